//! The registry of models.

use std::io::{self, BufRead};
use std::sync::Arc;

use futures_util::future::OptionFuture;
use serde_json::value::RawValue;
use sha2::{Digest, Sha256};
use tokio::sync::{Semaphore, SemaphorePermit, mpsc};

use super::pool::Admission;
use super::{Caller, Etude, Name, PipeWriter, PoolError, ServiceError, as_stored, pipe};
use crate::attribute::AttributeDocument;
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::Mapper;
use crate::model::{ActionDocument, Definition, Format, Limits, Model, ReadError, hex};
use crate::store::{
    ModelKey, ModelSize, ModelSummary, NewDefinition, NewModel, NewPieces, PIECE_BYTES, Page, PutModel, StoreError,
    StoredDefinition,
};

/// A model and its definition, as registered.
#[derive(Debug)]
pub struct ModelAnswer {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// The definition.
    pub definition: ModelDefinition,
}

/// A definition in canonical form.
#[derive(Debug)]
pub enum ModelDefinition {
    /// JSON.
    Text(Box<RawValue>),
    /// Too large to be held: to be read with [`Etude::definition_piece`], by this id.
    Pieces(i64),
}

/// The text of a model on its way in.
pub enum ModelText {
    /// At hand.
    Whole(Vec<u8>),
    /// At hand, to be decompressed while it is read.
    Packed(OpenText),
    /// To be read as the client sends it.
    Arriving(OpenText),
}

/// Opens a text, on the thread that will read it: to find its beginning, some of it must be read.
pub type OpenText = Box<dyn FnOnce() -> io::Result<Box<dyn BufRead + Send>> + Send>;

impl ModelText {
    fn read(self, format: Format, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Definition, ReadError> {
        match self {
            Self::Whole(text) => Definition::parse(&text, format, limits, interrupt),
            Self::Packed(open) | Self::Arriving(open) => {
                Definition::parse_from(open().map_err(ReadError::Read)?, format, limits, interrupt)
            }
        }
    }
}

/// Whose turn it is to send a model that is read as it comes. One at a time: each may take most of the memory that there is.
#[derive(Debug)]
pub(super) struct Uploads {
    admitted: Semaphore,
    turn: Semaphore,
}

impl Uploads {
    /// Most that are sent or wait for their turn; further ones are refused.
    const MAX_ADMITTED: usize = 16;

    async fn turn(&self) -> Result<(SemaphorePermit<'_>, SemaphorePermit<'_>), PoolError> {
        let admitted = self.admitted.try_acquire().map_err(|_| PoolError::Busy)?;
        let turn = self.turn.acquire().await.map_err(|_| PoolError::Stopped)?;
        Ok((admitted, turn))
    }
}

impl Default for Uploads {
    fn default() -> Self {
        Self { admitted: Semaphore::new(Self::MAX_ADMITTED), turn: Semaphore::new(1) }
    }
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
        let limits = self.limits;
        // Where something is registered already, nothing is stored; what it is then depends on the hash.
        let existing = self.store.model_key(name.as_str()).await?;
        let (writer, pieces) = definition_writer(existing.is_none());
        let prepare = move |read: Result<Definition, ReadError>, interrupt: &mut dyn Interrupt| {
            prepare(read?, writer, limits, interrupt)
        };
        let (prepared, stored) = if let ModelText::Arriving(_) = text {
            let _turn = self.uploads.turn().await?;
            let read = self.pool.run_aside(move |interrupt| Ok(text.read(format, limits, interrupt))).await?;
            let job = move |interrupt: &mut dyn Interrupt| Ok(prepare(read, interrupt));
            tokio::join!(self.pool.run_patiently(job), self.store_pieces(pieces))
        } else {
            let place = self.pool.admit()?;
            let job = move |interrupt: &mut dyn Interrupt| {
                let read = text.read(format, limits, interrupt);
                Ok(prepare(read, interrupt))
            };
            tokio::join!(place.run(None, job), self.store_pieces(pieces))
        };
        // If storing has failed, preparing has for that reason.
        let stored = stored?;
        let Prepared { text, hash, mapper, attributes, actions } = prepared??;
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
            created_at: as_stored(caller.now),
        };
        let key = ModelKey { hash: summary.hash.clone(), is_lazy: model.is_lazy() };
        let put = match (text, stored) {
            (Some(text), _) => {
                let definition = NewDefinition::Text(text);
                self.store.put_model(NewModel { summary, definition }).await?
            }
            (None, Some(pieces)) => {
                let definition = NewDefinition::Pieces(pieces);
                self.store.put_model(NewModel { summary, definition }).await?
            }
            (None, None) => match self.store.model(name.as_str()).await? {
                Some(existing) if existing.summary.hash == key.hash => PutModel::Unchanged(existing.summary),
                Some(existing) => PutModel::Conflict { existing_hash: existing.summary.hash },
                // It was deleted meanwhile.
                None => return Err(PoolError::Busy.into()),
            },
        };
        let (registered, summary) = match put {
            PutModel::Created(summary) => (Registered::New, summary),
            PutModel::Unchanged(summary) => (Registered::Already, summary),
            PutModel::Conflict { existing_hash } => {
                return Err(ServiceError::Conflict { kind: "model", name: name.to_string(), existing_hash });
            }
        };
        self.mappers.insert(&key, &Arc::new(mapper));
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

