//! Requests that are read in one pass: their demonstrations, which are most of them, without a document in between.
//!
//! Only what is well-formed can be read like this, for a model that is at hand. The rest is read as a document, which takes several times
//! as long and tells what is wrong.

use std::fmt;
use std::sync::Arc;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Value};

use super::batch::MAX_BATCH_ITEMS;
use super::policies::max_quick_observations;
use crate::mapping::{Demonstration, Mapper, Policy, WellFormed};

/// Gives the model with a name, if it is at hand.
pub(super) type AtHand<'m> = &'m dyn Fn(&str) -> Option<Arc<Mapper>>;

/// A request for a policy.
pub(super) struct Outline {
    /// With something else in place of the demonstration.
    pub(super) document: Value,
    /// Of the model that it was read for.
    mapper: Arc<Mapper>,
    demonstration: Demonstration,
}

impl Outline {
    /// Reads a request, which names a model that is `at_hand`. Nothing if it is not well-formed.
    pub(super) fn read(body: &[u8], at_hand: AtHand<'_>) -> Option<Self> {
        let (document, (mapper, demonstration)) = read(body, |body| OfRequest { body, at_hand })?;
        Some(Self { document, mapper, demonstration })
    }

    /// The document, and the demonstration for this mapper's model. Nothing if it was read for another one.
    pub(super) fn of(self, mapper: &Arc<Mapper>) -> Option<(Value, Demonstration)> {
        Arc::ptr_eq(&self.mapper, mapper).then_some((self.document, self.demonstration))
    }
}

/// A request for many policies.
pub(super) struct BatchOutline {
    /// With something else in place of the items.
    pub(super) document: Value,
    /// Of the model that they were read for.
    pub(super) mapper: Arc<Mapper>,
    /// Each with its demonstration, and something else in place of that.
    pub(super) items: Vec<(Value, Demonstration)>,
}

impl BatchOutline {
    /// Reads a batch, which names a model that is `at_hand`. Nothing if it is not well-formed.
    pub(super) fn read(body: &[u8], at_hand: AtHand<'_>) -> Option<Self> {
        let (document, (mapper, items)) = read(body, |body| OfBatch { body, at_hand })?;
        Some(Self { document, mapper, items })
    }
}

/// Reads an object: all of it as a document, but for what it is `about`, which has something else in its place.
fn read<'de, T: About<'de>>(body: &'de [u8], about: impl FnOnce(&'de str) -> T) -> Option<(Value, T::Read)> {
    // Once, rather than string by string.
    let body = std::str::from_utf8(body).ok()?;
    let mut deserializer = serde_json::Deserializer::from_str(body);
    let read = Members(about(body)).deserialize(&mut deserializer).ok()?;
    deserializer.end().ok()?;
    Some(read)
}

/// What an object is about: the member that is read in a way of its own.
trait About<'de> {
    const NAME: &'static str;
    type Read;

    /// Reads the value of that member, given those that come before it.
    fn read<A: MapAccess<'de>>(&self, before: &Map<String, Value>, members: &mut A) -> Result<Self::Read, A::Error>;
}

/// The demonstration of a request, and the model that it was read for.
struct OfRequest<'m> {
    body: &'m str,
    at_hand: AtHand<'m>,
}

impl<'de> About<'de> for OfRequest<'_> {
    const NAME: &'static str = "demonstration";
    type Read = (Arc<Mapper>, Demonstration);

    fn read<A: MapAccess<'de>>(&self, before: &Map<String, Value>, members: &mut A) -> Result<Self::Read, A::Error> {
        let mapper = model_at_hand(before, self.body, self.at_hand)?;
        let well_formed = WellFormed::in_text(mapper.model().schema(), self.body.len());
        // More than that are read as a document, whose size is checked first.
        let max_len = max_quick_observations(mapper.model());
        let read = members.next_value_seed(WellFormed { max_len, ..well_formed })?;
        Ok((mapper, read))
    }
}

