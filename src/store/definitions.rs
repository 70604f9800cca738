//! The tables of definitions that are too large for a column, and their removal with what models of experience were told.
//!
//! ```text
//! begin -> piece, piece, ..            each in a transaction of its own: nobody waits for long
//!       -> register_model                   makes them a model's, all at once
//!       -> dropped, or the model deleted: the sweeper removes the pieces, some at a time
//!       -> the program killed: a service that starts removes them
//! ```
//!
//! A definition becomes a model's only if all its pieces are still there.

use std::time::Duration;

use sqlx::query::QueryScalar;
use sqlx::sqlite::SqliteArguments;
use sqlx::{Sqlite, SqliteConnection};
use tokio::sync::mpsc;
use tokio_util::task::TaskTracker;

use super::writer::{MAX_LARGE_BYTES, Verb, Writer, Writing};
use super::{Store, StoreError, corrupt};

/// Most text of a piece, in bytes. What is written at once is a fraction of it.
pub const PIECE_BYTES: usize = 4 << 20;

/// Pieces that are removed in one transaction.
const N_SWEPT_AT_ONCE: i64 = 8;

/// How hard pieces are compressed: so that it keeps up with the writing of JSON.
const COMPRESSION_LEVEL: i32 = 1;

/// A definition that is stored piece by piece, and is no model's yet. What was stored of it is removed when this is dropped.
#[derive(Debug)]
pub struct NewPieces {
    pub(super) id: i64,
    pub(super) n_pieces: i64,
    sweeper: Sweeper,
}

impl Drop for NewPieces {
    fn drop(&mut self) {
        // If it has become a model's, the sweeper finds that.
        self.sweeper.sweep(self.id);
    }
}

/// The way to the task that removes definitions that are no model's.
#[derive(Clone, Debug)]
pub(super) struct Sweeper(mpsc::UnboundedSender<i64>);

impl Sweeper {
    /// Starts the task in `tasks`. It ends when the writer takes no more.
    pub(super) fn start(writer: Writer, tasks: &TaskTracker) -> Self {
        let (queue, mut ids) = mpsc::unbounded_channel();
        tasks.spawn(async move {
            loop {
                tokio::select! {
                    id = ids.recv() => match id {
                        Some(id) if sweep(&writer, id).await.is_ok() => {}
                        _ => return,
                    },
                    () = writer.closed() => return,
                }
            }
        });
        Self(queue)
    }

    /// Removes the definition `id` some time soon, unless it is a model's.
    pub(super) fn sweep(&self, id: i64) {
        // If the task has ended, the next service finds what is left.
        let _ = self.0.send(id);
    }
}

/// Fails only if the writer is closed.
async fn sweep(writer: &Writer, id: i64) -> Result<(), StoreError> {
    /// How long to wait where nothing can be written, as on a full disk, which may be full of this.
    const PAUSE: Duration = Duration::from_secs(5);
    loop {
        match writer.write(SweepDefinition(id)).await {
            Ok(Swept::All) => return Ok(()),
            Ok(Swept::Some) => {}
            Err(StoreError::Closed) => return Err(StoreError::Closed),
            Err(StoreError::Unavailable(_)) => tokio::select! {
                () = tokio::time::sleep(PAUSE) => {}
                () = writer.closed() => return Err(StoreError::Closed),
            },
            Err(error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, id, "a definition is left behind for now");
                return Ok(());
            }
        }
    }
}

