//! Values taken one by one as the parser meets them, whatever they are.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

use super::PathStep;
use super::raw::Raw;

/// Takes one value, whatever it is.
pub(super) trait Take<'de>: Sized {
    type Taken;

    fn scalar(self, found: Raw<&str>) -> Self::Taken;

    fn array<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Taken, A::Error> {
        let mut n_items = 0;
        while items.next_element::<IgnoredAny>()?.is_some() {
            n_items += 1;
        }
        Ok(self.scalar(Raw::Array(n_items)))
    }

    fn object<A: MapAccess<'de>>(self, mut members: A) -> Result<Self::Taken, A::Error> {
        while members.next_entry::<IgnoredAny, IgnoredAny>()?.is_some() {}
        Ok(self.scalar(Raw::Object))
    }
}

/// Takes it as it is deserialized.
pub(super) struct Taking<T>(pub(super) T);

impl<'de, T: Take<'de>> DeserializeSeed<'de> for Taking<T> {
    type Value = T::Taken;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<T::Taken, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de, T: Take<'de>> Visitor<'de> for Taking<T> {
    type Value = T::Taken;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any JSON value")
    }

    fn visit_unit<E>(self) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Null))
    }

    fn visit_bool<E>(self, flag: bool) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Boolean(flag)))
    }

    fn visit_u64<E>(self, number: u64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Whole(number)))
    }

    fn visit_i64<E>(self, number: i64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(u64::try_from(number).map_or(Raw::Negative(number), Raw::Whole)))
    }

    fn visit_f64<E>(self, number: f64) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::float(number)))
    }

    fn visit_str<E>(self, text: &str) -> Result<T::Taken, E> {
        Ok(self.0.scalar(Raw::Text(text)))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<T::Taken, A::Error> {
        self.0.array(items)
    }

    fn visit_map<A: MapAccess<'de>>(self, members: A) -> Result<T::Taken, A::Error> {
        self.0.object(members)
    }
}

/// Adds a step to the path of an error, as it is passed on to the caller.
pub(super) fn traced<T, E>(
    trace: &mut Vec<PathStep>,
    read: Result<T, E>,
    step: impl FnOnce() -> PathStep,
) -> Result<T, E> {
    if read.is_err() {
        trace.push(step());
    }
    read
}
