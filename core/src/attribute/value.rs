//! Values of attributes, inside and on the wire.

use std::fmt;
use std::hash::{Hash, Hasher};

use serde::{Deserialize, Serialize, Serializer};

/// A value of an attribute, in the form that the core compares.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Value {
    /// Of a `number`, or of a `cyclic` with a period. Finite, never -0.
    Number(f64),
    /// Of a `cyclic` with labels: an index into them.
    Label(u32),
    /// Of a `category`.
    Text(Box<str>),
    /// Of a `category`.
    Integer(i64),
    /// Of a `category`.
    Boolean(bool),
}

// Numbers are never NaN and never -0, so that they are equal exactly if their bits are.
impl Eq for Value {}

impl Hash for Value {
    fn hash<H: Hasher>(&self, state: &mut H) {
        match self {
            Self::Number(number) => number.to_bits().hash(state),
            Self::Label(label) => label.hash(state),
            Self::Text(text) => text.hash(state),
            Self::Integer(integer) => integer.hash(state),
            Self::Boolean(flag) => flag.hash(state),
        }
    }
}

/// A value of an attribute, as it is written in JSON: a number, a string (a label, or a category) or a boolean.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Scalar {
    /// A category's boolean.
    Boolean(bool),
    /// A whole number.
    Integer(i64),
    /// Any other number.
    Number(f64),
    /// A label, or a category's string.
    Text(Box<str>),
}

impl Scalar {
    /// A number, written without a decimal point where it is whole.
    #[must_use]
    pub fn number(number: f64) -> Self {
        /// Up to here every whole number is a float of its own.
        const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;
        if number.fract() == 0.0 && number.abs() < MAX_WHOLE {
            #[expect(clippy::cast_possible_truncation, reason = "whole, and far below 2^63")]
            let whole = number as i64;
            Self::Integer(whole)
        } else {
            Self::Number(number)
        }
    }
}

// Derived, a whole number would be described twice, as an integer and as a number.
#[cfg(feature = "openapi")]
impl utoipa::PartialSchema for Scalar {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::Schema> {
        use utoipa::openapi::schema::{AnyOfBuilder, ObjectBuilder, Type};
        let of = |kind: Type, what: &str| ObjectBuilder::new().schema_type(kind).description(Some(what));
        AnyOfBuilder::new()
            .description(Some("A value of an attribute: a number, a string (a label, or a category) or a boolean."))
            .item(of(Type::Boolean, "A category's boolean."))
            .item(of(Type::Number, "A number; a category's is whole."))
            .item(of(Type::String, "A label, or a category's string, of at most 1024 bytes."))
            .into()
    }
}

#[cfg(feature = "openapi")]
impl utoipa::ToSchema for Scalar {}

impl Serialize for Scalar {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Boolean(flag) => serializer.serialize_bool(*flag),
            Self::Integer(integer) => serializer.serialize_i64(*integer),
            Self::Number(number) => serializer.serialize_f64(*number),
            Self::Text(text) => serializer.serialize_str(text),
        }
    }
}

impl fmt::Display for Scalar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Boolean(flag) => flag.fmt(f),
            Self::Integer(integer) => integer.fmt(f),
            Self::Number(number) => number.fmt(f),
            Self::Text(text) => text.fmt(f),
        }
    }
}
