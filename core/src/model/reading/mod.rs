//! Reading the text of a model, which may be gigabytes long, in one pass and without a tree of JSON values.
//!
//! The long lists of a table, its states and transitions, are parsed into compact arrays. The rest, the [`Skeleton`], is small: a JSON
//! value with empty arrays in place of the lists. Values in the lists are checked after the whole text was parsed, once per *distinct*
//! value. So the members of the text may stand in any order, and the order of faults does not depend on it.
//!
//! ```text
//! JSON, NDJSON, Value --> Reader --> Skeleton { root, states, transitions } --> definition::of_skeleton, table::read
//! ```

mod interruptible;
mod items;
mod lists;
mod raw;
mod seeds;
mod take;

use std::io::{self, BufRead};

pub(super) use interruptible::Interruptible;
pub(super) use lists::{
    COLUMNS_BYTES, ItemPaths, NoTransition, RawIndex, RawStates, RawTerms, RawTransitions, add_to_column,
};
pub(super) use raw::{Distinct, Raw};
use seeds::{Position, Seed};
use serde::de::DeserializeSeed;
use serde_json::Value;

use super::Limits;
use crate::document::{self, BEYOND_FLOATS, BYTE_ORDER_MARK, Faults, ParseError, Path};
use crate::interrupt::{Cancelled, Interrupted, Meter};

/// How the text of a model is laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// One JSON value.
    Json,
    /// A JSON value a line: the model, then objects with more of its `states` and `transitions`.
    Ndjson,
}

