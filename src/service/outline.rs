//! Requests that are read in one pass: their demonstrations, which are most of them, without a document in between.
//!
//! Only what is well-formed can be read like this, for a model that is at hand. The rest is read as a document, which takes several times
//! as long and tells what is wrong.

use std::fmt;
use std::sync::Arc;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::value::RawValue;
use serde_json::{Map, Value};

use super::batch::MAX_BATCH_ITEMS;
use super::policies::max_quick_observations;
use crate::memory::{Held, Memory, UNCOUNTED_BYTES};
use etude_core::document;
use etude_core::mapping::{Demonstration, Mapper, Policy, WellFormed};
use etude_core::model::Model;

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
    /// For the items, if they are much.
    pub(super) held: Option<Held>,
}

impl BatchOutline {
    /// Reads a batch, which names a model that is `at_hand`. Nothing if it is not well-formed, or takes more of `memory` than is free: as
    /// a document, whose items are read one by one, it may take less.
    pub(super) fn read(body: &[u8], at_hand: AtHand<'_>, memory: &Memory) -> Option<Self> {
        let (document, (mapper, items, held)) = read(body, |body| OfBatch { body, at_hand, memory })?;
        Some(Self { document, mapper, items, held })
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

    /// Whether it is part of a text that may have more of other members than [`MAX_OTHERS_BYTES`].
    fn is_long(&self) -> bool;
}

/// Most bytes of other members of an object that is read in one pass. They are counted once they are read, and may take eighty times as
/// much.
const MAX_OTHERS_BYTES: usize = 4096;

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

    fn is_long(&self) -> bool {
        self.body.len() > MAX_OTHERS_BYTES
    }
}

/// The items of a batch, and the model that they were read for.
struct OfBatch<'m> {
    body: &'m str,
    at_hand: AtHand<'m>,
    memory: &'m Memory,
}

impl<'de> About<'de> for OfBatch<'_> {
    const NAME: &'static str = "items";
    type Read = (Arc<Mapper>, Vec<(Value, Demonstration)>, Option<Held>);

    fn read<A: MapAccess<'de>>(&self, before: &Map<String, Value>, members: &mut A) -> Result<Self::Read, A::Error> {
        let Self { body, at_hand, memory } = *self;
        let mapper = model_at_hand(before, body, at_hand)?;
        let mut held = None;
        let most_bytes = most_bytes(mapper.model(), body);
        memory.hold(&mut held, most_bytes).map_err(A::Error::custom)?;
        let is_long = self.is_long();
        let (items, n_bytes) =
            members.next_value_seed(Items { mapper: &mapper, is_long, memory, held: &mut held, most_bytes })?;
        if let Some(held) = &mut held {
            held.shrink_to(n_bytes as u64);
        }
        Ok((mapper, items, held))
    }

    fn is_long(&self) -> bool {
        self.body.len() > MAX_OTHERS_BYTES
    }
}

/// Most bytes that the demonstrations in `body` take while they are read. Each observation begins with a bracket.
fn most_bytes(model: &Model, body: &str) -> usize {
    /// A list that grows is copied to where it has room.
    const COPIES: usize = 2;
    const LEAST_OBSERVATION: usize = "{},".len();
    let bytes_of = |n: usize| COPIES * Demonstration::bytes_of(model.schema(), n.min(Policy::max_observations(model)));
    let most = bytes_of(body.len() / LEAST_OBSERVATION);
    if most as u64 <= UNCOUNTED_BYTES {
        return most;
    }
    bytes_of(body.bytes().filter(|byte| matches!(byte, b'{' | b'[')).count())
}

/// The demonstration of an item, of about `n_values`, and of no more than `max_len` observations.
struct OfItem<'m> {
    mapper: &'m Mapper,
    n_values: usize,
    max_len: usize,
    is_long: bool,
}

impl<'de> About<'de> for OfItem<'_> {
    const NAME: &'static str = "demonstration";
    type Read = Demonstration;

    fn read<A: MapAccess<'de>>(&self, _: &Map<String, Value>, members: &mut A) -> Result<Demonstration, A::Error> {
        let Self { mapper, n_values, max_len, .. } = *self;
        members.next_value_seed(WellFormed { schema: mapper.model().schema(), n_values, max_len })
    }

    fn is_long(&self) -> bool {
        self.is_long
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
        let (is_long, mut n_others_left) = (self.0.is_long(), MAX_OTHERS_BYTES);
        while let Some(name) = members.next_key::<String>()? {
            let value = if name == T::NAME {
                about = Some(self.0.read(&document, &mut members)?);
                Value::Bool(true)
            } else if is_long {
                let text = members.next_value::<&RawValue>()?.get();
                let left = n_others_left.checked_sub(name.len() + text.len());
                n_others_left = left.ok_or_else(|| A::Error::custom("too much besides"))?;
                serde_json::from_str(text).map_err(A::Error::custom)?
            } else {
                members.next_value()?
            };
            document.insert(name, value);
        }
        let about = about.ok_or_else(|| A::Error::missing_field(T::NAME))?;
        Ok((Value::Object(document), about))
    }
}

