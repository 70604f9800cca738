//! What a client asks for: a demonstration, and how it is to be followed.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Budget, Demonstration, HeuristicName, Problem, Settings};
use crate::attribute::{Scalar, Weights};
use crate::document::{Faults, Object, Place};
use crate::model::{Model, StateIdx};

/// A request for a policy, checked against its model.
#[derive(Debug)]
pub struct Request<'m> {
    /// What is to be solved.
    pub problem: Problem<'m>,
    /// How.
    pub settings: Settings,
    /// How long it may take, counted from when the request arrived.
    pub deadline: Option<Duration>,
}

impl<'m> Request<'m> {
    /// Longest deadline: a day.
    const MAX_DEADLINE_MS: u64 = 86_400_000;

    /// Every field of a request.
    pub const FIELDS: [&'static str; 9] = [
        "model",
        "demonstration",
        "weights",
        "learner",
        "lookahead",
        "start",
        "heuristic",
        "max_expansions",
        "deadline_ms",
    ];

    /// Reads a request against the model that it names. The names themselves (`model`, `learner`) are the caller's.
    pub fn read(model: &'m Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        Self::read_over(model, object, |_| Some(model.schema().weights()), faults)
    }

    /// Reads a request like [`Self::read`], with weights from `base` where it names none. `base` is called last, so that it
    /// knows whether faults were noted.
    pub fn read_over(
        model: &'m Model,
        object: &Object<'_, '_>,
        base: impl FnOnce(&mut Faults) -> Option<Weights>,
        faults: &mut Faults,
    ) -> Option<Self> {
        let schema = model.schema();
        let demonstration = object.required("demonstration", faults);
        let demonstration = demonstration.and_then(|place| Demonstration::read(schema, &place, faults));
        let named = match object.optional("weights") {
            Some(place) => schema.read_named_weights(&place, faults),
            None => Some(Vec::new()),
        };
        let start = match object.optional("start") {
            Some(place) => model.read_start(&place, faults).map(Some),
            None => Some(None),
        };
        let options = Self::read_options(object, faults);
        let mut weights = base(faults)?;
        for (position, weight) in named? {
            weights.set(position, weight);
        }
        let (settings, deadline) = options?;
        let problem = Problem::new(model, demonstration?, weights, start?);
        Some(Self { problem, settings, deadline })
    }

    /// Reads what does not depend on the model.
    pub fn read_options(object: &Object<'_, '_>, faults: &mut Faults) -> Option<(Settings, Option<Duration>)> {
        let heuristic = match object.optional("heuristic") {
            Some(place) => read_heuristic(&place, faults),
            None => Some(HeuristicName::Default),
        };
        if let Some(place) = object.optional("lookahead") {
            faults.note(&place, "policies are searched over the whole demonstration; leave this out or null");
        }
        let max_expansions = match object.optional("max_expansions") {
            Some(place) => place.integer(0, u64::MAX, faults),
            None => Some(Budget::DEFAULT.max_expansions),
        };
        let deadline = match object.optional("deadline_ms") {
            Some(place) => place.integer(0, Self::MAX_DEADLINE_MS, faults).map(|ms| Some(Duration::from_millis(ms))),
            None => Some(None),
        };
        let budget = Budget { max_expansions: max_expansions?, ..Budget::DEFAULT };
        Some((Settings { heuristic: heuristic?, budget }, deadline?))
    }
}

fn read_heuristic(place: &Place<'_, '_>, faults: &mut Faults) -> Option<HeuristicName> {
    let named = HeuristicName::ALL.into_iter().find(|(name, _)| place.value.as_str() == Some(name));
    match named {
        Some((_, heuristic)) => Some(heuristic),
        None => place.mismatch("one of \"default\", \"paper\", \"none\"", faults),
    }
}

/// A request for a policy, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = PolicyRequest)]
pub struct RequestDocument {
    /// Name of the imitator's model.
    #[schema(example = "figure-4")]
    pub model: String,
    /// The observed states, in order: 1 to 100,000. Attributes may be missing or null: not observed.
    pub demonstration: Vec<ObservationDocument>,
    /// Weights by attribute name, each at least 0; attributes not named keep the model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<BTreeMap<String, f64>>,
    /// Name of a learner whose mean weights are used, for attributes that `weights` does not name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learner: Option<String>,
    /// How many observations past the current one a decision may wait for; `null`: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1)]
    pub lookahead: Option<u32>,
    /// Where the imitator starts; the model's start if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartReference>,
    /// What guides the search.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heuristic: Option<HeuristicName>,
    /// Most nodes to expand; then the best mapping found so far is answered, with `status` `bounded`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_expansions: Option<u64>,
    /// Most milliseconds to search, waiting included; then as above. At most a day.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(maximum = 86_400_000)]
    pub deadline_ms: Option<u64>,
}

/// An observed state: an object by attribute name, or an array of values in attribute order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
#[schema(as = Observation)]
pub enum ObservationDocument {
    /// By attribute name; those left out were not observed.
    ByName(BTreeMap<String, ObservedDocument>),
    /// In attribute order.
    InOrder(Vec<ObservedDocument>),
}

/// An observed value; `null` was not observed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Observed)]
pub struct ObservedDocument(pub Option<Scalar>);

/// A state: its index, or attribute values that exactly one state has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(untagged)]
pub enum StartReference {
    /// The state's index.
    Index(StateIdx),
    /// Values by attribute name.
    Values(BTreeMap<String, Scalar>),
}
