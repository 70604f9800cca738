//! The one writer, which groups commits.
//!
//! A commit costs a sync of the disk, whatever it holds. So the writer takes everything that waits, up to a limit, applies it in one
//! transaction, and answers all of it after the commit. After a group of several it yields once, so that ready tasks can enqueue: groups
//! grow with the load, and no timer is needed. Small and large requests wait in lines of their own. A group takes all small requests, but
//! only about a MiB of large ones, so that small requests never wait long behind large ones. Observations, which are most requests, are
//! written to `arrivals` with a commit, and moved to their table later. A group of observations alone, of policies alone, or of sessions
//! alone that are opened, takes a single statement, and one of rewards alone two, outside of a transaction. Sessions that end, with their last
//! observations, take a transaction of two executions (`store::statements`), any other group one of a few more: each costs the driver a change
//! of threads.
//!
//! After an error the state of the connection is unknown: a transaction may still be open. So the connection is closed, and the next
//! group opens another. A write is acknowledged only if the file that was written to still has the database's name.

mod generations;
mod group;
mod lines;
#[cfg(test)]
mod tests;
mod verb;

use std::sync::Arc;
use std::time::Duration;

use sqlx::{Connection, SqliteConnection};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::arrivals::Arrivals;
use super::database::{Database, Readers};
use super::observations::NewObservations;
use super::observations::SessionRefusal;
use super::policies::AddPolicies;
use super::statements::Statements;
use super::trials::{NewReward, NewTrial, Opened, RewardAnswer};
use super::{NewSession, SessionEnd, StoreError, Unavailable, count, database};
use generations::Generations;
pub(super) use lines::MAX_LARGE_BYTES;
use lines::{Lines, MAX_SMALL_BYTES};
use verb::{Asked, Job};
pub(super) use verb::{Verb, Writing};

/// Most small requests in a transaction. Beyond this a group gains nothing, and its waiters wait longer.
const MAX_GROUP: usize = 256;

/// How long those who ask wait to get in line.
const LINE_TIMEOUT: Duration = Duration::from_secs(5);

/// What is written to the log between two checkpoints, roughly: as much as SQLite itself lets be written.
const CHECKPOINT_BYTES: usize = 4 << 20;

/// Most that the writer copies itself of what was logged during a checkpoint, roughly; more is left to the next checkpoint.
const REST_BYTES: usize = 1 << 20;

/// What a commit writes whatever it holds, roughly: four pages.
const COMMIT_BYTES: usize = 16 << 10;

/// A handle to the writer.
#[derive(Clone, Debug)]
pub(super) struct Writer {
    small: mpsc::Sender<Job>,
    large: mpsc::Sender<Job>,
    closing: CancellationToken,
    generations: Generations,
}

impl Writer {
    /// Starts the writer in `tasks`, with its connection if there is one yet. It ends once it was closed or dropped, and all that waited has
    /// been written.
    pub(super) fn start(
        database: Database,
        connection: Option<SqliteConnection>,
        readers: Arc<Readers>,
        tasks: &TaskTracker,
    ) -> Self {
        let (writer, lines) = Self::with_lines();
        let open = Open {
            database,
            connection,
            readers,
            tasks: tasks.clone(),
            n_logged_bytes: 0,
            checkpoint: None,
            arrivals: Arrivals::default(),
            was_interrupted: true,
            trouble: None,
            generations: writer.generations.clone(),
        };
        tasks.spawn(open.run(lines));
        writer
    }

    /// A handle without a writer.
    pub(super) fn none() -> Self {
        let (writer, _) = Self::with_lines();
        writer.close();
        writer
    }

    /// The handle to a writer that takes from these lines.
    fn with_lines() -> (Self, Lines) {
        let closing = CancellationToken::new();
        let (lines, [small, large]) = Lines::new(closing.clone());
        (Self { small, large, closing, generations: Generations::default() }, lines)
    }

    /// A number that changes whenever the model called `name` is registered, changed or deleted, before that is answered; `None` if it is not known
    /// now.
    pub(super) fn generation(&self, name: &str) -> Option<u64> {
        self.generations.of(name)
    }

    /// Takes no more requests, and ends once everything waiting has been written.
    pub(super) fn close(&self) {
        self.closing.cancel();
    }

    /// Completes when no more requests are taken.
    pub(super) async fn closed(&self) {
        self.closing.cancelled().await;
    }