/// Reads the items of a batch, which must not be too large together. Gives how many bytes they take, too.
struct Items<'m> {
    mapper: &'m Mapper,
    is_long: bool,
    memory: &'m Memory,
    /// For the demonstrations, which take no more than `most_bytes`; and for the documents, as they are read.
    held: &'m mut Option<Held>,
    most_bytes: usize,
}

impl<'de> DeserializeSeed<'de> for Items<'_> {
    type Value = (Vec<(Value, Demonstration)>, usize);

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for Items<'_> {
    type Value = (Vec<(Value, Demonstration)>, usize);

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of items")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut sent: A) -> Result<Self::Value, A::Error> {
        let Self { mapper, is_long, memory, held, most_bytes } = self;
        let model = mapper.model();
        let mut items = Vec::new();
        let (mut documents_bytes, mut demonstrations_bytes) = (0, 0);
        let (mut n_values, mut n_left) = (0, Policy::max_observations(model));
        loop {
            let max_len = n_left.min(Demonstration::MAX_OBSERVATIONS);
            let item = OfItem { mapper, n_values, max_len, is_long };
            let Some(item) = sent.next_element_seed(Members(item))? else {
                return Ok((items, documents_bytes + demonstrations_bytes));
            };
            documents_bytes += document::size_bytes(&item.0) + 2 * size_of_val(&item);
            demonstrations_bytes += item.1.size_bytes();
            memory.hold(held, most_bytes + documents_bytes).map_err(A::Error::custom)?;
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
    use etude_core::interrupt::Uninterrupted;
    use etude_core::model::{Definition, Limits};

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
            BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper)), &Memory::with_room(1 << 30)).is_some()
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
            BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper)), &Memory::with_room(1 << 30)).is_some()
        };
        assert!(is_read(MAX_BATCH_ITEMS) && !is_read(MAX_BATCH_ITEMS + 1));
    }

    /// A model of 256 attributes and one state.
    fn wide() -> Arc<Mapper> {
        let attribute = |n: usize| json!({"name": format!("{n}"), "kind": "number"});
        mapper_of(&json!({
            "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
            "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
        }))
    }

    #[test]
    fn the_items_of_a_batch_hold_their_memory_and_are_not_read_without() {
        let wide = wide();
        let items = vec![format!(r#"{{"demonstration": [{}]}}"#, vec!["{}"; 100].join(",")); 100].join(",");
        let body = format!(r#"{{"model": "wide", "items": [{items}]}}"#);
        let memory = Memory::with_room(1 << 30);
        let read = |memory| BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&wide)), memory);
        let batch = read(&memory).unwrap();
        let taken = (1 << 30) - memory.free();
        // 30 kB of text.
        let values = (100 * 100 * 256 * size_of::<Option<etude_core::attribute::Value>>()) as u64;
        assert!((values..values * 5 / 4).contains(&taken), "{taken} for {values}");
        drop(batch);
        assert_eq!(memory.free(), 1 << 30);
        assert!(read(&Memory::with_room(values)).is_none());
    }

    #[test]
    fn what_items_say_besides_their_demonstrations_is_counted() {
        let mapper = mapper();
        let item = r#"{"demonstration": [{}], "weights": {"a": {"": {"": {"": {"": 0}}}}}}"#;
        let body = format!(r#"{{"model": "a", "items": [{}]}}"#, vec![item; 5000].join(","));
        let memory = Memory::with_room(1 << 30);
        let batch = BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper)), &memory);
        assert!(batch.is_some() && (1 << 30) - memory.free() > 5000 * 6 * 600, "{}", memory.free());
        let large = format!(r#"{{"demonstration": [{{}}], "weights": {{"a": "{}"}}}}"#, "x".repeat(5000));
        let body = format!(r#"{{"model": "a", "items": [{large}]}}"#);
        assert!(BatchOutline::read(body.as_bytes(), &|_| Some(Arc::clone(&mapper)), &memory).is_none());
    }

    #[test]
    fn a_demonstration_that_takes_much_memory_is_not_read_in_passing() {
        let wide = wide();
        let most = max_quick_observations(wide.model()) * Demonstration::bytes_of(wide.model().schema(), 1);
        assert!(most as u64 <= UNCOUNTED_BYTES, "{most}");
    }
}
