//! Tables as they are written in JSON.

use serde::ser::SerializeSeq;
use serde::{Deserialize, Serialize, Serializer};

use super::Table;
use crate::attribute::Scalar;
use crate::model::{ActionIdx, Start, StateIdx, Transition};

/// Writes the [`TableDocument`] of a table in canonical form, without making one.
impl Serialize for Table {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeStruct;
        let start = match &self.start {
            Start::State(state) => Some(StartDocument::State(*state)),
            Start::Candidates(states) => Some(StartDocument::Candidates(states.clone())),
            Start::Any => None,
        };
        let mut fields = serializer.serialize_struct("Table", 4 + usize::from(start.is_some()))?;
        fields.serialize_field("kind", "table")?;
        fields.serialize_field("states", &WrittenStates(self))?;
        fields.serialize_field("transitions", &WrittenTransitions(self))?;
        if let Some(start) = start {
            fields.serialize_field("start", &start)?;
        }
        fields.serialize_field("unsafe", &self.unsafe_states)?;
        fields.end()
    }
}

struct WrittenStates<'t>(&'t Table);

impl Serialize for WrittenStates<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq((0..self.0.states.len()).map(|state| WrittenState(self.0, state)))
    }
}

struct WrittenState<'t>(&'t Table, StateIdx);

impl Serialize for WrittenState<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(table, state) = self;
        let mut cells = serializer.serialize_seq(Some(table.schema.len()))?;
        for (attribute, value) in table.schema.attributes().iter().zip(table.states.values(*state)) {
            cells.serialize_element(&attribute.written(value))?;
        }
        cells.end()
    }
}

struct WrittenTransitions<'t>(&'t Table);

impl Serialize for WrittenTransitions<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let name = |action: ActionIdx| &*self.0.actions[usize::from(action)].name;
        let edges = self.0.edges.outcomes();
        serializer.collect_seq(edges.map(|(from, (Transition { action, to }, own_cost, probability))| {
            WrittenTransition { parts: (from, name(action), to), probability, own_cost: own_cost.get() }
        }))
    }
}

/// A transition without what says nothing new.
struct WrittenTransition<'t> {
    parts: (StateIdx, &'t str, StateIdx),
    probability: f64,
    own_cost: Option<f64>,
}

impl Serialize for WrittenTransition<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self { parts: (from, action, to), probability, own_cost } = *self;
        match own_cost {
            Some(cost) => (from, action, to, probability, cost).serialize(serializer),
            None if probability < 1.0 => (from, action, to, probability).serialize(serializer),
            None => (from, action, to).serialize(serializer),
        }
    }
}

/// Listed states and transitions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TableDocument {
    /// Each state's attribute values, in attribute order.
    #[cfg_attr(feature = "openapi", schema(example = json!([[0, "east", "open"], [1, "east", "open"]])))]
    pub states: Vec<Vec<Scalar>>,
    /// `[from, action, to, probability, cost]`: states by index, the action by name or index; the last two may be left out or `null`: 1,
    /// and what the action costs. Those of the same state, action and state to which they lead add up, and the probabilities of a state and an
    /// action sum to 1. In another order they are other content, though they mean the same.
    pub transitions: Vec<TransitionDocument>,
    /// Where the imitator starts: a state's index, or a list of candidates, of which the one closest to the first
    /// observation is taken; in another order they are other content, though they mean the same. Left out: every safe state is
    /// a candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartDocument>,
    /// States that must never be entered, in any order.
    #[serde(default, rename = "unsafe")]
    pub unsafe_states: Vec<StateIdx>,
}

/// `[from, action, to, probability, cost]`, of which the last two may be left out or `null`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = TransitionEntry, example = json!([0, "forward", 1])))]
pub struct TransitionDocument(
    /// The state that it leaves.
    pub StateIdx,
    /// The action that leads along it.
    pub ActionReference,
    /// The state that it leads to.
    pub StateIdx,
    /// How probable that is: above 0, at most 1; `None`: 1.
    #[serde(default)]
    pub Option<f64>,
    /// What the body pays for it: 0 to 1e150; `None`: what the action costs.
    #[serde(default)]
    pub Option<f64>,
);

/// An action, by name or index.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
pub enum ActionReference {
    /// Its name.
    Name(String),
    /// Its index in the model's `actions`.
    Index(ActionIdx),
}

/// Where the imitator may start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = StartStates))]
pub enum StartDocument {
    /// In this state.
    State(StateIdx),
    /// In the one of these that is closest to the first observation.
    Candidates(Vec<StateIdx>),
}
