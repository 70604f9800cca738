//! What a job asks while it runs: whether it is to stop, to finish, or to make way for another one.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use super::place::{MOMENT, PoolPlace, level};
use super::priority::{Niceness, give_way};
use super::threads::{Threads, Turn, Waiting};
use super::turns::Class;
use crate::client::Client;
use crate::clock::{Clock, thread_time};
use etude_core::interrupt::{Interrupt, Signal};

/// How long a long job keeps its thread while those of other clients wait. Long beside the change of threads that it costs.
const SHARE: Duration = Duration::from_millis(100);

/// How often a long job looks whether it should make way.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Most jobs that have made way, each of which keeps a thread of the operating system; more are refused.
const MAX_PARKED: usize = 256;

/// What is known of a job that is about to run.
pub(super) struct Job {
    pub(super) client: Client,
    /// `None` beside the pool.
    pub(super) turn: Option<Turn>,
    /// `None` if its caller is bounded in number.
    pub(super) place: Option<Arc<PoolPlace>>,
    pub(super) deadline: Option<Instant>,
}

/// Looks at the token, the clock, and whose turn it is, when asked.
pub(super) struct Watch {
    job: Job,
    cancel: CancellationToken,
    runtime: Handle,
    clock: Clock,
    /// When its turn began.
    began: Instant,
    /// How long it had run before.
    before: Duration,
    next_look: Instant,
    /// What the thread has used of its processor when the job began.
    used_before: Duration,
    /// How much the job has used since, as far as it is charged to its client.
    charged: Duration,
    /// Whether it was stopped as there was no place for it among the long ones.
    pub(super) is_refused: bool,
}

impl Watch {
    pub(super) fn new(job: Job, cancel: CancellationToken, runtime: Handle, clock: Clock) -> Self {
        let began = clock.instant();
        let before = job.place.as_ref().map_or(0, |place| place.spent_us.load(Ordering::Relaxed));
        let before = Duration::from_micros(before);
        let next_look = began + MOMENT.saturating_sub(before);
        let (used_before, charged) = (thread_time(), Duration::ZERO);
        Self { job, cancel, runtime, clock, began, before, next_look, used_before, charged, is_refused: false }
    }

    /// Becomes long, or makes way if it should.
    fn look(&mut self, now: Instant) -> Signal {
        self.next_look = now + LOOK_EVERY;
        self.charge(now);
        let Some(turn) = &mut self.job.turn else { return Signal::Continue };
        let ran = now - self.began;
        let level = level(self.before + ran);
        let threads = Arc::clone(&turn.threads);
        // Whoever uses little is not to suffer for others that use the processors.
        if turn.class == Class::Quick && self.charged < MOMENT {
            return Signal::Continue;
        }
        let mut lines = threads.lines();
        let makes_way = if turn.class == Class::Long {
            lines.turns.makes_way(self.job.client, level, ran >= SHARE, now)
        } else {
            if self.job.place.as_ref().is_some_and(|place| !place.become_long(&mut lines.turns)) {
                self.is_refused = true;
                return Signal::Cancel;
            }
            give_way(Niceness::Long);
            let class = std::mem::replace(&mut turn.class, Class::Long);
            !lines.turns.become_long(turn.client, class, now)
        };
        if !makes_way {
            return Signal::Continue;
        }
        if lines.n_parked >= MAX_PARKED {
            self.is_refused = true;
            return Signal::Cancel;
        }
        lines.n_parked += 1;
        let waiting = threads.line_up(&mut lines, self.job.client, Class::Long, level);
        drop(lines);
        self.count();
        self.before += ran;
        self.job.turn = None;
        self.wait(&threads, waiting)
    }

    /// Waits for the next turn.
    fn wait(&mut self, threads: &Threads, waiting: Waiting) -> Signal {
        let (cancel, deadline) = (self.cancel.clone(), self.job.deadline);
        let until_deadline = async {
            match deadline {
                Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
                None => std::future::pending().await,
            }
        };
        let waited = self.runtime.block_on(async {
            tokio::select! {
                biased;
                () = cancel.cancelled() => Err(Signal::Cancel),
                () = until_deadline => Err(Signal::Finish),
                turn = waiting.turn() => Ok(turn),
            }
        });
        self.began = self.clock.instant();
        threads.lines().n_parked -= 1;
        match waited {
            Ok(turn) => {
                self.job.turn = Some(turn);
                Signal::Continue
            }
            Err(signal) => signal,
        }
    }

    /// Charges to the client what its job has used of a processor until `now`.
    fn charge(&mut self, now: Instant) {
        if let Some(turn) = &self.job.turn {
            let used = thread_time().saturating_sub(self.used_before);
            turn.threads.lines().turns.charge(turn.client, used.saturating_sub(self.charged), now);
            self.charged = used;
        }
    }

    /// Adds to the place what this turn has taken.
    fn count(&self) {
        if let Some(place) = &self.job.place {
            let ran_us = u64::try_from(self.clock.elapsed(self.began).as_micros()).unwrap_or(u64::MAX);
            place.spent_us.fetch_add(ran_us, Ordering::Relaxed);
        }
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.charge(self.clock.instant());
        self.count();
    }
}

impl Interrupt for Watch {
    fn poll(&mut self) -> Signal {
        if self.cancel.is_cancelled() {
            return Signal::Cancel;
        }
        let now = self.clock.instant();
        if self.job.deadline.is_some_and(|deadline| now >= deadline) {
            return Signal::Finish;
        }
        if now >= self.next_look { self.look(now) } else { Signal::Continue }
    }
}