    /// Applies `verb`, and returns once that is on disk. Dropping the future does not undo it, here and in the methods that follow.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing of `verb` was done.
    pub(super) async fn write<V: Verb>(&self, verb: V) -> Result<V::Answer, StoreError> {
        let (asked, answered) = Asked::new(verb);
        self.send(Job::Other(Box::new(asked)), answered).await
    }

    /// Appends observations to an open session.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn append(&self, new: NewObservations) -> Result<Result<(), SessionRefusal>, StoreError> {
        let (asked, answered) = Asked::new(new);
        self.send(Job::Observations(asked), answered).await
    }

    /// Adds policies.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn add_policies(&self, added: AddPolicies) -> Result<(), StoreError> {
        let (asked, answered) = Asked::new(added);
        self.send(Job::Policies(asked), answered).await
    }

    /// Stores a trial and its policy.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn open_trial(&self, trial: NewTrial) -> Result<Opened, StoreError> {
        let (asked, answered) = Asked::new(Box::new(trial));
        self.send(Job::Trial(asked), answered).await
    }

    /// Opens a session, and its trial if it explores.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn open_session(&self, session: NewSession) -> Result<Opened, StoreError> {
        let (asked, answered) = Asked::new(Box::new(session));
        self.send(Job::Session(asked), answered).await
    }

    /// Ends an open session.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing was done.
    pub(super) async fn end_session(&self, end: SessionEnd) -> Result<Result<(), SessionRefusal>, StoreError> {
        let (asked, answered) = Asked::new(Box::new(end));
        self.send(Job::End(asked), answered).await
    }

    /// Accepts a reward, unless its trial has one.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn accept_reward(&self, reward: NewReward) -> Result<RewardAnswer, StoreError> {
        let (asked, answered) = Asked::new(reward);
        self.send(Job::Reward(asked), answered).await
    }

    async fn send<A>(&self, job: Job, answered: oneshot::Receiver<Result<A, StoreError>>) -> Result<A, StoreError> {
        let line = if job.n_bytes() > MAX_SMALL_BYTES { &self.large } else { &self.small };
        match line.try_send(job) {
            Ok(()) => {}
            Err(TrySendError::Closed(_)) => return Err(StoreError::Closed),
            Err(TrySendError::Full(job)) => match tokio::time::timeout(LINE_TIMEOUT, line.send(job)).await {
                Ok(sent) => sent.map_err(|_| StoreError::Closed)?,
                Err(_) => return Err(Unavailable::Slow.into()),
            },
        }
        // The writer answers everything that it takes, unless it ends before.
        answered.await.map_err(|_| StoreError::Closed)?
    }
}

/// The writer at work.
struct Open {
    database: Database,
    /// `None` after an error, until something is to be written.
    connection: Option<SqliteConnection>,
    readers: Arc<Readers>,
    tasks: TaskTracker,
    /// Roughly, since the last checkpoint was begun.
    n_logged_bytes: usize,
    /// The last checkpoint.
    checkpoint: Option<JoinHandle<()>>,
    /// Known without looking, as long as what it writes succeeds.
    arrivals: Arrivals,
    /// Whether no sign of life was written since the start, or since the database was unavailable.
    was_interrupted: bool,
    /// Why nothing could be written the last time, if that was so.
    trouble: Option<Unavailable>,
    generations: Generations,
}

impl Open {
    async fn run(mut self, mut lines: Lines) {
        let mut group = Vec::with_capacity(MAX_GROUP);
        let mut n_told = 0;
        loop {
            if n_told > 1 {
                // It yields once, so that those who were told can enqueue. One alone would come alone again, and to yield for it wakes threads
                // that find nothing to do.
                tokio::task::yield_now().await;
            }
            if !lines.take(&mut group).await {
                break;
            }
            n_told = group.len();
            match self.commit(&mut group).await {
                Ok(()) => group.drain(..).for_each(|job| job.tell(Ok(()))),
                Err(StoreError::Unavailable(unavailable)) => {
                    // Each of them alone would fail in the same way.
                    group.drain(..).for_each(|job| job.tell(Err(unavailable.into())));
                    // Requests that came meanwhile have waited as long for the lock.
                    if unavailable == Unavailable::Locked {
                        lines.drain().for_each(|job| job.tell(Err(unavailable.into())));
                    }
                }
                Err(_) if group.len() > 1 => {
                    // One request must not spoil the others: each gets a transaction and an error of its own.
                    for mut job in group.drain(..) {
                        let committed = self.commit(std::slice::from_mut(&mut job)).await;
                        job.tell(committed);
                    }
                }
                Err(error) => {
                    if let Some(job) = group.pop() {
                        job.tell(Err(error));
                    }
                }
            }
            self.finish_checkpoint().await;
        }
        self.close().await;
    }