/// The items of a batch, and the model that they were read for.
struct OfBatch<'m> {
    body: &'m str,
    at_hand: AtHand<'m>,
}

impl<'de> About<'de> for OfBatch<'_> {
    const NAME: &'static str = "items";
    type Read = (Arc<Mapper>, Vec<(Value, Demonstration)>);

    fn read<A: MapAccess<'de>>(&self, before: &Map<String, Value>, members: &mut A) -> Result<Self::Read, A::Error> {
        let mapper = model_at_hand(before, self.body, self.at_hand)?;
        let items = members.next_value_seed(Items { mapper: &mapper })?;
        Ok((mapper, items))
    }
}

/// The demonstration of an item, of about `n_values`, and of no more than `max_len` observations.
struct OfItem<'m> {
    mapper: &'m Mapper,
    n_values: usize,
    max_len: usize,
}

impl<'de> About<'de> for OfItem<'_> {
    const NAME: &'static str = "demonstration";
    type Read = Demonstration;

    fn read<A: MapAccess<'de>>(&self, _: &Map<String, Value>, members: &mut A) -> Result<Demonstration, A::Error> {
        let Self { mapper, n_values, max_len } = *self;
        members.next_value_seed(WellFormed { schema: mapper.model().schema(), n_values, max_len })
    }
}

/// The model that is named among the members `before`, or may be named further on in `body`: who sorts members has it last. Whether it
/// is that one will be seen.
fn model_at_hand<E: serde::de::Error>(
    before: &Map<String, Value>,
    body: &str,
    at_hand: AtHand<'_>,
) -> Result<Arc<Mapper>, E> {
    let name = before.get("model").map_or_else(|| last_model(body), Value::as_str);
    name.and_then(at_hand).ok_or_else(|| E::custom("no model is at hand"))
}

/// What stands in `body` after the last `"model":`, if it is a plain string.
fn last_model(body: &str) -> Option<&str> {
    let (_, after) = body.rsplit_once("\"model\"")?;
    let value = after.trim_start().strip_prefix(':')?.trim_start().strip_prefix('"')?;
    value.split_once('"').map(|(name, _)| name)
}

/// Reads the members of an object.
struct Members<T>(T);

impl<'de, T: About<'de>> DeserializeSeed<'de> for Members<T> {
    type Value = (Value, T::Read);

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de, T: About<'de>> Visitor<'de> for Members<T> {
    type Value = (Value, T::Read);

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Self::Value, A::Error> {
        let (mut document, mut about) = (Map::new(), None);
        while let Some(name) = members.next_key::<String>()? {
            let value = if name == T::NAME {
                about = Some(self.0.read(&document, &mut members)?);
                Value::Bool(true)
            } else {
                members.next_value()?
            };
            document.insert(name, value);
        }
        let about = about.ok_or_else(|| A::Error::missing_field(T::NAME))?;
        Ok((Value::Object(document), about))
    }
}

/// Reads the items of a batch, which must not be too large together.
struct Items<'m> {
    mapper: &'m Mapper,
}

