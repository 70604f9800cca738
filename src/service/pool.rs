//! The bounded pool that everything CPU-bound runs on.
//!
//! A job is admitted if fewer than `n_threads + max_waiting` are in the pool, waits for a thread, and runs there. Whoever waits for
//! a job may go away at any time: it then leaves the queue, or is told to stop when it next asks its [`Interrupt`]. A job that is
//! over before a change of threads would have paid for itself waits its turn like the others, and then runs where it is.
//!
//! Searches may keep their threads for long. So bodies, which are read in a fraction of a second, wait for each other only, and a job
//! that has to be answered by some time runs beside the pool if it has waited until then: to finish at once is all that it can do.
//! What nobody waits for runs where there is a thread to spare, and is stopped as soon as somebody needs that.

use std::borrow::Borrow;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::{CancellationToken, DropGuard};
use tokio_util::task::TaskTracker;

use crate::interrupt::{Cancelled, Interrupt, Signal};

/// How long a job that nobody waits for may go on when it has taken the last thread: longer than most jobs keep theirs.
const LAST_THREAD_KEPT: Duration = Duration::from_millis(100);

/// Size of the pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolSettings {
    /// Jobs that run at the same time. At least 1.
    pub n_threads: usize,
    /// Jobs that wait; further ones are refused.
    pub max_waiting: usize,
}

/// Why a job has no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PoolError {
    /// As many jobs wait as may.
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
    settings: PoolSettings,
    admitted: Arc<Semaphore>,
    threads: Arc<Semaphore>,
    /// How many jobs wait for a thread.
    n_waiting: Arc<AtomicUsize>,
    /// For what is read: as many again.
    readers: Arc<Semaphore>,
    tasks: TaskTracker,
    abort: CancellationToken,
}

impl SearchPool {
    /// A pool whose jobs run in `tasks` and stop when `abort` is cancelled.
    #[must_use]
    pub fn new(settings: PoolSettings, tasks: TaskTracker, abort: CancellationToken) -> Self {
        let n_threads = settings.n_threads.max(1);
        Self(Arc::new(Shared {
            settings,
            admitted: Arc::new(Semaphore::new(n_threads + settings.max_waiting)),
            threads: Arc::new(Semaphore::new(n_threads)),
            n_waiting: Arc::default(),
            readers: Arc::new(Semaphore::new(n_threads)),
            tasks,
            abort,
        }))
    }

    /// How many jobs run at the same time, at most.
    #[must_use]
    pub fn n_threads(&self) -> usize {
        self.0.settings.n_threads.max(1)
    }

    /// How many jobs are in the pool, waiting or running.
    #[must_use]
    pub fn n_jobs(&self) -> usize {
        self.n_threads() + self.0.settings.max_waiting - self.0.admitted.available_permits()
    }

    /// A place in the pool, for all that a request needs.
    ///
    /// # Errors
    ///
    /// [`PoolError::Busy`] at once if the queue is full.
    pub fn admit(&self) -> Result<Admission, PoolError> {
        let admitted = Arc::clone(&self.0.admitted).try_acquire_owned().map_err(|_| PoolError::Busy)?;
        Ok(Admission { pool: self.clone(), admitted: Arc::new(admitted), patience: None })
    }

    /// Runs `job` when there is a thread for it, however many wait. For callers that are bounded in number themselves.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop.
    pub async fn run_patiently<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let cancel = self.0.abort.child_token();
        let thread = self.thread().await?;
        self.run_holding(thread, None, cancel, job).await
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
        let has_others = self.n_threads() > 1;
        let free = Arc::clone(&self.0.threads).try_acquire_many_owned(if has_others { 2 } else { 1 });
        let thread = free.ok().and_then(|mut free| free.split(1)).ok_or(PoolError::Busy)?;
        let (threads, n_waiting) = (Arc::clone(&self.0.threads), Arc::clone(&self.0.n_waiting));
        let yielding = move |watch: &mut dyn Interrupt| {
            let mut last_since: Option<Instant> = None;
            let mut is_needed = || {
                let is_last = has_others && threads.available_permits() == 0;
                last_since = if is_last { last_since.or_else(|| Some(Instant::now())) } else { None };
                n_waiting.load(Ordering::Relaxed) > 0
                    || last_since.is_some_and(|since| since.elapsed() >= LAST_THREAD_KEPT)
            };
            job(&mut || if is_needed() { Signal::Cancel } else { watch.poll() })
        };
        match self.run_holding(thread, None, self.0.abort.child_token(), yielding).await {
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
        self.run_holding((), None, self.0.abort.child_token(), job).await
    }

    /// Waits for a thread.
    async fn thread(&self) -> Result<OwnedSemaphorePermit, PoolError> {
        if !self.0.abort.is_cancelled()
            && let Ok(thread) = Arc::clone(&self.0.threads).try_acquire_owned()
        {
            return Ok(thread);
        }
        let _counted = Waiting::new(&self.0.n_waiting);
        self.turn(&self.0.threads).await
    }

