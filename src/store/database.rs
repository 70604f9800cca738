//! The files of the database, and the ways to them.
//!
//! ```text
//! etude.db       0600, as are the others; its identity (device and inode) is that of the first look at it
//! etude.db-lock  locked by the process that writes, for as long as it lives
//! etude.db-wal, etude.db-shm: SQLite's
//! ```
//!
//! The first way that a writer gets is the one by which the database is looked at: whose it is, whether it is whole, whether it has this
//! version's schema. Where nothing can be written, the database is read all the same if that can be: until a writer gets its way.
//! The file of the database is never opened here but by SQLite, which would lose its locks if another descriptor were closed.

mod files;
mod readers;

use std::fs::{self, File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::sqlite::{SqlitePool, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, SqliteConnection};
use tokio::sync::RwLock;

use super::{Depth, StoreError, Unavailable, schema};
use files::{Identity, MODE, is_read_only, probe_aside, resolve, unavailable};
#[cfg(test)]
pub(super) use readers::N_READERS;
pub(super) use readers::{Readers, checkpoint};
use readers::{look_at, options, readers};

/// Pages of the log, of 4 KiB, over which a commit copies it itself. That is rare: readers do it beside the writer before, but cannot
/// come to its end as long as others write, and only then it begins anew.
const MAX_LOG_PAGES: &str = "16384";

/// Whether others are kept from the database.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Locking {
    /// By a lock on the file beside it.
    Exclusive,
    /// Not, as there are none.
    None,
}

/// The files of the database, as its writer knows them.
#[derive(Debug)]
pub(super) struct Database {
    path: PathBuf,
    locking: Locking,
    /// Held while this lives.
    lock: Option<File>,
    /// `None` until there is a file.
    identity: Option<Identity>,
    /// That of the log, which is there as long as any way to the database is open.
    log_identity: Option<Identity>,
    /// Whether a writer has had its way, and with it the look at the database; since then, there are ways to read that go with it.
    is_looked_at: bool,
    /// Whether there is a log: not where memory cannot be shared between processes.
    has_log: bool,
    /// `None` until there is a way to read.
    readers: Option<Arc<Readers>>,
}

impl Database {
    /// The database at `path`, which is resolved now: whatever becomes of the working directory or of links later.
    ///
    /// # Errors
    ///
    /// If its directory is not there.
    pub(super) fn new(path: &Path, locking: Locking) -> Result<Self, StoreError> {
        let path = resolve(path).map_err(|source| StoreError::Create { path: path.to_owned(), source })?;
        let identity = Identity::of(&path).ok();
        let (lock, log_identity, readers) = (None, None, None);
        Ok(Self { path, locking, lock, identity, log_identity, is_looked_at: false, has_log: false, readers })
    }

    /// The ways to read.
    ///
    /// # Errors
    ///
    /// If there are none.
    pub(super) fn readers(&self) -> Result<Arc<Readers>, StoreError> {
        self.readers.clone().ok_or(StoreError::Closed)
    }

    /// Opens a way to write, and ways to read beside it.
    ///
    /// # Errors
    ///
    /// [`StoreError::Unavailable`] if it may go through later; whatever else speaks against using the database.
    pub(super) async fn connect(&mut self) -> Result<SqliteConnection, StoreError> {
        match self.try_connect().await {
            Err(error) => Err(self.diagnose(error).await),
            connected => connected,
        }
    }

    async fn try_connect(&mut self) -> Result<SqliteConnection, StoreError> {
        self.take_lock()?;
        if self.identity.is_none() {
            self.create()?;
        }
        self.check_files()?;
        let Some(readers) = self.readers.clone().filter(|_| !self.is_looked_at) else {
            let (connection, pool) = self.open().await?;
            if let Some(pool) = pool {
                self.readers = Some(Arc::new(Readers { pool: RwLock::new(pool) }));
            }
            return Ok(connection);
        };
        // The ways to read that there are without a writer keep its own from being opened as they should, and take locks away when they
        // are closed. So that is done first, once it looks as if it were worth it, and undone if it was not.
        let probed = probe_aside(&self.path).await;
        let mut place = readers.pool.write().await;
        if let Err(unavailable) = probed {
            // Where that was tried before, and then there were not even ways to read.
            if place.is_closed() {
                *place = self.look_at(Depth::Schema).await?;
            }
            return Err(unavailable.into());
        }
        place.close().await;
        let opened = self.open().await;
        let (connection, pool) = match opened {
            Ok((connection, Some(pool))) => (Ok(connection), pool),
            Ok((connection, None)) => return Ok(connection),
            Err(error) => (Err(error), self.look_at(Depth::Schema).await?),
        };
        *place = pool;
        connection
    }

