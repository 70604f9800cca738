//! Dynamics that list every state and transition.

use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::action::ReadActions;
use super::states::Interner;
use super::{Action, ActionIdx, Graph, Limits, Model, Start, StateIdx, States, Transition};
use crate::attribute::{Attribute, Scalar, Schema};
use crate::document::{Faults, Object, Place};
use crate::interrupt::{Cancelled, Meter};

/// Cost of an action that names none.
pub(super) const DEFAULT_ACTION_COST: f64 = 1.0;

/// A model whose states and transitions are listed. At most one transition leaves a state by an action.
#[derive(Clone, Debug)]
pub struct Table {
    schema: Schema,
    actions: Vec<Action>,
    states: States,
    /// In the order of the document.
    edges: Vec<(StateIdx, Transition)>,
    start: Start,
    /// Ascending, all different.
    unsafe_states: Vec<StateIdx>,
}

impl Table {
    pub(super) fn schema(&self) -> &Schema {
        &self.schema
    }

    pub(super) fn actions(&self) -> &[Action] {
        &self.actions
    }

    /// Leaves out transitions that no mapping can use: those into unsafe states, and those without effect, which
    /// a `skip` does for nothing.
    pub(super) fn compile(&self) -> Model {
        let n_states = self.states.len() as usize;
        let mut is_unsafe = vec![false; n_states];
        for state in &self.unsafe_states {
            is_unsafe[*state as usize] = true;
        }
        let is_useful =
            |(from, transition): &&(StateIdx, Transition)| *from != transition.to && !is_unsafe[transition.to as usize];
        let edges = self.edges.iter().filter(is_useful).copied().collect();
        Model {
            schema: self.schema.clone(),
            actions: self.actions.clone(),
            graph: Graph::new(n_states, edges),
            states: self.states.clone(),
            start: self.start.clone(),
            n_transitions: self.edges.len(),
            n_unsafe: is_unsafe.iter().filter(|is_unsafe| **is_unsafe).count(),
            is_unsafe,
            unexplored: None,
        }
    }

    pub(super) fn document(&self) -> TableDocument {
        let attributes = self.schema.attributes();
        let states = (0..self.states.len()).map(|state| {
            let values = self.states.values(state).zip(attributes);
            values.map(|(value, attribute)| attribute.write_value(value)).collect()
        });
        let transitions = self.edges.iter().map(|(from, transition)| {
            let action = self.actions[usize::from(transition.action)].name.clone();
            TransitionDocument(*from, ActionReference::Name(action.to_string()), transition.to)
        });
        TableDocument {
            states: states.collect(),
            transitions: transitions.collect(),
            start: match &self.start {
                Start::State(state) => Some(StartDocument::State(*state)),
                Start::Candidates(states) => Some(StartDocument::Candidates(states.clone())),
                Start::Any => None,
            },
            unsafe_states: self.unsafe_states.clone(),
        }
    }
}

