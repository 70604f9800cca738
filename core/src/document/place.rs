//! Values in a document, read one by one, with the way to each.

use serde_json::{Map, Value};

use super::fault::Faults;
use super::path::Path;
use super::shown::Excerpt;

impl Faults {
    /// Notes a fault at `place`.
    pub fn note(&mut self, place: &Place<'_, '_>, detail: impl Into<String>) {
        self.note_at(&place.path, detail);
    }
}

/// A value in a document, and the way to it.
#[derive(Clone, Copy, Debug)]
pub struct Place<'v, 'p> {
    /// The value found there.
    pub value: &'v Value,
    /// How it was reached.
    pub path: Path<'p>,
}

impl<'v, 'p> Place<'v, 'p> {
    /// The whole document.
    #[must_use]
    pub fn root(value: &'v Value) -> Self {
        Self { value, path: Path::Root }
    }

    /// Reads an object that may have the members in `known` and no others.
    pub fn object(&self, known: &[&str], faults: &mut Faults) -> Option<Object<'v, 'p>> {
        let object = self.open_object(faults)?;
        object.members.keys().filter(|name| !known.contains(&name.as_str())).for_each(|name| {
            let detail = format!("unknown field; known here: {}", known.join(", "));
            faults.note_at(&Path::Member(&self.path, name), detail);
        });
        Some(object)
    }

    /// Reads an object whose members the caller checks.
    pub fn open_object(&self, faults: &mut Faults) -> Option<Object<'v, 'p>> {
        match self.value {
            Value::Object(members) => Some(Object { members, path: self.path }),
            _ => self.mismatch("an object", faults),
        }
    }

    /// Reads an array.
    pub fn array(&self, faults: &mut Faults) -> Option<&'v [Value]> {
        match self.value {
            Value::Array(items) => Some(items),
            _ => self.mismatch("an array", faults),
        }
    }

    /// The item `index` of the array at this place, whose value is `value`.
    #[must_use]
    pub fn item<'s>(&'s self, index: usize, value: &'v Value) -> Place<'v, 's> {
        Place { value, path: Path::Item(&self.path, index) }
    }

    /// Reads a string.
    pub fn string(&self, faults: &mut Faults) -> Option<&'v str> {
        match self.value {
            Value::String(text) => Some(text),
            _ => self.mismatch("a string", faults),
        }
    }

    /// Reads `true` or `false`.
    pub fn boolean(&self, faults: &mut Faults) -> Option<bool> {
        match self.value {
            Value::Bool(flag) => Some(*flag),
            _ => self.mismatch("true or false", faults),
        }
    }

    /// Reads a finite number within `range`.
    pub fn number(&self, range: Range, faults: &mut Faults) -> Option<f64> {
        let Some(number) = self.value.as_f64().filter(|number| number.is_finite()) else {
            return self.mismatch(&range.describe(), faults);
        };
        // Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal bits.
        if range.contains(number) { Some(number + 0.0) } else { self.mismatch(&range.describe(), faults) }
    }

    /// The whole number of at least 0 that is here, if it is one; it may be written with a point or an exponent, as in 8.0 or 1e2.
    #[must_use]
    pub fn whole(&self) -> Option<u64> {
        self.value
            .as_u64()
            .or_else(|| self.value.as_f64().and_then(whole).and_then(|number| u64::try_from(number).ok()))
    }

    /// Reads a whole number from `least` to `most`.
    pub fn integer(&self, least: u64, most: u64, faults: &mut Faults) -> Option<u64> {
        match self.whole() {
            Some(number) if (least..=most).contains(&number) => Some(number),
            _ => self.mismatch(&format!("a whole number from {least} to {most}"), faults),
        }
    }

    /// Reads an index into a collection of `len` things, called `what` in the fault.
    pub fn index(&self, len: usize, what: &str, faults: &mut Faults) -> Option<u32> {
        match self.whole().and_then(|index| u32::try_from(index).ok()) {
            Some(index) if (index as usize) < len => Some(index),
            Some(index) => {
                faults.note_no_index(&self.path, what, index, len);
                None
            }
            None => self.mismatch(&index_of(what), faults),
        }
    }

    /// Notes that something else was `expected` here, and reads nothing.
    pub fn mismatch<T>(&self, expected: &str, faults: &mut Faults) -> Option<T> {
        faults.note_mismatch(&self.path, expected, Excerpt(self.value));
        None
    }
}

/// The whole number that `number` is, if it is one, and none other is the same float.
pub(crate) fn whole(number: f64) -> Option<i64> {
    let is_whole = number.fract() == 0.0 && number.abs() <= MAX_WHOLE;
    #[expect(clippy::cast_possible_truncation, reason = "whole, and far below 2^63")]
    is_whole.then_some(number as i64)
}

/// 2^53: up to here, every whole number is a float of its own.
pub(crate) const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;

/// What is expected where a thing called `what` is referred to by its index.
pub(crate) fn index_of(what: &str) -> String {
    let article = if what.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" };
    format!("the index of {article} {what}")
}

/// An object in a document.
#[derive(Clone, Copy, Debug)]
pub struct Object<'v, 'p> {
    /// Its members, by name.
    pub members: &'v Map<String, Value>,
    /// How it was reached.
    pub path: Path<'p>,
}

impl<'v, 'p> Object<'v, 'p> {
    /// A member that must be there. `null` counts as missing.
    pub fn required<'s>(&'s self, name: &'s str, faults: &mut Faults) -> Option<Place<'v, 's>> {
        let place = self.optional(name);
        if place.is_none() {
            faults.note_at(&Path::Member(&self.path, name), "is missing");
        }
        place
    }

    /// A member that may be missing or `null`.
    #[must_use]
    pub fn optional<'s>(&'s self, name: &'s str) -> Option<Place<'v, 's>> {
        let value = self.members.get(name).filter(|value| !value.is_null())?;
        Some(Place { value, path: Path::Member(&self.path, name) })
    }

    /// Every member, in the order of names.
    pub fn iter<'s>(&'s self) -> impl Iterator<Item = (&'v str, Place<'v, 's>)> + use<'v, 's, 'p> {
        self.members.iter().map(|(name, value)| {
            let path = Path::Member(&self.path, name);
            (name.as_str(), Place { value, path })
        })
    }
}

/// Which finite numbers are allowed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Range {
    /// All of them.
    Finite,
    /// 0 and above.
    NonNegative,
    /// Above 0.
    Positive,
    /// 0 to this.
    UpTo(f64),
}

impl Range {
    fn contains(self, number: f64) -> bool {
        match self {
            Self::Finite => true,
            Self::NonNegative => number >= 0.0,
            Self::Positive => number > 0.0,
            Self::UpTo(most) => (0.0..=most).contains(&number),
        }
    }

    pub(crate) fn describe(self) -> String {
        match self {
            Self::Finite => "a number".to_owned(),
            Self::NonNegative => "a number of at least 0".to_owned(),
            Self::Positive => "a number above 0".to_owned(),
            Self::UpTo(most) if most < 1e6 => format!("a number from 0 to {most}"),
            Self::UpTo(most) => format!("a number from 0 to {most:e}"),
        }
    }
}
