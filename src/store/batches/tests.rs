//! Batches through registrations, replacements and deletions of their models.

use jiff::Timestamp;
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::{ModelRegistration, ModelSummary, NewDefinition, NewModel, Replaces};

async fn open(directory: &std::path::Path) -> Store {
    Store::open(&directory.join("etude.db"), &TaskTracker::new()).await.unwrap()
}

fn model(hash: &str, replaces: Replaces) -> NewModel {
    let summary = ModelSummary {
        name: "m".to_owned(),
        hash: hash.to_owned(),
        definition_hash: Some(hash.to_owned()),
        attributes: Vec::new(),
        actions: Vec::new(),
        size: Some(ModelSize { n_states: 0, n_transitions: 0 }),
        n_stochastic: 0,
        n_unsafe: 0,
        created_at: Timestamp::UNIX_EPOCH,
    };
    NewModel { summary, definition: NewDefinition::Text("{}".to_owned()), replaces }
}

fn batch(experience: i64, n_before: i64, hash_before: &str, hash: &str, text: &[u8]) -> NewBatch {
    let size = ModelSize { n_states: 3, n_transitions: 2 };
    NewBatch {
        model: "m".to_owned(),
        experience,
        hash_before: hash_before.to_owned(),
        n_before,
        batch: format!("batch of {hash}"),
        content_hash: format!("content of {hash}"),
        hash: hash.to_owned(),
        revision: Revision { size, n_stochastic: 1, n_unsafe: 0 },
        content: pack_batch(text).unwrap(),
    }
}

async fn experience(store: &Store) -> i64 {
    store.model_head("m").await.unwrap().unwrap().experience.unwrap()
}

/// How many definitions there are, and how many batches, whoever they belong to.
async fn counts(store: &Store) -> (i64, i64) {
    let counts = "SELECT (SELECT count(*) FROM definitions), (SELECT count(*) FROM batches)";
    sqlx::query_as(counts).fetch_one(&mut *store.reader().await.unwrap()).await.unwrap()
}

async fn until_counts_are(store: &Store, expected: (i64, i64)) {
    let reached = async {
        while counts(store).await != expected {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(30), reached).await.unwrap();
}

#[tokio::test]
async fn a_batch_is_added_to_the_revision_that_it_was_made_for_and_to_no_other() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    store.register_model(model("a", Replaces::Nothing)).await.unwrap();
    let id = experience(&store).await;
    assert!(store.add_batch(batch(id, 0, "a", "b", b"first")).await.unwrap());
    assert!(!store.add_batch(batch(id, 0, "a", "c", b"late")).await.unwrap());
    assert!(!store.add_batch(batch(id + 1, 1, "b", "c", b"of another")).await.unwrap());
    let head = store.model_head("m").await.unwrap().unwrap();
    assert_eq!((head.key.hash.as_str(), head.key.is_lazy), ("b", false));
    let summary = store.model("m").await.unwrap().unwrap().summary;
    assert_eq!((summary.definition_hash(), summary.size.unwrap().n_states, summary.n_stochastic), ("a", 3, 1));
    let accepted = store.accepted_batch(id, "batch of b").await.unwrap().unwrap();
    assert_eq!((accepted.content_hash.as_str(), accepted.hash.as_str()), ("content of b", "b"));
    assert_eq!(store.accepted_batch(id, "batch of c").await.unwrap(), None);
    for (hash, seq) in [("a", Some(0)), ("b", Some(1)), ("c", None)] {
        assert_eq!(store.revision(id, hash).await.unwrap(), seq, "{hash}");
    }
    // The definition is what is compared.
    let again = store.register_model(model("a", Replaces::Any)).await.unwrap();
    assert!(matches!(again, ModelRegistration::Unchanged(summary) if summary.hash == "b"));
    assert_eq!(counts(&store).await, (1, 1));
}

#[tokio::test]
async fn batches_are_read_in_order_some_at_a_time() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    store.register_model(model("0", Replaces::Nothing)).await.unwrap();
    let id = experience(&store).await;
    // They do not compress.
    let mut random = 7_u64;
    let mut noise = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        random.to_le_bytes()
    };
    let texts: Vec<Vec<u8>> = (0..5).map(|_| (0..50_000).flat_map(|_| noise()).collect()).collect();
    for (n, text) in (0..).zip(&texts) {
        let added = store.add_batch(batch(id, n, &n.to_string(), &(n + 1).to_string(), text)).await.unwrap();
        assert!(added);
    }
    let (mut read, mut n_reads) = (Vec::new(), 0);
    loop {
        let n_before = read.len().try_into().unwrap();
        let some = store.batches(id, n_before).await.unwrap();
        if some.is_empty() {
            break;
        }
        n_reads += 1;
        read.extend(some);
    }
    assert!(n_reads > 1);
    assert_eq!(read.iter().map(|batch| batch.seq).collect::<Vec<_>>(), [1, 2, 3, 4, 5]);
    assert!(read.iter().zip(&texts).all(|(batch, text)| batch.text().unwrap() == *text));
}

#[tokio::test]
async fn what_a_model_was_told_is_removed_once_it_is_deleted_or_replaced() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    store.register_model(model("0", Replaces::Nothing)).await.unwrap();
    let id = experience(&store).await;
    for n in 0..5_i64 {
        assert!(store.add_batch(batch(id, n, &n.to_string(), &(n + 1).to_string(), b"some")).await.unwrap());
    }
    store.register_model(model("other", Replaces::OneOf(vec!["5".to_owned()]))).await.unwrap();
    until_counts_are(&store, (1, 0)).await;
    let other = experience(&store).await;
    assert!(other != id && store.add_batch(batch(other, 0, "other", "b", b"some")).await.unwrap());
    store.delete_model("m").await.unwrap();
    until_counts_are(&store, (0, 0)).await;
}
