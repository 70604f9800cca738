//! Rules as they are written in JSON.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::attribute::Scalar;
use crate::model::ActionReference;

/// States that follow from rules. A model of them names its attributes with their `values`, and its actions.
///
/// Expressions are written in the Common Expression Language (CEL). They see the attributes and the constants by name: numbers of which all
/// `values` are whole as `int`, others as `double`, labels and strings of categories as `string`. There are `+ - * / %`, comparisons,
/// `&& || !`, `in`, `[]`, `? :`; `size`, `int`, `double`, `string`, `startsWith`, `endsWith`, `contains`, `math.greatest`, `math.least`,
/// `math.abs`, `math.sign`, `math.floor`, `math.ceil`, `math.round`, `math.trunc`; `all`, `exists`, `exists_one`, `map`, `filter`.
///
/// The states are those that the body reaches from the start. If there are more than the service lists, each search finds those that it comes
/// to. Where an expression gives what its attribute may not have, or fails, that is a fault, in whatever state that is found at
/// registration; in one that only a search finds, the action has no effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = RulesDynamics))]
pub struct RulesDocument {
    /// Names for numbers, strings, booleans, and lists of these, at most 65,536 in all.
    #[serde(default, skip_serializing_if = "serde_json::Map::is_empty")]
    #[cfg_attr(feature = "openapi", schema(value_type = std::collections::HashMap<String, serde_json::Value>, example = json!({"walls": [3, 7]})))]
    pub constants: serde_json::Map<String, serde_json::Value>,
    /// Where the imitator starts: a state, or several, of which the one is taken that begins the cheapest mapping.
    pub start: StatesDocument,
    /// What the actions do: 1 to 10,000. Of the rules of an action the first whose `when` holds applies. An action does nothing where none
    /// applies.
    #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 10000))]
    pub rules: Vec<RuleDocument>,
    /// In which states the body must never be: an expression that gives a `bool`.
    #[serde(default, rename = "unsafe", skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = "x == 5 && door == 'shut'"))]
    pub unsafe_when: Option<String>,
}

/// What an action does in some states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Rule))]
pub struct RuleDocument {
    /// Which action.
    #[cfg_attr(feature = "openapi", schema(value_type = String, example = "forward"))]
    pub action: ActionReference,
    /// In which states: an expression that gives a `bool`. Left out: in all in which no earlier rule of the action applies.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = "fuel > 0 && !(x + 1 in walls)"))]
    pub when: Option<String>,
    /// The attributes that get another value, and expressions that give it, of the state before; others stay as they are. Left out: all stay
    /// as they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = json!({"x": "x + 1", "fuel": "fuel - 1"})))]
    pub then: Option<BTreeMap<String, String>>,
    /// Instead of `then`: what may come of it, at least one. Their probabilities sum to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outcomes: Option<Vec<OutcomeDocument>>,
    /// What the body pays for it, if that is not what the action costs: an expression that gives a number, 0 to 1e150, of the state before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(example = "1.0 + double(x) / 10.0"))]
    pub cost: Option<String>,
}

/// What may come of a rule.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = RuleOutcome))]
pub struct OutcomeDocument {
    /// How probable it is.
    #[cfg_attr(feature = "openapi", schema(exclusive_minimum = 0.0, maximum = 1.0, example = 0.9))]
    pub probability: f64,
    /// As in a rule.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(required = false, example = json!({"door": "'open'"})))]
    pub then: BTreeMap<String, String>,
}

/// A state, or several: the value of each attribute, by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = RulesStart))]
pub enum StatesDocument {
    /// One.
    One(BTreeMap<String, Scalar>),
    /// At least one.
    Several(Vec<BTreeMap<String, Scalar>>),
}
