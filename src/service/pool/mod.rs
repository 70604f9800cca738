//! The bounded pool that everything CPU-bound runs on.
//!
//! ```text
//! admit --> place --run--> waits for a turn --> runs --(a moment)--> is long --(makes way, waits for a turn)--+--> done
//!                               ^                                       ^-------------------------------------+
//!                               +---- whose turn it is: `turns`
//! ```
//!
//! A job is admitted while there is a place for its client, waits for its turn, and runs on a thread. What has run for longer than a
//! [`MOMENT`](place::MOMENT) is *long*. Long jobs never hold all threads, and make way for those of other clients: a job that makes way
//! keeps its progress and waits for its next turn. So small requests are answered while any number of large ones run. If the caller of a
//! job goes away, the job leaves the queue, or is told to stop when it next asks its [`Interrupt`].
//!
//! - Bodies are read on threads of their own, by the same rules: a request's deadline is written in its body, so that nobody knows it
//!   before.
//! - A job whose deadline comes while it waits runs beside the pool. It can do nothing but finish at once.
//! - A background job runs only while there is a spare thread, and is stopped as soon as another job needs that.
//! - A job that is shorter than a change of threads runs on the caller's thread ([`SearchPool::run_here`]).
//! - What a job uses of a processor is charged to its client. Whoever has used less comes first, and a short job of a client that has used little
//!   runs on a thread of its own that the operating system prefers to those of long jobs.

mod place;
mod priority;
mod threads;
mod turns;
mod watch;

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use crate::client::Client;
use crate::clock::Clock;
use etude_core::interrupt::{Cancelled, Interrupt, Signal};
use place::PoolPlace;
use priority::Niceness;
use threads::{Threads, Turn};
pub(crate) use turns::Places;
use turns::{Class, Level};
use watch::{Job, Watch};

/// How long a background job may go on once no thread is free: longer than most jobs keep theirs.
const LAST_THREAD_KEPT: Duration = Duration::from_millis(100);

/// Bodies over this size take longer than a moment to be read.
const LONG_READ_BYTES: usize = 1 << 20;

/// Size of the pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolSettings {
    /// Jobs that run at the same time. A few more run while they take less than a moment.
    pub n_threads: usize,
    /// Jobs that wait; further ones are refused.
    pub max_waiting: usize,
    /// Jobs that have run for longer than a moment, waiting for their next turn or running; further ones are refused then.
    pub max_long: usize,
}

/// Why a job has no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// As many jobs wait as may, or as many of this client's.
    #[error("too many requests are waiting to be searched; try again shortly")]
    Busy,
    /// The service is shutting down, and the job was stopped.
    #[error("the service is shutting down")]
    Stopped,
    /// The job panicked: a defect. The panic was logged.
    #[error("the search failed")]
    Panicked,
}

/// The pool.
#[derive(Clone, Debug)]
pub struct SearchPool(Arc<Shared>);

/// What all jobs share. It is behind one `Arc`, so that the clone that each request keeps is cheap.
#[derive(Debug)]
struct Shared {
    searching: Arc<Threads>,
    reading: Arc<Threads>,
    tasks: TaskTracker,
    abort: CancellationToken,
    clock: Clock,
}

impl SearchPool {
    /// A pool whose jobs run in `tasks`, by `clock`, and stop when `abort` is cancelled.
    #[must_use]
    pub fn new(settings: PoolSettings, clock: Clock, tasks: TaskTracker, abort: CancellationToken) -> Self {
        let threads = || Arc::new(Threads::new(settings, clock.clone()));
        Self(Arc::new(Shared { searching: threads(), reading: threads(), tasks, abort, clock }))
    }

    /// How many jobs are in the pool, waiting or running.
    #[must_use]
    pub fn n_jobs(&self) -> usize {
        self.0.searching.lines().turns.n_jobs()
    }

    /// A place in the pool, for all that a request of `client` needs.
    ///
    /// # Errors
    ///
    /// [`PoolError::Busy`] at once if there is none for it.
    pub fn admit(&self, client: Client) -> Result<Admission, PoolError> {
        let admission = self.admit_when_needed(client);
        admission.place()?;
        Ok(admission)
    }

