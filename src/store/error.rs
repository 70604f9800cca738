//! The errors of the store, by what the caller can do about them.

use std::io;
use std::path::PathBuf;

use sqlx::migrate::MigrateError;

use crate::memory::NoRoom;

/// Why the store could not do as told.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The database failed.
    #[error("the database failed")]
    Database(#[source] sqlx::Error),
    /// The database cannot be used now; later it may go through.
    #[error(transparent)]
    Unavailable(#[from] Unavailable),
    /// There is no database, and none can be made.
    #[error(
        "there is no database {}, and it cannot be created: its directory must exist, have room, and be writable for this user",
        path.display()
    )]
    Create {
        /// Where it was to be.
        path: PathBuf,
        /// Why not.
        #[source]
        source: io::Error,
    },
    /// The directory of the database is missing.
    #[error("there is no directory {}: make it with `mkdir -p {}`, or use another database", directory.display(), directory.display())]
    NoDirectory {
        /// The directory.
        directory: PathBuf,
    },
    /// The database is a directory.
    #[error("it is a directory: name a file in it, such as {}", path.join("etude.db").display())]
    Directory {
        /// The directory.
        path: PathBuf,
    },
    /// A process works with the database, and there may be only one.
    #[error(
        "another process works with the database and holds {}: stop it, go through it (`--server`, for commands that have it), or \
         use another database",
        lock.display()
    )]
    InUse {
        /// The file that it has locked.
        lock: PathBuf,
    },
    /// It cannot be found out whether another process works with the database.
    #[error("cannot lock {}", lock.display())]
    Lock {
        /// The file that was to be locked.
        lock: PathBuf,
        /// Why not.
        #[source]
        source: io::Error,
    },
    /// The database is another program's. It was left as it is.
    #[error("the file is a database of another program; it was left as it is")]
    Foreign,
    /// The file is something else.
    #[error("the file is not a database")]
    NotADatabase,
    /// The database's file is damaged.
    #[error("the file of the database is damaged, and was left as it is; use a copy of it from before: {finding}")]
    Damaged {
        /// What SQLite's quick check has found first.
        finding: String,
    },
    /// A later version of this program has changed the database's schema.
    #[error("a newer version of this program has written the database (it has migration {migration})")]
    Newer {
        /// The first one that is not known here.
        migration: i64,
    },
    /// The database is only read, and has the schema of an earlier version of this program.
    #[error("the database has the schema of an earlier version; it is migrated by the next start of the service")]
    Outdated,
    /// The database has the schema of a version of this program that was never released. It was left as it is.
    #[error(
        "a development version of this program has written the database, and its schema cannot be migrated: use a new file, or that \
         version"
    )]
    Unreleased,
    /// The database could not be brought to this version's schema.
    #[error("the database could not be migrated")]
    Migrate(#[source] MigrateError),
    /// The SQLite that this program was linked with is too old.
    #[error("SQLite {found} can corrupt a database in WAL mode; {}.{}.{} is needed", needed.0, needed.1, needed.2)]
    Version {
        /// Its version.
        found: String,
        /// The oldest that will do.
        needed: (u32, u32, u32),
    },
    /// A row holds what this program never writes.
    #[error("table {table} holds an invalid {column}{}", of_row(row.as_deref()))]
    Corrupt {
        /// Where.
        table: &'static str,
        /// In which column.
        column: &'static str,
        /// In which row, by its name or id, if that is known.
        row: Option<String>,
        /// What is wrong with it.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// What is to be read takes more memory than there is.
    #[error(transparent)]
    NoRoom(#[from] NoRoom),
    /// What is read was removed while it was.
    #[error("it was removed while it was read")]
    Removed,
    /// Some of what was to be registered was removed meanwhile; sent once more, it may go through.
    #[error("what was stored so far was removed meanwhile; send it again")]
    Lost,
    /// The store is shutting down.
    #[error("the store takes no more writes")]
    Closed,
}

/// Why the database cannot be used now, though nothing is wrong with what was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unavailable {
    /// Another process has held the database for too long.
    #[error("the database is locked by another process")]
    Locked,
    /// No room is left on its disk.
    #[error("the disk of the database is full")]
    Full,
    /// Its disk, its directory or its file is not to be written to.
    #[error("the database is read-only")]
    ReadOnly,
    /// Its disk fails.
    #[error("the disk of the database fails (SQLite's error {code})")]
    Failing {
        /// The extended result code.
        code: u32,
    },
    /// It does not answer in time.
    #[error("the database does not answer in time: its disk is slow, or another process has locked it")]
    Slow,
    /// Its file is not the one that was opened.
    #[error("the file of the database was deleted or replaced; bring it back, or start the service anew")]
    Gone,
}

impl StoreError {
    /// The same error, about the row of `table` with this name or id if it tells no row yet.
    pub(super) fn of_row(self, table: &'static str, name: &str) -> Self {
        match self {
            Self::Corrupt { table, column, row: None, source } => {
                Self::Corrupt { table, column, row: Some(name.to_owned()), source }
            }
            Self::Database(sqlx::Error::ColumnDecode { index, source }) => {
                let source = format!("column {index}: {source}").into();
                Self::Corrupt { table, column: "value", row: Some(name.to_owned()), source }
            }
            error => error,
        }
    }

    /// Whether it is one row's fault.
    pub(super) fn is_of_a_row(&self) -> bool {
        matches!(self, Self::Corrupt { .. })
    }
}

fn of_row(row: Option<&str>) -> String {
    row.map(|row| format!(" in the row of {row:?}")).unwrap_or_default()
}

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        const SQLITE_BUSY: u32 = 5;
        const SQLITE_READONLY: u32 = 8;
        const SQLITE_IOERR: u32 = 10;
        const SQLITE_CORRUPT: u32 = 11;
        const SQLITE_FULL: u32 = 13;
        const SQLITE_CANTOPEN: u32 = 14;
        const SQLITE_NOTADB: u32 = 26;
        // A pool is closed when another one takes its place, or the service stops.
        if let sqlx::Error::PoolTimedOut | sqlx::Error::PoolClosed = error {
            return Unavailable::Slow.into();
        }
        let code = error.as_database_error().and_then(|error| error.code()?.parse::<u32>().ok());
        let Some(code) = code else { return Self::Database(error) };
        // Extended codes have the primary one in their low byte.
        let unavailable = match code & 0xff {
            SQLITE_BUSY => Unavailable::Locked,
            SQLITE_READONLY => Unavailable::ReadOnly,
            SQLITE_FULL => Unavailable::Full,
            SQLITE_IOERR | SQLITE_CANTOPEN => Unavailable::Failing { code },
            SQLITE_CORRUPT => return Self::Damaged { finding: error.to_string() },
            SQLITE_NOTADB => return Self::NotADatabase,
            _ => return Self::Database(error),
        };
        unavailable.into()
    }
}

impl From<MigrateError> for StoreError {
    fn from(error: MigrateError) -> Self {
        match error {
            MigrateError::Execute(error) => error.into(),
            MigrateError::ExecuteMigration(error, version) => match error.into() {
                Self::Database(error) => Self::Migrate(MigrateError::ExecuteMigration(error, version)),
                error => error,
            },
            error => Self::Migrate(error),
        }
    }
}
