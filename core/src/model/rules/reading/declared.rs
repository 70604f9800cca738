//! The attributes of rules, and states of them.

use super::super::domain::MAX_VALUES;
use super::super::{Domain, State};
use crate::attribute::{Attribute, Schema};
use crate::document::{Faults, Path, Place, Quoted, list_known, normal};
use crate::expression::{Datum, Type};

/// Most start states.
const MAX_STARTS: usize = 10_000;

/// The attributes of a document, as far as they could be read.
pub(super) struct ReadAttributes {
    /// By attribute: its name, if that could be read; itself and its values, likewise.
    attributes: Vec<(Option<String>, Option<Declared>)>,
}

pub(super) type Declared = (Attribute, Domain);

impl ReadAttributes {
    /// Reads the attributes, which have `values`.
    pub(super) fn read(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let attributes = Schema::read_with_values(place, faults)?;
        let items = place.value.as_array()?;
        let mut most = MAX_VALUES;
        let read = |((n, item), attribute): ((usize, &serde_json::Value), Option<Attribute>)| {
            let name = item.get("name").and_then(serde_json::Value::as_str).map(|name| normal(name).into_owned());
            let item = place.item(n, item);
            let domain = attribute.as_ref().and_then(|attribute| {
                let object = item.open_object(faults)?;
                Domain::read(attribute, &object, most, faults)
            });
            most -= domain.as_ref().map_or(0, |domain| domain.len() as usize);
            (name, attribute.zip(domain))
        };
        Some(Self { attributes: items.iter().enumerate().zip(attributes).map(read).collect() })
    }

    fn len(&self) -> usize {
        self.attributes.len()
    }

    /// Where the attribute of this name stands.
    pub(super) fn position(&self, name: &str) -> Option<usize> {
        let name = normal(name);
        self.attributes.iter().position(|(known, _)| known.as_deref() == Some(&*name))
    }

    /// The names that could be read.
    pub(super) fn names(&self) -> impl Iterator<Item = &String> {
        self.attributes.iter().filter_map(|(name, _)| name.as_ref())
    }

    /// The attribute at `position` and its values, if these could be read.
    pub(super) fn of(&self, position: usize) -> Option<&(Attribute, Domain)> {
        self.attributes[position].1.as_ref()
    }

    /// Those that could be read, with their values.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Declared> {
        self.attributes.iter().filter_map(|(_, read)| read.as_ref())
    }

    /// What expressions see of them: names and types.
    pub(super) fn variables(&self) -> impl Iterator<Item = (String, Type)> {
        self.attributes.iter().enumerate().map(|(n, (name, read))| {
            // What could not be read was told, and may be anything.
            let kind = read.as_ref().map_or(Type::Any, |(_, domain)| domain.kind().clone());
            (name.clone().unwrap_or_else(|| format!(" {n}")), kind)
        })
    }

    /// Notes that there is no attribute of this name.
    pub(super) fn note_unknown(&self, name: &str, place: &Place<'_, '_>, faults: &mut Faults) {
        let known = list_known(self.names());
        faults.note(place, format!("unknown attribute {}; the model has {known}", Quoted(name)));
    }

    /// The attributes and their values, if none is faulty.
    pub(super) fn complete(self) -> Option<(Schema, Vec<Domain>)> {
        let read: Vec<(Attribute, Domain)> =
            self.attributes.into_iter().map(|(_, read)| read).collect::<Option<_>>()?;
        let (attributes, domains) = read.into_iter().unzip();
        Some((Schema::of(attributes), domains))
    }

    /// Reads a state, or a list of states, all different.
    pub(super) fn read_states(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<State>> {
        let Some(items) = place.value.as_array() else { return Some(vec![self.read_state(place, faults)?]) };
        if items.is_empty() || items.len() > MAX_STARTS {
            return place.mismatch(&format!("1 to {MAX_STARTS} states"), faults);
        }
        let read = |(n, item)| self.read_state(&place.item(n, item), faults);
        let states: Vec<Option<State>> = items.iter().enumerate().map(read).collect();
        let mut distinct: Vec<State> = Vec::new();
        for state in states {
            let state = state?;
            if !distinct.contains(&state) {
                distinct.push(state);
            }
        }
        Some(distinct)
    }

    fn read_state(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<State> {
        if !place.value.is_object() {
            return place.mismatch("a state: an object with the value of each attribute", faults);
        }
        let object = place.open_object(faults)?;
        let mut row = vec![None; self.len()];
        let n_before = faults.count();
        for (name, place) in object.iter() {
            let Some(at) = self.position(name) else {
                self.note_unknown(name, &place, faults);
                continue;
            };
            let Some((attribute, domain)) = self.of(at) else { continue };
            let Some(value) = attribute.read_value(&place, faults) else { continue };
            row[at] = domain.position_of(&value, attribute);
            if row[at].is_none() {
                let shown = attribute.write_value(&value).to_string();
                faults.note(&place, domain.refusal(&Datum::text(&shown), &attribute.name));
            }
        }
        for (n, (name, _)) in self.attributes.iter().enumerate() {
            let Some(name) = name else { continue };
            if row[n].is_none() && !object.members.keys().any(|known| normal(known) == name.as_str()) {
                faults.note_at(&Path::Member(&object.path, name), "is missing");
            }
        }
        if faults.count() > n_before { None } else { row.into_iter().collect() }
    }
}
