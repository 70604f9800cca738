//! Models of experience as they are written in JSON.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::attribute::Scalar;

/// States and transitions are those that were experienced: batches of them are sent to the model once it is registered.
///
/// The model is then a table of what was seen: of a state and an action that were seen `n` times, `k` times with the same outcome, that outcome has the
/// probability `k / n`, and costs the mean of what it cost. States are numbered by their first appearance; start states that have not appeared come after them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = ExperienceDynamics))]
pub struct ExperienceDocument {
    /// How often a state and an action must have been seen, with whatever outcome, to be in the model.
    #[serde(default = "once")]
    #[cfg_attr(
        feature = "openapi",
        schema(minimum = 1, maximum = 9_007_199_254_740_992_u64, default = 1, required = false)
    )]
    pub min_count: u64,
    /// By the name of a `number`, or of a `cyclic` with a period, a width above 0: values of states are rounded to the nearest multiple of it, those
    /// of `start` and `unsafe` too.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cfg_attr(feature = "openapi", schema(example = json!({"x": 0.5})))]
    pub bin: BTreeMap<String, f64>,
    /// Where the imitator starts: a state, or several, of which the one is taken that begins the cheapest mapping. Left out: every safe state
    /// that was seen is a candidate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<SeenStatesDocument>,
    /// States that must never be entered.
    #[serde(default, rename = "unsafe", skip_serializing_if = "Vec::is_empty")]
    pub unsafe_states: Vec<SeenStateDocument>,
}

/// A state, or several.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = ExperienceStart))]
pub enum SeenStatesDocument {
    /// One: the value of each attribute, by name.
    One(BTreeMap<String, Scalar>),
    /// At least one.
    Several(Vec<SeenStateDocument>),
}

/// A state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = ExperienceState))]
pub enum SeenStateDocument {
    /// The value of each attribute, by name.
    ByName(BTreeMap<String, Scalar>),
    /// In attribute order.
    InOrder(Vec<Scalar>),
}

fn once() -> u64 {
    1
}
