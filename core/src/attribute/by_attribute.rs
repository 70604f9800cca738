//! A JSON object with a member for each of some attributes, in schema order.

use std::fmt;
use std::marker::PhantomData;
use std::sync::Arc;

use serde::de::{MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// A `T` for each of some attributes. It is written as a JSON object whose members stand in schema order, so that the
/// same content always gives the same bytes.
#[derive(Clone, Debug, PartialEq)]
pub struct ByAttribute<T>(Vec<(Arc<str>, T)>);

impl<T> ByAttribute<T> {
    /// What belongs to the attribute `name`.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&T> {
        self.0.iter().find(|(attribute, _)| &**attribute == name).map(|(_, item)| item)
    }

    /// Attributes and what belongs to them, in schema order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &T)> {
        self.0.iter().map(|(attribute, item)| (&**attribute, item))
    }
}

impl<T> FromIterator<(Arc<str>, T)> for ByAttribute<T> {
    fn from_iter<I: IntoIterator<Item = (Arc<str>, T)>>(items: I) -> Self {
        Self(items.into_iter().collect())
    }
}

impl<T: Serialize> Serialize for ByAttribute<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (attribute, item) in &self.0 {
            map.serialize_entry(&**attribute, item)?;
        }
        map.end()
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for ByAttribute<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Members<T>(PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Members<T> {
            type Value = ByAttribute<T>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object by attribute name")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
                let mut members = Vec::with_capacity(map.size_hint().unwrap_or(0));
                while let Some((attribute, item)) = map.next_entry::<String, T>()? {
                    members.push((attribute.into(), item));
                }
                Ok(ByAttribute(members))
            }
        }
        deserializer.deserialize_map(Members(PhantomData))
    }
}