    /// A place in the pool for a request of `client`, which is taken with the first job that runs by it: small requests may need none.
    #[must_use]
    pub fn admit_when_needed(&self, client: Client) -> Admission {
        Admission { pool: self.clone(), client, place: Arc::default(), wait_until: None }
    }

    /// Runs `job` for `client` when it is its turn, however many wait. For callers that are bounded in number themselves.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop.
    pub async fn run_in_turn<T, F>(&self, client: Client, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let turn = self.turn(&self.0.searching, client, Class::Short, 0).await?;
        self.run_holding((), Job { client, turn: Some(turn), place: None, deadline: None }, job).await
    }

    /// Runs `job`, which reads so many bytes for `client`, when it is its turn among what is read. For callers that are bounded in number
    /// themselves.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the service ends before it has begun.
    pub async fn read_in_turn<T, F>(&self, client: Client, n_bytes: usize, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        self.read_holding((), client, n_bytes, job).await
    }

    /// Runs `job`, which reads so many bytes for `client`, and keeps `held` until it has ended.
    async fn read_holding<T, F>(
        &self,
        held: impl Send + 'static,
        client: Client,
        n_bytes: usize,
        job: F,
    ) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let class = if n_bytes > LONG_READ_BYTES { Class::Long } else { Class::Short };
        let turn = self.turn(&self.0.reading, client, class, 0).await?;
        self.run_holding(held, Job { client, turn: Some(turn), place: None, deadline: None }, |_| Ok(job())).await
    }

    /// Runs a background job, if there is a thread to spare: where there are several threads, one more stays free when it begins.
    ///
    /// # Errors
    ///
    /// [`PoolError::Busy`] if there is none, or the job was told to stop because somebody waits for a thread or all have been taken
    /// for a while; [`PoolError::Stopped`] if the service ends.
    pub async fn run_to_spare<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let threads = Arc::clone(&self.0.searching);
        if !threads.lines().turns.try_start_spare(Client::LOCAL) {
            return Err(PoolError::Busy);
        }
        let turn = Turn { threads: Arc::clone(&threads), client: Client::LOCAL, class: Class::Long };
        let clock = self.0.clock.clone();
        let yielding = move |watch: &mut dyn Interrupt| {
            let mut last_since: Option<Instant> = None;
            let mut is_needed = || {
                let turns = &threads.lines().turns;
                last_since = if turns.are_all_taken() { last_since.or_else(|| Some(clock.instant())) } else { None };
                turns.is_waited_for() || last_since.is_some_and(|since| clock.elapsed(since) >= LAST_THREAD_KEPT)
            };
            job(&mut || if is_needed() { Signal::Cancel } else { watch.poll() })
        };
        // Its turn is not the job's to give away: it makes way by ending.
        let job = Job { client: Client::LOCAL, turn: None, place: None, deadline: None };
        match self.run_holding(turn, job, yielding).await {
            Err(PoolError::Stopped) if !self.0.abort.is_cancelled() => Err(PoolError::Busy),
            answer => answer,
        }
    }

    /// Runs `job` beside the threads of the pool, which it must not keep: it waits for others. For callers that are bounded in
    /// number themselves.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop.
    pub async fn run_aside<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        self.run_holding((), Job { client: Client::LOCAL, turn: None, place: None, deadline: None }, job).await
    }

    /// Runs `job`, which takes no longer than a millisecond or so, at once, on the thread that polls the caller. It is told to finish
    /// when `deadline` has passed. Such jobs need no place: no more of them run at a time than there are threads for what is asynchronous.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the service ends before it has begun.
    pub fn run_here<T>(
        &self,
        deadline: Option<Instant>,
        job: impl FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled>,
    ) -> Result<T, PoolError> {
        self.0.searching.lines().turns.note_short(self.0.clock.instant());
        job(&mut || {
            if self.0.abort.is_cancelled() {
                Signal::Cancel
            } else if deadline.is_some_and(|deadline| self.0.clock.instant() >= deadline) {
                Signal::Finish
            } else {
                Signal::Continue
            }
        })
        .map_err(|Cancelled| PoolError::Stopped)
    }

    /// Waits for a turn on `threads`.
    async fn turn(
        &self,
        threads: &Arc<Threads>,
        client: Client,
        class: Class,
        level: Level,
    ) -> Result<Turn, PoolError> {
        if self.0.abort.is_cancelled() {
            return Err(PoolError::Stopped);
        }
        let waiting = match threads.start_or_wait(client, class, level) {
            Ok(turn) => return Ok(turn),
            Err(waiting) => waiting,
        };
        tokio::select! {
            biased;
            () = self.0.abort.cancelled() => Err(PoolError::Stopped),
            turn = waiting.turn() => Ok(turn),
        }
    }

    /// Runs `run`, and keeps `held` until it has really ended, even if nobody waits for it any more.
    async fn run_holding<T, F>(&self, held: impl Send + 'static, job: Job, run: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let cancel = self.0.abort.child_token();
        // Dropped with this future: whoever waited is gone.
        let _gone: DropGuard = cancel.clone().drop_guard();
        let span = tracing::Span::current();
        let (runtime, clock) = (Handle::current(), self.0.clock.clone());
        let is_quick = job.turn.as_ref().is_some_and(|turn| turn.class == Class::Quick);
        let niceness = if is_quick { Niceness::Quick } else { Niceness::Long };
        let token = self.0.tasks.token();
        let running = priority::run(niceness, move || {
            let _held = (held, token);
            let mut watch = Watch::new(job, cancel, runtime, clock);
            let done = span.in_scope(|| run(&mut watch));
            (done, watch.is_refused)
        })?;
        match running.await.map_err(|_| PoolError::Panicked)? {
            (Ok(answer), _) => Ok(answer),
            (Err(Cancelled), is_refused) => Err(if is_refused { PoolError::Busy } else { PoolError::Stopped }),
        }
    }
}

