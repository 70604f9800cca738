//! The table of what models of experience were told, counted: so that a service that starts need not count all batches again.
//!
//! ```text
//! piece, piece, ..      each in a transaction of its own: nobody waits for long
//!   -> all are there    it counts
//!   -> killed before    what was stored before counts on; the next one that is stored takes its place
//! ```
//!
//! Nothing here is truth: what is missing, or damaged, is counted from [`super::batches`].

use std::sync::Arc;

use sqlx::{Row, SqliteConnection};

use super::writer::{MAX_LARGE_BYTES, Verb, Writing};
use super::{Store, StoreError, corrupt};

/// Most bytes of a piece, as it is stored.
const PIECE_BYTES: usize = 256 << 10;
/// Pieces that are removed in one transaction.
const N_REMOVED_AT_ONCE: i64 = 8;
/// How hard they are compressed.
const COMPRESSION_LEVEL: i32 = 1;

/// What a model was told up to some batch, counted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredTally {
    /// The last batch that is counted, from 1.
    pub seq: i64,
    /// The hash of the model with that.
    pub hash: String,
    /// As its maker wrote it.
    pub content: Vec<u8>,
}

impl Store {
    /// Stores what a model was told, under the id `experience`, up to some batch, in place of what was stored of earlier ones. Says whether the model is still there.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn put_tally(&self, experience: i64, tally: StoredTally) -> Result<bool, StoreError> {
        let StoredTally { seq, hash, content } = tally;
        let checksum = i64::from(crc32fast::hash(&content));
        let compress = move || zstd::bulk::compress(&content, COMPRESSION_LEVEL);
        let compressed = self.tasks.spawn_blocking(compress).await.map_err(std::io::Error::other).flatten();
        let compressed: Arc<[u8]> = compressed.map_err(corrupt("tallies", "content"))?.into();
        let n_pieces = compressed.len().div_ceil(PIECE_BYTES);
        for piece in 0..n_pieces {
            let hash = hash.clone();
            let new =
                AddTallyPiece { experience, seq, hash, piece, n_pieces, checksum, compressed: compressed.clone() };
            if !self.writer.write(new).await? {
                return Ok(false);
            }
        }
        while self.writer.write(RemoveEarlierTallies { experience, seq }).await? {}
        Ok(true)
    }

    /// What the model was told, under the id `experience`, up to the last batch of which that is stored, and that is none after `most`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn tally(&self, experience: i64, most: i64) -> Result<Option<StoredTally>, StoreError> {
        let query = sqlx::query(
            "SELECT tallies.seq, tallies.hash, checksum, tallies.content FROM tallies
             JOIN batches ON batches.definition_id = tallies.definition_id AND batches.seq = tallies.seq AND batches.hash = tallies.hash
             WHERE tallies.definition_id = $1 AND tallies.seq =
                 (SELECT seq FROM tallies WHERE definition_id = $1 AND seq <= $2
                  GROUP BY seq HAVING count(*) = min(n_pieces) AND min(n_pieces) = max(n_pieces) ORDER BY seq DESC LIMIT 1)
             ORDER BY piece",
        );
        let rows = query.bind(experience).bind(most).fetch_all(&mut *self.reader().await?).await?;
        let Some(first) = rows.first() else { return Ok(None) };
        let (seq, hash, checksum) =
            (first.try_get("seq")?, first.try_get("hash")?, first.try_get::<i64, _>("checksum")?);
        let mut compressed = Vec::new();
        for row in &rows {
            compressed.extend_from_slice(row.try_get("content")?);
        }
        let decompress = move || zstd::stream::decode_all(compressed.as_slice());
        let content = self.tasks.spawn_blocking(decompress).await.map_err(std::io::Error::other).flatten();
        let content = content.ok().filter(|content| i64::from(crc32fast::hash(content)) == checksum);
        Ok(content.map(|content| StoredTally { seq, hash, content }))
    }
}

/// Stores a piece of a tally, if the model is there; says whether it is.
#[derive(Debug)]
struct AddTallyPiece {
    experience: i64,
    seq: i64,
    hash: String,
    /// Which it is, from 0, of `n_pieces`.
    piece: usize,
    n_pieces: usize,
    /// CRC-32 of the whole.
    checksum: i64,
    /// The whole.
    compressed: Arc<[u8]>,
}

impl Verb for AddTallyPiece {
    type Answer = bool;

    fn n_bytes(&self) -> usize {
        self.content().len()
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<bool, StoreError> {
        let inserted = sqlx::query(
            "INSERT OR REPLACE INTO tallies (definition_id, seq, piece, n_pieces, hash, checksum, content)
             SELECT $1, $2, $3, $4, $5, $6, $7 WHERE EXISTS (SELECT 1 FROM models WHERE definition_id = $1)",
        );
        let [piece, n_pieces] = [self.piece, self.n_pieces].map(|n| i64::try_from(n).unwrap_or(i64::MAX));
        let inserted = inserted
            .bind(self.experience)
            .bind(self.seq)
            .bind(piece)
            .bind(n_pieces)
            .bind(&self.hash)
            .bind(self.checksum)
            .bind(self.content())
            .execute(writing.connection().await?)
            .await?;
        Ok(inserted.rows_affected() > 0)
    }
}

impl AddTallyPiece {
    fn content(&self) -> &[u8] {
        let begin = self.piece * PIECE_BYTES;
        &self.compressed[begin..self.compressed.len().min(begin + PIECE_BYTES)]
    }
}

/// Removes some of what was stored of earlier batches; says whether there was any.
#[derive(Debug)]
struct RemoveEarlierTallies {
    experience: i64,
    seq: i64,
}

impl Verb for RemoveEarlierTallies {
    type Answer = bool;

    /// Several pieces.
    fn n_bytes(&self) -> usize {
        MAX_LARGE_BYTES
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<bool, StoreError> {
        remove_before(writing.connection().await?, self.experience, self.seq).await
    }
}

/// Removes some of what is stored of a model that is gone; says whether there was any.
pub(super) async fn remove_some(connection: &mut SqliteConnection, experience: i64) -> Result<bool, StoreError> {
    remove_before(connection, experience, i64::MAX).await
}

async fn remove_before(connection: &mut SqliteConnection, experience: i64, seq: i64) -> Result<bool, StoreError> {
    let removed = sqlx::query(
        "DELETE FROM tallies WHERE (definition_id, seq, piece) IN
             (SELECT definition_id, seq, piece FROM tallies WHERE definition_id = $1 AND seq < $2 LIMIT $3)",
    );
    let removed = removed.bind(experience).bind(seq).bind(N_REMOVED_AT_ONCE).execute(connection).await?;
    Ok(removed.rows_affected() > 0)
}

#[cfg(test)]
mod tests;
