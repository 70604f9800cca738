//! The table of a Gymnasium environment.

use std::collections::BTreeMap;

use super::{Outcomes, check_optimal, edits, imported, millionths, model, outcomes, through, told};
use crate::problems::example_bytes;
use etude_core::model::{Edits, ImportFormat, ReadError};
use serde_json::{Value, json};

/// The table of a file that `examples/gymnasium/export.py` wrote, by the words of Gymnasium's documentation.
fn gymnasium_outcomes(file: &Value, without: &[&str], cost: impl Fn(&str, f64) -> f64) -> Outcomes {
    let table = file["P"].as_object().unwrap();
    let mut ends = Vec::new();
    for outcome in table.values().flat_map(|actions| actions.as_object().unwrap().values()) {
        ends.extend(outcome.as_array().unwrap().iter().filter(|way| way[3] == true).map(|way| way[1].clone()));
    }
    let mut expected = Outcomes::new();
    for (state, actions) in
        table.iter().filter(|(state, _)| !ends.iter().any(|end| end == &json!(state.parse::<u64>().unwrap())))
    {
        for (action, ways) in actions.as_object().unwrap() {
            let name = file["actions"][action.parse::<usize>().unwrap()].as_str().unwrap();
            if without.contains(&name) {
                continue;
            }
            let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
            for way in ways.as_array().unwrap() {
                let probability = way[0].as_f64().unwrap();
                let sum = sums.entry(way[1].as_u64().unwrap() as usize).or_default();
                sum.0 += probability;
                sum.1 += probability * cost(name, way[2].as_f64().unwrap());
            }
            let from: usize = state.parse().unwrap();
            let is_paid = |to: usize| sums.len() > 1 || to != from;
            let sums = sums.iter().map(|(to, (probability, cost))| {
                (*to, (millionths(*probability), is_paid(*to).then(|| millionths(cost / probability))))
            });
            expected.insert((from, name.to_owned()), sums.collect());
        }
    }
    expected
}

#[test]
fn a_table_of_gymnasium_is_the_model_that_its_documentation_says() {
    let cases = [
        ("taxi", &["west"][..], &["dropoff=2.5"][..], 500, 0),
        ("frozen-lake", &[], &["*=0.5"], 16, 44),
        ("cliff-walking", &[], &[], 48, 0),
    ];
    for (name, without, costs, n_states, n_stochastic) in cases {
        let path = format!("gymnasium/{name}.json");
        let file: Value = serde_json::from_slice(&example_bytes(&path)).unwrap();
        let model = model(ImportFormat::Gymnasium, &path, &edits(without, costs));
        assert_eq!(model["dynamics"]["states"], file["states"], "{name}");
        let cost = |action: &str, reward: f64| match (name, action) {
            ("taxi", "dropoff") => 2.5,
            ("frozen-lake", _) => 0.5,
            _ => -reward,
        };
        let expected = gymnasium_outcomes(&file, without, cost);
        assert_eq!(outcomes(&model), expected, "{name}");
        let names: Vec<_> = model["attributes"].as_array().unwrap().iter().map(|own| own["name"].clone()).collect();
        assert_eq!(file["attributes"], Value::from(names));
        let n_several = expected.values().filter(|ways| ways.len() > 1).count();
        assert_eq!((file["states"].as_array().unwrap().len(), n_several), (n_states, n_stochastic), "{name}");
        let start = file["start"].as_array().unwrap();
        assert_eq!(model["dynamics"]["start"], if start.len() == 1 { start[0].clone() } else { start.clone().into() });
    }
}

#[test]
fn a_mapping_on_a_table_of_gymnasium_costs_what_the_independent_solver_finds() {
    let edits = edits(&["west"], &["dropoff=1"]);
    let taxi = model(ImportFormat::Gymnasium, "gymnasium/taxi.json", &edits);
    let demonstration = crate::problems::example("taxi/demonstration.json");
    check_optimal(&taxi, &json!({"model": "m", "demonstration": demonstration}));

    let cliff = model(ImportFormat::Gymnasium, "gymnasium/cliff-walking.json", &Edits::default());
    // Through the cliff, whose cells no body enters: it walks along.
    let demonstration = through(&cliff, &[36, 37, 38, 39, 40, 41, 42, 43, 44, 45, 46, 47]);
    let cost = check_optimal(&cliff, &json!({"model": "m", "demonstration": demonstration}));
    assert!(cost > 11.0, "{cost}");
}

