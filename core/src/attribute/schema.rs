//! The attributes of a model, in order.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

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
                // As they are written, so that they can be sent back.
                (Some(position), Some(weight)) if self.attributes[position].is_hidden && weight > 0.0 => {
                    faults.note(&member, HIDDEN);
                }
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
        self.read_some_values(place, false, faults)
    }

    /// As [`Self::read_observation`], of a state: hidden attributes may have values as others.
    pub(crate) fn read_state(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Value>>> {
        self.read_some_values(place, true, faults)
    }

    fn read_some_values(
        &self,
        place: &Place<'_, '_>,
        with_hidden: bool,
        faults: &mut Faults,
    ) -> Option<Vec<Option<Value>>> {
        use serde_json::Value as Json;
        let read = |position: usize, place: &Place<'_, '_>, faults: &mut Faults| {
            let attribute: &Attribute = &self.attributes[position];
            if attribute.is_hidden && !with_hidden {
                faults.note(place, HIDDEN);
                return None;
            }
            attribute.read_value(place, faults)
        };
        let mut observation = vec![None; self.len()];
        match place.value {
            Json::Array(items) if items.len() == self.len() => {
                for (position, item) in items.iter().enumerate() {
                    let item = place.item(position, item);
                    if !item.value.is_null() {
                        observation[position] = read(position, &item, faults);
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
                            observation[position] = read(position, &member, faults);
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
        let attributes = Self::read_with_values(place, faults)?;
        for (n, item) in place.value.as_array().into_iter().flatten().enumerate() {
            if let Some(values) = item.get("values").filter(|values| !values.is_null()) {
                let item = place.item(n, item);
                let place = Place { value: values, path: Path::Member(&item.path, "values") };
                faults.note(
                    &place,
                    "the values of an attribute are told where states follow from rules, and nowhere else",
                );
            }
        }
        Some(attributes)
    }

    /// As [`Self::read`]; the member `values` of the attributes is left to the caller.
    pub(crate) fn read_with_values(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<Attribute>>> {
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
    let object = place.object(&["name", "kind", "scale", "period", "labels", "weight", "hidden", "values"], faults)?;
    let name = object.required("name", faults).and_then(|place| read_name(&place, faults));
    let is_hidden = match object.optional("hidden") {
        Some(place) => place.boolean(faults),
        None => Some(false),
    };
    let weight = match object.optional("weight") {
        Some(place) => {
            let weight = place.number(Range::NonNegative, faults);
            if is_hidden == Some(true) && weight.is_some_and(|weight| weight > 0.0) {
                faults.note(&place, HIDDEN);
            }
            weight
        }
        None => Some(if is_hidden == Some(true) { 0.0 } else { 1.0 }),
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
    Some(Attribute { name: name?, kind, weight: weight?, is_hidden: is_hidden? })
}

const HIDDEN: &str = "this attribute is hidden: it is never observed nor compared";

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
