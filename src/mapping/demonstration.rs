//! What was seen of the demonstrator.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::Value as Json;

use crate::attribute::{Schema, Value};
use crate::document::{Faults, Place};

/// The observed states `o_0 .. o_n` of a demonstration, at least one. Nothing is known of the demonstrator's actions.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstration {
    /// Shape `[n_observations, n_attributes]`, row by row; `None` where an attribute was not observed.
    values: Vec<Option<Value>>,
    n_attributes: usize,
}

impl Demonstration {
    /// Most observations of a demonstration.
    pub const MAX_OBSERVATIONS: usize = 100_000;

    /// Reads a demonstration: an array of 1 to [`Self::MAX_OBSERVATIONS`] observations.
    pub fn read(schema: &Schema, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let items = place.array(faults)?;
        if items.is_empty() || items.len() > Self::MAX_OBSERVATIONS {
            let detail = format!("expected 1 to {} observations, found {}", Self::MAX_OBSERVATIONS, items.len());
            faults.note(place, detail);
            return None;
        }
        let n_before = faults.count();
        let mut values = Vec::with_capacity(items.len() * schema.len());
        for (n, item) in items.iter().enumerate() {
            values.extend(schema.read_observation(&place.item(n, item), faults).unwrap_or_default());
        }
        (faults.count() == n_before).then_some(Self { values, n_attributes: schema.len() })
    }

    /// Reads a demonstration that is well-formed from its JSON text, in a fraction of the time. `None` if anything is wrong with it,
    /// which [`Self::read`] can tell.
    #[must_use]
    pub fn read_well_formed(schema: &Schema, text: &str) -> Option<Self> {
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let values = Observations(schema).deserialize(&mut deserializer).ok()?;
        deserializer.end().ok()?;
        let n_observations = values.len() / schema.len();
        (1..=Self::MAX_OBSERVATIONS).contains(&n_observations).then_some(Self { values, n_attributes: schema.len() })
    }

    /// How many observations there are: n + 1.
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "it is never empty")]
    pub fn len(&self) -> usize {
        self.values.len() / self.n_attributes
    }

    /// A demonstration of these observations, each of shape `[n_attributes]`. `None` if there are none.
    #[must_use]
    pub fn of(observations: impl IntoIterator<Item = Vec<Option<Value>>>) -> Option<Self> {
        let mut observations = observations.into_iter().peekable();
        let n_attributes = observations.peek()?.len();
        Some(Self { values: observations.flatten().collect(), n_attributes })
    }

    /// The observations, in order.
    pub fn iter(&self) -> impl Iterator<Item = &[Option<Value>]> {
        self.values.chunks_exact(self.n_attributes)
    }

    /// The observation at `index`. Shape `[n_attributes]`.
    #[must_use]
    pub fn observation(&self, index: usize) -> &[Option<Value>] {
        &self.values[index * self.n_attributes..(index + 1) * self.n_attributes]
    }
}

/// Reads observations, one after the other.
struct Observations<'s>(&'s Schema);

impl<'de> DeserializeSeed<'de> for Observations<'_> {
    type Value = Vec<Option<Value>>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Observations<'_> {
    type Value = Vec<Option<Value>>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of observations")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
        let mut values = Vec::new();
        while items.next_element_seed(OneObservation { schema: self.0, values: &mut values })?.is_some() {}
        Ok(values)
    }
}

/// Reads an observation, to the end of `values`.
struct OneObservation<'s, 'v> {
    schema: &'s Schema,
    values: &'v mut Vec<Option<Value>>,
}

impl OneObservation<'_, '_> {
    /// The value of the attribute at `position`; nothing if it was not observed.
    fn value<E: serde::de::Error>(&self, position: usize, value: &Json) -> Result<Option<Value>, E> {
        if value.is_null() {
            return Ok(None);
        }
        let read = self.schema.attributes()[position].read_value(&Place::root(value), &mut Faults::default());
        read.map(Some).ok_or_else(|| E::custom("not a value of the attribute"))
    }
}

