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
        serializer.collect_seq(self.0.edges.iter().map(|(from, Transition { action, to })| (from, name(action), to)))
    }
}

/// Listed states and transitions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct TableDocument {
    /// Each state's attribute values, in attribute order.
    #[cfg_attr(feature = "openapi", schema(example = json!([[0, "east", "open"], [1, "east", "open"]])))]
    pub states: Vec<Vec<Scalar>>,
    /// `[from, action, to]`: states by index, the action by name or index. At most one per state and action. In another order
    /// they are other content, though they mean the same.
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

/// `[from, action, to]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = TransitionEntry, example = json!([0, "forward", 1])))]
pub struct TransitionDocument(pub StateIdx, pub ActionReference, pub StateIdx);

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