    /// Waits for one of `threads`.
    async fn turn(&self, threads: &Arc<Semaphore>) -> Result<OwnedSemaphorePermit, PoolError> {
        tokio::select! {
            biased;
            () = self.0.abort.cancelled() => Err(PoolError::Stopped),
            thread = Arc::clone(threads).acquire_owned() => thread.map_err(|_| PoolError::Stopped),
        }
    }

    /// Runs `job`, and keeps `held` until it has really ended, even if nobody waits for it any more.
    async fn run_holding<T, F>(
        &self,
        held: impl Send + 'static,
        deadline: Option<Instant>,
        cancel: CancellationToken,
        job: F,
    ) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        // Dropped with this future: whoever waited is gone.
        let _gone: DropGuard = cancel.clone().drop_guard();
        let span = tracing::Span::current();
        let running = self.0.tasks.spawn_blocking(move || {
            let _held = held;
            let mut interrupt = Watch { cancel, deadline };
            span.in_scope(|| job(&mut interrupt))
        });
        match running.await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(Cancelled)) => Err(PoolError::Stopped),
            Err(_) => Err(PoolError::Panicked),
        }
    }
}

/// A place in the pool. Given back when this and its clones are dropped and the last job that ran by it has ended.
#[derive(Clone, Debug)]
pub struct Admission {
    pool: SearchPool,
    admitted: Arc<OwnedSemaphorePermit>,
    /// Until when jobs wait for a thread.
    patience: Option<Instant>,
}

impl Admission {
    /// The same place, whose jobs wait for a thread of the pool until `patience` at most, and then run beside it.
    #[must_use]
    pub fn with_patience(self, patience: Option<Instant>) -> Self {
        Self { patience, ..self }
    }

    /// Waits for a thread; nothing if the patience ends first.
    async fn turn(&self) -> Result<Option<OwnedSemaphorePermit>, PoolError> {
        let turn = self.pool.thread();
        match self.patience {
            None => turn.await.map(Some),
            Some(patience) => tokio::time::timeout_at(patience.into(), turn).await.ok().transpose(),
        }
    }

