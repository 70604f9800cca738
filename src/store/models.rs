//! The table of models.

use jiff::Timestamp;
use sqlx::Row;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::definitions::{self, NewPieces};
use super::page::Rows;
use super::writer::{MAX_LARGE_BYTES, Verb, Writing};
use super::{Deletion, Page, Store, StoreError, as_integer, corrupt, count, page, timestamp};
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
    /// What it may take the place of.
    pub replaces: Replaces,
}

/// Which model of the same name a new one takes the place of.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Replaces {
    /// None: the name must be free.
    #[default]
    Nothing,
    /// Whichever is there. One must be.
    Any,
    /// One with one of these hashes.
    OneOf(Vec<String>),
}

impl Replaces {
    /// Whether it may take the place of a model with this hash.
    #[must_use]
    pub fn admits(&self, hash: &str) -> bool {
        match self {
            Self::Nothing => false,
            Self::Any => true,
            Self::OneOf(hashes) => hashes.iter().any(|admitted| admitted == hash),
        }
    }
}

/// What became of the registration of a model.
#[derive(Clone, Debug, PartialEq)]
pub enum ModelRegistration {
    /// It is new.
    Created(ModelSummary),
    /// It took the place of another one.
    Replaced(ModelSummary),
    /// The same content was there already, under the same name.
    Unchanged(ModelSummary),
    /// It may not take the place of what is there, which was left alone.
    Conflict {
        /// The hash of that; `None` if nothing is there, though something must be.
        existing_hash: Option<String>,
    },
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

/// A model that was deleted, or replaced.
#[derive(Debug)]
pub(super) struct DeletedModel {
    /// Of a definition in pieces.
    definition_id: Option<i64>,
}

impl Store {
    /// Registers a model, unless it may not take the place of what has its name.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn register_model(&self, model: NewModel) -> Result<ModelRegistration, StoreError> {
        let (registration, replaced) = self.writer.write(model).await?;
        if let Some(id) = replaced.and_then(|replaced| replaced.definition_id) {
            self.sweeper.sweep(id);
        }
        Ok(registration)
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
    type Answer = (ModelRegistration, Option<DeletedModel>);

    fn n_bytes(&self) -> usize {
        match &self.definition {
            NewDefinition::Text(text) => text.len(),
            // It may have as many labels, which are stored once more.
            NewDefinition::Pieces(_) => MAX_LARGE_BYTES,
        }
    }

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Self::Answer, StoreError> {
        let registered = register(writing.connection, self).await?;
        if let ModelRegistration::Created(_) | ModelRegistration::Replaced(_) = registered.0 {
            note_change(writing).await?;
        }
        Ok(registered)
    }
}

impl Verb for DeleteModel {
    type Answer = Option<DeletedModel>;

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Option<DeletedModel>, StoreError> {
        let deleted = delete(writing.connection, &self.0).await?;
        if deleted.is_some() {
            note_change(writing).await?;
        }
        Ok(deleted)
    }
}

async fn delete(connection: &mut SqliteConnection, name: &str) -> Result<Option<DeletedModel>, StoreError> {
    let query = sqlx::query_scalar("DELETE FROM models WHERE name = $1 RETURNING definition_id").bind(name);
    Ok(query.fetch_optional(connection).await?.map(|definition_id| DeletedModel { definition_id }))
}

/// Counts a registration, replacement or deletion.
async fn note_change(writing: &mut Writing<'_>) -> Result<(), StoreError> {
    let query = "UPDATE service SET models_generation = models_generation + 1 RETURNING models_generation";
    let row = sqlx::query(query).fetch_one(&mut *writing.connection).await?;
    writing.effects.models_generation = Some(count(&row, "service", "models_generation")?);
    Ok(())
}

async fn register(
    connection: &mut SqliteConnection,
    model: &NewModel,
) -> Result<(ModelRegistration, Option<DeletedModel>), StoreError> {
    let NewModel { summary, definition, replaces } = model;
    let mut replaced = None;
    if *replaces != Replaces::Nothing {
        let query = sqlx::query_scalar::<_, String>("SELECT hash FROM models WHERE name = $1").bind(&summary.name);
        match query.fetch_optional(&mut *connection).await? {
            None => return Ok((ModelRegistration::Conflict { existing_hash: None }, None)),
            Some(hash) if hash != summary.hash && replaces.admits(&hash) => {
                replaced = delete(&mut *connection, &summary.name).await?;
            }
            Some(_) => {}
        }
    }
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
        let summary = summary.clone();
        let created = if replaced.is_some() { ModelRegistration::Replaced } else { ModelRegistration::Created };
        return Ok((created(summary), replaced));
    }
    let query = sqlx::query(
        "SELECT name, hash, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe, created_at_ms
         FROM models WHERE name = $1",
    );
    let query = query.bind(&summary.name);
    let existing = read_summary(&query.fetch_one(connection).await?)?;
    let registration = if existing.hash == summary.hash {
        ModelRegistration::Unchanged(existing)
    } else {
        ModelRegistration::Conflict { existing_hash: Some(existing.hash) }
    };
    Ok((registration, None))
}
