//! How long steps wait, by the server's clock.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

/// When steps of a session are due that advance to what was observed.
#[derive(Debug)]
pub(crate) struct Waits {
    /// How long a step waits at most after the observation that it advances to came.
    limit: Duration,
    /// From which observation on it is due when.
    due: VecDeque<(u32, Instant)>,
}

impl Waits {
    /// Steps that wait for so many milliseconds, if any do.
    pub(crate) fn of(lookahead_ms: Option<NonZeroU64>) -> Option<Self> {
        /// A century, so that a time is never too late to be told.
        const LONGEST: Duration = Duration::from_hours(100 * 365 * 24);
        let limit = Duration::from_millis(lookahead_ms?.get()).min(LONGEST);
        Some(Self { limit, due: VecDeque::new() })
    }

    /// The observations from `first` on have come, so long before `now`.
    pub(crate) fn came(&mut self, first: u32, ago: Duration, now: Instant) {
        self.due.push_back((first, now + self.limit.saturating_sub(ago)));
    }

    /// Forgets observations before `n_met`, which committed steps have met.
    pub(crate) fn met(&mut self, n_met: u32) {
        while self.due.get(1).is_some_and(|(first, _)| *first <= n_met) {
            self.due.pop_front();
        }
    }

    /// When the next step is due: the one that advances to the observation `n_met`, if that is one of `n_received`.
    pub(crate) fn next(&self, n_met: u32, n_received: u32) -> Option<Instant> {
        let (first, due) = self.due.front()?;
        (*first <= n_met && n_met < n_received).then_some(*due)
    }

    /// How many of `n_received` observations steps are due to have met by `now`.
    pub(super) fn n_due(&self, n_received: u32, now: Instant) -> u32 {
        let waiting = self.due.iter().find(|(_, due)| *due > now);
        waiting.map_or(n_received, |(first, _)| *first)
    }
}

#[cfg(test)]
mod tests;
