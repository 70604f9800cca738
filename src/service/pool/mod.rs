//! The bounded pool that everything CPU-bound runs on.
//!
//! ```text
//! admit --> place --run--> waits for a turn --> runs --(a moment)--> is long --(makes way, waits for a turn)--+--> done
//!                               ^                                       ^-------------------------------------+
//!                               +---- whose turn it is: `turns`
//! ```
//!
//! A job is admitted while there is a place for its client, waits for its turn, and runs on a thread. What has run for longer than a
//! [`MOMENT`] may hold all threads but some, and makes way for the long jobs of other clients: it keeps what it has done and waits for its
//! next turn, so that small requests are answered while any number of large ones run. Whoever waits for a job may go away at
//! any time: it then leaves the queue, or is told to stop when it next asks its [`Interrupt`].
//!
//! Bodies are read on threads of their own, by the same rules, as how long a request may wait is written in its body. A job that has
//! to be answered by some time runs beside the pool if it has waited until then: to finish at once is all that it can do. What
//! nobody waits for runs where there is a thread to spare, and is stopped as soon as somebody needs that. And a job that is over
//! before a change of threads would have paid for itself runs where it is ([`SearchPool::run_here`]).

mod turns;

use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use rustc_hash::FxHashMap;
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use super::Client;
use crate::clock::Clock;
use etude_core::interrupt::{Cancelled, Interrupt, Signal};
pub(crate) use turns::Places;
use turns::{Class, LENT_AFTER, Level, Ticket, Turns};

/// How long a job, or all jobs of a request together, may run before it is long. Most are over by then.
const MOMENT: Duration = Duration::from_millis(10);

/// How long a long job keeps its thread while those of other clients wait. Long beside the change of threads that it costs.
const SHARE: Duration = Duration::from_millis(100);

/// How often a long job looks whether it should make way.
const LOOK_EVERY: Duration = Duration::from_millis(1);

/// Most jobs that have made way, each of which keeps a thread of the operating system; more are refused.
const MAX_PARKED: usize = 256;

/// How long a job that nobody waits for may go on when it has taken the last thread: longer than most jobs keep theirs.
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

/// What all jobs share, which is counted as a whole, not part by part: every request has a place of its own.
#[derive(Debug)]
struct Shared {
    searching: Arc<Threads>,
    reading: Arc<Threads>,
    tasks: TaskTracker,
    abort: CancellationToken,
    clock: Clock,
}

/// Threads that jobs take turns on.
#[derive(Debug)]
struct Threads(Mutex<Lines>);

#[derive(Debug)]
struct Lines {
    clock: Clock,
    turns: Turns,
    /// How to tell those who wait.
    waiting: FxHashMap<Ticket, oneshot::Sender<()>>,
    /// Jobs that have made way and wait with all that they have done.
    n_parked: usize,
}

impl Lines {
    /// Tells those whose turn it is.
    fn pass_on(&mut self) {
        while let Some(ticket) = self.turns.next(self.clock.instant()) {
            if let Some(waiting) = self.waiting.remove(&ticket) {
                // Whoever has gone gives the thread back.
                let _ = waiting.send(());
            }
        }
    }
}

impl Threads {
    fn new(settings: PoolSettings, clock: Clock) -> Self {
        let n_short = settings.n_threads.max(1) + settings.max_waiting;
        let turns = Turns::new(settings.n_threads, n_short, settings.max_long);
        Self(Mutex::new(Lines { clock, turns, waiting: FxHashMap::default(), n_parked: 0 }))
    }

    /// What a panic has left behind is whole.
    fn lines(&self) -> MutexGuard<'_, Lines> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a thread, or lines up for one.
    fn start_or_wait(self: &Arc<Self>, client: Client, class: Class, level: Level) -> Result<Turn, Waiting> {
        let mut lines = self.lines();
        let now = lines.clock.instant();
        if lines.turns.try_start(class, now) {
            return Ok(Turn { threads: Arc::clone(self), class });
        }
        Err(self.line_up(&mut lines, client, class, level))
    }

    fn line_up(self: &Arc<Self>, lines: &mut Lines, client: Client, class: Class, level: Level) -> Waiting {
        let (sender, granted) = oneshot::channel();
        let ticket = lines.turns.wait(client, class, level);
        lines.waiting.insert(ticket, sender);
        Waiting { threads: Arc::clone(self), client, class, ticket: Some(ticket), granted }
    }
}

/// The right to use a thread, until it is dropped.
#[derive(Debug)]
struct Turn {
    threads: Arc<Threads>,
    class: Class,
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut lines = self.threads.lines();
        lines.turns.stop(self.class);
        lines.pass_on();
    }
}

/// A job that waits for its turn, until it is dropped.
#[derive(Debug)]
struct Waiting {
    threads: Arc<Threads>,
    client: Client,
    class: Class,
    /// `None` once it has its turn.
    ticket: Option<Ticket>,
    granted: oneshot::Receiver<()>,
}

