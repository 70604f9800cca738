//! The table of what models of experience were told.

use futures_util::TryStreamExt;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::models::note_change;
use super::writer::{Verb, Writing};
use super::{ModelSize, Store, StoreError, as_integer, corrupt, count};

/// How hard batches are compressed: logs repeat themselves.
const COMPRESSION_LEVEL: i32 = 1;

/// Batches are read so many bytes at a time, as they are stored; a larger one by itself.
const MAX_READ_BYTES: usize = 1 << 20;

/// How much there is of a model of experience.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Revision {
    /// How many states and transitions it has.
    pub size: ModelSize,
    /// Of how many states and actions there are several outcomes.
    pub n_stochastic: u64,
    /// How many of its states are unsafe.
    pub n_unsafe: u64,
}

/// A batch to be added to a model of experience.
#[derive(Debug)]
pub struct NewBatch {
    /// The name of the model.
    pub model: String,
    /// Of what the model was told.
    pub experience: i64,
    /// The hash that the model has without it.
    pub hash_before: String,
    /// How many batches there are before it.
    pub n_before: i64,
    /// As the client calls it.
    pub batch: String,
    /// SHA-256 of its text.
    pub content_hash: String,
    /// The hash of the model with it.
    pub hash: String,
    /// How much there is of the model with it.
    pub revision: Revision,
    /// Its canonical text, from [`pack_batch`].
    pub content: Vec<u8>,
}

/// A batch that was accepted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AcceptedBatch {
    /// SHA-256 of its text.
    pub content_hash: String,
    /// The hash of the model with it.
    pub hash: String,
    /// How much there was of the model with it.
    pub revision: Revision,
}

/// A batch, as it is stored.
#[derive(Debug)]
pub struct StoredBatch {
    /// Counts the model's batches, from 1.
    pub seq: i64,
    /// The hash of the model with it.
    pub hash: String,
    content: Vec<u8>,
}

impl StoredBatch {
    /// Its canonical text.
    ///
    /// # Errors
    ///
    /// [`StoreError::Corrupt`] if it cannot be decompressed.
    pub fn text(&self) -> Result<Vec<u8>, StoreError> {
        zstd::stream::decode_all(self.content.as_slice()).map_err(corrupt("batches", "content"))
    }
}

/// The text of a batch, as it is stored.
///
/// # Errors
///
/// [`StoreError::Corrupt`] if it cannot be compressed, as where there is no memory.
pub fn pack_batch(text: &[u8]) -> Result<Vec<u8>, StoreError> {
    zstd::bulk::compress(text, COMPRESSION_LEVEL).map_err(corrupt("batches", "content"))
}

impl Store {
    /// Adds a batch, if the model still has the hash that it had before; says whether it had.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_batch(&self, batch: NewBatch) -> Result<bool, StoreError> {
        self.writer.write(batch).await
    }

    /// The batch of this name, if it was accepted.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn accepted_batch(&self, experience: i64, batch: &str) -> Result<Option<AcceptedBatch>, StoreError> {
        let query = sqlx::query(
            "SELECT content_hash, hash, n_states, n_transitions, n_stochastic, n_unsafe
             FROM batches WHERE definition_id = $1 AND batch = $2",
        );
        let row = query.bind(experience).bind(batch).fetch_optional(&mut *self.reader().await?).await?;
        row.as_ref().map(read_accepted).transpose()
    }

    /// The last batch that the model was told when it had this hash, 0 if that was before the first; `None` if it never had it.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn revision(&self, experience: i64, hash: &str) -> Result<Option<i64>, StoreError> {
        let query = "SELECT seq FROM batches WHERE hash = $1 AND definition_id = $2
                     UNION ALL SELECT 0 FROM models WHERE definition_hash = $1 AND definition_id = $2";
        let query = sqlx::query_scalar(query).bind(hash).bind(experience);
        Ok(query.fetch_optional(&mut *self.reader().await?).await?)
    }

    /// Some of the batches after the first `n_before`, in order; none if there are no more.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn batches(&self, experience: i64, n_before: i64) -> Result<Vec<StoredBatch>, StoreError> {
        let query = "SELECT seq, hash, content FROM batches WHERE definition_id = $1 AND seq > $2 ORDER BY seq";
        let mut reader = self.reader().await?;
        let mut rows = sqlx::query(query).bind(experience).bind(n_before).fetch(&mut *reader);
        let (mut batches, mut n_bytes) = (Vec::new(), 0);
        while n_bytes < MAX_READ_BYTES
            && let Some(row) = rows.try_next().await?
        {
            let content: Vec<u8> = row.try_get("content")?;
            n_bytes += content.len();
            batches.push(StoredBatch { seq: row.try_get("seq")?, hash: row.try_get("hash")?, content });
        }
        Ok(batches)
    }
}

