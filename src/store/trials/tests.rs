//! What becomes of trials and rewards that come together, beside what becomes of them one after the other.

use std::collections::{BTreeMap, BTreeSet};

use futures_util::future::join_all;
use proptest::prelude::*;
use tokio_util::task::TaskTracker;

use super::*;
use crate::store::learners::{Fold, NewLearner, WeightsRecord};
use crate::store::{PolicyFilter, Registration, RequestKey};
use etude_core::learning::Distribution;

/// A trial to be opened, of one of three learners, the last of which is not there.
#[derive(Clone, Debug)]
struct Open {
    learner: usize,
    number: u64,
    key: Option<u8>,
}

/// Something that comes while nothing else does, or many that come together.
#[derive(Clone, Debug)]
enum Step {
    Open(Vec<Open>),
    /// Rewards of trials, by their place among all that were asked for.
    Reward(Vec<(usize, u8)>),
    Fail(usize),
    /// Both learners fold what there is.
    Fold,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let open = (0..7_usize, 1..20_u64, proptest::option::weighted(0.3, 0..4_u8));
    let open = open.prop_map(|(learner, number, key)| Open { learner: learner / 3, number, key });
    let step = prop_oneof![
        3 => proptest::collection::vec(open, 1..8).prop_map(Step::Open),
        4 => proptest::collection::vec((0..24_usize, 0..2_u8), 1..8).prop_map(Step::Reward),
        1 => (0..24_usize).prop_map(Step::Fail),
        1 => Just(Step::Fold),
    ];
    proptest::collection::vec(step, 1..20)
}

/// What the definition says that there is, written to be read.
#[derive(Debug, Default)]
struct Expected {
    /// Numbers that are taken, by learner.
    numbers: BTreeSet<(usize, u64)>,
    keys: BTreeSet<u8>,
    /// Ids of trials that were opened, with their learner.
    opened: BTreeMap<String, usize>,
    failed: BTreeSet<String>,
    /// Rewards, and their order, by id of their trial.
    rewards: BTreeMap<String, (f64, u64)>,
    /// By learner.
    n_rewards: [u64; 2],
}

impl Expected {
    fn open(&mut self, id: &str, open: &Open) -> Opened {
        if open.key.is_some_and(|key| self.keys.contains(&key)) {
            return Opened::KeyTaken;
        }
        if open.learner > 1 {
            return Opened::NoLearner;
        }
        if !self.numbers.insert((open.learner, open.number)) {
            return Opened::NumberTaken;
        }
        self.keys.extend(open.key);
        self.opened.insert(id.to_owned(), open.learner);
        Opened::Yes
    }

    fn reward(&mut self, id: &str, reward: f64) -> String {
        let Some(learner) = self.opened.get(id) else { return "unknown".to_owned() };
        if self.failed.contains(id) {
            return "failed".to_owned();
        }
        match self.rewards.get(id) {
            Some((existing, order)) if *existing == reward => format!("unchanged {order}"),
            Some((existing, _)) => format!("conflict {existing}"),
            None => {
                self.n_rewards[*learner] += 1;
                self.rewards.insert(id.to_owned(), (reward, self.n_rewards[*learner]));
                format!("accepted {}", self.n_rewards[*learner])
            }
        }
    }
}

fn short(answer: &RewardAnswer) -> String {
    let order = |trial: &TrialRecord| trial.reward.unwrap().reward_order;
    match answer {
        RewardAnswer::Accepted(trial) => format!("accepted {}", order(trial)),
        RewardAnswer::Unchanged(trial) => format!("unchanged {}", order(trial)),
        RewardAnswer::Conflict { existing } => format!("conflict {existing}"),
        RewardAnswer::Failed => "failed".to_owned(),
        RewardAnswer::Unknown => "unknown".to_owned(),
    }
}

async fn learner(store: &Store, name: &str) -> i64 {
    let Registration::Created(row) = store.register_learner(NewLearner::plain(name)).await.unwrap() else {
        panic!("it is new")
    };
    row.sequence
}

