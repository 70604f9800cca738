//! What time it is, and new ids: arguments of everything else, so that tests decide both.
//!
//! `main`, `server` and the commands make the [`Clock`] and the [`Ids`] of a process, and hand them on; `clippy.toml` keeps all others
//! from asking the operating system. Timers are tokio's, which tests pause: what is compared with these asks `timer_now`.

#![expect(clippy::disallowed_methods, reason = "the one place where the system's clock and random ids are asked for")]

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use jiff::Timestamp;
use tokio::sync::watch;
use uuid::Uuid;

/// Tells the time: of the day, and for durations. Copies of a clock tell the same.
#[derive(Clone, Debug)]
pub struct Clock(Option<Arc<watch::Sender<Stepped>>>);

/// What a clock shows that is stepped by hand.
#[derive(Clone, Copy, Debug)]
struct Stepped {
    now: Timestamp,
    instant: Instant,
}

impl Clock {
    /// The operating system's.
    #[must_use]
    pub fn system() -> Self {
        Self(None)
    }

    /// One that shows `now` until it is stepped.
    #[must_use]
    pub fn stepped(now: Timestamp) -> Self {
        Self(Some(Arc::new(watch::Sender::new(Stepped { now, instant: Instant::now() }))))
    }

    /// Moves the clock on. The operating system's goes by itself, and is left alone.
    pub fn step(&self, by: Duration) {
        if let Some(stepped) = &self.0 {
            stepped.send_modify(|stepped| {
                stepped.now = stepped.now.checked_add(by).unwrap_or(Timestamp::MAX);
                stepped.instant += by;
            });
        }
    }

    /// The time of the day. It may be set back.
    #[must_use]
    pub fn now(&self) -> Timestamp {
        self.read().map_or_else(Timestamp::now, |stepped| stepped.now)
    }

    /// What durations are measured by. It never goes back.
    #[must_use]
    pub fn instant(&self) -> Instant {
        self.read().map_or_else(Instant::now, |stepped| stepped.instant)
    }

    /// How long ago `since` was.
    #[must_use]
    pub fn elapsed(&self, since: Instant) -> Duration {
        self.instant().saturating_duration_since(since)
    }

    /// Waits until [`Self::instant`] is `instant`.
    pub async fn sleep_until(&self, instant: Instant) {
        match &self.0 {
            None => tokio::time::sleep_until(instant.into()).await,
            Some(stepped) => {
                // The sender is here, so that it does not end.
                let _ = stepped.subscribe().wait_for(|stepped| stepped.instant >= instant).await;
            }
        }
    }

    fn read(&self) -> Option<Stepped> {
        Some(*self.0.as_ref()?.borrow())
    }
}

/// What tokio's timers go by: tests pause it.
pub(crate) fn timer_now() -> tokio::time::Instant {
    tokio::time::Instant::now()
}

/// Makes ids, each of them once. Copies never make the same.
#[derive(Clone, Debug)]
pub struct Ids(Option<Arc<AtomicU64>>);

impl Ids {
    /// Ids that nobody else makes, in the order of time (UUID, version 7).
    #[must_use]
    pub fn random() -> Self {
        Self(None)
    }

    /// 1, 2, 3 and so on, as UUIDs.
    #[must_use]
    pub fn counted() -> Self {
        Self(Some(Arc::default()))
    }

    /// The next id.
    #[must_use]
    pub fn next(&self) -> Uuid {
        match &self.0 {
            None => Uuid::now_v7(),
            Some(last) => Uuid::from_u128(u128::from(last.fetch_add(1, Ordering::Relaxed)) + 1),
        }
    }
}

/// How long the processors have worked on this thread.
pub(crate) fn thread_time() -> Duration {
    let used = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::try_from(used).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_that_is_stepped_moves_both_times_and_its_copies() {
        let clock = Clock::stepped(Timestamp::UNIX_EPOCH);
        let (copy, before) = (clock.clone(), clock.instant());
        assert_eq!((copy.now(), copy.elapsed(before)), (Timestamp::UNIX_EPOCH, Duration::ZERO));
        clock.step(Duration::from_secs(90));
        assert_eq!((copy.now().as_second(), copy.elapsed(before)), (90, Duration::from_secs(90)));
    }

    #[tokio::test]
    async fn who_waits_for_a_time_of_a_clock_that_is_stepped_waits_for_its_steps() {
        let clock = Clock::stepped(Timestamp::UNIX_EPOCH);
        let due = clock.instant() + Duration::from_secs(2);
        let mut waiting = Box::pin(clock.sleep_until(due));
        for _ in 0..2 {
            assert!(futures_util::poll!(&mut waiting).is_pending());
            clock.step(Duration::from_secs(1));
        }
        waiting.await;
        clock.sleep_until(due).await;
    }

    #[test]
    fn counted_ids_begin_with_one_and_copies_go_on() {
        let ids = Ids::counted();
        assert_eq!(ids.next().as_u128(), 1);
        assert_eq!(ids.clone().next().as_u128(), 2);
    }
}