fn read_accepted(row: &SqliteRow) -> Result<AcceptedBatch, StoreError> {
    let count = |column| count(row, "batches", column);
    let size = ModelSize { n_states: count("n_states")?, n_transitions: count("n_transitions")? };
    let revision = Revision { size, n_stochastic: count("n_stochastic")?, n_unsafe: count("n_unsafe")? };
    Ok(AcceptedBatch { content_hash: row.try_get("content_hash")?, hash: row.try_get("hash")?, revision })
}

impl Verb for NewBatch {
    type Answer = bool;

    fn n_bytes(&self) -> usize {
        self.content.len()
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<bool, StoreError> {
        let Revision { size, n_stochastic, n_unsafe } = self.revision;
        let updated = sqlx::query(
            "UPDATE models SET hash = $1, n_states = $2, n_transitions = $3, n_stochastic = $4, n_unsafe = $5
             WHERE name = $6 AND definition_id = $7 AND hash = $8",
        );
        let updated = updated
            .bind(&self.hash)
            .bind(as_integer(size.n_states))
            .bind(as_integer(size.n_transitions))
            .bind(as_integer(n_stochastic))
            .bind(as_integer(n_unsafe))
            .bind(&self.model)
            .bind(self.experience)
            .bind(&self.hash_before)
            .execute(writing.connection().await?)
            .await?;
        if updated.rows_affected() == 0 {
            return Ok(false);
        }
        let inserted = sqlx::query(
            "INSERT INTO batches
                 (definition_id, seq, batch, content_hash, hash, n_states, n_transitions, n_stochastic, n_unsafe, content)
             VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)",
        );
        inserted
            .bind(self.experience)
            .bind(self.n_before + 1)
            .bind(&self.batch)
            .bind(&self.content_hash)
            .bind(&self.hash)
            .bind(as_integer(size.n_states))
            .bind(as_integer(size.n_transitions))
            .bind(as_integer(n_stochastic))
            .bind(as_integer(n_unsafe))
            .bind(&self.content)
            .execute(writing.connection().await?)
            .await?;
        note_change(writing, &self.model).await?;
        Ok(true)
    }
}

/// Removes some of the batches of a model that is gone, the last ones first; says whether there were any.
pub(super) async fn remove_some(connection: &mut SqliteConnection, experience: i64) -> Result<bool, StoreError> {
    /// Batches that are removed in one transaction.
    const N_AT_ONCE: i64 = 1000;
    /// As many bytes of them, unless a single one is larger.
    const MAX_BYTES: i64 = 8 << 20;
    let removed = sqlx::query(
        "DELETE FROM batches WHERE definition_id = $1 AND seq IN
             (SELECT seq FROM
                  (SELECT seq, sum(n_bytes) OVER (ORDER BY seq DESC) - n_bytes AS n_bytes_before FROM
                       (SELECT seq, length(content) AS n_bytes FROM batches
                        WHERE definition_id = $1 ORDER BY seq DESC LIMIT $2))
              WHERE n_bytes_before < $3)",
    );
    let removed = removed.bind(experience).bind(N_AT_ONCE).bind(MAX_BYTES).execute(connection).await?;
    Ok(removed.rows_affected() > 0)
}

#[cfg(test)]
mod tests;
