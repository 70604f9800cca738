//! `--column`: attributes under another name, and in other units.

use std::fmt;
use std::str::FromStr;

use serde_json::{Map as Members, Number, Value};

/// Where the values of an attribute stand: in a column, or a member, of another name, and perhaps to be scaled.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::cli) struct Column {
    pub(super) attribute: String,
    /// All that was said of where the values stand. If a column is called so, it is meant as it is.
    pub(super) whole: String,
    pub(super) name: String,
    pub(super) factor: f64,
    pub(super) offset: f64,
}

impl FromStr for Column {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('=').filter(|(attribute, whole)| !attribute.is_empty() && !whole.is_empty());
        let (attribute, whole) = parts.ok_or("expected ATTRIBUTE=COLUMN, such as x=lon or x=lon*1000-5")?;
        let (name, factor, offset) = if let Some((name, factor)) = scaled(whole) {
            (name, factor, 0.0)
        } else {
            let signs = whole.char_indices().skip(1).filter(|(_, sign)| matches!(sign, '+' | '-'));
            let mut parts = signs.map(|(at, _)| whole.split_at(at));
            let shifted = parts.find_map(|(name, offset)| Some((name, number(offset)?)));
            let (name, offset) = shifted.unwrap_or((whole, 0.0));
            let (name, factor) = scaled(name).unwrap_or((name, 1.0));
            (name, factor, offset)
        };
        let [attribute, whole, name] = [attribute, whole, name].map(|part| part.trim().to_owned());
        Ok(Self { attribute, whole, name, factor, offset })
    }
}

/// The name and the factor of `name*factor`.
fn scaled(text: &str) -> Option<(&str, f64)> {
    let (name, factor) = text.rsplit_once('*')?;
    Some((name, number(factor)?))
}

fn number(text: &str) -> Option<f64> {
    // With no space between a sign and its number, which may be written with one.
    let text: String = text.chars().filter(|c| !c.is_whitespace()).collect();
    text.strip_prefix('+').unwrap_or(&text).parse().ok().filter(|number: &f64| number.is_finite())
}

impl fmt::Display for Column {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.attribute, self.whole)
    }
}

impl Column {
    pub(super) fn is_scaled(&self) -> bool {
        (self.factor, self.offset) != (1.0, 0.0)
    }

    /// A number in the attribute's units. What is none, or too large then, is left as it is, to be refused by who reads it.
    pub(super) fn scale(&self, value: Value) -> Value {
        let scaled = value.as_f64().filter(|_| self.is_scaled()).map(|number| number * self.factor + self.offset);
        scaled.and_then(Number::from_f64).map_or(value, Value::Number)
    }

    /// The value of the attribute among the members of an observation.
    fn value(&self, members: &Members<String, Value>) -> Option<Value> {
        match members.get(&self.whole) {
            Some(value) => Some(value.clone()),
            None => members.get(&self.name).map(|value| self.scale(value.clone())),
        }
    }
}

/// Gives members of an observation the names and units of attributes.
pub(super) fn rename(columns: &[Column], members: &mut Members<String, Value>) {
    // All are looked up before any is replaced: two may change places.
    let renamed: Vec<_> =
        columns.iter().filter_map(|column| Some((column.attribute.clone(), column.value(members)?))).collect();
    for column in columns {
        members.remove(&column.whole);
        members.remove(&column.name);
    }
    members.extend(renamed);
}
