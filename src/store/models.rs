//! The table of models.

mod registration;

use jiff::Timestamp;
use sqlx::Row;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::definitions::NewPieces;
use super::page::Rows;
use super::writer::{Verb, Writing};
use super::{Deletion, Page, Store, StoreError, corrupt, count, page, timestamp};
use etude_core::attribute::AttributeDocument;
use etude_core::model::ActionDocument;

/// What is kept of a model besides its definition.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSummary {
    /// The name it is registered under.
    pub name: String,
    /// SHA-256 of its canonical text; of a model of experience, one over that and what it was told.
    pub hash: String,
    /// SHA-256 of the canonical text of a model of experience.
    pub definition_hash: Option<String>,
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

impl ModelSummary {
    /// SHA-256 of its canonical text.
    #[must_use]
    pub fn definition_hash(&self) -> &str {
        self.definition_hash.as_ref().unwrap_or(&self.hash)
    }
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
    /// As in its summary.
    pub hash: String,
    /// Whether it is searched lazily, which the limit on states has decided when the model was registered.
    pub is_lazy: bool,
}

/// What there is to know of a model before anything else.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelHead {
    /// Its key.
    pub key: ModelKey,
    /// As in [`ModelRecord`].
    pub experience: Option<i64>,
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
    /// What a model of experience was told, by the id under which [`Store::batches`] gives it.
    pub experience: Option<i64>,
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
    /// Of a definition in pieces, or of what it was told.
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
            let (text, id): (String, Option<i64>) = (row.try_get("definition")?, row.try_get("definition_id")?);
            let definition = match id {
                Some(id) if text.is_empty() => StoredDefinition::Pieces(id),
                _ => StoredDefinition::Text(text),
            };
            let summary = read_summary(&row)?;
            let experience = id.filter(|_| summary.definition_hash.is_some());
            Ok(ModelRecord { summary, definition, experience })
        };
        row.map(read).transpose()
    }

    /// The key of the model called `name`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn model_key(&self, name: &str) -> Result<Option<ModelKey>, StoreError> {
        Ok(self.model_head(name).await?.map(|head| head.key))
    }

    /// The key of the model called `name`, and by which id [`Self::batches`] gives what it was told.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn model_head(&self, name: &str) -> Result<Option<ModelHead>, StoreError> {
        let query = sqlx::query("SELECT hash, definition_hash, definition_id, n_states FROM models WHERE name = $1");
        let row = query.bind(name).fetch_optional(&mut *self.reader().await?).await?;
        let read = |row: SqliteRow| {
            let is_experience = row.try_get::<Option<String>, _>("definition_hash")?.is_some();
            let is_lazy = !is_experience && row.try_get::<i64, _>("n_states")? == UNKNOWN;
            let experience = row.try_get::<Option<i64>, _>("definition_id")?.filter(|_| is_experience);
            Ok(ModelHead { key: ModelKey { hash: row.try_get("hash")?, is_lazy }, experience })
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
            "SELECT name, hash, definition_hash, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe, created_at_ms
             FROM models WHERE name > $1 ORDER BY name LIMIT $2",
        );
        let rows = query.bind(after.unwrap_or_default()).bind(n_rows).fetch(&mut *reader);
        Rows { table: "models", key: "name", name: "name", long: &["attributes", "actions"], read: read_summary }
            .page(rows, n_rows, rest)
            .await
    }
}

/// Stands for a number of states that is not known. No model has so few, but one of which nothing was experienced.
const UNKNOWN: i64 = 0;

fn read_summary(row: &SqliteRow) -> Result<ModelSummary, StoreError> {
    const TABLE: &str = "models";
    let count = |column| count(row, TABLE, column);
    let definition_hash: Option<String> = row.try_get("definition_hash")?;
    Ok(ModelSummary {
        name: row.try_get("name")?,
        hash: row.try_get("hash")?,
        attributes: serde_json::from_str(row.try_get("attributes")?).map_err(corrupt(TABLE, "attributes"))?,
        actions: serde_json::from_str(row.try_get("actions")?).map_err(corrupt(TABLE, "actions"))?,
        size: match row.try_get::<i64, _>("n_states")? {
            UNKNOWN if definition_hash.is_none() => None,
            _ => Some(ModelSize { n_states: count("n_states")?, n_transitions: count("n_transitions")? }),
        },
        n_stochastic: count("n_stochastic")?,
        n_unsafe: count("n_unsafe")?,
        created_at: timestamp(TABLE, "created_at_ms", row.try_get("created_at_ms")?)?,
        definition_hash,
    })
}

impl Verb for DeleteModel {
    type Answer = Option<DeletedModel>;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Option<DeletedModel>, StoreError> {
        let deleted = delete(writing.connection().await?, &self.0).await?;
        if deleted.is_some() {
            note_change(writing, &self.0).await?;
        }
        Ok(deleted)
    }
}

async fn delete(connection: &mut SqliteConnection, name: &str) -> Result<Option<DeletedModel>, StoreError> {
    let query = sqlx::query_scalar("DELETE FROM models WHERE name = $1 RETURNING definition_id").bind(name);
    Ok(query.fetch_optional(connection).await?.map(|definition_id| DeletedModel { definition_id }))
}

/// Counts a registration, change or deletion of the model called `name`.
pub(super) async fn note_change(writing: &mut Writing<'_, '_>, name: &str) -> Result<(), StoreError> {
    let counted = "UPDATE service SET models_generation = models_generation + 1 RETURNING models_generation";
    writing.statements.add(counted);
    let row = writing.statements.fetch().await?.ok_or(sqlx::Error::RowNotFound)?;
    let generation = count(&row, "service", "models_generation")?;
    writing.effects.changed_models.push((name.to_owned(), generation));
    Ok(())
}
