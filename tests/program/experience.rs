//! Models that the program makes of what was experienced.

use crate::commands::{run, text};
use serde_json::Value;

#[test]
fn a_log_becomes_a_table_without_a_service_and_each_batch_counts_once() {
    let (model, monday) = ("examples/explored/model.json", "examples/explored/monday.json");
    let once = run(&["model", "experience", model, monday]);
    assert!(once.status.success(), "{}", text(&once.stderr));
    let table: Value = serde_json::from_slice(&once.stdout).unwrap();
    assert_eq!(table["dynamics"]["kind"], "table");
    assert_eq!(table["dynamics"]["states"].as_array().unwrap().len(), 6);
    assert_eq!(run(&["model", "experience", model, monday, monday]).stdout, once.stdout);

    let directory = tempfile::tempdir().unwrap();
    let other = directory.path().join("other.json");
    std::fs::write(&other, r#"{"batch": "monday", "transitions": []}"#).unwrap();
    let told = |arguments: &[&str]| {
        let done = run(&[&["model", "experience"], arguments].concat());
        assert!(!done.status.success() && done.stdout.is_empty());
        text(&done.stderr).to_owned()
    };
    let other = other.to_str().unwrap();
    assert!(told(&[model, monday, other]).contains("another batch is called \"monday\" already"));
    assert!(told(&["examples/lift/model.json", monday]).contains("the kind of its dynamics is not `experience`"));
    let faulty = directory.path().join("faulty.json");
    std::fs::write(
        &faulty,
        r#"{"batch": "b", "transitions": [{"state": {"x": 0}, "action": "jump", "next": [0, "open"]}]}"#,
    )
    .unwrap();
    let faults = told(&[model, faulty.to_str().unwrap()]);
    assert!(faults.contains("/transitions/0/state/door") && faults.contains("/transitions/0/action"), "{faults}");
}

#[test]
fn a_log_of_lines_is_a_batch_that_is_called_as_its_file_compressed_or_not() {
    const DEFINITION: &str = "examples/explored/model.json";
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let log = std::fs::read("examples/explored/tuesday.jsonl").unwrap();
    let lines: Vec<Value> = text(&log).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let batch = serde_json::json!({"batch": "tuesday", "transitions": lines}).to_string();
    std::fs::write(path("batch.json"), &batch).unwrap();
    std::fs::write(path("log"), &log).unwrap();
    std::fs::write(path("tuesday.jsonl.zst"), zstd::bulk::compress(&log, 1).unwrap()).unwrap();
    std::fs::write(path("cut.ndjson"), [&log[..], b"\n{\"state\": {\"x\": 1}, \"action\": \"jump\"}\n{"].concat())
        .unwrap();
    let made = |file: &str| run(&["model", "experience", DEFINITION, file]);
    let expected = made(&path("batch.json")).stdout;
    assert!(!expected.is_empty());
    for file in [&path("tuesday.jsonl.zst"), &path("log"), "examples/explored/tuesday.jsonl"] {
        assert_eq!(text(&made(file).stdout), text(&expected), "{file}");
    }
    // Of the same name and content, it counts once.
    let twice = run(&["model", "experience", DEFINITION, &path("batch.json"), &path("tuesday.jsonl.zst")]);
    assert_eq!(twice.stdout, expected);
    let told = text(&made(&path("cut.ndjson")).stderr).to_owned();
    for expected in [
        "cut.ndjson has faults:",
        "line 5, /state/door: is missing",
        "line 5, /action: unknown action \"jump\"",
        "line 5, /next: is missing",
        "line 6, (document): not JSON at column ",
    ] {
        assert!(told.contains(expected), "{expected}: {told}");
    }
}

#[test]
fn rows_of_states_and_actions_are_the_transitions_between_them() {
    const DEFINITION: &str = "examples/explored/model.json";
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let made = |file: &str| run(&["model", "experience", DEFINITION, file]);
    let batch = serde_json::json!({"batch": "wednesday", "transitions": [
        {"state": [0.02, "shut"], "action": "forward", "next": [0.51, "shut"], "cost": 1.0},
        {"state": [0.51, "shut"], "action": "push", "next": [0.5, "open"]},
        {"state": [0.5, "open"], "action": "forward", "next": [1.02, "open"]},
        {"state": [2.98, "open"], "action": "forward", "next": [3.51, "open"], "cost": 1.3},
    ]});
    std::fs::write(path("batch.json"), batch.to_string()).unwrap();
    let done = made("examples/explored/wednesday.csv");
    assert_eq!(text(&done.stdout), text(&made(&path("batch.json")).stdout));
    let told = text(&done.stderr);
    assert!(told.contains("what is in \"time\" is no attribute of the model") && !told.contains("action"), "{told}");
    for (log, expected) in [
        ("x,door,action\n0,shut,forward\n", "log.csv: what the last action led to is not told"),
        (
            "x,door,action\n0,shut,forward\n0.5,shut,\n1,shut,jump\nfar,shut,\n",
            "line 4, /action: unknown action \"jump\"",
        ),
        (
            "x,door,action\n0,shut,forward\n0.5,shut,\n1,shut,jump\nfar,shut,\n",
            "line 4, /next/x: expected a number, found \"far\"",
        ),
        ("x,action\n0,forward\n1,\n", "line 2, /state/door: is missing"),
    ] {
        std::fs::write(path("log.csv"), log).unwrap();
        let done = made(&path("log.csv"));
        assert!(!done.status.success() && text(&done.stderr).contains(expected), "{expected}: {}", text(&done.stderr));
    }
}
