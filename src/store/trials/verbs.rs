//! How the table of trials and the log of rewards are written.

use std::collections::{BTreeMap, BTreeSet};

use rustc_hash::{FxHashMap, FxHashSet};
use sqlx::{AssertSqlSafe, QueryBuilder, Row, SqliteConnection};

use super::{
    AcceptedReward, FROM, Failure, FailureAnswer, NewReward, NewTrial, Opened, RewardAnswer, SELECT, TrialRecord,
    read_trial,
};
use crate::store::policies::{NewPolicy, NewRefinement};
use crate::store::writer::{Verb, Writing};
use crate::store::{StoreError, as_integer, corrupt, count, learners, policies, refinements, request_keys};

impl Verb for NewTrial {
    type Answer = Opened;

    fn n_bytes(&self) -> usize {
        self.policy.as_ref().map_or(0, NewPolicy::n_bytes) + self.refinement.as_ref().map_or(0, NewRefinement::n_bytes)
    }

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Opened, StoreError> {
        open(writing.connection, self).await
    }
}

/// Stores a trial and its policy, and the key of the request for it.
pub(in crate::store) async fn open(connection: &mut SqliteConnection, trial: &NewTrial) -> Result<Opened, StoreError> {
    if let Some(key) = &trial.key
        && request_keys::add(connection, key, &trial.id).await?.is_err()
    {
        return Ok(Opened::KeyTaken);
    }
    let inserted = sqlx::query(
        "INSERT INTO trials
             (id, learner, number, weights, weights_version, policy_id, lease_expires_at_ms, created_at_ms)
         SELECT $1, sequence, $3, $4, $5, $6, $7, $8 FROM learners WHERE sequence = $2
         ON CONFLICT (learner, number) DO NOTHING",
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
        if trial.key.is_some() {
            request_keys::forget(connection, &trial.id).await?;
        }
        let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM learners WHERE sequence = $1)");
        let has_learner = query.bind(trial.learner).fetch_one(connection).await?;
        return Ok(if has_learner { Opened::NumberTaken } else { Opened::NoLearner });
    }
    if let Some(policy) = &trial.policy {
        policies::add(connection, policy).await?;
    }
    if let Some(refinement) = &trial.refinement {
        refinements::add(connection, refinement).await?;
    }
    Ok(Opened::Yes)
}

/// Ends a trial without a reward.
#[derive(Debug)]
pub(super) struct FailTrial {
    pub(super) id: String,
    pub(super) reason: Option<String>,
}

impl Verb for FailTrial {
    type Answer = FailureAnswer;

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<FailureAnswer, StoreError> {
        let (id, reason) = (self.id.as_str(), self.reason.as_deref());
        let query = sqlx::query(AssertSqlSafe(format!("{SELECT} {FROM} WHERE t.id = $1"))).bind(id);
        let Some(row) = query.fetch_optional(&mut *writing.connection).await? else {
            return Ok(FailureAnswer::Unknown);
        };
        let mut trial = read_trial(&row)?;
        if let Some(AcceptedReward { reward, .. }) = trial.reward {
            return Ok(FailureAnswer::Rewarded { existing: reward });
        }
        match trial.failed {
            Some(Failure { reason: existing }) if existing.as_deref() != reason => {
                return Ok(FailureAnswer::Conflict { existing });
            }
            Some(_) => {}
            None => {
                let query = sqlx::query("UPDATE trials SET is_failed = 1, fail_reason = $2 WHERE sequence = $1");
                query.bind(trial.sequence).bind(reason).execute(&mut *writing.connection).await?;
            }
        }
        trial.failed = Some(Failure { reason: reason.map(str::to_owned) });
        Ok(FailureAnswer::Failed(trial))
    }
}

/// Accepts rewards, in order. Takes two statements, however many there are, and another one if a learner is not yet among those that
/// are marked as having rewards to fold, `pending`.
pub(in crate::store) async fn accept_all(
    connection: &mut SqliteConnection,
    rewards: &[&NewReward],
    pending: &mut FxHashSet<i64>,
) -> Result<Vec<RewardAnswer>, StoreError> {
    let mut read = read_rewarded(connection, rewards).await?;
    let mut accepted = Vec::with_capacity(rewards.len());
    let mut put = Vec::with_capacity(rewards.len());
    for new in rewards {
        let Some(found) = read.trials.get_mut(new.trial.as_str()) else {
            put.push(RewardAnswer::Unknown);
            continue;
        };
        put.push(match (&found.row.failed, found.row.reward) {
            (Some(_), _) => RewardAnswer::Failed,
            (None, Some(AcceptedReward { reward, .. })) if reward == new.reward => {
                RewardAnswer::Unchanged(found.row.clone())
            }
            (None, Some(AcceptedReward { reward, .. })) => RewardAnswer::Conflict { existing: reward },
            (None, None) => {
                let last = read.last_orders.entry(found.learner).or_insert(0);
                *last += 1;
                found.row.reward = Some(AcceptedReward { reward: new.reward, reward_order: *last });
                accepted.push((found.learner, *last, found.row.sequence, new));
                RewardAnswer::Accepted(found.row.clone())
            }
        });
    }
    if !accepted.is_empty() {
        let new: BTreeSet<i64> =
            accepted.iter().map(|(learner, ..)| *learner).filter(|id| !pending.contains(id)).collect();
        if !new.is_empty() {
            let ids = serde_json::to_string(&new).map_err(corrupt("learners", "sequence"))?;
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
    row: TrialRecord,
}

async fn read_rewarded(connection: &mut SqliteConnection, rewards: &[&NewReward]) -> Result<Rewarded, StoreError> {
    let ids: Vec<&str> = rewards.iter().map(|new| new.trial.as_str()).collect();
    let ids = serde_json::to_string(&ids).map_err(corrupt("trials", "id"))?;
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
