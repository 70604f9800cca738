//! Reading JSON documents with *all* their faults.
//!
//! A client that sends a body with five mistakes should be told of five, each with its place. Derived
//! deserialization stops at the first, so documents are read in two steps: [`parse`] turns text into a
//! [`serde_json::Value`], and the readers of each domain type walk that value by [`Place`]s, noting every
//! [`Fault`] with its JSON pointer (RFC 6901) and reading on.
//!
//! A reader returns `Option`: `None` means that it noted at least one fault. [`Faults::check`] turns the two
//! into a `Result` at the end.
//!
//! Where that takes too long, what is well-formed may be read from its text at once (such as a small demonstration); whatever is not is
//! read again, to tell what is wrong.
//!
//! This module knows no document in particular; those live beside the types that they describe.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// One thing wrong with a document, and where.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Fault {
    /// In a document of several lines (NDJSON): the line, from 1. The pointer is then that of a place within it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(required = false, nullable = false))]
    pub line: Option<u64>,
    /// JSON pointer (RFC 6901) to the faulty value; the empty pointer is the whole document.
    #[cfg_attr(feature = "openapi", schema(example = "/demonstration/3/x"))]
    pub pointer: String,
    /// What is wrong, and what would be right.
    #[cfg_attr(feature = "openapi", schema(example = "expected a number, found \"a\""))]
    pub detail: String,
}

/// Everything wrong with one document, in the order in which its reader found it: unknown fields of an object before its
/// known ones, which come in the order in which they are read, not in that of the text.
#[derive(Clone, Debug, Default, PartialEq, Eq, thiserror::Error)]
pub struct Faults {
    listed: Vec<Fault>,
    n_unlisted: usize,
}

impl Faults {
    /// Most faults that are listed; further ones are only counted. A million faulty states would otherwise
    /// make an answer larger than the request.
    pub const MAX_LISTED: usize = 1000;

    /// A document with a single fault.
    #[must_use]
    pub fn one(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        let fault = Fault { line: None, pointer: pointer.into(), detail: detail.into() };
        Self { listed: vec![fault], n_unlisted: 0 }
    }

    /// Notes a fault at `place`.
    pub fn note(&mut self, place: &Place<'_, '_>, detail: impl Into<String>) {
        self.note_at(&place.path, detail);
    }

    /// Notes a fault at `path`.
    pub fn note_at(&mut self, path: &Path<'_>, detail: impl Into<String>) {
        if self.listed.len() < Self::MAX_LISTED {
            self.listed.push(Fault { line: path.line(), pointer: path.to_string(), detail: detail.into() });
        } else {
            self.n_unlisted += 1;
        }
    }

    /// Notes that something else was `expected` at `path` than what was `found`.
    pub(crate) fn note_mismatch(&mut self, path: &Path<'_>, expected: &str, found: impl fmt::Display) {
        self.note_at(path, format!("expected {expected}, found {found}"));
    }

    /// Notes that the index at `path` is beyond a collection of `len` things called `what`.
    pub(crate) fn note_no_index(&mut self, path: &Path<'_>, what: &str, index: impl fmt::Display, len: usize) {
        self.note_at(path, format!("there is no {what} {index}: there are {len}, counted from 0"));
    }

    /// Counts `n` faults that are not to be listed.
    pub(crate) fn count_unlisted(&mut self, n: usize) {
        self.n_unlisted += n;
    }

    /// Adds the faults of another part of the document.
    pub(crate) fn append(&mut self, other: Self) {
        let n_fitting = (Self::MAX_LISTED - self.listed.len()).min(other.listed.len());
        self.n_unlisted += other.count() - n_fitting;
        self.listed.extend(other.listed.into_iter().take(n_fitting));
    }

