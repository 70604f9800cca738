//! An independent solver, written to be read: a layered shortest-path computation that follows the definition of the
//! mapping word by word, on JSON alone. It shares no code with the library.

// Each test binary uses its own part of this module.
#![allow(dead_code, clippy::allow_attributes, reason = "`expect` would fail where everything is used")]
#![expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "numbers here are small")]

pub(crate) mod wumpus;

use serde_json::Value;

/// The optimal cost of what `request` asks for, with the body `model` (`table` dynamics, all fields spelled out).
pub(crate) fn optimal_cost(model: &Value, request: &Value) -> f64 {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let observations = request["demonstration"].as_array().unwrap();
    let mut layer = vec![f64::INFINITY; states.len()];
    for s in starts(model, request) {
        layer[s] = observation_weight(request, 0) * distance(model, &request["weights"], &observations[0], &states[s]);
    }
    let layer = layer_at(model, request, layer, 0, observations.len() - 1);
    let last = &observations[observations.len() - 1];
    let end = |s: usize| end_weight(request) * distance(model, &request["weights"], last, &states[s]);
    layer.iter().enumerate().map(|(s, cost)| cost + end(s)).fold(f64::INFINITY, f64::min)
}

/// The least costs at the observation `to`, if those at the observation `from` are `layer` before extra actions.
fn layer_at(model: &Value, request: &Value, mut layer: Vec<f64>, from: usize, to: usize) -> Vec<f64> {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let d = |i: usize, s: usize| {
        let observed = &request["demonstration"][i];
        observation_weight(request, i) * distance(model, &request["weights"], observed, &states[s])
    };
    let x = request["extra_weight"].as_f64().unwrap_or(1.0);
    let edges = edges(model, request);
    relax_extras(&mut layer, &edges, |s| x * d(from, s));
    for i in from + 1..=to {
        let mut next = vec![f64::INFINITY; states.len()];
        for s in 0..states.len() {
            next[s] = next[s].min(layer[s] + d(i, s)); // skip
        }
        for &(from, cost, to) in &edges {
            next[to] = next[to].min(layer[from] + cost + d(i, to)); // match
        }
        relax_extras(&mut next, &edges, |s| x * d(i, s));
        layer = next;
    }
    layer
}

/// What a distance to an observation counts.
pub(crate) fn observation_weight(request: &Value, i: usize) -> f64 {
    request["observation_weights"][i].as_f64().unwrap_or(1.0)
}

/// What the distance at the end counts once more.
pub(crate) fn end_weight(request: &Value) -> f64 {
    request["end_weight"].as_f64().unwrap_or(0.0)
}

/// Extra actions under one observation, until none improves anything (Bellman & Ford).
fn relax_extras(layer: &mut [f64], edges: &[(usize, f64, usize)], d: impl Fn(usize) -> f64) {
    loop {
        let mut improved = false;
        for &(from, cost, to) in edges {
            let extra = layer[from] + cost + d(to);
            if extra < layer[to] {
                layer[to] = extra;
                improved = true;
            }
        }
        if !improved {
            return;
        }
    }
}

/// Transitions of the request's body that are not into unsafe states: (from, cost, to).
fn edges(model: &Value, request: &Value) -> Vec<(usize, f64, usize)> {
    let unsafe_states = unsafe_states(model);
    let actions = model["actions"].as_array().unwrap();
    let lacks = |name: &Value| request["without"].as_array().is_some_and(|without| without.contains(name));
    let mut edges = Vec::new();
    for transition in model["dynamics"]["transitions"].as_array().unwrap() {
        let action = match &transition[1] {
            Value::String(name) => actions.iter().find(|action| action["name"] == *name).unwrap(),
            index => &actions[index.as_u64().unwrap() as usize],
        };
        let [from, to] = [0, 2].map(|end| transition[end].as_u64().unwrap() as usize);
        let name = action["name"].as_str().unwrap();
        let of_action = request["action_costs"][name].as_f64().or(action["cost"].as_f64());
        if !lacks(&action["name"]) && !unsafe_states.contains(&to) {
            edges.push((from, transition[4].as_f64().or(of_action).unwrap(), to));
        }
    }
    edges
}

