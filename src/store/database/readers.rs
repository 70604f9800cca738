//! Connections that read, and what all connections have in common.

use std::ops::{Deref, DerefMut};
use std::path::Path;
use std::time::Duration;

use sqlx::pool::PoolConnection;
use sqlx::sqlite::{SqliteConnectOptions, SqlitePool, SqlitePoolOptions};
use sqlx::{ConnectOptions, Connection, Sqlite, SqliteConnection};
use tokio::sync::RwLock;

use super::turns::{Turn, Turns};
use crate::client::Client;
use crate::store::{Depth, StoreError, schema};

/// How long a connection waits for another process's lock.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// How long those who read wait for their turn.
const READER_TIMEOUT: Duration = Duration::from_secs(30);

/// Readers at the same time. Reads are short, and there are few cores. One of them copies the log now and then.
pub(in crate::store) const N_READERS: u32 = 5;

/// Statements that a connection keeps prepared: enough for all. A statement for several rows counts once for each number of rows.
const N_STATEMENTS: usize = 256;

/// Copies what is in the log to the file of the database, as far as others let `connection`.
pub(in crate::store) async fn checkpoint(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    sqlx::query("PRAGMA wal_checkpoint(PASSIVE)").execute(connection).await?;
    Ok(())
}

/// The connections that read, for which clients wait in turn.
#[derive(Debug)]
pub(in crate::store) struct Readers {
    /// Locked for writing while another pool takes its place.
    pub(super) pool: RwLock<SqlitePool>,
    turns: Turns,
}

/// One of them, until this is dropped.
#[derive(Debug)]
pub(in crate::store) struct Reader {
    connection: PoolConnection<Sqlite>,
    _turn: Turn,
}

impl Deref for Reader {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        &self.connection
    }
}

impl DerefMut for Reader {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        &mut self.connection
    }
}

impl Readers {
    pub(super) fn new(pool: SqlitePool) -> Self {
        Self { pool: RwLock::new(pool), turns: Turns::new(N_READERS) }
    }

    /// One of them, for whom the task serves that asks. While the pool is replaced, the new one is waited for.
    ///
    /// # Errors
    ///
    /// If none comes free in time, or the pool is closed.
    pub(in crate::store) async fn one(&self) -> Result<Reader, StoreError> {
        let pool = self.pool.read().await;
        let turn = tokio::time::timeout(READER_TIMEOUT, self.turns.take(Client::served()));
        let turn = turn.await.map_err(|_| sqlx::Error::PoolTimedOut)?;
        Ok(Reader { connection: pool.acquire().await?, _turn: turn })
    }

    /// Copies what is in the log to the file of the database, as far as others let it: nobody waits for that.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(in crate::store) async fn checkpoint(&self) -> Result<(), StoreError> {
        checkpoint(&mut *self.one().await?).await
    }

    pub(in crate::store) async fn close(&self) {
        self.pool.read().await.close().await;
    }
}

/// What every connection has.
pub(super) fn options(path: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(path)
        .create_if_missing(false)
        .busy_timeout(BUSY_TIMEOUT)
        .statement_cache_capacity(N_STATEMENTS)
        .disable_statement_logging()
}

/// Opens all readers now, and keeps them: one that is opened later could lack room on the disk, or find another file.
pub(super) async fn readers(options: SqliteConnectOptions) -> Result<SqlitePool, StoreError> {
    let pool = SqlitePoolOptions::new().min_connections(N_READERS).max_connections(N_READERS);
    // The pool has looked at each when it came back, and nothing breaks one within this process.
    let pool = pool.test_before_acquire(false);
    // SQLite opens the log with a connection's first read. Before that, closing another connection may remove it.
    let pool = pool.idle_timeout(None).max_lifetime(None).after_connect(|connection, _| {
        Box::pin(async move { sqlx::query("SELECT 1 FROM sqlite_schema").execute(connection).await.map(drop) })
    });
    Ok(pool.connect_with(options).await?)
}

/// Opens readers of a database that is whole, as far as `depth` asks, and has this version's schema.
pub(super) async fn look_at(options: SqliteConnectOptions, depth: Depth) -> Result<SqlitePool, StoreError> {
    let mut connection = options.connect().await?;
    schema::check_version(&mut connection).await?;
    schema::check_whose(&mut connection).await?;
    schema::check_current(&mut connection).await?;
    if depth == Depth::Whole {
        schema::quick_check(&mut connection).await?;
    }
    connection.close().await?;
    readers(options).await
}
