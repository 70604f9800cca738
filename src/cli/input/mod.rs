//! Demonstrations as commands read them, from a file or from standard input.
//!
//! | form | begins with |
//! |---|---|
//! | CSV: a header, then an observation per row | anything else, or the file's name ends in `.csv` or `.tsv` |
//! | JSON lines: an observation per line, as an object or as an array of values | an object that ends on the first line, or `[` and a value |
//! | JSON: an array of observations | `[` and then `{`, `[` or `]` |
//! | JSON: a request, with its `demonstration` and options | an object that goes on after the first line, or has a `demonstration` |
//!
//! A file may be compressed (gzip, zstd). Rows and lines are read as they come, so that a pipe can be followed while it is written. Values are not checked here: each
//! observation comes with its [`Spot`], the place in the file that a fault is reported at.

mod column;
mod json;
mod lines;
mod spot;
mod table;

use std::ffi::OsStr;
use std::path::Path;
use std::sync::Arc;

use indicatif::ProgressBar;
use serde_json::{Map as Members, Value};
use tokio::sync::mpsc;

pub(super) use self::column::Column;
pub(super) use self::json::parse_json;
use self::json::{parse_document, parse_line};
use self::lines::{Input, Lines};
use self::spot::At;
pub(super) use self::spot::{Source, Spot};
pub(super) use self::table::Cells;
use self::table::Table;
use super::CliError;
use super::opened::open;

/// Most observations that are read before a service has acknowledged them.
pub(super) const MAX_READ_AHEAD: usize = 64;

/// An observation, and where it stood.
pub(super) struct Observation {
    pub(super) spot: Spot,
    /// A state, in part: an object by attribute name, or an array of values.
    pub(super) state: Value,
}

/// The observations of a demonstration, one after the other.
pub(super) struct Observations {
    source: Arc<Source>,
    columns: Vec<Column>,
    request: Members<String, Value>,
    form: Form,
}

enum Form {
    Lines(Lines),
    Table(Table),
    Items(std::iter::Enumerate<std::vec::IntoIter<Value>>),
}

impl Observations {
    /// Opens the file at `path`; `-` is standard input. `columns` rename and scale columns; `cells` says how cells of a table become values.
    pub(super) fn open(path: &Path, columns: &[Column], cells: &Cells) -> Result<Self, CliError> {
        Self::read(path, open(path, &ProgressBar::hidden())?, columns, cells)
    }

    fn read(path: &Path, input: Input, columns: &[Column], cells: &Cells) -> Result<Self, CliError> {
        let name = if path == Path::new("-") { "the input".to_owned() } else { path.display().to_string() };
        let mut lines = Lines::new(input, name.clone());
        let (source, request, form) = match form_of(path, lines.first()?) {
            FormName::Table => {
                let table = Table::read(lines, columns, cells)?;
                (Source { name, columns: table.names(), array: "" }, Members::new(), Form::Table(table))
            }
            FormName::Lines => (Source { name, ..Source::default() }, Members::new(), Form::Lines(lines)),
            FormName::Document => {
                let (items, array, request) = match parse_document(&name, lines.rest()?)? {
                    Value::Array(items) => (items, "", Members::new()),
                    Value::Object(mut request) => {
                        let Some(Value::Array(items)) = request.remove("demonstration") else {
                            let detail = if request.contains_key("dynamics") {
                                "this is a model, and no demonstration"
                            } else {
                                "/demonstration: expected an array of observations"
                            };
                            return Err(CliError::Faulty(format!("{name}: {detail}")));
                        };
                        (items, "/demonstration", request)
                    }
                    _ => return Err(CliError::Faulty(format!("{name}: expected an array of observations"))),
                };
                let items = Form::Items(items.into_iter().enumerate());
                (Source { name, array, ..Source::default() }, request, items)
            }
        };
        Ok(Self { source: Arc::new(source), columns: columns.to_vec(), request, form })
    }

    /// Where they come from, for what is to be told of the whole.
    pub(super) fn source(&self) -> &Arc<Source> {
        &self.source
    }

    /// The members of a request besides its demonstration; none where the input is a demonstration alone.
    pub(super) fn take_request(&mut self) -> Members<String, Value> {
        std::mem::take(&mut self.request)
    }

    /// The next observation; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Observation>, CliError> {
        let (at, mut state) = match &mut self.form {
            Form::Lines(lines) => {
                let Some(text) = lines.next()? else { return Ok(None) };
                let at = At::Line(lines.n_read());
                let told = |problem: String| CliError::Faulty(Spot::new(&self.source, at).tell("", &problem));
                (at, parse_line(text).map_err(told)?)
            }
            Form::Table(table) => match table.next()? {
                Some((row, state)) => return Ok(Some(self.observation(At::Row(row), state))),
                None => return Ok(None),
            },
            Form::Items(items) => match items.next() {
                Some((index, state)) => (At::Item(index), state),
                None => return Ok(None),
            },
        };
        if let Value::Object(members) = &mut state {
            column::rename(&self.columns, members);
        }
        Ok(Some(self.observation(at, state)))
    }

    fn observation(&self, at: At, state: Value) -> Observation {
        Observation { spot: Spot::new(&self.source, at), state }
    }

    /// Reads the observations in a thread of its own, because a read of standard input cannot be cancelled.
    pub(super) fn read_ahead(mut self) -> mpsc::Receiver<Result<Option<Observation>, CliError>> {
        let (sender, observations) = mpsc::channel(MAX_READ_AHEAD);
        std::thread::spawn(move || {
            loop {
                let next = self.next();
                let is_last = !matches!(next, Ok(Some(_)));
                if sender.blocking_send(next).is_err() || is_last {
                    return;
                }
            }
        });
        observations
    }
}

/// How the observations are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FormName {
    Table,
    Lines,
    /// An array, or a request.
    Document,
}

/// The form of what begins with the line `head`, the first that is not blank.
fn form_of(path: &Path, head: &[u8]) -> FormName {
    let is_packed = path.extension().is_some_and(|extension| extension == "gz" || extension == "zst");
    let inner = if is_packed { path.with_extension("") } else { path.to_owned() };
    let extension = inner.extension().map(OsStr::to_ascii_lowercase);
    let is_called = |names: &[&str]| names.iter().any(|name| extension.as_deref() == Some(name.as_ref()));
    let head = head.trim_ascii();
    match head.first() {
        _ if is_called(&["csv", "tsv"]) => FormName::Table,
        Some(b'[') => match head[1..].trim_ascii_start().first() {
            Some(b'{' | b'[' | b']') | None => FormName::Document,
            // Values of an observation.
            Some(_) => FormName::Lines,
        },
        Some(b'{') => match parse_line(head.to_vec()) {
            Ok(Value::Object(members)) if members.get("demonstration").is_some_and(Value::is_array) => {
                FormName::Document
            }
            Err(_) if json::is_cut_off(head) => FormName::Document,
            _ => FormName::Lines,
        },
        Some(_) if is_called(&["json"]) => FormName::Document,
        Some(_) if is_called(&["ndjson", "jsonl"]) => FormName::Lines,
        // An empty input has no observations, whatever its form.
        None => FormName::Lines,
        Some(_) => FormName::Table,
    }
}

#[cfg(test)]
mod tests;
