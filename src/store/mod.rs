//! All SQL: what is durable, in SQLite.
//!
//! ```text
//! service --Write--> queue --> writer (one task, one connection): groups what is waiting into one transaction
//!    |                            BEGIN IMMEDIATE .. COMMIT (WAL, synchronous = FULL), then answers every waiter
//!    |                            observations: one row a group in `arrivals`, settled in their table later
//!    +------ reads ------------> pool of readers (query_only)
//! ```
//!
//! A write that was answered is on disk. Rows become domain types here and nowhere else; times are milliseconds since 1970,
//! documents are JSON text, in compressed pieces where it is long. Of a policy, what could be told from the rest is left out, and
//! put back when it is read.

mod arrivals;
mod definitions;
mod learners;
mod models;
mod policies;
mod refinements;
mod sessions;
mod trials;
mod writer;

use std::path::Path;
use std::time::Duration;

use definitions::Sweeper;
pub use definitions::{NewPieces, PIECE_BYTES};
pub use learners::{LearnerRow, NewLearner, PutLearner, RewardRow, WeightsRow};
pub use models::{ModelKey, ModelRow, ModelSize, ModelSummary, NewDefinition, NewModel, PutModel, StoredDefinition};
pub use policies::{NewPolicy, PolicySummaryRow};
pub use refinements::{NewRefinement, RefinementEnd};
pub use sessions::{NewObservations, NewSession, SessionEnd, SessionRow, SessionStatus, SessionWeights};
use sqlx::migrate::{Migration, MigrationType, Migrator};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, SqlSafeStr, SqliteConnection};
use tokio_util::task::TaskTracker;
pub use trials::{AcceptedReward, FailTrial, Failure, NewReward, NewTrial, PutReward, TrialRow, TrialStatus};
use writer::Writer;

/// Earlier ones can corrupt a database in WAL mode.
const LEAST_SQLITE_VERSION: (u32, u32, u32) = (3, 51, 3);

/// How long a connection waits for another process's lock.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// Readers at the same time. Reads are short, and there are few cores.
const N_READERS: u32 = 4;

/// Statements that a connection keeps prepared: all that there are, those with a number of rows as often as there are numbers.
const N_STATEMENTS: usize = 256;

/// Why the store could not do as told.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The database failed.
    #[error("the database failed")]
    Database(#[source] sqlx::Error),
    /// Another process has held the database for too long; later it may go through.
    #[error("the database is locked by another process")]
    Locked,
    /// The database could not be brought to this version's schema.
    #[error("the database could not be migrated")]
    Migrate(#[from] sqlx::migrate::MigrateError),
    /// The SQLite that this program was linked with is too old.
    #[error("SQLite {found} can corrupt a database in WAL mode; {}.{}.{} is needed", needed.0, needed.1, needed.2)]
    Version {
        /// Its version.
        found: String,
        /// The oldest that will do.
        needed: (u32, u32, u32),
    },
    /// A row holds what this program never writes.
    #[error("table {table} holds an invalid {column}")]
    Corrupt {
        /// Where.
        table: &'static str,
        /// In which column.
        column: &'static str,
        /// What is wrong with it.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// What is read was removed while it was.
    #[error("it was removed while it was read")]
    Removed,
    /// Another process has removed some of what was to be registered; sent once more, it may go through.
    #[error("another service on the same database has removed what was stored so far; send it again")]
    Lost,
    /// The store is shutting down.
    #[error("the store takes no more writes")]
    Closed,
}

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        /// Primary result code of SQLite; extended codes have it in their low byte.
        const SQLITE_BUSY: u32 = 5;
        let code = error.as_database_error().and_then(|error| error.code()?.parse::<u32>().ok());
        if code.is_some_and(|code| code & 0xff == SQLITE_BUSY) { Self::Locked } else { Self::Database(error) }
    }
}

/// The durable state of the service.
#[derive(Debug)]
pub struct Store {
    readers: SqlitePool,
    writer: Writer,
    sweeper: Sweeper,
    tasks: TaskTracker,
}

