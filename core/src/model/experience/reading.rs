//! Reading the definition of a model of experience.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use super::{Experience, ExperienceDocument, SeenStateDocument, SeenStatesDocument};
use crate::attribute::{Attribute, Cycle, Kind, Scalar, Schema, Value};
use crate::document::{Faults, Object, Path, Place, Quoted, Range, list_known};
use crate::interrupt::{Interrupted, Meter};
use crate::model::Limits;
use crate::model::action::ReadActions;
use crate::model::dynamics::{Description, Dynamics};

/// Cost of an action that names none.
const DEFAULT_ACTION_COST: f64 = 1.0;
/// Most of what can be counted in JSON: 2^53.
const MAX_COUNT: u64 = 1 << 53;
/// Most states that a definition lists, to start in and likewise unsafe ones.
const MAX_LISTED: usize = 10_000;

/// Reads a model whose states and transitions are still to be experienced. If attributes or actions have faults, what does not depend on
/// them is still checked.
#[expect(clippy::unnecessary_wraps, reason = "as `Read` wants it")]
pub(in crate::model) fn read(
    description: &mut Description<'_, '_>,
    _: Limits,
    _: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let (model, dynamics) = (description.model, description.dynamics);
    let n_before = faults.count();
    let attributes = model.required("attributes", faults).and_then(|place| Schema::read(&place, faults));
    let actions = model.required("actions", faults);
    let actions = actions.and_then(|place| ReadActions::read(&place, DEFAULT_ACTION_COST, faults));
    let Some(object) = dynamics.object(&["kind", "min_count", "bin", "start", "unsafe"], faults) else {
        return Ok(None);
    };
    let min_count = match object.optional("min_count") {
        Some(place) => place.integer(1, MAX_COUNT, faults),
        None => Some(1),
    };
    let schema = attributes.and_then(|attributes| attributes.into_iter().collect::<Option<_>>()).map(Schema::of);
    // What else there is follows from the attributes.
    let Some(schema) = schema else { return Ok(None) };
    let bins = read_bins(&object, &schema, faults);
    let unsafe_states = match object.optional("unsafe") {
        Some(place) => read_states(&schema, &place, 0, faults),
        None => Some(Vec::new()),
    };
    let start = match object.optional("start") {
        Some(place) if place.value.is_array() => read_states(&schema, &place, 1, faults),
        Some(place) => read_state(&schema, &place, faults).map(|state| vec![state]),
        None => Some(Vec::new()),
    };
    let experience = || {
        let (min_count, bins) = (min_count?, bins?);
        let (start, unsafe_states) = (start?, unsafe_states?);
        let document = document_of(&schema, min_count, &bins, &start, &unsafe_states);
        let actions = actions?.complete()?;
        let mut experience =
            Experience { schema, actions, min_count, bins, start: Vec::new(), unsafe_states: HashSet::new(), document };
        experience.unsafe_states = unsafe_states.into_iter().map(|state| experience.binned(state)).collect();
        experience.start = start.into_iter().map(|state| experience.binned(state)).collect();
        Some(experience)
    };
    let Some(mut experience) = experience() else { return Ok(None) };
    for (n, state) in experience.start.iter().enumerate() {
        if experience.unsafe_states.contains(state)
            && let Some(place) = object.optional("start")
        {
            let place = if place.value.is_array() { place.item(n, &place.value[n]) } else { place };
            faults.note(&place, "this state is unsafe");
        }
    }
    let mut known = HashSet::new();
    experience.start.retain(|state| known.insert(state.clone()));
    let is_faultless = faults.count() == n_before;
    Ok(is_faultless.then(|| Arc::new(experience) as Arc<dyn Dynamics>))
}

/// The widths to which values are rounded, by attribute.
fn read_bins(object: &Object<'_, '_>, schema: &Schema, faults: &mut Faults) -> Option<Vec<Option<f64>>> {
    let mut bins = vec![None; schema.len()];
    let Some(place) = object.optional("bin") else { return Some(bins) };
    let n_before = faults.count();
    for (name, place) in place.open_object(faults)?.iter() {
        let Some(at) = schema.position(name) else {
            let known = list_known(schema.attributes().iter().map(|attribute| &attribute.name));
            faults.note(&place, format!("unknown attribute {}; the model has {known}", Quoted(name)));
            continue;
        };
        if !has_numbers(&schema.attributes()[at]) {
            faults.note(&place, "this attribute has no numbers, which could be rounded");
        }
        bins[at] = place.number(Range::Positive, faults);
    }
    (faults.count() == n_before).then_some(bins)
}

fn has_numbers(attribute: &Attribute) -> bool {
    matches!(attribute.kind, Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. })
}

/// Reads a list of states, at least so many.
fn read_states(schema: &Schema, place: &Place<'_, '_>, least: usize, faults: &mut Faults) -> Option<Vec<Vec<Value>>> {
    let items = place.array(faults)?;
    if !(least..=MAX_LISTED).contains(&items.len()) {
        return place.mismatch(&format!("{least} to {MAX_LISTED} states"), faults);
    }
    let read = items.iter().enumerate().map(|(n, item)| read_state(schema, &place.item(n, item), faults));
    let states: Vec<_> = read.collect();
    states.into_iter().collect()
}

/// Reads the value of every attribute of a state: an object by attribute name, or an array in attribute order.
pub(super) fn read_state(schema: &Schema, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Value>> {
    let n_before = faults.count();
    let read = schema.read_state(place, faults)?;
    let is_there = |at: usize| match place.value {
        serde_json::Value::Object(members) => {
            members.iter().any(|(name, value)| !value.is_null() && schema.position(name) == Some(at))
        }
        value => !value[at].is_null(),
    };
    for (at, attribute) in schema.attributes().iter().enumerate() {
        if read[at].is_none() && !is_there(at) {
            let path = match place.value {
                serde_json::Value::Array(_) => Path::Item(&place.path, at),
                _ => Path::Member(&place.path, &attribute.name),
            };
            faults.note_at(&path, "is missing: a state has a value of each attribute");
        }
    }
    let values = read.into_iter().collect::<Option<_>>()?;
    (faults.count() == n_before).then_some(values)
}

/// The definition in canonical form. States are written as they were sent, and in their order.
fn document_of(
    schema: &Schema,
    min_count: u64,
    bins: &[Option<f64>],
    start: &[Vec<Value>],
    unsafe_states: &[Vec<Value>],
) -> ExperienceDocument {
    let attributes = schema.attributes();
    let written = |state: &Vec<Value>| -> BTreeMap<String, Scalar> {
        let values = attributes.iter().zip(state);
        values.map(|(attribute, value)| (attribute.name.clone(), attribute.write_value(value))).collect()
    };
    let by_name =
        |states: &[Vec<Value>]| states.iter().map(|state| SeenStateDocument::ByName(written(state))).collect();
    let start = match start {
        [] => None,
        [one] => Some(SeenStatesDocument::One(written(one))),
        several => Some(SeenStatesDocument::Several(by_name(several))),
    };
    let bins = attributes.iter().zip(bins);
    ExperienceDocument {
        min_count,
        bin: bins.filter_map(|(attribute, width)| Some((attribute.name.clone(), (*width)?))).collect(),
        start,
        unsafe_states: by_name(unsafe_states),
    }
}
