//! How the table of trials and the log of rewards are written.

use std::collections::{BTreeMap, BTreeSet};

use jiff::Timestamp;
use rustc_hash::{FxHashMap, FxHashSet};
use sqlx::{AssertSqlSafe, Row, SqliteConnection};

use super::{
    AcceptedReward, FROM, Failure, FailureAnswer, NewReward, NewTrial, Opened, RewardAnswer, SELECT, TrialRecord,
    read_trial,
};
use crate::store::statements::Statements;
use crate::store::writer::{Verb, Writing};
use crate::store::{StoreError, as_integer, corrupt, count, learners, policies, refinements, request_keys};

/// Stores trials and their policies, in order, and the keys of the requests for them, within a transaction. Takes one execution for all without
/// a key that come one after the other, and more for those that have one or are refused.
pub(in crate::store) async fn open_all(
    statements: &mut Statements<'_>,
    trials: &[&NewTrial],
) -> Result<Vec<Opened>, StoreError> {
    let mut answers = Vec::with_capacity(trials.len());
    // A key of one that is refused is free for the next.
    for together in trials.chunk_by(|one, next| one.key.is_none() && next.key.is_none()) {
        if let [trial] = together
            && let Some(key) = &trial.key
            && request_keys::add(statements.connection().await?, key, &trial.id).await?.is_err()
        {
            answers.push(Opened::KeyTaken);
            continue;
        }
        let inserted = insert(statements, together).await?;
        let opened: Vec<&NewTrial> = together.iter().copied().filter(|trial| inserted.contains(&trial.id)).collect();
        let policies: Vec<_> = opened.iter().filter_map(|trial| trial.policy.as_ref()).collect();
        policies::add_all(statements, &policies).await?;
        for refinement in opened.iter().filter_map(|trial| trial.refinement.as_ref()) {
            refinements::add(statements, refinement);
        }
        for trial in together {
            let was_opened = inserted.contains(&trial.id);
            answers.push(if was_opened { Opened::Yes } else { refused(statements.connection().await?, trial).await? });
        }
    }
    Ok(answers)
}

/// Inserts trials, in this order, those whose learner is there and whose number no other one has. Gives their ids.
async fn insert(statements: &mut Statements<'_>, trials: &[&NewTrial]) -> Result<FxHashSet<String>, StoreError> {
    statements.add(
        "INSERT INTO trials
             (id, learner, number, weights, weights_version, policy_id, lease_expires_at_ms, created_at_ms)
         SELECT * FROM (",
    );
    statements.go_on_with_rows(trials, |values, trial| {
        values.bind(&trial.id).bind(trial.learner).bind(as_integer(trial.number)).bind(&trial.weights);
        values.bind(as_integer(trial.weights_version)).bind(&trial.policy_id);
        values.bind(trial.lease_expires_at.as_millisecond()).bind(trial.created_at.as_millisecond());
    });
    // The columns of values have these names.
    statements.go_on(
        ") WHERE column2 IN (SELECT sequence FROM learners)
         ON CONFLICT (learner, number) DO NOTHING RETURNING id",
    );
    statements.fetch_all().await?.iter().map(|row| Ok(row.try_get(0)?)).collect()
}

/// Why a trial was not inserted. Nothing is left of it.
async fn refused(connection: &mut SqliteConnection, trial: &NewTrial) -> Result<Opened, StoreError> {
    if trial.key.is_some() {
        request_keys::forget(connection, &trial.id).await?;
    }
    let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM learners WHERE sequence = $1)");
    let has_learner = query.bind(trial.learner).fetch_one(connection).await?;
    Ok(if has_learner { Opened::NumberTaken } else { Opened::NoLearner })
}

/// Ends a trial without a reward.
#[derive(Debug)]
pub(super) struct FailTrial {
    pub(super) id: String,
    pub(super) reason: Option<String>,
}

impl Verb for FailTrial {
    type Answer = FailureAnswer;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<FailureAnswer, StoreError> {
        let (id, reason) = (self.id.as_str(), self.reason.as_deref());
        let query = sqlx::query(AssertSqlSafe(format!("{SELECT} {FROM} WHERE t.id = $1"))).bind(id);
        let Some(row) = query.fetch_optional(writing.connection().await?).await? else {
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
                query.bind(trial.sequence).bind(reason).execute(writing.connection().await?).await?;
            }
        }
        trial.failed = Some(Failure { reason: reason.map(str::to_owned) });
        Ok(FailureAnswer::Failed(trial))
    }
}

/// Accepts rewards, in order, within a transaction.
pub(in crate::store) async fn accept_all(
    statements: &mut Statements<'_>,
    rewards: &[&NewReward],
) -> Result<Vec<RewardAnswer>, StoreError> {
    let decided = read_rewarded(statements, rewards).await?.decide(rewards);
    if !decided.unmarked.is_empty() {
        let ids = serde_json::to_string(&decided.unmarked).map_err(corrupt("learners", "sequence"))?;
        learners::mark_pending(statements, &ids);
    }
    decided.insert(statements);
    Ok(decided.answers)
}

