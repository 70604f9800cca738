//! The table of trials, and the log of rewards as it is written.

mod numbers;
mod verbs;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, Row};

use super::page::{Rest, Rows};
use super::{NewPolicy, NewRefinement, NewRequestKey, Page, Store, StoreError, as_integer, count, timestamp};
pub use numbers::NextNumber;
pub(super) use numbers::TrialNumbers;
use verbs::FailTrial;
pub(super) use verbs::{accept_all, accept_at_once, open_all};

/// A trial to be stored.
#[derive(Clone, Debug)]
pub struct NewTrial {
    /// Its id, unique.
    pub id: String,
    /// The sequence number of its learner.
    pub learner: i64,
    /// Counted from 1 per learner.
    pub number: u64,
    /// JSON: the weights as drawn, by attribute of the learner.
    pub weights: String,
    /// The version that they were drawn from.
    pub weights_version: u64,
    /// The id of the policy that they give.
    pub policy_id: String,
    /// That policy, unless it is still in the making.
    pub policy: Option<NewPolicy>,
    /// What is to be done about the policy, if it is local.
    pub refinement: Option<NewRefinement>,
    /// The key of the request for it, if that has one.
    pub key: Option<NewRequestKey>,
    /// When it is drawn.
    pub created_at: Timestamp,
    /// When it expires.
    pub lease_expires_at: Timestamp,
}

impl NewTrial {
    /// How many bytes there are to be written, roughly.
    pub(super) fn n_bytes(&self) -> usize {
        self.policy.as_ref().map_or(0, NewPolicy::n_bytes) + self.refinement.as_ref().map_or(0, NewRefinement::n_bytes)
    }
}

/// A reward to be accepted.
#[derive(Clone, Debug)]
pub struct NewReward {
    /// The id of the trial that earned it.
    pub trial: String,
    /// Finite.
    pub reward: f64,
    /// When it came.
    pub accepted_at: Timestamp,
}

/// A trial as it is stored.
#[derive(Clone, Debug, PartialEq)]
pub struct TrialRecord {
    /// The order in which it became durable.
    pub sequence: i64,
    /// Its id.
    pub id: String,
    /// The name of its learner.
    pub learner: String,
    /// Counted from 1 per learner.
    pub number: u64,
    /// JSON: the weights as drawn, by attribute of the learner.
    pub weights: String,
    /// The version that they were drawn from.
    pub weights_version: u64,
    /// The policy that they gave.
    pub policy_id: String,
    /// When it expires, or would have.
    pub lease_expires_at: Timestamp,
    /// Whether it ended without a reward, and why.
    pub failed: Option<Failure>,
    /// What it earned, if anything.
    pub reward: Option<AcceptedReward>,
    /// The version of the weights that folded its reward in.
    pub learned_version: Option<u64>,
}

/// The end of a trial without a reward.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// Why, in the client's words.
    pub reason: Option<String>,
}

/// A reward in the log.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AcceptedReward {
    /// The reward.
    pub reward: f64,
    /// Counted from 1 per learner, in the order of acceptance.
    pub reward_order: u64,
}

/// What can become of a trial.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrialStatus {
    /// A reward is awaited.
    Active,
    /// It has a reward, which is not folded into the weights yet.
    Rewarded,
    /// Its reward is folded into the weights.
    Learned,
    /// It ended without a reward.
    Failed,
    /// Its lease is over; a late reward is still accepted.
    Expired,
}

impl TrialStatus {
    /// Every status.
    pub const ALL: [Self; 5] = [Self::Active, Self::Rewarded, Self::Learned, Self::Failed, Self::Expired];

