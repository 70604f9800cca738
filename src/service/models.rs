//! The registry of models.

use std::io::{self, BufRead};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::value::RawValue;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

use super::compiler::{Compiler, LimitedTime};
use super::hash::{hash_of, hex};
use super::pool::Places;
use super::search::MAX_INLINE_BYTES;
use super::{Caller, Client, Etude, Name, PoolError, ServiceError, as_stored};
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::store::{
    Deletion, ModelKey, ModelSize, ModelSummary, NewDefinition, NewModel, NewPieces, PIECE_BYTES, Page, Registration,
    Store, StoredDefinition,
};
use etude_core::attribute::AttributeDocument;
use etude_core::interrupt::{Interrupt, Interrupted};
use etude_core::mapping::Mapper;
use etude_core::model::{ActionDocument, Definition, Format, Limits, ReadError};

/// A model and its definition, as registered.
#[derive(Debug)]
pub struct ModelAnswer {
    /// What is kept besides the definition.
    pub summary: ModelSummary,
    /// The definition.
    pub definition: ModelDefinition,
    /// For what is kept, if that is much.
    _held: Option<Held>,
}

/// A definition in canonical form.
#[derive(Debug)]
pub enum ModelDefinition {
    /// JSON.
    Text(Box<RawValue>),
    /// Too large to be held: to be read with this.
    Pieces(DefinitionReader),
}

/// Reads a definition piece by piece, and tells at its end whether that was the one that was registered.
#[derive(Debug)]
pub struct DefinitionReader {
    model: String,
    expected: String,
    id: i64,
    seq: i64,
    hash: Sha256,
}

impl DefinitionReader {
    pub(super) fn new(summary: &ModelSummary, id: i64) -> Self {
        Self { model: summary.name.clone(), expected: summary.hash.clone(), id, seq: 0, hash: Sha256::new() }
    }

    /// The next piece of the canonical text; `None` after the last one.
    ///
    /// # Errors
    ///
    /// If the model was deleted, the pieces are not what was registered, or the store failed.
    pub async fn next(&mut self, etude: &Etude) -> Result<Option<Vec<u8>>, ServiceError> {
        self.next_in(&etude.store).await
    }

    pub(super) async fn next_in(&mut self, store: &Store) -> Result<Option<Vec<u8>>, ServiceError> {
        let Some(piece) = store.piece(self.id, self.seq).await? else {
            let hash = std::mem::take(&mut self.hash);
            check_hash(&self.model, &hex(hash.finalize()), &self.expected)?;
            return Ok(None);
        };
        self.seq += 1;
        self.hash.update(&piece);
        Ok(Some(piece))
    }
}

/// Makes sure that what is stored of a definition is what was registered.
pub(super) fn check_hash(model: &str, hash: &str, expected: &str) -> Result<(), ServiceError> {
    if hash == expected {
        return Ok(());
    }
    Err(ServiceError::unreadable("models", "definition", model, "it is not what its hash is of"))
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
    pub(super) fn read(
        self,
        format: Format,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Definition, ReadError> {
        match self {
            Self::Whole(text) => Definition::parse(&text, format, limits, interrupt),
            Self::Packed(open) | Self::Arriving(open) => Definition::parse_from(open()?, format, limits, interrupt),
        }
    }

    /// Whether it is read in less than a millisecond.
    fn is_small(&self) -> bool {
        matches!(self, Self::Whole(text) if text.len() <= MAX_INLINE_BYTES)
    }

    /// The same text, of which what is kept is held against `memory` as it is read.
    fn counted(self, memory: &Memory) -> Self {
        let open = match self {
            Self::Whole(text) if text.len() as u64 <= SMALL_BYTES => return Self::Whole(text),
            Self::Whole(text) => {
                Box::new(move || -> io::Result<Box<dyn BufRead + Send>> { Ok(Box::new(io::Cursor::new(text))) })
            }
            Self::Packed(open) | Self::Arriving(open) => open,
        };
        let memory = memory.clone();
        // Once its turn has come.
        Self::Packed(Box::new(move || {
            let held = memory.try_take(SMALL_BYTES).map_err(io::Error::other)?;
            Ok(Box::new(Counted { inner: open()?, held, n_bytes: 0 }))
        }))
    }
}

/// A text of a model that is read, and what is kept of it.
struct Counted {
    inner: Box<dyn BufRead + Send>,
    held: Held,
    n_bytes: u64,
}

impl Counted {
    /// Of a text, about twice as much is kept until it is compiled: values as numbers, and lists that grow.
    const KEPT: u64 = 2;
}

impl io::Read for Counted {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n_read = self.fill_buf()?.read(buffer)?;
        self.consume(n_read);
        Ok(n_read)
    }
}

impl BufRead for Counted {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        let needed = Self::KEPT * self.n_bytes;
        if needed > self.held.n_bytes() {
            self.held.grow_to(needed + SMALL_BYTES).map_err(io::Error::other)?;
        }
        self.inner.fill_buf()
    }

    fn consume(&mut self, n_bytes: usize) {
        self.n_bytes += n_bytes as u64;
        self.inner.consume(n_bytes);
    }
}

