//! What is wrong with a document, and where.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::path::Path;

/// One thing wrong with a document, and where.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Fault {
    /// In a document of several lines (NDJSON): the line, from 1. The pointer is then that of a place within it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(required = false, nullable = false))]
    pub line: Option<u64>,
    /// JSON pointer (RFC 6901) to the faulty value; the empty pointer is the whole document.
    #[cfg_attr(feature = "openapi", schema(example = "/demonstration/3/x"))]
    pub pointer: String,
    /// What is wrong, and what would be right.
    #[cfg_attr(feature = "openapi", schema(example = "expected a number, found \"a\""))]
    pub detail: String,
}

/// Everything wrong with one document, in the order in which its reader found it: unknown fields of an object before its
/// known ones, which come in the order in which they are read, not in that of the text.
#[derive(Clone, Debug, Default, PartialEq, Eq, thiserror::Error)]
pub struct Faults {
    listed: Vec<Fault>,
    n_unlisted: usize,
}

impl Faults {
    /// Most faults that are listed; further ones are only counted. A million faulty states would otherwise
    /// make an answer larger than the request.
    pub const MAX_LISTED: usize = 1000;

    /// A document with a single fault.
    #[must_use]
    pub fn one(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        let fault = Fault { line: None, pointer: pointer.into(), detail: detail.into() };
        Self { listed: vec![fault], n_unlisted: 0 }
    }

    /// Notes a fault at `path`.
    pub fn note_at(&mut self, path: &Path<'_>, detail: impl Into<String>) {
        if self.listed.len() < Self::MAX_LISTED {
            self.listed.push(Fault { line: path.line(), pointer: path.to_string(), detail: detail.into() });
        } else {
            self.n_unlisted += 1;
        }
    }

    /// Notes a fault at what is called by a JSON pointer, in a document of several lines in a line of it.
    #[cfg(feature = "rules")]
    pub(crate) fn note_in(&mut self, line: Option<u64>, pointer: String, detail: impl Into<String>) {
        self.list(Fault { line, pointer, detail: detail.into() });
    }

    /// Lists a fault, if there is room for it.
    pub(super) fn list(&mut self, fault: Fault) {
        if self.listed.len() < Self::MAX_LISTED {
            self.listed.push(fault);
        } else {
            self.n_unlisted += 1;
        }
    }

    /// The faults that are listed.
    pub(super) fn into_listed(self) -> Vec<Fault> {
        self.listed
    }

    /// Notes that something else was `expected` at `path` than what was `found`.
    pub(crate) fn note_mismatch(&mut self, path: &Path<'_>, expected: &str, found: impl fmt::Display) {
        self.note_at(path, format!("expected {expected}, found {found}"));
    }

    /// Notes that the index at `path` is beyond a collection of `len` things called `what`.
    pub(crate) fn note_no_index(&mut self, path: &Path<'_>, what: &str, index: impl fmt::Display, len: usize) {
        self.note_at(path, format!("there is no {what} {index}: there are {len}, counted from 0"));
    }

    /// Counts `n` faults that are not to be listed.
    pub(crate) fn count_unlisted(&mut self, n: usize) {
        self.n_unlisted += n;
    }

    /// Adds the faults of a line of the document, from 1.
    pub(crate) fn append_at(&mut self, line: u64, mut other: Self) {
        for fault in &mut other.listed {
            fault.line = Some(line);
        }
        self.append(other);
    }

    /// Adds the faults of another part of the document.
    pub(crate) fn append(&mut self, other: Self) {
        let n_fitting = (Self::MAX_LISTED - self.listed.len()).min(other.listed.len());
        self.n_unlisted += other.count() - n_fitting;
        self.listed.extend(other.listed.into_iter().take(n_fitting));
    }

    /// Whether nothing was found wrong.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.listed.is_empty()
    }

    /// How many faults were found, listed or not.
    #[must_use]
    pub fn count(&self) -> usize {
        self.listed.len() + self.n_unlisted
    }

    /// How many bytes of memory they take.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.listed.iter().map(|fault| size_of::<Fault>() + fault.pointer.len() + fault.detail.len()).sum()
    }

    /// The first [`Self::MAX_LISTED`] faults.
    #[must_use]
    pub fn listed(&self) -> &[Fault] {
        &self.listed
    }

    /// Ends a reading: the value if nothing was noted, else the faults.
    ///
    /// # Errors
    ///
    /// `self`, if a fault was noted or (a defect of a reader) `read` is missing without one.
    pub fn check<T>(mut self, read: Option<T>) -> Result<T, Self> {
        match read {
            Some(value) if self.is_empty() => Ok(value),
            Some(_) => Err(self),
            None => {
                debug_assert!(!self.is_empty(), "a reader gave nothing and noted no fault");
                if self.is_empty() {
                    self.note_at(&Path::Root, "this document could not be read");
                }
                Err(self)
            }
        }
    }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (n, fault) in self.listed.iter().enumerate() {
            let separator = if n == 0 { "" } else { "\n" };
            let pointer = if fault.pointer.is_empty() { "(document)" } else { &fault.pointer };
            let line = fault.line.map(|line| format!("line {line}, ")).unwrap_or_default();
            write!(f, "{separator}{line}{pointer}: {}", fault.detail)?;
        }
        if self.n_unlisted > 0 {
            write!(f, "\nand {} more", self.n_unlisted)?;
        }
        Ok(())
    }
}
