//! JSON as other programs write it.

use serde_json::Value;

use crate::cli::CliError;
use etude_core::document::{self, ParseError};

/// Parses the text of a file called `name`.
pub(super) fn parse_document(name: &str, text: Vec<u8>) -> Result<Value, CliError> {
    document::parse(&as_json(text)).map_err(|error| CliError::Faulty(format!("{name}: {error}")))
}

/// Parses a line; else, says what is wrong with it.
pub(super) fn parse_line(text: Vec<u8>) -> Result<Value, String> {
    document::parse(as_json(text).trim_ascii()).map_err(|error| match error {
        ParseError::Syntax { column, detail, .. } => format!("not JSON at column {column}: {detail}"),
        error @ ParseError::Faults(_) => error.to_string(),
    })
}

/// Parses the value of an option.
pub(in crate::cli) fn parse_json(text: &str) -> Result<Value, String> {
    parse_line(text.as_bytes().to_vec())
}

/// Whether `text` is the beginning of a JSON value that goes on.
pub(super) fn is_cut_off(text: &[u8]) -> bool {
    serde_json::from_slice::<serde::de::IgnoredAny>(&as_json(text.to_vec())).is_err_and(|error| error.is_eof())
}

/// Python writes `NaN` and `Infinity`, which JSON lacks. Here the first becomes `null`, which is what was not observed, and the other a
/// number beyond the range of floats, which is refused for what it is.
fn as_json(text: Vec<u8>) -> Vec<u8> {
    const WORDS: [(&[u8], &[u8]); 2] = [(b"NaN", b"null"), (b"Infinity", b"1e999999")];
    if !WORDS.iter().any(|(word, _)| text.windows(word.len()).any(|part| part == *word)) {
        return text;
    }
    let mut json = Vec::with_capacity(text.len() + text.len() / 8);
    let (mut rest, mut is_in_string) = (&text[..], false);
    while let Some(byte) = rest.first() {
        if let Some((word, value)) = WORDS.iter().find(|(word, _)| !is_in_string && rest.starts_with(word)) {
            json.extend_from_slice(value);
            rest = &rest[word.len()..];
            continue;
        }
        let n_bytes = if is_in_string && *byte == b'\\' { rest.len().min(2) } else { 1 };
        is_in_string ^= *byte == b'"';
        json.extend_from_slice(&rest[..n_bytes]);
        rest = &rest[n_bytes..];
    }
    json
}