impl<'de> DeserializeSeed<'de> for OneObservation<'_, '_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for OneObservation<'_, '_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an observation")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        for position in 0..self.schema.len() {
            let value: Json = items.next_element()?.ok_or_else(|| A::Error::custom("too few values"))?;
            let value = self.value(position, &value)?;
            self.values.push(value);
        }
        // One too many is an error of the deserializer.
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        let first = self.values.len();
        self.values.resize(first + self.schema.len(), None);
        // Most name the attributes in their order.
        let mut expected = 0;
        while let Some(position) = members.next_key_seed(Name { schema: self.schema, expected })? {
            let value: Json = members.next_value()?;
            self.values[first + position] = self.value(position, &value)?;
            expected = position + 1;
        }
        Ok(())
    }
}

/// Reads the name of an attribute, which may be that of the `expected` one: its position.
struct Name<'s> {
    schema: &'s Schema,
    expected: usize,
}

impl<'de> DeserializeSeed<'de> for Name<'_> {
    type Value = usize;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<usize, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for Name<'_> {
    type Value = usize;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of an attribute")
    }

    fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<usize, E> {
        let expected = self.schema.attributes().get(self.expected).filter(|attribute| attribute.name == name);
        let position = expected.map(|_| self.expected).or_else(|| self.schema.position(name));
        position.ok_or_else(|| E::custom("not an attribute"))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::attribute::{Attribute, Kind};
    use crate::document;

    fn schema() -> Schema {
        let attribute = |name: &str, kind| Attribute { name: name.to_owned(), kind, weight: 1.0 };
        let number = || Kind::Number { scale: 1.0 };
        Schema::new(vec![attribute("x", number()), attribute("y", number()), attribute("door", Kind::Category)])
    }

    /// An observation, which names no attribute twice; now and then with something wrong.
    fn observation() -> impl Strategy<Value = String> {
        let member = |fine: &'static [&'static str], wrong: &'static [&'static str]| {
            prop_oneof![
                20 => proptest::sample::select(fine).prop_map(Some),
                20 => Just(None),
                1 => proptest::sample::select(wrong).prop_map(Some),
            ]
        };
        let x = member(&[r#""x":1"#, r#""x":null"#, r#""\u0078" : 3"#], &[r#""x":"a""#, r#""z":1"#, r#""x":1e999"#]);
        let y = member(&[r#""y":-0.0"#, r#""y":2.5e-3"#], &[r#""y":[[]]"#, r#""y""#, r#""y":01"#]);
        let door =
            member(&[r#""door":"open""#, r#""door":true"#, r#""door":7"#], &[r#""door":1.5"#, r#""door":"\ud800""#]);
        let members = (x, y, door, any::<bool>()).prop_map(|(x, y, door, is_reversed)| {
            let mut members: Vec<_> = [x, y, door].into_iter().flatten().collect();
            if is_reversed {
                members.reverse();
            }
            format!("{{{}}}", members.join(", "))
        });
        prop_oneof![
            10 => members,
            4 => proptest::sample::select(vec!["[1,2.5,null]", "[null, 18446744073709551615,\"a\"]"]).prop_map(str::to_owned),
            1 => proptest::sample::select(vec!["[1,2]", "[1,2,3,4]", "[1,\"a\",3]", "7", "{},"]).prop_map(str::to_owned),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 5000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn what_is_well_formed_is_read_alike_and_the_rest_is_left_alone(
            observations in proptest::collection::vec(observation(), 0..4),
            after in prop_oneof![30 => Just(""), 1 => Just(" "), 1 => Just("]"), 1 => Just(",1")],
        ) {
            let schema = schema();
            let text = format!("[{}]{after}", observations.join(" ,"));
            let document = document::parse(text.as_bytes());
            let mut faults = Faults::default();
            let read = document.as_ref().ok().and_then(|document| {
                let read = Demonstration::read(&schema, &Place::root(document), &mut faults);
                read.filter(|_| faults.is_empty())
            });
            prop_assert_eq!(Demonstration::read_well_formed(&schema, &text), read, "{}", text);
        }
    }

    #[test]
    fn of_a_member_that_stands_twice_the_last_counts() {
        let text = r#"[{"x":1,"y":2,"x":3,"y":null}]"#;
        let document = document::parse(text.as_bytes()).unwrap();
        let read = Demonstration::read(&schema(), &Place::root(&document), &mut Faults::default());
        assert!(read.is_some());
        assert_eq!(Demonstration::read_well_formed(&schema(), text), read);
    }
}