    /// Opens a way to write, and for the first of them, ways to read that go with it.
    async fn open(&mut self) -> Result<(SqliteConnection, Option<SqlitePool>), StoreError> {
        let writing = options(&self.path).synchronous(SqliteSynchronous::Full);
        let mut connection = writing.pragma("wal_autocheckpoint", MAX_LOG_PAGES).connect().await?;
        match self.prepare(&mut connection).await {
            Ok(pool) => Ok((connection, pool)),
            Err(error) => {
                let _ = connection.close().await;
                Err(error)
            }
        }
    }

    async fn prepare(&mut self, connection: &mut SqliteConnection) -> Result<Option<SqlitePool>, StoreError> {
        if self.is_looked_at {
            self.check_files()?;
            return Ok(None);
        }
        schema::check_version(connection).await?;
        schema::check_whose(connection).await?;
        schema::quick_check(connection).await?;
        let mode: String = sqlx::query_scalar("PRAGMA journal_mode = WAL").fetch_one(&mut *connection).await?;
        self.has_log = mode == "wal";
        schema::migrate(connection).await?;
        // A file that can only be read has been opened all the same. That it is locked is no reason not to have it open.
        let written =
            sqlx::query("UPDATE service SET last_alive_ms = last_alive_ms WHERE FALSE").execute(&mut *connection);
        match written.await.map_err(StoreError::from) {
            Ok(_) | Err(StoreError::Unavailable(Unavailable::Locked)) => {}
            Err(error) => return Err(error),
        }
        self.keep_from_others();
        let readers = readers(options(&self.path).pragma("query_only", "ON")).await?;
        self.check_written()?;
        self.is_looked_at = true;
        Ok(Some(readers))
    }

    /// Opens ways to read, which leave the database and its directory as they are as far as can be.
    ///
    /// # Errors
    ///
    /// If it cannot be read, or not be understood without being changed.
    pub(super) async fn read_only(&mut self, depth: Depth) -> Result<(), StoreError> {
        let pool = self.look_at(depth).await?;
        self.readers = Some(Arc::new(Readers { pool: RwLock::new(pool) }));
        Ok(())
    }

    async fn look_at(&self, depth: Depth) -> Result<SqlitePool, StoreError> {
        let options = options(&self.path).read_only(true);
        match look_at(options.clone(), depth).await {
            // Without room for the memory that is shared, or leave to make the file for it, only a file that nobody writes to can be
            // read: as it is, without what its log has.
            Err(StoreError::Unavailable(_)) if self.is_log_empty() => look_at(options.immutable(true), depth).await,
            pool => pool,
        }
    }

    /// Makes sure that what was just written is in the database's file and its log, as whoever opens them by their names finds them.
    ///
    /// # Errors
    ///
    /// [`Unavailable::Gone`] if not.
    pub(super) fn check_written(&mut self) -> Result<(), StoreError> {
        if self.has_log && self.log_identity.is_none() {
            // From now on it stays, as readers have it open.
            self.log_identity = Some(Identity::of(&self.beside("-wal")).map_err(|_| Unavailable::Gone)?);
        }
        self.check_files()
    }

    fn check_files(&self) -> Result<(), StoreError> {
        let is_there = |path: &Path, known: Option<Identity>| {
            known.is_none_or(|known| Identity::of(path).is_ok_and(|found| found == known))
        };
        if is_there(&self.path, self.identity)
            && (self.log_identity.is_none() || is_there(&self.beside("-wal"), self.log_identity))
        {
            Ok(())
        } else {
            Err(Unavailable::Gone.into())
        }
    }