/// Who sends models that are read as they come. A client that sends slowly keeps others from nothing but its own place.
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
        // Where something is registered already, nothing is stored or compiled; what it is then depends on the hash.
        let existing = self.store.model_key(name.as_str()).await?;
        let is_new = existing.is_none();
        let (writer, pieces) = definition_writer(is_new);
        let compiler = self.compiler.clone();
        let prepare = move |read: Result<Definition, ReadError>, interrupt: &mut dyn Interrupt| {
            prepare(read?, writer, is_new.then_some(&compiler), limits, interrupt)
        };
        let is_arriving = matches!(text, ModelText::Arriving(_));
        let text = text.counted(&self.memory);
        let (prepared, stored) = if is_arriving {
            let _place = self.uploads.admit(caller.client)?;
            let read = self.pool.run_aside(move |interrupt| Ok(text.read(format, limits, interrupt))).await?;
            let job = move |interrupt: &mut dyn Interrupt| Ok(prepare(read, interrupt));
            tokio::join!(self.pool.run_patiently(caller.client, job), self.store_pieces(pieces))
        } else if !is_new && text.is_small() {
            // There is nothing to be compiled or stored.
            let job = |interrupt: &mut dyn Interrupt| Ok(prepare(text.read(format, limits, interrupt), interrupt));
            (self.pool.run_here(None, job), Ok(None))
        } else {
            let place = self.pool.admit(caller.client)?;
            let (max_time, clock) = (self.time_limits.compile, self.clock.clone());
            let job = move |interrupt: &mut dyn Interrupt| {
                let read = text.read(format, limits, &mut LimitedTime::new(interrupt, max_time, clock));
                Ok(prepare(read, interrupt))
            };
            tokio::join!(place.run(None, job), self.store_pieces(pieces))
        };
        // If storing has failed, preparing has for that reason.
        let stored = stored?;
        let Prepared { text, hash, compiled } = prepared??;
        let Some(Compiled { mapper, attributes, actions }) = compiled else {
            // What is there is looked up once more: it may have been deleted meanwhile.
            let existing = self.store.model(name.as_str()).await?.ok_or(PoolError::Busy)?.summary;
            return if existing.hash == hash {
                Ok((Registered::Already, existing))
            } else {
                Err(conflict(name, existing.hash))
            };
        };
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
        let definition = match (text, stored) {
            (Some(text), _) => NewDefinition::Text(text),
            (None, Some(pieces)) => NewDefinition::Pieces(pieces),
            (None, None) => return Err(PoolError::Busy.into()),
        };
        let (registered, summary) = match self.store.register_model(NewModel { summary, definition }).await? {
            Registration::Created(summary) => (Registered::New, summary),
            Registration::Unchanged(summary) => (Registered::Already, summary),
            Registration::Conflict { existing_hash } => return Err(conflict(name, existing_hash)),
        };
        self.compiler.put(key, &Arc::new(mapper)).await;
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
        let held = self.take_for_summary(self.store.summary_bytes(name.as_str()).await?)?;
        let row = self.store.model(name.as_str()).await?.ok_or_else(|| unknown(name.as_str(), None))?;
        let definition = match row.definition {
            StoredDefinition::Text(text) => {
                check_hash(name.as_str(), &hash_of(&text), &row.summary.hash)?;
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

    /// Takes what reading and writing so many bytes of attributes and actions needs, if that is much: labels may take any number of bytes.
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
            Deletion::Deleted => Ok(()),
            Deletion::Unknown => Err(unknown(name.as_str(), None)),
        }
    }
}

fn conflict(name: &Name, existing_hash: String) -> ServiceError {
    ServiceError::Conflict { kind: "model", name: name.to_string(), existing_hash }
}

pub(super) fn unknown(name: &str, pointer: Option<&'static str>) -> ServiceError {
    ServiceError::Unknown { kind: "model", name: name.to_owned(), pointer }
}

pub(super) fn corrupt_definition(model: &str, source: Box<dyn std::error::Error + Send + Sync>) -> ServiceError {
    ServiceError::unreadable("models", "definition", model, source)
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
    mapper: Mapper,
    attributes: Vec<AttributeDocument>,
    actions: Vec<ActionDocument>,
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
        let held = compiler.take(definition.compiling_bytes(limits))?;
        let mapper = compiler.compile(definition, held, limits, interrupt)?;
        let model = mapper.model();
        let attributes = model.schema().attributes().iter().map(AttributeDocument::from).collect();
        let actions = model.actions().iter().map(ActionDocument::from).collect();
        Ok(Compiled { mapper, attributes, actions })
    };
    Ok(Prepared { text, hash, compiled: compiler.map(compile).transpose()? })
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
            let text = String::from_utf8(self.piece)
                .map_err(|error| ServiceError::Write(serde_json::Error::io(io::Error::other(error))))?;
            return Ok((hex(self.hash.finalize()), Some(text)));
        }
        if !self.piece.is_empty() {
            self.send_piece().map_err(|error| ServiceError::Write(serde_json::Error::io(error)))?;
        }
        Ok((hex(self.hash.finalize()), None))
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
