//! Deserializing values of attributes from JSON text, without a tree of JSON values.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error, Visitor};

use super::{Attribute, Cycle, Kind, Value};
use crate::document::whole;

/// Reads a value of this attribute, or `null`: not observed. It accepts exactly the values that [`Attribute::read_value`] accepts, which a
/// property test of demonstrations holds; of a hidden attribute, none. Its errors do not explain what is wrong; the faults of `read_value` do.
pub(crate) struct ValueSeed<'a>(pub(crate) &'a Attribute);

impl<'de> DeserializeSeed<'de> for ValueSeed<'_> {
    type Value = Option<Value>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl Visitor<'_> for ValueSeed<'_> {
    type Value = Option<Value>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value of the attribute")
    }

    fn visit_unit<E: Error>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_bool<E: Error>(self, flag: bool) -> Result<Self::Value, E> {
        let read = matches!(self.0.kind, Kind::Category).then_some(Value::Boolean(flag));
        self.checked(read)
    }

    fn visit_i64<E: Error>(self, integer: i64) -> Result<Self::Value, E> {
        let read = match self.0.kind {
            Kind::Category => Some(Value::Integer(integer)),
            _ => exact(integer.into()).and_then(|number| self.number(number)),
        };
        self.checked(read)
    }

    fn visit_u64<E: Error>(self, integer: u64) -> Result<Self::Value, E> {
        let read = match self.0.kind {
            Kind::Category => i64::try_from(integer).ok().map(Value::Integer),
            _ => exact(integer.into()).and_then(|number| self.number(number)),
        };
        self.checked(read)
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<Self::Value, E> {
        let read = match self.0.kind {
            Kind::Category => whole(number).map(Value::Integer),
            _ => self.number(number),
        };
        self.checked(read)
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Self::Value, E> {
        let read = match &self.0.kind {
            Kind::Category => Attribute::text(text).map(|text| Value::Text(text.into())),
            Kind::Cyclic { cycle: Cycle::Labels(labels), .. } => labels.position(text).map(Value::Label),
            Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. } => None,
        };
        self.checked(read)
    }
}

impl ValueSeed<'_> {
    /// A number, if the attribute's values are numbers.
    fn number(&self, number: f64) -> Option<Value> {
        // Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal bits.
        let is_number = matches!(self.0.kind, Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. });
        (is_number && number.is_finite()).then_some(Value::Number(number + 0.0))
    }

    /// The value that was `read`; an error if there is none, or may be none.
    fn checked<E: Error>(&self, read: Option<Value>) -> Result<Option<Value>, E> {
        if read.is_some() && !self.0.is_hidden { Ok(read) } else { Err(E::custom("not a value of the attribute")) }
    }
}

/// The float that is this integer; `None` if there is none.
#[inline]
pub(super) fn exact(integer: i128) -> Option<f64> {
    const ALL_EXACT: std::ops::RangeInclusive<i128> = -(1 << 53)..=1 << 53;
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "whether it is exact is asked")]
    if ALL_EXACT.contains(&integer) {
        Some(integer as i64 as f64)
    } else {
        let number = integer as f64;
        (number as i128 == integer).then_some(number)
    }
}