    /// Closes a way to write, however that ends: what was not committed is undone by whoever opens the database next.
    pub(super) async fn disconnect(&mut self, connection: SqliteConnection) {
        let was_there = self.check_files().is_ok();
        let _ = connection.close().await;
        // Whoever closes the last way to the database removes its log, of which nothing is left to be done then.
        if was_there && self.is_log_missing() {
            self.log_identity = None;
        }
    }

    /// What is behind an error of SQLite, as far as can be found out.
    pub(super) async fn diagnose(&self, error: StoreError) -> StoreError {
        let StoreError::Unavailable(unavailable) = error else { return error };
        if self.check_files().is_err() {
            return Unavailable::Gone.into();
        }
        if let Unavailable::Failing { .. } = unavailable {
            // A disk that has no room is not always told from one that fails otherwise.
            return probe_aside(&self.path).await.err().unwrap_or(unavailable).into();
        }
        unavailable.into()
    }

    fn take_lock(&mut self) -> Result<(), StoreError> {
        if self.locking == Locking::None || self.lock.is_some() {
            return Ok(());
        }
        let path = self.beside("-lock");
        // Not truncated, as nothing is in it. It stays when the process ends: whoever removed it could remove another's.
        let opened = OpenOptions::new().write(true).create(true).truncate(false).mode(MODE).open(&path);
        let opened = opened.or_else(|error| if is_read_only(&error) { File::open(&path) } else { Err(error) });
        let file = opened.map_err(|source| match unavailable(&source) {
            Some(unavailable) => unavailable.into(),
            None => StoreError::Lock { lock: path.clone(), source },
        })?;
        match file.try_lock() {
            Ok(()) => {
                self.lock = Some(file);
                Ok(())
            }
            Err(fs::TryLockError::WouldBlock) => Err(StoreError::InUse { lock: path }),
            Err(fs::TryLockError::Error(source)) => Err(StoreError::Lock { lock: path, source }),
        }
    }

    /// Keeps others from files that were there before, and that only this process writes to.
    fn keep_from_others(&self) {
        if self.locking == Locking::None {
            return;
        }
        for path in [self.path.clone(), self.beside("-wal"), self.beside("-shm"), self.beside("-lock")] {
            let file = path.display();
            match files::keep_from_others(&path) {
                Ok(true) => {
                    tracing::info!(%file, "others could read or write this file of the database; now only its owner can");
                }
                Ok(false) => {}
                Err(error) => tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    %file,
                    "others can read or write this file of the database, and its mode cannot be changed"
                ),
            }
        }
    }

    /// Makes an empty file, which is an empty database; others by SQLite have its mode.
    fn create(&mut self) -> Result<(), StoreError> {
        let made = OpenOptions::new().write(true).create_new(true).mode(MODE).open(&self.path);
        match made {
            Ok(_) => {}
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(source) => return Err(StoreError::Create { path: self.path.clone(), source }),
        }
        let identity = Identity::of(&self.path);
        self.identity = Some(identity.map_err(|source| StoreError::Create { path: self.path.clone(), source })?);
        Ok(())
    }

    /// Whether nothing was ever written to it.
    pub(super) fn is_empty(&self) -> bool {
        fs::metadata(&self.path).is_ok_and(|file| file.len() == 0) && self.is_log_empty()
    }

    fn is_log_empty(&self) -> bool {
        self.is_log_missing() || fs::metadata(self.beside("-wal")).is_ok_and(|log| log.len() == 0)
    }

    fn is_log_missing(&self) -> bool {
        fs::metadata(self.beside("-wal")).is_err_and(|error| error.kind() == ErrorKind::NotFound)
    }

    /// The file beside the database whose name ends so.
    fn beside(&self, end: &str) -> PathBuf {
        let mut name = self.path.clone().into_os_string();
        name.push(end);
        name.into()
    }
}

#[cfg(test)]
mod tests;
