//! Problems: the examples, and generated ones.

#![allow(dead_code, clippy::allow_attributes, reason = "each test binary uses its part of this module")]

use std::path::Path;

use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Mapper, Policy, Request, Stamp};
use etude_core::model::{Act, Definition, Limits, Model};
use proptest::prelude::*;
use serde_json::{Value, json};

pub(crate) fn example(path: &str) -> Value {
    serde_json::from_slice(&example_bytes(path)).unwrap()
}

pub(crate) fn example_bytes(path: &str) -> Vec<u8> {
    // Of the repository, whichever of its packages is tested.
    let mut roots = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let path = roots.find_map(|root| Some(root.join("examples").join(path)).filter(|path| path.exists())).unwrap();
    std::fs::read(path).unwrap()
}

pub(crate) fn mapper(model: &Value) -> Mapper {
    mapper_within(Limits::DEFAULT, model)
}

/// A mapper of a model, of which at most as many states may be known as `limits` say.
pub(crate) fn mapper_within(limits: Limits, model: &Value) -> Mapper {
    let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let model = Model::compile(&definition, limits, &mut Uninterrupted).unwrap();
    Mapper::new(model, &mut Uninterrupted).unwrap()
}

pub(crate) fn solve(mapper: &Mapper, request: &Value) -> Policy {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let read = Request::read(mapper.model(), &object, &mut faults);
    let request = faults.check(read).unwrap();
    let mapping = mapper.map(&request.problem, request.settings, &mut Uninterrupted).unwrap();
    Policy::new(&Stamp::default(), &request.problem, &mapping).unwrap()
}

pub(crate) fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * (1.0 + a.abs().max(b.abs()))
}

fn attribute() -> impl Strategy<Value = Value> {
    let weight = prop_oneof![Just(0.0), Just(1.0), 0.0..5.0];
    let scale = prop_oneof![Just(1.0), 0.5..3.0];
    (0..4, weight, scale).prop_map(|(kind, weight, scale)| match kind {
        0 => json!({"kind": "number", "weight": weight, "scale": scale}),
        1 => json!({"kind": "cyclic", "labels": ["a", "b", "c", "d", "e"], "weight": weight, "scale": scale}),
        2 => json!({"kind": "cyclic", "period": 4.5, "weight": weight, "scale": scale}),
        _ => json!({"kind": "category", "weight": weight}),
    })
}

/// A value of an attribute, by a number from 0 to 4.
fn value(attribute: &Value, n: usize) -> Value {
    match (attribute["kind"].as_str().unwrap(), &attribute["labels"]) {
        ("number", _) => json!([0.0, 1.0, 2.5, -1.0, 3.0][n]),
        ("cyclic", Value::Array(labels)) => labels[n].clone(),
        ("cyclic", _) => json!([0.0, 1.5, 4.0, -2.0, 11.25][n]),
        _ => [json!("a"), json!(true), json!(1), json!("b"), json!(false)][n].clone(),
    }
}

/// Where a request may say that the imitator starts, what counts, and what the body lacks; often the defaults. By numbers that are made to
/// fit.
pub(crate) fn conditions() -> impl Strategy<Value = Value> {
    let weight = || prop_oneof![2 => Just(1.0), 1 => Just(0.0), 1 => 0.0..3.0];
    (
        prop::option::weighted(0.3, prop::collection::vec(0usize..100, 1..4)),
        prop::option::weighted(0.4, prop::collection::vec(prop::option::weighted(0.8, weight()), 30)),
        prop::option::weighted(0.5, prop_oneof![Just(0.0), Just(1.0), 0.0..1.0]),
        prop::option::weighted(0.5, prop_oneof![Just(0.0), Just(10.0), 0.0..3.0]),
        prop::option::weighted(0.2, 0usize..100),
        prop::option::weighted(0.2, (0usize..100, 0.0..2.0)),
    )
        .prop_map(|(start, observation_weights, extra_weight, end_weight, without, action_cost)| {
            json!({
                "start": start, "observation_weights": observation_weights, "extra_weight": extra_weight,
                "end_weight": end_weight, "without": without, "action_costs": action_cost,
            })
        })
}

