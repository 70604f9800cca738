//! The table of models.

use jiff::Timestamp;
use sqlx::Row;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::definitions::{self, NewPieces};
use super::page::Rows;
use super::writer::{MAX_LARGE_BYTES, Verb, Writing};
use super::{Deletion, Page, Registration, Store, StoreError, as_integer, corrupt, count, page, timestamp};
use etude_core::attribute::AttributeDocument;
use etude_core::model::ActionDocument;

/// What is kept of a model besides its definition.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSummary {
    /// The name it is registered under.
    pub name: String,
    /// SHA-256 of its canonical text.
    pub hash: String,
    /// Its attributes, in order.
    pub attributes: Vec<AttributeDocument>,
    /// The actions of the body, in order.
    pub actions: Vec<ActionDocument>,
    /// How many states and transitions it has; `None` if it is searched lazily.
    pub size: Option<ModelSize>,
    /// Of how many states and actions there are several outcomes.
    pub n_stochastic: u64,
    /// How many of its states are unsafe.
    pub n_unsafe: u64,
    /// When it was registered.
    pub created_at: Timestamp,
}

/// How large a model is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ModelSize {
    /// How many states it has.
    pub n_states: u64,
    /// How many transitions it has.
    pub n_transitions: u64,
}

/// The key of a compiled model.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ModelKey {
    /// SHA-256 of its canonical text.
    pub hash: String,
    /// Whether it is searched lazily, which the limit on states has decided when the model was registered.
    pub is_lazy: bool,
}

/// A model to be registered.
#[derive(Debug)]
pub struct NewModel {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// Its canonical text.
    pub definition: NewDefinition,
}

/// The canonical text of a model to be registered.
#[derive(Debug)]
pub enum NewDefinition {
    /// As a whole.
    Text(String),
    /// In pieces, all of which are stored.
    Pieces(NewPieces),
}

/// A model as it is stored.
#[derive(Clone, Debug)]
pub struct ModelRecord {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// Its canonical text.
    pub definition: StoredDefinition,
}

/// The canonical text of a model as it is stored.
#[derive(Clone, Debug)]
pub enum StoredDefinition {
    /// As a whole.
    Text(String),
    /// In pieces, by the id under which [`Store::piece`] gives them.
    Pieces(i64),
}

/// Deletes a model.
#[derive(Debug)]
struct DeleteModel(String);

/// A model that was deleted.
#[derive(Debug)]
struct DeletedModel {
    /// Of a definition in pieces.
    definition_id: Option<i64>,
}

impl Store {
    /// Registers a model, unless its name is taken.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn register_model(&self, model: NewModel) -> Result<Registration<ModelSummary>, StoreError> {
        self.writer.write(model).await
    }

    /// Deletes a model.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_model(&self, name: &str) -> Result<Deletion, StoreError> {
        let Some(deleted) = self.writer.write(DeleteModel(name.to_owned())).await? else {
            return Ok(Deletion::Unknown);
        };
        if let Some(id) = deleted.definition_id {
            self.sweeper.sweep(id);
        }
        Ok(Deletion::Deleted)
    }

    /// The model called `name`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn model(&self, name: &str) -> Result<Option<ModelRecord>, StoreError> {
        let query = sqlx::query("SELECT * FROM models WHERE name = $1").bind(name);
        let row = query.fetch_optional(&mut *self.reader().await?).await?;
        let read = |row: SqliteRow| {
            let definition = match row.try_get("definition_id")? {
                Some(id) => StoredDefinition::Pieces(id),
                None => StoredDefinition::Text(row.try_get("definition")?),
            };
            Ok(ModelRecord { summary: read_summary(&row)?, definition })
        };
        row.map(read).transpose()
    }

    /// The key of the model called `name`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn model_key(&self, name: &str) -> Result<Option<ModelKey>, StoreError> {
        let query = sqlx::query("SELECT hash, n_states FROM models WHERE name = $1").bind(name);
        let row = query.fetch_optional(&mut *self.reader().await?).await?;
        let read = |row: SqliteRow| {
            Ok(ModelKey { hash: row.try_get("hash")?, is_lazy: row.try_get::<i64, _>("n_states")? == UNKNOWN })
        };
        row.map(read).transpose()
    }

    /// How many bytes of text the attributes and actions of the model called `name` are; 0 if there is none.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn summary_bytes(&self, name: &str) -> Result<u64, StoreError> {
        let sizes = "SELECT octet_length(attributes) + octet_length(actions) FROM models WHERE name = $1";
        let size: Option<i64> = sqlx::query_scalar(sizes).bind(name).fetch_optional(&mut *self.reader().await?).await?;
        Ok(size.unwrap_or_default().unsigned_abs())
    }

    /// The same of the first model after `after` in the order of their names. A page of models has no more, unless that is little.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn first_summary_bytes(&self, after: Option<&str>) -> Result<u64, StoreError> {
        let sizes =
            "SELECT octet_length(attributes) + octet_length(actions) FROM models WHERE name > $1 ORDER BY name LIMIT 1";
        let sizes = sqlx::query_scalar(sizes).bind(after.unwrap_or_default());
        let size: Option<i64> = sizes.fetch_optional(&mut *self.reader().await?).await?;
        Ok(size.unwrap_or_default().unsigned_abs())
    }

    /// At most `limit` models in the order of their names, from the first after `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn models(&self, after: Option<&str>, limit: u32) -> Result<Page<ModelSummary>, StoreError> {
        // Labels may be so long that even a few models are not read ahead.
        let sizes = "SELECT octet_length(attributes) + octet_length(actions) FROM models WHERE name > $1 ORDER BY name LIMIT $2";
        let sizes = sqlx::query_scalar(sizes).bind(after.unwrap_or_default()).bind(i64::from(limit) + 1);
        let mut reader = self.reader().await?;
        let sizes: Vec<i64> = sizes.fetch_all(&mut *reader).await?;
        let (n_rows, rest) = page::fitting(&sizes, limit);
        let query = sqlx::query(
            "SELECT name, hash, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe, created_at_ms
             FROM models WHERE name > $1 ORDER BY name LIMIT $2",
        );
        let rows = query.bind(after.unwrap_or_default()).bind(n_rows).fetch(&mut *reader);
        Rows { table: "models", key: "name", name: "name", long: &["attributes", "actions"], read: read_summary }
            .page(rows, n_rows, rest)
            .await
    }
}