#[test]
fn what_is_wrong_with_a_table_of_gymnasium_is_told_with_its_place() {
    let told = |content: &str| told(ImportFormat::Gymnasium, content);
    for (content, expected) in [
        ("", "line 1, column 0: EOF while parsing a value"),
        ("{\"0\": {\"0\": [[1, 0,", "line 1, column 19: EOF while parsing a value"),
        ("[[[[1, 0, -1, false]]]] 1", "line 1, column 25: trailing characters"),
        ("{\"format\": \"etude.gymnasium.v2\"}", "etude.gymnasium.v1 is read here"),
        ("{\"states\": [[0]]}", "there is no `P`"),
        ("{\"Q\": 1}", "unknown member \"Q\""),
        (
            "[[[[0.5, 0, 0, false], [0.4, 0, 0, false]]]]",
            "/P/0/0: the probabilities of state 0 and action \"0\" sum to 0.9, not to 1",
        ),
        ("[[[[1.5, 0, 0, false], [-0.5, 0, 0, false]]]]", "/P/0/0: 1.5 is no probability, from 0 to 1"),
        ("[[[[1, 7, 0, false]]]]", "/P/0/0: there is no state 7: there are 1, counted from 0"),
        (
            "[[[[1, 0, 0]]]]",
            "line 1, column 12: expected [probability, next state, reward, terminated], with `true` or `false` at its end, found nothing",
        ),
        ("[[[[1, \"zero\", 0, false]]]]", "with the index of its next state, found \"zero\""),
        ("[[[[null, 0, 0, false]]]]", "with a number as its probability, found null"),
        ("[[[[1, 0, [[]], false]]]]", "with a number as its reward, found an array of 1"),
        ("[[[[1, 0, 0, false, 1]]]]", "with nothing after these, found 1"),
        (
            "[[[7]]]",
            "line 1, column 5: expected for state 0 and action 0 an outcome [probability, next state, reward, terminated], found integer `7`",
        ),
        ("{\"dynamics\": {}}", "this is a model already, which need not be imported"),
        ("[[[]]]", "/P/0/0: the probabilities of state 0 and action \"0\" sum to 0, not to 1"),
        (
            "[[[[1, 0, 3, false]]]]",
            "/P/0/0: a reward of 3 is no cost; say by `cost` what the action costs, \"0=1\", or what all cost, \"*=1\"",
        ),
        ("{\"1\": {\"0\": [[1, 0, 0, false]]}}", "/P: state 0 is missing"),
        ("{\"0\": {}, \"0\": {}}", "/P/0: the state stands twice"),
        ("{\"0\": {\"0\": [[1, 0, 0, false]], \"0\": [[1, 0, 0, false]]}}", "/P/0/0: the action stands twice"),
        ("{\"P\": [[[[1, 0, 0, false]]]], \"states\": [[0], [1]]}", "expected 1 states, found 2"),
        ("{\"P\": [[[[1, 0, 0, false]]]], \"states\": [[0], [1, 2]]}", "/states/1: expected 1 values, found 2"),
        ("{\"P\": [[[[1, 0, 0, false]]]], \"states\": [[0]], \"attributes\": []}", "/attributes: expected 1, "),
        ("{\"P\": [[[[1, 0, 0, false]]]], \"actions\": []}", "/actions: 0 names, but `P` has 1 actions"),
        ("{\"P\": [[[[1, 0, 0, false]]]], \"start\": [1]}", "/start: 1 is no state: there are 1, counted from 0"),
        ("[]", "there are no states"),
    ] {
        let detail = told(content);
        assert!(detail.contains(expected), "{content}: {detail}");
    }
}

