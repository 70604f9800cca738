//! The registry of models.

use std::sync::Arc;

use jiff::{Timestamp, Unit};
use serde_json::value::RawValue;

use super::pool::Admission;
use super::{Etude, Name, ServiceError};
use crate::attribute::AttributeDocument;
use crate::document;
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::Mapper;
use crate::model::{ActionDocument, CompileError, Definition, Limits, Model, hash_of};
use crate::store::{ModelKey, ModelSize, ModelSummary, NewModel, Page, PutModel, StoreError};

/// A model and its definition, as registered.
#[derive(Debug)]
pub struct ModelAnswer {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// The definition in canonical form: JSON.
    pub definition: Box<RawValue>,
}

/// Whether a registration changed anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Registered {
    /// The model is new.
    New,
    /// The same model was there already.
    Already,
}

impl Etude {
    /// Registers the model in `body` (JSON) under `name`.
    ///
    /// # Errors
    ///
    /// If the body is no model, the name is taken by another one, or the service cannot do it now.
    pub async fn put_model(
        &self,
        name: &Name,
        body: impl AsRef<[u8]> + Send + 'static,
        now: Timestamp,
    ) -> Result<(Registered, ModelSummary), ServiceError> {
        let limits = self.limits;
        let place = self.pool.admit()?;
        let prepared = place.run(None, move |interrupt| prepare(body.as_ref(), limits, interrupt)).await??;
        drop(place);
        let Prepared { definition, hash, mapper, attributes, actions } = prepared;
        let model = mapper.model();
        let summary = ModelSummary {
            name: name.to_string(),
            hash,
            attributes,
            actions,
            size: (!model.is_lazy()).then(|| ModelSize {
                n_states: model.graph().n_states() as u64,
                n_transitions: model.n_transitions() as u64,
            }),
            n_unsafe: model.n_unsafe() as u64,
            // As exact as it is stored.
            created_at: now.round(Unit::Millisecond).unwrap_or(now),
        };
        let key = ModelKey { hash: summary.hash.clone(), is_lazy: model.is_lazy() };
        let (registered, summary) = match self.store.put_model(NewModel { summary, definition }).await? {
            PutModel::Created(summary) => (Registered::New, summary),
            PutModel::Unchanged(summary) => (Registered::Already, summary),
            PutModel::Conflict { existing_hash } => {
                return Err(ServiceError::Conflict { kind: "model", name: name.to_string(), existing_hash });
            }
        };
        self.mappers.insert(key, Arc::new(mapper));
        Ok((registered, summary))
    }

    /// The model called `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn model(&self, name: &Name) -> Result<ModelAnswer, ServiceError> {
        let row = self.store.model(name.as_str()).await?.ok_or_else(|| unknown(name.as_str(), None))?;
        let definition = RawValue::from_string(row.definition).map_err(|error| corrupt_definition(error.into()))?;
        Ok(ModelAnswer { summary: row.summary, definition })
    }

    /// At most `limit` models in the order of their names, from the first after `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn models(&self, after: Option<&str>, limit: u32) -> Result<Page<ModelSummary>, ServiceError> {
        Ok(self.store.models(after, limit).await?)
    }

    /// Deletes the model called `name`. Policies made with it stay.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn delete_model(&self, name: &Name) -> Result<(), ServiceError> {
        if self.store.delete_model(name.as_str()).await? { Ok(()) } else { Err(unknown(name.as_str(), None)) }
    }

    /// The model called `name`, ready to be searched, and its hash. `pointer` is where a request names it; what must be
    /// compiled is compiled by its `place` in the pool, if it has one.
    pub(super) async fn mapper(
        &self,
        name: &str,
        pointer: &'static str,
        place: Option<&Admission>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        let unknown = || unknown(name, Some(pointer));
        let key = self.store.model_key(name).await?.ok_or_else(unknown)?;
        let (hash, is_lazy) = (key.hash.clone(), key.is_lazy);
        let compile = async {
            // Deleted and registered anew in between, it has another hash; then the next request finds that.
            let row = self.store.model(name).await?.filter(|row| row.summary.hash == hash).ok_or_else(unknown)?;
            // What it was found to be when it was registered, whatever the limit is now.
            let limits = Limits { max_states: if is_lazy { 0 } else { usize::MAX } };
            let text = row.definition;
            let job = move |interrupt: &mut dyn Interrupt| prepare(text.as_bytes(), limits, interrupt);
            let prepared = match place {
                Some(place) => place.run(None, job).await?,
                None => self.pool.run_patiently(job).await?,
            };
            // What was once accepted is read again without faults.
            let prepared = prepared.map_err(|error| corrupt_definition(error.into()))?;
            Ok::<_, ServiceError>(Arc::new(prepared.mapper))
        };
        let mapper = self.mappers.get_or_compile(&key, compile).await?;
        Ok((hash, mapper))
    }
}

fn unknown(name: &str, pointer: Option<&'static str>) -> ServiceError {
    ServiceError::Unknown { kind: "model", name: name.to_owned(), pointer }
}

fn corrupt_definition(source: Box<dyn std::error::Error + Send + Sync>) -> ServiceError {
    StoreError::Corrupt { table: "models", column: "definition", source }.into()
}

struct Prepared {
    /// The canonical text.
    definition: String,
    hash: String,
    mapper: Mapper,
    attributes: Vec<AttributeDocument>,
    actions: Vec<ActionDocument>,
}

/// Reads and compiles a model.
fn prepare(
    text: &[u8],
    limits: Limits,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Prepared, ServiceError>, Cancelled> {
    let definition = match document::parse(text) {
        Ok(document) => Definition::read(&document, limits, interrupt),
        Err(error) => return Ok(Err(error.into())),
    };
    let definition = match definition {
        Ok(definition) => definition,
        Err(CompileError::Faults(faults)) => return Ok(Err(faults.into())),
        Err(CompileError::Cancelled(cancelled)) => return Err(cancelled),
    };
    let model = Model::compile(&definition, limits, interrupt)?;
    let attributes = model.schema().attributes().iter().map(AttributeDocument::from).collect();
    let actions = model.actions().iter().map(ActionDocument::from).collect();
    let mapper = Mapper::new(model, interrupt)?;
    let definition = definition.document().text();
    let hash = hash_of(&definition);
    Ok(Ok(Prepared { definition, hash, mapper, attributes, actions }))
}
