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
