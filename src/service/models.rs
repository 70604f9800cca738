//! The registry of models.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::value::RawValue;
use tokio::sync::mpsc;

use super::compiler::Compiler;
use super::definitions::{
    DefinitionReader, DefinitionWriter, ModelForm, ModelText, check_hash, corrupt_definition, definition_writer,
    unknown,
};
use super::hash::hash_of;
use super::limited::LimitedTime;
use super::pool::Places;
use super::told::revision;
use super::{Caller, Etude, Name, PoolError, ServiceError, as_stored};
use crate::client::Client;
use crate::memory::{Held, NoRoom, SMALL_BYTES};
use crate::store::{
    Deletion, ModelKey, ModelRegistration, ModelSize, ModelSummary, NewDefinition, NewModel, NewPieces, Page, Replaces,
    Revision, StoredDefinition,
};
use etude_core::attribute::AttributeDocument;
use etude_core::interrupt::{Interrupt, Interrupted};
use etude_core::mapping::Mapper;
use etude_core::model::{ActionDocument, Definition, Format, Limits, ReadError, Tally};

/// A model and its definition, as registered.
#[derive(Debug)]
pub struct ModelAnswer {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// The definition.
    pub definition: ModelDefinition,
    /// The memory for the summary, if that is much.
    _held: Option<Held>,
}

/// A definition in canonical form.
#[derive(Debug)]
pub enum ModelDefinition {
    /// JSON.
    Text(Box<RawValue>),
    /// Too large to be kept in memory: read piece by piece.
    Pieces(DefinitionReader),
}

/// Uploads of models that are read as they come. A client that sends slowly takes nothing from others but its own place.
#[derive(Debug)]
pub(super) struct Uploads(Mutex<Places>);

impl Uploads {
    /// Most that are sent at the same time, each of which keeps a thread of the operating system; further ones are refused.
    const MAX_UPLOADS: usize = 64;

    fn admit(&self, client: Client) -> Result<Upload<'_>, PoolError> {
        let is_admitted = self.places().take(client);
        if is_admitted { Ok(Upload { uploads: self, client }) } else { Err(PoolError::Busy) }
    }

    fn places(&self) -> MutexGuard<'_, Places> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Default for Uploads {
    fn default() -> Self {
        Self(Mutex::new(Places::new(Self::MAX_UPLOADS)))
    }
}

/// The right to send a model, until it is dropped.
struct Upload<'u> {
    uploads: &'u Uploads,
    client: Client,
}

impl Drop for Upload<'_> {
    fn drop(&mut self) {
        self.uploads.places().give_back(self.client);
    }
}

/// Whether a registration changed anything.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Registered {
    /// It is new.
    New,
    /// It took the place of another one.
    Instead,
    /// The same was there already.
    Already,
}

impl Etude {
    /// Registers the model in `text` under `name`.
    ///
    /// # Errors
    ///
    /// If the text is no model, the name is taken by another one, or the service cannot do it now.
    pub async fn put_model(
        &self,
        name: &Name,
        text: ModelText,
        format: Format,
        caller: Caller,
    ) -> Result<(Registered, ModelSummary), ServiceError> {
        self.replace_model(name, text, format.into(), Replaces::Nothing, caller).await
    }

