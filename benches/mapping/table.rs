//! Tables of states at random.

use serde_json::{Value, json};

use crate::worlds::{SplitMix, World};

/// A table of `n_states` states at random in a space of two numbers, a cycle and a category, with `N_ACTIONS` ways out of each: all
/// but one lead to one of the states next to it in the order of their first number, the other anywhere. The demonstrator walked
/// at random; the imitator lacks one of its actions.
pub(crate) fn table(n_states: usize, n_observations: usize, seed: u64) -> World {
    const N_ACTIONS: usize = 5;
    let mut random = SplitMix(seed);
    let n = i64::try_from(n_states).unwrap_or(i64::MAX);
    let mut states: Vec<[i64; 4]> =
        (0..n_states).map(|_| [random.below(100), random.below(100), random.below(8), random.below(4)]).collect();
    states.sort_unstable();
    let value = |state: &[i64; 4]| json!([state[0], state[1], state[2], format!("kind {}", state[3])]);
    let mut successor = |from: usize, action: usize| {
        let from = i64::try_from(from).unwrap_or(0);
        let to = if action == 0 { random.below(n) } else { (from + random.below(101) - 50).rem_euclid(n) };
        usize::try_from(to).unwrap_or(0)
    };
    let ways: Vec<[usize; N_ACTIONS]> =
        (0..n_states).map(|from| std::array::from_fn(|action| successor(from, action))).collect();
    let transitions = ways.iter().enumerate().flat_map(|(from, ways)| {
        let kept = ways.iter().enumerate().skip(1).filter(move |(_, to)| **to != from);
        kept.map(move |(action, to)| json!([from, action - 1, to]))
    });
    let mut at = 0;
    let demonstration = (0..n_observations).map(|_| {
        let seen = value(&states[at]);
        at = ways[at][usize::try_from(random.below(5)).unwrap_or(0)];
        seen
    });
    let demonstration = demonstration.collect();
    World {
        name: format!("random table of {n_states} states"),
        model: json!({
            "attributes": [
                {"name": "a", "kind": "number", "scale": 10}, {"name": "b", "kind": "number", "scale": 10},
                {"name": "c", "kind": "cyclic", "period": 8}, {"name": "d", "kind": "category"},
            ],
            "actions": (1..N_ACTIONS).map(|action| json!({"name": format!("action {action}"), "cost": 0.3})).collect::<Value>(),
            "dynamics": {
                "kind": "table", "states": states.iter().map(value).collect::<Value>(),
                "transitions": transitions.collect::<Value>(), "start": 0,
            },
        }),
        demonstration,
    }
}
