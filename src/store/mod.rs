//! All SQL: what is durable, in SQLite.
//!
//! ```text
//! service --verbs--> two lines --> writer (one task, one connection): groups what is small and waits, and some of what is large
//!    |                                BEGIN IMMEDIATE .. COMMIT (WAL, synchronous = FULL), then answers every waiter
//!    |                                statements: executed together, but for what is asked in between
//!    |                                observations: one row a group in `arrivals`, settled in their table later
//!    +------ reads ----------------> pool of readers (query_only), one of which copies the log to the database now and then
//! ```
//!
//! A write that was answered is on disk, in the file that has the database's name. While nothing can be written, reading goes on. Rows
//! become domain types here and nowhere else. Times are milliseconds since 1970; documents are JSON text, long ones in compressed pieces.
//! Members of a policy that follow from others are not stored, and computed when it is read.

mod alive;
mod arrivals;
mod batches;
mod database;
mod definitions;
mod deletions;
mod error;
mod learners;
mod models;
mod observations;
mod page;
mod policies;
mod refinements;
mod request_keys;
mod schema;
mod sessions;
mod statements;
mod tallies;
mod trials;
mod writer;

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::{Duration, Instant};

use crate::clock::Clock;
use alive::{Down, NoteAlive};
pub use batches::{AcceptedBatch, NewBatch, Revision, StoredBatch, pack_batch};
use database::{Database, Locking, Reader, Readers};
use definitions::Sweeper;
pub use definitions::{NewPieces, PIECE_BYTES};
pub use deletions::Needed;
pub use error::{StoreError, Unavailable};
use jiff::Timestamp;
pub use learners::{Fold, LearnerRecord, NewLearner, RewardRecord, WeightsRecord};
pub use models::{
    ModelHead, ModelKey, ModelRecord, ModelRegistration, ModelSize, ModelSummary, NewDefinition, NewModel, Replaces,
    StoredDefinition,
};
pub use observations::{NewObservations, NewSteps, Owner, ServiceTime, SessionRefusal};
pub use page::Page;
pub use policies::{Links, NewPolicy, NewRefinement, PolicyClass, PolicyFilter, PolicyRecord, pack_steps};
pub use refinements::{Attempt, MAX_ATTEMPTS, RefinementEnd};
pub use request_keys::{AnsweredRequest, KeyTaken, NewRequestKey, RequestKey};
pub use sessions::{
    ExpiredSession, MAX_EXPIRED_AT_ONCE, NewSession, SessionEnd, SessionFilter, SessionRecord, SessionStatus,
    StoredObservations, StoredSteps, Taken,
};

pub use tallies::StoredTally;
use tokio_util::task::TaskTracker;
use trials::TrialNumbers;
pub use trials::{
    AcceptedReward, Failure, FailureAnswer, NewReward, NewTrial, NextNumber, Opened, RewardAnswer, TrialRecord,
    TrialStatus,
};
use writer::Writer;

/// The durable state of the service.
#[derive(Debug)]
pub struct Store {
    readers: Arc<Readers>,
    writer: Writer,
    sweeper: Sweeper,
    trial_numbers: TrialNumbers,
    /// For how long the service was not alive, as was noted last.
    down_ms: AtomicI64,
    tasks: TaskTracker,
    /// What the last check found, and when.
    checked: tokio::sync::Mutex<Option<(Instant, Result<(), Unavailable>)>>,
}

impl Store {
    /// Opens the database at `path`, creating and migrating it as needed, whoever else works with it. The writer runs in `tasks` until
    /// the store is closed. Where nothing can be written now, it can be read, and writes fail until they can be done.
    ///
    /// # Errors
    ///
    /// If it cannot be opened or migrated, is another program's or damaged, or SQLite is too old.
    pub async fn open(path: &Path, tasks: &TaskTracker) -> Result<Self, StoreError> {
        Self::open_locking(path, Locking::None, tasks).await
    }

    /// As [`Self::open`], for as long as no other process does the same. The lock ends with the writer.
    ///
    /// # Errors
    ///
    /// Likewise, and [`StoreError::InUse`] if another process has it.
    pub async fn open_alone(path: &Path, tasks: &TaskTracker) -> Result<Self, StoreError> {
        Self::open_locking(path, Locking::Exclusive, tasks).await
    }

    async fn open_locking(path: &Path, locking: Locking, tasks: &TaskTracker) -> Result<Self, StoreError> {
        let mut database = Database::new(path, locking)?;
        let connection = match database.connect().await {
            Ok(connection) => Some(connection),
            Err(error @ StoreError::Unavailable(unavailable)) => {
                if database.is_empty() {
                    return Err(StoreError::Create { path: path.to_owned(), source: io::Error::other(unavailable) });
                }
                // If it cannot be read either, the first error says more.
                if database.read_only(Depth::Whole).await.is_err() {
                    return Err(error);
                }
                tracing::error!(
                    error = &error as &dyn std::error::Error,
                    "nothing can be written; the database is only read"
                );
                None
            }
            Err(error) => return Err(error),
        };
        let readers = database.readers()?;
        let writer = Writer::start(database, connection, Arc::clone(&readers), tasks);
        Ok(Self::of(readers, writer, tasks))
    }

    /// Opens the database at `path` to read it, whoever works with it. It is left as it is.
    ///
    /// # Errors
    ///
    /// If it cannot be opened, is another program's, or has another schema than this version's.
    pub async fn open_to_read(path: &Path, tasks: &TaskTracker) -> Result<Self, StoreError> {
        let mut database = Database::new(path, Locking::None)?;
        database.read_only(Depth::Schema).await?;
        Ok(Self::of(database.readers()?, Writer::none(), tasks))
    }