/// Accepts rewards, in order, outside of a transaction: durable when this returns. Gives no answers, and has done nothing, if a learner is not
/// marked yet, or others have written meanwhile.
pub(in crate::store) async fn accept_at_once(
    connection: &mut SqliteConnection,
    rewards: &[&NewReward],
) -> Result<Option<Vec<RewardAnswer>>, StoreError> {
    let statements = &mut Statements::on(connection);
    let decided = read_rewarded(statements, rewards).await?.decide(rewards);
    if !decided.unmarked.is_empty() {
        return Ok(None);
    }
    decided.insert(statements);
    let was_done = decided.rows.is_empty() || statements.run().await? > 0;
    Ok(was_done.then_some(decided.answers))
}

/// What becomes of rewards.
struct Decided {
    /// For each of them.
    answers: Vec<RewardAnswer>,
    /// Of those that are accepted.
    rows: Vec<RewardRow>,
    /// Their learners that are not marked as having rewards to fold.
    unmarked: BTreeSet<i64>,
    /// SQLite's number that changes when others write, as it was.
    data_version: i64,
}

/// A row of the log of rewards.
struct RewardRow {
    learner: i64,
    order: u64,
    trial: i64,
    reward: f64,
    accepted_at: Timestamp,
}

impl Decided {
    /// Adds what is accepted to the log of rewards, unless others have written meanwhile.
    fn insert(&self, statements: &mut Statements<'_>) {
        if self.rows.is_empty() {
            return;
        }
        statements.add("INSERT INTO rewards (learner, reward_order, trial, reward, accepted_at_ms) SELECT * FROM (");
        statements.go_on_with_rows(&self.rows, |values, row| {
            values.bind(row.learner).bind(as_integer(row.order)).bind(row.trial).bind(row.reward);
            values.bind(row.accepted_at.as_millisecond());
        });
        statements.go_on(") WHERE (SELECT data_version FROM pragma_data_version) = ?").bind(self.data_version);
    }
}

/// The trials that rewards are for, as they are before any of these.
struct Rewarded {
    trials: FxHashMap<String, Found>,
    /// By learner, the order of the last reward.
    last_orders: BTreeMap<i64, u64>,
    /// SQLite's number that changes when others write.
    data_version: i64,
}

struct Found {
    learner: i64,
    /// Whether the learner is marked as having rewards to fold.
    is_marked: bool,
    row: TrialRecord,
}

impl Rewarded {
    /// What becomes of these rewards, in order, if nothing else is written meanwhile.
    fn decide(mut self, rewards: &[&NewReward]) -> Decided {
        let (mut rows, mut unmarked) = (Vec::with_capacity(rewards.len()), BTreeSet::new());
        let answers = rewards.iter().map(|new| {
            let Some(Found { learner, is_marked, row: trial }) = self.trials.get_mut(new.trial.as_str()) else {
                return RewardAnswer::Unknown;
            };
            match (&trial.failed, trial.reward) {
                (Some(_), _) => RewardAnswer::Failed,
                (None, Some(AcceptedReward { reward, .. })) if reward == new.reward => {
                    RewardAnswer::Unchanged(trial.clone())
                }
                (None, Some(AcceptedReward { reward, .. })) => RewardAnswer::Conflict { existing: reward },
                (None, None) => {
                    let last = self.last_orders.entry(*learner).or_insert(0);
                    *last += 1;
                    trial.reward = Some(AcceptedReward { reward: new.reward, reward_order: *last });
                    if !*is_marked {
                        unmarked.insert(*learner);
                    }
                    rows.push(RewardRow {
                        learner: *learner,
                        order: *last,
                        trial: trial.sequence,
                        reward: new.reward,
                        accepted_at: new.accepted_at,
                    });
                    RewardAnswer::Accepted(trial.clone())
                }
            }
        });
        let answers = answers.collect();
        Decided { answers, rows, unmarked, data_version: self.data_version }
    }
}

async fn read_rewarded(statements: &mut Statements<'_>, rewards: &[&NewReward]) -> Result<Rewarded, StoreError> {
    let ids: Vec<&str> = rewards.iter().map(|new| new.trial.as_str()).collect();
    let ids = serde_json::to_string(&ids).map_err(corrupt("trials", "id"))?;
    // `CROSS JOIN` makes SQLite look trials up by id, rather than ids up by trial.
    let wanted = statements.add(&format!(
        "{SELECT}, t.learner, l.has_pending,
             (SELECT MAX(last.reward_order) FROM rewards last WHERE last.learner = t.learner) AS last_order,
             (SELECT data_version FROM pragma_data_version) AS data_version
         FROM json_each(?) wanted CROSS JOIN trials t ON t.id = wanted.value
             JOIN learners l ON l.sequence = t.learner LEFT JOIN rewards r ON r.trial = t.sequence"
    ));
    wanted.bind(ids);
    let mut read = Rewarded { trials: FxHashMap::default(), last_orders: BTreeMap::new(), data_version: 0 };
    for row in statements.fetch_all().await? {
        let (learner, is_marked) = (row.try_get("learner")?, row.try_get("has_pending")?);
        read.data_version = row.try_get("data_version")?;
        let last: Option<i64> = row.try_get("last_order")?;
        if last.is_some() {
            read.last_orders.insert(learner, count(&row, "rewards", "last_order")?);
        }
        let row = read_trial(&row)?;
        read.trials.insert(row.id.clone(), Found { learner, is_marked, row });
    }
    Ok(read)
}

#[cfg(test)]
mod tests;
