//! Demonstrations read from JSON as it comes.

use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};

use super::Demonstration;
use crate::attribute::{Schema, Value, ValueSeed};
use crate::document::TWICE;

/// Reads a demonstration that is well-formed from JSON as it comes, in a fraction of the time that a document takes. An error does not
/// tell what is wrong with it, as [`Demonstration::read`] can.
pub struct WellFormed<'s> {
    /// The attributes that it observes.
    pub schema: &'s Schema,
    /// How many values it has, about: room for so many is made first.
    pub n_values: usize,
    /// Most observations that it may have.
    pub max_len: usize,
}

impl<'s> WellFormed<'s> {
    /// One that takes most of a text of `n_bytes`.
    #[must_use]
    pub fn in_text(schema: &'s Schema, n_bytes: usize) -> Self {
        /// About what a value takes, with the name of its attribute.
        const VALUE_BYTES: usize = 12;
        Self { schema, n_values: n_bytes / VALUE_BYTES, max_len: Demonstration::MAX_OBSERVATIONS }
    }

    /// Reads all of `text`.
    ///
    /// # Errors
    ///
    /// If it is not well-formed.
    pub fn read(self, text: &str) -> Result<Demonstration, serde_json::Error> {
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let read = self.deserialize(&mut deserializer)?;
        deserializer.end()?;
        Ok(read)
    }

    /// Reads all of `text`, in which a number before an observation is its weight. Gives the weights as far as they are told.
    ///
    /// # Errors
    ///
    /// If it is not well-formed.
    pub(super) fn read_weighted(self, text: &str) -> Result<(Demonstration, Vec<Option<f64>>), serde_json::Error> {
        let mut weights = Vec::new();
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let read = deserializer.deserialize_seq(Observations { all: self, weights: Some(&mut weights) })?;
        deserializer.end()?;
        Ok((read, weights))
    }
}

/// Reads observations; numbers before them too, if there is a place for weights.
struct Observations<'s, 'w> {
    all: WellFormed<'s>,
    weights: Option<&'w mut Vec<Option<f64>>>,
}

impl<'de> DeserializeSeed<'de> for WellFormed<'_> {
    type Value = Demonstration;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Demonstration, D::Error> {
        deserializer.deserialize_seq(Observations { all: self, weights: None })
    }
}

impl<'de> Visitor<'de> for Observations<'_, '_> {
    type Value = Demonstration;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of observations")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Demonstration, A::Error> {
        let Self { all: WellFormed { schema, n_values, max_len }, mut weights } = self;
        let mut values = Vec::with_capacity(n_values);
        let mut len = 0;
        // Most observations have their members in the order of the first, and that is mostly the attributes'.
        let mut order: Vec<usize> = (0..schema.len()).collect();
        let mut last_seen = vec![0; schema.len()];
        let mut weight = None;
        loop {
            let number = len + 1;
            let one =
                OneObservation { schema, values: &mut values, order: &mut order, last_seen: &mut last_seen, number };
            let Some(told) = items.next_element_seed(one)? else { break };
            match (told, &mut weights) {
                (Some(_), None) => return Err(A::Error::custom("a number is no observation")),
                (Some(number), Some(_)) => {
                    weight = Some(number);
                    continue;
                }
                (None, Some(weights)) if weight.is_some() => {
                    weights.resize(len, None);
                    weights.push(weight.take());
                }
                (None, _) => {}
            }
            len = number;
            // As they come: what is not observed takes as much room as what is.
            if len > max_len {
                return Err(A::Error::custom("too many observations"));
            }
        }
        if len == 0 {
            return Err(A::Error::custom("no observations"));
        }
        Ok(Demonstration { values, n_attributes: schema.len() })
    }
}

/// Reads an observation, to the end of `values`; or a number, which it gives.
struct OneObservation<'s, 'v> {
    schema: &'s Schema,
    values: &'v mut Vec<Option<Value>>,
    /// The attributes that members were of, by their place, in the observation before.
    order: &'v mut [usize],
    /// By attribute: the number of the last observation that has it.
    last_seen: &'v mut [usize],
    /// That of this one, from 1.
    number: usize,
}

