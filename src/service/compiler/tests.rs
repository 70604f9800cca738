//! Who waits for a model that is made ready, and what that takes.

use tokio_util::sync::CancellationToken;

use super::*;
use crate::service::pool::tests::keep_all_threads;
use crate::service::{Caller, Name, PoolSettings, TimeLimits};

/// Longer than anything here takes; a test that waits for this fails.
const PATIENCE: Duration = Duration::from_secs(30);

fn settings(directory: &std::path::Path) -> Settings {
    Settings {
        database: directory.join("etude.db"),
        limits: Limits::DEFAULT,
        memory: Memory::with_room(64 << 20),
        model_cache_bytes: 1 << 20,
        session_idle_timeout: Duration::MAX,
        time_limits: TimeLimits::DEFAULT,
        clock: Clock::system(),
        ids: crate::clock::Ids::random(),
        pool: PoolSettings { n_threads: 1, max_waiting: 100, max_long: 1 },
    }
}

/// An application that has a model, and none at hand.
async fn cold(directory: &std::path::Path, tasks: &TaskTracker) -> Etude {
    let settings = settings(directory);
    let mut etude = Etude::open(&settings, tasks, CancellationToken::new()).await.unwrap();
    let world = ModelText::Whole(br#"{"dynamics": {"kind": "wumpus", "width": 4, "height": 4}}"#.to_vec());
    let caller = Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: jiff::Timestamp::UNIX_EPOCH };
    etude.put_model(&Name::new("world").unwrap(), world, Format::Json, caller).await.unwrap();
    etude.compiler.cache = Arc::new(MapperCache::new(settings.model_cache_bytes));
    etude
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_leaves_before_a_cold_model_is_ready_leaves_nothing_behind() {
    let (directory, tasks) = (tempfile::tempdir().unwrap(), TaskTracker::new());
    let etude = cold(directory.path(), &tasks).await;
    let kept = keep_all_threads(etude.pool()).await;
    let before = (tasks.len(), etude.pool().n_jobs());
    let mut others = Vec::new();
    for _ in 0..50 {
        let deadline = Some(Clock::system().instant());
        let place = etude.pool().admit_when_needed(Client::LOCAL).waiting_until(deadline);
        let left = etude.mapper("world", "/model", Some(&place), deadline).await;
        assert!(matches!(left, Err(ServiceError::Compiling { .. })), "{left:?}");
    }
    assert_eq!(etude.pool().n_jobs(), before.1 + 1, "one place for all");
    // One that compiles, and what that waits for.
    assert!(tasks.len() <= before.0 + 2, "{} and {before:?}", tasks.len());
    let asked = Asked::Exactly(etude.store.model_key("world").await.unwrap().unwrap());
    for _ in 0..10 {
        others.push(etude.compiler.begin("world", &asked, None));
    }
    drop(kept);
    let (_, mapper) =
        tokio::time::timeout(PATIENCE, etude.mapper("world", "/model", None, None)).await.unwrap().unwrap();
    for other in others {
        let mut other = other.unwrap();
        let ready = tokio::time::timeout(PATIENCE, other.wait_for(Option::is_some)).await.unwrap().unwrap();
        assert!(matches!(&*ready, Some(Ok((_, same))) if Arc::ptr_eq(same, &mapper)), "it is compiled once");
    }
    assert!(etude.compiler.coming().is_empty());
    etude.close().await;
}

#[tokio::test]
async fn an_error_of_compiling_is_told_to_all_who_wait_and_the_next_one_tries_again() {
    let (directory, tasks) = (tempfile::tempdir().unwrap(), TaskTracker::new());
    let etude = cold(directory.path(), &tasks).await;
    let memory = etude.memory().clone();
    let mut taken: Vec<Held> = [memory.free_for_large(), 1 << 20, 1 << 20, 1 << 20, 1 << 20, 1 << 20, 1 << 20, 1 << 20]
        .into_iter()
        .map(|most| memory.try_take(most).unwrap())
        .collect();
    taken.extend(std::iter::from_fn(|| memory.try_take(4096).ok()));
    let asking = || etude.mapper("world", "/model", None, None);
    let answers = tokio::join!(asking(), asking(), asking());
    for answer in [answers.0, answers.1, answers.2] {
        assert!(matches!(answer, Err(ServiceError::NoRoom(_))), "{answer:?}");
    }
    drop(taken);
    assert!(asking().await.is_ok());
    etude.close().await;
}

#[tokio::test]
async fn compiling_leaves_to_searches_half_of_what_is_free_beyond_what_was_counted() {
    const MIB: u64 = 1 << 20;
    let (directory, tasks) = (tempfile::tempdir().unwrap(), TaskTracker::new());
    let etude = cold(directory.path(), &tasks).await;
    let memory = etude.memory().clone();
    let free = memory.free_for_large();
    assert_eq!(free, 56 * MIB);
    for (counted, expected) in [(4 * MIB, 12 * MIB), (16 * MIB, 36 * MIB), (40 * MIB, 48 * MIB), (56 * MIB, 56 * MIB)] {
        assert_eq!(etude.compiler.take(counted).unwrap().n_bytes(), expected);
    }
    assert!(etude.compiler.take(57 * MIB).is_err());
    etude.close().await;
}
