use proptest::num::f64::{NEGATIVE, NORMAL, POSITIVE, SUBNORMAL, ZERO};
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::attribute::MAX_COST;
use crate::document;
use crate::interrupt::{Signal, Uninterrupted};
use crate::model::Model;

fn read(text: &str) -> Definition {
    let document = document::parse(text.as_bytes()).unwrap();
    Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_definition_that_is_read_again_is_the_same_to_the_last_bit(
        weight in POSITIVE | NORMAL | SUBNORMAL | ZERO,
        scale in POSITIVE | NORMAL | SUBNORMAL,
        cost in 0.0..=MAX_COST,
        x in POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO,
    ) {
        let model = json!({
            "attributes": [{"name": "x", "kind": "number", "scale": scale, "weight": weight}],
            "actions": [{"name": "a", "cost": cost}],
            "dynamics": {"kind": "table", "states": [[x]], "transitions": []},
        });
        let first = read(&model.to_string()).text();
        let again = read(&first).text();
        prop_assert_eq!(&first, &again);
        let read: DefinitionDocument = serde_json::from_str(&first).unwrap();
        let attributes = read.attributes.unwrap();
        prop_assert_eq!((attributes[0].weight, attributes[0].scale), (Some(weight), Some(scale)));
        prop_assert_eq!(read.actions.unwrap()[0].cost, Some(cost));
    }
}

/// The pointers of the faults of `model`, in the order of their text.
fn faults_of(model: &serde_json::Value) -> Vec<String> {
    let read = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted);
    let Err(CompileError::Faults(faults)) = read else { panic!("{model} has faults") };
    let mut pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.clone()).collect();
    pointers.sort_unstable();
    pointers
}

fn two_states() -> serde_json::Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "a"}, {"name": "b"}],
        "dynamics": {"kind": "table", "states": [[0], [1]], "transitions": [[0, "a", 1]]},
    })
}

#[test]
fn without_known_dynamics_attributes_and_actions_are_checked_all_the_same() {
    let mut model = two_states();
    model["attributes"][0]["scale"] = json!(0);
    model["actions"][1]["cost"] = json!(-1);
    for (dynamics, pointer) in
        [(json!(null), "/dynamics"), (json!({"kind": "maze"}), "/dynamics/kind"), (json!({}), "/dynamics/kind")]
    {
        model["dynamics"] = dynamics;
        assert_eq!(faults_of(&model), ["/actions/1/cost", "/attributes/0/scale", pointer]);
    }
}

#[test]
fn without_states_the_rest_of_a_table_is_checked_all_the_same() {
    let mut model = two_states();
    model["dynamics"] = json!({
        "kind": "table", "states": [], "transitions": [[0, "c", 1], [0]], "start": "here", "unsafe": [-1],
    });
    assert_eq!(
        faults_of(&model),
        [
            "/dynamics/start",
            "/dynamics/states",
            "/dynamics/transitions/0/1",
            "/dynamics/transitions/1",
            "/dynamics/unsafe/0"
        ]
    );
}

#[test]
fn a_cyclic_attribute_with_a_period_and_labels_has_one_fault_whatever_these_are() {
    let mut model = two_states();
    model["attributes"] = json!([{"name": "x", "kind": "cyclic", "period": 0, "labels": []}]);
    assert_eq!(faults_of(&model), ["/attributes/0"]);
}

#[test]
fn a_faulty_action_keeps_its_index_and_its_name() {
    let mut model = two_states();
    model["actions"] = json!([{"name": "a", "cost": -1}, {"name": "b"}, {"name": "a"}]);
    model["dynamics"]["transitions"] = json!([[0, "a", 1], [0, 1, 1], [1, 2, 0], [1, 3, 0], [1, "c", 0]]);
    let expected = ["/actions/0/cost", "/actions/2/name", "/dynamics/transitions/3/1", "/dynamics/transitions/4/1"];
    assert_eq!(faults_of(&model), expected);
    // What an action without a name is called is not known.
    model["actions"] = json!([{"name": 7}, {"name": "b"}, {"cost": 1}, {"name": "b"}]);
    model["dynamics"]["transitions"] = json!([[0, "c", 1]]);
    assert_eq!(faults_of(&model), ["/actions/0/name", "/actions/2/name", "/actions/3/name"]);
}

#[test]
fn unsafe_states_are_a_set() {
    let text = |listed: serde_json::Value| {
        let mut model = two_states();
        model["dynamics"]["states"] = json!([[0], [1], [2], [3]]);
        model["dynamics"]["unsafe"] = listed;
        read(&model.to_string()).text()
    };
    assert_eq!(text(json!([3, 1, 3])), text(json!([1, 3])));
}

