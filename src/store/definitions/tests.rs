//! Pieces become a model's all together, or are removed.

use std::path::Path;

use jiff::Timestamp;
use sqlx::sqlite::{SqliteConnectOptions, SqlitePool};
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::{
    Deletion, ModelRegistration, ModelSize, ModelSummary, NewDefinition, NewModel, Replaces, StoredDefinition,
};

async fn open(directory: &Path) -> (Store, TaskTracker) {
    let tasks = TaskTracker::new();
    (Store::open(&directory.join("etude.db"), &tasks).await.unwrap(), tasks)
}

async fn close(store: Store, tasks: TaskTracker) {
    store.close().await;
    tasks.close();
    tasks.wait().await;
}

/// Another way to the same database.
async fn writing(directory: &Path) -> SqlitePool {
    SqlitePool::connect_with(SqliteConnectOptions::new().filename(directory.join("etude.db"))).await.unwrap()
}

/// How many definitions and pieces there are, whoever they belong to.
async fn counts(store: &Store) -> (i64, i64) {
    let counts = "SELECT (SELECT count(*) FROM definitions), (SELECT count(*) FROM definition_pieces)";
    sqlx::query_as(counts).fetch_one(&mut *store.reader().await.unwrap()).await.unwrap()
}

async fn until_counts_are(store: &Store, expected: (i64, i64)) {
    while counts(store).await != expected {
        tokio::task::yield_now().await;
    }
}

async fn stored(store: &Store, pieces: &[&str]) -> NewPieces {
    let mut definition = store.begin_pieces().await.unwrap();
    for piece in pieces {
        store.add_piece(&mut definition, piece.as_bytes().to_vec()).await.unwrap();
    }
    definition
}

fn model(name: &str, pieces: NewPieces) -> NewModel {
    let summary = ModelSummary {
        name: name.to_owned(),
        hash: "hash".to_owned(),
        definition_hash: None,
        attributes: Vec::new(),
        actions: Vec::new(),
        size: Some(ModelSize { n_states: 1, n_transitions: 0 }),
        n_stochastic: 0,
        n_unsafe: 0,
        created_at: Timestamp::UNIX_EPOCH,
    };
    NewModel { summary, definition: NewDefinition::Pieces(pieces), replaces: Replaces::Nothing }
}

async fn text(store: &Store, name: &str) -> Result<String, StoreError> {
    let StoredDefinition::Pieces(id) = store.model(name).await?.unwrap().definition else { panic!("in pieces") };
    let mut text = Vec::new();
    for seq in 0.. {
        let Some(piece) = store.piece(id, seq).await? else { break };
        text.extend(piece);
    }
    Ok(String::from_utf8(text).unwrap())
}

#[tokio::test]
async fn pieces_become_a_models_all_at_once_and_are_read_back() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let pieces = stored(&store, &["one, ", "two, ", "three"]).await;
    assert!(store.model("m").await.unwrap().is_none());
    let put = store.register_model(model("m", pieces)).await.unwrap();
    assert!(matches!(put, ModelRegistration::Created(_)));
    assert_eq!(text(&store, "m").await.unwrap(), "one, two, three");
    // The same again keeps what is there, and nothing else.
    let again = stored(&store, &["one, two, three"]).await;
    assert!(matches!(store.register_model(model("m", again)).await.unwrap(), ModelRegistration::Unchanged(_)));
    until_counts_are(&store, (1, 3)).await;
    close(store, tasks).await;
    let (store, tasks) = open(directory.path()).await;
    assert_eq!(text(&store, "m").await.unwrap(), "one, two, three");
    close(store, tasks).await;
}

#[tokio::test]
async fn what_a_crash_leaves_behind_is_no_model_and_is_removed_by_the_next_service() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let kept = stored(&store, &["kept"]).await;
    store.register_model(model("kept", kept)).await.unwrap();
    let many: Vec<String> = (0..20).map(|n| n.to_string()).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    // A killed program drops nothing.
    std::mem::forget(stored(&store, &many).await);
    assert_eq!(counts(&store).await, (2, 21));
    close(store, tasks).await;
    let (store, tasks) = open(directory.path()).await;
    let names: Vec<_> = store.models(None, 10).await.unwrap().items.into_iter().map(|model| model.name).collect();
    assert_eq!(names, ["kept"]);
    // Pieces alone would be no other's.
    sqlx::query("DELETE FROM definitions WHERE id != 1").execute(&writing(directory.path()).await).await.unwrap();
    store.sweep_left_behind().await.unwrap();
    until_counts_are(&store, (1, 1)).await;
    assert_eq!(text(&store, "kept").await.unwrap(), "kept");
    close(store, tasks).await;
}

