//! The place of a request in the pool.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use super::threads::Threads;
use super::turns::{Class, Level, Turns};
use crate::client::Client;

/// How long a job, or all jobs of a request together, may run before it is long. Most are over by then.
pub(super) const MOMENT: Duration = Duration::from_millis(10);

/// A place in the pool, counted among the short or the long ones.
#[derive(Debug)]
pub(super) struct PoolPlace {
    pub(super) threads: Arc<Threads>,
    pub(super) client: Client,
    pub(super) is_long: AtomicBool,
    /// How long the jobs of this request have run.
    pub(super) spent_us: AtomicU64,
}

impl PoolPlace {
    /// How long its jobs have run.
    pub(super) fn level(&self) -> Level {
        level(Duration::from_micros(self.spent_us.load(Ordering::Relaxed)))
    }

    pub(super) fn class(&self) -> Class {
        if self.is_long.load(Ordering::Relaxed) { Class::Long } else { Class::Short }
    }

    /// Moves to the long ones. Says whether there is a place among them.
    pub(super) fn become_long(&self, turns: &mut Turns) -> bool {
        if self.is_long.load(Ordering::Relaxed) {
            return true;
        }
        let is_admitted = turns.admit(self.client, Class::Long);
        if is_admitted {
            turns.leave(self.client, Class::Short);
            self.is_long.store(true, Ordering::Relaxed);
        }
        is_admitted
    }
}

impl Drop for PoolPlace {
    fn drop(&mut self) {
        self.threads.lines().turns.leave(self.client, self.class());
    }
}

/// The level of a job that has run for so long.
pub(super) fn level(ran: Duration) -> Level {
    let n_moments = ran.as_micros() / MOMENT.as_micros();
    n_moments.checked_ilog2().map_or(0, |power| power + 1)
}
