//! Which databases are opened, and which are left as they are.

use std::fs::Permissions;
use std::os::unix::fs::{MetadataExt, PermissionsExt};

use sqlx::Row;
use tokio_util::task::TaskTracker;

use super::files::keep_from_others;
use super::*;
use crate::store::{PolicyFilter, Store};

#[tokio::test]
async fn a_database_whose_migration_was_not_completed_is_migrated_but_not_by_whoever_only_reads() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    let mut begun = options(&path).create_if_missing(true).connect().await.unwrap();
    let mut migrator = schema::migrator();
    migrator.migrations.to_mut().pop();
    migrator.run_direct(None, &mut begun, false).await.unwrap();
    begun.close().await.unwrap();
    let read = Store::open_to_read(&path, &TaskTracker::new()).await;
    assert!(matches!(read, Err(StoreError::Outdated)), "{read:?}");
    let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
    let id = sqlx::query("PRAGMA application_id").fetch_one(&mut *store.reader().await.unwrap()).await.unwrap();
    assert_eq!(id.get::<i64, _>(0), schema::APPLICATION_ID);
}

#[tokio::test]
async fn a_service_keeps_others_from_files_that_they_could_read_and_whoever_only_reads_leaves_them() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    let at = |end: &str| directory.path().join(format!("etude.db{end}"));
    let of_all = ["", "-wal", "-shm", "-lock"];
    let modes = || of_all.map(|end| fs::metadata(at(end)).unwrap().mode() & 0o777);
    let tasks = TaskTracker::new();
    let store = Store::open_alone(&path, &tasks).await.unwrap();
    store.close().await;
    tasks.close();
    tasks.wait().await;
    for end in ["", "-lock"] {
        fs::set_permissions(at(end), Permissions::from_mode(0o644)).unwrap();
    }
    // SQLite gives what it makes the mode of the database.
    let reading = Store::open_to_read(&path, &TaskTracker::new()).await.unwrap();
    assert_eq!(modes(), [0o644; 4]);
    let _store = Store::open_alone(&path, &TaskTracker::new()).await.unwrap();
    assert_eq!(modes(), [0o600; 4]);
    reading.policies(&PolicyFilter::default(), 0, 1).await.unwrap();

    let foreign = directory.path().join("foreign.db");
    let mut other = options(&foreign).create_if_missing(true).connect().await.unwrap();
    sqlx::query("CREATE TABLE others (id INTEGER)").execute(&mut other).await.unwrap();
    fs::set_permissions(&foreign, Permissions::from_mode(0o644)).unwrap();
    assert!(matches!(Store::open_alone(&foreign, &TaskTracker::new()).await, Err(StoreError::Foreign)));
    assert_eq!(fs::metadata(&foreign).unwrap().mode() & 0o777, 0o644);
}

#[test]
fn what_its_owner_must_not_write_to_stays_so_and_what_a_link_leads_to_is_left() {
    let directory = tempfile::tempdir().unwrap();
    let (path, link) = (directory.path().join("file"), directory.path().join("link"));
    fs::write(&path, "").unwrap();
    fs::set_permissions(&path, Permissions::from_mode(0o444)).unwrap();
    std::os::unix::fs::symlink(&path, &link).unwrap();
    let mode = || fs::metadata(&path).unwrap().mode() & 0o777;
    assert!(!keep_from_others(&link).unwrap());
    assert_eq!(mode(), 0o444);
    assert!(keep_from_others(&path).unwrap());
    assert_eq!(mode(), 0o400);
    assert!(!keep_from_others(&path).unwrap());
    assert!(!keep_from_others(&directory.path().join("none")).unwrap());
}

#[tokio::test]
async fn who_waits_for_a_way_to_read_gets_it_before_others_take_their_place() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    let mut taken = Vec::new();
    for _ in 0..N_READERS {
        taken.push(store.reader().await.unwrap());
    }
    let mut waiting = Box::pin(store.reader());
    assert!(futures_util::poll!(&mut waiting).is_pending());
    let replaced = async { store.readers.pool.write().await.close().await };
    let reads = async move {
        taken.clear();
        sqlx::query("SELECT * FROM models").fetch_all(&mut *waiting.await?).await?;
        Ok::<_, StoreError>(())
    };
    let ((), read) = tokio::join!(biased; replaced, reads);
    read.unwrap();
}

#[tokio::test]
async fn a_database_of_a_newer_version_is_refused_and_left_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    drop(Store::open(&path, &TaskTracker::new()).await.unwrap());
    let mut newer = options(&path).connect().await.unwrap();
    let applied = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
        VALUES (1000, 'later', TRUE, x'00', 0)";
    sqlx::query(applied).execute(&mut newer).await.unwrap();
    newer.close().await.unwrap();
    let opened = Store::open(&path, &TaskTracker::new()).await;
    assert!(matches!(opened, Err(StoreError::Newer { migration: 1000 })), "{opened:?}");
    let read = Store::open_to_read(&path, &TaskTracker::new()).await;
    assert!(matches!(read, Err(StoreError::Newer { migration: 1000 })), "{read:?}");
}
