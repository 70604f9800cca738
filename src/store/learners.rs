//! The tables of learners and their weights, and the log of rewards as learners read it.

use futures_util::TryStreamExt;
use jiff::Timestamp;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::page::{Rest, Rows};
use super::statements::Statements;
use super::writer::{Verb, Writing};
use super::{Deletion, Page, Registration, Store, StoreError, as_integer, corrupt, count, page, timestamp};
use etude_core::attribute::ByAttribute;
use etude_core::learning::Distribution;

/// A learner to be registered.
#[derive(Clone, Debug)]
pub struct NewLearner {
    /// The name to register it under.
    pub name: String,
    /// SHA-256 of its canonical text.
    pub hash: String,
    /// Its canonical text.
    pub definition: String,
    /// What it starts from.
    pub initial: Distribution,
    /// When it is registered.
    pub created_at: Timestamp,
}

/// A learner as it is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LearnerRecord {
    /// Unlike its name, never used again.
    pub sequence: i64,
    /// The name it is registered under.
    pub name: String,
    /// SHA-256 of its canonical text.
    pub hash: String,
    /// Its canonical text.
    pub definition: String,
    /// When it was registered.
    pub created_at: Timestamp,
}

/// A version of a learner's distribution.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightsRecord {
    /// Counted from 0: what the learner started from.
    pub version: u64,
    /// The order of the last reward that is folded in; 0 if there is none.
    pub reward_order: u64,
    /// The distribution.
    pub distribution: Distribution,
    /// When it was made.
    pub updated_at: Timestamp,
}

/// What a learner learns from: an accepted reward, and the weights that earned it.
#[derive(Clone, Debug, PartialEq)]
pub struct RewardRecord {
    /// Counted from 1 per learner, in the order of acceptance.
    pub reward_order: u64,
    /// As drawn.
    pub weights: ByAttribute<f64>,
    /// The reward.
    pub reward: f64,
}

/// What became of a version of a learner's weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fold {
    /// It is the learner's last version now.
    Added,
    /// It does not follow the last version: another one was added meanwhile, or the learner is gone.
    Outdated,
}

/// Deletes a learner, and gives its sequence number.
#[derive(Debug)]
struct DeleteLearner(String);

/// Adds a version of a learner's weights.
#[derive(Debug)]
struct FoldRewards {
    learner: i64,
    weights: WeightsRecord,
}