    /// The model called `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn model(&self, name: &Name) -> Result<ModelAnswer, ServiceError> {
        let row = self.store.model(name.as_str()).await?.ok_or_else(|| unknown(name.as_str(), None))?;
        let definition = match row.definition {
            StoredDefinition::Text(text) => {
                ModelDefinition::Text(RawValue::from_string(text).map_err(|error| corrupt_definition(error.into()))?)
            }
            StoredDefinition::Pieces(id) => ModelDefinition::Pieces(id),
        };
        Ok(ModelAnswer { summary: row.summary, definition })
    }

    /// The piece `seq` of the canonical text of a definition; `None` after the last one.
    ///
    /// # Errors
    ///
    /// If the model was deleted, or the store failed.
    pub async fn definition_piece(&self, id: i64, seq: i64) -> Result<Option<Vec<u8>>, ServiceError> {
        Ok(self.store.piece(id, seq).await?)
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
            let (text, feed) = match row.definition {
                StoredDefinition::Text(text) => (ModelText::Whole(text.into_bytes()), None),
                StoredDefinition::Pieces(id) => {
                    let (to_reader, reader) = pipe();
                    (ModelText::Packed(Box::new(|| Ok(Box::new(reader)))), Some(self.feed(id, to_reader)))
                }
            };
            // What it was found to be when it was registered, whatever the limit is now.
            let limits = if is_lazy { Limits { max_states: 0, ..Limits::NONE } } else { Limits::NONE };
            let job = move |interrupt: &mut dyn Interrupt| {
                let definition = text.read(Format::Json, Limits::NONE, interrupt);
                Ok(match definition {
                    Ok(definition) => compile(definition, limits, interrupt),
                    Err(error) => Err(error.into()),
                })
            };
            let compile = async {
                match place {
                    Some(place) => place.run(None, job).await,
                    None => self.pool.run_patiently(job).await,
                }
            };
            let (mapper, fed) = tokio::join!(compile, OptionFuture::from(feed));
            match fed {
                // It was deleted meanwhile.
                Some(Err(ServiceError::Store(StoreError::Removed))) => return Err(unknown()),
                Some(Err(error)) => return Err(error),
                Some(Ok(())) | None => {}
            }
            let mapper = match mapper? {
                Err(ServiceError::Pool(error)) => return Err(error.into()),
                // What was once accepted is read again without faults.
                mapper => mapper.map_err(|error| corrupt_definition(error.into()))?,
            };
            Ok::<_, ServiceError>(Arc::new(mapper))
        };
        let mapper = self.mappers.get_or_compile(&key, compile).await?;
        Ok((hash, mapper))
    }

    /// Sends the pieces of a definition to their reader.
    async fn feed(&self, id: i64, to_reader: PipeWriter<Vec<u8>>) -> Result<(), ServiceError> {
        for seq in 0.. {
            let Some(piece) = self.store.piece(id, seq).await? else { break };
            if !to_reader.send(Ok(piece)).await {
                return Ok(());
            }
        }
        to_reader.end().await;
        Ok(())
    }
}

fn unknown(name: &str, pointer: Option<&'static str>) -> ServiceError {
    ServiceError::Unknown { kind: "model", name: name.to_owned(), pointer }
}

