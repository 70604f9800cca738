//! What is kept of models of experience, and what that takes.

use std::time::Duration;

use jiff::Timestamp;
use serde_json::{Value, json};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::*;
use crate::clock::Clock;
use crate::service::{BatchText, Caller, Etude, ModelText, Name, Settings};
use crate::store::ModelKey;

fn caller() -> Caller {
    Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Timestamp::UNIX_EPOCH }
}

async fn open(directory: &std::path::Path, room: u64) -> Etude {
    let settings = Settings { memory: Memory::with_room(room), ..Settings::of_test(directory) };
    Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap()
}

async fn put(etude: &Etude, name: &str) {
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on"}],
        "dynamics": {"kind": "experience", "start": [[0]]},
    });
    let text = ModelText::Whole(model.to_string().into_bytes());
    etude.put_model(&Name::new(name).unwrap(), text, Format::Json, caller()).await.unwrap();
}

/// The way from one number to another.
fn way(id: &str, numbers: std::ops::Range<u32>) -> Value {
    let transitions = numbers.map(|x| json!({"state": [x], "action": "on", "next": [x + 1]}));
    json!({"batch": id, "transitions": transitions.collect::<Vec<_>>()})
}

async fn tell(etude: &Etude, name: &str, batch: &Value) -> Result<String, ServiceError> {
    let answer =
        etude.add_experience(&Name::new(name).unwrap(), BatchText::Json(batch.to_string().into()), caller()).await;
    answer.map(|answer| answer.hash)
}

#[tokio::test]
async fn a_revision_leaves_the_cache_for_the_next_one_and_is_made_again_if_it_is_asked_for() {
    let directory = tempfile::tempdir().unwrap();
    let etude = open(directory.path(), 1 << 30).await;
    put(&etude, "m").await;
    let (untold, _) = etude.mapper("m", "/model", None, None).await.unwrap();
    let mut hashes = Vec::new();
    for n in 0..5 {
        hashes.push(tell(&etude, "m", &way(&n.to_string(), n..n + 1)).await.unwrap());
        let (hash, mapper) = etude.mapper("m", "/model", None, None).await.unwrap();
        assert_eq!((&hash, mapper.model().states().len()), (&hashes[n as usize], n + 2));
    }
    let is_kept = |hash: &String| etude.compiler.cache.get(&ModelKey { hash: hash.clone(), is_lazy: false }).is_some();
    assert_eq!(hashes.iter().map(is_kept).collect::<Vec<_>>(), [false, false, false, false, true]);
    let earlier = etude.mapper_with_hash(("m", &hashes[1]), "/model", None, None).await.unwrap().unwrap();
    assert_eq!(earlier.model().states().len(), 3);
    let first = etude.mapper_with_hash(("m", &untold), "/model", None, None).await.unwrap().unwrap();
    assert_eq!((first.model().states().len(), first.model().n_transitions()), (1, 0));
    let (hash, _) = etude.mapper("m", "/model", None, None).await.unwrap();
    assert_eq!(hash, hashes[4], "it is still the last one that others get");
    assert!(etude.mapper_with_hash(("m", "none"), "/model", None, None).await.unwrap().is_none());
}

#[tokio::test]
async fn what_was_told_is_counted_in_the_budget_and_makes_room_for_others() {
    let directory = tempfile::tempdir().unwrap();
    let etude = open(directory.path(), 64 << 20).await;
    let free = etude.memory.free();
    for name in ["a", "b"] {
        put(&etude, name).await;
        tell(&etude, name, &way("first", 0..5000)).await.unwrap();
    }
    let experiences = &etude.compiler.experiences;
    assert!(etude.memory.free() + (400 << 10) < free, "{} {free}", etude.memory.free());
    experiences.forget("a");
    experiences.make_room();
    assert_eq!(etude.memory.free(), free);
    // Counted anew, they are as they were.
    let again = tell(&etude, "a", &way("second", 5000..5001)).await.unwrap();
    assert_eq!(experiences.table("a", Wanted::Current).await.unwrap().0, again);
    assert_eq!(experiences.lock("a").await.as_ref().unwrap().tally.counts().n_states, 5002);
}

#[tokio::test]
async fn a_batch_for_which_there_is_no_memory_is_refused_and_nothing_of_it_counts() {
    let directory = tempfile::tempdir().unwrap();
    let etude = open(directory.path(), 64 << 20).await;
    put(&etude, "m").await;
    let first = tell(&etude, "m", &way("first", 0..10)).await.unwrap();
    let large = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
    let small: Vec<_> = std::iter::from_fn(|| etude.memory.try_take(1 << 16).ok()).collect();
    let refused = tell(&etude, "m", &way("second", 0..5000)).await;
    assert!(matches!(refused, Err(ServiceError::NoRoom(_))), "{refused:?}");
    drop((large, small));
    assert_eq!(etude.model_hash(&Name::new("m").unwrap()).await.unwrap(), first);
    tell(&etude, "m", &way("second", 0..5000)).await.unwrap();
}

