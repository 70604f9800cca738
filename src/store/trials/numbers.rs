//! The numbers of trials that are being made.
//!
//! A trial is drawn by its number before it is stored. The database decides whose a number is, when it stores the trial; memory only
//! keeps the trials that are made at the same time from drawing by the same one. A number that was given out, and whose trial was not
//! stored, was never seen outside, and may be given out again after a restart.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use rustc_hash::FxHashMap;

/// The last number that was given out, by learner.
#[derive(Debug, Default)]
pub(in crate::store) struct TrialNumbers {
    last: Mutex<FxHashMap<i64, NextNumber>>,
}

/// Gives out numbers for the trials of a learner.
#[derive(Clone, Debug)]
pub struct NextNumber(Arc<AtomicU64>);

impl NextNumber {
    /// A number that was not given out before.
    #[must_use]
    pub fn take(&self) -> u64 {
        self.0.fetch_add(1, Ordering::Relaxed) + 1
    }
}

impl TrialNumbers {
    /// The numbers of this learner, if some were given out.
    pub(super) fn known(&self, learner: i64) -> Option<NextNumber> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).get(&learner).cloned()
    }

    /// The numbers of this learner after the last one that is stored.
    pub(super) fn after(&self, learner: i64, stored: u64) -> NextNumber {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        // Another request may have been faster, and have given out a number already.
        last.entry(learner).or_insert_with(|| NextNumber(Arc::new(AtomicU64::new(stored)))).clone()
    }

    /// Forgets a learner that was deleted, or whose numbers somebody else has given out too.
    pub(in crate::store) fn forget(&self, learner: i64) {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).remove(&learner);
    }
}

#[cfg(test)]
mod tests {
    use etude_core::learning::Distribution;
    use jiff::Timestamp;
    use tokio_util::task::TaskTracker;

    use crate::store::{NewLearner, NewTrial, Opened, Registration, Store};

    fn trial(id: &str, learner: i64, number: u64) -> NewTrial {
        NewTrial {
            id: id.to_owned(),
            learner,
            number,
            weights: "{}".to_owned(),
            weights_version: 0,
            policy_id: id.to_owned(),
            policy: None,
            refinement: None,
            key: None,
            created_at: Timestamp::UNIX_EPOCH,
            lease_expires_at: Timestamp::UNIX_EPOCH,
        }
    }

    #[tokio::test]
    async fn of_two_trials_with_a_number_one_is_stored_and_the_other_side_goes_on_behind_it() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("etude.db");
        let tasks = TaskTracker::new();
        let (a, b) = (Store::open(&path, &tasks).await.unwrap(), Store::open(&path, &tasks).await.unwrap());
        let new = NewLearner {
            name: "l".to_owned(),
            hash: String::new(),
            definition: "{}".to_owned(),
            initial: Distribution { mean: Vec::new(), sd: Vec::new(), expected_reward: None },
            created_at: Timestamp::UNIX_EPOCH,
        };
        let Registration::Created(learner) = a.register_learner(new).await.unwrap() else { panic!("it is new") };
        let learner = learner.sequence;
        let (of_a, of_b) = (a.trial_numbers(learner).await.unwrap(), b.trial_numbers(learner).await.unwrap());
        assert_eq!((of_a.take(), of_a.take(), of_b.take()), (1, 2, 1));
        for number in [1, 2] {
            assert_eq!(a.open_trial(trial(&number.to_string(), learner, number)).await.unwrap(), Opened::Yes);
        }
        assert_eq!(b.open_trial(trial("b", learner, 1)).await.unwrap(), Opened::NumberTaken);
        assert!(b.trial("b").await.unwrap().is_none());
        assert_eq!(b.trial_numbers(learner).await.unwrap().take(), 3);
        assert_eq!(b.open_trial(trial("gone", learner + 1, 1)).await.unwrap(), Opened::NoLearner);
    }
}