    /// Runs `job`, which ends by itself in a fraction of a second, off the async threads: it does not wait for searches.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the service ends before it has begun.
    pub async fn run_reading<T, F>(&self, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce() -> T + Send + 'static,
    {
        let cancel = self.pool.0.abort.child_token();
        let reader = self.pool.turn(&self.pool.0.readers).await?;
        self.pool.run_holding((Arc::clone(&self.admitted), reader), None, cancel, |_| Ok(job())).await
    }

    /// Runs `job` on a thread of the pool. It is told to finish when `deadline` has passed, and to stop when the returned
    /// future is dropped or the service ends.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the job was told to stop.
    pub async fn run<T, F>(&self, deadline: Option<Instant>, job: F) -> Result<T, PoolError>
    where
        T: Send + 'static,
        F: FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    {
        let cancel = self.pool.0.abort.child_token();
        let thread = self.turn().await?;
        self.pool.run_holding((Arc::clone(&self.admitted), thread), deadline, cancel, job).await
    }

    /// Runs `job`, which takes no longer than a millisecond or so, in place of a thread of the pool: on the one that polls the
    /// returned future. It is told to finish when `deadline` has passed.
    ///
    /// # Errors
    ///
    /// [`PoolError::Stopped`] if the service ends before it has begun.
    pub async fn run_here<T>(
        &self,
        deadline: Option<Instant>,
        job: impl FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled>,
    ) -> Result<T, PoolError> {
        let _thread = self.turn().await?;
        let mut interrupt = Watch { cancel: &self.pool.0.abort, deadline };
        job(&mut interrupt).map_err(|Cancelled| PoolError::Stopped)
    }
}

/// Counts a job that waits, until it is dropped.
struct Waiting(Arc<AtomicUsize>);

impl Waiting {
    fn new(n_waiting: &Arc<AtomicUsize>) -> Self {
        n_waiting.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(n_waiting))
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Looks at the token and the clock when asked.
struct Watch<C> {
    cancel: C,
    deadline: Option<Instant>,
}

impl<C: Borrow<CancellationToken>> Interrupt for Watch<C> {
    fn poll(&mut self) -> Signal {
        if self.cancel.borrow().is_cancelled() {
            return Signal::Cancel;
        }
        match self.deadline {
            Some(deadline) if Instant::now() >= deadline => Signal::Finish,
            _ => Signal::Continue,
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::task::JoinHandle;

    use super::*;

    fn pool(n_threads: usize, max_waiting: usize) -> (SearchPool, CancellationToken) {
        let abort = CancellationToken::new();
        (SearchPool::new(PoolSettings { n_threads, max_waiting }, TaskTracker::new(), abort.clone()), abort)
    }

    fn until_cancelled(interrupt: &mut dyn Interrupt) -> Result<(), Cancelled> {
        loop {
            match interrupt.poll() {
                Signal::Cancel => return Err(Cancelled),
                Signal::Finish => return Ok(()),
                Signal::Continue => std::thread::yield_now(),
            }
        }
    }

    /// A job that is in the pool until it is cancelled.
    async fn busy(pool: &SearchPool) -> JoinHandle<Result<(), PoolError>> {
        let n_before = pool.n_jobs();
        let job = tokio::spawn({
            let pool = pool.clone();
            async move { pool.admit()?.run(None, until_cancelled).await }
        });
        while pool.n_jobs() == n_before {
            tokio::task::yield_now().await;
        }
        job
    }

    #[tokio::test]
    async fn a_dropped_waiter_cancels_its_job_and_frees_the_thread() {
        let (pool, _abort) = pool(1, 0);
        let waiting = busy(&pool).await;
        waiting.abort();
        while pool.n_jobs() > 0 {
            tokio::task::yield_now().await;
        }
        assert_eq!(pool.admit().unwrap().run(None, |_| Ok(7)).await, Ok(7));
    }

    #[tokio::test]
    async fn a_full_queue_refuses_at_once_and_a_shutdown_stops_what_runs() {
        let (pool, abort) = pool(1, 1);
        let (running, waiting) = (busy(&pool).await, busy(&pool).await);
        assert_eq!(pool.admit().map(drop), Err(PoolError::Busy));
        abort.cancel();
        assert_eq!(running.await.unwrap(), Err(PoolError::Stopped));
        assert_eq!(waiting.await.unwrap(), Err(PoolError::Stopped));
    }

    #[tokio::test]
    async fn a_job_that_runs_where_it_is_waits_its_turn() {
        let (pool, abort) = pool(1, 1);
        let running = busy(&pool).await;
        let place = pool.admit().unwrap();
        assert_eq!(pool.admit().map(drop), Err(PoolError::Busy), "it is counted");
        let mut waiting = Box::pin(place.run_here(None, |_| Ok(7)));
        assert!(futures_util::poll!(&mut waiting).is_pending());
        running.abort();
        assert_eq!(waiting.await, Ok(7));
        assert_eq!(place.run_here(Some(Instant::now()), until_cancelled).await, Ok(()));
        abort.cancel();
        assert_eq!(place.run_here(None, |_| Ok(7)).await, Err(PoolError::Stopped));
    }

    #[tokio::test]
    async fn a_job_whose_patience_ends_and_one_that_reads_do_not_wait_for_searches() {
        let (pool, _abort) = pool(1, 1);
        let running = busy(&pool).await;
        let place = pool.admit().unwrap();
        assert_eq!(place.run_reading(|| 7).await, Ok(7));
        let now = Instant::now();
        let impatient = place.clone().with_patience(Some(now));
        assert_eq!(impatient.run(Some(now), until_cancelled).await, Ok(()));
        assert_eq!(impatient.run_here(Some(now), until_cancelled).await, Ok(()));
        assert_eq!(pool.n_jobs(), 2, "the first one still runs");
        let mut waiting = Box::pin(place.run(Some(now), until_cancelled));
        assert!(futures_util::poll!(&mut waiting).is_pending(), "its patience was not limited");
        running.abort();
        assert_eq!(waiting.await, Ok(()));
    }

    #[tokio::test]
    async fn what_nobody_waits_for_makes_way_for_whoever_does() {
        let (pool, abort) = pool(1, 1);
        let spare = Box::pin(pool.run_to_spare(until_cancelled));
        let mut spare = std::pin::pin!(spare);
        assert!(futures_util::poll!(&mut spare).is_pending());
        assert_eq!(pool.run_to_spare(|_| Ok(())).await, Err(PoolError::Busy), "there is one thread");
        assert_eq!(pool.admit().unwrap().run(None, |_| Ok(7)).await, Ok(7));
        assert_eq!(spare.await, Err(PoolError::Busy));
        assert_eq!(pool.run_to_spare(|_| Ok(7)).await, Ok(7));
        abort.cancel();
        assert_eq!(pool.run_to_spare(until_cancelled).await, Err(PoolError::Stopped));
    }

    #[tokio::test]
    async fn what_nobody_waits_for_leaves_a_thread_free() {
        let (pool, _abort) = pool(2, 0);
        let mut running = Box::pin(pool.run_patiently(until_cancelled));
        assert!(futures_util::poll!(&mut running).is_pending());
        assert_eq!(pool.run_to_spare(|_| Ok(())).await, Err(PoolError::Busy));
        drop(running);
        // Its thread is free once it has seen that.
        while pool.0.threads.available_permits() < 2 {
            tokio::task::yield_now().await;
        }
        let mut spare = Box::pin(pool.run_to_spare(until_cancelled));
        assert!(futures_util::poll!(&mut spare).is_pending());
        let mut running = Box::pin(pool.run_patiently(until_cancelled));
        assert!(futures_util::poll!(&mut running).is_pending());
        assert_eq!(spare.await, Err(PoolError::Busy), "it had the last one for a while");
    }

    #[tokio::test]
    async fn a_passed_deadline_asks_the_job_to_finish() {
        let (pool, _abort) = pool(1, 0);
        assert_eq!(pool.admit().unwrap().run(Some(Instant::now()), until_cancelled).await, Ok(()));
    }
}
