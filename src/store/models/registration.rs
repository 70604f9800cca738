//! Registering models, and replacing them.

use super::{
    DeletedModel, ModelRegistration, NewDefinition, NewModel, Replaces, UNKNOWN, delete, note_change, read_summary,
};
use crate::store::definitions::{self, NewPieces};
use crate::store::statements::Statements;
use crate::store::writer::{MAX_LARGE_BYTES, Verb, Writing};
use crate::store::{StoreError, as_integer, corrupt};

impl Verb for NewModel {
    type Answer = (ModelRegistration, Option<DeletedModel>);

    fn n_bytes(&self) -> usize {
        match &self.definition {
            NewDefinition::Text(text) => text.len(),
            // It may have as many labels, which are stored once more.
            NewDefinition::Pieces(_) => MAX_LARGE_BYTES,
        }
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Self::Answer, StoreError> {
        let registered = register(writing.statements, self).await?;
        if let ModelRegistration::Created(_) | ModelRegistration::Replaced(_) = registered.0 {
            note_change(writing, &self.summary.name).await?;
        }
        Ok(registered)
    }
}

async fn register(
    statements: &mut Statements<'_>,
    model: &NewModel,
) -> Result<(ModelRegistration, Option<DeletedModel>), StoreError> {
    let NewModel { summary, definition, replaces } = model;
    let mut replaced = None;
    if *replaces != Replaces::Nothing {
        let query = "SELECT hash, coalesce(definition_hash, hash) FROM models WHERE name = $1";
        let query = sqlx::query_as::<_, (String, String)>(query).bind(&summary.name);
        let connection = statements.connection().await?;
        match query.fetch_optional(&mut *connection).await? {
            None => return Ok((ModelRegistration::Conflict { existing_hash: None }, None)),
            Some((hash, definition_hash)) if definition_hash != summary.hash && replaces.admits(&hash) => {
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
    let inserted = statements.add(
        "INSERT INTO models
             (name, hash, definition, definition_id, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe,
              created_at_ms, definition_hash)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (name) DO NOTHING RETURNING name",
    );
    inserted.bind(&summary.name).bind(&summary.hash).bind(text).bind(definition_id);
    inserted.bind(serde_json::to_string(&summary.attributes).map_err(json)?);
    inserted.bind(serde_json::to_string(&summary.actions).map_err(json)?);
    inserted.bind(summary.size.map_or(UNKNOWN, |size| as_integer(size.n_states)));
    inserted.bind(summary.size.map_or(UNKNOWN, |size| as_integer(size.n_transitions)));
    inserted.bind(as_integer(summary.n_stochastic)).bind(as_integer(summary.n_unsafe));
    inserted.bind(summary.created_at.as_millisecond()).bind(&summary.definition_hash);
    let was_inserted = statements.fetch().await?.is_some();
    let connection = statements.connection().await?;
    if was_inserted {
        if let NewDefinition::Pieces(NewPieces { id, n_pieces, .. }) = definition
            && !definitions::is_whole(&mut *connection, *id, *n_pieces).await?
        {
            // Takes the insertion back.
            return Err(StoreError::Lost);
        }
        if summary.definition_hash.is_some() && definition_id.is_none() {
            // What it will be told is kept under this id.
            let id = definitions::begin(&mut *connection).await?;
            let query = sqlx::query("UPDATE models SET definition_id = $1 WHERE name = $2").bind(id);
            query.bind(&summary.name).execute(connection).await?;
        }
        let summary = summary.clone();
        let created = if replaced.is_some() { ModelRegistration::Replaced } else { ModelRegistration::Created };
        return Ok((created(summary), replaced));
    }
    let query = sqlx::query(
        "SELECT name, hash, definition_hash, attributes, actions, n_states, n_transitions, n_stochastic, n_unsafe, created_at_ms
         FROM models WHERE name = $1",
    );
    let query = query.bind(&summary.name);
    let existing = read_summary(&query.fetch_one(connection).await?)?;
    let registration = if existing.definition_hash() == summary.hash {
        ModelRegistration::Unchanged(existing)
    } else {
        ModelRegistration::Conflict { existing_hash: Some(existing.hash) }
    };
    Ok((registration, None))
}
