//! Models that are told by rules, against the same models told otherwise.

mod cave;
mod faults;

use std::collections::BTreeMap;

use cave::cave_as_rules;
use faults::with;

use crate::problems::{cave, close, mapper, mapper_within, solve, walked};
use etude_core::document::Faults;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Limits, Model, Outcome};
use proptest::prelude::*;
use serde_json::{Value, json};

/// Nothing may be known beforehand.
const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };

fn compiled(model: &Value) -> Model {
    let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_cave_told_by_rules_is_the_one_that_is_built_in((model, walk) in cave()) {
        let told = cave_as_rules(&model);
        let (own, built_in) = (compiled(&told), compiled(&model));
        // Both are found breadth first, by actions in the same order: the numbers are the same, too.
        prop_assert_eq!(own.states().len(), built_in.states().len());
        for state in 0..own.states().len() {
            let values = [&own, &built_in].map(|model| serde_json::to_value(model.describe(state)).unwrap());
            prop_assert_eq!(&values[0], &values[1]);
        }
        let ways = |model: &Model| model.graph().iter().collect::<Vec<_>>();
        prop_assert_eq!(ways(&own), ways(&built_in));
        prop_assert_eq!((own.start(), own.actions()), (built_in.start(), built_in.actions()));

        let request = json!({"model": "m", "demonstration": walked(&model, &walk)});
        let optimum = solve(&mapper(&model), &request);
        let (known, lazy) = (mapper(&told), mapper_within(LAZY, &told));
        prop_assert!(lazy.model().is_lazy() && !known.model().is_lazy());
        for policy in [solve(&known, &request), solve(&lazy, &request)] {
            prop_assert_eq!(policy.cost, optimum.cost);
            prop_assert_eq!(policy.lower_bound, optimum.lower_bound);
        }
    }
}

/// What a rover does, written by hand: it drives on a grid of quarters of a metre, turns by thirds, pays for sand, and drains a battery.
#[derive(Clone, Debug, PartialEq)]
struct Rover {
    place: i64,
    turn: i64,
    battery: i64,
    lamp: &'static str,
}

fn metres(quarters: i64) -> f64 {
    f64::from(quarters as i32) / 4.0
}

impl Rover {
    fn start() -> Self {
        Self { place: 0, turn: 0, battery: 5, lamp: "off" }
    }

    /// Where `action` leads, and at what cost, unless it has no effect.
    fn after(&self, action: &str, sand: &[i64], chargers: &[i64]) -> Option<(Self, Option<f64>)> {
        let mut next = self.clone();
        let mut cost = None;
        match action {
            "drive" => {
                let far = if self.turn == 0 {
                    1
                } else if self.turn == 1 {
                    2
                } else {
                    -1
                };
                let power = 1 + i64::from(self.lamp == "on");
                next.place += far;
                next.battery -= power;
                if next.battery < 0 || !(0..=40).contains(&next.place) {
                    return None;
                }
                let is_sand = f64::from(u8::from(sand.contains(&next.place)));
                cost = Some(0.5 + is_sand * 4.0 * metres(self.place) * 0.25);
            }
            "turn" => next.turn = (self.turn + 1) % 3,
            "switch" => next.lamp = if self.lamp == "on" { "off" } else { "on" },
            _ => {
                if !chargers.contains(&self.place) {
                    return None;
                }
                next.battery = (self.battery + 4).min(9);
            }
        }
        // It is stuck where the sand is deepest.
        (next != *self && next.place != 13).then_some((next, cost))
    }

    fn values(&self) -> Value {
        json!({
            "place": metres(self.place), "turn": f64::from(self.turn as i32) * 120.0, "battery": self.battery, "lamp": self.lamp,
        })
    }
}

const ROVER_ACTIONS: [&str; 4] = ["drive", "turn", "switch", "charge"];