/// A place in the pool. Given back when this and its clones are dropped and the last job that ran by it has ended.
#[derive(Clone, Debug)]
pub struct Admission {
    pool: SearchPool,
    client: Client,
    /// Once it is taken.
    place: Arc<OnceLock<Arc<PoolPlace>>>,
    /// Until when jobs wait for a thread of the pool; `None` for as long as it takes.
    wait_until: Option<Instant>,
}

impl Admission {
    /// The same place, whose jobs wait for a thread of the pool until `wait_until` at most, and then run on a thread beside it.
    #[must_use]
    pub fn waiting_until(self, wait_until: Option<Instant>) -> Self {
        Self { wait_until, ..self }
    }

    /// Takes the place, if it was not taken before.
    ///
    /// # Errors
    ///
    /// [`PoolError::Busy`] if there is none.
    pub(super) fn take(&self) -> Result<(), PoolError> {
        self.place().map(|_| ())
    }

    /// The place, which is taken if it was not before.
    fn place(&self) -> Result<Arc<PoolPlace>, PoolError> {
        if let Some(place) = self.place.get() {
            return Ok(Arc::clone(place));
        }
        let threads = &self.pool.0.searching;
        if !threads.lines().turns.admit(self.client, Class::Short) {
            return Err(PoolError::Busy);
        }
        let place = PoolPlace {
            threads: Arc::clone(threads),
            client: self.client,
            is_long: AtomicBool::new(false),
            spent_us: AtomicU64::new(0),
        };
        // If another job of the request was faster, this one is given back.
        Ok(Arc::clone(self.place.get_or_init(|| Arc::new(place))))
    }

    /// Runs `job`, which reads so many bytes, off the async threads: it does not wait for searches.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the service ends before it has begun, [`PoolError::Busy`] if there is no place for it.
    pub async fn run_reading<T, F>(&self, n_bytes: usize, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let place = self.place()?;
        self.pool.read_holding(place, self.client, n_bytes, job).await
    }

    /// Runs `job` on a thread of the pool. It is told to finish when `deadline` has passed, and to stop when the returned
    /// future is dropped or the service ends.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop, [`PoolError::Busy`] if there is no place for it, or none among those that have
    /// run for longer than a moment once it has.
    pub async fn run<T, F>(&self, deadline: Option<Instant>, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let (place, client) = (self.place()?, self.client);
        let waiting = self.pool.turn(&self.pool.0.searching, client, place.class(), place.level());
        let turn = match self.wait_until {
            None => Some(waiting.await?),
            // `None` if that time comes first.
            Some(until) => tokio::time::timeout_at(until.into(), waiting).await.ok().transpose()?,
        };
        self.pool.run_holding((), Job { client, turn, place: Some(place), deadline }, job).await
    }
}

#[cfg(test)]
pub(in crate::service) mod tests;
