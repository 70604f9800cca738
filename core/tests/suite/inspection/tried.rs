//! What a body can do, found by trying everything, on JSON alone.

use std::collections::{BTreeMap, BTreeSet};

use crate::oracle;
use serde_json::{Value, json};

pub(super) fn strings(value: &Value) -> Vec<String> {
    value.as_array().into_iter().flatten().map(|name| name.as_str().unwrap().to_owned()).collect()
}

/// All that is tried out.
pub(super) struct Tried {
    pub(super) starts: BTreeSet<usize>,
    /// States that are reached.
    pub(super) reached: BTreeSet<usize>,
    /// Between these: from, action, to.
    pub(super) ways: Vec<(usize, String, usize)>,
    /// The fewest actions from state to state.
    pub(super) steps: Vec<Vec<Option<usize>>>,
}

pub(super) fn try_all(model: &Value, request: &Value) -> Tried {
    let dynamics = &model["dynamics"];
    let n_states = dynamics["states"].as_array().unwrap().len();
    let unsafe_states: BTreeSet<usize> =
        dynamics["unsafe"].as_array().into_iter().flatten().map(|state| state.as_u64().unwrap() as usize).collect();
    let without = strings(&request["without"]);
    let mut outcomes: BTreeMap<(usize, String), BTreeSet<usize>> = BTreeMap::new();
    for transition in dynamics["transitions"].as_array().unwrap() {
        let [from, to] = [0, 2].map(|end| transition[end].as_u64().unwrap() as usize);
        let action = transition[1].as_str().unwrap().to_owned();
        outcomes.entry((from, action)).or_default().insert(to);
    }
    outcomes.retain(|(_, action), to| !without.contains(action) && to.is_disjoint(&unsafe_states));
    let all = outcomes.iter().flat_map(|((from, action), to)| to.iter().map(move |to| (*from, action.clone(), *to)));
    let mut ways: Vec<(usize, String, usize)> = all.filter(|(from, _, to)| from != to).collect();
    // Floyd and Warshall.
    let mut steps = vec![vec![None; n_states]; n_states];
    (0..n_states).for_each(|s| steps[s][s] = Some(0));
    for (from, _, to) in &ways {
        steps[*from][*to] = Some(1);
    }
    for (k, i, j) in (0..n_states).flat_map(|k| (0..n_states).flat_map(move |i| (0..n_states).map(move |j| (k, i, j))))
    {
        if let (Some(first), Some(second)) = (steps[i][k], steps[k][j]) {
            steps[i][j] = Some(steps[i][j].map_or(first + second, |known: usize| known.min(first + second)));
        }
    }
    let starts: BTreeSet<usize> = oracle::starts(model, request).into_iter().collect();
    let reached: BTreeSet<usize> =
        (0..n_states).filter(|s| starts.iter().any(|start| steps[*start][*s].is_some())).collect();
    ways.retain(|(from, ..)| reached.contains(from));
    Tried { starts, reached, ways, steps }
}

/// The weight of the attribute at `k`.
pub(super) fn weight(model: &Value, request: &Value, k: usize) -> f64 {
    let attribute = &model["attributes"][k];
    let default = attribute["weight"].as_f64().unwrap_or(1.0);
    request["weights"][attribute["name"].as_str().unwrap()].as_f64().unwrap_or(default)
}

pub(super) fn observed<'v>(model: &Value, observation: &'v Value, k: usize) -> &'v Value {
    if observation.is_array() {
        &observation[k]
    } else {
        &observation[model["attributes"][k]["name"].as_str().unwrap()]
    }
}

/// The distance to an observation in one attribute, as if it weighed so much.
pub(super) fn term(model: &Value, observation: &Value, state: &Value, k: usize, weight: f64) -> f64 {
    let attribute = &model["attributes"][k];
    let one = json!({"attributes": [attribute]});
    let name = attribute["name"].as_str().unwrap();
    let weights = json!({name: weight});
    oracle::distance(&one, &weights, &json!([observed(model, observation, k)]), &json!([state[k]]))
}

/// Whether they are the same value, however it is written.
pub(super) fn is_same(one: &Value, other: &Value) -> bool {
    one == other || one.as_f64().zip(other.as_f64()).is_some_and(|(one, other)| one == other)
}
