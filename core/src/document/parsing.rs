//! Text to values.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_json::Value;

use super::fault::Faults;
use super::path::escape;

/// Why a text is not a document at all.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ParseError {
    /// The text is not JSON. Lines and columns count from 1.
    #[error("not JSON at line {line}, column {column}: {detail}")]
    Syntax {
        /// Line of the fault.
        line: usize,
        /// Column of the fault, in bytes.
        column: usize,
        /// What the parser met.
        detail: String,
    },
    /// The text is JSON with a value that cannot be held: a number beyond the range of 64-bit floats.
    #[error(transparent)]
    Faults(#[from] Faults),
}

/// Parses JSON text.
///
/// # Errors
///
/// [`ParseError::Syntax`] if `text` is not JSON (`NaN` and `Infinity` are not), [`ParseError::Faults`] if a
/// number in it overflows a 64-bit float.
pub fn parse(text: &[u8]) -> Result<Value, ParseError> {
    serde_json::from_slice(text).map_err(|error| explain_parse_error(text, &error))
}

/// Parses once more, slowly, to say where the fault is.
fn explain_parse_error(text: &[u8], error: &serde_json::Error) -> ParseError {
    let place = || {
        let mut pointer = String::new();
        // What it ends with is known; where it does is not.
        let _ = Tracked(&mut pointer).deserialize(&mut serde_json::Deserializer::from_slice(text));
        Faults::one(pointer, BEYOND_FLOATS)
    };
    ParseError::of(error, place)
}

/// Reads a value and leaves the pointer to where that failed.
struct Tracked<'p>(&'p mut String);

impl Tracked<'_> {
    /// Reads what is under `name` with `read`. The pointer leads there if that fails.
    fn under<T, E>(&mut self, name: &str, read: impl FnOnce(Tracked<'_>) -> Result<T, E>) -> Result<T, E> {
        let n_bytes = self.0.len();
        self.0.push('/');
        self.0.push_str(name);
        let value = read(Tracked(self.0))?;
        self.0.truncate(n_bytes);
        Ok(value)
    }
}

impl<'de> DeserializeSeed<'de> for Tracked<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Tracked<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JSON")
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut items: A) -> Result<(), A::Error> {
        for index in 0_usize.. {
            if self.under(&index.to_string(), |item| items.next_element_seed(item))?.is_none() {
                break;
            }
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut members: A) -> Result<(), A::Error> {
        while let Some(name) = members.next_key::<String>()? {
            self.under(&escape(&name), |member| members.next_value_seed(member))?;
        }
        Ok(())
    }

    fn visit_unit<E>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_bool<E>(self, _: bool) -> Result<(), E> {
        Ok(())
    }

    fn visit_i64<E>(self, _: i64) -> Result<(), E> {
        Ok(())
    }

    fn visit_u64<E>(self, _: u64) -> Result<(), E> {
        Ok(())
    }

    fn visit_f64<E>(self, _: f64) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E>(self, _: &str) -> Result<(), E> {
        Ok(())
    }
}

/// What is wrong with a number that a 64-bit float cannot hold.
pub(crate) const BEYOND_FLOATS: &str = "expected a finite number, found one beyond the range of 64-bit floats";

impl ParseError {
    /// What `error` means; `beyond_floats` gives the fault of a number that is out of range.
    pub(crate) fn of(error: &serde_json::Error, beyond_floats: impl FnOnce() -> Faults) -> Self {
        let detail = error.to_string();
        // serde_json appends the position, which is given separately here.
        let detail = detail.split(" at line ").next().unwrap_or_default().to_owned();
        if detail == "number out of range" {
            return beyond_floats().into();
        }
        Self::Syntax { line: error.line(), column: error.column(), detail }
    }
}
