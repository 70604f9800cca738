//! An independent solver, written to be read: a layered shortest-path computation that follows the definition of the
//! mapping word by word, on JSON alone. It shares no code with the library.

// Each test binary uses its own part of this module.
#![allow(dead_code, clippy::allow_attributes, reason = "`expect` would fail where everything is used")]
#![expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "numbers here are small")]

pub(crate) mod wumpus;

use serde_json::Value;

/// The optimal cost of following `demonstration` with the body `model` (`table` dynamics, all fields spelled out).
pub(crate) fn optimal_cost(model: &Value, demonstration: &Value, weights: &Value, start: Option<usize>) -> f64 {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let observations = demonstration.as_array().unwrap();
    let d = |i: usize, s: usize| distance(model, weights, &observations[i], &states[s]);
    let edges = edges(model);

    // Layer 0: only the start is reached; then extra actions under o_0.
    let start = start.unwrap_or_else(|| choose_start(model, |s| d(0, s)));
    let mut layer = vec![f64::INFINITY; states.len()];
    layer[start] = d(0, start);
    relax_extras(&mut layer, &edges, |s| d(0, s));

    for i in 1..observations.len() {
        let mut next = vec![f64::INFINITY; states.len()];
        for s in 0..states.len() {
            next[s] = next[s].min(layer[s] + d(i, s)); // skip
        }
        for &(from, cost, to) in &edges {
            next[to] = next[to].min(layer[from] + cost + d(i, to)); // match
        }
        relax_extras(&mut next, &edges, |s| d(i, s));
        layer = next;
    }
    layer.into_iter().fold(f64::INFINITY, f64::min)
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

/// Transitions that are not into unsafe states: (from, action cost, to).
fn edges(model: &Value) -> Vec<(usize, f64, usize)> {
    let unsafe_states = unsafe_states(model);
    let actions = model["actions"].as_array().unwrap();
    let transitions = model["dynamics"]["transitions"].as_array().unwrap();
    let edges = transitions.iter().map(|transition| {
        let action = match &transition[1] {
            Value::String(name) => actions.iter().find(|action| action["name"] == *name).unwrap(),
            index => &actions[index.as_u64().unwrap() as usize],
        };
        let [from, to] = [0, 2].map(|end| transition[end].as_u64().unwrap() as usize);
        (from, action["cost"].as_f64().unwrap(), to)
    });
    edges.filter(|(_, _, to)| !unsafe_states.contains(to)).collect()
}

fn unsafe_states(model: &Value) -> Vec<usize> {
    let listed = model["dynamics"]["unsafe"].as_array();
    listed.into_iter().flatten().map(|state| state.as_u64().unwrap() as usize).collect()
}

fn choose_start(model: &Value, d: impl Fn(usize) -> f64) -> usize {
    let n_states = model["dynamics"]["states"].as_array().unwrap().len();
    let unsafe_states = unsafe_states(model);
    let mut candidates: Vec<usize> = match &model["dynamics"]["start"] {
        Value::Null => (0..n_states).filter(|state| !unsafe_states.contains(state)).collect(),
        Value::Array(states) => states.iter().map(|state| state.as_u64().unwrap() as usize).collect(),
        state => return state.as_u64().unwrap() as usize,
    };
    candidates.sort_unstable();
    let mut best = candidates[0];
    for candidate in candidates {
        if d(candidate) < d(best) {
            best = candidate;
        }
    }
    best
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

/// The least cost of going from the node `(i, s)`, itself not counted, to any state at the observation `to`.
pub(crate) fn cost_to_go(
    model: &Value,
    demonstration: &Value,
    weights: &Value,
    (i, s): (usize, usize),
    to: usize,
) -> f64 {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let d = |i: usize, s: usize| distance(model, weights, &demonstration[i], &states[s]);
    let edges = edges(model);
    let mut layer = vec![f64::INFINITY; states.len()];
    layer[s] = 0.0;
    relax_extras(&mut layer, &edges, |s| d(i, s));
    for j in i + 1..=to {
        let mut next = vec![f64::INFINITY; states.len()];
        for s in 0..states.len() {
            next[s] = next[s].min(layer[s] + d(j, s));
        }
        for &(from, cost, to) in &edges {
            next[to] = next[to].min(layer[from] + cost + d(j, to));
        }
        relax_extras(&mut next, &edges, |s| d(j, s));
        layer = next;
    }
    layer.into_iter().fold(f64::INFINITY, f64::min)
}