/// Reads the dynamics. `attributes` and `actions` are `None` where they had faults of their own; what does not
/// depend on them is checked all the same.
pub(super) fn read(
    place: &Place<'_, '_>,
    attributes: Option<Vec<Option<Attribute>>>,
    actions: Option<ReadActions<'_>>,
    limits: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Table>, Cancelled> {
    let Some(object) = place.object(&["kind", "states", "transitions", "start", "unsafe"], faults) else {
        return Ok(None);
    };
    let rows = object.required("states", faults).and_then(|place| place.array(faults).map(|rows| (place, rows)));
    let rows = rows.filter(|(place, rows)| {
        let is_number_right = (1..=limits.max_states).contains(&rows.len());
        if !is_number_right {
            faults.note(place, format!("expected 1 to {} states, found {}", limits.max_states, rows.len()));
        }
        is_number_right
    });
    let states = match rows.zip(attributes.as_ref()) {
        Some(((place, rows), attributes)) => read_states(&place, rows, attributes, meter, faults)?,
        None => None,
    };
    // Where the states are missing, any index may be right.
    let n_states = rows.map_or(StateIdx::MAX as usize, |(_, rows)| rows.len());
    let edges = read_transitions(&object, n_states, actions.as_ref(), meter, faults)?;
    let unsafe_states = match object.optional("unsafe") {
        Some(place) => read_state_list(&place, n_states, faults).map(|mut states| {
            // A set, however it is written.
            states.sort_unstable();
            states.dedup();
            states
        }),
        None => Some(Vec::new()),
    };
    let start = read_start(&object, n_states, unsafe_states.as_deref().unwrap_or_default(), faults);
    let table = || {
        Some(Table {
            schema: Schema::new(attributes?.into_iter().collect::<Option<_>>()?),
            actions: actions?.complete()?,
            states: states?,
            edges: edges?,
            start: start?,
            unsafe_states: unsafe_states?,
        })
    };
    Ok(table())
}

fn read_states(
    place: &Place<'_, '_>,
    rows: &[serde_json::Value],
    attributes: &[Option<Attribute>],
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<States>, Cancelled> {
    let n_before = faults.count();
    let mut interner = Interner::new(attributes.len());
    let mut state = Vec::with_capacity(attributes.len());
    for (n, row) in rows.iter().enumerate() {
        meter.spend_or_cancel(attributes.len() as u64)?;
        let place = place.item(n, row);
        let Some(values) = place.array(faults) else { continue };
        if values.len() != attributes.len() {
            let detail = format!("expected {} values, one per attribute, found {}", attributes.len(), values.len());
            faults.note(&place, detail);
            continue;
        }
        state.clear();
        for (k, (value, attribute)) in values.iter().zip(attributes).enumerate() {
            let Some(attribute) = attribute else { continue };
            state.extend(attribute.read_value(&place.item(k, value), faults));
        }
        if state.len() == attributes.len() {
            interner.push(state.drain(..));
        }
    }
    Ok((faults.count() == n_before).then(|| interner.finish()))
}

fn read_transitions(
    object: &Object<'_, '_>,
    n_states: usize,
    actions: Option<&ReadActions<'_>>,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Vec<(StateIdx, Transition)>>, Cancelled> {
    let place = object.required("transitions", faults);
    let Some((place, items)) = place.and_then(|place| place.array(faults).map(|items| (place, items))) else {
        return Ok(None);
    };
    let mut edges = Vec::with_capacity(items.len());
    let mut seen: FxHashMap<(StateIdx, ActionIdx), usize> = FxHashMap::default();
    for (n, item) in items.iter().enumerate() {
        meter.spend_or_cancel(1)?;
        let place = place.item(n, item);
        let Some(parts) = place.array(faults) else { continue };
        let [from, action, to] = parts else {
            faults.note(&place, format!("expected [from, action, to], found an array of {}", parts.len()));
            continue;
        };
        let from = place.item(0, from).index(n_states, "state", faults);
        let action = actions.and_then(|actions| actions.read_reference(&place.item(1, action), faults));
        let to = place.item(2, to).index(n_states, "state", faults);
        let (Some(from), Some(action), Some(to)) = (from, action, to) else { continue };
        if let Some(other) = seen.insert((from, action), n) {
            let detail = format!("state {from} has a transition by this action already: transition {other}");
            faults.note(&place, detail);
        }
        edges.push((from, Transition { action, to }));
    }
    Ok((edges.len() == items.len()).then_some(edges))
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

/// Listed states and transitions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TableDocument {
    /// Each state's attribute values, in attribute order.
    #[schema(example = json!([[0, "east", "open"], [1, "east", "open"]]))]
    pub states: Vec<Vec<Scalar>>,
    /// `[from, action, to]`: states by index, the action by name or index. At most one per state and action.
    pub transitions: Vec<TransitionDocument>,
    /// Where the imitator starts: a state's index, or a list of candidates, of which the one closest to the first
    /// observation is taken. Left out: every safe state is a candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartDocument>,
    /// States that must never be entered, in any order.
    #[serde(default, rename = "unsafe")]
    pub unsafe_states: Vec<StateIdx>,
}

/// `[from, action, to]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = TransitionEntry, example = json!([0, "forward", 1]))]
pub struct TransitionDocument(pub StateIdx, pub ActionReference, pub StateIdx);

/// An action, by name or index.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
pub enum ActionReference {
    /// Its name.
    Name(String),
    /// Its index in the model's `actions`.
    Index(ActionIdx),
}

/// Where the imitator may start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
#[schema(as = StartStates)]
pub enum StartDocument {
    /// In this state.
    State(StateIdx),
    /// In the one of these that is closest to the first observation.
    Candidates(Vec<StateIdx>),
}
