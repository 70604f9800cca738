//! Values of expressions.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::ops::Deref;
use std::sync::Arc;

use crate::document::{Quoted, whole};

/// A value of an expression. Equal as in CEL: an `int` equals a `double` of the same value.
#[derive(Clone, Debug)]
pub(crate) enum Datum<'a> {
    /// Nothing: what was not observed.
    Null,
    /// A whole number.
    Int(i64),
    /// A number; may be infinite or NaN.
    Double(f64),
    /// True or false.
    Bool(bool),
    /// A text.
    Text(Text<'a>),
    /// Values in order.
    List(List<'a>),
}

/// A text that is somebody else's, or was made by an expression.
#[derive(Clone, Debug)]
pub(crate) enum Text<'a> {
    /// Somebody else's.
    Borrowed(&'a str),
    /// Made by an expression.
    Owned(Arc<str>),
}

/// A list that is somebody else's, or was made by an expression.
#[derive(Clone, Debug)]
pub(crate) enum List<'a> {
    /// Somebody else's.
    Borrowed(&'a [Datum<'a>]),
    /// Made by an expression.
    Owned(Arc<[Datum<'a>]>),
}

impl Deref for Text<'_> {
    type Target = str;

    #[inline]
    fn deref(&self) -> &str {
        match self {
            Self::Borrowed(text) => text,
            Self::Owned(text) => text,
        }
    }
}

impl<'a> Deref for List<'a> {
    type Target = [Datum<'a>];

    #[inline]
    fn deref(&self) -> &[Datum<'a>] {
        match self {
            Self::Borrowed(list) => list,
            Self::Owned(list) => list,
        }
    }
}

impl Datum<'static> {
    /// A text of its own.
    pub(crate) fn text(text: &str) -> Self {
        Self::Text(Text::Owned(text.into()))
    }
}

impl<'a> Datum<'a> {
    /// A list of its own.
    pub(crate) fn list(items: Vec<Self>) -> Self {
        Self::List(List::Owned(items.into()))
    }

    /// The same value, borrowed.
    #[inline]
    pub(crate) fn borrowed<'b>(&'b self) -> Datum<'b>
    where
        'a: 'b,
    {
        match self {
            Self::Null => Datum::Null,
            Self::Int(number) => Datum::Int(*number),
            Self::Double(number) => Datum::Double(*number),
            Self::Bool(flag) => Datum::Bool(*flag),
            Self::Text(text) => Datum::Text(Text::Borrowed(text)),
            Self::List(list) => Datum::List(List::Borrowed(list)),
        }
    }

    /// Whether it is null, or has one in it: what it equals is then not known.
    pub(super) fn is_unknown(&self) -> bool {
        match self {
            Self::Null => true,
            Self::List(list) => list.iter().any(Self::is_unknown),
            _ => false,
        }
    }

    /// What its type is called.
    pub(crate) fn type_name(&self) -> &'static str {
        match self {
            Self::Null => "null",
            Self::Int(_) => "int",
            Self::Double(_) => "double",
            Self::Bool(_) => "bool",
            Self::Text(_) => "string",
            Self::List(_) => "list",
        }
    }

    /// How it compares, if it can be: numbers with numbers, texts with texts, flags with flags. NaN compares with nothing.
    pub(super) fn order(&self, other: &Self) -> Option<Ordering> {
        match (self, other) {
            (Self::Int(a), Self::Int(b)) => Some(a.cmp(b)),
            (Self::Double(a), Self::Double(b)) => a.partial_cmp(b),
            (Self::Int(a), Self::Double(b)) => order_mixed(*a, *b),
            (Self::Double(a), Self::Int(b)) => order_mixed(*b, *a).map(Ordering::reverse),
            (Self::Text(a), Self::Text(b)) => Some((**a).cmp(&**b)),
            (Self::Bool(a), Self::Bool(b)) => Some(a.cmp(b)),
            _ => None,
        }
    }
}

/// How a whole number compares with a float, exactly.
#[expect(clippy::cast_precision_loss, reason = "where precision is lost, the whole parts decide")]
fn order_mixed(a: i64, b: f64) -> Option<Ordering> {
    match whole(b) {
        Some(b) => Some(a.cmp(&b)),
        None => (a as f64).partial_cmp(&b),
    }
}

impl PartialEq for Datum<'_> {
    #[inline]
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Null, Self::Null) => true,
            (Self::List(a), Self::List(b)) => **a == **b,
            (Self::Text(a), Self::Text(b)) => **a == **b,
            _ => self.order(other) == Some(Ordering::Equal),
        }
    }
}

// NaN is never looked up: it is no constant, and equal to nothing that is one.
impl Eq for Datum<'_> {}

impl Hash for Datum<'_> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        match self {
            Self::Null => 0.hash(state),
            Self::Int(number) => number.hash(state),
            Self::Double(number) => match whole(*number) {
                Some(number) => number.hash(state),
                None => number.to_bits().hash(state),
            },
            Self::Bool(flag) => flag.hash(state),
            Self::Text(text) => text.hash(state),
            Self::List(list) => list.hash(state),
        }
    }
}

impl fmt::Display for Datum<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Null => f.write_str("null"),
            Self::Int(number) => number.fmt(f),
            Self::Double(number) => number.fmt(f),
            Self::Bool(flag) => flag.fmt(f),
            Self::Text(text) => Quoted(text).fmt(f),
            Self::List(list) => write!(f, "a list of {}", list.len()),
        }
    }
}
