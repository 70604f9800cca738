//! Worlds to measure on: the examples, and caves of any size from a seed.

#![allow(dead_code, clippy::allow_attributes, reason = "each benchmark uses its part of this module")]

use std::path::Path;

use serde_json::{Value, json};

/// A body and a demonstration for it.
pub(crate) struct World {
    pub(crate) name: String,
    pub(crate) model: Value,
    pub(crate) demonstration: Value,
}

/// The world of an example's directory.
pub(crate) fn example(directory: &str) -> World {
    let read = |file: &str| -> Value {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(directory).join(file);
        let text = std::fs::read_to_string(&path).expect("the examples are there");
        serde_json::from_str(&text).expect("the examples are JSON")
    };
    World { name: directory.to_owned(), model: read("model.json"), demonstration: read("demonstration.json") }
}

/// A cave of `side` by `side` cells with two wumpi and `n_gold` pieces of gold, for a body that cannot shoot. The demonstrator
/// shot its arrow and walked through the cells where the wumpi live now; it fetched the gold piece by piece, the nearest
/// first, from where it lay then: each piece has since been moved by up to three cells along each axis. It is watched for
/// `n_observations` states.
pub(crate) fn cave(side: i64, n_gold: usize, n_observations: usize, seed: u64) -> World {
    let mut random = SplitMix(seed);
    let mut gold: Vec<(i64, i64)> = Vec::new();
    while gold.len() < n_gold {
        let cell = (random.below(side), random.below(side));
        if cell != (0, 0) && !gold.contains(&cell) {
            gold.push(cell);
        }
    }
    let seen = demonstrate(&gold, n_observations);
    let passed: Vec<(i64, i64)> = seen.iter().map(|state| (state.x, state.y)).collect();
    let mut wumpi: Vec<(i64, i64)> = Vec::new();
    while wumpi.len() < 2 {
        let cell = passed[usize::try_from(random.below(i64::try_from(passed.len()).unwrap_or(1))).unwrap_or(0)];
        if cell != (0, 0) && !wumpi.contains(&cell) {
            wumpi.push(cell);
        }
    }
    let mut moved = |at: i64| (at + random.below(7) - 3).clamp(0, side - 1);
    let gold: Vec<(i64, i64)> = gold.iter().map(|(x, y)| (moved(*x), moved(*y))).collect();
    world(side, n_gold, &wumpi, &gold, &seen)
}

/// The same, for a demonstrator who goes from place to place without an end, and takes the gold that it comes upon; none was moved.
pub(crate) fn wandered(side: i64, n_gold: usize, n_observations: usize, seed: u64) -> World {
    let mut random = SplitMix(seed);
    let mut cell = || (random.below(side), random.below(side));
    let mut gold: Vec<(i64, i64)> = (0..n_gold).map(|_| cell()).collect();
    gold.sort_unstable();
    gold.dedup();
    let wumpi: Vec<(i64, i64)> =
        (0..2).map(|_| cell()).filter(|cell| *cell != (0, 0) && !gold.contains(cell)).collect();
    let mut left = gold.clone();
    let (mut state, mut goal) = (State { x: 0, y: 0, heading: 0, n_gold: 0, n_arrows: 1 }, cell());
    let mut seen = Vec::with_capacity(n_observations);
    while seen.len() < n_observations {
        seen.push(state.clone());
        if let Some(taken) = left.iter().position(|cell| *cell == (state.x, state.y)) {
            left.swap_remove(taken);
            state.n_gold += 1;
        } else if state.turn_or_go_towards(goal).is_none() {
            goal = cell();
        }
    }
    world(side, n_gold, &wumpi, &gold, &seen)
}

/// The world of a body that cannot shoot, in a cave with these wumpi and this gold, and of what was `seen`.
fn world(side: i64, n_gold: usize, wumpi: &[(i64, i64)], gold: &[(i64, i64)], seen: &[State]) -> World {
    let cells = |cells: &[(i64, i64)]| cells.iter().map(|(x, y)| json!([x, y])).collect::<Value>();
    let actions = ["forward", "turn_left", "turn_right", "grab", "climb"];
    World {
        name: format!("{side}x{side} cave, {n_gold} gold"),
        model: json!({
            "actions": actions.map(|name| json!({"name": name, "cost": 0.3})),
            "dynamics": {
                "kind": "wumpus", "width": side, "height": side, "wumpi": cells(wumpi), "gold": cells(gold),
            },
        }),
        demonstration: seen.iter().map(State::observed).collect(),
    }
}

#[derive(Clone)]
struct State {
    x: i64,
    y: i64,
    heading: usize,
    n_gold: i64,
    n_arrows: i64,
}

impl State {
    fn observed(&self) -> Value {
        let heading = ["east", "north", "west", "south"][self.heading];
        json!({"x": self.x, "y": self.y, "heading": heading, "gold": self.n_gold, "arrows": self.n_arrows, "outside": false})
    }
}

impl State {
    /// Turns towards a cell, or goes on, along x first. `None` if it is there.
    fn turn_or_go_towards(&mut self, goal: (i64, i64)) -> Option<()> {
        let ahead = match (goal.0 - self.x, goal.1 - self.y) {
            (0, 0) => return None,
            (dx, _) if dx != 0 => usize::from(dx < 0) * 2,
            (_, dy) => 1 + usize::from(dy < 0) * 2,
        };
        if self.heading == ahead {
            let (dx, dy) = [(1, 0), (0, 1), (-1, 0), (0, -1)][ahead];
            (self.x, self.y) = (self.x + dx, self.y + dy);
        } else {
            let is_left = (ahead + 4 - self.heading) % 4 != 3;
            self.heading = (self.heading + if is_left { 1 } else { 3 }) % 4;
        }
        Some(())
    }
}

/// Walks to the nearest piece of gold, along x and then along y, and takes it; and so on, until enough was seen.
fn demonstrate(gold: &[(i64, i64)], n_observations: usize) -> Vec<State> {
    let mut left = gold.to_vec();
    let mut state = State { x: 0, y: 0, heading: 0, n_gold: 0, n_arrows: 1 };
    let mut seen = vec![state.clone()];
    state.n_arrows = 0;
    seen.push(state.clone());
    while seen.len() < n_observations {
        let distance = |(x, y): &(i64, i64)| (x - state.x).abs() + (y - state.y).abs();
        // With all the gold in hand, it goes home.
        let goal = left.iter().copied().min_by_key(distance).unwrap_or((0, 0));
        if state.turn_or_go_towards(goal).is_none() {
            if left.is_empty() {
                break;
            }
            left.retain(|cell| *cell != goal);
            state.n_gold += 1;
        }
        seen.push(state.clone());
    }
    seen
}

/// A generator of numbers that are the same everywhere (Steele, Lea & Flood 2014).
pub(crate) struct SplitMix(pub(crate) u64);

impl SplitMix {
    pub(crate) fn below(&mut self, bound: i64) -> i64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        i64::try_from((z ^ (z >> 31)) >> 1).unwrap_or(0) % bound
    }
}