fn weights(version: u64, reward_order: u64) -> WeightsRecord {
    let distribution = Distribution { mean: vec![1.0], sd: vec![1.0], expected_reward: None };
    WeightsRecord { version, reward_order, distribution, updated_at: Timestamp::UNIX_EPOCH }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn trials_and_rewards_that_come_together_are_as_if_they_had_come_one_after_the_other(steps in steps()) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let directory = tempfile::tempdir().unwrap();
            let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
            let learners = [learner(&store, "a").await, learner(&store, "b").await, 99];
            let mut expected = Expected::default();
            let (mut ids, mut versions, mut folded) = (Vec::new(), [0; 2], [0; 2]);
            for step in steps {
                match step {
                    Step::Open(opens) => {
                        let mut asked = Vec::new();
                        let mut answers = Vec::new();
                        for open in opens {
                            let id = format!("t{}", ids.len());
                            answers.push(expected.open(&id, &open));
                            let key = open.key.map(|key| NewRequestKey {
                                key: RequestKey { scope: "trials".to_owned(), key: key.to_string() },
                                body_hash: String::new(),
                                at: Timestamp::UNIX_EPOCH,
                            });
                            let policy = Some(NewPolicy::plain(&id, "{}", Timestamp::UNIX_EPOCH));
                            let plain = NewTrial::plain(learners[open.learner], open.number);
                            asked.push(store.open_trial(NewTrial { id: id.clone(), policy_id: id.clone(), policy, key, ..plain }));
                            ids.push(id);
                        }
                        let opened: Vec<_> = join_all(asked).await.into_iter().map(Result::unwrap).collect();
                        prop_assert_eq!(opened, answers);
                    }
                    Step::Reward(rewards) => {
                        let rewards: Vec<_> = rewards.into_iter().map(|(place, reward)| (format!("t{place}"), f64::from(reward))).collect();
                        let answers: Vec<_> = rewards.iter().map(|(id, reward)| expected.reward(id, *reward)).collect();
                        let asked = rewards.into_iter().map(|(trial, reward)| {
                            store.accept_reward(NewReward { trial, reward, accepted_at: Timestamp::UNIX_EPOCH })
                        });
                        let accepted: Vec<_> = join_all(asked).await.iter().map(|answer| short(answer.as_ref().unwrap())).collect();
                        prop_assert_eq!(accepted, answers);
                        let behind = store.learners_behind().await.unwrap().len();
                        let expected_behind = (0..2).filter(|learner| expected.n_rewards[*learner] > folded[*learner]).count();
                        prop_assert_eq!(behind, expected_behind);
                    }
                    Step::Fail(place) => {
                        let id = format!("t{place}");
                        let answer = store.fail_trial(&id, None).await.unwrap();
                        if expected.opened.contains_key(&id) && !expected.rewards.contains_key(&id) {
                            prop_assert!(matches!(answer, FailureAnswer::Failed(_)));
                            expected.failed.insert(id);
                        }
                    }
                    Step::Fold => {
                        for learner in 0..2 {
                            let reward_order = expected.n_rewards[learner];
                            if reward_order > folded[learner] {
                                folded[learner] = reward_order;
                                versions[learner] += 1;
                                let weights = weights(versions[learner], reward_order);
                                let fold = store.fold_rewards(learners[learner], weights).await.unwrap();
                                prop_assert_eq!(fold, Fold::Added);
                            }
                        }
                    }
                }
            }
            let stored = store.policies(&PolicyFilter::default(), 0, 1000).await.unwrap().items;
            prop_assert_eq!(stored.len(), expected.opened.len(), "each opened trial has its policy, and no other one");
            for (id, learner) in &expected.opened {
                let trial = store.trial(id).await.unwrap().unwrap();
                prop_assert_eq!(trial.learner, ["a", "b"][*learner]);
                let reward = trial.reward.map(|reward| (reward.reward, reward.reward_order));
                prop_assert_eq!(reward, expected.rewards.get(id).copied());
            }
            Ok(())
        })?;
    }
}
