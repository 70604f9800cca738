//! What the transitions of a table say, to be compared with what something else says of the same world.

#![expect(clippy::cast_possible_truncation, reason = "numbers here are small")]

use std::collections::BTreeMap;

use serde_json::Value;

/// The outcomes of every state and action, by the state that they lead to: probability and cost, in millionths. A cost that is never paid is none.
pub(crate) type Outcomes = BTreeMap<(usize, String), BTreeMap<usize, (i64, Option<i64>)>>;

pub(crate) fn millionths(number: f64) -> i64 {
    (number * 1e6).round() as i64
}

pub(crate) fn outcomes(model: &Value) -> Outcomes {
    let mut outcomes = Outcomes::new();
    let cost_of = |name: &str| {
        let action = model["actions"].as_array().unwrap().iter().find(|action| action["name"] == name).unwrap();
        action["cost"].as_f64().unwrap()
    };
    for transition in model["dynamics"]["transitions"].as_array().unwrap() {
        let [from, to] = [0, 2].map(|end| transition[end].as_u64().unwrap() as usize);
        let name = transition[1].as_str().unwrap();
        let probability = transition[3].as_f64().unwrap_or(1.0);
        let cost = transition[4].as_f64().unwrap_or_else(|| cost_of(name));
        let cost = (from != to || probability < 1.0).then(|| millionths(cost));
        let entry = (millionths(probability), cost);
        assert!(outcomes.entry((from, name.to_owned())).or_default().insert(to, entry).is_none());
    }
    outcomes
}