#[tokio::test]
async fn a_piece_that_is_still_to_be_written_is_removed_with_the_others() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let kept = stored(&store, &[]).await;
    let dropped = stored(&store, &["one, "]).await;
    let write =
        |definition_id, seq| Box::pin(store.writer.write(AddPiece { definition_id, seq, piece: vec![0; 1 << 20] }));
    let mut others = [write(kept.id, 0), write(kept.id, 1)];
    for other in &mut others {
        assert!(futures_util::poll!(other).is_pending());
    }
    assert!(futures_util::poll!(write(dropped.id, 1)).is_pending());
    drop(dropped);
    until_counts_are(&store, (1, 2)).await;
    drop(others);
    close(store, tasks).await;
}

#[tokio::test]
async fn what_a_foreign_hand_has_removed_becomes_no_model() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let mut continued = stored(&store, &["one, "]).await;
    let all_lost = stored(&store, &["two"]).await;
    let foreign = writing(directory.path()).await;
    for table in ["DELETE FROM definitions", "DELETE FROM definition_pieces"] {
        sqlx::query(table).execute(&foreign).await.unwrap();
    }
    store.add_piece(&mut continued, b"three".to_vec()).await.unwrap();
    for pieces in [continued, all_lost] {
        let put = store.register_model(model("m", pieces)).await;
        assert!(matches!(put, Err(StoreError::Lost)), "{put:?}");
    }
    assert!(store.model("m").await.unwrap().is_none());
    // Sent once more, it goes through.
    let again = stored(&store, &["one, ", "three"]).await;
    assert!(matches!(store.register_model(model("m", again)).await.unwrap(), ModelRegistration::Created(_)));
    close(store, tasks).await;
}

#[tokio::test]
async fn a_definition_without_its_first_piece_is_corrupt() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let pieces = stored(&store, &["all"]).await;
    store.register_model(model("m", pieces)).await.unwrap();
    sqlx::query("DELETE FROM definition_pieces").execute(&writing(directory.path()).await).await.unwrap();
    assert!(matches!(text(&store, "m").await, Err(StoreError::Corrupt { .. })));
    close(store, tasks).await;
}

#[tokio::test]
async fn what_is_not_finished_or_deleted_is_removed() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    drop(stored(&store, &["unfinished"]).await);
    until_counts_are(&store, (0, 0)).await;
    let deleted = stored(&store, &["one, ", "two"]).await;
    store.register_model(model("m", deleted)).await.unwrap();
    let StoredDefinition::Pieces(id) = store.model("m").await.unwrap().unwrap().definition else { panic!("pieces") };
    assert_eq!(store.delete_model("m").await.unwrap(), Deletion::Deleted);
    until_counts_are(&store, (0, 0)).await;
    // Whoever still reads it is told, instead of taking a part for the whole.
    assert!(matches!(store.piece(id, 1).await, Err(StoreError::Removed)));
    close(store, tasks).await;
}

#[tokio::test]
async fn a_model_that_takes_the_place_of_another_one_leaves_nothing_of_that() {
    let directory = tempfile::tempdir().unwrap();
    let (store, tasks) = open(directory.path()).await;
    let old = stored(&store, &["old, ", "very old"]).await;
    store.register_model(model("m", old)).await.unwrap();
    let mut new = model("m", stored(&store, &["new"]).await);
    new.summary.hash = "other".to_owned();
    new.replaces = Replaces::OneOf(vec!["hash".to_owned()]);
    let before = store.model_generation("m");
    assert!(matches!(store.register_model(new).await.unwrap(), ModelRegistration::Replaced(_)));
    assert_ne!(store.model_generation("m"), before);
    let before = store.model_generation("m");
    store.register_model(model("other", stored(&store, &["other"]).await)).await.unwrap();
    assert!(before.is_some() && store.model_generation("m") == before, "another one has changed");
    store.delete_model("other").await.unwrap();
    assert_eq!(text(&store, "m").await.unwrap(), "new");
    until_counts_are(&store, (1, 1)).await;
    // What is not to be replaced stays, with all its pieces.
    let mut late = model("m", stored(&store, &["late"]).await);
    late.summary.hash = "third".to_owned();
    late.replaces = Replaces::OneOf(vec!["hash".to_owned()]);
    let conflict = ModelRegistration::Conflict { existing_hash: Some("other".to_owned()) };
    assert_eq!(store.register_model(late).await.unwrap(), conflict);
    until_counts_are(&store, (1, 1)).await;
    assert_eq!(text(&store, "m").await.unwrap(), "new");
    close(store, tasks).await;
}
