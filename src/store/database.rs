//! The files of the database, and the connections to it.
//!
//! ```text
//! etude.db       0600, as are the others; its identity is the device and inode found when it was first opened
//! etude.db-lock  locked by the process that writes, for as long as it lives
//! etude.db-wal, etude.db-shm: SQLite's
//! ```
//!
//! The writer's first connection checks the database: whose it is, whether it is whole, and whether it has this version's schema. While
//! nothing can be written, the database is only read, until a connection that writes can be opened. Only SQLite opens the file of the
//! database: its locks would be lost if another descriptor of the file were closed.

mod files;
mod readers;
mod turns;

use std::fs::{self, File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::sqlite::{SqlitePool, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, SqliteConnection};

use super::{Depth, StoreError, Unavailable, schema};
use files::{Identity, MODE, is_read_only, probe_aside, resolve, unavailable};
#[cfg(test)]
pub(super) use readers::N_READERS;
pub(super) use readers::{Reader, Readers, checkpoint};
use readers::{look_at, options, readers};

/// Size of the log, in pages of 4 KiB, from which on a commit copies it itself. That is rare, as a reader copies it beside the writer
/// before. But a reader cannot copy the end of the log while others write, and the log begins anew only once all of it was copied.
const MAX_LOG_PAGES: &str = "16384";

/// How much of the database the writer keeps in memory: 8 MiB. To bring what has arrived to its table, it changes some 700 pages at once, which do
/// not fit into the 2 MiB that SQLite keeps by itself, and were read and written again and again.
const WRITER_CACHE: &str = "-8192";

/// Whether others are kept from the database.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Locking {
    /// Other processes are kept out, by a lock on the file beside the database.
    Exclusive,
    /// They are not.
    None,
}

/// The files of the database, as its writer knows them.
#[derive(Debug)]
pub(super) struct Database {
    path: PathBuf,
    locking: Locking,
    /// The file that is locked while this lives.
    lock: Option<File>,
    /// The file of the database. `None` until there is one.
    identity: Option<Identity>,
    /// The file of the log, which exists while any connection is open.
    log_identity: Option<Identity>,
    /// Whether a connection that writes was opened, and the database checked by it. Since then, the readers are opened beside it.
    is_looked_at: bool,
    /// Whether there is a log. There is none where processes cannot share memory.
    has_log: bool,
    /// `None` until the database could be read.
    readers: Option<Arc<Readers>>,
}

impl Database {
    /// The database at `path`. Links and the working directory are resolved now, and may change later.
    ///
    /// # Errors
    ///
    /// If its directory is not there.
    pub(super) fn new(path: &Path, locking: Locking) -> Result<Self, StoreError> {
        let path = resolve(path).map_err(|source| match path.parent() {
            Some(directory) if !directory.as_os_str().is_empty() && !directory.exists() => {
                StoreError::NoDirectory { directory: directory.to_owned() }
            }
            _ => StoreError::Create { path: path.to_owned(), source },
        })?;
        if path.is_dir() {
            return Err(StoreError::Directory { path });
        }
        let identity = Identity::of(&path).ok();
        let (lock, log_identity, readers) = (None, None, None);
        Ok(Self { path, locking, lock, identity, log_identity, is_looked_at: false, has_log: false, readers })
    }

    /// The connections that read.
    ///
    /// # Errors
    ///
    /// If there are none.
    pub(super) fn readers(&self) -> Result<Arc<Readers>, StoreError> {
        self.readers.clone().ok_or(StoreError::Closed)
    }

    /// Opens a connection that writes, and at the first time the readers.
    ///
    /// # Errors
    ///
    /// [`StoreError::Unavailable`] if it may go through later; another error if the database cannot be used at all.
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
                self.readers = Some(Arc::new(Readers::new(pool)));
            }
            return Ok(connection);
        };
        // Readers that were opened without a writer keep the writer's connection from being opened as it should, and closing them later
        // would take locks away. So they are closed first, if something can be written now, and opened again if the writer fails.
        let probed = probe_aside(&self.path).await;
        let mut place = readers.pool.write().await;
        if let Err(unavailable) = probed {
            // An earlier attempt has closed the readers, and could not open them again.
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

    /// Opens a connection that writes, and with the first one the readers.
    async fn open(&mut self) -> Result<(SqliteConnection, Option<SqlitePool>), StoreError> {
        let writing = options(&self.path).synchronous(SqliteSynchronous::Full);
        let writing = writing.pragma("wal_autocheckpoint", MAX_LOG_PAGES).pragma("cache_size", WRITER_CACHE);
        let mut connection = writing.connect().await?;
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
        // SQLite opens a file that can only be read without an error, so a write is tried. If the file is merely locked, the connection
        // is good.
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

    /// Opens readers only. The database and its directory are left as they are, as far as SQLite can.
    ///
    /// # Errors
    ///
    /// If the database cannot be read, or would have to be changed first.
    pub(super) async fn read_only(&mut self, depth: Depth) -> Result<(), StoreError> {
        let pool = self.look_at(depth).await?;
        self.readers = Some(Arc::new(Readers::new(pool)));
        Ok(())
    }

    async fn look_at(&self, depth: Depth) -> Result<SqlitePool, StoreError> {
        let options = options(&self.path).read_only(true);
        match look_at(options.clone(), depth).await {
            // SQLite cannot make its `-shm` file: no room, or no permission. Then the database can only be read as a file that nobody
            // writes to, without its log, which must be empty.
            Err(StoreError::Unavailable(_)) if self.is_log_empty() => look_at(options.immutable(true), depth).await,
            pool => pool,
        }
    }

    /// Makes sure that the files just written to are still the ones that have the names of the database and of its log.
    ///
    /// # Errors
    ///
    /// [`Unavailable::Gone`] if not.
    pub(super) fn check_written(&mut self) -> Result<(), StoreError> {
        if self.has_log && self.log_identity.is_none() {
            // From now on the log stays, as readers have it open.
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

    /// Closes the connection that writes, and ignores an error of that: whoever opens the database next undoes what was not committed.
    pub(super) async fn disconnect(&mut self, connection: SqliteConnection) {
        let was_there = self.check_files().is_ok();
        let _ = connection.close().await;
        // The last connection that is closed removes the log, after everything in it was copied.
        if was_there && self.is_log_missing() {
            self.log_identity = None;
        }
    }

    /// The cause of an error of SQLite, as far as can be found out.
    pub(super) async fn diagnose(&self, error: StoreError) -> StoreError {
        let StoreError::Unavailable(unavailable) = error else { return error };
        if self.check_files().is_err() {
            return Unavailable::Gone.into();
        }
        if let Unavailable::Failing { .. } = unavailable {
            // SQLite does not always tell a full disk from one that fails.
            return probe_aside(&self.path).await.err().unwrap_or(unavailable).into();
        }
        unavailable.into()
    }

    fn take_lock(&mut self) -> Result<(), StoreError> {
        if self.locking == Locking::None || self.lock.is_some() {
            return Ok(());
        }
        let path = self.beside("-lock");
        // The file stays when the process ends: if it were removed, it could be another process's lock by then.
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

    /// Takes the permissions of other users from files that were there before and that only this process writes to.
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

    /// Makes an empty file, which is an empty database. SQLite gives the files beside it the same mode.
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

    /// The file beside the database whose name has this suffix.
    fn beside(&self, end: &str) -> PathBuf {
        let mut name = self.path.clone().into_os_string();
        name.push(end);
        name.into()
    }
}

#[cfg(test)]
mod tests;