/// The request with these conditions, whose numbers are made to fit.
pub(crate) fn under(model: &Value, mut request: Value, conditions: &Value) -> Value {
    let count = |value: &Value| value.as_array().map_or(0, Vec::len);
    let (n_states, n_observations) = (count(&model["dynamics"]["states"]), count(&request["demonstration"]));
    let unsafe_states = model["dynamics"]["unsafe"].as_array().cloned().unwrap_or_default();
    let name = |n: &Value| {
        let n = n.as_u64().unwrap() as usize % count(&model["actions"]);
        model["actions"][n]["name"].as_str().unwrap().to_owned()
    };
    if let Some(starts) = conditions["start"].as_array() {
        let fitted = starts.iter().map(|start| json!(start.as_u64().unwrap() as usize % n_states));
        let safe: Vec<Value> = fitted.filter(|start| !unsafe_states.contains(start)).collect();
        if !safe.is_empty() {
            request["start"] = if safe.len() == 1 { safe[0].clone() } else { safe.into() };
        }
    }
    if let Some(weights) = conditions["observation_weights"].as_array() {
        request["observation_weights"] = weights[..n_observations].to_vec().into();
    }
    request["extra_weight"] = conditions["extra_weight"].clone();
    request["end_weight"] = conditions["end_weight"].clone();
    if !conditions["without"].is_null() {
        request["without"] = json!([name(&conditions["without"])]);
    }
    if !conditions["action_costs"].is_null() {
        request["action_costs"] = json!({name(&conditions["action_costs"][0]): conditions["action_costs"][1]});
    }
    request
}

/// A model with `table` dynamics, and a request. Some of the transitions have their own costs.
pub(crate) fn problem() -> impl Strategy<Value = (Value, Value)> {
    let own_costs = prop::option::weighted(0.4, prop::collection::vec(prop::option::of(0.0..3.0), 30));
    (plain_problem(), conditions(), own_costs).prop_map(|((mut model, request), conditions, own_costs)| {
        let transitions = model["dynamics"]["transitions"].as_array_mut().unwrap();
        let own_costs = own_costs.unwrap_or_default();
        for (transition, cost) in transitions.iter_mut().zip(own_costs).filter(|(_, cost)| cost.is_some()) {
            *transition = json!([transition[0], transition[1], transition[2], null, cost]);
        }
        let request = under(&model, request, &conditions);
        (model, request)
    })
}

/// The same, with the defaults.
fn plain_problem() -> impl Strategy<Value = (Value, Value)> {
    let attributes = prop::collection::vec(attribute(), 1..4);
    let costs = prop::collection::vec(prop_oneof![Just(0.0), Just(0.3), Just(1.0), 0.0..2.0], 1..4);
    (attributes, costs, 1usize..9).prop_flat_map(|(mut attributes, costs, n_states)| {
        for (k, attribute) in attributes.iter_mut().enumerate() {
            attribute["name"] = json!(format!("k{k}"));
        }
        let n_attributes = attributes.len();
        let states = prop::collection::vec(prop::collection::vec(0usize..5, n_attributes), n_states);
        let targets = prop::collection::vec(prop::option::weighted(0.6, 0..n_states), n_states * costs.len());
        let observations =
            prop::collection::vec(prop::collection::vec(prop::option::weighted(0.8, 0usize..5), n_attributes), 1..8);
        let unsafe_states = prop::collection::vec(prop::bool::weighted(0.1), n_states);
        let starts = (0..3, 0..n_states, prop::option::weighted(0.3, 0..n_states));
        let weights = prop::option::of((0..n_attributes, prop_oneof![Just(0.0), Just(2.0), 0.0..4.0]));
        (Just((attributes, costs)), states, targets, observations, unsafe_states, starts, weights).prop_map(build)
    })
}

