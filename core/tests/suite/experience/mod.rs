//! Models of experience, against counts that are written here.

#![expect(clippy::cast_precision_loss, clippy::cast_sign_loss, reason = "numbers here are small")]

mod kept;

use std::collections::BTreeMap;

use proptest::prelude::*;
use serde_json::{Value, json};

use crate::oracle::optimal_cost;
use crate::problems::{close, mapper, solve};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::Mapper;
use etude_core::model::{Batch, Definition, Limits, Model, Tally};

fn definition(dynamics: &Value) -> Value {
    json!({
        "attributes": [
            {"name": "x", "kind": "number", "scale": 0.5},
            {"name": "heading", "kind": "cyclic", "period": 360},
            {"name": "door", "kind": "category"},
        ],
        "actions": [{"name": "on", "cost": 0.3}, {"name": "turn"}, {"name": "push", "cost": 2}],
        "dynamics": dynamics,
    })
}

fn read(definition: &Value) -> Result<Definition, Faults> {
    Definition::read(definition, Limits::DEFAULT, &mut Uninterrupted).map_err(|error| match error {
        etude_core::model::CompileError::Faults(faults) => faults,
        error => panic!("{error}"),
    })
}

fn tally(definition: &Value) -> Tally {
    Tally::new(&read(definition).unwrap()).unwrap()
}

fn read_batch(tally: &Tally, batch: &Value) -> Result<Batch, Faults> {
    let mut faults = Faults::default();
    let batch = tally.read_batch(&Place::root(batch), &mut faults, &mut Uninterrupted).unwrap();
    faults.check(batch)
}

fn add(tally: &mut Tally, batch: &Value) {
    let batch = read_batch(tally, batch).unwrap();
    tally.add(&batch);
}

fn table(tally: &Tally) -> Definition {
    tally.definition(&mut Uninterrupted).unwrap().unwrap()
}

