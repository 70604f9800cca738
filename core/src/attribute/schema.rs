//! The attributes of a model, in order.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Attribute, ByAttribute, Cycle, Kind, Labels, Value, Weights, read_text};
use crate::document::{Faults, Path, Place, Quoted, Range, TWICE, list_known, normal};

/// The attributes of a model, in order. Names are unique.
#[derive(Clone, Debug, PartialEq)]
pub struct Schema {
    attributes: Vec<Attribute>,
    /// Shared copies of the names, for what is written once per step.
    names: Vec<Arc<str>>,
    /// Where each name stands. Hashed with a seed, as clients choose the names.
    positions: HashMap<Arc<str>, usize>,
}

impl Schema {
    /// Most attributes of a model. Distances are summed over all of them at every node of a search.
    pub const MAX_ATTRIBUTES: usize = 256;

    /// A schema of `attributes`, whose names the caller knows to differ.
    pub(crate) fn of(attributes: Vec<Attribute>) -> Self {
        let names: Vec<Arc<str>> = attributes.iter().map(|attribute| attribute.name.as_str().into()).collect();
        let positions = names.iter().cloned().zip(0..).collect();
        Self { attributes, names, positions }
    }

    /// The attributes, in order.
    #[must_use]
    pub fn attributes(&self) -> &[Attribute] {
        &self.attributes
    }

