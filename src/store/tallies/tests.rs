//! Tallies through kills, and what is removed.

use jiff::Timestamp;
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::{ModelSize, ModelSummary, NewBatch, NewDefinition, NewModel, Replaces, Revision};

async fn open(directory: &std::path::Path) -> Store {
    Store::open(&directory.join("etude.db"), &TaskTracker::new()).await.unwrap()
}

/// A model that was told three batches; with which it has the hashes 1, 2 and 3.
async fn told(store: &Store) -> i64 {
    let size = ModelSize { n_states: 0, n_transitions: 0 };
    let summary = ModelSummary {
        name: "m".to_owned(),
        hash: "0".to_owned(),
        definition_hash: Some("0".to_owned()),
        attributes: Vec::new(),
        actions: Vec::new(),
        size: Some(size),
        n_stochastic: 0,
        n_unsafe: 0,
        created_at: Timestamp::UNIX_EPOCH,
    };
    let definition = NewDefinition::Text("{}".to_owned());
    store.register_model(NewModel { summary, definition, replaces: Replaces::Nothing }).await.unwrap();
    let experience = store.model_head("m").await.unwrap().unwrap().experience.unwrap();
    for n in 0..3 {
        let batch = NewBatch {
            model: "m".to_owned(),
            experience,
            hash_before: n.to_string(),
            n_before: n,
            batch: n.to_string(),
            content_hash: n.to_string(),
            hash: (n + 1).to_string(),
            revision: Revision { size, n_stochastic: 0, n_unsafe: 0 },
            content: Vec::new(),
        };
        assert!(store.add_batch(batch).await.unwrap());
    }
    experience
}

/// Of several pieces, as it does not compress.
fn tally(seq: i64) -> StoredTally {
    let mut random = u64::try_from(seq).unwrap();
    let mut noise = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        random.to_le_bytes()
    };
    StoredTally { seq, hash: seq.to_string(), content: (0..80_000).flat_map(|_| noise()).collect() }
}

async fn n_rows(store: &Store) -> i64 {
    let mut reader = store.reader().await.unwrap();
    sqlx::query_scalar("SELECT count(*) FROM tallies").fetch_one(&mut *reader).await.unwrap()
}

#[tokio::test]
async fn a_tally_counts_once_all_of_it_is_stored_and_then_takes_the_place_of_the_one_before() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let experience = told(&store).await;
    assert_eq!(store.tally(experience, 3).await.unwrap(), None);
    assert!(store.put_tally(experience, tally(1)).await.unwrap());
    assert_eq!(store.tally(experience, 3).await.unwrap(), Some(tally(1)));
    assert_eq!(store.tally(experience, 0).await.unwrap(), None);
    // As if the program had been killed.
    let compressed: Arc<[u8]> = zstd::bulk::compress(&tally(2).content, COMPRESSION_LEVEL).unwrap().into();
    let n_pieces = compressed.len().div_ceil(PIECE_BYTES);
    assert!(n_pieces > 2);
    for piece in 1..n_pieces {
        let (hash, compressed) = ("2".to_owned(), Arc::clone(&compressed));
        let piece = AddTallyPiece { experience, seq: 2, hash, piece, n_pieces, checksum: 0, compressed };
        assert!(store.writer.write(piece).await.unwrap());
    }
    assert_eq!(store.tally(experience, 3).await.unwrap(), Some(tally(1)));
    assert!(store.put_tally(experience, tally(3)).await.unwrap());
    assert_eq!(store.tally(experience, 3).await.unwrap(), Some(tally(3)));
    assert_eq!(n_rows(&store).await, i64::try_from(n_pieces).unwrap());
    assert_eq!(store.tally(experience, 2).await.unwrap(), None);
}

#[tokio::test]
async fn nothing_is_stored_for_a_model_that_is_gone() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let experience = told(&store).await;
    assert!(store.put_tally(experience, tally(1)).await.unwrap());
    store.delete_model("m").await.unwrap();
    assert!(!store.put_tally(experience, tally(2)).await.unwrap());
    let removed = async {
        while n_rows(&store).await > 0 {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(30), removed).await.unwrap();
}