fn unsafe_states(model: &Value) -> Vec<usize> {
    let listed = model["dynamics"]["unsafe"].as_array();
    listed.into_iter().flatten().map(|state| state.as_u64().unwrap() as usize).collect()
}

/// All states that may be started in.
pub(crate) fn starts(model: &Value, request: &Value) -> Vec<usize> {
    let n_states = model["dynamics"]["states"].as_array().unwrap().len();
    let start = [&request["start"], &model["dynamics"]["start"]].into_iter().find(|start| !start.is_null());
    match start {
        None => (0..n_states).filter(|state| !unsafe_states(model).contains(state)).collect(),
        Some(Value::Array(states)) => states.iter().map(|state| state.as_u64().unwrap() as usize).collect(),
        Some(state) => vec![state.as_u64().unwrap() as usize],
    }
}

/// `D(o, s)`, from the definition.
pub(crate) fn distance(model: &Value, weights: &Value, observation: &Value, state: &Value) -> f64 {
    let attributes = model["attributes"].as_array().unwrap();
    let mut sum = 0.0;
    for (k, attribute) in attributes.iter().enumerate() {
        let name = attribute["name"].as_str().unwrap();
        let o = if observation.is_array() { &observation[k] } else { &observation[name] };
        let s = &state[k];
        if o.is_null() {
            continue;
        }
        let scale = attribute["scale"].as_f64().unwrap_or(1.0);
        let delta = match attribute["kind"].as_str().unwrap() {
            "number" => (o.as_f64().unwrap() - s.as_f64().unwrap()).abs() / scale,
            "cyclic" => {
                let (o, s, p) = match attribute["labels"].as_array() {
                    Some(labels) => {
                        let place = |v: &Value| labels.iter().position(|label| label == v).unwrap() as f64;
                        (place(o), place(s), labels.len() as f64)
                    }
                    None => (o.as_f64().unwrap(), s.as_f64().unwrap(), attribute["period"].as_f64().unwrap()),
                };
                let d = (o - s).abs() % p;
                d.min(p - d) / scale
            }
            "category" => f64::from(u8::from(o != s)),
            other => panic!("unknown kind {other}"),
        };
        let default = attribute["weight"].as_f64().unwrap_or(1.0);
        sum += weights[name].as_f64().unwrap_or(default) * delta * delta;
    }
    sum
}

/// The least cost of going from the node `(i, s)`, itself not counted, to any state at the observation `to`; with the end, if `ends`.
pub(crate) fn cost_to_go(model: &Value, request: &Value, (i, s): (usize, usize), to: usize, ends: bool) -> f64 {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let mut layer = vec![f64::INFINITY; states.len()];
    layer[s] = 0.0;
    let layer = layer_at(model, request, layer, i, to);
    let w = if ends { end_weight(request) } else { 0.0 };
    let end = |s: usize| w * distance(model, &request["weights"], &request["demonstration"][to], &states[s]);
    layer.iter().enumerate().map(|(s, cost)| cost + end(s)).fold(f64::INFINITY, f64::min)
}

/// The least cost of a mapping up to the observation `to` that starts in one of `starts`; with the end, if `ends`.
pub(crate) fn cost_from(model: &Value, request: &Value, starts: &[usize], to: usize, ends: bool) -> f64 {
    let first = |s: &usize| {
        let state = &model["dynamics"]["states"][*s];
        let distance = distance(model, &request["weights"], &request["demonstration"][0], state);
        observation_weight(request, 0) * distance + cost_to_go(model, request, (0, *s), to, ends)
    };
    starts.iter().map(first).fold(f64::INFINITY, f64::min)
}
