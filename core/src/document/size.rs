//! How much memory documents take.

use serde_json::Value;

/// What a value takes in a list that has grown, or a name.
const VALUE_BYTES: usize = 2 * size_of::<Value>();

/// What a map takes, which has room for eleven members.
const MAP_BYTES: usize = 11 * (size_of::<Value>() + size_of::<String>()) + 32;

/// About how much memory a document takes, in bytes.
pub fn size_bytes(document: &Value) -> usize {
    let inside = match document {
        Value::Null | Value::Bool(_) | Value::Number(_) => 0,
        Value::String(text) => text.len(),
        Value::Array(items) => items.iter().map(size_bytes).sum(),
        Value::Object(members) => {
            let inside =
                members.iter().map(|(name, value)| VALUE_BYTES + name.len() + size_bytes(value)).sum::<usize>();
            MAP_BYTES + inside
        }
    };
    VALUE_BYTES + inside
}

/// About how much memory the values in `text` take once they are parsed, in bytes: up to eighty times as much as the text. It counts
/// punctuation alone, also where that stands in strings.
#[must_use]
pub fn parsed_bytes(text: &[u8]) -> usize {
    let bytes_of = |byte: &u8| match byte {
        b',' | b':' => VALUE_BYTES,
        b'{' => MAP_BYTES,
        _ => 0,
    };
    text.len() + text.iter().map(bytes_of).sum::<usize>()
}
