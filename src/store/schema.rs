//! Whether a database is one that this program can use: linked with a safe SQLite, ours, whole, of this version's schema.

use sqlx::SqlSafeStr;
use sqlx::SqliteConnection;
use sqlx::migrate::{Migration, MigrationType, Migrator};

use super::StoreError;

/// Earlier versions of SQLite can corrupt a database in WAL mode.
const LEAST_SQLITE_VERSION: (u32, u32, u32) = (3, 51, 3);

/// What the first migration sets.
pub(super) const APPLICATION_ID: i64 = 0x6574_7564;

/// Every migration, in order. They are part of the program, so that it runs wherever it is copied to.
pub(super) fn migrator() -> Migrator {
    let migration = |version, description: &'static str, sql: &'static str| {
        Migration::new(version, description.into(), MigrationType::Simple, sql.into_sql_str(), false)
    };
    Migrator {
        migrations: vec![migration(1, "schema", include_str!("../../migrations/0001_schema.sql"))].into(),
        ..Migrator::DEFAULT
    }
}

/// Brings a database of ours to this version's schema.
///
/// # Errors
///
/// [`StoreError::Newer`] or [`StoreError::Unreleased`] if it has a schema that cannot be brought to it, or if the database failed.
pub(super) async fn migrate(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    is_current(connection).await?;
    Ok(migrator().run_direct(None, connection, false).await?)
}

/// Refuses a database that has another schema than this version's.
///
/// # Errors
///
/// [`StoreError::Outdated`] if it can be migrated, as [`migrate`] otherwise.
pub(super) async fn check_current(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    if is_current(connection).await? { Ok(()) } else { Err(StoreError::Outdated) }
}

/// Whether every migration was applied to the database; and, that it can be migrated if not.
async fn is_current(connection: &mut SqliteConnection) -> Result<bool, StoreError> {
    let begun = "SELECT EXISTS (SELECT 1 FROM sqlite_schema WHERE name = '_sqlx_migrations')";
    if !sqlx::query_scalar(begun).fetch_one(&mut *connection).await? {
        return Ok(false);
    }
    let query = sqlx::query_as("SELECT version, checksum FROM _sqlx_migrations ORDER BY version");
    let applied: Vec<(i64, Vec<u8>)> = query.fetch_all(connection).await?;
    let known = migrator().migrations;
    if known
        .iter()
        .zip(&applied)
        .any(|(known, (version, checksum))| (known.version, known.checksum.as_ref()) != (*version, checksum.as_slice()))
    {
        return Err(StoreError::Unreleased);
    }
    match applied.get(known.len()) {
        Some((migration, _)) => Err(StoreError::Newer { migration: *migration }),
        None => Ok(applied.len() == known.len()),
    }
}

/// Refuses an SQLite that can corrupt the database.
pub(super) async fn check_version(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    let found: String = sqlx::query_scalar("SELECT sqlite_version()").fetch_one(connection).await?;
    let mut parts = found.split('.').map(|part| part.parse::<u32>().unwrap_or(0));
    let mut next = || parts.next().unwrap_or(0);
    let version = (next(), next(), next());
    if version < LEAST_SQLITE_VERSION {
        return Err(StoreError::Version { found, needed: LEAST_SQLITE_VERSION });
    }
    Ok(())
}

/// Refuses a database of another program. An empty one may be used.
pub(super) async fn check_whose(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    let id: i64 = sqlx::query_scalar("PRAGMA application_id").fetch_one(&mut *connection).await?;
    // A process that was killed while it made the first tables has left `_sqlx_migrations` alone.
    let has_tables = "SELECT EXISTS (SELECT 1 FROM sqlite_schema
         WHERE name NOT LIKE 'sqlite\\_%' ESCAPE '\\' AND tbl_name != '_sqlx_migrations')";
    if id == APPLICATION_ID || (id == 0 && !sqlx::query_scalar::<_, bool>(has_tables).fetch_one(connection).await?) {
        Ok(())
    } else {
        Err(StoreError::Foreign)
    }
}

/// Refuses a file whose pages do not fit together.
pub(super) async fn quick_check(connection: &mut SqliteConnection) -> Result<(), StoreError> {
    let checked = sqlx::query_scalar::<_, String>("PRAGMA quick_check(1)").fetch_one(connection).await;
    match checked.map_err(StoreError::from) {
        Ok(finding) if finding == "ok" => Ok(()),
        Ok(finding) => Err(StoreError::Damaged { finding }),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use sqlx::sqlite::SqliteConnectOptions;
    use sqlx::{ConnectOptions, Connection};
    use tokio_util::task::TaskTracker;

    use crate::store::Store;

    #[tokio::test]
    async fn a_database_whose_first_migration_was_another_one_is_refused_with_a_sentence_that_says_so() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("etude.db");
        drop(Store::open(&path, &TaskTracker::new()).await.unwrap());
        let mut older = SqliteConnectOptions::new().filename(&path).connect().await.unwrap();
        let others = "UPDATE _sqlx_migrations SET checksum = x'00', description = 'models and policies';
            INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
            VALUES (1000, 'sessions', TRUE, x'00', 0)";
        sqlx::raw_sql(others).execute(&mut older).await.unwrap();
        older.close().await.unwrap();
        let opened = Store::open(&path, &TaskTracker::new()).await.unwrap_err();
        let read = Store::open_to_read(&path, &TaskTracker::new()).await.unwrap_err();
        for error in [opened, read] {
            assert!(error.to_string().contains("development version"), "{error}");
        }
    }
}