    /// Whether nothing was found wrong.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.listed.is_empty()
    }

    /// How many faults were found, listed or not.
    #[must_use]
    pub fn count(&self) -> usize {
        self.listed.len() + self.n_unlisted
    }

    /// How many bytes of memory they take.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.listed.iter().map(|fault| size_of::<Fault>() + fault.pointer.len() + fault.detail.len()).sum()
    }

    /// The first [`Self::MAX_LISTED`] faults.
    #[must_use]
    pub fn listed(&self) -> &[Fault] {
        &self.listed
    }

    /// Ends a reading: the value if nothing was noted, else the faults.
    ///
    /// # Errors
    ///
    /// `self`, if a fault was noted or (a defect of a reader) `read` is missing without one.
    pub fn check<T>(mut self, read: Option<T>) -> Result<T, Self> {
        match read {
            Some(value) if self.is_empty() => Ok(value),
            Some(_) => Err(self),
            None => {
                debug_assert!(!self.is_empty(), "a reader gave nothing and noted no fault");
                if self.is_empty() {
                    self.note_at(&Path::Root, "this document could not be read");
                }
                Err(self)
            }
        }
    }
}

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (n, fault) in self.listed.iter().enumerate() {
            let separator = if n == 0 { "" } else { "\n" };
            let pointer = if fault.pointer.is_empty() { "(document)" } else { &fault.pointer };
            let line = fault.line.map(|line| format!("line {line}, ")).unwrap_or_default();
            write!(f, "{separator}{line}{pointer}: {}", fault.detail)?;
        }
        if self.n_unlisted > 0 {
            write!(f, "\nand {} more", self.n_unlisted)?;
        }
        Ok(())
    }
}

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

/// About how much memory the values in `text` take once they are parsed, in bytes: up to eighty times as much as the text. Looks at
/// nothing but punctuation, and takes that in strings for more of it.
#[must_use]
pub fn parsed_bytes(text: &[u8]) -> usize {
    let bytes_of = |byte: &u8| match byte {
        b',' | b':' => VALUE_BYTES,
        b'{' => MAP_BYTES,
        _ => 0,
    };
    text.len() + text.iter().map(bytes_of).sum::<usize>()
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

/// The way from a document's root to a value in it. Lives on the stack of the readers, so that following it costs
/// nothing until a fault has to be written down.
#[derive(Clone, Copy, Debug)]
pub enum Path<'p> {
    /// The document.
    Root,
    /// A line of a document of several, from 1.
    Line(u64),
    /// A member of an object.
    Member(&'p Path<'p>, &'p str),
    /// An item of an array.
    Item(&'p Path<'p>, usize),
}

impl Path<'_> {
    /// The line that it leads into, in a document of several.
    fn line(&self) -> Option<u64> {
        match self {
            Path::Root => None,
            Path::Line(line) => Some(*line),
            Path::Member(parent, _) | Path::Item(parent, _) => parent.line(),
        }
    }
}

impl fmt::Display for Path<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Path::Root | Path::Line(_) => Ok(()),
            Path::Member(parent, name) => write!(f, "{parent}/{}", escape(name)),
            Path::Item(parent, index) => write!(f, "{parent}/{index}"),
        }
    }
}

/// Escapes a member's name for a JSON pointer (RFC 6901, section 4).
fn escape(name: &str) -> String {
    name.replace('~', "~0").replace('/', "~1")
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

    /// Reads a whole number from `least` to `most`.
    pub fn integer(&self, least: u64, most: u64, faults: &mut Faults) -> Option<u64> {
        match self.value.as_u64() {
            Some(number) if (least..=most).contains(&number) => Some(number),
            _ => self.mismatch(&format!("a whole number from {least} to {most}"), faults),
        }
    }

    /// Reads an index into a collection of `len` things, called `what` in the fault.
    pub fn index(&self, len: usize, what: &str, faults: &mut Faults) -> Option<u32> {
        let index = self.value.as_u64().and_then(|index| u32::try_from(index).ok());
        match index {
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

/// A value as it is shown in a fault: whole if short, else its kind.
pub(crate) struct Excerpt<'v>(pub(crate) &'v Value);

impl fmt::Display for Excerpt<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Value::Array(items) => write!(f, "an array of {}", items.len()),
            Value::Object(_) => f.write_str("an object"),
            Value::String(text) => Quoted(text).fmt(f),
            other => write!(f, "{other}"),
        }
    }
}