#[test]
fn sums_that_were_rounded_are_divided_and_what_never_happens_is_left_out() {
    let content =
        b"[[[[0.333333, 0, 0, false], [0.333333, 1, 0, false], [0.333333, 2, 0, false], [0, 9, 3, true]]], [[]], [[]]]";
    let short = imported(ImportFormat::Gymnasium, content, &Edits::default()).unwrap_err().to_string();
    assert!(short.starts_with("/P/1/0: the probabilities"), "{short}");
    let content =
        b"[[[[0.333333, 0, 0, false], [0.333333, 1, 0, false], [0.333333, 2, 0, false], [0, 1, 3, true]]], [], []]";
    let definition = imported(ImportFormat::Gymnasium, content, &Edits::default()).unwrap();
    let model: Value = serde_json::from_str(&definition.text()).unwrap();
    let sum: f64 =
        model["dynamics"]["transitions"].as_array().unwrap().iter().map(|way| way[3].as_f64().unwrap()).sum();
    assert!((sum - 1.0).abs() < 1e-12, "{sum}");
}

#[test]
fn a_body_lacks_actions_pays_otherwise_and_has_names_of_its_own() {
    let content = b"[[[[1, 1, -1, false]], [[1, 1, -2, false]]], [[[1, 0, -3, false]], [[1, 1, -1, true]]]]";
    let mut edits = edits(&["1"], &[]);
    edits.add_rename("0=on").unwrap();
    edits.add_rename("state=place").unwrap();
    let definition = imported(ImportFormat::Gymnasium, content, &edits).unwrap();
    let model: Value = serde_json::from_str(&definition.text()).unwrap();
    assert_eq!(model["attributes"][0]["name"], "place");
    assert_eq!(model["actions"], json!([{"name": "on", "cost": 1.0}]));
    assert_eq!(
        model["dynamics"]["transitions"],
        json!([[0, "on", 1]]),
        "nothing leaves the state that ends an episode"
    );
    for (wrong, expected) in [
        (Edits { without: vec!["slide *".into()], ..Edits::default() }, "no action is called like \"slide *\""),
        (Edits { rename: vec![("x".into(), "y".into())], ..Edits::default() }, "neither an action nor an attribute"),
        (Edits { rename: vec![("0".into(), "1".into())], ..Edits::default() }, "two actions are called \"1\""),
    ] {
        let detail = imported(ImportFormat::Gymnasium, content, &wrong).unwrap_err().to_string();
        assert!(detail.contains(expected), "{detail}");
    }
    assert!(edits.add_cost("on=-1").is_err() && edits.add_cost("on=x").is_err() && edits.add_rename("x").is_err());
}

#[test]
fn faults_of_files_become_faults_of_requests_with_their_places() {
    let failed = |content: &str| imported(ImportFormat::Gymnasium, content.as_bytes(), &Edits::default()).unwrap_err();
    let faults = |content: &str| match ReadError::from(failed(content)) {
        ReadError::Faults(faults) => faults.listed()[0].clone(),
        other => panic!("{other}"),
    };
    assert_eq!(faults("\n\n[3]").line, Some(3));
    assert_eq!(faults("[[[[1, 7, 0, false]]]]").pointer, "/P/0/0");
}

#[cfg(feature = "rules")]
#[test]
fn states_in_which_an_expression_holds_must_never_be_entered() {
    let path = "gymnasium/cliff-walking.json";
    let with = |texts: &[&str]| {
        let unsafe_if = texts.iter().map(ToString::to_string).collect();
        let edits = Edits { unsafe_if, rename: vec![("col".into(), "x".into())], ..Edits::default() };
        let definition = imported(ImportFormat::Gymnasium, &example_bytes(path), &edits);
        definition
            .map(|definition| serde_json::from_str::<Value>(&definition.text()).unwrap())
            .map_err(|error| error.to_string())
    };
    let model = with(&["row == 3 && x > 0 && x < 11", "x == 11 && row == 0"]).unwrap();
    assert_eq!(model["dynamics"]["unsafe"], json!([11, 37, 38, 39, 40, 41, 42, 43, 44, 45, 46]));
    for (text, expected) in [
        ("row = 3", "unsafe \"row = 3\": column"),
        ("col == 3", "unsafe \"col == 3\": column 1: unknown name"),
        ("row + 1", "unsafe \"row + 1\": expected bool, found int"),
        ("row == 3", "unsafe: state 36 is, where the body starts"),
        ("1 / row > 0", "unsafe \"1 / row > 0\": in state 0: "),
    ] {
        let told = with(&[text]).unwrap_err();
        assert!(told.starts_with(expected), "{text}: {told}");
    }
}
