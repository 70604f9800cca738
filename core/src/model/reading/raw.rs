//! JSON values of a text, interned before the reader knows what they should be.

use std::fmt;
use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;

use crate::attribute::{Attribute, Value};
use crate::document::{Excerpt, Quoted};

/// A JSON value, without the items of an array and the members of an object. `T` is a text, borrowed or owned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(in crate::model) enum Raw<T = Box<str>> {
    Null,
    Boolean(bool),
    Whole(u64),
    /// A whole number below 0.
    Negative(i64),
    /// The bits of a finite number.
    Float(u64),
    Text(T),
    /// An array of so many items.
    Array(usize),
    Object,
}

impl<T: AsRef<str>> Raw<T> {
    pub(in crate::model) fn float(number: f64) -> Self {
        Self::Float(number.to_bits())
    }

    fn borrowed(&self) -> Raw<&str> {
        match self {
            Self::Null => Raw::Null,
            Self::Boolean(flag) => Raw::Boolean(*flag),
            Self::Whole(number) => Raw::Whole(*number),
            Self::Negative(number) => Raw::Negative(*number),
            Self::Float(bits) => Raw::Float(*bits),
            Self::Text(text) => Raw::Text(text.as_ref()),
            Self::Array(len) => Raw::Array(*len),
            Self::Object => Raw::Object,
        }
    }

    /// The number that it is, if it is one.
    pub(in crate::model) fn number(&self) -> Option<f64> {
        #[expect(clippy::cast_precision_loss, reason = "numbers are floats")]
        match self {
            Self::Whole(number) => Some(*number as f64),
            Self::Negative(number) => Some(*number as f64),
            Self::Float(bits) => Some(f64::from_bits(*bits)),
            _ => None,
        }
    }

    /// The value; `None` if it is an array or an object.
    pub(in crate::model) fn scalar(&self) -> Option<serde_json::Value> {
        Some(match self {
            Self::Null => serde_json::Value::Null,
            Self::Boolean(flag) => (*flag).into(),
            Self::Whole(number) => (*number).into(),
            Self::Negative(number) => (*number).into(),
            Self::Float(bits) => f64::from_bits(*bits).into(),
            Self::Text(text) => text.as_ref().into(),
            Self::Array(_) | Self::Object => return None,
        })
    }
}

impl Raw<&str> {
    pub(super) fn owned(self) -> Raw {
        /// A longer text is a fault, which shows only how the text begins.
        const MAX_KEPT_BYTES: usize = Attribute::MAX_TEXT_BYTES + 1;
        match self {
            Self::Null => Raw::Null,
            Self::Boolean(flag) => Raw::Boolean(flag),
            Self::Whole(number) => Raw::Whole(number),
            Self::Negative(number) => Raw::Negative(number),
            Self::Float(bits) => Raw::Float(bits),
            Self::Text(text) => Raw::Text(text[..text.ceil_char_boundary(MAX_KEPT_BYTES)].into()),
            Self::Array(len) => Raw::Array(len),
            Self::Object => Raw::Object,
        }
    }
}

/// The value as it is shown in a fault.
impl<T: AsRef<str>> fmt::Display for Raw<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Array(len) => write!(f, "an array of {len}"),
            Self::Object => f.write_str("an object"),
            Self::Text(text) => Quoted(text.as_ref()).fmt(f),
            scalar => Excerpt(&scalar.scalar().unwrap_or_default()).fmt(f),
        }
    }
}

/// Distinct values, numbered from 0 in the order in which they were first met.
#[derive(Debug, Default)]
pub(in crate::model) struct Distinct {
    values: Vec<Raw>,
    /// Indices into `values`, 5 bytes each. Hashed with a seed, as clients choose the values.
    numbers: HashTable<u32>,
    hasher: RandomState,
    n_text_bytes: usize,
}

impl Distinct {
    /// The number of `found`.
    pub(in crate::model) fn number_of(&mut self, found: Raw<&str>) -> u32 {
        let Self { values, numbers, hasher, n_text_bytes } = self;
        let hash = hasher.hash_one(found);
        let is_found = |number: &u32| values[*number as usize].borrowed() == found;
        if let Some(number) = numbers.find(hash, is_found) {
            return *number;
        }
        #[expect(clippy::cast_possible_truncation, reason = "fewer than cells, of which limits allow fewer than 2^32")]
        let number = values.len() as u32;
        let found = found.owned();
        if let Raw::Text(text) = &found {
            *n_text_bytes += text.len();
        }
        values.push(found);
        numbers.insert_unique(hash, number, |number| hasher.hash_one(values[*number as usize].borrowed()));
        number
    }

    /// About how much memory they take, in bytes, including the attribute values that they are read into, and the projected transitions
    /// between those.
    pub(super) fn size_bytes(&self) -> usize {
        const VALUE_BYTES: usize = 2 * size_of::<Raw>() + 2 * size_of::<Value>();
        self.values.len() * VALUE_BYTES + 2 * self.n_text_bytes
    }

    /// The values, in the order of their numbers.
    pub(in crate::model) fn values(&self) -> &[Raw] {
        &self.values
    }

    /// As [`Self::values`]; drops the index.
    pub(in crate::model) fn into_values(self) -> Vec<Raw> {
        self.values
    }
}
