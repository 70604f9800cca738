//! The tables of learners and their weights, and the log of rewards as learners read it.

use futures_util::TryStreamExt;
use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::page::{Rest, Rows};
use super::writer::{Write, Written};
use super::{Page, Store, StoreError, as_integer, corrupt, count, page, timestamp};
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
pub struct LearnerRow {
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

/// What became of a registration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PutLearner {
    /// It is new.
    Created(LearnerRow),
    /// The same content was there already, under the same name.
    Unchanged(LearnerRow),
    /// Other content is there under this name; it was left alone.
    Conflict {
        /// The hash of what is there.
        existing_hash: String,
    },
}

/// A version of a learner's distribution.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightsRow {
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
pub struct RewardRow {
    /// Counted from 1 per learner, in the order of acceptance.
    pub reward_order: u64,
    /// As drawn.
    pub weights: ByAttribute<f64>,
    /// The reward.
    pub reward: f64,
}

impl Store {
    /// Registers a learner, unless its name is taken.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn put_learner(&self, learner: NewLearner) -> Result<PutLearner, StoreError> {
        match self.writer.write(Write::PutLearner(learner)).await? {
            Written::PutLearner(put) => Ok(put),
            _ => Err(StoreError::Closed),
        }
    }

    /// Deletes a learner with its weights, trials and rewards. Gives the sequence number of the deleted one, if there was
    /// one.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_learner(&self, name: &str) -> Result<Option<i64>, StoreError> {
        match self.writer.write(Write::DeleteLearner(name.to_owned())).await? {
            Written::DeleteLearner(deleted) => Ok(deleted),
            _ => Err(StoreError::Closed),
        }
    }

    /// Adds the version that follows the learner's last one. Says whether it did: not if that version is there already, or
    /// the learner is gone.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_weights(&self, learner: i64, weights: WeightsRow) -> Result<bool, StoreError> {
        match self.writer.write(Write::AddWeights { learner, weights }).await? {
            Written::AddWeights(added) => Ok(added),
            _ => Err(StoreError::Closed),
        }
    }

    /// The learner called `name`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learner(&self, name: &str) -> Result<Option<LearnerRow>, StoreError> {
        let query = sqlx::query("SELECT * FROM learners WHERE name = $1").bind(name);
        query.fetch_optional(&mut *self.reader().await?).await?.map(|row| read_learner(&row)).transpose()
    }

    /// The learner called `name`, and the last version of its weights.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn learner_and_weights(&self, name: &str) -> Result<Option<(LearnerRow, WeightsRow)>, StoreError> {
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
    pub async fn learners(&self, after: Option<&str>, limit: u32) -> Result<Page<LearnerRow>, StoreError> {
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
    pub async fn weights(&self, learner: i64, version: u64) -> Result<Option<WeightsRow>, StoreError> {
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
    ) -> Result<Page<WeightsRow>, StoreError> {
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
        mut each: impl FnMut(RewardRow),
    ) -> Result<(), StoreError> {
        let query = sqlx::query(
            "SELECT r.reward_order, r.reward, t.weights FROM rewards r JOIN trials t ON t.sequence = r.trial
             WHERE r.learner = $1 AND r.reward_order > $2 ORDER BY r.reward_order",
        );
        let mut reader = self.reader().await?;
        let mut rows = query.bind(learner).bind(as_integer(after)).fetch(&mut *reader);
        while let Some(row) = rows.try_next().await? {
            each(RewardRow {
                reward_order: count(&row, "rewards", "reward_order")?,
                weights: serde_json::from_str(row.try_get("weights")?).map_err(corrupt("trials", "weights"))?,
                reward: row.try_get("reward")?,
            });
        }
        Ok(())
    }
}

/// Looked for every second, however many learners there are: only those that have something to fold are in the index.
const BEHIND: &str = "SELECT name FROM learners WHERE has_pending = 1 ORDER BY sequence";

fn read_learner(row: &SqliteRow) -> Result<LearnerRow, StoreError> {
    Ok(LearnerRow {
        sequence: row.try_get("sequence")?,
        name: row.try_get("name")?,
        hash: row.try_get("hash")?,
        definition: row.try_get("definition")?,
        created_at: timestamp("learners", "created_at_ms", row.try_get("created_at_ms")?)?,
    })
}

