//! Files as commands read them, which may be compressed.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use indicatif::ProgressBar;
use serde_json::Value;

use super::CliError;
use crate::compressed::{Decompressed, GZIP, ZSTD};
use etude_core::document;

/// What begins like this is not read, and what has made it.
const OTHERS: [(&[u8], &str); 3] =
    [(b"\xfd7zXZ\0", "compressed by xz"), (b"BZh", "compressed by bzip2"), (b"PK\x03\x04", "a zip archive")];

/// Opens the file at `path`, `-` for standard input, decompressed; how far it is read is shown by `bar`.
pub(super) fn open(path: &Path, bar: &ProgressBar) -> Result<Box<dyn BufRead + Send>, CliError> {
    let read = |source| CliError::Read { path: path.to_owned(), source };
    let input: Box<dyn Read + Send> = if path == Path::new("-") {
        Box::new(io::stdin())
    } else {
        let file = File::open(path).map_err(read)?;
        bar.set_length(file.metadata().map_err(read)?.len());
        Box::new(file)
    };
    let mut input = buffered(bar.wrap_read(input));
    let head = input.fill_buf().map_err(read)?;
    if let Some((_, what)) = OTHERS.iter().find(|(magic, _)| head.starts_with(magic)) {
        return Err(CliError::Faulty(format!("{}: {what}; decompress it first", path.display())));
    }
    if head.starts_with(GZIP) {
        return Ok(Box::new(buffered(Decompressed::gzip(input))));
    }
    if head.starts_with(ZSTD) {
        return Ok(Box::new(buffered(Decompressed::zstd(input, None).map_err(read)?)));
    }
    Ok(Box::new(input))
}

fn buffered<R: Read>(reader: R) -> BufReader<R> {
    BufReader::with_capacity(1 << 16, reader)
}

/// Reads the whole file at `path`, likewise, as JSON.
pub(super) fn read_json(path: &Path) -> Result<Value, CliError> {
    let mut text = Vec::new();
    let read = open(path, &ProgressBar::hidden())?.read_to_end(&mut text);
    read.map_err(|source| CliError::Read { path: path.to_owned(), source })?;
    document::parse(&text).map_err(|source| CliError::Faulty(format!("{}: {source}", path.display())))
}
