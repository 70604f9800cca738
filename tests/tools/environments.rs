//! Gymnasium's own table of an environment.

use serde_json::Value;

use crate::{Tools, check};

#[test]
fn a_table_that_the_script_exports_is_the_environments_own() {
    let Some(tools) = Tools::installed("tables of Gymnasium") else { return };
    for (environment, settings, n_states) in [
        ("Taxi-v4", &[][..], 500),
        ("FrozenLake-v1", &[], 16),
        ("FrozenLake-v1", &["map_name=\"8x8\"", "is_slippery=false"], 64),
        ("CliffWalking-v1", &[], 48),
        ("CliffWalking-v1", &["is_slippery=true"], 48),
    ] {
        let set: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
        tools.run("examples/gymnasium/export.py", &[&[environment, "--out", "table.json"], &set[..]].concat());
        tools.run("tests/tools/environment.py", &[&["told.json", environment], settings].concat());
        // What a positive reward is replaced by is 1 in the script as well.
        let costs: &[&str] = match environment {
            "Taxi-v4" => &["--cost", "dropoff=1"],
            "FrozenLake-v1" => &["--cost", "*=1"],
            _ => &[],
        };
        let (model, told) = (tools.import("table.json", costs), tools.read("told.json"));
        assert_eq!(model["dynamics"]["states"].as_array().unwrap().len(), n_states);
        let cost = |earned: &Value| match environment {
            "FrozenLake-v1" => 1.0,
            _ => earned.as_f64().unwrap(),
        };
        check(&format!("{environment} {settings:?}"), &model, &told, cost);
        if crate::is_deterministic(&told) {
            let states: Vec<usize> = (0..12).map(|n| n * n_states / 13).collect();
            tools.check_mapping(&model, &states);
        }
    }
}

#[test]
fn the_tables_beside_the_script_are_those_that_it_exports() {
    let Some(tools) = Tools::installed("the tables of Gymnasium in examples") else { return };
    for (environment, file) in
        [("Taxi-v4", "taxi"), ("FrozenLake-v1", "frozen-lake"), ("CliffWalking-v1", "cliff-walking")]
    {
        tools.run("examples/gymnasium/export.py", &[environment, "--out", "table.json"]);
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
        let committed = std::fs::read_to_string(root.join(format!("examples/gymnasium/{file}.json"))).unwrap();
        assert!(committed == std::fs::read_to_string(tools.folder.path().join("table.json")).unwrap(), "{file}");
    }
}