#[expect(clippy::type_complexity, reason = "the parts of a generated problem, used once")]
fn build(
    ((attributes, costs), states, targets, observations, unsafe_states, starts, weights): (
        (Vec<Value>, Vec<f64>),
        Vec<Vec<usize>>,
        Vec<Option<usize>>,
        Vec<Vec<Option<usize>>>,
        Vec<bool>,
        (i32, usize, Option<usize>),
        Option<(usize, f64)>,
    ),
) -> (Value, Value) {
    let n_states = states.len();
    let (start_kind, model_start, request_start) = starts;
    // Whatever may be a start is made safe.
    let is_unsafe = |s: usize| unsafe_states[s] && s != model_start && Some(s) != request_start && s != 0;
    let start = match start_kind {
        0 => Value::Null,
        1 => json!(model_start),
        _ => json!([0, model_start]),
    };
    let actions: Vec<Value> =
        costs.iter().enumerate().map(|(a, cost)| json!({"name": format!("a{a}"), "cost": cost})).collect();
    let transitions: Vec<Value> = targets
        .iter()
        .enumerate()
        .filter_map(|(n, to)| to.map(|to| json!([n / costs.len(), format!("a{}", n % costs.len()), to])))
        .collect();
    let states: Vec<Value> = states
        .iter()
        .map(|state| state.iter().zip(&attributes).map(|(n, attribute)| value(attribute, *n)).collect())
        .collect();
    let demonstration: Value = observations
        .iter()
        .enumerate()
        .map(|(i, observation)| {
            let seen = |k: usize| observation[k].map(|n| value(&attributes[k], n));
            if i % 2 == 0 {
                (0..attributes.len()).map(|k| seen(k).unwrap_or(Value::Null)).collect()
            } else {
                let named = (0..attributes.len()).filter_map(|k| seen(k).map(|value| (format!("k{k}"), value)));
                Value::Object(named.collect())
            }
        })
        .collect();
    let weights = weights.map_or(json!({}), |(k, weight)| json!({format!("k{k}"): weight}));
    let unsafe_states: Vec<usize> = (0..n_states).filter(|s| is_unsafe(*s)).collect();
    let model = json!({
        "attributes": attributes,
        "actions": actions,
        "dynamics":
            {"kind": "table", "states": states, "transitions": transitions, "start": start, "unsafe": unsafe_states},
    });
    let request = json!({"model": "m", "demonstration": demonstration, "weights": weights, "start": request_start});
    (model, request)
}

/// A cave with up to three wumpi, pits and pieces of gold, a body, and a walk of a full body in the same cave.
pub(crate) fn cave() -> impl Strategy<Value = (Value, Vec<usize>)> {
    let cells = |most| prop::collection::vec((0u16..4, 0u16..3), 0..=most);
    let body = prop::sample::subsequence(Act::ALL.to_vec(), 1..=6);
    let walk = prop::collection::vec(0usize..6, 0..12);
    let start = (0u16..4, 0u16..3, 0usize..4);
    (cells(2), cells(3), cells(3), body, walk, start, 0u8..3).prop_map(
        |(pits, wumpi, gold, body, walk, start, arrows)| {
            let (x, y, heading) = start;
            let away = |cells: Vec<(u16, u16)>| cells.into_iter().filter(|cell| *cell != (x, y)).collect::<Vec<_>>();
            let actions: Vec<Value> = body.iter().map(|act| json!({"name": act.name(), "cost": 0.3})).collect();
            let heading = ["east", "north", "west", "south"][heading];
            let model = json!({
                "actions": actions,
                "dynamics": {
                    "kind": "wumpus", "width": 4, "height": 3, "pits": away(pits), "wumpi": away(wumpi), "gold": gold,
                    "start": {"x": x, "y": y, "heading": heading}, "arrows": arrows,
                },
            });
            (model, walk)
        },
    )
}

/// What is seen of a demonstrator in the cave `model` who has every action and does what `walk` says, where it can and lives.
pub(crate) fn walked(model: &Value, walk: &[usize]) -> Value {
    let mut full = model.clone();
    full["actions"] = Act::ALL.iter().map(|act| json!({"name": act.name(), "cost": 0.3})).collect();
    let full = super::oracle::wumpus::as_table(&full);
    let mut at = json!(0);
    let mut demonstration = vec![full["dynamics"]["states"][0].clone()];
    for act in walk {
        let transitions = full["dynamics"]["transitions"].as_array().unwrap();
        let taken = transitions.iter().find(|t| t[0] == at && t[1] == Act::ALL[*act].name());
        at = taken.map_or(at, |t| t[2].clone());
        demonstration.push(full["dynamics"]["states"][at.as_u64().unwrap() as usize].clone());
    }
    demonstration.into()
}
