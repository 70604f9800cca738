//! What mappings in the making are tested with.

use std::num::NonZeroU32;
use std::sync::Arc;

use crate::oracle;
use crate::problems::{cave, conditions, mapper, mapper_within, problem, under, walked};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Place};
use etude_core::mapping::{CommittedStep, Conditions, Mapper, OnlineMapping, Options, Request};
use etude_core::model::Limits;
use proptest::prelude::*;
use serde_json::{Value, json};

/// The weights and conditions of a request.
fn weights_and_conditions(mapper: &Mapper, request: &Value) -> (Weights, Conditions) {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let options = Options::read(&object, mapper.model(), &Options::default(), &mut faults);
    let options = faults.check(options).unwrap();
    (options.weights_over(mapper.model().schema().weights()), options.conditions())
}

/// The observations of a request.
pub(crate) fn observations(mapper: &Mapper, request: &Value) -> Vec<Vec<Option<etude_core::attribute::Value>>> {
    let read = |observation: &Value| {
        let place = Place::root(observation);
        mapper.model().schema().read_observation(&place, &mut Faults::default()).unwrap()
    };
    request["demonstration"].as_array().unwrap().iter().map(read).collect()
}

/// A mapping of a request that has not begun. If it `searches`, it looks ahead as it does in large models.
pub(crate) fn begun(mapper: &Arc<Mapper>, request: &Value, lookahead: Option<u32>, searches: bool) -> OnlineMapping {
    let (weights, conditions) = weights_and_conditions(mapper, request);
    match lookahead.and_then(NonZeroU32::new) {
        Some(lookahead) if searches => OnlineMapping::searching(mapper, weights, conditions, lookahead),
        lookahead => OnlineMapping::new(mapper, weights, conditions, lookahead),
    }
}

/// States on a line, and longer demonstrations: often few of the states lose their ways by what is decided.
fn line() -> impl Strategy<Value = (Value, Value)> {
    let states = prop::collection::vec((0..12_u32, 0..3_u32), 5..25);
    let transitions = prop::collection::vec((0..25_usize, 0..3_usize, 0..25_usize), 10..70);
    let seen = prop::collection::vec((0..12_u32, prop::option::weighted(0.7, 0..3_u32)), 5..25);
    let costs = prop_oneof![Just([0.0, 0.5, 2.0]), Just([0.3, 0.7, 1.1])];
    (states, transitions, seen, costs).prop_map(|(states, mut transitions, seen, costs)| {
        for (from, _, to) in &mut transitions {
            (*from, *to) = (*from % states.len(), *to % states.len());
        }
        transitions.sort_unstable();
        transitions.dedup_by_key(|(from, action, _)| (*from, *action));
        let model = json!({
            "attributes": [{"name": "x", "kind": "number"}, {"name": "c", "kind": "category", "weight": 0.3}],
            "actions": costs.iter().enumerate().map(|(n, cost)| json!({"name": format!("a{n}"), "cost": cost})).collect::<Value>(),
            "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0, "unsafe": []},
        });
        (model, json!({"model": "m", "demonstration": seen, "weights": {}}))
    })
}

/// A body and what is asked of it.
#[derive(Clone, Debug)]
pub(crate) struct Case {
    /// With table dynamics.
    pub(crate) model: Value,
    pub(crate) request: Value,
    /// The same cave with the rules of its world, and what is asked of it, if it is to be searched lazily.
    pub(crate) lazy: Option<(Value, Value)>,
}

impl Case {
    pub(crate) fn mapper(&self) -> Arc<Mapper> {
        const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };
        Arc::new(match &self.lazy {
            Some((cave, _)) => mapper_within(LAZY, cave),
            None => mapper(&self.model),
        })
    }

    pub(crate) fn begun(&self, mapper: &Arc<Mapper>, lookahead: Option<u32>, searches: bool) -> OnlineMapping {
        let request = self.lazy.as_ref().map_or(&self.request, |(_, request)| request);
        // No others look ahead without an end.
        let lookahead = lookahead.or(self.lazy.is_some().then_some(3));
        begun(mapper, request, lookahead, searches)
    }

    /// The node that a step ends at, in the table.
    pub(crate) fn node(&self, step: &CommittedStep) -> (usize, usize) {
        let state = if self.lazy.is_some() {
            let values: Value = step.step.state.iter().map(|(_, value)| json!(value)).collect();
            let states = self.model["dynamics"]["states"].as_array().unwrap();
            states.iter().position(|state| *state == values).unwrap()
        } else {
            step.step.state_index as usize
        };
        (step.step.observation as usize, state)
    }
}

/// Small bodies, some of which are searched lazily.
pub(crate) fn case() -> impl Strategy<Value = Case> {
    let listed = prop_oneof![problem(), line()].prop_map(|(model, request)| Case { model, request, lazy: None });
    let lazy = (cave(), conditions()).prop_map(|((cave, walk), conditions)| {
        let model = oracle::wumpus::as_table(&cave);
        let request = json!({"model": "m", "demonstration": walked(&cave, &walk), "weights": {}});
        let request = under(&model, request, &conditions);
        let described = |start: &Value| -> Value {
            let names = model["attributes"].as_array().unwrap().iter().map(|attribute| &attribute["name"]);
            let values = model["dynamics"]["states"][start.as_u64().unwrap() as usize].as_array().unwrap();
            names.zip(values).map(|(name, value)| (name.as_str().unwrap().to_owned(), value.clone())).collect()
        };
        let mut asked = request.clone();
        match &request["start"] {
            Value::Null => {}
            Value::Array(starts) => asked["start"] = starts.iter().map(described).collect(),
            start => asked["start"] = described(start),
        }
        Case { model, request, lazy: Some((cave, asked)) }
    });
    prop_oneof![15 => listed, 1 => lazy]
}