    /// Applies `group`. After an error, the connection is closed, and what was known of the database is forgotten.
    async fn commit(&mut self, group: &mut [Job]) -> Result<(), StoreError> {
        if let Err(error) = self.try_commit(group).await {
            return Err(self.failed(error).await);
        }
        self.n_logged_bytes += COMMIT_BYTES + group.iter().map(Job::n_bytes).sum::<usize>();
        if self.n_logged_bytes >= CHECKPOINT_BYTES {
            self.checkpoint();
        }
        if self.trouble.take().is_some() {
            tracing::info!("the database takes writes again");
        }
        Ok(())
    }

    async fn try_commit(&mut self, group: &mut [Job]) -> Result<(), StoreError> {
        let connection = match &mut self.connection {
            Some(connection) => connection,
            none => none.insert(self.database.connect().await?),
        };
        if !self.generations.are_known() {
            self.generations.begin(models_generation(connection).await?);
        }
        let effects = group::write(connection, &mut self.arrivals, group, self.was_interrupted).await?;
        self.database.check_written()?;
        self.was_interrupted &= !effects.has_noted_life;
        for (name, generation) in effects.changed_models {
            self.generations.note(name, generation);
        }
        Ok(())
    }

    /// Copies the little that was logged during the last checkpoint, so that the log begins anew. Every commit to a log that grows must make
    /// its new size durable too, which takes twice the time.
    async fn finish_checkpoint(&mut self) {
        if self.checkpoint.as_ref().is_none_or(|checkpoint| !checkpoint.is_finished()) {
            return;
        }
        self.checkpoint = None;
        if self.n_logged_bytes < REST_BYTES
            && let Some(connection) = &mut self.connection
            && let Err(error) = database::checkpoint(connection).await
        {
            tracing::debug!(error = &error as &dyn std::error::Error, "the log was not copied to its end");
        }
    }

    /// Has the log copied to the database's file, beside the writing.
    fn checkpoint(&mut self) {
        if self.checkpoint.is_none() {
            self.n_logged_bytes = 0;
            let readers = Arc::clone(&self.readers);
            self.checkpoint = Some(self.tasks.spawn(async move {
                if let Err(error) = readers.checkpoint().await {
                    // If the log becomes long, a commit copies it; if nothing can be written, the next writes fail.
                    tracing::debug!(error = &error as &dyn std::error::Error, "the log was not copied");
                }
            }));
        }
    }

    async fn failed(&mut self, error: StoreError) -> StoreError {
        self.arrivals.forget();
        self.generations.forget();
        if let Some(connection) = self.connection.take() {
            self.database.disconnect(connection).await;
        }
        let error = self.database.diagnose(error).await;
        if let StoreError::Unavailable(unavailable) = error {
            self.was_interrupted = true;
            if self.trouble.replace(unavailable) != Some(unavailable) {
                tracing::error!(error = &unavailable as &dyn std::error::Error, "nothing can be written for now");
            }
        }
        error
    }

    async fn close(mut self) {
        let Some(mut connection) = self.connection.take() else { return };
        if !self.arrivals.is_empty()
            && let Err(error) = settle(&mut connection, &mut self.arrivals).await
        {
            // Observations are durable in `arrivals` too.
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "observations were left for the next start to settle"
            );
        }
        // Checkpoints the log, so that what is left behind is a single file.
        if let Err(error) = connection.close().await {
            tracing::warn!(error = &error as &dyn std::error::Error, "the database was not closed cleanly");
        }
    }
}

/// Brings what has arrived to its table.
async fn settle(connection: &mut SqliteConnection, arrivals: &mut Arrivals) -> Result<(), StoreError> {
    let statements = &mut Statements::on(connection);
    statements.add("BEGIN IMMEDIATE");
    arrivals.check(statements).await?;
    arrivals.settle(statements).await?;
    statements.add("COMMIT");
    statements.run().await.map(drop)
}

/// Changes with every registration and deletion of a model.
async fn models_generation(connection: &mut SqliteConnection) -> Result<u64, StoreError> {
    let row = sqlx::query("SELECT models_generation FROM service").fetch_one(connection).await?;
    count(&row, "service", "models_generation")
}
