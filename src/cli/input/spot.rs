//! Where observations come from, and where one of them stands there.

use std::sync::Arc;

/// Where observations come from.
#[derive(Debug, Default)]
pub(in crate::cli) struct Source {
    /// The file's path, or `the input`.
    pub(super) name: String,
    /// In a table: the column of each attribute that has one.
    pub(super) columns: Vec<(String, String)>,
    /// In a document: the pointer to the array of observations.
    pub(super) array: &'static str,
}

impl Source {
    /// What is told of the place at `pointer` in a request that was read from it, or of all of it.
    pub(in crate::cli) fn tell(&self, pointer: &str, detail: &str) -> String {
        let colon = if pointer.is_empty() { "" } else { ": " };
        format!("{}{colon}{pointer}: {detail}", self.name)
    }
}

/// The place of an observation in its source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum At {
    /// Counted from 1, blank ones too.
    Line(u64),
    /// Of a table. Its header is the first line of the file, so that this is the row that a spreadsheet shows.
    Row(u64),
    /// Of an array, counted from 0.
    Item(usize),
}

/// Where an observation stood.
#[derive(Clone, Debug)]
pub(in crate::cli) struct Spot {
    source: Arc<Source>,
    at: At,
}

impl Spot {
    pub(super) fn new(source: &Arc<Source>, at: At) -> Self {
        Self { source: Arc::clone(source), at }
    }

    /// What is told of the place at `pointer` in the observation, or of all of it.
    pub(in crate::cli) fn tell(&self, pointer: &str, detail: &str) -> String {
        let Source { name, columns, array } = &*self.source;
        match self.at {
            At::Line(line) => {
                let colon = if pointer.is_empty() { "" } else { ": " };
                format!("line {line} of {name}{colon}{pointer}: {detail}")
            }
            At::Row(row) => {
                let attribute = pointer.trim_start_matches('/').replace("~1", "/").replace("~0", "~");
                let column = columns.iter().find(|(named, _)| *named == attribute).map(|(_, column)| column);
                let column = column.map(|column| format!(", column {column:?}")).unwrap_or_default();
                format!("row {row} of {name}{column}: {detail}")
            }
            At::Item(index) => format!("{name}: {array}/{index}{pointer}: {detail}"),
        }
    }
}