    /// Registers the model in `text` under `name`, at once in the place of a model that it `replaces`. Batches of experience that the replaced
    /// one was told are deleted with it. Sessions that run go on with the model that they were opened with, and policies keep its hash; a
    /// session that is resumed and a policy that is to be refined do not find
    /// it any more, as if it were deleted.
    ///
    /// # Errors
    ///
    /// Likewise; [`ServiceError::PreconditionFailed`] if what is there, if anything, is neither to be replaced nor the same.
    pub async fn replace_model(
        &self,
        name: &Name,
        text: ModelText,
        form: ModelForm,
        replaces: Replaces,
        caller: Caller,
    ) -> Result<(Registered, ModelSummary), ServiceError> {
        let limits = self.limits;
        // Unless it can take the name, nothing is stored or compiled: the hash decides whether it is the same model.
        let existing = self.store.model_key(name.as_str()).await?;
        let is_new = existing.map_or(replaces == Replaces::Nothing, |existing| replaces.admits(&existing.hash));
        let (writer, pieces) = definition_writer(is_new);
        let compiler = self.compiler.clone();
        let prepare = move |read: Result<Definition, ReadError>, interrupt: &mut dyn Interrupt| {
            prepare(read?, writer, is_new.then_some(&compiler), limits, interrupt)
        };
        let is_arriving = matches!(text, ModelText::Arriving(_));
        let text = text.counted(&self.memory);
        let (prepared, stored) = if is_arriving {
            let _place = self.uploads.admit(caller.client)?;
            let read = self.pool.run_aside(move |interrupt| Ok(text.read(&form, limits, interrupt))).await?;
            let job = move |interrupt: &mut dyn Interrupt| Ok(prepare(read, interrupt));
            tokio::join!(self.pool.run_in_turn(caller.client, job), self.store_pieces(pieces))
        } else if !is_new && text.is_small() {
            // The name is taken, so nothing is compiled or stored.
            let job = |interrupt: &mut dyn Interrupt| Ok(prepare(text.read(&form, limits, interrupt), interrupt));
            (self.pool.run_here(None, job), Ok(None))
        } else {
            let place = self.pool.admit(caller.client)?;
            let (max_time, clock) = (self.time_limits.compile, self.clock.clone());
            let job = move |interrupt: &mut dyn Interrupt| {
                let read = text.read(&form, limits, &mut LimitedTime::new(interrupt, max_time, clock));
                Ok(prepare(read, interrupt))
            };
            tokio::join!(place.run(None, job), self.store_pieces(pieces))
        };
        // The first error is that of storing: preparing fails because of it.
        let stored = stored?;
        let Prepared { text, hash, compiled } = prepared??;
        let Some(Compiled { content, attributes, actions }) = compiled else {
            // Looked up again, as the model may have been deleted meanwhile.
            return match self.store.model(name.as_str()).await? {
                Some(existing) if existing.summary.definition_hash() == hash => {
                    Ok((Registered::Already, existing.summary))
                }
                None if replaces == Replaces::Nothing => Err(PoolError::Busy.into()),
                existing => Err(conflict(name, &replaces, existing.map(|existing| existing.summary.hash))),
            };
        };
        let summary = ModelSummary {
            name: name.to_string(),
            definition_hash: matches!(content, Content::Experience(_)).then(|| hash.clone()),
            hash,
            attributes,
            actions,
            size: content.size(),
            n_stochastic: content.n_stochastic(),
            n_unsafe: content.n_unsafe(),
            created_at: as_stored(caller.now),
        };
        let key = ModelKey { hash: summary.hash.clone(), is_lazy: content.size().is_none() };
        let definition = match (text, stored) {
            (Some(text), _) => NewDefinition::Text(text),
            (None, Some(pieces)) => NewDefinition::Pieces(pieces),
            (None, None) => return Err(PoolError::Busy.into()),
        };
        let new = NewModel { summary, definition, replaces: replaces.clone() };
        let (registered, summary) = match self.store.register_model(new).await? {
            ModelRegistration::Created(summary) => (Registered::New, summary),
            ModelRegistration::Replaced(summary) => (Registered::Instead, summary),
            ModelRegistration::Unchanged(summary) => (Registered::Already, summary),
            ModelRegistration::Conflict { existing_hash } => return Err(conflict(name, &replaces, existing_hash)),
        };
        match content {
            Content::Mapper(mapper) => self.compiler.put(key, &Arc::from(mapper)).await,
            // What is there may have been told something.
            Content::Experience(_) if registered == Registered::Already => {}
            Content::Experience(_) => self.compiler.experiences.forget(name.as_str()),
        }
        Ok((registered, summary))
    }

    /// Stores pieces as they come; `None` if there are none.
    async fn store_pieces(&self, mut pieces: mpsc::Receiver<Vec<u8>>) -> Result<Option<NewPieces>, ServiceError> {
        let mut stored = None;
        while let Some(piece) = pieces.recv().await {
            let mut definition = match stored {
                Some(definition) => definition,
                None => self.store.begin_pieces().await?,
            };
            self.store.add_piece(&mut definition, piece).await?;
            stored = Some(definition);
        }
        Ok(stored)
    }

    /// The hash of the model called `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn model_hash(&self, name: &Name) -> Result<String, ServiceError> {
        let key = self.store.model_key(name.as_str()).await?;
        Ok(key.ok_or_else(|| unknown(name.as_str(), None))?.hash)
    }

    /// The model called `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn model(&self, name: &Name) -> Result<ModelAnswer, ServiceError> {
        let held = self.take_for_summary(self.store.summary_bytes(name.as_str()).await?)?;
        let row = self.store.model(name.as_str()).await?.ok_or_else(|| unknown(name.as_str(), None))?;
        let definition = match row.definition {
            StoredDefinition::Text(text) => {
                check_hash(name.as_str(), &hash_of(&text), row.summary.definition_hash())?;
                let text = RawValue::from_string(text);
                ModelDefinition::Text(text.map_err(|error| corrupt_definition(name.as_str(), error.into()))?)
            }
            StoredDefinition::Pieces(id) => ModelDefinition::Pieces(DefinitionReader::new(&row.summary, id)),
        };
        Ok(ModelAnswer { summary: row.summary, definition, _held: held })
    }

    /// At most `limit` models in the order of their names, from the first after `after`, and the memory that they take, if that is much.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn models(
        &self,
        after: Option<&str>,
        limit: u32,
    ) -> Result<(Page<ModelSummary>, Option<Held>), ServiceError> {
        let held = self.take_for_summary(self.store.first_summary_bytes(after).await?)?;
        Ok((self.store.models(after, limit).await?, held))
    }

    /// Takes the memory for reading and writing `n_bytes` of attributes and actions, if that is much: labels may have any length.
    fn take_for_summary(&self, n_bytes: u64) -> Result<Option<Held>, NoRoom> {
        const COPIES: u64 = 8;
        (n_bytes > SMALL_BYTES / COPIES).then(|| self.memory.try_take(COPIES * n_bytes)).transpose()
    }

    /// Deletes the model called `name`. Policies made with it stay.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn delete_model(&self, name: &Name) -> Result<(), ServiceError> {
        match self.store.delete_model(name.as_str()).await? {
            Deletion::Deleted => {
                self.compiler.experiences.forget(name.as_str());
                Ok(())
            }
            Deletion::Unknown => Err(unknown(name.as_str(), None)),
        }
    }
}

