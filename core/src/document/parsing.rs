//! Text to values.

use std::collections::HashSet;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};

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
    /// The text is JSON that cannot be held: an object has a member twice, or a number is beyond the range of 64-bit floats.
    #[error(transparent)]
    Faults(#[from] Faults),
}

/// Parses JSON text, which may begin with a byte order mark.
///
/// # Errors
///
/// [`ParseError::Syntax`] if `text` is not JSON (`NaN` and `Infinity` are not), [`ParseError::Faults`] if an object in it has a member
/// twice, or a number overflows a 64-bit float.
pub fn parse(text: &[u8]) -> Result<Value, ParseError> {
    let text = text.strip_prefix(BYTE_ORDER_MARK).unwrap_or(text);
    let mut json = serde_json::Deserializer::from_slice(text);
    let read = Whole.deserialize(&mut json).and_then(|value| json.end().map(|()| value));
    read.map_err(|_| explain_parse_error(text))
}

/// What some programs write at the beginning of a text (U+FEFF in UTF-8). It says nothing.
pub(crate) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// What is wrong with a member whose name an object has already.
pub(crate) const TWICE: &str = "stands twice in this object";

/// Parses once more, slowly, to say where the fault is.
fn explain_parse_error(text: &[u8]) -> ParseError {
    let (mut pointer, mut faults) = (String::new(), Faults::default());
    // What it ends with is known; where it does is not.
    let mut json = serde_json::Deserializer::from_slice(text);
    let read = Tracked { pointer: &mut pointer, faults: &mut faults }.deserialize(&mut json);
    match read.and_then(|()| json.end()) {
        // There was something, so there is a fault.
        Ok(()) => faults.into(),
        Err(error) => ParseError::of(&error, || {
            let mut faults = faults;
            faults.append(Faults::one(pointer, BEYOND_FLOATS));
            faults
        }),
    }
}

/// Reads a value as `serde_json` does, but for members that stand twice, which it refuses.
struct Whole;

impl<'de> DeserializeSeed<'de> for Whole {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Whole {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any valid JSON value")
    }

    fn visit_bool<E>(self, flag: bool) -> Result<Value, E> {
        Ok(flag.into())
    }

    fn visit_i64<E>(self, number: i64) -> Result<Value, E> {
        Ok(number.into())
    }

    fn visit_u64<E>(self, number: u64) -> Result<Value, E> {
        Ok(number.into())
    }

    fn visit_f64<E>(self, number: f64) -> Result<Value, E> {
        Ok(number.into())
    }

    fn visit_str<E>(self, text: &str) -> Result<Value, E> {
        Ok(text.into())
    }

    fn visit_string<E>(self, text: String) -> Result<Value, E> {
        Ok(text.into())
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Value, A::Error> {
        let mut held = Vec::new();
        while let Some(item) = items.next_element_seed(Self)? {
            held.push(item);
        }
        Ok(held.into())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Value, A::Error> {
        let mut held = Map::new();
        while let Some(name) = members.next_key::<String>()? {
            if held.insert(name, members.next_value_seed(Self)?).is_some() {
                return Err(A::Error::custom(TWICE));
            }
        }
        Ok(held.into())
    }
}

/// Reads a value, notes members that stand twice, and leaves the pointer to where reading failed, if it did.
struct Tracked<'p> {
    pointer: &'p mut String,
    faults: &'p mut Faults,
}

impl Tracked<'_> {
    /// Reads what is under `name` with `read`. The pointer leads there if that fails.
    fn under<T, E>(&mut self, name: &str, read: impl FnOnce(Tracked<'_>) -> Result<T, E>) -> Result<T, E> {
        let n_bytes = self.pointer.len();
        self.pointer.push('/');
        self.pointer.push_str(name);
        let value = read(Tracked { pointer: self.pointer, faults: self.faults })?;
        self.pointer.truncate(n_bytes);
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
        let mut names = HashSet::new();
        while let Some(name) = members.next_key::<String>()? {
            self.under(&escape(&name), |member| {
                if names.contains(&name) {
                    member.faults.append(Faults::one(member.pointer.as_str(), TWICE));
                }
                members.next_value_seed(member)
            })?;
            names.insert(name);
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
