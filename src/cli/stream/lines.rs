//! Observations from standard input, a line each.

use std::io::{self, BufRead};

use serde_json::Value;
use tokio::sync::mpsc;

use crate::cli::CliError;
use etude_core::document::{self, ParseError};

/// Most lines that are read ahead.
pub(super) const MAX_READ_AHEAD: usize = 64;

/// A line of the input.
pub(super) struct Line {
    /// Counted from 1, blank ones too.
    pub(super) number: u64,
    pub(super) observation: Value,
}

/// Lines as they come.
pub(super) struct Lines<R> {
    input: R,
    n_read: u64,
}

impl<R: BufRead> Lines<R> {
    pub(super) fn new(input: R) -> Self {
        Self { input, n_read: 0 }
    }

    /// The next line that is not blank; `None` at the end.
    pub(super) fn next(&mut self) -> Result<Option<Line>, CliError> {
        let mut text = Vec::new();
        loop {
            text.clear();
            if self.input.read_until(b'\n', &mut text)? == 0 {
                return Ok(None);
            }
            self.n_read += 1;
            if !text.trim_ascii().is_empty() {
                break;
            }
        }
        let number = self.n_read;
        let told = |error: ParseError| CliError::Line { line: number, problem: error.to_string() };
        Ok(Some(Line { number, observation: document::parse(text.trim_ascii()).map_err(told)? }))
    }
}

/// Reads standard input in a thread of its own, because waiting for it cannot be given up.
pub(super) fn read_lines() -> mpsc::Receiver<Result<Option<Line>, CliError>> {
    let (sender, lines) = mpsc::channel(MAX_READ_AHEAD);
    std::thread::spawn(move || {
        let mut input = Lines::new(io::stdin().lock());
        loop {
            let line = input.next();
            let is_last = !matches!(line, Ok(Some(_)));
            if sender.blocking_send(line).is_err() || is_last {
                return;
            }
        }
    });
    lines
}