/// Why a model with this name was not registered.
fn conflict(name: &Name, replaces: &Replaces, existing_hash: Option<String>) -> ServiceError {
    match existing_hash {
        Some(existing_hash) if *replaces == Replaces::Nothing => {
            ServiceError::Conflict { kind: "model", name: name.to_string(), existing_hash }
        }
        existing_hash => ServiceError::PreconditionFailed { name: name.to_string(), existing_hash },
    }
}

impl From<ReadError> for ServiceError {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Parse(error) => error.into(),
            ReadError::Faults(faults) => faults.into(),
            ReadError::Cancelled(cancelled) => Interrupted::from(cancelled).into(),
            ReadError::OutOfTime => Interrupted::OutOfTime.into(),
            ReadError::TooLarge(detail) => Self::TooLarge(detail),
            ReadError::Read(error) => Self::Body(error),
        }
    }
}

struct Prepared {
    /// The canonical text, if it was not sent in pieces.
    text: Option<String>,
    hash: String,
    /// `None` if that was not asked for.
    compiled: Option<Compiled>,
}

struct Compiled {
    content: Content,
    attributes: Vec<AttributeDocument>,
    actions: Vec<ActionDocument>,
}

/// What a model is made of.
enum Content {
    /// All that its definition says.
    Mapper(Box<Mapper>),
    /// What it will be told; so much for now.
    Experience(Revision),
}

impl Content {
    /// How large the model is; `None` if it is searched lazily.
    fn size(&self) -> Option<ModelSize> {
        let model = match self {
            Self::Mapper(mapper) => mapper.model(),
            Self::Experience(revision) => return Some(revision.size),
        };
        (!model.is_lazy()).then(|| ModelSize {
            n_states: model.graph().n_states() as u64,
            n_transitions: model.n_transitions() as u64,
        })
    }

    fn n_stochastic(&self) -> u64 {
        match self {
            Self::Mapper(mapper) => mapper.model().n_stochastic() as u64,
            Self::Experience(revision) => revision.n_stochastic,
        }
    }

    fn n_unsafe(&self) -> u64 {
        match self {
            Self::Mapper(mapper) => mapper.model().n_unsafe() as u64,
            Self::Experience(revision) => revision.n_unsafe,
        }
    }
}

/// Writes the canonical text of a model, and compiles it if there is a compiler.
fn prepare(
    definition: Definition,
    mut writer: DefinitionWriter,
    compiler: Option<&Compiler>,
    limits: Limits,
    interrupt: &mut dyn Interrupt,
) -> Result<Prepared, ServiceError> {
    definition.write(&mut writer).map_err(|error| ServiceError::Write(serde_json::Error::io(error)))?;
    let (hash, text) = writer.finish()?;
    let compile = |compiler: &Compiler| -> Result<Compiled, ServiceError> {
        if let Some(tally) = Tally::new(&definition) {
            let attributes = tally.schema().attributes().iter().map(AttributeDocument::from).collect();
            let actions = tally.actions().iter().map(ActionDocument::from).collect();
            return Ok(Compiled { content: Content::Experience(revision(&tally)), attributes, actions });
        }
        let held = compiler.take(definition.compiling_bytes(limits))?;
        let mapper = compiler.compile(definition, held, limits, interrupt)?;
        let model = mapper.model();
        let attributes = model.schema().attributes().iter().map(AttributeDocument::from).collect();
        let actions = model.actions().iter().map(ActionDocument::from).collect();
        Ok(Compiled { content: Content::Mapper(Box::new(mapper)), attributes, actions })
    };
    Ok(Prepared { text, hash, compiled: compiler.map(compile).transpose()? })
}
