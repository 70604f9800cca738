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
//! Hot paths deserialize valid input directly: they tell the [`Members`] of a request apart, and read its demonstration as what it is.
//! They use this reader to report faults.
//!
//! This module knows no document in particular; those live beside the types that they describe.

mod fault;
mod members;
mod normal;
mod parsing;
mod path;
mod place;
mod repeated;
mod shown;
mod size;

pub use fault::{Fault, Faults};
pub use members::Members;
pub use normal::normal;
pub(crate) use parsing::{BEYOND_FLOATS, BYTE_ORDER_MARK, TWICE};
pub use parsing::{ParseError, parse};
pub use path::Path;
pub use place::{Object, Place, Range};
pub(crate) use place::{index_of, whole};
pub use repeated::Repeated;
pub use shown::Quoted;
pub(crate) use shown::{Excerpt, list_known};
pub use size::{parsed_bytes, size_bytes};

#[cfg(test)]
mod tests;
