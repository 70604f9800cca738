//! What is wrong with rules, and how that is told.

use etude_core::document::Faults;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{CompileError, Definition, Limits, Model};
use serde_json::{Value, json};

/// All faults of a model, read or compiled: their pointers and what they say.
fn faults_of(model: &Value) -> Vec<(String, String)> {
    let told = |faults: &Faults| {
        faults.listed().iter().map(|fault| (fault.pointer.clone(), fault.detail.clone())).collect::<Vec<_>>()
    };
    match Definition::read(model, Limits::DEFAULT, &mut Uninterrupted) {
        Err(CompileError::Faults(faults)) => told(&faults),
        Err(error) => panic!("{error}"),
        Ok(definition) => match Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted) {
            Err(CompileError::Faults(faults)) => told(&faults),
            Err(error) => panic!("{error}"),
            Ok(_) => Vec::new(),
        },
    }
}

/// A model with one attribute of each kind, whose `dynamics` have the members of `other`.
pub(crate) fn with(other: &Value) -> Value {
    let mut model = json!({
        "attributes": [
            {"name": "x", "kind": "number", "values": {"from": 0, "to": 3}},
            {"name": "load", "kind": "number", "values": {"from": 0, "to": 1, "step": 0.25}},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "west"]},
            {"name": "door", "kind": "category", "values": ["open", "shut"]},
            {"name": "fuel", "kind": "number", "values": [0, 2, 4], "hidden": true},
        ],
        "actions": [{"name": "go"}, {"name": "wait"}],
        "dynamics": {
            "kind": "rules", "constants": {"walls": [3, 7]},
            "start": {"x": 0, "load": 0, "heading": "east", "door": "shut", "fuel": 4},
            "rules": [{"action": "go", "when": "x < 3", "then": {"x": "x + 1"}}],
        },
    });
    for (name, value) in other.as_object().unwrap() {
        model["dynamics"][name] = value.clone();
    }
    model
}

fn assert_faults(model: &Value, expected: &[(&str, &str)]) {
    let faults = faults_of(model);
    assert_eq!(faults.len(), expected.len(), "{faults:#?}");
    for ((pointer, detail), (expected_pointer, part)) in faults.iter().zip(expected) {
        assert_eq!((pointer.as_str(), detail.contains(part)), (*expected_pointer, true), "{detail} should say {part}");
    }
}

#[test]
fn a_model_without_faults_has_none() {
    assert_faults(&with(&json!({})), &[]);
}

#[test]
fn all_that_is_wrong_with_rules_is_told_at_once_with_rule_and_column() {
    let rules = json!({"constants": {"walls": [3, 7], "x": 1, "map": {}}, "rules": [
        {"action": "go", "when": "x + 1", "then": {"x": "x + 0.5", "door": "x > 1 ? 'open' : 'ajar'", "speed": "1"}},
        {"action": "fly", "when": "fule > 0 && x in door"},
        {"action": "go", "when": "x ==", "then": {"heading": "'north'", "load": "load + 1"}, "cost": "'cheap'"},
        {"action": "wait", "then": {"x": "9", "load": "1"}, "outcomes": []},
        {"action": "wait", "outcomes": [{"probability": 0.5}, {"probability": 0.4, "then": {"fuel": "3"}}, {"odds": 1}]},
        {"action": "wait", "cost": "x > 2 ? -1 : 1", "when": "size(x) == 1 && jump(x)"},
        {"action": "wait", "when": "x == 'a' || !x || -door == 1"},
        {"action": "go", "then": {"x": 1}},
    ], "unsafe": "x"});
    let at = |pointer: &str| format!("/dynamics/{pointer}");
    let expected = [
        ("constants/map", "expected a number"),
        ("constants/x", "an attribute is called so already"),
        ("rules/0/then/speed", "unknown attribute \"speed\""),
        ("rules/1/action", "one of the actions \"go\", \"wait\""),
        ("rules/3/outcomes", "1 to 1000 outcomes"),
        ("rules/4/outcomes/2/odds", "unknown field"),
        ("rules/4/outcomes/2/probability", "is missing"),
        ("rules/7/then/x", "an expression"),
        ("rules/0/when", "rule 0, column 1: expected bool, found int"),
        (
            "rules/0/then/door",
            "rule 0, column 18: this is \"ajar\", which is none of the values of \"door\", which are \"open\", \"shut\"",
        ),
        ("rules/0/then/x", "rule 0, column 3: + cannot be applied to int and double: write double(..)"),
        ("rules/1/when", "rule 1, column 1: unknown name \"fule\"; known here: \"door\", \"fuel\""),
        ("rules/1/when", "rule 1, column 15: in cannot be applied to int and string"),
        ("rules/2/when", "rule 2, column 5: the expression ends too early"),
        ("rules/2/then/heading", "rule 2, column 1: this is \"north\""),
        ("rules/2/then/load", "rule 2, column 6: + cannot be applied to double and int"),
        ("rules/2/cost", "rule 2, column 1: expected int or double, found string"),
        ("rules/4/outcomes/1/then/fuel", "rule 4, column 1: this is 3, which is none of the values of \"fuel\""),
        ("rules/5/when", "rule 5, column 1: size() cannot be applied to (int)"),
        ("rules/5/when", "rule 5, column 17: unknown function jump()"),
        ("rules/5/cost", "rule 5, column 10: -1 is no cost"),
        ("rules/6/when", "rule 6, column 3: == cannot be applied to int and string"),
        ("rules/6/when", "rule 6, column 14: expected bool, found int"),
        ("rules/6/when", "rule 6, column 19: expected int or double, found string"),
        ("unsafe", "column 1: expected bool, found int"),
    ];
    let pointers: Vec<String> = expected.iter().map(|(pointer, _)| at(pointer)).collect();
    let mut model = with(&rules);
    model["dynamics"]["rules"][3].as_object_mut().unwrap().remove("then");
    let expected: Vec<(&str, &str)> = pointers.iter().map(String::as_str).zip(expected.map(|(_, part)| part)).collect();
    assert_faults(&model, &expected);
}