/// Why a text gives no definition.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The text is not JSON.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// It is JSON, but not a model.
    #[error(transparent)]
    Faults(#[from] Faults),
    /// The caller asked for it to be cancelled.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// The caller's time was up.
    #[error("out of time")]
    OutOfTime,
    /// The model takes more memory than it may.
    #[error("{0}")]
    TooLarge(String),
    /// The text could not be read to its end.
    #[error("the text could not be read")]
    Read(#[source] io::Error),
}

impl From<io::Error> for ReadError {
    fn from(error: io::Error) -> Self {
        match error.get_ref().and_then(|inner| inner.downcast_ref::<Interrupted>()) {
            Some(interrupted) => (*interrupted).into(),
            None => Self::Read(error),
        }
    }
}

impl From<Interrupted> for ReadError {
    fn from(interrupted: Interrupted) -> Self {
        match interrupted {
            Interrupted::Cancelled(cancelled) => Self::Cancelled(cancelled),
            Interrupted::OutOfTime => Self::OutOfTime,
        }
    }
}

/// A model's document without its long lists.
#[derive(Debug, Default)]
pub(super) struct Skeleton {
    /// The document; an empty array stands for each list that was taken out.
    pub(super) root: Value,
    /// The line that it stands on, in a document of several.
    pub(super) line: Option<u64>,
    /// The states, if the document lists any.
    pub(super) states: Option<RawStates>,
    /// The transitions, if the document lists any.
    pub(super) transitions: Option<RawTransitions>,
    /// Faults of the lines after the first, and members that stand twice.
    pub(super) faults: Faults,
}

/// Reads skeletons.
pub(super) struct Reader<'m, 'i> {
    meter: &'m mut Meter<'i>,
    limits: Limits,
    states: Option<RawStates>,
    transitions: Option<RawTransitions>,
    /// The line that is read, in a document of several.
    line: Option<u64>,
    /// About how much memory the values of the skeleton take, in bytes.
    n_held_bytes: usize,
    max_held_bytes: usize,
    /// Members that stand twice.
    twice: Faults,
    /// Why reading was stopped, if not for a fault of the text.
    stop: Option<Stop>,
    /// The path of the value at which an error occurred, innermost step first.
    trace: Vec<PathStep>,
}

#[derive(Debug)]
enum Stop {
    Interrupted(Interrupted),
    TooLarge(String),
}

#[derive(Debug)]
enum PathStep {
    Member(String),
    Item(usize),
}

/// Most memory for what is neither states nor transitions; a text of 8 MiB needs less, whatever it holds.
const MAX_HELD_BYTES: usize = 512 << 20;

/// Longest line of NDJSON: it is kept while it is read.
pub const MAX_LINE_BYTES: usize = 64 << 20;

impl<'m, 'i> Reader<'m, 'i> {
    pub(super) fn new(limits: Limits, meter: &'m mut Meter<'i>) -> Self {
        Self {
            meter,
            limits: Limits {
                max_states: limits.max_states.min(lists::MAX_STATES),
                max_transitions: limits.max_transitions.min(lists::MAX_TRANSITIONS),
                ..limits
            },
            states: None,
            transitions: None,
            line: None,
            n_held_bytes: 0,
            max_held_bytes: MAX_HELD_BYTES.min(limits.max_bytes),
            twice: Faults::default(),
            stop: None,
            trace: Vec::new(),
        }
    }

    /// Reads what is in memory already.
    pub(super) fn read_value(mut self, document: &Value) -> Result<Skeleton, ReadError> {
        self.max_held_bytes = usize::MAX;
        let root = Seed::new(&mut self, Position::Root, Path::Root).deserialize(document);
        let root = root.map_err(|error| self.explain(error))?;
        Ok(self.finish(root, Faults::default()))
    }

    pub(super) fn read_text(self, text: &[u8], format: Format) -> Result<Skeleton, ReadError> {
        let text = text.strip_prefix(BYTE_ORDER_MARK).unwrap_or(text);
        match format {
            Format::Json => self.read_json(&mut serde_json::Deserializer::from_slice(text)),
            Format::Ndjson => self.read_ndjson(text),
        }
    }

    pub(super) fn read_from(self, mut reader: impl BufRead, format: Format) -> Result<Skeleton, ReadError> {
        skip_byte_order_mark(&mut reader)?;
        match format {
            Format::Json => self.read_json(&mut serde_json::Deserializer::from_reader(reader)),
            Format::Ndjson => self.read_ndjson(reader),
        }
    }

    fn read_json<'de, R: serde_json::de::Read<'de>>(
        mut self,
        json: &mut serde_json::Deserializer<R>,
    ) -> Result<Skeleton, ReadError> {
        let root = Seed::new(&mut self, Position::Root, Path::Root).deserialize(&mut *json);
        let root = root.and_then(|root| json.end().map(|()| root)).map_err(|error| self.explain(error))?;
        Ok(self.finish(root, Faults::default()))
    }

    fn read_ndjson(mut self, mut reader: impl BufRead) -> Result<Skeleton, ReadError> {
        let mut line = Vec::new();
        let mut root = None;
        let mut model_line = None;
        let mut faults = Faults::default();
        for number in 1u64.. {
            if !read_line(&mut reader, &mut line, number)? {
                break;
            }
            if line.iter().all(u8::is_ascii_whitespace) {
                continue;
            }
            self.line = Some(number);
            let position = if root.is_none() { Position::Root } else { Position::Chunk };
            let text = line.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&line);
            let mut json = serde_json::Deserializer::from_slice(text);
            let read = Seed::new(&mut self, position, Path::Line(number)).deserialize(&mut json);
            let read = read.and_then(|read| json.end().map(|()| read)).map_err(|error| self.explain(error))?;
            if root.is_none() {
                model_line = self.line;
                root = Some(read);
            } else {
                check_chunk(&read, number, &mut faults);
            }
        }
        self.line = model_line;
        let Some(mut root) = root else {
            let detail = "EOF while parsing a value".to_owned();
            return Err(ParseError::Syntax { line: 1, column: 0, detail }.into());
        };
        // What came on later lines belongs to the model.
        if let Some(dynamics) = root.get_mut("dynamics").and_then(Value::as_object_mut) {
            for (list, is_there) in [("states", self.states.is_some()), ("transitions", self.transitions.is_some())] {
                if is_there {
                    let member = dynamics.entry(list).or_insert(Value::Null);
                    if member.is_null() {
                        *member = Value::Array(Vec::new());
                    }
                }
            }
        }
        Ok(self.finish(root, faults))
    }

    fn finish(self, root: Value, mut faults: Faults) -> Skeleton {
        faults.append(self.twice);
        Skeleton { root, line: self.line, states: self.states, transitions: self.transitions, faults }
    }

    /// What an error of a seed means.
    fn explain(&mut self, error: serde_json::Error) -> ReadError {
        match self.stop.take() {
            Some(Stop::Interrupted(interrupted)) => return interrupted.into(),
            Some(Stop::TooLarge(detail)) => return ReadError::TooLarge(detail),
            None => {}
        }
        if error.is_io() {
            return io::Error::from(error).into();
        }
        let beyond_floats = || {
            let mut faults = Faults::default();
            note_along(&self.trace, &self.line.map_or(Path::Root, Path::Line), &mut faults);
            faults
        };
        match (ParseError::of(&error, beyond_floats), self.line) {
            // The parser saw only this line, as line 1.
            (ParseError::Syntax { column, detail, .. }, Some(line)) => {
                let line = usize::try_from(line).unwrap_or(usize::MAX);
                ParseError::Syntax { line, column, detail }.into()
            }
            (error, _) => error.into(),
        }
    }
}

