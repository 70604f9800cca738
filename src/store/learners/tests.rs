//! Which learners are behind.

use sqlx::AssertSqlSafe;
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::{NewReward, NewTrial, Opened, RewardAnswer};

async fn learner(store: &Store, name: &str) -> i64 {
    let Registration::Created(row) = store.register_learner(NewLearner::plain(name)).await.unwrap() else {
        panic!("it is new")
    };
    row.sequence
}

async fn reward(store: &Store, learner: i64, number: u64) {
    let trial = NewTrial::plain(learner, number);
    let id = trial.id.clone();
    assert_eq!(store.open_trial(trial).await.unwrap(), Opened::Yes);
    let put = store.accept_reward(NewReward { trial: id, reward: 1.0, accepted_at: Timestamp::UNIX_EPOCH }).await;
    assert!(matches!(put.unwrap(), RewardAnswer::Accepted(_)));
}

async fn fold(store: &Store, learner: i64, version: u64, reward_order: u64) {
    let distribution = Distribution { mean: vec![1.0], sd: vec![1.0], expected_reward: None };
    let weights = WeightsRecord { version, reward_order, distribution, updated_at: Timestamp::UNIX_EPOCH };
    assert_eq!(store.fold_rewards(learner, weights).await.unwrap(), Fold::Added);
}

#[tokio::test]
async fn a_learner_is_behind_from_its_first_reward_to_the_fold_of_the_last_one() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
    let (a, b) = (learner(&store, "a").await, learner(&store, "b").await);
    assert_eq!(store.learners_behind().await.unwrap(), Vec::<String>::new());
    reward(&store, a, 1).await;
    reward(&store, b, 1).await;
    reward(&store, b, 2).await;
    assert_eq!(store.learners_behind().await.unwrap(), ["a", "b"]);
    // A reward has come since the fold was begun.
    fold(&store, a, 1, 1).await;
    fold(&store, b, 1, 1).await;
    assert_eq!(store.learners_behind().await.unwrap(), ["b"]);
    fold(&store, b, 2, 2).await;
    assert_eq!(store.learners_behind().await.unwrap(), Vec::<String>::new());
    // After an error, nothing is known of who is marked.
    reward(&store, b, 3).await;
    assert!(
        store.open_trial(NewTrial { id: format!("{a}-1"), ..NewTrial::plain(a, 99) }).await.is_err(),
        "its id is taken"
    );
    fold(&store, b, 3, 3).await;
    reward(&store, b, 4).await;
    drop(store);
    let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
    assert_eq!(store.learners_behind().await.unwrap(), ["b"]);
    reward(&store, b, 5).await;
    fold(&store, b, 4, 5).await;
    assert_eq!(store.learners_behind().await.unwrap(), Vec::<String>::new());
}

/// However many there are, the index only has those that are behind.
#[tokio::test]
async fn who_is_behind_is_looked_up_in_an_index_that_nobody_else_is_in() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    let plan = sqlx::query(AssertSqlSafe(format!("EXPLAIN QUERY PLAN {BEHIND}")));
    let plan = plan.fetch_all(&mut *store.reader().await.unwrap()).await.unwrap();
    let plan: Vec<String> = plan.iter().map(|row| row.get("detail")).collect();
    assert_eq!(plan, ["SCAN learners USING INDEX learners_with_pending"]);
    let index: String = sqlx::query_scalar("SELECT sql FROM sqlite_schema WHERE name = 'learners_with_pending'")
        .fetch_one(&mut *store.reader().await.unwrap())
        .await
        .unwrap();
    assert!(index.ends_with("WHERE has_pending = 1"), "{index}");
}