#[test]
fn what_leads_out_of_the_domains_is_told_with_rule_column_and_state() {
    let model = with(&json!({"rules": [
        {"action": "go", "then": {"x": "x + 1", "fuel": "fuel - 2"}},
        {"action": "wait", "when": "10 / x > 0 && walls[x] > 2", "then": {"load": "load + 0.5"}, "cost": "3 - x"},
        {"action": "wait", "when": "x == 1", "then": {"x": "9223372036854775807 + x"}},
    ], "unsafe": "10 / (x - 3) == 7"}));
    let expected = [
        ("/dynamics/rules/0/then/x", ""),
        (
            "/dynamics/rules/0/then/fuel",
            "rule 0, column 1: this is -2, which is none of the values of \"fuel\", which are \"0\", \"2\", \"4\", in the state {\"x\":2",
        ),
        (
            "/dynamics/rules/1/when",
            "rule 1, column 4: a division by zero, in the state {\"x\":0,\"load\":0,\"heading\":\"east\",\"door\":\"shut\",\"fuel\":4}",
        ),
        (
            "/dynamics/rules/1/then/load",
            "rule 1, column 1: this is 1.5, which is none of the values of \"load\", which are 0 to 1",
        ),
    ];
    let faults = faults_of(&model);
    for (pointer, part) in expected.iter().skip(1) {
        let found = faults.iter().find(|(known, _)| known == pointer);
        assert!(found.is_some_and(|(_, detail)| detail.contains(part)), "{pointer}: {part} in {faults:#?}");
    }
}

#[test]
fn values_and_starts_are_checked() {
    let mut model = with(&json!({"start": [{"x": 9, "load": 0.1, "heading": "up", "door": "ajar", "speed": 1}, 3]}));
    model["attributes"] = json!([
        {"name": "x", "kind": "number", "values": {"from": 0, "to": 3}},
        {"name": "load", "kind": "number", "values": {"from": 0, "to": 1, "step": 0.3}},
        {"name": "heading", "kind": "cyclic", "labels": ["east", "west"], "values": ["east"]},
        {"name": "door", "kind": "category", "values": ["open", 1]},
        {"name": "fuel", "kind": "number", "weight": 2, "hidden": true},
        {"name": "far", "kind": "number", "values": {"from": 0, "to": 1e12}},
        {"name": "twice", "kind": "category", "values": ["a", "a"]},
    ]);
    let expected = [
        ("/attributes/4/weight", "hidden"),
        ("/attributes/1/values", "1 is not 0 and a whole number of steps of 0.3"),
        ("/attributes/2/values", "the values are the `labels`"),
        ("/attributes/3/values", "values of one type are needed"),
        ("/attributes/4/values", "is missing"),
        ("/attributes/5/values", "1 to 1048572 values (1048576 of all attributes)"),
        ("/attributes/6/values/1", "stands twice"),
        ("/dynamics/start/0/speed", "unknown attribute"),
        ("/dynamics/start/0/x", "none of the values of \"x\", which are 0 to 3"),
        ("/dynamics/start/0/far", "is missing"),
        ("/dynamics/start/0/fuel", "is missing"),
        ("/dynamics/start/0/twice", "is missing"),
        ("/dynamics/start/1", "expected a state"),
    ];
    let mut faults = faults_of(&model);
    faults.sort();
    let mut expected = expected.to_vec();
    expected.sort_unstable();
    for (pointer, part) in &expected {
        assert!(
            faults.iter().any(|(known, detail)| known == pointer && detail.contains(part)),
            "{pointer}: {part} in {faults:#?}"
        );
    }
    let mut unsafe_start = with(&json!({"unsafe": "door == 'shut'"}));
    assert_faults(&unsafe_start, &[("/dynamics/start", "unsafe")]);
    unsafe_start["dynamics"]["start"] = Value::Null;
    assert_faults(&unsafe_start, &[("/dynamics/start", "is missing")]);
}

#[test]
fn no_expression_takes_the_stack_or_the_time_of_its_reader() {
    let when = |when: String| with(&json!({"rules": [{"action": "go", "when": when}]}));
    for deep in ["(", "[", "!(", "-(", "size([", "walls.all(w, ", "x > 1 ? x : (", "{1: "] {
        let faults = faults_of(&when(deep.repeat(400)));
        assert!(!faults.is_empty(), "{deep}");
    }
    assert!(faults_of(&when(format!("x{} > 0", " + 1".repeat(900))))[0].1.contains("more than 200 operators"));
    assert!(faults_of(&when("x > 0 || ".repeat(500)))[0].1.contains("at most 4096 bytes"));
    let mut model = when("big.exists(a, big.exists(b, big.exists(c, a + b + c < 0)))".to_owned());
    model["dynamics"]["constants"] = json!({"big": vec![1; 2000]});
    assert!(faults_of(&model)[0].1.contains("take too long"));
}