impl Store {
    /// Opens the database at `path`, creating and migrating it as needed. The writer runs in `tasks` until the store is
    /// closed.
    ///
    /// # Errors
    ///
    /// If it cannot be opened or migrated, or SQLite is too old.
    pub async fn open(path: &Path, tasks: &TaskTracker) -> Result<Self, StoreError> {
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(BUSY_TIMEOUT)
            .statement_cache_capacity(N_STATEMENTS)
            .disable_statement_logging();
        let mut connection = SqliteConnection::connect_with(&options).await?;
        check_version(&mut connection).await?;
        migrator().run_direct(None, &mut connection, false).await?;
        // A database that cannot be written to should be told of now, not with the first request.
        connection.begin_with("BEGIN IMMEDIATE").await?.rollback().await?;
        let readers = SqlitePoolOptions::new()
            .max_connections(N_READERS)
            .connect_with(options.create_if_missing(false).pragma("query_only", "ON"))
            .await?;
        let writer = Writer::start(connection, tasks);
        let sweeper = Sweeper::start(writer.clone(), tasks);
        Ok(Self { readers, writer, sweeper, tasks: tasks.clone() })
    }

    /// Takes no more reads or writes. Once the writer has ended, all that was written stands in a single file.
    pub async fn close(&self) {
        // The last connection to be closed folds in the log; that must be the writer's.
        self.readers.close().await;
        self.writer.close();
    }

    /// Counts up whenever a model was registered or deleted, before whoever did so is told.
    pub(crate) fn models_generation(&self) -> u64 {
        self.writer.models_generation()
    }

    /// Whether the database answers, and writes are taken.
    ///
    /// # Errors
    ///
    /// If not.
    pub async fn check(&self) -> Result<(), StoreError> {
        if !self.writer.is_running() {
            return Err(StoreError::Closed);
        }
        sqlx::query("SELECT count(*) FROM (SELECT 1 FROM models LIMIT 1)").execute(&self.readers).await?;
        Ok(())
    }
}

/// Every migration, in order. They are part of the program, so that it runs wherever it is copied to.
fn migrator() -> Migrator {
    let migration = |version, description: &'static str, sql: &'static str| {
        Migration::new(version, description.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator {
        migrations: vec![
            migration(1, "models and policies", include_str!("../../migrations/0001_models_and_policies.sql")),
            migration(2, "sessions", include_str!("../../migrations/0002_sessions.sql")),
            migration(3, "learners and trials", include_str!("../../migrations/0003_learners_and_trials.sql")),
            migration(4, "large definitions", include_str!("../../migrations/0004_large_definitions.sql")),
            migration(5, "arrivals", include_str!("../../migrations/0005_arrivals.sql")),
            migration(6, "short policies", include_str!("../../migrations/0006_short_policies.sql")),
        ]
        .into(),
        ..Migrator::DEFAULT
    }
}

async fn check_version(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    let found: String = sqlx::query_scalar("SELECT sqlite_version()").fetch_one(connection).await?;
    let mut parts = found.split('.').map(|part| part.parse::<u32>().unwrap_or(0));
    let mut next = || parts.next().unwrap_or(0);
    let version = (next(), next(), next());
    if version < LEAST_SQLITE_VERSION {
        return Err(StoreError::Version { found, needed: LEAST_SQLITE_VERSION });
    }
    Ok(())
}

/// A part of a long list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Page<T> {
    /// The items, in order.
    pub items: Vec<T>,
    /// The key of the last item, if there are more.
    pub next: Option<String>,
}

impl<T> Page<T> {
    /// Makes a page of at most `limit` of `rows`, of which the query asked for one more than that.
    fn of(mut rows: Vec<T>, limit: u32, key: impl Fn(&T) -> String) -> Self {
        let limit = limit as usize;
        let has_more = rows.len() > limit;
        rows.truncate(limit);
        let next = if has_more { rows.last().map(key) } else { None };
        Self { items: rows, next }
    }
}

fn corrupt<E: Into<Box<dyn std::error::Error + Send + Sync>>>(
    table: &'static str,
    column: &'static str,
) -> impl FnOnce(E) -> StoreError {
    move |source| StoreError::Corrupt { table, column, source: source.into() }
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
        store.check().await.unwrap();
        store.writer.close();
        tasks.close();
        tasks.wait().await;
        assert!(matches!(store.check().await, Err(StoreError::Closed)), "though it could be read");
    }
}
