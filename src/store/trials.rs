//! The table of trials, and the log of rewards as it is written.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use rustc_hash::{FxHashMap, FxHashSet};
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, QueryBuilder, Row, SqliteConnection};

use super::page::{Rest, Rows};
use super::writer::{Write, Written};
use super::{
    NewPolicy, NewRefinement, Page, Store, StoreError, as_integer, count, learners, policies, refinements, timestamp,
};

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
    /// When it is drawn.
    pub created_at: Timestamp,
    /// When it expires.
    pub lease_expires_at: Timestamp,
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
pub struct TrialRow {
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

    /// The same as [`TrialRow::status`], in SQL; `$4` is now.
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

impl TrialRow {
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

/// What became of a reward.
#[derive(Clone, Debug, PartialEq)]
pub enum PutReward {
    /// It is the trial's now.
    Accepted(TrialRow),
    /// It was the trial's already.
    Unchanged(TrialRow),
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
pub enum FailTrial {
    /// It has failed, now or before for the same reason.
    Failed(TrialRow),
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
    /// Stores a trial and its policy. Says whether it did: not if the learner is gone.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_trial(&self, trial: NewTrial) -> Result<bool, StoreError> {
        match self.writer.write(Write::AddTrial(Box::new(trial))).await? {
            Written::AddTrial(added) => Ok(added),
            _ => Err(StoreError::Closed),
        }
    }

    /// Accepts a reward, unless the trial has one.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn put_reward(&self, reward: NewReward) -> Result<PutReward, StoreError> {
        match self.writer.write(Write::PutReward(reward)).await? {
            Written::PutReward(put) => Ok(*put),
            _ => Err(StoreError::Closed),
        }
    }

    /// Ends a trial without a reward.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn fail_trial(&self, id: &str, reason: Option<String>) -> Result<FailTrial, StoreError> {
        match self.writer.write(Write::FailTrial { id: id.to_owned(), reason }).await? {
            Written::FailTrial(failed) => Ok(*failed),
            _ => Err(StoreError::Closed),
        }
    }

    /// The trial with this id.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn trial(&self, id: &str) -> Result<Option<TrialRow>, StoreError> {
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
    ) -> Result<Page<TrialRow>, StoreError> {
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

    /// The largest number of a trial of a learner; 0 if there is none.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn last_trial_number(&self, learner: i64) -> Result<u64, StoreError> {
        let query = sqlx::query("SELECT COALESCE(MAX(number), 0) AS number FROM trials WHERE learner = $1");
        count(&query.bind(learner).fetch_one(&mut *self.reader().await?).await?, "trials", "number")
    }
}

const SELECT: &str = "
    SELECT t.sequence, t.id, t.number, t.weights, t.weights_version, t.policy_id, t.lease_expires_at_ms, t.is_failed,
           t.fail_reason, l.name AS learner_name, r.reward, r.reward_order,
           (SELECT w.version FROM weights w WHERE w.learner = t.learner AND w.reward_order >= r.reward_order
            ORDER BY w.reward_order LIMIT 1) AS learned_version";

const FROM: &str = "
    FROM trials t JOIN learners l ON l.sequence = t.learner LEFT JOIN rewards r ON r.trial = t.sequence";

fn read_trial(row: &SqliteRow) -> Result<TrialRow, StoreError> {
    const TABLE: &str = "trials";
    let reward: Option<f64> = row.try_get("reward")?;
    let reward = match reward {
        Some(reward) => Some(AcceptedReward { reward, reward_order: count(row, "rewards", "reward_order")? }),
        None => None,
    };
    let learned: Option<i64> = row.try_get("learned_version")?;
    let is_failed: i64 = row.try_get("is_failed")?;
    let failed = if is_failed == 0 { None } else { Some(Failure { reason: row.try_get("fail_reason")? }) };
    Ok(TrialRow {
        sequence: row.try_get("sequence")?,
        id: row.try_get("id")?,
        learner: row.try_get("learner_name")?,
        number: count(row, TABLE, "number")?,
        weights: row.try_get("weights")?,
        weights_version: count(row, TABLE, "weights_version")?,
        policy_id: row.try_get("policy_id")?,
        lease_expires_at: timestamp(TABLE, "lease_expires_at_ms", row.try_get("lease_expires_at_ms")?)?,
        failed,
        reward,
        learned_version: learned.is_some().then(|| count(row, "weights", "learned_version")).transpose()?,
    })
}

pub(super) async fn add(connection: &mut SqliteConnection, trial: &NewTrial) -> Result<bool, StoreError> {
    let inserted = sqlx::query(
        "INSERT INTO trials
             (id, learner, number, weights, weights_version, policy_id, lease_expires_at_ms, created_at_ms)
         SELECT $1, sequence, $3, $4, $5, $6, $7, $8 FROM learners WHERE sequence = $2",
    )
    .bind(&trial.id)
    .bind(trial.learner)
    .bind(as_integer(trial.number))
    .bind(&trial.weights)
    .bind(as_integer(trial.weights_version))
    .bind(&trial.policy_id)
    .bind(trial.lease_expires_at.as_millisecond())
    .bind(trial.created_at.as_millisecond())
    .execute(&mut *connection)
    .await?;
    if inserted.rows_affected() == 0 {
        return Ok(false);
    }
    if let Some(policy) = &trial.policy {
        policies::add(connection, policy).await?;
    }
    if let Some(refinement) = &trial.refinement {
        refinements::add(connection, refinement).await?;
    }
    Ok(true)
}