#[tokio::test]
async fn of_many_models_some_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    let etude = open(directory.path(), 64 << 20).await;
    for n in 0..Experiences::MAX_KEPT + 3 {
        let name = format!("m{n}");
        put(&etude, &name).await;
        tell(&etude, &name, &way("first", 0..2)).await.unwrap();
    }
    let experiences = &etude.compiler.experiences;
    assert_eq!(experiences.rooms().by_name.len(), Experiences::MAX_KEPT);
    assert!(!experiences.rooms().by_name.contains_key("m0"));
    let first = tokio::time::timeout(Duration::from_secs(30), tell(&etude, "m0", &way("first", 0..2))).await.unwrap();
    assert_eq!(first.unwrap(), etude.model_hash(&Name::new("m0").unwrap()).await.unwrap());
}

#[tokio::test]
async fn what_is_stored_and_is_not_what_was_told_is_noticed() {
    let directory = tempfile::tempdir().unwrap();
    let etude = open(directory.path(), 64 << 20).await;
    put(&etude, "m").await;
    tell(&etude, "m", &way("first", 0..2)).await.unwrap();
    etude.compiler.experiences.make_room();
    let forged = crate::store::pack_batch(way("first", 0..3).to_string().as_bytes()).unwrap();
    let path = directory.path().join("etude.db");
    let database = sqlx::SqlitePool::connect(path.to_str().unwrap()).await.unwrap();
    sqlx::query("UPDATE batches SET content = $1").bind(forged).execute(&database).await.unwrap();
    let error = tell(&etude, "m", &way("second", 0..2)).await.unwrap_err();
    assert!(matches!(error, ServiceError::Unreadable { table: "batches", .. }), "{error:?}");
}

/// Waits until the tally that is stored has counted up to `expected`.
async fn until_stored_is(etude: &Etude, expected: i64) {
    let (_, experience) = etude.compiler.experiences.head("m").await.unwrap();
    let reached = async {
        while etude.store.tally(experience, i64::MAX).await.unwrap().map_or(0, |stored| stored.seq) != expected {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), reached).await.unwrap();
}

async fn execute(path: &std::path::Path, sql: &'static str) {
    let database = sqlx::SqlitePool::connect(path.join("etude.db").to_str().unwrap()).await.unwrap();
    sqlx::query(sql).execute(&database).await.unwrap();
}

#[tokio::test]
async fn what_was_counted_is_stored_from_time_to_time_and_only_what_came_since_is_counted_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path();
    let etude = open(path, 256 << 20).await;
    put(&etude, "m").await;
    let first = tell(&etude, "m", &way("first", 0..10)).await.unwrap();
    tell(&etude, "m", &way("second", 0..20_000)).await.unwrap();
    until_stored_is(&etude, 2).await;
    let third = tell(&etude, "m", &way("third", 5..15)).await.unwrap();
    let experiences = &etude.compiler.experiences;
    let (hash, table) = experiences.table("m", Wanted::Current).await.unwrap();
    let expected = table.unwrap().text();
    assert_eq!(hash, third);
    // Nobody reads what came before.
    execute(path, "UPDATE batches SET content = x'00' WHERE seq <= 2").await;
    experiences.make_room();
    let (hash, table) = etude.compiler.experiences.table("m", Wanted::Current).await.unwrap();
    assert_eq!((&hash, table.unwrap().text()), (&third, expected));
    // The next one takes its place.
    tell(&etude, "m", &way("fourth", 0..20_000)).await.unwrap();
    until_stored_is(&etude, 4).await;
    // An earlier revision needs them.
    let unknown = etude.compiler.experiences.table("m", Wanted::Revision(&hash_of("none"))).await;
    assert!(matches!(unknown, Err(ServiceError::Unknown { .. })));
    let earlier = etude.compiler.experiences.table("m", Wanted::Revision(&first)).await;
    assert!(matches!(earlier, Err(ServiceError::Unreadable { table: "batches", .. })));
}

#[tokio::test]
async fn a_tally_that_is_damaged_or_not_there_in_full_is_counted_again() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path();
    let etude = open(path, 256 << 20).await;
    put(&etude, "m").await;
    tell(&etude, "m", &way("first", 0..20_000)).await.unwrap();
    until_stored_is(&etude, 1).await;
    let second = tell(&etude, "m", &way("second", 0..10)).await.unwrap();
    let (_, table) = etude.compiler.experiences.table("m", Wanted::Current).await.unwrap();
    let expected = table.unwrap().text();
    for damage in [
        "UPDATE tallies SET content = x'28b52ffd'",
        "UPDATE tallies SET checksum = checksum + 1",
        "UPDATE tallies SET hash = 'another'",
        "UPDATE tallies SET seq = 2",
        "UPDATE tallies SET n_pieces = n_pieces + 1",
        "DELETE FROM tallies WHERE piece = 0",
    ] {
        execute(path, damage).await;
        etude.compiler.experiences.make_room();
        let (hash, table) = etude.compiler.experiences.table("m", Wanted::Current).await.unwrap();
        assert!((&hash, table.unwrap().text()) == (&second, expected.clone()), "{damage}");
        // As counting took long.
        until_stored_is(&etude, 2).await;
    }
}
