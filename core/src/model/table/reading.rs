//! Reading what a table lists.

use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;

use hashbrown::HashTable;

use super::edges::{find_uneven, keys_by_pair};
use super::{DEFAULT_ACTION_COST, Edges, Table, Uneven};
use crate::attribute::{Attribute, MAX_COST, Schema, Value};
use crate::document::{Faults, Object, Path, Place, Range, index_of};
use crate::interrupt::{Interrupted, Meter};
use crate::model::action::ReadActions;
use crate::model::dynamics::{Description, Dynamics};
use crate::model::reading::{Distinct, ItemPaths, NoTransition, Raw, RawIndex, RawStates, RawTerms, RawTransitions};
use crate::model::{ActionIdx, Limits, Start, StateIdx, States};

/// Reads a model with listed states and transitions. If attributes or actions have faults, what does not depend on them is still checked.
pub(in crate::model) fn read(
    description: &mut Description<'_, '_>,
    limits: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let (model, dynamics) = (description.model, description.dynamics);
    let (rows, items) = (description.states.take(), description.transitions.take());
    let attributes = model.required("attributes", faults).and_then(|place| Schema::read(&place, faults));
    let actions = model.required("actions", faults);
    let actions = actions.and_then(|place| ReadActions::read(&place, DEFAULT_ACTION_COST, faults));
    let Some(object) = dynamics.object(&["kind", "states", "transitions", "start", "unsafe"], faults) else {
        return Ok(None);
    };
    let place = object.required("states", faults).and_then(|place| place.array(faults).map(|_| place));
    let rows = place.zip(rows).filter(|(place, rows)| {
        let is_number_right = (1..=limits.max_states).contains(&rows.n_states);
        if !is_number_right {
            faults.note(place, format!("expected 1 to {} states, found {}", limits.max_states, rows.n_states));
        }
        is_number_right
    });
    // If the states are missing, any index may be right.
    let n_states = rows.as_ref().map_or(StateIdx::MAX as usize, |(_, rows)| rows.n_states);
    let states = match rows.zip(attributes.as_ref()) {
        Some(((_, rows), attributes)) => read_states(rows, attributes, meter, faults)?,
        None => None,
    };
    let place = object.required("transitions", faults).and_then(|place| place.array(faults).map(|_| place));
    let items = place.zip(items).filter(|(place, items)| {
        let is_number_right = items.n_transitions <= limits.max_transitions;
        if !is_number_right {
            let detail =
                format!("expected at most {} transitions, found {}", limits.max_transitions, items.n_transitions);
            faults.note(place, detail);
        }
        is_number_right
    });
    let edges = match items {
        Some((_, items)) => read_transitions(items, n_states, actions.as_ref(), meter, faults)?,
        None => None,
    };
    let unsafe_states = match object.optional("unsafe") {
        Some(place) => read_state_list(&place, n_states, faults).map(|mut states| {
            // They are a set, in whatever order they are written.
            states.sort_unstable();
            states.dedup();
            states
        }),
        None => Some(Vec::new()),
    };
    let start = read_start(&object, n_states, unsafe_states.as_deref().unwrap_or_default(), faults);
    let table = || {
        Some(Table {
            schema: Schema::of(attributes?.into_iter().collect::<Option<_>>()?),
            actions: actions?.complete()?,
            states: Arc::new(states?),
            edges: edges?,
            start: start?,
            unsafe_states: unsafe_states?,
        })
    };
    Ok(table().map(|table| Arc::new(table) as Arc<dyn Dynamics>))
}

/// The values of a column that are values of its attribute.
struct Domain {
    /// Distinct values, in the order in which they were first met.
    values: Vec<Value>,
    /// Where each of the column's distinct raw values stands in `values`; [`Self::NONE`] for one that is no value of the attribute.
    positions: Vec<u32>,
}

impl Domain {
    const NONE: u32 = u32::MAX;