impl Store {
    /// Registers a learner, unless its name is taken.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn register_learner(&self, learner: NewLearner) -> Result<Registration<LearnerRecord>, StoreError> {
        self.writer.write(learner).await
    }

    /// Deletes a learner with its weights, trials and rewards.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_learner(&self, name: &str) -> Result<Deletion, StoreError> {
        let Some(learner) = self.writer.write(DeleteLearner(name.to_owned())).await? else {
            return Ok(Deletion::Unknown);
        };
        self.trial_numbers.forget(learner);
        Ok(Deletion::Deleted)
    }

    /// Adds the version of a learner's weights into which the rewards that follow the last version are folded.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn fold_rewards(&self, learner: i64, weights: WeightsRecord) -> Result<Fold, StoreError> {
        self.writer.write(FoldRewards { learner, weights }).await
    }

    /// The learner called `name`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learner(&self, name: &str) -> Result<Option<LearnerRecord>, StoreError> {
        let query = sqlx::query("SELECT * FROM learners WHERE name = $1").bind(name);
        query.fetch_optional(&mut *self.reader().await?).await?.map(|row| read_learner(&row)).transpose()
    }

    /// The learner called `name`, and the last version of its weights.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learner_and_weights(&self, name: &str) -> Result<Option<(LearnerRecord, WeightsRecord)>, StoreError> {
        let query = sqlx::query(
            "SELECT l.*, w.version, w.reward_order, w.expected_reward, w.mean, w.sd, w.updated_at_ms
             FROM learners l JOIN weights w ON w.learner = l.sequence
             WHERE l.name = $1 ORDER BY w.version DESC LIMIT 1",
        );
        let row = query.bind(name).fetch_optional(&mut *self.reader().await?).await?;
        row.map(|row| Ok((read_learner(&row)?, read_weights(&row)?))).transpose()
    }

    /// At most `limit` learners in the order of their names, from the first after `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learners(&self, after: Option<&str>, limit: u32) -> Result<Page<LearnerRecord>, StoreError> {
        // Definitions may be so long that even a few of them are not read ahead.
        let sizes = "SELECT octet_length(definition) FROM learners WHERE name > $1 ORDER BY name LIMIT $2";
        let sizes = sqlx::query_scalar(sizes).bind(after.unwrap_or_default()).bind(i64::from(limit) + 1);
        let mut reader = self.reader().await?;
        let sizes: Vec<i64> = sizes.fetch_all(&mut *reader).await?;
        let (n_rows, rest) = page::fitting(&sizes, limit);
        let query = sqlx::query("SELECT * FROM learners WHERE name > $1 ORDER BY name LIMIT $2");
        let rows = query.bind(after.unwrap_or_default()).bind(n_rows).fetch(&mut *reader);
        Rows { table: "learners", key: "name", name: "name", long: &["definition"], read: read_learner }
            .page(rows, n_rows, rest)
            .await
    }

    /// Names of learners with rewards that no version has folded in.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learners_behind(&self) -> Result<Vec<String>, StoreError> {
        Ok(sqlx::query_scalar(BEHIND).fetch_all(&mut *self.reader().await?).await?)
    }

    /// A version of the weights of a learner.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn weights(&self, learner: i64, version: u64) -> Result<Option<WeightsRecord>, StoreError> {
        let query = sqlx::query("SELECT * FROM weights WHERE learner = $1 AND version = $2");
        let query = query.bind(learner).bind(as_integer(version));
        query.fetch_optional(&mut *self.reader().await?).await?.map(|row| read_weights(&row)).transpose()
    }

    /// At most `limit` versions of the weights of a learner, from the first after `after` on; `None`: from version 0.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn weights_history(
        &self,
        learner: i64,
        after: Option<u64>,
        limit: u32,
    ) -> Result<Page<WeightsRecord>, StoreError> {
        let query = sqlx::query("SELECT * FROM weights WHERE learner = $1 AND version > $2 ORDER BY version LIMIT $3");
        let query = query.bind(learner).bind(after.map_or(-1, as_integer)).bind(i64::from(limit) + 1);
        let mut reader = self.reader().await?;
        let rows = query.fetch(&mut *reader);
        Rows { table: "weights", key: "version", name: "version", long: &["mean", "sd"], read: read_weights }
            .page(rows, limit, Rest::IsNone)
            .await
    }

    /// Gives each accepted reward of a learner after the one with order `after` to `each`, in order.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn each_reward(
        &self,
        learner: i64,
        after: u64,
        mut each: impl FnMut(RewardRecord),
    ) -> Result<(), StoreError> {
        let query = sqlx::query(
            "SELECT r.reward_order, r.reward, t.weights FROM rewards r JOIN trials t ON t.sequence = r.trial
             WHERE r.learner = $1 AND r.reward_order > $2 ORDER BY r.reward_order",
        );
        let mut reader = self.reader().await?;
        let mut rows = query.bind(learner).bind(as_integer(after)).fetch(&mut *reader);
        while let Some(row) = rows.try_next().await? {
            each(RewardRecord {
                reward_order: count(&row, "rewards", "reward_order")?,
                weights: serde_json::from_str(row.try_get("weights")?).map_err(corrupt("trials", "weights"))?,
                reward: row.try_get("reward")?,
            });
        }
        Ok(())
    }
}

/// This runs every second, however many learners there are. The index has only those with rewards to fold.
const BEHIND: &str = "SELECT name FROM learners WHERE has_pending = 1 ORDER BY sequence";

fn read_learner(row: &SqliteRow) -> Result<LearnerRecord, StoreError> {
    Ok(LearnerRecord {
        sequence: row.try_get("sequence")?,
        name: row.try_get("name")?,
        hash: row.try_get("hash")?,
        definition: row.try_get("definition")?,
        created_at: timestamp("learners", "created_at_ms", row.try_get("created_at_ms")?)?,
    })
}

fn read_weights(row: &SqliteRow) -> Result<WeightsRecord, StoreError> {
    const TABLE: &str = "weights";
    let numbers = |column: &'static str| -> Result<Vec<f64>, StoreError> {
        serde_json::from_str(row.try_get(column)?).map_err(corrupt(TABLE, column))
    };
    Ok(WeightsRecord {
        version: count(row, TABLE, "version")?,
        reward_order: count(row, TABLE, "reward_order")?,
        distribution: Distribution {
            mean: numbers("mean")?,
            sd: numbers("sd")?,
            expected_reward: row.try_get("expected_reward")?,
        },
        updated_at: timestamp(TABLE, "updated_at_ms", row.try_get("updated_at_ms")?)?,
    })
}