    fn of(readers: Arc<Readers>, writer: Writer, tasks: &TaskTracker) -> Self {
        let sweeper = Sweeper::start(writer.clone(), tasks);
        Self {
            readers,
            writer,
            sweeper,
            trial_numbers: TrialNumbers::default(),
            down_ms: AtomicI64::new(0),
            tasks: tasks.clone(),
            checked: tokio::sync::Mutex::default(),
        }
    }

    /// Takes no more reads or writes. Once the writer has ended, all that was written stands in a single file.
    pub async fn close(&self) {
        // The last connection that is closed copies the log to the database, so the writer's must be the last.
        self.readers.close().await;
        self.writer.close();
    }

    /// A connection that reads.
    async fn reader(&self) -> Result<Reader, StoreError> {
        self.readers.one().await
    }

    /// A number that changes whenever the model called `name` is registered, changed or deleted, before that is answered; `None` if it is not known
    /// now.
    pub(crate) fn model_generation(&self, name: &str) -> Option<u64> {
        self.writer.generation(name)
    }

    /// Notes that the service is alive at `now`, as is done at least `every` so often. Time without service before does not count for
    /// open sessions.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub async fn note_alive(&self, now: Timestamp, every: Duration) -> Result<(), StoreError> {
        self.note_down(self.writer.write(NoteAlive { now, every }).await?);
        Ok(())
    }

    fn note_down(&self, Down(ms): Down) {
        self.down_ms.store(ms, Ordering::Relaxed);
    }

    /// The service's own time at `now`: time in which it was not alive is left out, as far as that was [noted](Self::note_alive).
    #[must_use]
    pub fn service_time(&self, now: Timestamp) -> ServiceTime {
        ServiceTime(now.as_millisecond() - self.down_ms.load(Ordering::Relaxed))
    }

    /// Whether something can be written by `clock`, as [`Self::note_alive`] is; tried at most once a second, and known within two.
    ///
    /// # Errors
    ///
    /// If not.
    pub async fn check(&self, clock: &Clock, every: Duration) -> Result<(), StoreError> {
        // Callers that come meanwhile wait here, and are told the same.
        let mut checked = self.checked.lock().await;
        if let Some((at, known)) = *checked
            && clock.elapsed(at) < CHECK_EVERY
        {
            return Ok(known?);
        }
        let noted = tokio::time::timeout(CHECK_TIMEOUT, self.note_alive(clock.now(), every)).await;
        let found = match noted.unwrap_or(Err(Unavailable::Slow.into())) {
            Ok(()) => Ok(()),
            Err(StoreError::Unavailable(unavailable)) => Err(unavailable),
            Err(error) => return Err(error),
        };
        *checked = Some((clock.instant(), found));
        Ok(found?)
    }
}

/// What became of a registration.
#[derive(Clone, Debug, PartialEq)]
pub enum Registration<T> {
    /// It is new.
    Created(T),
    /// The same content was there already, under the same name.
    Unchanged(T),
    /// Other content is there under this name; it was left alone.
    Conflict {
        /// The hash of what is there.
        existing_hash: String,
    },
}

/// What became of a deletion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deletion {
    /// It is gone.
    Deleted,
    /// There was nothing of this name.
    Unknown,
}

/// How often it is tried whether something can be written. Each time costs a sync of the disk.
const CHECK_EVERY: Duration = Duration::from_secs(1);

/// How long that may take: those who ask wait no longer than two seconds.
const CHECK_TIMEOUT: Duration = Duration::from_millis(1500);

/// How closely a database is looked at that is only read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Depth {
    /// Whether it is ours, and has this version's schema.
    Schema,
    /// Whether it is whole as well.
    Whole,
}

fn corrupt<E: Into<Box<dyn std::error::Error + Send + Sync>>>(
    table: &'static str,
    column: &'static str,
) -> impl FnOnce(E) -> StoreError {
    move |source| StoreError::Corrupt { table, column, row: None, source: source.into() }
}

/// As SQLite holds it; the counts and times of this program stay far below its limit.
fn as_integer(count: u64) -> i64 {
    i64::try_from(count).unwrap_or(i64::MAX)
}

/// A column that is never negative.
fn count(row: &sqlx::sqlite::SqliteRow, table: &'static str, column: &'static str) -> Result<u64, StoreError> {
    use sqlx::Row;
    u64::try_from(row.try_get::<i64, _>(column)?).map_err(corrupt(table, column))
}

fn timestamp(table: &'static str, column: &'static str, ms: i64) -> Result<jiff::Timestamp, StoreError> {
    jiff::Timestamp::from_millisecond(ms).map_err(corrupt(table, column))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_store_whose_writer_has_ended_is_not_ready() {
        let directory = tempfile::tempdir().unwrap();
        let tasks = TaskTracker::new();
        let store = Store::open(&directory.path().join("etude.db"), &tasks).await.unwrap();
        let clock = Clock::stepped(Timestamp::UNIX_EPOCH);
        let check = || store.check(&clock, Duration::ZERO);
        store.writer.close();
        tasks.close();
        tasks.wait().await;
        assert!(matches!(check().await, Err(StoreError::Closed)), "though it could be read");
    }

    #[tokio::test]
    async fn a_log_that_goes_with_the_last_connection_is_not_taken_for_a_deleted_database() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
        let policy = |id: &str| vec![NewPolicy::plain(id, "{}", Timestamp::UNIX_EPOCH)];
        store.add_policies(policy("a"), Vec::new()).await.unwrap();
        // Nobody has it open any more but the writer, which opens it anew after an error.
        store.readers.close().await;
        assert!(store.add_policies(policy("a"), Vec::new()).await.is_err(), "its id is taken");
        store.add_policies(policy("b"), Vec::new()).await.unwrap();
    }
}
