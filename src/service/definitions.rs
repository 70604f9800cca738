//! The texts of models on their way in and out.

use std::io::{self, BufRead};

use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

use super::hash::hex;
use super::search::MAX_INLINE_BYTES;
use super::{Etude, Kind, ServiceError};
use crate::compressed::{Decompressed, GZIP};
use crate::memory::{Held, Memory, SMALL_BYTES};
use crate::store::{ModelSummary, PIECE_BYTES, Store};
use etude_core::interrupt::Interrupt;
use etude_core::model::{Definition, Edits, Format, ImportFile, ImportFormat, Limits, ReadError, import};

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
        Self {
            model: summary.name.clone(),
            expected: summary.definition_hash().to_owned(),
            id,
            seq: 0,
            hash: Sha256::new(),
        }
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

/// Checks the hash of a stored definition against the one that was registered.
pub(super) fn check_hash(model: &str, hash: &str, expected: &str) -> Result<(), ServiceError> {
    if hash == expected {
        return Ok(());
    }
    Err(ServiceError::unreadable("models", "definition", model, "it is not what its hash is of"))
}

/// The text of a model on its way in.
pub enum ModelText {
    /// In memory.
    Whole(Vec<u8>),
    /// In memory, to be decompressed while it is read.
    Packed(OpenText),
    /// To be read as the client sends it.
    Arriving(OpenText),
}

/// Opens a text, on the thread that will read it, as opening already reads its beginning.
pub type OpenText = Box<dyn FnOnce() -> io::Result<Box<dyn BufRead + Send>> + Send>;

/// What the text of a model is.
#[derive(Clone, Debug)]
pub enum ModelForm {
    /// The model itself.
    Own(Format),
    /// A file of another tool, and what is to be changed on the way.
    Imported(ImportFormat, Box<Edits>),
}

impl From<Format> for ModelForm {
    fn from(format: Format) -> Self {
        Self::Own(format)
    }
}

impl ModelText {
    pub(super) fn read(
        self,
        form: &ModelForm,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Definition, ReadError> {
        match (form, self) {
            (ModelForm::Own(format), Self::Whole(text)) => Definition::parse(&text, *format, limits, interrupt),
            (ModelForm::Own(format), Self::Packed(open) | Self::Arriving(open)) => {
                Definition::parse_from(open()?, *format, limits, interrupt)
            }
            (ModelForm::Imported(format, edits), text) => {
                let mut content: Box<dyn BufRead> = match text {
                    Self::Whole(text) => Box::new(io::Cursor::new(text)),
                    Self::Packed(open) | Self::Arriving(open) => open()?,
                };
                // Archives are compressed by what makes them, and have their limit as they are read.
                if *format == ImportFormat::Umb && content.fill_buf()?.starts_with(GZIP) {
                    content = Box::new(io::BufReader::new(Decompressed::gzip(content)));
                }
                let file = ImportFile { name: String::new(), content };
                Ok(import(*format, vec![file], edits, limits, interrupt)?)
            }
        }
    }

    /// Whether it is read in less than a millisecond.
    pub(super) fn is_small(&self) -> bool {
        matches!(self, Self::Whole(text) if text.len() <= MAX_INLINE_BYTES)
    }

    /// The same text, which takes from `memory`, as it is read, what is kept of it.
    pub(super) fn counted(self, memory: &Memory) -> Self {
        let open = match self {
            Self::Whole(text) if text.len() as u64 <= SMALL_BYTES => return Self::Whole(text),
            Self::Whole(text) => {
                Box::new(move || -> io::Result<Box<dyn BufRead + Send>> { Ok(Box::new(io::Cursor::new(text))) })
            }
            Self::Packed(open) | Self::Arriving(open) => open,
        };
        let memory = memory.clone();
        // The memory is taken only when the text is read.
        Self::Packed(Box::new(move || {
            let held = memory.try_take(SMALL_BYTES).map_err(io::Error::other)?;
            Ok(Box::new(Counted { inner: open()?, held, n_bytes: 0 }))
        }))
    }
}

/// A text of a model that is read, and the memory for what is kept of it.
struct Counted {
    inner: Box<dyn BufRead + Send>,
    held: Held,
    n_bytes: u64,
}

impl Counted {
    /// Until a text is compiled, about so many bytes are kept for each of its bytes: values as numbers, and lists that grow.
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

pub(super) fn unknown(name: &str, pointer: Option<&'static str>) -> ServiceError {
    ServiceError::Unknown { kind: Kind::Model, name: name.to_owned(), pointer }
}

pub(super) fn corrupt_definition(model: &str, source: Box<dyn std::error::Error + Send + Sync>) -> ServiceError {
    ServiceError::unreadable("models", "definition", model, source)
}

/// A writer of canonical text, and the pieces that come of it: if `is_stored` and it is longer than one.
pub(super) fn definition_writer(is_stored: bool) -> (DefinitionWriter, mpsc::Receiver<Vec<u8>>) {
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
pub(super) struct DefinitionWriter {
    hash: Sha256,
    /// The last piece. Less than [`PIECE_BYTES`].
    piece: Vec<u8>,
    /// Whether that is the whole text so far.
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
    pub(super) fn finish(mut self) -> Result<(String, Option<String>), ServiceError> {
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