#[test]
fn what_a_fault_says_is_short_however_long_the_document() {
    let long = "x".repeat(100_000);
    let actions: Vec<_> = (0..4000).map(|n| json!({"name": format!("action {n}")})).collect();
    let mut model = two_states();
    model["actions"] = actions.into();
    model["dynamics"]["transitions"] = json!([[0, long, 1], [0, "fly", 1]]);
    model["attributes"] = json!([{"name": long, "kind": long}, {"name": long, "kind": "number"}]);
    let read = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted);
    let Err(CompileError::Faults(faults)) = read else { panic!("the model has faults") };
    for fault in faults.listed() {
        assert!(fault.detail.len() < 500, "{fault:?}");
    }
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 2, "height": 2}, "actions": [{"name": long}]});
    let read = Definition::read(&cave, Limits::DEFAULT, &mut Uninterrupted);
    let Err(CompileError::Faults(faults)) = read else { panic!("the cave has faults") };
    assert!(faults.listed().iter().all(|fault| fault.detail.len() < 500));
}

#[test]
fn reading_asks_again_and_again_whether_to_go_on() {
    let many: Vec<_> = (0..20_000).map(|n| json!([n])).collect();
    let edges: Vec<_> = (0..20_000).map(|n| json!([n, "a", 0])).collect();
    let mut states = two_states();
    states["dynamics"]["states"] = many.into();
    let mut transitions = states.clone();
    transitions["dynamics"]["transitions"] = edges.into();
    let pits: Vec<_> = (0..20_000).map(|n| json!([n % 200 + 1, n / 200])).collect();
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 300, "height": 300, "pits": pits}});
    for (model, n_polls_least) in [(states, 5), (transitions, 9), (cave, 4)] {
        let mut n_polls = 0;
        let mut count = || {
            n_polls += 1;
            Signal::Continue
        };
        assert!(Definition::read(&model, Limits::DEFAULT, &mut count).is_ok());
        assert!(n_polls >= n_polls_least, "{n_polls}");
        let mut n_left = n_polls_least;
        let mut cancel = || {
            n_left -= 1;
            if n_left == 0 { Signal::Cancel } else { Signal::Continue }
        };
        let cancelled = Definition::read(&model, Limits::DEFAULT, &mut cancel);
        assert!(matches!(cancelled, Err(CompileError::Cancelled(_))));
    }
}

/// A line of states in a table, of which each leads on to the next two, and the first ones; the attribute tells all of them apart.
fn line(n_states: usize) -> serde_json::Value {
    let edges = (2..n_states).flat_map(|n| [json!([n - 2, "a", n - 1]), json!([n - 2, "b", n])]);
    json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "a"}, {"name": "b"}],
        "dynamics": {
            "kind": "table", "states": (0..n_states).map(|n| [n]).collect::<Vec<_>>(), "transitions": edges.collect::<Vec<_>>(),
        },
    })
}

#[test]
fn a_text_that_is_not_read_in_time_is_no_model() {
    let model = two_states();
    let read = Definition::read(&model, Limits::DEFAULT, &mut || Signal::Finish);
    assert!(matches!(read, Err(CompileError::OutOfTime)), "{read:?}");
    let text = model.to_string();
    let read = Definition::parse(text.as_bytes(), Format::Json, Limits::DEFAULT, &mut || Signal::Finish);
    assert!(matches!(read, Err(ReadError::OutOfTime)), "{read:?}");
}

#[test]
fn a_table_that_would_take_more_memory_than_it_may_is_refused_while_it_is_read() {
    let text = line(2000).to_string();
    let read = |max_bytes| {
        let limits = Limits { max_bytes, ..Limits::NONE };
        Definition::parse(text.as_bytes(), Format::Json, limits, &mut Uninterrupted)
    };
    let definition = read(usize::MAX).unwrap();
    let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).unwrap();
    let n_bytes = model.size_bytes();
    assert!(read(6 * n_bytes).is_ok());
    // Whether its states are too many, or its transitions.
    for max_bytes in [n_bytes / 8, n_bytes] {
        let error = read(max_bytes).unwrap_err();
        assert!(matches!(&error, ReadError::TooLarge(detail) if detail.contains("ETUDE_MAX_MEMORY")), "{error}");
    }
    let limits = Limits { max_bytes: n_bytes, ..Limits::NONE };
    let read = Definition::read(&line(2000), limits, &mut Uninterrupted);
    assert!(matches!(read, Err(CompileError::Faults(_))), "{read:?}");
}
