//! Files of lines, read as they come.

use std::io::{BufRead, Read as _};
use std::str::FromStr;

use super::{ImportError, Spot};
use crate::document::Quoted;

/// Longest line, in bytes: it is kept while it is read.
const MAX_LINE_BYTES: usize = 4 << 20;

/// The lines of a file, numbered from 1.
pub(super) struct Lines<R> {
    inner: R,
    buffer: Vec<u8>,
    number: u64,
}

impl<R: BufRead> Lines<R> {
    pub(super) fn new(inner: R) -> Self {
        Self { inner, buffer: Vec::new(), number: 0 }
    }

    /// The next line, without its end; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<&str>, ImportError> {
        self.buffer.clear();
        let n_read = self.inner.by_ref().take(MAX_LINE_BYTES as u64).read_until(b'\n', &mut self.buffer)?;
        if n_read == 0 {
            return Ok(None);
        }
        self.number += 1;
        if n_read == MAX_LINE_BYTES {
            return Err(self.wrong(format!("the line has over {MAX_LINE_BYTES} bytes")));
        }
        let number = Spot::Line(self.number);
        let line = std::str::from_utf8(&self.buffer)
            .map_err(|error| ImportError::at(number, format!("byte {} is not UTF-8", error.valid_up_to())))?;
        Ok(Some(line.trim_end_matches(['\n', '\r'])))
    }

    /// The next line, where there must be one: it has `what`.
    pub(super) fn required(&mut self, what: &str) -> Result<&str, ImportError> {
        let spot = Spot::Line(self.number + 1);
        let missing = || ImportError::at(spot, format!("the file ends, but {what} should follow"));
        self.next()?.ok_or_else(missing)
    }

    /// The line that was read last.
    pub(super) fn spot(&self) -> Spot {
        Spot::Line(self.number)
    }

    /// The line that is read next.
    pub(super) fn next_spot(&self) -> Spot {
        Spot::Line(self.number + 1)
    }

    /// What is wrong with the line that was read last.
    pub(super) fn wrong(&self, detail: impl Into<String>) -> ImportError {
        ImportError::at(self.spot(), detail)
    }
}

/// Reads a number.
pub(super) fn number<T: FromStr>(text: &str, what: &str, spot: Spot) -> Result<T, ImportError> {
    text.trim().parse().map_err(|_| ImportError::at(spot, format!("expected {what}, found {}", Quoted(text))))
}