impl Store {
    /// Removes, some time soon, the definitions that are no model's. To be called by a service that starts, before it stores any: those
    /// that are being stored cannot be told from those that a killed one has left behind.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn sweep_left_behind(&self) -> Result<(), StoreError> {
        let left = sqlx::query_scalar(
            "SELECT id FROM (SELECT id FROM definitions UNION SELECT definition_id FROM definition_pieces)
             WHERE NOT EXISTS (SELECT 1 FROM models WHERE definition_id = id)",
        );
        for id in left.fetch_all(&mut *self.reader().await?).await? {
            self.sweeper.sweep(id);
        }
        Ok(())
    }

    /// Begins to store a definition in pieces.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn begin_pieces(&self) -> Result<NewPieces, StoreError> {
        let id = self.writer.write(BeginDefinition).await?;
        Ok(NewPieces { id, n_pieces: 0, sweeper: self.sweeper.clone() })
    }

    /// Stores the next piece of a definition: text of at most [`PIECE_BYTES`].
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_piece(&self, definition: &mut NewPieces, text: Vec<u8>) -> Result<(), StoreError> {
        let compress = move || zstd::bulk::compress(&text, COMPRESSION_LEVEL);
        let compressed = self.tasks.spawn_blocking(compress).await.map_err(std::io::Error::other).flatten();
        let piece = compressed.map_err(corrupt("definition_pieces", "piece"))?;
        let (definition_id, seq) = (definition.id, definition.n_pieces);
        definition.n_pieces += 1;
        self.writer.write(AddPiece { definition_id, seq, piece }).await
    }

    /// The text of the piece `seq` of the definition `definition_id`; `None` after the last one.
    ///
    /// # Errors
    ///
    /// [`StoreError::Removed`] if the definition is no model's any more, [`StoreError::Corrupt`] if it has no first piece, or if
    /// the database failed.
    pub async fn piece(&self, definition_id: i64, seq: i64) -> Result<Option<Vec<u8>>, StoreError> {
        let query = sqlx::query_scalar("SELECT piece FROM definition_pieces WHERE definition_id = $1 AND seq = $2");
        let query = query.bind(definition_id).bind(seq);
        let Some(piece): Option<Vec<u8>> = query.fetch_optional(&mut *self.reader().await?).await? else {
            // Pieces are only ever removed once the model is.
            return match is_a_models(definition_id).fetch_one(&mut *self.reader().await?).await? {
                false => Err(StoreError::Removed),
                true if seq == 0 => Err(corrupt("definition_pieces", "seq")("the first piece is missing")),
                true => Ok(None),
            };
        };
        let decompress = move || zstd::bulk::decompress(&piece, PIECE_BYTES);
        let text = self.tasks.spawn_blocking(decompress).await.map_err(std::io::Error::other).flatten();
        text.map(Some).map_err(corrupt("definition_pieces", "piece"))
    }
}

/// Begins a definition, and gives its id.
#[derive(Debug)]
struct BeginDefinition;

impl Verb for BeginDefinition {
    type Answer = i64;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<i64, StoreError> {
        begin(writing.connection().await?).await
    }
}

/// A new id.
pub(super) async fn begin(connection: &mut SqliteConnection) -> Result<i64, StoreError> {
    let inserted = sqlx::query("INSERT INTO definitions DEFAULT VALUES").execute(connection).await?;
    Ok(inserted.last_insert_rowid())
}

/// Stores a piece of a definition.
#[derive(Debug)]
struct AddPiece {
    definition_id: i64,
    seq: i64,
    /// Compressed.
    piece: Vec<u8>,
}

impl Verb for AddPiece {
    type Answer = ();

    fn n_bytes(&self) -> usize {
        self.piece.len()
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<(), StoreError> {
        sqlx::query("INSERT INTO definition_pieces (definition_id, seq, piece) VALUES ($1, $2, $3)")
            .bind(self.definition_id)
            .bind(self.seq)
            .bind(&self.piece)
            .execute(writing.connection().await?)
            .await?;
        Ok(())
    }
}

fn is_a_models<'q>(definition_id: i64) -> QueryScalar<'q, Sqlite, bool, SqliteArguments> {
    sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM models WHERE definition_id = $1)").bind(definition_id)
}

/// Whether a definition has been begun, and has `n_pieces`.
pub(super) async fn is_whole(
    connection: &mut SqliteConnection,
    definition_id: i64,
    n_pieces: i64,
) -> Result<bool, StoreError> {
    let query = sqlx::query_scalar(
        "SELECT EXISTS (SELECT 1 FROM definitions WHERE id = $1)
             AND $2 = (SELECT count(*) FROM definition_pieces WHERE definition_id = $1)",
    );
    Ok(query.bind(definition_id).bind(n_pieces).fetch_one(connection).await?)
}

/// Removes some pieces of a definition, unless it is a model's.
#[derive(Debug)]
struct SweepDefinition(i64);

/// What was removed of a definition.
#[derive(Debug)]
enum Swept {
    /// Some of its pieces.
    Some,
    /// All that is to be removed.
    All,
}

impl Verb for SweepDefinition {
    type Answer = Swept;

    /// Several pieces. As they are large, this comes behind those that were sent before.
    fn n_bytes(&self) -> usize {
        MAX_LARGE_BYTES
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Swept, StoreError> {
        let Self(id) = *self;
        if is_a_models(id).fetch_one(writing.connection().await?).await? {
            return Ok(Swept::All);
        }
        let removed = sqlx::query(
            "DELETE FROM definition_pieces WHERE definition_id = $1 AND seq IN
                 (SELECT seq FROM definition_pieces WHERE definition_id = $1 ORDER BY seq DESC LIMIT $2)",
        );
        let removed = removed.bind(id).bind(N_SWEPT_AT_ONCE).execute(writing.connection().await?).await?;
        if removed.rows_affected() > 0
            || super::batches::remove_some(writing.connection().await?, id).await?
            || super::tallies::remove_some(writing.connection().await?, id).await?
        {
            return Ok(Swept::Some);
        }
        sqlx::query("DELETE FROM definitions WHERE id = $1").bind(id).execute(writing.connection().await?).await?;
        Ok(Swept::All)
    }
}

#[cfg(test)]
mod tests;