fn read_weights(row: &SqliteRow) -> Result<WeightsRow, StoreError> {
    const TABLE: &str = "weights";
    let numbers = |column: &'static str| -> Result<Vec<f64>, StoreError> {
        serde_json::from_str(row.try_get(column)?).map_err(corrupt(TABLE, column))
    };
    Ok(WeightsRow {
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

pub(super) async fn put(connection: &mut SqliteConnection, learner: &NewLearner) -> Result<PutLearner, StoreError> {
    let inserted = sqlx::query(
        "INSERT INTO learners (name, hash, definition, created_at_ms) VALUES ($1, $2, $3, $4)
         ON CONFLICT (name) DO NOTHING",
    )
    .bind(&learner.name)
    .bind(&learner.hash)
    .bind(&learner.definition)
    .bind(learner.created_at.as_millisecond())
    .execute(&mut *connection)
    .await?;
    let query = sqlx::query("SELECT * FROM learners WHERE name = $1").bind(&learner.name);
    let row = read_learner(&query.fetch_one(&mut *connection).await?)?;
    if inserted.rows_affected() == 1 {
        let first = WeightsRow {
            version: 0,
            reward_order: 0,
            distribution: learner.initial.clone(),
            updated_at: learner.created_at,
        };
        insert_weights(connection, row.sequence, &first).await?;
        return Ok(PutLearner::Created(row));
    }
    Ok(if row.hash == learner.hash {
        PutLearner::Unchanged(row)
    } else {
        PutLearner::Conflict { existing_hash: row.hash }
    })
}

pub(super) async fn delete(connection: &mut SqliteConnection, name: &str) -> Result<Option<i64>, StoreError> {
    let query = sqlx::query_scalar("DELETE FROM learners WHERE name = $1 RETURNING sequence").bind(name);
    Ok(query.fetch_optional(connection).await?)
}

pub(super) async fn add_weights(
    connection: &mut SqliteConnection,
    learner: i64,
    weights: &WeightsRow,
) -> Result<bool, StoreError> {
    let query = sqlx::query_scalar("SELECT MAX(version) FROM weights WHERE learner = $1").bind(learner);
    let last: Option<i64> = query.fetch_one(&mut *connection).await?;
    // Without a version, the learner is gone.
    if last.map(|last| last + 1) != Some(as_integer(weights.version)) {
        return Ok(false);
    }
    insert_weights(connection, learner, weights).await?;
    let folded = sqlx::query(
        "UPDATE learners SET has_pending = EXISTS (SELECT 1 FROM rewards WHERE learner = $1 AND reward_order > $2)
         WHERE sequence = $1",
    );
    folded.bind(learner).bind(as_integer(weights.reward_order)).execute(connection).await?;
    Ok(true)
}

/// Marks learners (JSON: an array of sequence numbers) as having rewards to fold.
pub(super) async fn mark_pending(connection: &mut SqliteConnection, learners: &str) -> Result<(), StoreError> {
    let marked = sqlx::query(
        "UPDATE learners SET has_pending = 1
         WHERE has_pending = 0 AND sequence IN (SELECT value FROM json_each($1))",
    );
    marked.bind(learners).execute(connection).await?;
    Ok(())
}

async fn insert_weights(
    connection: &mut SqliteConnection,
    learner: i64,
    weights: &WeightsRow,
) -> Result<(), StoreError> {
    let json = |numbers: &[f64], column| serde_json::to_string(numbers).map_err(corrupt("weights", column));
    let Distribution { mean, sd, expected_reward } = &weights.distribution;
    sqlx::query(
        "INSERT INTO weights (learner, version, reward_order, expected_reward, mean, sd, updated_at_ms)
         VALUES ($1, $2, $3, $4, $5, $6, $7)",
    )
    .bind(learner)
    .bind(as_integer(weights.version))
    .bind(as_integer(weights.reward_order))
    .bind(expected_reward)
    .bind(json(mean, "mean")?)
    .bind(json(sd, "sd")?)
    .bind(weights.updated_at.as_millisecond())
    .execute(connection)
    .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::AssertSqlSafe;
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::store::{NewReward, NewTrial, PutReward};

    fn new_learner(name: &str) -> NewLearner {
        let initial = Distribution { mean: vec![1.0], sd: vec![1.0], expected_reward: None };
        NewLearner {
            name: name.to_owned(),
            hash: "0".to_owned(),
            definition: "{}".to_owned(),
            initial,
            created_at: Timestamp::UNIX_EPOCH,
        }
    }

    async fn learner(store: &Store, name: &str) -> i64 {
        let PutLearner::Created(row) = store.put_learner(new_learner(name)).await.unwrap() else { panic!("it is new") };
        row.sequence
    }

    async fn reward(store: &Store, learner: i64, number: u64) {
        let id = format!("{learner}-{number}");
        let trial = NewTrial {
            id: id.clone(),
            learner,
            number,
            weights: "{\"x\":1.0}".to_owned(),
            weights_version: 0,
            policy_id: id.clone(),
            policy: None,
            refinement: None,
            created_at: Timestamp::UNIX_EPOCH,
            lease_expires_at: Timestamp::UNIX_EPOCH,
        };
        assert!(store.add_trial(trial).await.unwrap());
        let put = store.put_reward(NewReward { trial: id, reward: 1.0, accepted_at: Timestamp::UNIX_EPOCH }).await;
        assert!(matches!(put.unwrap(), PutReward::Accepted(_)));
    }

    async fn fold(store: &Store, learner: i64, version: u64, reward_order: u64) {
        let distribution = Distribution { mean: vec![1.0], sd: vec![1.0], expected_reward: None };
        let weights = WeightsRow { version, reward_order, distribution, updated_at: Timestamp::UNIX_EPOCH };
        assert!(store.add_weights(learner, weights).await.unwrap());
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
        assert!(store.add_trial(NewTrial { id: format!("{a}-1"), ..repeated(a) }).await.is_err(), "its id is taken");
        fold(&store, b, 3, 3).await;
        reward(&store, b, 4).await;
        drop(store);
        let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
        assert_eq!(store.learners_behind().await.unwrap(), ["b"]);
        reward(&store, b, 5).await;
        fold(&store, b, 4, 5).await;
        assert_eq!(store.learners_behind().await.unwrap(), Vec::<String>::new());
    }

    fn repeated(learner: i64) -> NewTrial {
        NewTrial {
            id: String::new(),
            learner,
            number: 99,
            weights: "{}".to_owned(),
            weights_version: 0,
            policy_id: String::new(),
            policy: None,
            refinement: None,
            created_at: Timestamp::UNIX_EPOCH,
            lease_expires_at: Timestamp::UNIX_EPOCH,
        }
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
}