    /// The status, as in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Active => "active",
            Self::Rewarded => "rewarded",
            Self::Learned => "learned",
            Self::Failed => "failed",
            Self::Expired => "expired",
        }
    }

    /// The same as [`TrialRecord::status`], in SQL; `$4` is now.
    fn condition(self) -> &'static str {
        match self {
            Self::Active => "t.is_failed = 0 AND r.reward_order IS NULL AND t.lease_expires_at_ms > $4",
            Self::Expired => "t.is_failed = 0 AND r.reward_order IS NULL AND t.lease_expires_at_ms <= $4",
            Self::Failed => "t.is_failed = 1",
            Self::Rewarded => {
                "r.reward_order > (SELECT MAX(w.reward_order) FROM weights w WHERE w.learner = t.learner)"
            }
            Self::Learned => {
                "r.reward_order <= (SELECT MAX(w.reward_order) FROM weights w WHERE w.learner = t.learner)"
            }
        }
    }
}

impl TrialRecord {
    /// What has become of it by `now`.
    #[must_use]
    pub fn status(&self, now: Timestamp) -> TrialStatus {
        match (&self.failed, &self.reward, self.learned_version) {
            (Some(_), ..) => TrialStatus::Failed,
            (None, Some(_), Some(_)) => TrialStatus::Learned,
            (None, Some(_), None) => TrialStatus::Rewarded,
            (None, None, _) if self.lease_expires_at <= now => TrialStatus::Expired,
            (None, None, _) => TrialStatus::Active,
        }
    }
}

/// What became of a trial, or of a session that explores one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Opened {
    /// It is open.
    Yes,
    /// The learner is gone.
    NoLearner,
    /// Another trial of the learner has its number: it was drawn for nothing. The next numbers come after those that are stored.
    NumberTaken,
    /// The key of the request is another one's, which was answered.
    KeyTaken,
}

/// What became of a reward.
#[derive(Clone, Debug, PartialEq)]
pub enum RewardAnswer {
    /// It is the trial's now.
    Accepted(TrialRecord),
    /// It was the trial's already.
    Unchanged(TrialRecord),
    /// The trial has another one, which was left alone.
    Conflict {
        /// The one it has.
        existing: f64,
    },
    /// The trial has failed.
    Failed,
    /// There is no such trial.
    Unknown,
}

/// What became of an attempt to end a trial without a reward.
#[derive(Clone, Debug, PartialEq)]
pub enum FailureAnswer {
    /// It has failed, now or before for the same reason.
    Failed(TrialRecord),
    /// It had failed for another reason, which was left alone.
    Conflict {
        /// The one it has.
        existing: Option<String>,
    },
    /// It has a reward.
    Rewarded {
        /// The one it has.
        existing: f64,
    },
    /// There is no such trial.
    Unknown,
}

