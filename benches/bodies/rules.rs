//! Models that are told by rules, beside the tables of the same states.

use std::time::Duration;

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::HeuristicName;
use etude_core::model::{Definition, Limits, Model, Start};
use serde_json::{Value, json};

use crate::cave::cave_as_rules;
use crate::worlds::{self, SplitMix};
use crate::{Known, map, mapper, ms, problem, spread, timed};

const N_ROUNDS: usize = 5;
const N_SEEDS: u64 = 5;
/// How wide and high the rover's field is.
const SIDE: i64 = 68;

pub(crate) fn measure() {
    println!("rules: ms, and multiples of the table's time, of {N_ROUNDS} rounds and {N_SEEDS} demonstrations");
    compare("a rover that turns, fills up and goes round walls", &rover(), &|seed| watched(50, seed));
    let cave = worlds::cave(20, 5, 50, 1).model;
    let cave = Definition::read(&cave, Limits::NONE, &mut Uninterrupted).expect("a cave");
    let mut cave: Value = serde_json::from_str(&cave.text()).expect("JSON");
    cave["dynamics"]["start"] = json!({"x": 0, "y": 0, "heading": "east"});
    cave["dynamics"]["arrows"] = json!(1);
    for list in ["pits", "wumpi", "gold"] {
        if cave["dynamics"][list].is_null() {
            cave["dynamics"][list] = json!([]);
        }
    }
    let demonstration = |seed| worlds::cave(20, 5, 50, seed).demonstration;
    compare("the 20x20 cave with 5 gold, written as rules", &cave_as_rules(&cave), &demonstration);
}

/// A rover on a field with walls, which turns and drives, and fills up at stations.
fn rover() -> Value {
    let mut random = SplitMix(7);
    let walls: Vec<i64> = (0..300).map(|_| 1 + random.below(SIDE * SIDE - 1)).collect();
    let drive = |heading: &str, guard: &str, axis: &str, step: &str, cell: &str| {
        json!({
            "action": "drive", "when": format!("fuel > 0 && heading == '{heading}' && {guard} && !({cell} in walls)"),
            "then": {axis: step, "fuel": "fuel - 1"}, "cost": "x % 7 == 3 ? 0.9 : 0.3",
        })
    };
    json!({
        "attributes": [
            {"name": "x", "kind": "number", "values": {"from": 0, "to": SIDE - 1}},
            {"name": "y", "kind": "number", "values": {"from": 0, "to": SIDE - 1}},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]},
            {"name": "fuel", "kind": "number", "values": {"from": 0, "to": 9}},
        ],
        "actions": [{"name": "drive", "cost": 0.3}, {"name": "left", "cost": 0.3}, {"name": "right", "cost": 0.3}, {"name": "fill"}],
        "dynamics": {
            "kind": "rules", "constants": {"walls": walls, "side": SIDE}, "start": {"x": 0, "y": 0, "heading": "east", "fuel": 9},
            "rules": [
                drive("east", "x < side - 1", "x", "x + 1", "x + 1 + side * y"),
                drive("north", "y < side - 1", "y", "y + 1", "x + side * (y + 1)"),
                drive("west", "x > 0", "x", "x - 1", "x - 1 + side * y"),
                drive("south", "y > 0", "y", "y - 1", "x + side * (y - 1)"),
                {"action": "left", "then": {"heading": "heading == 'east' ? 'north' : heading == 'north' ? 'west' : heading == 'west' ? 'south' : 'east'"}},
                {"action": "right", "then": {"heading": "heading == 'east' ? 'south' : heading == 'south' ? 'west' : heading == 'west' ? 'north' : 'east'"}},
                {"action": "fill", "when": "x % 5 == 2 && y % 5 == 2", "then": {"fuel": "9"}, "cost": "0.1 * double(9 - fuel)"},
            ],
        },
    })
}