impl Waiting {
    async fn turn(mut self) -> Turn {
        loop {
            tokio::select! {
                biased;
                _ = &mut self.granted => {
                    self.ticket = None;
                    return Turn { threads: Arc::clone(&self.threads), class: self.class };
                }
                // Then a thread may be lent that was not before.
                () = tokio::time::sleep(LENT_AFTER), if self.class == Class::Long => self.threads.lines().pass_on(),
            }
        }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        let Some(ticket) = self.ticket else { return };
        let mut lines = self.threads.lines();
        lines.waiting.remove(&ticket);
        if !lines.turns.give_up(self.client, self.class, ticket) {
            // It was granted, and nobody has noticed.
            lines.turns.stop(self.class);
        }
        lines.pass_on();
    }
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
        Admission { pool: self.clone(), client, place: Arc::default(), patience: None }
    }

    /// Runs `job` for `client` when it is its turn, however many wait. For callers that are bounded in number themselves.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop.
    pub async fn run_patiently<T, F>(&self, client: Client, job: F) -> Result<T, PoolError>
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
    pub async fn read_patiently<T, F>(&self, client: Client, n_bytes: usize, job: F) -> Result<T, PoolError>
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
        let reading = Job { client, turn: None, place: None, deadline: None };
        self.run_holding((held, turn), reading, |_| Ok(job())).await
    }

    /// Runs `job`, which nobody waits for, if there is a thread to spare: of several, another one stays free when it begins.
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
        if !threads.lines().turns.try_start_spare() {
            return Err(PoolError::Busy);
        }
        let turn = Turn { threads: Arc::clone(&threads), class: Class::Long };
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
        let running = self.0.tasks.spawn_blocking(move || {
            let _held = held;
            give_way();
            let mut watch = Watch::new(job, cancel, runtime, clock);
            let done = span.in_scope(|| run(&mut watch));
            (done, watch.is_refused)
        });
        match running.await {
            Ok((Ok(answer), _)) => Ok(answer),
            Ok((Err(Cancelled), is_refused)) => Err(if is_refused { PoolError::Busy } else { PoolError::Stopped }),
            Err(_) => Err(PoolError::Panicked),
        }
    }
}

/// The level of a job that has run for so long.
fn level(ran: Duration) -> Level {
    let n_moments = ran.as_micros() / MOMENT.as_micros();
    n_moments.checked_ilog2().map_or(0, |power| power + 1)
}

/// A place in the pool, counted among the short or the long ones.
#[derive(Debug)]
struct Place {
    threads: Arc<Threads>,
    client: Client,
    is_long: AtomicBool,
    /// How long the jobs of this request have run.
    spent_us: AtomicU64,
}

impl Place {
    /// How long its jobs have run.
    fn level(&self) -> Level {
        level(Duration::from_micros(self.spent_us.load(Ordering::Relaxed)))
    }

    fn class(&self) -> Class {
        if self.is_long.load(Ordering::Relaxed) { Class::Long } else { Class::Short }
    }

    /// Moves to the long ones. Says whether there is a place among them.
    fn become_long(&self, turns: &mut Turns) -> bool {
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

impl Drop for Place {
    fn drop(&mut self) {
        self.threads.lines().turns.leave(self.client, self.class());
    }
}

/// A place in the pool. Given back when this and its clones are dropped and the last job that ran by it has ended.
#[derive(Clone, Debug)]
pub struct Admission {
    pool: SearchPool,
    client: Client,
    /// Once it is taken.
    place: Arc<OnceLock<Arc<Place>>>,
    /// Until when jobs wait for a thread.
    patience: Option<Instant>,
}

impl Admission {
    /// The same place, whose jobs wait for a thread of the pool until `patience` at most, and then run beside it.
    #[must_use]
    pub fn with_patience(self, patience: Option<Instant>) -> Self {
        Self { patience, ..self }
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
    fn place(&self) -> Result<Arc<Place>, PoolError> {
        if let Some(place) = self.place.get() {
            return Ok(Arc::clone(place));
        }
        let threads = &self.pool.0.searching;
        if !threads.lines().turns.admit(self.client, Class::Short) {
            return Err(PoolError::Busy);
        }
        let place = Place {
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
        let turn = match self.patience {
            None => Some(waiting.await?),
            // Nothing if the patience ends first.
            Some(patience) => tokio::time::timeout_at(patience.into(), waiting).await.ok().transpose()?,
        };
        self.pool.run_holding((), Job { client, turn, place: Some(place), deadline }, job).await
    }
}

/// Lets the threads that talk to clients and to the disk come before this one, from now on: they need little, and soon.
fn give_way() {
    /// Where all processors are wanted, a thirtieth of what others have: a search that runs is then interrupted at once by a thread that has
    /// an answer to send.
    const NICENESS: i32 = 15;
    thread_local! {
        static HAS_GIVEN_WAY: Cell<bool> = const { Cell::new(false) };
    }
    #[cfg(target_os = "linux")]
    if !HAS_GIVEN_WAY.replace(true) {
        // Threads have priorities of their own here. Where this one keeps its, things are as they were.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
    }
}

/// What is known of a job that is about to run.
struct Job {
    client: Client,
    /// `None` beside the pool.
    turn: Option<Turn>,
    /// `None` if its caller is bounded in number.
    place: Option<Arc<Place>>,
    deadline: Option<Instant>,
}

/// Looks at the token, the clock, and whose turn it is, when asked.
struct Watch {
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
    is_refused: bool,
}

impl Watch {
    fn new(job: Job, cancel: CancellationToken, runtime: Handle, clock: Clock) -> Self {
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

#[cfg(test)]
mod tests;
