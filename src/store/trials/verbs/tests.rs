//! When rewards need no transaction.

use sqlx::Connection;
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::learners::NewLearner;
use crate::store::{Registration, Store};

#[tokio::test]
async fn rewards_need_no_transaction_once_their_learner_is_marked_unless_others_write_meanwhile() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
    let Registration::Created(learner) = store.register_learner(NewLearner::plain("a")).await.unwrap() else {
        panic!("it is new")
    };
    let learner = learner.sequence;
    for number in 1..=5 {
        store.open_trial(NewTrial::plain(learner, number)).await.unwrap();
    }
    let reward = |number: u64, reward: f64| NewReward {
        trial: format!("{learner}-{number}"),
        reward,
        accepted_at: Timestamp::UNIX_EPOCH,
    };
    let connect = || async { SqliteConnection::connect(path.to_str().unwrap()).await.unwrap() };
    let (mut connection, mut other) = (connect().await, connect().await);
    let (first, second) = (reward(1, 0.1), reward(2, 0.2));
    assert_eq!(accept_at_once(&mut connection, &[&first]).await.unwrap(), None);
    assert_eq!(store.trial(&first.trial).await.unwrap().unwrap().reward, None, "nothing was done");
    let statements = &mut Statements::on(&mut connection);
    learners::mark_pending(statements, &format!("[{learner}]"));
    statements.run().await.unwrap();
    let answers = accept_at_once(&mut connection, &[&second, &first]).await.unwrap().unwrap();
    assert!(answers.iter().all(|answer| matches!(answer, RewardAnswer::Accepted(_))), "{answers:?}");
    let stored = store.trial(&first.trial).await.unwrap().unwrap().reward.unwrap();
    assert_eq!((stored.reward.to_bits(), stored.reward_order), (0.1_f64.to_bits(), 2));

    let third = reward(3, 0.3);
    let decided = read_rewarded(&mut Statements::on(&mut connection), &[&third]).await.unwrap().decide(&[&third]);
    sqlx::query("UPDATE trials SET is_failed = 1 WHERE number = 3").execute(&mut other).await.unwrap();
    let statements = &mut Statements::on(&mut connection);
    decided.insert(statements);
    assert_eq!(statements.run().await.unwrap(), 0);
    assert_eq!(store.trial(&third.trial).await.unwrap().unwrap().reward, None);
    let answers = accept_at_once(&mut connection, &[&third]).await.unwrap().unwrap();
    assert_eq!(answers, [RewardAnswer::Failed]);

    // Whether a learner is marked is looked at each time, as others may have folded.
    for number in [4, 5] {
        sqlx::query("UPDATE learners SET has_pending = 0").execute(&mut other).await.unwrap();
        let answer = store.accept_reward(reward(number, 0.4)).await.unwrap();
        assert!(matches!(answer, RewardAnswer::Accepted(_)), "{answer:?}");
        assert_eq!(store.learners_behind().await.unwrap(), ["a"]);
    }
}