impl Store {
    /// Numbers for the next trials of a learner, which no trial has that is stored or was deleted.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn trial_numbers(&self, learner: i64) -> Result<NextNumber, StoreError> {
        if let Some(known) = self.trial_numbers.known(learner) {
            return Ok(known);
        }
        let query = sqlx::query(
            "SELECT MAX(deleted_number, (SELECT COALESCE(MAX(number), 0) FROM trials WHERE learner = $1)) AS number
             FROM learners WHERE sequence = $1",
        );
        let row = query.bind(learner).fetch_optional(&mut *self.reader().await?).await?;
        let last = row.map_or(Ok(0), |row| count(&row, "trials", "number"))?;
        Ok(self.trial_numbers.after(learner, last))
    }

    /// Stores a trial and its policy.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn open_trial(&self, trial: NewTrial) -> Result<Opened, StoreError> {
        let learner = trial.learner;
        let opened = self.writer.open_trial(trial).await?;
        if opened == Opened::NumberTaken {
            self.trial_numbers.forget(learner);
        }
        Ok(opened)
    }

    /// Accepts a reward, unless the trial has one.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn accept_reward(&self, reward: NewReward) -> Result<RewardAnswer, StoreError> {
        self.writer.accept_reward(reward).await
    }

    /// Ends a trial without a reward.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn fail_trial(&self, id: &str, reason: Option<String>) -> Result<FailureAnswer, StoreError> {
        self.writer.write(FailTrial { id: id.to_owned(), reason }).await
    }

    /// The trial with this id.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn trial(&self, id: &str) -> Result<Option<TrialRecord>, StoreError> {
        let query = sqlx::query(AssertSqlSafe(format!("{SELECT} {FROM} WHERE t.id = $1"))).bind(id);
        query.fetch_optional(&mut *self.reader().await?).await?.map(|row| read_trial(&row)).transpose()
    }

    /// At most `limit` trials of a learner with the given status by `now`, in the order of their numbers, from the first
    /// after `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn trials(
        &self,
        learner: i64,
        status: Option<TrialStatus>,
        now: Timestamp,
        after: u64,
        limit: u32,
    ) -> Result<Page<TrialRecord>, StoreError> {
        let condition = status.map_or("TRUE", TrialStatus::condition);
        let query = sqlx::query(AssertSqlSafe(format!(
            "{SELECT} {FROM} WHERE t.learner = $1 AND t.number > $2 AND {condition} ORDER BY t.number LIMIT $3"
        )));
        let query = query.bind(learner).bind(as_integer(after)).bind(i64::from(limit) + 1).bind(now.as_millisecond());
        let mut reader = self.reader().await?;
        let rows = query.fetch(&mut *reader);
        Rows { table: "trials", key: "number", name: "id", long: &["weights", "fail_reason"], read: read_trial }
            .page(rows, limit, Rest::IsNone)
            .await
    }
}

const SELECT: &str = "
    SELECT t.sequence, t.id, t.number, t.weights, t.weights_version, t.policy_id, t.lease_expires_at_ms, t.is_failed,
           t.fail_reason, l.name AS learner_name, r.reward, r.reward_order,
           (SELECT w.version FROM weights w WHERE w.learner = t.learner AND w.reward_order >= r.reward_order
            ORDER BY w.reward_order LIMIT 1) AS learned_version";

const FROM: &str = "
    FROM trials t JOIN learners l ON l.sequence = t.learner LEFT JOIN rewards r ON r.trial = t.sequence";

fn read_trial(row: &SqliteRow) -> Result<TrialRecord, StoreError> {
    const TABLE: &str = "trials";
    let reward: Option<f64> = row.try_get("reward")?;
    let reward = match reward {
        Some(reward) => Some(AcceptedReward { reward, reward_order: count(row, "rewards", "reward_order")? }),
        None => None,
    };
    let learned: Option<i64> = row.try_get("learned_version")?;
    let is_failed: i64 = row.try_get("is_failed")?;
    let failed = if is_failed == 0 { None } else { Some(Failure { reason: row.try_get("fail_reason")? }) };
    Ok(TrialRecord {
        weights: row.try_get("weights")?,
        sequence: row.try_get("sequence")?,
        id: row.try_get("id")?,
        learner: row.try_get("learner_name")?,
        number: count(row, TABLE, "number")?,
        weights_version: count(row, TABLE, "weights_version")?,
        policy_id: row.try_get("policy_id")?,
        lease_expires_at: timestamp(TABLE, "lease_expires_at_ms", row.try_get("lease_expires_at_ms")?)?,
        failed,
        reward,
        learned_version: learned.is_some().then(|| count(row, "weights", "learned_version")).transpose()?,
    })
}

#[cfg(test)]
impl NewTrial {
    /// The trial of this number of this learner, whose id is made of both, without a policy.
    pub(in crate::store) fn plain(learner: i64, number: u64) -> Self {
        let id = format!("{learner}-{number}");
        Self {
            id: id.clone(),
            learner,
            number,
            weights: "{\"x\":1.0}".to_owned(),
            weights_version: 0,
            policy_id: id,
            policy: None,
            refinement: None,
            key: None,
            created_at: Timestamp::UNIX_EPOCH,
            lease_expires_at: Timestamp::UNIX_EPOCH,
        }
    }
}

#[cfg(test)]
mod tests;