/// Where somebody was seen that needs no fuel and minds no walls, going from place to place.
fn watched(n_observations: usize, seed: u64) -> Value {
    let mut random = SplitMix(seed);
    let (mut at, mut goal) = ((0, 0), (0, 0));
    let mut seen = Vec::with_capacity(n_observations);
    while seen.len() < n_observations {
        seen.push(json!({"x": at.0, "y": at.1}));
        while at == goal {
            goal = (random.below(SIDE), random.below(SIDE));
        }
        if at.0 == goal.0 {
            at.1 += (goal.1 - at.1).signum();
        } else {
            at.0 += (goal.0 - at.0).signum();
        }
    }
    seen.into()
}

/// The table of the states of a model.
fn as_table(rules: &Value, model: &Model) -> Value {
    let names: Vec<&str> = model.schema().attributes().iter().map(|attribute| attribute.name.as_str()).collect();
    let states = (0..model.states().len()).map(|state| {
        let described = serde_json::to_value(model.describe(state)).expect("a state is JSON");
        names.iter().map(|name| described[name].clone()).collect::<Value>()
    });
    let ways = (0..model.states().len()).flat_map(|from| {
        model.outcomes(from).map(move |(action, outcome)| json!([from, action, outcome.to, 1.0, outcome.cost]))
    });
    let attributes = rules["attributes"].as_array().expect("attributes").iter().map(|attribute| {
        let mut attribute = attribute.clone();
        attribute.as_object_mut().expect("an object").remove("values");
        attribute
    });
    let start = match model.start() {
        Start::State(state) => *state,
        _ => 0,
    };
    json!({
        "attributes": attributes.collect::<Value>(), "actions": rules["actions"],
        "dynamics": {"kind": "table", "states": states.collect::<Value>(), "transitions": ways.collect::<Value>(), "start": start},
    })
}

fn compare(name: &str, rules: &Value, demonstration: &dyn Fn(u64) -> Value) {
    let read = |model: &Value| Definition::read(model, Limits::NONE, &mut Uninterrupted).expect("worlds are models");
    let compile = || {
        let compiled = Model::compile(&read(rules), Limits::NONE, &mut Uninterrupted);
        compiled.expect("worlds are without faults")
    };
    let compiling = (0..N_ROUNDS).map(|_| ms(timed(compile).1)).collect();
    let model = compile();
    println!("\n{name}: {} states, {} transitions", model.states().len(), model.n_transitions());
    println!("read and compiled in                {} ms", spread(compiling));

    let table = mapper(&read(&as_table(rules, &model)), Known::All);
    let (listed, lazy) = (mapper(&read(rules), Known::All), mapper(&read(rules), Known::Nothing));
    let mappers = [&table, &listed, &lazy];
    let mut times = vec![Vec::new(); mappers.len()];
    let mut ratios = vec![Vec::new(); mappers.len()];
    let (mut n_expanded, mut slowest) = (vec![0; mappers.len()], Duration::ZERO);
    for seed in 1..=N_SEEDS {
        let demonstration = demonstration(seed);
        let problems = mappers.map(|mapper| problem(mapper, &demonstration));
        let mut costs = [0.0; 3];
        for round in 0..=N_ROUNDS {
            let mut first = 0.0;
            for (n, (mapper, problem)) in mappers.into_iter().zip(&problems).enumerate() {
                let (mapping, time) = timed(|| map(mapper, problem, HeuristicName::Default));
                costs[n] = mapping.cost.total;
                // The first finds what is kept for those after it.
                if round == 0 {
                    n_expanded[n] += mapping.n_expanded;
                    continue;
                }
                if n == 0 {
                    first = ms(time);
                }
                slowest = slowest.max(time);
                times[n].push(ms(time));
                ratios[n].push(ms(time) / first);
            }
        }
        assert!(costs.iter().all(|cost| (cost - costs[0]).abs() < 1e-6), "{costs:?}");
    }
    for (n, name) in ["the table", "rules, all states listed", "rules, searched lazily"].into_iter().enumerate() {
        let (times, ratios) = (spread(times[n].clone()), spread(ratios[n].clone()));
        println!("{name:<28} {times:>28} ms   {ratios:>24} of the table   {} expansions", n_expanded[n]);
    }
}