impl Verb for NewLearner {
    type Answer = Registration<LearnerRecord>;

    fn n_bytes(&self) -> usize {
        self.definition.len()
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Registration<LearnerRecord>, StoreError> {
        let connection = writing.connection().await?;
        let inserted = sqlx::query(
            "INSERT INTO learners (name, hash, definition, created_at_ms) VALUES ($1, $2, $3, $4)
             ON CONFLICT (name) DO NOTHING",
        )
        .bind(&self.name)
        .bind(&self.hash)
        .bind(&self.definition)
        .bind(self.created_at.as_millisecond())
        .execute(&mut *connection)
        .await?;
        let query = sqlx::query("SELECT * FROM learners WHERE name = $1").bind(&self.name);
        let row = read_learner(&query.fetch_one(&mut *connection).await?)?;
        if inserted.rows_affected() == 1 {
            let distribution = self.initial.clone();
            let first = WeightsRecord { version: 0, reward_order: 0, distribution, updated_at: self.created_at };
            insert_weights(writing.statements, row.sequence, &first)?;
            return Ok(Registration::Created(row));
        }
        Ok(if row.hash == self.hash {
            Registration::Unchanged(row)
        } else {
            Registration::Conflict { existing_hash: row.hash }
        })
    }
}

impl Verb for DeleteLearner {
    type Answer = Option<i64>;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Option<i64>, StoreError> {
        let query = sqlx::query_scalar("DELETE FROM learners WHERE name = $1 RETURNING sequence").bind(&self.0);
        Ok(query.fetch_optional(writing.connection().await?).await?)
    }
}

impl Verb for FoldRewards {
    type Answer = Fold;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Fold, StoreError> {
        let Self { learner, weights } = self;
        let statements = &mut *writing.statements;
        statements.add("SELECT MAX(version) FROM weights WHERE learner = ?").bind(learner);
        let last = statements.fetch().await?.map(|row| row.try_get::<Option<i64>, _>(0)).transpose()?.flatten();
        // Without a version, the learner is gone.
        if last.map(|last| last + 1) != Some(as_integer(weights.version)) {
            return Ok(Fold::Outdated);
        }
        insert_weights(statements, *learner, weights)?;
        let folded = statements.add(
            "UPDATE learners SET has_pending = EXISTS (SELECT 1 FROM rewards WHERE learner = ? AND reward_order > ?)
             WHERE sequence = ?",
        );
        folded.bind(learner).bind(as_integer(weights.reward_order)).bind(learner);
        Ok(Fold::Added)
    }
}

/// Marks learners (JSON: an array of sequence numbers) as having rewards to fold.
pub(super) fn mark_pending(statements: &mut Statements<'_>, learners: &str) {
    let marked = statements.add(
        "UPDATE learners SET has_pending = 1
         WHERE has_pending = 0 AND sequence IN (SELECT value FROM json_each(?))",
    );
    marked.bind(learners);
}

fn insert_weights(statements: &mut Statements<'_>, learner: i64, weights: &WeightsRecord) -> Result<(), StoreError> {
    let json = |numbers: &[f64], column| serde_json::to_string(numbers).map_err(corrupt("weights", column));
    let Distribution { mean, sd, expected_reward } = &weights.distribution;
    let inserted = statements.add(
        "INSERT INTO weights (learner, version, reward_order, expected_reward, mean, sd, updated_at_ms)
         VALUES (?, ?, ?, ?, ?, ?, ?)",
    );
    inserted.bind(learner).bind(as_integer(weights.version)).bind(as_integer(weights.reward_order));
    inserted.bind(expected_reward).bind(json(mean, "mean")?).bind(json(sd, "sd")?);
    inserted.bind(weights.updated_at.as_millisecond());
    Ok(())
}

#[cfg(test)]
impl NewLearner {
    /// A learner of one attribute.
    pub(in crate::store) fn plain(name: &str) -> Self {
        let initial = Distribution { mean: vec![1.0], sd: vec![1.0], expected_reward: None };
        Self {
            name: name.to_owned(),
            hash: "0".to_owned(),
            definition: "{}".to_owned(),
            initial,
            created_at: Timestamp::UNIX_EPOCH,
        }
    }
}

#[cfg(test)]
mod tests;