/// Takes a byte order mark out of what is to be read, if it begins with one.
fn skip_byte_order_mark(reader: &mut impl BufRead) -> Result<(), ReadError> {
    for (n, byte) in BYTE_ORDER_MARK.iter().enumerate() {
        let next = loop {
            match reader.fill_buf() {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                available => break available?.first().copied(),
            }
        };
        if next == Some(*byte) {
            reader.consume(1);
        } else if n == 0 {
            break;
        } else {
            // No JSON begins with a part of it.
            let detail = "expected value".to_owned();
            return Err(ParseError::Syntax { line: 1, column: 1, detail }.into());
        }
    }
    Ok(())
}

/// Notes a number beyond floats where `trace` leads to.
fn note_along(trace: &[PathStep], path: &Path<'_>, faults: &mut Faults) {
    match trace.split_last() {
        None => faults.note_at(path, BEYOND_FLOATS),
        Some((PathStep::Member(name), rest)) => note_along(rest, &Path::Member(path, name), faults),
        Some((PathStep::Item(index), rest)) => note_along(rest, &Path::Item(path, *index), faults),
    }
}

/// Notes what is wrong with a line after the first, besides its lists.
fn check_chunk(chunk: &Value, line: u64, faults: &mut Faults) {
    let place = document::Place { value: chunk, path: Path::Line(line) };
    if let Some(object) = place.object(&["states", "transitions"], faults) {
        for list in ["states", "transitions"] {
            object.optional(list).map(|place| place.array(faults).map(drop));
        }
    }
}

/// Reads the next line into `line`; `false` at the end.
fn read_line(reader: &mut impl BufRead, line: &mut Vec<u8>, number: u64) -> Result<bool, ReadError> {
    line.clear();
    loop {
        let available = match reader.fill_buf() {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            available => available?,
        };
        let end = available.iter().position(|byte| *byte == b'\n');
        let n_taken = end.map_or(available.len(), |end| end + 1);
        if line.len() + n_taken > MAX_LINE_BYTES {
            let detail = format!("line {number} has over {MAX_LINE_BYTES} bytes; make several lines of it");
            return Err(ReadError::TooLarge(detail));
        }
        line.extend_from_slice(&available[..n_taken]);
        reader.consume(n_taken);
        if end.is_some() || n_taken == 0 {
            return Ok(!line.is_empty());
        }
    }
}

#[cfg(test)]
mod tests;