impl<'de> DeserializeSeed<'de> for Items<'_> {
    type Value = Vec<(Value, Demonstration)>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Items<'_> {
    type Value = Vec<(Value, Demonstration)>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of items")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut sent: A) -> Result<Self::Value, A::Error> {
        let model = self.mapper.model();
        let mut items = Vec::new();
        let (mut n_values, mut n_left) = (0, Policy::max_observations(model));
        loop {
            let max_len = n_left.min(Demonstration::MAX_OBSERVATIONS);
            let item = OfItem { mapper: self.mapper, n_values, max_len };
            let Some(item) = sent.next_element_seed(Members(item))? else { return Ok(items) };
            // Most are about as long as the one before.
            n_values = item.1.len() * model.schema().len();
            n_left -= item.1.len();
            items.push(item);
            if items.len() > MAX_BATCH_ITEMS {
                return Err(A::Error::custom("too many items"));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::model::{Definition, Limits, Model};

    fn mapper() -> Arc<Mapper> {
        mapper_of(&serde_json::from_str(include_str!("../../examples/figure-4/model.json")).unwrap())
    }

    fn mapper_of(model: &Value) -> Arc<Mapper> {
        let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap())
    }

    /// Whether this is read for the model `a`; there is another one called `b`.
    fn is_read_for_a(body: &str) -> bool {
        let (a, b) = (mapper(), mapper());
        let at_hand = |name: &str| match name {
            "a" => Some(Arc::clone(&a)),
            "b" => Some(Arc::clone(&b)),
            _ => None,
        };
        let read = Outline::read(body.as_bytes(), &at_hand).and_then(|outline| outline.of(&a));
        read.is_some_and(|(document, demonstration)| document["model"] == "a" && demonstration.len() == 2)
    }

    #[test]
    fn a_request_is_read_for_its_model_wherever_that_is_named() {
        const DEMONSTRATION: &str = r#""demonstration": [{"x": 0, "y": 0}, {"y": 1, "x": 0}]"#;
        for body in [
            format!(r#"{{"model": "a", {DEMONSTRATION}}}"#),
            format!(r#"{{{DEMONSTRATION}, "model" :"a"}}"#),
            format!(r#"{{"learner": "l", {DEMONSTRATION}, "model": "a", "start": 0}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": "a", "learner": "\"model\": \"b\""}}"#),
        ] {
            assert!(is_read_for_a(&body), "{body}");
        }
        for body in [
            format!(r#"{{"model": "b", {DEMONSTRATION}}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": "b"}}"#),
            format!(r#"{{"model": "b", {DEMONSTRATION}, "model": "a"}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": "a", "weights": {{"model": "b"}}}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": "c"}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": 7}}"#),
            format!(r#"{{{DEMONSTRATION}, "model": "\u0061"}}"#),
            format!("{{{DEMONSTRATION}}}"),
            r#"{"model": "a"}"#.to_owned(),
        ] {
            assert!(!is_read_for_a(&body), "{body}");
        }
    }

    #[test]
    fn a_batch_of_more_than_may_be_answered_is_not_read_to_its_end() {
        let attribute = |n: usize| json!({"name": format!("{n:0>64}"), "kind": "number"});
        let mapper = mapper_of(&json!({
            "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
            "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
        }));
        let is_read = |lengths: &[usize]| {
            let items = lengths.iter().map(|len| format!(r#"{{"demonstration": [{}]}}"#, vec!["{}"; *len].join(",")));
            let items = items.collect::<Vec<_>>().join(",");
            let body = format!(r#"{{"model": "wide", "items": [{items}]}}"#);
            BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper))).is_some()
        };
        let most = Policy::max_observations(mapper.model());
        assert!((100..Demonstration::MAX_OBSERVATIONS).contains(&most));
        assert!(is_read(&[most]) && is_read(&[most - 100, 99, 1]));
        assert!(!is_read(&[most + 1]) && !is_read(&[most - 100, 99, 1, 1]) && !is_read(&[1, 0]));
    }

    #[test]
    fn a_demonstration_that_takes_long_to_answer_is_not_read_to_its_end() {
        let mapper = mapper();
        let is_read = |len: usize| {
            let body = format!(r#"{{"demonstration": [{}], "model": "a"}}"#, vec!["{}"; len].join(","));
            Outline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper))).is_some()
        };
        let most = max_quick_observations(mapper.model());
        assert!(most > 100 && is_read(most) && !is_read(most + 1));
    }

    #[test]
    fn a_batch_of_too_many_items_is_not_read_to_its_end() {
        let mapper = mapper();
        let is_read = |n_items: usize| {
            let items = vec![r#"{"demonstration": [{}]}"#; n_items].join(",");
            let body = format!(r#"{{"items": [{items}], "model": "a"}}"#);
            BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper))).is_some()
        };
        assert!(is_read(MAX_BATCH_ITEMS) && !is_read(MAX_BATCH_ITEMS + 1));
    }
}