impl<'de> DeserializeSeed<'de> for OneObservation<'_, '_> {
    type Value = Option<f64>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Option<f64>, D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for OneObservation<'_, '_> {
    type Value = Option<f64>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an observation")
    }

    fn visit_f64<E: serde::de::Error>(self, number: f64) -> Result<Option<f64>, E> {
        Ok(Some(number))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Option<f64>, A::Error> {
        for attribute in self.schema.attributes() {
            let value = items.next_element_seed(ValueSeed(attribute))?;
            self.values.push(value.ok_or_else(|| A::Error::custom("too few values"))?);
        }
        // One too many is an error of the deserializer.
        Ok(None)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Option<f64>, A::Error> {
        let first = self.values.len();
        self.values.resize(first + self.schema.len(), None);
        let Self { schema, values, order, last_seen, number } = self;
        let mut places = order.iter_mut();
        loop {
            let mut further = 0;
            let expected = places.next().unwrap_or(&mut further);
            let Some(position) = members.next_key_seed(Name { schema, expected: *expected })? else { return Ok(None) };
            *expected = position;
            if std::mem::replace(&mut last_seen[position], number) == number {
                return Err(A::Error::custom(TWICE));
            }
            values[first + position] = members.next_value_seed(ValueSeed(&schema.attributes()[position]))?;
        }
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
    use crate::attribute::{Attribute, Cycle, Kind, Labels};
    use crate::document::{self, Faults, Place};

    fn schema() -> Schema {
        schema_with_door(false)
    }

    fn schema_with_door(is_hidden: bool) -> Schema {
        let attribute = |name: &str, kind| Attribute { name: name.to_owned(), kind, weight: 1.0, is_hidden: false };
        let cyclic = |cycle| Kind::Cyclic { scale: 1.0, cycle };
        Schema::of(vec![
            attribute("x", Kind::Number { scale: 1.0 }),
            attribute("angle", cyclic(Cycle::Period(360.0))),
            attribute("heading", cyclic(Cycle::Labels(Labels::of(["east", "north", "tr\u{e4}ge"])))),
            Attribute { is_hidden, ..attribute("door", Kind::Category) },
        ])
    }

    fn read_well_formed(schema: &Schema, text: &str) -> Option<Demonstration> {
        WellFormed::in_text(schema, text.len()).read(text).ok()
    }

    /// A value that some attribute may have, and others may not.
    fn value() -> impl Strategy<Value = String> {
        const NUMBERS: &str = "0 -0 -0.0 7 -7 7.0 2.5e-3 1e2 1e-999 4.9e-324 1.7976931348623157e308 0.1 \
            9007199254740993 -9007199254740993 9223372036854775807 9223372036854775808 -9223372036854775808 \
            -9223372036854775809 18446744073709551615 18446744073709551616 123456789012345678901234567890 0.30000000000000004440892098500626";
        const TEXTS: [&str; 8] =
            ["east", "\\u0065ast", "tr\u{e4}ge", "tr\\u00e4ge", "North", "", "\\ud83d\\ude00", "a\\nb"];
        const WRONG: [&str; 8] = ["1e999", "01", "[1]", "{}", "[[]]", "\"\\ud800\"", "tru", "\"\n\""];
        prop_oneof![
            20 => proptest::sample::select(NUMBERS.split(' ').map(str::to_owned).collect::<Vec<_>>()),
            10 => any::<f64>().prop_map(|number| serde_json::Value::from(number).to_string()),
            10 => any::<i64>().prop_map(|number| number.to_string()),
            20 => proptest::sample::select(&TEXTS[..]).prop_map(|text| format!("\"{text}\"")),
            10 => any::<bool>().prop_map(|flag| flag.to_string()),
            10 => Just("null".to_owned()),
            2 => (1023_usize..1027).prop_map(|n| format!("\"{}\"", "x".repeat(n))),
            1 => proptest::sample::select(&WRONG[..]).prop_map(str::to_owned),
        ]
    }

    /// Values that the attributes of [`schema`] may have, in their order.
    fn fitting() -> impl Strategy<Value = Vec<String>> {
        let number =
            || proptest::sample::select(vec!["1", "-0.0", "-0", "2.5", "9007199254740993", "18446744073709551615"]);
        let heading = proptest::sample::select(vec!["\"east\"", "\"\\u006eorth\"", "null"]);
        let door = proptest::sample::select(vec!["\"open\"", "true", "7", "-9223372036854775808", "null"]);
        (number(), number(), heading, door)
            .prop_map(|(x, angle, heading, door)| [x, angle, heading, door].map(str::to_owned).into())
    }

    /// An observation, which names no attribute twice; now and then with something wrong.
    fn observation() -> impl Strategy<Value = String> {
        const NAMES: [&str; 4] = [r#""x":"#, r#""\u0061ngle" : "#, r#""heading": "#, r#""door" :"#];
        let values = || {
            prop_oneof![
                12 => fitting(),
                1 => (fitting(), 0_usize..4, value()).prop_map(|(mut values, at, other)| {
                    values[at] = other;
                    values
                }),
            ]
        };
        let members = (values(), any::<[bool; 4]>(), any::<bool>()).prop_map(|(values, is_there, is_reversed)| {
            let members = NAMES.iter().zip(values).zip(is_there).filter(|(_, is_there)| *is_there);
            let mut members: Vec<_> = members.map(|((name, value), _)| format!("{name}{value}")).collect();
            if is_reversed {
                members.reverse();
            }
            format!("{{{}}}", members.join(", "))
        });
        let wrong =
            ["[1,2]", "[1,2,null,4,5]", "[1,2,3,4]", "7", "{},", r#"{"z":1}"#, r#"{"x"}"#, r#"{"x":1,}"#, "[1,,1]"];
        prop_oneof![
            10 => members,
            10 => values().prop_map(|values| format!("[{}]", values.join(", "))),
            1 => proptest::sample::select(wrong.to_vec()).prop_map(str::to_owned),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 5000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn what_is_well_formed_is_read_alike_and_the_rest_is_left_alone(
            observations in proptest::collection::vec(observation(), 0..4),
            is_door_hidden in any::<bool>(),
            after in prop_oneof![30 => Just(""), 1 => Just(" "), 1 => Just("]"), 1 => Just(",1")],
        ) {
            let schema = schema_with_door(is_door_hidden);
            let text = format!("[{}]{after}", observations.join(" ,"));
            let document = document::parse(text.as_bytes());
            let mut faults = Faults::default();
            let read = document.as_ref().ok().and_then(|document| {
                let read = Demonstration::read(&schema, &Place::root(document), &mut faults);
                read.filter(|_| faults.is_empty())
            });
            let well_formed = read_well_formed(&schema, &text);
            // Written out, 0 and -0 differ.
            prop_assert_eq!(format!("{well_formed:?}"), format!("{read:?}"), "{}", text);
        }

        #[test]
        fn a_value_is_read_alike_whichever_attribute_it_is_of(value in value(), position in 0_usize..4) {
            let mut values = ["null"; 4];
            values[position] = &value;
            let text = format!("[[{}]]", values.join(","));
            let document = document::parse(text.as_bytes());
            let mut faults = Faults::default();
            let read = document.as_ref().ok().and_then(|document| {
                Demonstration::read(&schema(), &Place::root(document), &mut faults)
            });
            let well_formed = read_well_formed(&schema(), &text);
            prop_assert_eq!(format!("{well_formed:?}"), format!("{read:?}"), "{}", text);
        }
    }

    #[test]
    fn an_attribute_that_is_observed_twice_is_no_observation() {
        let well = |text: &str| read_well_formed(&schema(), text);
        assert!(well(r#"[{"x":1,"angle":2},{"angle":2,"x":1},{"x":1,"angle":2}]"#).is_some());
        for text in [
            r#"[{"x":1,"angle":2,"x":3}]"#,
            r#"[{"x":null,"x":3}]"#,
            r#"[{"x":1},{"angle":2,"\u0061ngle":2}]"#,
            r#"[{"x":1,"angle":2},{"x":1,"x":2}]"#,
        ] {
            assert_eq!(well(text), None, "{text}");
            assert!(document::parse(text.as_bytes()).is_err(), "{text}");
        }
    }
}