pub(super) async fn fail(
    connection: &mut SqliteConnection,
    id: &str,
    reason: Option<&str>,
) -> Result<FailTrial, StoreError> {
    let query = sqlx::query(AssertSqlSafe(format!("{SELECT} {FROM} WHERE t.id = $1"))).bind(id);
    let Some(row) = query.fetch_optional(&mut *connection).await? else { return Ok(FailTrial::Unknown) };
    let mut trial = read_trial(&row)?;
    if let Some(AcceptedReward { reward, .. }) = trial.reward {
        return Ok(FailTrial::Rewarded { existing: reward });
    }
    match trial.failed {
        Some(Failure { reason: existing }) if existing.as_deref() != reason => {
            return Ok(FailTrial::Conflict { existing });
        }
        Some(_) => {}
        None => {
            let query = sqlx::query("UPDATE trials SET is_failed = 1, fail_reason = $2 WHERE sequence = $1");
            query.bind(trial.sequence).bind(reason).execute(connection).await?;
        }
    }
    trial.failed = Some(Failure { reason: reason.map(str::to_owned) });
    Ok(FailTrial::Failed(trial))
}

/// Accepts rewards, in order. Takes two statements, however many there are, and another one if a learner is not yet among those that
/// are marked as having rewards to fold, `pending`.
pub(super) async fn reward_all(
    connection: &mut SqliteConnection,
    rewards: &[&NewReward],
    pending: &mut FxHashSet<i64>,
) -> Result<Vec<PutReward>, StoreError> {
    let mut read = read_rewarded(connection, rewards).await?;
    let mut accepted = Vec::with_capacity(rewards.len());
    let mut put = Vec::with_capacity(rewards.len());
    for new in rewards {
        let Some(found) = read.trials.get_mut(new.trial.as_str()) else {
            put.push(PutReward::Unknown);
            continue;
        };
        put.push(match (&found.row.failed, found.row.reward) {
            (Some(_), _) => PutReward::Failed,
            (None, Some(AcceptedReward { reward, .. })) if reward == new.reward => {
                PutReward::Unchanged(found.row.clone())
            }
            (None, Some(AcceptedReward { reward, .. })) => PutReward::Conflict { existing: reward },
            (None, None) => {
                let last = read.last_orders.entry(found.learner).or_insert(0);
                *last += 1;
                found.row.reward = Some(AcceptedReward { reward: new.reward, reward_order: *last });
                accepted.push((found.learner, *last, found.row.sequence, new));
                PutReward::Accepted(found.row.clone())
            }
        });
    }
    if !accepted.is_empty() {
        let new: BTreeSet<i64> =
            accepted.iter().map(|(learner, ..)| *learner).filter(|id| !pending.contains(id)).collect();
        if !new.is_empty() {
            let ids = serde_json::to_string(&new).map_err(super::corrupt("learners", "sequence"))?;
            learners::mark_pending(connection, &ids).await?;
            pending.extend(new);
        }
        let mut insert =
            QueryBuilder::new("INSERT INTO rewards (learner, reward_order, trial, reward, accepted_at_ms) ");
        insert.push_values(accepted, |mut row, (learner, order, trial, new)| {
            row.push_bind(learner).push_bind(as_integer(order)).push_bind(trial).push_bind(new.reward);
            row.push_bind(new.accepted_at.as_millisecond());
        });
        insert.build().execute(connection).await?;
    }
    Ok(put)
}

/// The trials that rewards are for, as they are before any of these.
struct Rewarded {
    trials: FxHashMap<String, Found>,
    /// By learner, the order of the last reward.
    last_orders: BTreeMap<i64, u64>,
}

struct Found {
    learner: i64,
    row: TrialRow,
}

async fn read_rewarded(connection: &mut SqliteConnection, rewards: &[&NewReward]) -> Result<Rewarded, StoreError> {
    let ids: Vec<&str> = rewards.iter().map(|new| new.trial.as_str()).collect();
    let ids = serde_json::to_string(&ids).map_err(super::corrupt("trials", "id"))?;
    // `CROSS JOIN` makes SQLite look trials up by id, rather than ids up by trial.
    let query = sqlx::query(AssertSqlSafe(format!(
        "{SELECT}, t.learner,
             (SELECT MAX(last.reward_order) FROM rewards last WHERE last.learner = t.learner) AS last_order
         FROM json_each($1) wanted CROSS JOIN trials t ON t.id = wanted.value
             JOIN learners l ON l.sequence = t.learner LEFT JOIN rewards r ON r.trial = t.sequence"
    )));
    let mut read = Rewarded { trials: FxHashMap::default(), last_orders: BTreeMap::new() };
    for row in query.bind(ids).fetch_all(connection).await? {
        let learner = row.try_get("learner")?;
        let last: Option<i64> = row.try_get("last_order")?;
        if last.is_some() {
            read.last_orders.insert(learner, count(&row, "rewards", "last_order")?);
        }
        let row = read_trial(&row)?;
        read.trials.insert(row.id.clone(), Found { learner, row });
    }
    Ok(read)
}