    /// How many attributes there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.attributes.len()
    }

    /// Whether there are none. Never the case in a model.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.attributes.is_empty()
    }

    /// The position of the attribute called `name`, however that is [normalized](crate::document::normal).
    #[must_use]
    pub fn position(&self, name: &str) -> Option<usize> {
        self.positions.get(name).or_else(|| self.positions.get(normal(name).as_ref())).copied()
    }

    /// Names `items`, one per attribute.
    pub fn by_attribute<T>(&self, items: impl IntoIterator<Item = T>) -> ByAttribute<T> {
        self.names.iter().cloned().zip(items).collect()
    }

    /// Names those of `items` that are there, one per attribute.
    pub fn by_some_attributes<T>(&self, items: impl IntoIterator<Item = Option<T>>) -> ByAttribute<T> {
        let named = self.names.iter().cloned().zip(items);
        named.filter_map(|(name, item)| item.map(|item| (name, item))).collect()
    }

    /// The default weights.
    #[must_use]
    pub fn weights(&self) -> Weights {
        Weights::of(self.attributes.iter().map(|attribute| attribute.weight))
    }

    /// Reads weights by attribute name; those not named keep their default.
    pub fn read_weights(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Weights> {
        let mut weights = self.weights();
        for (position, weight) in self.read_named_weights(place, faults)? {
            weights.set(position, weight);
        }
        Some(weights)
    }

    /// Reads weights by attribute name: positions and weights of those that are named.
    pub fn read_named_weights(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<(usize, f64)>> {
        let object = place.open_object(faults)?;
        let mut named: Vec<(usize, f64)> = Vec::new();
        for (name, member) in object.iter() {
            let weight = member.number(Range::NonNegative, faults);
            match (self.position(name), weight) {
                (Some(position), _) if named.iter().any(|(known, _)| *known == position) => faults.note(&member, TWICE),
                (Some(position), Some(weight)) => named.push((position, weight)),
                (None, _) => self.note_unknown(name, &member, faults),
                (Some(_), None) => {}
            }
        }
        Some(named)
    }

    /// Reads an observation: an object by attribute name, or an array in attribute order. Shape
    /// `[n_attributes]`; `None` where an attribute is missing or null.
    pub fn read_observation(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Value>>> {
        use serde_json::Value as Json;
        let mut observation = vec![None; self.len()];
        match place.value {
            Json::Array(items) if items.len() == self.len() => {
                for (position, item) in items.iter().enumerate() {
                    let item = place.item(position, item);
                    if !item.value.is_null() {
                        observation[position] = self.attributes[position].read_value(&item, faults);
                    }
                }
            }
            Json::Array(items) => {
                let detail = format!("expected {} values, one per attribute, found {}", self.len(), items.len());
                faults.note(place, detail);
                return None;
            }
            Json::Object(_) => {
                let mut seen: Vec<usize> = Vec::new();
                for (name, member) in place.open_object(faults)?.iter() {
                    let position = self.position(name);
                    // Names that are written in the same way were told apart already.
                    if !name.is_ascii()
                        && let Some(position) = position
                    {
                        if seen.contains(&position) {
                            faults.note(&member, TWICE);
                        }
                        seen.push(position);
                    }
                    match position {
                        Some(_) if member.value.is_null() => {}
                        Some(position) => {
                            observation[position] = self.attributes[position].read_value(&member, faults);
                        }
                        None => self.note_unknown(name, &member, faults),
                    }
                }
            }
            _ => return place.mismatch("a state: an object by attribute name, or an array of values", faults),
        }
        Some(observation)
    }

    fn note_unknown(&self, name: &str, place: &Place<'_, '_>, faults: &mut Faults) {
        let known = list_known(&self.names);
        faults.note(place, format!("unknown attribute {}; the model has {known}", Quoted(name)));
    }

    /// Reads the attributes of a model: `None` for each that is faulty, so that states can still be checked
    /// against the others.
    pub(crate) fn read(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Attribute>>> {
        let items = place.array(faults)?;
        if items.is_empty() || items.len() > Self::MAX_ATTRIBUTES {
            let detail = format!("expected 1 to {} attributes, found {}", Self::MAX_ATTRIBUTES, items.len());
            faults.note(place, detail);
            return None;
        }
        let mut names = HashSet::with_capacity(items.len());
        let attributes = items.iter().enumerate().map(|(n, item)| {
            let item = place.item(n, item);
            let attribute = read_attribute(&item, faults);
            if let Some(name) = item.value.get("name").and_then(serde_json::Value::as_str)
                && !names.insert(normal(name))
            {
                let detail = format!("another attribute is called {} already", Quoted(name));
                faults.note_at(&Path::Member(&item.path, "name"), detail);
            }
            attribute
        });
        Some(attributes.collect())
    }
}

fn read_attribute(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Attribute> {
    let object = place.object(&["name", "kind", "scale", "period", "labels", "weight"], faults)?;
    let name = object.required("name", faults).and_then(|place| read_name(&place, faults));
    let weight = match object.optional("weight") {
        Some(place) => place.number(Range::NonNegative, faults),
        None => Some(1.0),
    };
    let scale = match object.optional("scale") {
        Some(place) => place.number(Range::Positive, faults),
        None => Some(1.0),
    };
    let kind = object.required("kind", faults)?;
    let forbid = |fields: &[&str], faults: &mut Faults| {
        for field in fields {
            if let Some(place) = object.optional(field) {
                faults.note(&place, format!("does not apply to kind {}", kind.value));
            }
        }
    };
    let kind = match kind.value.as_str() {
        Some("number") => {
            forbid(&["period", "labels"], faults);
            Kind::Number { scale: scale? }
        }
        Some("cyclic") => {
            let cycle = match (object.optional("period"), object.optional("labels")) {
                (Some(period), None) => period.number(Range::Positive, faults).map(Cycle::Period),
                (None, Some(labels)) => read_labels(&labels, faults).map(Cycle::Labels),
                (None, None) | (Some(_), Some(_)) => {
                    faults.note(place, "a cyclic attribute needs either `period` or `labels`");
                    None
                }
            };
            Kind::Cyclic { scale: scale?, cycle: cycle? }
        }
        Some("category") => {
            forbid(&["scale", "period", "labels"], faults);
            Kind::Category
        }
        _ => return kind.mismatch("one of \"number\", \"cyclic\", \"category\"", faults),
    };
    Some(Attribute { name: name?, kind, weight: weight? })
}

fn read_name(place: &Place<'_, '_>, faults: &mut Faults) -> Option<String> {
    let name = normal(place.string(faults)?);
    if (1..=Attribute::MAX_NAME_CHARS).contains(&name.chars().count()) {
        Some(name.into_owned())
    } else {
        place.mismatch(&format!("a name of 1 to {} characters", Attribute::MAX_NAME_CHARS), faults)
    }
}

fn read_labels(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Labels> {
    let items = place.array(faults)?;
    if items.is_empty() || items.len() > Labels::MAX_LABELS {
        return place.mismatch(&format!("1 to {} labels", Labels::MAX_LABELS), faults);
    }
    let mut seen = HashSet::with_capacity(items.len());
    let mut labels = Vec::with_capacity(items.len());
    for (n, item) in items.iter().enumerate() {
        let item = place.item(n, item);
        let Some(label) = read_text(&item, faults) else { continue };
        if seen.insert(label.clone()) {
            labels.push(label);
        } else {
            faults.note(&item, format!("the label {} stands twice", Quoted(&label)));
        }
    }
    (labels.len() == items.len()).then(|| Labels::new(labels.into_iter()))
}

/// How the values of an attribute are compared: as numbers, as numbers or labels on a circle, or as equal or not.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum KindName {
    /// `delta = |o - s| / scale`.
    Number,
    /// `delta = min(d mod p, p - d mod p) / scale`, `d = |o - s|`, `p` the period or the number of labels.
    Cyclic,
    /// `delta = 0` if equal, else 1. Strings have at most 1024 bytes.
    Category,
}

/// An attribute, as it is written in JSON.
///
/// The distance between an observation `o` and a state `s` is the sum of `weight * delta^2` over all attributes, where `delta` is
///
/// - of a `number`: `|o - s| / scale`;
/// - of a `cyclic`: `min(d mod p, p - d mod p) / scale`, where `d = |o - s|` and `p` is the `period`, or how many `labels` there are, which
///   count as 0, 1, 2, .. in their order;
/// - of a `category`: 0 if they are equal, else 1.
///
/// What was not observed adds nothing. An example: `x` is a `number` of `scale` 2, `heading` a `cyclic` with the `labels` east, north, west and
/// south, and `door` a `category` of `weight` 5. Between the observation x = 0, east, open and the state x = 3, south, shut, the distance is
/// `1 * (3 / 2)^2 + 1 * 1^2 + 5 * 1^2 = 8.25`: from east to south it is one step around the circle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Attribute))]
pub struct AttributeDocument {
    /// Unique within the model; 1 to 64 characters.
    #[cfg_attr(feature = "openapi", schema(example = "heading"))]
    pub name: String,
    /// How its values are compared.
    pub kind: KindName,
    /// `number` and `cyclic`: what counts as a difference of 1. Above 0; 1 if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0))]
    pub scale: Option<f64>,
    /// `cyclic`: the circumference of the circle that values (numbers) lie on. Above 0. Either this or `labels`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0))]
    pub period: Option<f64>,
    /// `cyclic`: the values, in order around the circle: 1 to 65,536, each of at most 1024 bytes. All different.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<Vec<String>>,
    /// Default weight `w` in the distance, to which the attribute adds `w * delta^2`, at most 1e150. At least 0; 1 if left
    /// out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0.0))]
    pub weight: Option<f64>,
}

impl From<&Attribute> for AttributeDocument {
    fn from(attribute: &Attribute) -> Self {
        let (kind, scale, period, labels) = match &attribute.kind {
            Kind::Number { scale } => (KindName::Number, Some(*scale), None, None),
            Kind::Cyclic { scale, cycle: Cycle::Period(period) } => {
                (KindName::Cyclic, Some(*scale), Some(*period), None)
            }
            Kind::Cyclic { scale, cycle: Cycle::Labels(labels) } => {
                (KindName::Cyclic, Some(*scale), None, Some(labels.names().iter().map(ToString::to_string).collect()))
            }
            Kind::Category => (KindName::Category, None, None, None),
        };
        Self { name: attribute.name.clone(), kind, scale, period, labels, weight: Some(attribute.weight) }
    }
}
