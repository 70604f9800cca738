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
#[cfg_attr(feature = "openapi", schema(as = TableDynamics))]
pub struct TableDocument {
    /// Each state's attribute values, in attribute order.
    #[cfg_attr(feature = "openapi", schema(example = json!([[0, "east", "open"], [1, "east", "open"]])))]
    pub states: Vec<Vec<Scalar>>,
    /// `[from, action, to, probability, cost]`: states by index, the action by name or index; the last two may be left out or `null`: 1,
    /// and what the action costs. Those of the same state, action and state to which they lead add up, and the probabilities of a state and an
    /// action sum to 1. In another order they are other content, though they mean the same.
    pub transitions: Vec<TransitionDocument>,
    /// Where the imitator starts: a state's index, or a list of candidates, of which the one is taken that begins the cheapest
    /// mapping; in another order they are other content, though they mean the same. Left out: every safe state is a candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartDocument>,
    /// States that must never be entered, in any order.
    #[serde(default, rename = "unsafe")]
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<u32>))]
    pub unsafe_states: Vec<StateIdx>,
}

/// `[from, action, to, probability, cost]`, of which the last two may be left out or `null`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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

// Derived, it would be a list of objects.
#[cfg(feature = "openapi")]
impl utoipa::PartialSchema for TransitionDocument {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::Schema> {
        use utoipa::openapi::schema::{AnyOfBuilder, ArrayBuilder, ObjectBuilder, Schema, SchemaType, Type};
        let of = |kind: SchemaType, what: &str| ObjectBuilder::new().schema_type(kind).description(Some(what));
        let index = |what: &str| of(Type::Integer.into(), what).minimum(Some(0)).build();
        let number = |what: &str| of([Type::Number, Type::Null].into_iter().collect(), what);
        let text = of(Type::String.into(), "Its name.").build();
        let action = AnyOfBuilder::new().item(text.clone()).item(index("Its index in `actions`."));
        let probability = number("How probable that is: above 0, at most 1; 1 if left out or `null`.");
        let cost = number("What the body pays for it: 0 to 1e150; what the action costs if left out or `null`.");
        ArrayBuilder::new()
            .description(Some(
                "`[from, action, to, probability, cost]`, of which the last two may be left out or `null`.",
            ))
            .prefix_items([
                Schema::Object(index("The state that it leaves, by index.")),
                Schema::AnyOf(action.description(Some("The action that leads along it.")).build()),
                Schema::Object(index("The state that it leads to, by index.")),
                Schema::Object(probability.exclusive_minimum(Some(0)).maximum(Some(1)).build()),
                Schema::Object(cost.minimum(Some(0)).build()),
            ])
            // There are no others, but generators of clients that know no `prefixItems` look here.
            .items(AnyOfBuilder::new().item(text).item(number("A number.")))
            .min_items(Some(3))
            .max_items(Some(5))
            .examples([serde_json::json!([0, "forward", 1]), serde_json::json!([0, "forward", 1, 0.9, 2.5])])
            .into()
    }
}

#[cfg(feature = "openapi")]
impl utoipa::ToSchema for TransitionDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "TransitionEntry".into()
    }
}

/// An action, by name or index.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
    #[cfg_attr(feature = "openapi", schema(value_type = u32))]
    State(StateIdx),
    /// In the one of these that begins the cheapest mapping.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<u32>))]
    Candidates(Vec<StateIdx>),
}