fn rover(sand: &[i64], chargers: &[i64]) -> Value {
    let at = |cells: &[i64]| cells.iter().map(|cell| metres(*cell)).collect::<Vec<_>>();
    json!({
        "attributes": [
            {"name": "place", "kind": "number", "values": {"from": 0, "to": 10, "step": 0.25}},
            {"name": "turn", "kind": "cyclic", "period": 360, "scale": 120, "values": {"from": 0, "to": 240, "step": 120}},
            {"name": "battery", "kind": "number", "values": {"from": 0, "to": 9}, "hidden": true},
            {"name": "lamp", "kind": "category", "values": ["on", "off"]},
        ],
        "actions": ROVER_ACTIONS.map(|name| json!({"name": name, "cost": 0.1})),
        "dynamics": {
            "kind": "rules", "constants": {"sand": at(sand), "chargers": at(chargers), "far": [0.25, 0.5, -0.25]},
            "start": Rover::start().values(),
            "rules": [
                {"action": "drive", "when": "battery < (lamp == 'on' ? 2 : 1)"},
                {
                    "action": "drive", "when": "place + far[turn / 120] >= 0.0 && place + far[turn / 120] <= 10.0",
                    "then": {"place": "place + far[turn / 120]", "battery": "battery - (lamp == 'on' ? 2 : 1)"},
                    "cost": "0.5 + (sand.exists(s, s == place + far[turn / 120]) ? 0.25 * place * 4.0 : 0.0)",
                },
                {"action": "turn", "then": {"turn": "(turn + 120) % 360"}},
                {"action": "switch", "then": {"lamp": "lamp == 'on' ? 'off' : 'on'"}},
                {"action": "charge", "when": "place in chargers", "then": {"battery": "math.least(battery + 4, 9)"}},
            ],
            "unsafe": "place == 3.25",
        },
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn rules_lead_where_a_successor_function_written_by_hand_does(
        sand in prop::collection::btree_set(1i64..41, 0..12),
        chargers in prop::collection::btree_set(0i64..41, 10..20),
    ) {
        let (sand, chargers): (Vec<i64>, Vec<i64>) = (sand.into_iter().collect(), chargers.into_iter().collect());
        let model = compiled(&rover(&sand, &chargers));
        let number: BTreeMap<String, u32> = (0..model.states().len())
            .map(|state| (key(&serde_json::to_value(model.describe(state)).unwrap()), state))
            .collect();
        let mut found = vec![Rover::start()];
        let mut next = 0;
        while next < found.len() {
            let here = found[next].clone();
            next += 1;
            let mut expected = Vec::new();
            for (n, action) in ROVER_ACTIONS.iter().enumerate() {
                if let Some((after, cost)) = here.after(action, &sand, &chargers) {
                    if !found.contains(&after) {
                        found.push(after.clone());
                    }
                    let mut outcome = Outcome::certain(number[&key(&after.values())]);
                    outcome.cost = cost;
                    expected.push((n as u16, outcome));
                }
            }
            let own: Vec<_> = model.outcomes(number[&key(&here.values())]).collect();
            prop_assert_eq!(own, expected, "{:?}", here);
        }
        prop_assert_eq!(found.len(), model.states().len() as usize);
    }
}

fn key(state: &Value) -> String {
    let number = |name: &str| state[name].as_f64().unwrap();
    format!("{} {} {} {}", number("place"), number("turn"), number("battery"), state["lamp"])
}

/// Rules of three attributes, of which the expressions are drawn.
fn drawn_rules() -> impl Strategy<Value = (Value, Value)> {
    const WHENS: [&str; 7] = [
        "true",
        "x > y",
        "b",
        "!b && x < 4",
        "c == 'up' || y == 2",
        "(x + y) % 2 == 0",
        "[x, y] in [[1, 1], [2, 3], [4, 0]]",
    ];
    const THENS: [(&str, &str); 10] = [
        ("x", "(x + 1) % 6"),
        ("x", "x > 0 ? x - 1 : x"),
        ("y", "x"),
        ("y", "(y + 2) % 6"),
        ("x", "y"),
        ("b", "!b"),
        ("b", "x == y"),
        ("c", "b ? 'up' : 'down'"),
        ("c", "'flat'"),
        ("y", "math.greatest(x, y)"),
    ];
    const COSTS: [Option<&str>; 4] = [None, Some("0.25"), Some("0.1 * double(x + y)"), Some("b ? 2 : 1")];
    let rule = (0usize..3, 0..WHENS.len(), prop::collection::vec(0..THENS.len(), 0..4), 0..COSTS.len());
    let rules = prop::collection::vec(rule, 1..8);
    let seen = prop::collection::vec((0u8..6, 0u8..6, prop::option::of(any::<bool>()), 0usize..3), 1..6);
    (rules, seen, prop::option::of(0u8..6), 0usize..3).prop_map(|(rules, seen, deadly, extra)| {
        let rules = rules.into_iter().map(|(action, when, thens, cost)| {
            let then: BTreeMap<_, _> = thens.into_iter().map(|n| THENS[n]).collect();
            json!({"action": format!("a{action}"), "when": WHENS[when], "then": then, "cost": COSTS[cost]})
        });
        let model = json!({
            "attributes": [
                {"name": "x", "kind": "number", "values": {"from": 0, "to": 5}},
                {"name": "y", "kind": "number", "values": {"from": 0, "to": 5}, "weight": 0.7},
                {"name": "b", "kind": "category", "values": [true, false]},
                {"name": "c", "kind": "category", "values": ["up", "down", "flat"], "hidden": true},
            ],
            "actions": [{"name": "a0", "cost": 0.3}, {"name": "a1"}, {"name": "a2", "cost": 0}],
            "dynamics": {
                "kind": "rules", "start": {"x": 1, "y": 0, "b": true, "c": "up"}, "rules": rules.collect::<Vec<_>>(),
                "unsafe": deadly.map(|y| format!("x == 3 && y == {y}")),
            },
        });
        let seen: Vec<_> = seen.into_iter().map(|(x, y, b, _)| json!({"x": x, "y": y, "b": b})).collect();
        (model, json!({"model": "m", "demonstration": seen, "extra_weight": ([0.0, 0.5, 1.0][extra])}))
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn rules_are_searched_lazily_for_the_same_optimum((model, request) in drawn_rules()) {
        let optimum = solve(&mapper(&model), &request);
        let mut request = request;
        for heuristic in ["default", "none"] {
            request["heuristic"] = heuristic.into();
            let policy = solve(&mapper_within(LAZY, &model), &request);
            prop_assert!(close(policy.cost.total, optimum.cost.total), "{:?} and {:?}", policy.cost, optimum.cost);
        }
    }
}

#[test]
fn attributes_that_are_too_large_to_be_tried_together_are_told_apart() {
    // A thousand places along each of three axes; the condition reads all of them.
    let axis = |name: &str| json!({"name": name, "kind": "number", "values": {"from": 0, "to": 999}});
    let step = |action: &str, then: Value| json!({"action": action, "when": "x + y + z < 3000", "then": then, "cost": "1 + x - x"});
    let model = json!({
        "attributes": [axis("x"), axis("y"), axis("z")],
        "actions": [{"name": "east"}, {"name": "north"}, {"name": "mix"}],
        "dynamics": {"kind": "rules", "start": {"x": 0, "y": 0, "z": 500}, "rules": [
            step("east", json!({"x": "math.least(x + 1, 999)"})), step("north", json!({"y": "math.least(y + 2, 999)", "x": "x"})),
            step("mix", json!({"z": "(x + y + z) % 1000"})),
        ]},
    });
    let seen: Vec<_> = (0..30).map(|n| json!({"x": n, "y": 2 * n, "z": 500})).collect();
    let request = json!({"model": "m", "demonstration": seen, "weights": {"x": 3, "y": 3}});
    let lazy = mapper_within(LAZY, &model);
    let (policy, blind) = (
        solve(&lazy, &request),
        solve(&lazy, &{
            let mut request = request.clone();
            request["heuristic"] = "none".into();
            request
        }),
    );
    assert!(close(policy.cost.total, blind.cost.total), "{:?} and {:?}", policy.cost, blind.cost);
    assert!(
        policy.search.expanded * 2 < blind.search.expanded,
        "{} of {}",
        policy.search.expanded,
        blind.search.expanded
    );
}

#[test]
fn outcomes_are_states_of_their_own_and_counted() {
    let model = json!({
        "attributes": [{"name": "x", "kind": "number", "values": {"from": 0, "to": 3}}, {"name": "ok", "kind": "category", "values": [true, false]}],
        "actions": [{"name": "hop"}, {"name": "rest"}],
        "dynamics": {
            "kind": "rules", "start": [{"x": 0, "ok": true}, {"x": 1, "ok": true}], "unsafe": "!ok",
            "rules": [
                {"action": "hop", "when": "x < 2", "outcomes": [
                    {"probability": 0.5, "then": {"x": "x + 1"}}, {"probability": 0.25, "then": {"x": "x + 1"}},
                    {"probability": 0.125, "then": {"ok": "false"}}, {"probability": 0.125},
                ]},
                {"action": "hop", "when": "x == 2", "outcomes": [{"probability": 0.5, "then": {"x": "3"}}, {"probability": 0.5, "then": {"x": "3"}}]},
                {"action": "rest", "then": {"x": "math.greatest(x - 1, 0)"}},
            ],
        },
    });
    let compiled = compiled(&model);
    let told: Vec<(u16, u32, f64)> =
        compiled.outcomes(0).map(|(action, outcome)| (action, outcome.to, outcome.probability)).collect();
    let named = |state: u32| serde_json::to_value(compiled.describe(state)).unwrap();
    assert_eq!((compiled.n_stochastic(), compiled.n_unsafe()), (2, 2));
    let dead = told.iter().find(|(_, to, _)| compiled.is_unsafe(*to)).unwrap();
    assert_eq!((named(dead.1), dead.2), (json!({"x": 0, "ok": false}), 0.125));
    let by_state: BTreeMap<String, f64> = told.iter().map(|(_, to, p)| (named(*to).to_string(), *p)).collect();
    assert_eq!(by_state[&json!({"x": 1, "ok": true}).to_string()], 0.75);
    assert_eq!(by_state[&json!({"x": 0, "ok": true}).to_string()], 0.125);
    // Two outcomes that are one are certain, and nothing leaves an unsafe state.
    let last = (0..compiled.states().len()).find(|state| named(*state) == json!({"x": 2, "ok": true})).unwrap();
    let (_, hop) = compiled.outcomes(last).find(|(action, _)| *action == 0).unwrap();
    assert_eq!((named(hop.to), hop.probability), (json!({"x": 3, "ok": true}), 1.0));
    assert_eq!(compiled.outcomes(dead.1).count(), 0);
    let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    assert!(Model::compile(&definition, LAZY, &mut Uninterrupted).unwrap().n_stochastic() > 0);
}

#[test]
fn a_hidden_attribute_is_part_of_the_state_and_nothing_else() {
    let model = with(
        &json!({"rules": [{"action": "go", "when": "x < 3 && fuel > 0", "then": {"x": "x + 1", "fuel": "fuel - 2"}}]}),
    );
    let mapper = mapper(&model);
    let policy = solve(
        &mapper,
        &json!({"model": "m", "demonstration": [{"x": 0}, {"x": 1}, {"x": 2}, {"x": 3}], "weights": {"x": 9}}),
    );
    let last = serde_json::to_value(&policy.steps.last().unwrap().state).unwrap();
    assert_eq!((&last["x"], &last["fuel"]), (&json!(2), &json!(0)));
    let refused = |request: &Value| {
        let mut faults = Faults::default();
        let place = etude_core::document::Place::root(request);
        let object = place.object(etude_core::mapping::Request::FIELDS, &mut faults).unwrap();
        etude_core::mapping::Request::read(mapper.model(), &object, &mut faults);
        faults.listed().iter().map(|fault| fault.pointer.clone()).collect::<Vec<_>>()
    };
    let request = json!({"model": "m", "demonstration": [{"fuel": 1}, [0, 0, null, null, 2]], "weights": {"fuel": 1}, "start": {"x": 1, "fuel": 2}});
    let mut pointers = refused(&request);
    pointers.sort();
    assert_eq!(pointers, ["/demonstration/0/fuel", "/demonstration/1/4", "/weights/fuel"]);
}

#[test]
fn what_is_written_is_read_as_the_same() {
    for model in [
        with(&json!({})),
        rover(&[1], &[2]),
        with(&json!({"start": [{"x": 0, "load": 0.25, "heading": "west", "door": "open", "fuel": 2}]})),
    ] {
        let text = |model: &Value| Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap().text();
        let once = text(&model);
        assert_eq!(text(&serde_json::from_str(&once).unwrap()), once);
        let states = |model: &Value| compiled(model).states().clone();
        assert_eq!(states(&serde_json::from_str(&once).unwrap()), states(&model));
    }
}