    fn read(column: &[Raw], attribute: &Attribute, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        let mut values: Vec<Value> = Vec::with_capacity(column.len());
        // A number may be written in several ways, such as 1 and 1.0.
        let mut known: HashTable<u32> = HashTable::with_capacity(column.len());
        let hasher = RandomState::default();
        let mut positions = Vec::with_capacity(column.len());
        let mut ignored = Faults::default();
        for raw in column {
            meter.spend_or_stop(1)?;
            let value = raw.scalar().and_then(|json| attribute.read_value(&Place::root(&json), &mut ignored));
            let Some(value) = value else {
                positions.push(Self::NONE);
                continue;
            };
            let hash = hasher.hash_one(&value);
            let entry = known.entry(
                hash,
                |position| values[*position as usize] == value,
                |position| hasher.hash_one(&values[*position as usize]),
            );
            let position = match entry {
                hashbrown::hash_table::Entry::Occupied(entry) => *entry.get(),
                hashbrown::hash_table::Entry::Vacant(entry) => {
                    #[expect(clippy::cast_possible_truncation, reason = "at most as many as raw values")]
                    let position = values.len() as u32;
                    entry.insert(position);
                    values.push(value);
                    position
                }
            };
            positions.push(position);
        }
        Ok(Self { values, positions })
    }

    /// Whether no two raw values are the same value.
    fn is_as_found(&self) -> bool {
        self.values.len() == self.positions.len()
    }
}

