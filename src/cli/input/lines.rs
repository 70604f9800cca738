//! Lines of a text, as they come.

use std::io::{BufRead, Read};

use crate::cli::CliError;

/// What is read. That may be done in a thread of its own.
pub(super) type Input = Box<dyn BufRead + Send>;

/// Lines of a text, as they come. The first that is not blank can be looked at before it is read.
pub(super) struct Lines {
    input: Input,
    name: String,
    n_read: u64,
    first: Option<Vec<u8>>,
}

impl Lines {
    /// The lines of `input`, which is called `name`.
    pub(super) fn new(input: Input, name: String) -> Self {
        Self { input, name, n_read: 0, first: None }
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// How many lines were read, which is the number of the last one, counted from 1.
    pub(super) fn n_read(&self) -> u64 {
        self.n_read
    }

    /// The first line that is not blank, to be read still; empty if there is none.
    pub(super) fn first(&mut self) -> Result<&[u8], CliError> {
        let first = self.next()?.unwrap_or_default();
        Ok(self.first.insert(first))
    }

    /// The next line that is not blank; `None` at the end of the input.
    pub(super) fn next(&mut self) -> Result<Option<Vec<u8>>, CliError> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first).filter(|first| !first.is_empty()));
        }
        loop {
            match self.next_or_blank()? {
                Some(line) if line.trim_ascii().is_empty() => {}
                line => return Ok(line),
            }
        }
    }

    /// The next line, with its end; `None` at the end of the input.
    pub(super) fn next_or_blank(&mut self) -> Result<Option<Vec<u8>>, CliError> {
        const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";
        let mut text = Vec::new();
        let n_bytes = self.input.read_until(b'\n', &mut text).map_err(|source| self.failed(source))?;
        if n_bytes == 0 {
            return Ok(None);
        }
        self.n_read += 1;
        if self.n_read == 1 {
            if text.starts_with(b"\xff\xfe") || text.starts_with(b"\xfe\xff") {
                return Err(CliError::Faulty(format!("{} is UTF-16: save it as UTF-8", self.name)));
            }
            if text.starts_with(BYTE_ORDER_MARK) {
                text.drain(..BYTE_ORDER_MARK.len());
            }
        }
        Ok(Some(text))
    }

    /// All that was not read yet, after as many blank lines as were read, so that lines have the same numbers in it.
    pub(super) fn rest(mut self) -> Result<Vec<u8>, CliError> {
        let n_blank = self.n_read - u64::from(self.first.is_some());
        let mut text = vec![b'\n'; usize::try_from(n_blank).unwrap_or(0)];
        text.extend(self.first.take().unwrap_or_default());
        self.input.read_to_end(&mut text).map_err(|source| self.failed(source))?;
        Ok(text)
    }

    fn failed(&self, source: std::io::Error) -> CliError {
        CliError::Read { path: self.name.as_str().into(), source }
    }
}
