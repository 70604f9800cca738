//! Requests that are read in one pass: their demonstrations, which are most of them, without a document in between.
//!
//! Only what is well-formed can be read like this, by a model that is at hand. The rest is read as a document, which takes several times
//! as long and tells what is wrong.

use std::fmt;
use std::sync::Arc;

use serde::de::{DeserializeSeed, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};
use serde_json::value::RawValue;
use serde_json::{Map, Value};

use crate::mapping::{Demonstration, Mapper, WellFormed};

/// Gives the model with a name, if it is at hand.
pub(super) type AtHand<'m> = &'m dyn Fn(&str) -> Option<Arc<Mapper>>;

/// A request for a policy.
pub(super) struct Outline<'b> {
    /// With something else in place of the demonstration.
    pub(super) document: Value,
    demonstration: Sent<'b>,
}

impl<'b> Outline<'b> {
    /// Reads a request, which names one of the models that may be `at_hand`. Nothing if it is not well-formed.
    pub(super) fn read(body: &'b [u8], at_hand: AtHand<'_>) -> Option<Self> {
        let (document, demonstration) = read(body, OfRequest { n_bytes: body.len(), at_hand })?;
        Some(Self { document, demonstration })
    }

    /// The document, and the demonstration for this mapper's model. Nothing if that is not well-formed, or was read for another model.
    pub(super) fn of(self, mapper: &Arc<Mapper>) -> Option<(Value, Demonstration)> {
        let demonstration = match self.demonstration {
            Sent::Read(other, demonstration) => Arc::ptr_eq(mapper, &other).then_some(demonstration),
            Sent::Text(text) => Demonstration::read_well_formed(mapper.model().schema(), text.get()),
        };
        Some((self.document, demonstration?))
    }
}

/// A demonstration, as it came in a body.
enum Sent<'b> {
    /// After the name of a model that was at hand: as one for that.
    Read(Arc<Mapper>, Demonstration),
    /// Before the model was known.
    Text(&'b RawValue),
}

/// A request for many policies.
pub(super) struct BatchOutline {
    /// With something else in place of the items.
    pub(super) document: Value,
    /// Each with its demonstration, and something else in place of that.
    pub(super) items: Vec<(Value, Demonstration)>,
    /// Of the model that they were read for.
    pub(super) mapper: Arc<Mapper>,
}

impl BatchOutline {
    /// Reads a batch, which names a model that is `at_hand`. Nothing if it is not well-formed.
    pub(super) fn read(body: &[u8], at_hand: AtHand<'_>) -> Option<Self> {
        let (document, sent) = read(body, OfBatch { at_hand })?;
        let (mapper, items) = match sent {
            SentItems::Read(mapper, items) => (mapper, items),
            SentItems::Text(text) => {
                let mapper = model_at_hand(document.as_object()?, at_hand)?;
                let mut deserializer = serde_json::Deserializer::from_str(text.get());
                let items = Items { mapper: &mapper }.deserialize(&mut deserializer).ok()?;
                (mapper, items)
            }
        };
        Some(Self { document, items, mapper })
    }
}

/// The items of a batch, as they came in a body.
enum SentItems<'b> {
    /// After the name of a model that was at hand: as those for that.
    Read(Arc<Mapper>, Vec<(Value, Demonstration)>),
    /// Before the model was known.
    Text(&'b RawValue),
}

/// Reads an object: all of it as a document, but for what it is `about`, which has something else in its place.
fn read<'de, T: About<'de>>(body: &'de [u8], about: T) -> Option<(Value, T::Read)> {
    // Once, rather than string by string.
    let body = std::str::from_utf8(body).ok()?;
    let mut deserializer = serde_json::Deserializer::from_str(body);
    let read = Members(about).deserialize(&mut deserializer).ok()?;
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

/// The demonstration of a request of `n_bytes`.
struct OfRequest<'m> {
    n_bytes: usize,
    at_hand: AtHand<'m>,
}

impl<'de> About<'de> for OfRequest<'_> {
    const NAME: &'static str = "demonstration";
    type Read = Sent<'de>;

    fn read<A: MapAccess<'de>>(&self, before: &Map<String, Value>, members: &mut A) -> Result<Sent<'de>, A::Error> {
        let Some(mapper) = model_at_hand(before, self.at_hand) else { return members.next_value().map(Sent::Text) };
        let read = members.next_value_seed(WellFormed::in_text(mapper.model().schema(), self.n_bytes))?;
        Ok(Sent::Read(mapper, read))
    }
}

/// The items of a batch.
struct OfBatch<'m> {
    at_hand: AtHand<'m>,
}

impl<'de> About<'de> for OfBatch<'_> {
    const NAME: &'static str = "items";
    type Read = SentItems<'de>;

    fn read<A: MapAccess<'de>>(
        &self,
        before: &Map<String, Value>,
        members: &mut A,
    ) -> Result<SentItems<'de>, A::Error> {
        let Some(mapper) = model_at_hand(before, self.at_hand) else {
            return members.next_value().map(SentItems::Text);
        };
        let items = members.next_value_seed(Items { mapper: &mapper })?;
        Ok(SentItems::Read(mapper, items))
    }
}

/// The demonstration of an item, of about `n_values`.
struct OfItem<'m> {
    mapper: &'m Mapper,
    n_values: usize,
}

impl<'de> About<'de> for OfItem<'_> {
    const NAME: &'static str = "demonstration";
    type Read = Demonstration;

    fn read<A: MapAccess<'de>>(&self, _: &Map<String, Value>, members: &mut A) -> Result<Demonstration, A::Error> {
        members.next_value_seed(WellFormed { schema: self.mapper.model().schema(), n_values: self.n_values })
    }
}

/// The model that is named among the members, if it is at hand.
fn model_at_hand(members: &Map<String, Value>, at_hand: AtHand<'_>) -> Option<Arc<Mapper>> {
    at_hand(members.get("model")?.as_str()?)
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

/// Reads the items of a batch.
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
        let mut items = Vec::new();
        let mut n_values = 0;
        while let Some(item) = sent.next_element_seed(Members(OfItem { mapper: self.mapper, n_values }))? {
            // Most are about as long as the one before.
            n_values = item.1.len() * self.mapper.model().schema().len();
            items.push(item);
        }
        Ok(items)
    }
}