fn read_states(
    rows: RawStates,
    attributes: &[Option<Attribute>],
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<States>, Interrupted> {
    let RawStates { n_states, columns, mut cells, width, lens, no_rows, item_paths } = rows;
    let width_wanted = attributes.len();
    let is_even = lens.is_none() && width == width_wanted;
    // The raw values of a column are dropped as soon as they are read, unless a fault must be explained.
    let mut columns: Vec<Vec<Raw>> = columns.into_iter().map(Distinct::into_values).collect();
    let mut domains = Vec::with_capacity(width_wanted);
    for (column, attribute) in columns.iter_mut().zip(attributes) {
        let domain = match attribute {
            Some(attribute) => Some(Domain::read(column, attribute, meter)?),
            None => None,
        };
        if is_even && domain.as_ref().is_some_and(|domain| !domain.positions.contains(&Domain::NONE)) {
            *column = Vec::new();
        }
        domains.push(domain);
    }
    let is_faultless =
        domains.iter().all(|domain| domain.as_ref().is_some_and(|domain| !domain.positions.contains(&Domain::NONE)));
    if is_even && is_faultless {
        for (k, domain) in domains.iter().flatten().enumerate() {
            if !domain.is_as_found() {
                meter.spend_or_stop(n_states as u64)?;
                for cell in cells.iter_mut().skip(k).step_by(width) {
                    *cell = domain.positions[*cell as usize];
                }
            }
        }
        cells.shrink_to_fit();
        let domains = domains.into_iter().flatten().map(|domain| domain.values).collect();
        return Ok(Some(States::new(domains, cells)));
    }

    let n_before = faults.count();
    let mut no_rows = no_rows.into_iter();
    let mut next_cell = 0;
    for n in 0..n_states {
        meter.spend_or_stop(1)?;
        let len = lens.as_ref().map_or(width, |lens| lens[n] as usize);
        if len == RawStates::NO_ROW as usize {
            match no_rows.next() {
                Some(found) => item_paths.with_path("states", n, |path| faults.note_mismatch(path, "an array", found)),
                None => faults.count_unlisted(1),
            }
            continue;
        }
        let row = &cells[next_cell..][..len.min(Schema::MAX_ATTRIBUTES)];
        next_cell += row.len();
        if len != width_wanted {
            let detail = format!("expected {width_wanted} values, one per attribute, found {len}");
            item_paths.with_path("states", n, |path| faults.note_at(path, detail));
            continue;
        }
        for (k, cell) in row.iter().enumerate() {
            let (Some(domain), Some(attribute)) = (&domains[k], &attributes[k]) else { continue };
            if domain.positions[*cell as usize] == Domain::NONE {
                let found = &columns[k][*cell as usize];
                item_paths.with_path("states", n, |path| note_no_value(&Path::Item(path, k), found, attribute, faults));
            }
        }
    }
    debug_assert!(faults.count() > n_before || attributes.contains(&None), "there was a reason");
    Ok(None)
}

/// Notes that `found` is no value of `attribute`.
fn note_no_value(path: &Path<'_>, found: &Raw, attribute: &Attribute, faults: &mut Faults) {
    match found.scalar() {
        Some(value) => drop(attribute.read_value(&Place { value: &value, path: *path }, faults)),
        None => faults.note_mismatch(path, &attribute.expected(), found),
    }
}

fn read_transitions(
    items: RawTransitions,
    n_states: usize,
    actions: Option<&ReadActions<'_>>,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Edges>, Interrupted> {
    let RawTransitions { n_transitions, from, mut action, to, probabilities, own_costs, references, .. } = items;
    let RawTransitions { faulty, n_faulty, item_paths, .. } = items;
    let read_reference = |found: &Raw, path: &Path<'_>, faults: &mut Faults| {
        let actions = actions?;
        if let Some(value) = found.scalar() {
            return actions.read_reference(&Place { value: &value, path: *path }, faults);
        }
        faults.note_mismatch(path, &index_of("action"), found);
        None
    };
    let mut ignored = Faults::default();
    let known: Vec<Option<ActionIdx>> =
        references.values().iter().map(|found| read_reference(found, &Path::Root, &mut ignored)).collect();
    let n_before = faults.count();
    // Of any length, so that the chunks are looked at in between.
    let are_states = |states: &[StateIdx]| states.iter().all(|state| (*state as usize) < n_states);
    let is_faultless = n_faulty == 0 && known.iter().all(Option::is_some) && are_states(&from) && are_states(&to);
    if !is_faultless {
        let mut faulty = faulty.into_iter();
        let read_index = |found: RawIndex, path: &Path<'_>, faults: &mut Faults| match found {
            Err(found) => faults.note_mismatch(path, &index_of("state"), found),
            Ok(index) if index as usize >= n_states => faults.note_no_index(path, "state", index, n_states),
            Ok(_) => {}
        };
        let read_parts = |path: &Path<'_>, from: RawIndex, reference: &Raw, to: RawIndex, faults: &mut Faults| {
            read_index(from, &Path::Item(path, 0), faults);
            read_reference(reference, &Path::Item(path, 1), faults);
            read_index(to, &Path::Item(path, 2), faults);
        };
        for n in 0..n_transitions {
            meter.spend_or_stop(1)?;
            if from[n] == RawTransitions::NOWHERE {
                let Some(faulty) = faulty.next() else {
                    faults.count_unlisted(1);
                    continue;
                };
                item_paths.with_path("transitions", n, |path| match faulty {
                    NoTransition::Other(found) => faults.note_mismatch(path, "an array", found),
                    NoTransition::Array(len) => {
                        let parts = "[from, action, to, probability, cost], of which the last two may be left out";
                        faults.note_at(path, format!("expected {parts}, found an array of {len}"));
                    }
                    NoTransition::Parts(from, reference, to, terms) => {
                        read_parts(path, from, &reference, to, faults);
                        note_no_terms(path, &terms, faults);
                    }
                });
                continue;
            }
            let (reference, is_action) = (&references.values()[usize::from(action[n])], known[usize::from(action[n])]);
            if is_action.is_none() || from[n] as usize >= n_states || to[n] as usize >= n_states {
                item_paths
                    .with_path("transitions", n, |path| read_parts(path, Ok(from[n]), reference, Ok(to[n]), faults));
            }
        }
    }
    // The state and the action of each value that is a transition.
    let key = |n: usize| {
        let action = known.get(usize::from(action[n])).copied().flatten()?;
        ((from[n] as usize) < n_states && (to[n] as usize) < n_states && from[n] != RawTransitions::NOWHERE)
            .then_some((from[n], action))
    };
    let keys = keys_by_pair(n_transitions, !probabilities.is_empty(), key, meter)?;
    let mut uneven = keys.as_ref().map(|keys| find_uneven(keys, &probabilities)).unwrap_or_default();
    if !is_faultless {
        // What is missing from a sum may be in a transition that is faulty.
        uneven.retain(|uneven| matches!(uneven, Uneven::Twice { .. }));
    }
    note_uneven(&uneven, &from, &item_paths, faults);
    if !is_faultless || !uneven.is_empty() {
        debug_assert!(faults.count() > n_before || known.contains(&None), "there was a reason");
        return Ok(None);
    }
    for action in &mut action {
        // All actions are known here.
        *action = known[usize::from(*action)].unwrap_or_default();
    }
    let mut edges = Edges { from, action, to, probabilities, own_costs, n_stochastic: 0 };
    if let Some(keys) = keys {
        edges.merge(keys, |action| actions.map_or(0.0, |actions| actions.cost(action)), meter)?;
    }
    Ok(Some(edges))
}

