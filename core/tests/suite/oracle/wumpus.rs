//! The rules of the wumpus world once more, as plainly as possible: turns a cave into a table.

use std::collections::HashMap;

use serde_json::{Value, json};

const HEADINGS: [&str; 4] = ["east", "north", "west", "south"];

#[derive(Clone, PartialEq, Eq, Hash)]
struct State {
    x: i64,
    y: i64,
    heading: usize,
    arrows: i64,
    outside: bool,
    wumpi_alive: Vec<bool>,
    gold_there: Vec<bool>,
}

/// The model with `wumpus` dynamics as a model with `table` dynamics.
pub(crate) fn as_table(model: &Value) -> Value {
    let cave = &model["dynamics"];
    let cells = |name: &str| -> Vec<(i64, i64)> {
        let cells = cave[name].as_array().unwrap();
        cells.iter().map(|cell| (cell[0].as_i64().unwrap(), cell[1].as_i64().unwrap())).collect()
    };
    let (pits, wumpi, gold) = (cells("pits"), cells("wumpi"), cells("gold"));
    let first = State {
        x: cave["start"]["x"].as_i64().unwrap(),
        y: cave["start"]["y"].as_i64().unwrap(),
        heading: HEADINGS.iter().position(|name| *name == cave["start"]["heading"]).unwrap(),
        arrows: cave["arrows"].as_i64().unwrap(),
        outside: false,
        wumpi_alive: vec![true; wumpi.len()],
        gold_there: vec![true; gold.len()],
    };
    let in_grid = |x: i64, y: i64| {
        (0..cave["width"].as_i64().unwrap()).contains(&x) && (0..cave["height"].as_i64().unwrap()).contains(&y)
    };
    let after = |before: &State, action: &str| -> State {
        let mut state = before.clone();
        let (dx, dy) = [(1, 0), (0, 1), (-1, 0), (0, -1)][state.heading];
        match action {
            _ if state.outside => {}
            "forward" if in_grid(state.x + dx, state.y + dy) => {
                state.x += dx;
                state.y += dy;
            }
            "turn_left" => state.heading = (state.heading + 1) % 4,
            "turn_right" => state.heading = (state.heading + 3) % 4,
            "shoot" if state.arrows > 0 => {
                state.arrows -= 1;
                let (mut x, mut y) = (state.x + dx, state.y + dy);
                'flight: while in_grid(x, y) {
                    for (k, wumpus) in wumpi.iter().enumerate() {
                        if *wumpus == (x, y) && state.wumpi_alive[k] {
                            state.wumpi_alive[k] = false;
                            break 'flight;
                        }
                    }
                    x += dx;
                    y += dy;
                }
            }
            "grab" => {
                let here = (0..gold.len()).find(|k| gold[*k] == (state.x, state.y) && state.gold_there[*k]);
                if let Some(k) = here {
                    state.gold_there[k] = false;
                }
            }
            "climb" if (state.x, state.y) == (first.x, first.y) => state.outside = true,
            _ => {}
        }
        state
    };
    let is_dead = |state: &State| {
        let here = (state.x, state.y);
        pits.contains(&here) || wumpi.iter().zip(&state.wumpi_alive).any(|(wumpus, alive)| *alive && *wumpus == here)
    };

    let mut attributes = vec![
        json!({"name": "x", "kind": "number", "weight": 1}),
        json!({"name": "y", "kind": "number", "weight": 1}),
        json!({"name": "heading", "kind": "cyclic", "labels": HEADINGS, "weight": 1}),
        json!({"name": "gold", "kind": "number", "weight": 1}),
        json!({"name": "arrows", "kind": "number", "weight": 1}),
        json!({"name": "outside", "kind": "category", "weight": 5}),
    ];
    for k in 1..=wumpi.len() {
        attributes.push(json!({"name": format!("wumpus_{k}"), "kind": "category", "weight": 0}));
    }
    for k in 1..=gold.len() {
        attributes.push(json!({"name": format!("gold_{k}"), "kind": "category", "weight": 0}));
    }
    let values = |state: &State| -> Value {
        let carried = state.gold_there.iter().filter(|there| !**there).count();
        let mut values =
            vec![json!(state.x), json!(state.y), json!(HEADINGS[state.heading]), json!(carried), json!(state.arrows)];
        values.push(json!(state.outside));
        values.extend(state.wumpi_alive.iter().chain(&state.gold_there).map(|flag| json!(flag)));
        values.into()
    };

    let mut states = vec![first.clone()];
    let mut numbers = HashMap::from([(first.clone(), 0)]);
    let mut transitions = Vec::new();
    let mut n = 0;
    while n < states.len() {
        for action in model["actions"].as_array().unwrap() {
            let name = action["name"].as_str().unwrap();
            let next = after(&states[n], name);
            if next == states[n] || is_dead(&next) {
                continue;
            }
            let to = *numbers.entry(next.clone()).or_insert_with(|| {
                states.push(next);
                states.len() - 1
            });
            transitions.push(json!([n, name, to]));
        }
        n += 1;
    }
    let states: Vec<Value> = states.iter().map(values).collect();
    json!({
        "attributes": attributes,
        "actions": model["actions"],
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0, "unsafe": []},
    })
}
