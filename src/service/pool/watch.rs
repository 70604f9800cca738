//! What a job asks while it runs: whether it is to stop, to finish, or to make way for another one.

use std::cell::Cell;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use tokio_util::sync::CancellationToken;

use super::place::{MOMENT, PoolPlace, level};
use super::threads::{Threads, Turn, Waiting};
use super::turns::Class;
use crate::client::Client;
use crate::clock::Clock;
use etude_core::interrupt::{Interrupt, Signal};

/// How long a long job keeps its thread while those of other clients wait. Long beside the change of threads that it costs.
const SHARE: Duration = Duration::from_millis(100);

/// How often a long job looks whether it should make way.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Most jobs that have made way, each of which keeps a thread of the operating system; more are refused.
const MAX_PARKED: usize = 256;

/// Lowers the priority of this thread for good, so that threads which talk to clients and to the disk run first.
pub(super) fn give_way() {
    /// About a thirtieth of a normal thread's share while all processors are busy: a thread that has an answer to send then preempts a
    /// search at once.
    const NICENESS: i32 = 15;
    thread_local! {
        static HAS_GIVEN_WAY: Cell<bool> = const { Cell::new(false) };
    }
    #[cfg(target_os = "linux")]
    if !HAS_GIVEN_WAY.replace(true) {
        // On Linux each thread has its own priority. If it cannot be set, the thread only competes with the others.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
    }
}

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
    /// Whether it was stopped as there was no place for it among the long ones.
    pub(super) is_refused: bool,
}

impl Watch {
    pub(super) fn new(job: Job, cancel: CancellationToken, runtime: Handle, clock: Clock) -> Self {
        let began = clock.instant();
        let before = job.place.as_ref().map_or(0, |place| place.spent_us.load(Ordering::Relaxed));
        let before = Duration::from_micros(before);
        let next_look = began + MOMENT.saturating_sub(before);
        Self { job, cancel, runtime, clock, began, before, next_look, is_refused: false }
    }

    /// Becomes long, or makes way if it should.
    fn look(&mut self, now: Instant) -> Signal {
        self.next_look = now + LOOK_EVERY;
        let Some(turn) = &mut self.job.turn else { return Signal::Continue };
        let ran = now - self.began;
        let level = level(self.before + ran);
        let threads = Arc::clone(&turn.threads);
        let mut lines = threads.lines();
        let makes_way = if turn.class == Class::Short {
            if self.job.place.as_ref().is_some_and(|place| !place.become_long(&mut lines.turns)) {
                self.is_refused = true;
                return Signal::Cancel;
            }
            turn.class = Class::Long;
            !lines.turns.become_long(now)
        } else {
            lines.turns.makes_way(self.job.client, level, ran >= SHARE, now)
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
