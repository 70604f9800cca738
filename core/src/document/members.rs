//! Objects taken apart into their members, each of which stays text until it is known what to read it as.

use std::borrow::Cow;
use std::fmt;

use serde::de::{Deserializer, Error as _, MapAccess, Visitor};
use serde_json::value::RawValue;
use serde_json::{Map, Value};

use super::parsing::{TWICE, parse};
use super::size::parsed_bytes;

/// The members of an object, as text.
///
/// A request is mostly its demonstration, which is read several times as fast once its model is known. So its members are told apart
/// first, in one pass that copies nothing; then what is short is parsed, and what is long is deserialized into what it is.
#[derive(Debug)]
pub struct Members<'t> {
    names: &'static [&'static str],
    /// By name.
    texts: Vec<Option<&'t str>>,
}

impl<'t> Members<'t> {
    /// The members of the object in `text`, which may have these names, each once. `None` if
    /// the text is something else; [`parse`](super::parse) and [`Place::object`](super::Place::object) tell what is wrong with it.
    #[must_use]
    pub fn split(text: &'t str, names: &'static [&'static str]) -> Option<Self> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let mut deserializer = serde_json::Deserializer::from_str(text);
        let members = deserializer.deserialize_map(Split(names)).ok()?;
        deserializer.end().ok()?;
        Some(members)
    }

    /// Takes the text of the member called `name` out.
    pub fn take(&mut self, name: &str) -> Option<&'t str> {
        let position = self.names.iter().position(|known| *known == name)?;
        self.texts[position].take()
    }

    /// About how much memory the members take once they are parsed, in bytes: up to eighty times as much as their text.
    #[must_use]
    pub fn parsed_bytes(&self) -> usize {
        self.texts.iter().flatten().map(|text| parsed_bytes(text.as_bytes())).sum()
    }

    /// How many bytes the texts of the members are.
    #[must_use]
    pub fn n_bytes(&self) -> usize {
        self.texts.iter().flatten().map(|text| text.len()).sum()
    }

    /// The members as an object. `None` if one of them cannot be held, as [`parse`](super::parse) tells.
    #[must_use]
    pub fn parse(&self) -> Option<Value> {
        let mut object = Map::new();
        for (name, text) in self.names.iter().zip(&self.texts) {
            if let Some(text) = text {
                object.insert((*name).to_owned(), parse(text.as_bytes()).ok()?);
            }
        }
        Some(Value::Object(object))
    }
}

struct Split(&'static [&'static str]);

impl<'de> Visitor<'de> for Split {
    type Value = Members<'de>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<Self::Value, A::Error> {
        let Self(names) = self;
        let mut texts = vec![None; names.len()];
        while let Some(name) = members.next_key::<Cow<'de, str>>()? {
            let position = names.iter().position(|known| *known == name);
            let position = position.ok_or_else(|| A::Error::custom("unknown member"))?;
            if texts[position].replace(members.next_value::<&'de RawValue>()?.get()).is_some() {
                return Err(A::Error::custom(TWICE));
            }
        }
        Ok(Members { names, texts })
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    const NAMES: [&str; 3] = ["model", "demonstration", "start"];

    #[test]
    fn members_are_told_apart_in_whatever_order_and_form_they_stand() {
        for text in [
            r#"{"model":"a","demonstration":[{"model":"b"}],"start":7}"#,
            r#" { "start" : 7 , "demonstration" : [{"model":"b"}] , "m\u006fdel" : "a" } "#,
            "\u{feff}{\"model\":\"a\",\"demonstration\":[{\"model\":\"b\"}],\"start\":7}",
        ] {
            let mut members = Members::split(text, &NAMES).unwrap();
            assert_eq!(members.take("demonstration"), Some(r#"[{"model":"b"}]"#), "{text}");
            assert_eq!(members.take("demonstration"), None);
            assert_eq!(members.parse(), Some(json!({"model": "a", "start": 7})), "{text}");
            assert_eq!(members.n_bytes(), 4);
        }
    }

    #[test]
    fn what_is_no_object_of_these_members_is_left_to_be_explained() {
        let twice = r#"{"model":"b","start":{},"model":"a"}"#;
        for text in ["", "[]", "7", r#"{"model":"a"} x"#, r#"{"model":"a""#, r#"{"hurry":1}"#, r#"{"model":01}"#, twice]
        {
            assert!(Members::split(text, &NAMES).is_none(), "{text}");
        }
        for text in [r#"{"start":1e999}"#, r#"{"start":{"x":1,"x":1}}"#] {
            assert_eq!(Members::split(text, &NAMES).unwrap().parse(), None);
        }
    }
}
