//! A floor of cells, for a robot that is observed from outside and not exactly.

use serde_json::{Value, json};

use crate::worlds::{SplitMix, World};

/// A grid of `side` by `side` cells, of which one in eight is blocked. The imitator moves to any of the eight cells around it that is
/// free. The demonstrator was somewhere on a smooth curve that knows no walls, and was seen to within about half a cell.
pub(crate) fn grid(side: i64, n_observations: usize, seed: u64) -> World {
    let mut random = SplitMix(seed);
    let mut cells: Vec<Option<usize>> = Vec::new();
    let mut states = Vec::new();
    for x in 0..side {
        for y in 0..side {
            let is_free = (x, y) == (side / 2, side / 2) || random.below(8) > 0;
            cells.push(is_free.then_some(states.len()));
            if is_free {
                states.push((x, y));
            }
        }
    }
    let at = |x: i64, y: i64| {
        let is_inside = (0..side).contains(&x) && (0..side).contains(&y);
        is_inside.then(|| cells[usize::try_from(x * side + y).unwrap_or(0)]).flatten()
    };
    let moves: Vec<(i64, i64)> =
        (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))).filter(|step| *step != (0, 0)).collect();
    let transitions = states.iter().enumerate().flat_map(|(from, (x, y))| {
        let ways = moves.iter().enumerate();
        ways.filter_map(move |(action, (dx, dy))| at(x + dx, y + dy).map(|to| json!([from, action, to])))
    });
    let transitions: Value = transitions.collect();
    let actions = moves.iter().map(|(dx, dy)| {
        let cost = if dx * dy == 0 { 0.3 } else { 0.42 };
        json!({"name": format!("by {dx} and {dy}"), "cost": cost})
    });
    let half = side as f64 / 2.0;
    let demonstration = (0..n_observations).map(|i| {
        let time = i as f64 / 400.0;
        let mut seen_at = |along: f64| {
            let noise = random.below(11) as f64 / 10.0 - 0.5;
            ((half + 0.8 * half * along + noise) * 10.0).round() / 10.0
        };
        json!({"x": seen_at((3.0 * time).sin()), "y": seen_at((2.0 * time).sin())})
    });
    World {
        name: format!("grid of {} cells", side * side),
        demonstration: demonstration.collect(),
        model: json!({
            "attributes": [{"name": "x", "kind": "number"}, {"name": "y", "kind": "number"}],
            "actions": actions.collect::<Value>(),
            "dynamics": {
                "kind": "table", "states": states, "transitions": transitions, "start": at(side / 2, side / 2),
            },
        }),
    }
}
