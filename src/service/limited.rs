//! Jobs that may take so long.

use std::time::{Duration, Instant};

use crate::clock::Clock;
use etude_core::interrupt::{Interrupt, Signal};

/// An interrupt with a time limit, which does not count the time in which the job makes way for others.
pub(super) struct LimitedTime<'i> {
    inner: &'i mut dyn Interrupt,
    clock: Clock,
    left: Duration,
    last: Instant,
}

impl<'i> LimitedTime<'i> {
    pub(super) fn new(inner: &'i mut dyn Interrupt, max_time: Duration, clock: Clock) -> Self {
        Self { inner, left: max_time, last: clock.instant(), clock }
    }
}

impl Interrupt for LimitedTime<'_> {
    fn poll(&mut self) -> Signal {
        self.left = self.left.saturating_sub(self.clock.elapsed(self.last));
        let signal = self.inner.poll();
        self.last = self.clock.instant();
        if signal == Signal::Continue && self.left.is_zero() { Signal::Finish } else { signal }
    }
}