/// Notes what is wrong with the probability and the cost of a transition.
fn note_no_terms(path: &Path<'_>, terms: &RawTerms, faults: &mut Faults) {
    if terms.probability().is_none() {
        faults.note_mismatch(&Path::Item(path, 3), "a number above 0 and at most 1", &terms.probability);
    }
    if terms.own_cost().is_none() {
        faults.note_mismatch(&Path::Item(path, 4), &Range::UpTo(MAX_COST).describe(), &terms.cost);
    }
}

/// Notes where the transitions of a state and an action do not come together. That they are several without probabilities is told once: whoever
/// does not know of probabilities has left them all out.
fn note_uneven(uneven: &[Uneven], from: &[StateIdx], paths: &ItemPaths, faults: &mut Faults) {
    /// How many places are shown.
    const N_SHOWN: usize = 3;
    let state = |number: u32| from[number as usize];
    let twice = || uneven.iter().filter(|uneven| matches!(uneven, Uneven::Twice { .. }));
    for found in twice().take(1).chain(uneven.iter().filter(|uneven| matches!(uneven, Uneven::Sum { .. }))) {
        let (number, detail) = match *found {
            Uneven::Sum { number, sum } => {
                let state = state(number);
                (number, format!("the probabilities of state {state} and this action sum to {sum}, not to 1"))
            }
            Uneven::Twice { number, before } => {
                let state = state(number);
                let first = format!("state {state} has a transition by this action already: transition {before}");
                let shown = twice().take(N_SHOWN).filter_map(|uneven| match uneven {
                    Uneven::Twice { number, .. } => Some(number.to_string()),
                    Uneven::Sum { .. } => None,
                });
                let shown = shown.collect::<Vec<_>>().join(", ");
                let others = match twice().count() {
                    1 => String::new(),
                    n if n <= N_SHOWN => format!("; there are {n} like this: transitions {shown}"),
                    n => format!("; there are {n} like this: transitions {shown}, .."),
                };
                let right =
                    "an action with several outcomes needs their probabilities: [from, action, to, probability]";
                (number, format!("{first}{others}; {right}"))
            }
        };
        paths.with_path("transitions", number as usize, |path| faults.note_at(path, detail));
    }
}

fn read_state_list(place: &Place<'_, '_>, n_states: usize, faults: &mut Faults) -> Option<Vec<StateIdx>> {
    let items = place.array(faults)?;
    let indices = items.iter().enumerate().map(|(n, item)| place.item(n, item).index(n_states, "state", faults));
    let indices: Vec<_> = indices.collect();
    indices.into_iter().collect()
}

fn read_start(
    object: &Object<'_, '_>,
    n_states: usize,
    unsafe_states: &[StateIdx],
    faults: &mut Faults,
) -> Option<Start> {
    let is_unsafe: rustc_hash::FxHashSet<_> = unsafe_states.iter().copied().collect();
    let note_unsafe = |place: &Place<'_, '_>, state: StateIdx, faults: &mut Faults| {
        if is_unsafe.contains(&state) {
            faults.note(place, format!("state {state} is unsafe"));
        }
    };
    match object.optional("start") {
        Some(place) if place.value.is_array() => {
            let candidates = read_state_list(&place, n_states, faults)?;
            if candidates.is_empty() {
                return place.mismatch("at least one candidate", faults);
            }
            for (n, state) in candidates.iter().enumerate() {
                note_unsafe(&place.item(n, &place.value[n]), *state, faults);
            }
            Some(Start::Candidates(candidates))
        }
        Some(place) => {
            let state = place.index(n_states, "state", faults)?;
            note_unsafe(&place, state, faults);
            Some(Start::State(state))
        }
        None => {
            if is_unsafe.len() >= n_states {
                faults.note_at(&object.path, "every state is unsafe: there is nowhere to start");
            }
            Some(Start::Any)
        }
    }
}
