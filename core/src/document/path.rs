//! The way to a value in a document.

use std::fmt;

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
    pub(crate) fn line(&self) -> Option<u64> {
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
pub(super) fn escape(name: &str) -> String {
    name.replace('~', "~0").replace('/', "~1")
}