fn compiled(tally: &Tally) -> Model {
    Model::compile(&table(tally), Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

/// A place, where it is rounded to: to halves, and to thirds of a circle.
#[derive(Clone, Debug)]
struct Seen {
    state: (f64, f64, bool),
    action: usize,
    next: (f64, f64, bool),
    count: u64,
    cost: Option<f64>,
}

const ACTIONS: [(&str, f64); 3] = [("on", 0.3), ("turn", 1.0), ("push", 2.0)];

fn place((x, heading, door): (f64, f64, bool)) -> Value {
    json!({"x": x, "heading": heading, "door": if door { "open" } else { "shut" }})
}

/// The place that stands for all those that are rounded to it.
fn rounded((x, heading, door): (f64, f64, bool)) -> Value {
    let halves = (2.0 * x).round() / 2.0;
    let degrees = [0.0, 120.0, 240.0, 0.0][(heading / 120.0).round() as usize];
    place((halves + 0.0, degrees, door))
}

fn log(max_len: usize) -> impl Strategy<Value = Vec<Seen>> {
    let state = || (-1.0..1.0, 0.0..360.0, any::<bool>());
    let cost = prop::option::weighted(0.5, prop_oneof![Just(0.7), 0.0..9.0]);
    let seen = (state(), 0..ACTIONS.len(), state(), 1u64..4, cost);
    let seen = seen.prop_map(|(state, action, next, count, cost)| Seen { state, action, next, count, cost });
    prop::collection::vec(seen, 0..max_len)
}

/// Batches of a log: up to so many transitions each.
fn batches(log: &[Seen], n_each: usize) -> Vec<Value> {
    let written = |seen: &Seen| {
        let mut written =
            json!({"state": place(seen.state), "action": ACTIONS[seen.action].0, "next": place(seen.next)});
        if seen.count > 1 {
            written["count"] = seen.count.into();
        }
        if let Some(cost) = seen.cost {
            written["cost"] = cost.into();
        }
        written
    };
    let chunks = log.chunks(n_each).enumerate();
    let batch = |(n, chunk): (usize, &[Seen])| json!({"batch": format!("b{n}"), "transitions": chunk.iter().map(written).collect::<Vec<_>>()});
    chunks.map(batch).collect()
}

/// How often an outcome was seen, and what it cost in all.
type Outcomes = BTreeMap<String, (u64, f64)>;

/// What was seen, counted plainly: states by first appearance, and by state and action the outcomes, with those whose cost was never told.
struct Counted {
    states: Vec<String>,
    pairs: BTreeMap<(String, usize), Outcomes>,
    told: BTreeMap<(String, usize, String), bool>,
}

fn count(log: &[Seen]) -> Counted {
    let mut counted = Counted { states: Vec::new(), pairs: BTreeMap::new(), told: BTreeMap::new() };
    for seen in log {
        let [from, to] = [seen.state, seen.next].map(|state| rounded(state).to_string());
        for state in [&from, &to] {
            if !counted.states.contains(state) {
                counted.states.push(state.clone());
            }
        }
        let outcomes = counted.pairs.entry((from.clone(), seen.action)).or_default();
        let (n, cost) = outcomes.entry(to.clone()).or_default();
        *n += seen.count;
        *cost += seen.count as f64 * seen.cost.unwrap_or(ACTIONS[seen.action].1);
        *counted.told.entry((from, seen.action, to)).or_default() |= seen.cost.is_some();
    }
    counted
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_model_of_experience_is_what_counting_gives(log in log(80), n_each in 1usize..20, min_count in 1u64..5) {
        let dynamics = json!({"kind": "experience", "min_count": min_count, "bin": {"x": 0.5, "heading": 120}, "start": place((0.2, 350.0, true))});
        let mut tally = tally(&definition(&dynamics));
        let mut before = tally.counts();
        prop_assert_eq!(before.n_states, 1, "the start");
        for batch in batches(&log, n_each) {
            add(&mut tally, &batch);
            prop_assert!(tally.counts().n_states >= before.n_states);
            before = tally.counts();
        }
        let mut counted = count(&log);
        let start = rounded((0.2, 350.0, true)).to_string();
        if !counted.states.contains(&start) {
            counted.states.push(start.clone());
        }
        let model = compiled(&tally);
        let number = |state: &str| counted.states.iter().position(|known| known == state).unwrap() as u32;
        let told: Vec<Value> = (0..model.states().len()).map(|state| serde_json::to_value(model.describe(state)).unwrap()).collect();
        let expected: Vec<Value> = counted.states.iter().map(|state| serde_json::from_str(state).unwrap()).collect();
        for (told, expected) in told.iter().zip(&expected) {
            for name in ["x", "heading", "door"] {
                prop_assert!(told[name] == expected[name] || told[name].as_f64() == expected[name].as_f64(), "{} {}", told, expected);
            }
        }
        prop_assert_eq!(told.len(), expected.len());
        prop_assert_eq!(model.start(), &etude_core::model::Start::State(number(&start)));

        let mut n_transitions = 0;
        let mut n_stochastic = 0;
        for ((from, action), outcomes) in &counted.pairs {
            let n: u64 = outcomes.values().map(|(n, _)| n).sum();
            let found: Vec<_> = model.outcomes(number(from)).filter(|(found, _)| usize::from(*found) == *action).collect();
            if n < min_count {
                prop_assert_eq!(found, vec![]);
                continue;
            }
            n_transitions += outcomes.len();
            n_stochastic += usize::from(outcomes.len() > 1);
            // What has no effect is of no use to a search.
            let is_idle = outcomes.len() == 1 && outcomes.contains_key(from);
            prop_assert_eq!(found.len(), if is_idle { 0 } else { outcomes.len() });
            let sum: f64 = found.iter().map(|(_, outcome)| outcome.probability).sum();
            prop_assert!(is_idle || (sum - 1.0).abs() < 1e-9, "{}", sum);
            for (_, outcome) in found {
                let to = &counted.states[outcome.to as usize];
                let (seen, cost) = outcomes[to];
                prop_assert!((outcome.probability - seen as f64 / n as f64).abs() < 1e-12);
                let is_told = counted.told[&(from.clone(), *action, to.clone())];
                prop_assert_eq!(outcome.cost.is_some(), is_told);
                prop_assert!(outcome.cost.is_none_or(|mean| (mean - cost / seen as f64).abs() < 1e-9));
            }
        }
        let counts = tally.counts();
        prop_assert_eq!((counts.n_transitions, counts.n_stochastic), (n_transitions, n_stochastic));
        prop_assert_eq!((model.n_transitions(), model.n_stochastic()), (n_transitions, n_stochastic));
        prop_assert_eq!(counts.n_states, expected.len());
    }

    #[test]
    fn it_does_not_matter_how_a_log_is_cut_into_batches(log in log(60), n_each in 1usize..20) {
        let definition = definition(&json!({"kind": "experience", "bin": {"x": 0.25}, "start": place((0.0, 0.0, true))}));
        let [mut whole, mut cut] = [tally(&definition), tally(&definition)];
        for batch in batches(&log, 1000) {
            add(&mut whole, &batch);
        }
        for batch in batches(&log, n_each) {
            add(&mut cut, &batch);
        }
        prop_assert_eq!(whole.counts(), cut.counts());
        prop_assert_eq!(table(&whole).text(), table(&cut).text());
    }

    #[test]
    fn the_text_of_a_batch_reads_as_the_same_batch(log in log(30)) {
        let tally = tally(&definition(&json!({"kind": "experience", "bin": {"x": 0.25}})));
        for batch in batches(&log, 1000) {
            let text = read_batch(&tally, &batch).unwrap().text;
            prop_assert_eq!(&read_batch(&tally, &serde_json::from_str(&text).unwrap()).unwrap().text, &text);
        }
    }

    #[test]
    fn a_body_without_surprises_maps_as_the_table_of_what_it_did(
        (steps, walk) in (prop::collection::vec((0usize..3, 0usize..5), 1..60), prop::collection::vec((-1.0..3.0, 0usize..2), 1..6)),
        costs in prop::collection::vec(0.0..3.0, 15),
    ) {
        // Five places on a line; where an action leads from one follows from both, and so does what it costs.
        let places: Vec<Value> = (0..5).map(|n| json!([n, 0, n % 2 == 0])).collect();
        let mut at = 0;
        let (mut transitions, mut states, mut table) = (Vec::new(), vec![0], BTreeMap::new());
        for (action, hop) in steps {
            // Now and then it is carried elsewhere.
            if hop == 0 {
                at = (at + 2) % 5;
            }
            let to = (at * (action + 2) + action) % 5;
            let cost = costs[at * 3 + action];
            for state in [at, to] {
                if !states.contains(&state) {
                    states.push(state);
                }
            }
            transitions.push(json!({"state": places[at], "action": ACTIONS[action].0, "next": places[to], "cost": cost}));
            table.insert((at, action), json!([at, action, to, 1.0, cost]));
            at = to;
        }
        let mut experience = definition(&json!({"kind": "experience", "start": {"x": 0, "heading": 0, "door": true}}));
        let mut tally = tally(&experience);
        add(&mut tally, &json!({"batch": "all", "transitions": transitions}));
        prop_assert_eq!((tally.counts().n_stochastic, tally.counts().n_transitions), (0, table.len()));
        let model = Mapper::new(compiled(&tally), &mut Uninterrupted).unwrap();

        experience["dynamics"] = json!({
            "kind": "table", "states": places, "transitions": table.values().collect::<Vec<_>>(), "start": 0, "unsafe": [],
        });
        experience["actions"][1]["cost"] = 1.0.into();
        for attribute in experience["attributes"].as_array_mut().unwrap() {
            attribute["weight"] = 1.0.into();
            if attribute["scale"].is_null() && attribute["kind"] != "category" {
                attribute["scale"] = 1.0.into();
            }
        }
        let demonstration: Vec<Value> = walk.iter().map(|(x, door)| json!([x, null, *door == 0])).collect();
        let request = json!({"model": "m", "demonstration": demonstration});
        let policy = solve(&model, &request);
        prop_assert!(close(policy.cost.total, optimal_cost(&experience, &request)), "{}", policy.cost.total);
        prop_assert!(close(policy.cost.total, solve(&mapper(&experience), &request).cost.total));
    }
}

#[test]
fn what_is_wrong_with_a_batch_is_told_all_at_once() {
    let tally = tally(&definition(&json!({"kind": "experience"})));
    let here = || json!({"x": 0, "heading": 0, "door": "shut"});
    let batch = json!({"batch": "", "speed": 1, "transitions": [
        {"state": here(), "action": "on", "next": here(), "count": 2, "cost": 0},
        {"state": {"x": "far", "heading": null, "hue": 1}, "action": "of", "next": [0, 1]},
        {"state": [0, null, "shut"], "action": 3, "next": here(), "count": 0, "cost": -1},
        {"action": "on", "next": here(), "count": 1.5, "cost": 1e151, "note": ""},
        7,
    ]});
    let faults = read_batch(&tally, &batch).unwrap_err();
    let mut pointers: Vec<&str> = faults.listed().iter().map(|fault| &*fault.pointer).collect();
    pointers.sort_unstable();
    let expected = [
        "/batch",
        "/speed",
        "/transitions/1/action",
        "/transitions/1/next",
        "/transitions/1/state/door",
        "/transitions/1/state/heading",
        "/transitions/1/state/hue",
        "/transitions/1/state/x",
        "/transitions/2/action",
        "/transitions/2/cost",
        "/transitions/2/count",
        "/transitions/2/state/1",
        "/transitions/3/cost",
        "/transitions/3/count",
        "/transitions/3/note",
        "/transitions/3/state",
        "/transitions/4",
    ];
    assert_eq!(pointers, expected);
    let missing = read_batch(&tally, &json!({})).unwrap_err();
    assert_eq!(missing.count(), 2);
    assert!(read_batch(&tally, &json!([])).is_err());
}

#[test]
fn what_is_wrong_with_a_definition_is_told_all_at_once() {
    let dynamics = json!({
        "kind": "experience", "min_count": 0, "bin": {"x": 0, "door": 1, "hue": 2}, "states": [], "start": 1, "unsafe": {},
    });
    let faults = read(&definition(&dynamics)).unwrap_err();
    let mut pointers: Vec<&str> = faults.listed().iter().map(|fault| &*fault.pointer).collect();
    pointers.sort_unstable();
    let expected = [
        "/dynamics/bin/door",
        "/dynamics/bin/hue",
        "/dynamics/bin/x",
        "/dynamics/min_count",
        "/dynamics/start",
        "/dynamics/states",
        "/dynamics/unsafe",
    ];
    assert_eq!(pointers, expected);
    let (shut, open) = (place((0.1, 1.0, false)), place((0.0, 359.0, true)));
    let dynamics = json!({"kind": "experience", "bin": {"x": 1, "heading": 10}, "start": [shut, place((0.3, 0.0, true))], "unsafe": [open]});
    let faults = read(&definition(&dynamics)).unwrap_err();
    assert_eq!((faults.count(), &*faults.listed()[0].pointer), (1, "/dynamics/start/1"));
}

#[test]
fn a_definition_is_the_same_however_it_is_written() {
    let of = |dynamics: Value| read(&definition(&dynamics)).unwrap().text();
    let plain = of(json!({"kind": "experience"}));
    assert_eq!(plain, of(json!({"unsafe": [], "bin": {}, "kind": "experience", "min_count": 1.0, "start": null})));
    let told = of(
        json!({"kind": "experience", "min_count": 3, "bin": {"x": 0.5}, "start": [[0, 0, "shut"]], "unsafe": [[1, 0, "shut"]]}),
    );
    assert_eq!(
        told,
        of(
            json!({"kind": "experience", "min_count": 3, "bin": {"x": 0.5}, "start": {"door": "shut", "x": 0, "heading": 0}, "unsafe": [[1, 0, "shut"]]})
        )
    );
    let again: Value = serde_json::from_str(&told).unwrap();
    assert_eq!(read(&again).unwrap().text(), told);
    assert_eq!(
        again["dynamics"],
        json!({
            "kind": "experience", "min_count": 3, "bin": {"x": 0.5}, "start": {"x": 0, "heading": 0, "door": "shut"},
            "unsafe": [{"x": 1, "heading": 0, "door": "shut"}],
        })
    );
}

#[test]
fn a_model_of_which_nothing_is_known_has_nowhere_to_start() {
    let compile =
        |dynamics: Value| Model::compile(&read(&definition(&dynamics)).unwrap(), Limits::DEFAULT, &mut Uninterrupted);
    let error = compile(json!({"kind": "experience"})).unwrap_err();
    assert!(error.to_string().contains("nothing was experienced yet"), "{error}");
    let model = compile(json!({"kind": "experience", "start": [[0, 0, "shut"], [1, 0, "shut"]]})).unwrap();
    assert_eq!((model.states().len(), model.n_transitions()), (2, 0));
    // All that was seen must not be entered.
    let mut tally = tally(&definition(&json!({"kind": "experience", "unsafe": [[0, 0, "shut"]]})));
    let seen = |next: u8| json!({"batch": "a", "transitions": [{"state": [0, 0, "shut"], "action": "on", "next": [next, 0, "shut"]}]});
    add(&mut tally, &seen(0));
    assert_eq!((tally.counts().n_states, tally.counts().n_unsafe), (1, 1));
    assert!(tally.definition(&mut Uninterrupted).unwrap().is_none());
    add(&mut tally, &seen(1));
    let model = compiled(&tally);
    assert_eq!((model.n_unsafe(), model.is_unsafe(0), model.is_unsafe(1)), (1, true, false));
}

#[test]
fn a_batch_beyond_the_limits_is_told_and_one_of_what_is_known_is_not() {
    let mut tally = tally(&definition(&json!({"kind": "experience", "bin": {"x": 1}})));
    let to = |x: f64, next: f64| json!({"state": [x, 0, 1], "action": "on", "next": [next, 0, 1]});
    add(&mut tally, &json!({"batch": "a", "transitions": [to(0.0, 1.0), to(1.0, 2.0)]}));
    let limits = Limits { max_states: 4, max_transitions: 3, ..Limits::DEFAULT };
    let told = |transitions: Value| {
        let batch = read_batch(&tally, &json!({"batch": "b", "transitions": transitions})).unwrap();
        let mut faults = Faults::default();
        tally.check(&batch, limits, &mut faults);
        faults.listed().iter().map(|fault| fault.detail.clone()).collect::<Vec<_>>()
    };
    assert_eq!(
        told(json!([to(0.0, 1.0), to(1.2, 2.0), to(0.0, 0.9), to(2.0, 3.0), to(2.4, 3.1)])),
        Vec::<String>::new()
    );
    let both = told(json!([to(2.0, 3.0), to(3.0, 4.0)]));
    assert!(both.len() == 2 && both[0].contains("5 states") && both[1].contains("4 transitions"), "{both:?}");
}