/// Stands for a number of states that is not known. No model has so few.
const UNKNOWN: i64 = 0;

fn read_summary(row: &SqliteRow) -> Result<ModelSummary, StoreError> {
    const TABLE: &str = "models";
    let count = |column| count(row, TABLE, column);
    Ok(ModelSummary {
        name: row.try_get("name")?,
        hash: row.try_get("hash")?,
        attributes: serde_json::from_str(row.try_get("attributes")?).map_err(corrupt(TABLE, "attributes"))?,
        actions: serde_json::from_str(row.try_get("actions")?).map_err(corrupt(TABLE, "actions"))?,
        size: match row.try_get::<i64, _>("n_states")? {
            UNKNOWN => None,
            _ => Some(ModelSize { n_states: count("n_states")?, n_transitions: count("n_transitions")? }),
        },
        n_stochastic: count("n_stochastic")?,
        n_unsafe: count("n_unsafe")?,
        created_at: timestamp(TABLE, "created_at_ms", row.try_get("created_at_ms")?)?,
    })
}

impl Verb for NewModel {
    type Answer = Registration<ModelSummary>;

    fn n_bytes(&self) -> usize {
        match &self.definition {
            NewDefinition::Text(text) => text.len(),
            // It may have as many labels, which are stored once more.
            NewDefinition::Pieces(_) => MAX_LARGE_BYTES,
        }
    }

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Registration<ModelSummary>, StoreError> {
        let registration = register(writing.connection, self).await?;
        if let Registration::Created(_) = registration {
            note_change(writing).await?;
        }
        Ok(registration)
    }
}

impl Verb for DeleteModel {
    type Answer = Option<DeletedModel>;

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Option<DeletedModel>, StoreError> {
        let query = sqlx::query_scalar("DELETE FROM models WHERE name = $1 RETURNING definition_id").bind(&self.0);
        let deleted = query.fetch_optional(&mut *writing.connection).await?;
        if deleted.is_some() {
            note_change(writing).await?;
        }
        Ok(deleted.map(|definition_id| DeletedModel { definition_id }))
    }
}

/// Counts a registration or deletion.
async fn note_change(writing: &mut Writing<'_>) -> Result<(), StoreError> {
    let query = "UPDATE service SET models_generation = models_generation + 1 RETURNING models_generation";
    let row = sqlx::query(query).fetch_one(&mut *writing.connection).await?;
    writing.effects.models_generation = Some(count(&row, "service", "models_generation")?);
    Ok(())
}

async fn register(
    connection: &mut SqliteConnection,
    model: &NewModel,
) -> Result<Registration<ModelSummary>, StoreError> {
    let NewModel { summary, definition } = model;
    let (text, definition_id) = match definition {
        NewDefinition::Text(text) => (text.as_str(), None),
        NewDefinition::Pieces(pieces) => ("", Some(pieces.id)),
    };
    let json = |source: serde_json::Error| corrupt("models", "attributes")(source);
    let inserted = sqlx::query(
        "INSERT INTO models
             (name, hash, definition, definition_id, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe,
              created_at_ms)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11) ON CONFLICT (name) DO NOTHING",
    )
    .bind(&summary.name)
    .bind(&summary.hash)
    .bind(text)
    .bind(definition_id)
    .bind(serde_json::to_string(&summary.attributes).map_err(json)?)
    .bind(serde_json::to_string(&summary.actions).map_err(json)?)
    .bind(summary.size.map_or(UNKNOWN, |size| as_integer(size.n_states)))
    .bind(summary.size.map_or(UNKNOWN, |size| as_integer(size.n_transitions)))
    .bind(as_integer(summary.n_stochastic))
    .bind(as_integer(summary.n_unsafe))
    .bind(summary.created_at.as_millisecond())
    .execute(&mut *connection)
    .await?;
    if inserted.rows_affected() == 1 {
        if let NewDefinition::Pieces(NewPieces { id, n_pieces, .. }) = definition
            && !definitions::is_whole(connection, *id, *n_pieces).await?
        {
            // Takes the insertion back.
            return Err(StoreError::Lost);
        }
        return Ok(Registration::Created(summary.clone()));
    }
    let query = sqlx::query(
        "SELECT name, hash, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe, created_at_ms
         FROM models WHERE name = $1",
    );
    let query = query.bind(&summary.name);
    let existing = read_summary(&query.fetch_one(connection).await?)?;
    Ok(if existing.hash == summary.hash {
        Registration::Unchanged(existing)
    } else {
        Registration::Conflict { existing_hash: existing.hash }
    })
}