/// A text as it is shown in a fault: quoted, and cut if it is long.
pub struct Quoted<'t>(pub &'t str);

impl fmt::Display for Quoted<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        /// Most characters shown: enough to recognize a name by.
        const MAX_SHOWN: usize = 60;
        let cut = self.0.char_indices().nth(MAX_SHOWN).map(|(end, _)| &self.0[..end]);
        let ellipsis = if cut.is_some() { ".." } else { "" };
        write!(f, "{}{ellipsis}", Value::from(cut.unwrap_or(self.0)))
    }
}

/// Names that would have been right, as they are listed in a fault: the first few.
pub(crate) fn list_known<N: AsRef<str>>(names: impl IntoIterator<Item = N>) -> String {
    /// Most names listed. There may be tens of thousands, and a fault for every state.
    const MAX_KNOWN: usize = 10;
    let mut names = names.into_iter();
    let mut known: Vec<String> = names.by_ref().take(MAX_KNOWN).map(|name| Quoted(name.as_ref()).to_string()).collect();
    known.extend(names.next().map(|_| "..".to_owned()));
    known.join(", ")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn faults_carry_escaped_pointers_in_reading_order() {
        let value = json!({"a/b": [1, "x"], "c~": true});
        let mut faults = Faults::default();
        let root = Place::root(&value);
        let object = root.object(&["a/b"], &mut faults).unwrap();
        let items = object.required("a/b", &mut faults).unwrap();
        for (n, item) in items.array(&mut faults).unwrap().iter().enumerate() {
            items.item(n, item).number(Range::Finite, &mut faults);
        }
        object.required("gone", &mut faults);
        let pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
        assert_eq!(pointers, ["/c~0", "/a~1b/1", "/gone"]);
    }

    #[test]
    fn a_number_beyond_floats_is_a_fault_with_its_place() {
        let error = parse(br#"{"a": [0, 1e999]}"#).unwrap_err();
        let ParseError::Faults(faults) = error else { panic!("{error:?}") };
        assert_eq!(faults.listed()[0].pointer, "/a/1");
    }

    #[test]
    fn nan_is_not_json() {
        let error = parse(b"{\n\"a\": NaN}").unwrap_err();
        assert!(matches!(error, ParseError::Syntax { line: 2, .. }), "{error:?}");
    }

    #[test]
    fn the_list_of_faults_is_bounded_and_says_so() {
        let mut faults = Faults::default();
        for _ in 0..Faults::MAX_LISTED + 5 {
            faults.note_at(&Path::Root, "no");
        }
        assert_eq!((faults.listed().len(), faults.count()), (Faults::MAX_LISTED, Faults::MAX_LISTED + 5));
        assert!(faults.to_string().ends_with("and 5 more"));
    }

    #[test]
    fn what_a_fault_repeats_of_a_document_is_cut() {
        let long = "\u{e9}".repeat(1_000_000);
        assert_eq!(Quoted(&long).to_string(), format!("\"{}\"..", "\u{e9}".repeat(60)));
        assert_eq!(Quoted("a\"b").to_string(), r#""a\"b""#);
        let names: Vec<String> = (0..60_000).map(|n| format!("{n}{long}")).take(12).collect();
        let known = list_known(&names);
        assert!(known.starts_with("\"0") && known.ends_with(", ..") && known.len() < 2000, "{known}");
        assert_eq!(list_known(["a", "b"]), r#""a", "b""#);
    }

    #[test]
    fn an_index_of_an_action_is_asked_for_in_english() {
        let mut faults = Faults::default();
        Place::root(&json!("x")).index(3, "action", &mut faults);
        assert_eq!(faults.listed()[0].detail, "expected the index of an action, found \"x\"");
    }
}