fn corrupt_definition(source: Box<dyn std::error::Error + Send + Sync>) -> ServiceError {
    StoreError::Corrupt { table: "models", column: "definition", source }.into()
}

impl From<ReadError> for ServiceError {
    fn from(error: ReadError) -> Self {
        match error {
            ReadError::Parse(error) => error.into(),
            ReadError::Faults(faults) => faults.into(),
            ReadError::Cancelled(Cancelled) => PoolError::Stopped.into(),
            ReadError::TooLarge(detail) => Self::TooLarge(detail),
            ReadError::Read(error) => Self::Body(error),
        }
    }
}

struct Prepared {
    /// The canonical text, if it was not sent in pieces.
    text: Option<String>,
    hash: String,
    mapper: Mapper,
    attributes: Vec<AttributeDocument>,
    actions: Vec<ActionDocument>,
}

/// Compiles a model, and writes its canonical text.
fn prepare(
    definition: Definition,
    mut writer: DefinitionWriter,
    limits: Limits,
    interrupt: &mut dyn Interrupt,
) -> Result<Prepared, ServiceError> {
    let model = Model::compile(&definition, limits, interrupt).map_err(|Cancelled| PoolError::Stopped)?;
    definition.write(&mut writer).map_err(|error| ServiceError::Write(serde_json::Error::io(error)))?;
    let (hash, text) = writer.finish()?;
    drop(definition);
    let attributes = model.schema().attributes().iter().map(AttributeDocument::from).collect();
    let actions = model.actions().iter().map(ActionDocument::from).collect();
    let mapper = Mapper::new(model, interrupt).map_err(|Cancelled| PoolError::Stopped)?;
    Ok(Prepared { text, hash, mapper, attributes, actions })
}

/// Compiles a model.
fn compile(definition: Definition, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Mapper, ServiceError> {
    let model = Model::compile(&definition, limits, interrupt).map_err(|Cancelled| PoolError::Stopped)?;
    drop(definition);
    Ok(Mapper::new(model, interrupt).map_err(|Cancelled| PoolError::Stopped)?)
}

/// A writer of canonical text, and the pieces that come of it: if `is_stored` and it is longer than one.
fn definition_writer(is_stored: bool) -> (DefinitionWriter, mpsc::Receiver<Vec<u8>>) {
    /// Pieces that wait to be stored.
    const MAX_WAITING: usize = 1;
    let (pieces, received) = mpsc::channel(MAX_WAITING);
    let writer = DefinitionWriter {
        hash: Sha256::new(),
        piece: Vec::new(),
        is_whole: true,
        pieces: is_stored.then_some(pieces),
    };
    (writer, received)
}

/// Takes canonical text: hashes it, and makes pieces of it if it is long.
struct DefinitionWriter {
    hash: Sha256,
    /// The last piece. Less than [`PIECE_BYTES`].
    piece: Vec<u8>,
    /// Whether that is all there is.
    is_whole: bool,
    pieces: Option<mpsc::Sender<Vec<u8>>>,
}

impl DefinitionWriter {
    fn send_piece(&mut self) -> io::Result<()> {
        self.is_whole = false;
        self.hash.update(&self.piece);
        if let Some(pieces) = &self.pieces {
            let piece = std::mem::replace(&mut self.piece, Vec::with_capacity(PIECE_BYTES));
            // Nobody receives if storing has failed, or nobody waits for the model any more.
            return pieces.blocking_send(piece).map_err(|_| io::ErrorKind::BrokenPipe.into());
        }
        self.piece.clear();
        Ok(())
    }

    /// The hash of the text, and the text if it is short.
    fn finish(mut self) -> Result<(String, Option<String>), ServiceError> {
        if self.is_whole {
            self.hash.update(&self.piece);
            let text = String::from_utf8(self.piece).map_err(|error| corrupt_definition(error.into()))?;
            return Ok((hex(&self.hash.finalize()), Some(text)));
        }
        if !self.piece.is_empty() {
            self.send_piece().map_err(|error| ServiceError::Write(serde_json::Error::io(error)))?;
        }
        Ok((hex(&self.hash.finalize()), None))
    }
}

impl io::Write for DefinitionWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n_taken = bytes.len().min(PIECE_BYTES - self.piece.len());
        self.piece.extend_from_slice(&bytes[..n_taken]);
        if self.piece.len() == PIECE_BYTES {
            self.send_piece()?;
        }
        Ok(n_taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
