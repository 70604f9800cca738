//! Storm, which builds models of PRISM programs that others have written.

use std::path::Path;

use serde_json::Value;

use crate::{Tools, check, check_ways, is_deterministic};

/// What ways earn by a reward, or 1 if there is none.
fn earned(reward: Option<&str>) -> impl Fn(&Value) -> f64 {
    move |earned| reward.map_or(1.0, |reward| earned[reward].as_f64().unwrap())
}

#[test]
fn models_that_storm_builds_of_prism_programs_are_imported_as_it_says_them() {
    let Some(tools) = Tools::installed("models of Storm") else { return };
    tools.run("tests/tools/storm.py", &["programs", "."]);
    let (mut n_programs, mut n_mapped) = (0, 0);
    for entry in std::fs::read_dir(tools.folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap();
        if path.extension().is_none_or(|extension| extension != "drn") {
            continue;
        }
        n_programs += 1;
        let told = tools.read(&format!("{name}.json"));
        let rewards: Vec<&str> =
            told["rewards"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
        let rewards: Vec<Option<&str>> =
            if rewards.is_empty() { vec![None] } else { rewards.into_iter().map(Some).collect() };
        for reward in &rewards {
            for extension in ["drn", "umb"] {
                let file = format!("{name}.{extension}");
                // One without a name is called so.
                let cost = reward.filter(|_| rewards.len() > 1);
                let cost = cost.map(|reward| ["--cost", if reward.is_empty() { "default" } else { reward }]);
                let model = tools.import(&file, cost.as_ref().map_or(&[], |cost| &cost[..]));
                check(&file, &model, &told, earned(*reward));
                if is_deterministic(&told) {
                    n_mapped += 1;
                    let n_states = model["dynamics"]["states"].as_array().unwrap().len();
                    tools.check_mapping(&model, &[0, n_states / 2, n_states - 1, n_states / 3]);
                }
            }
        }
    }
    assert!(n_programs >= 25 && n_mapped >= 6, "{n_programs} and {n_mapped}");
}

#[test]
fn the_explicit_files_of_prism_are_what_storm_reads_in_them() {
    let Some(tools) = Tools::installed("explicit files of PRISM, read by Storm") else { return };
    let stem = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/verification/slippery");
    tools.run("tests/tools/storm.py", &["explicit", ".", stem.to_str().unwrap()]);
    let mut told = tools.read("explicit.json");
    let model = tools.import(stem.with_extension("tra").to_str().unwrap(), &[]);
    assert_eq!(told["counts"], serde_json::json!([20, 52, 67]));
    // Storm reads neither the names of actions nor the values of states, and numbers choices as the file does.
    let names = ["right", "left", "up", "open", "0"];
    let labels = std::fs::read_to_string(stem.with_extension("tra")).unwrap();
    let label = |state: u64, choice: &str| {
        let line = labels.lines().find(|line| line.starts_with(&format!("{state} {choice} "))).unwrap();
        line.split(' ').nth(4).unwrap_or("0").to_owned()
    };
    for choice in told["choices"].as_array_mut().unwrap() {
        let name = label(choice[0].as_u64().unwrap(), choice[1].as_str().unwrap());
        assert!(names.contains(&name.as_str()), "{name}");
        choice[1] = name.into();
    }
    check_ways("slippery.tra", &model, &told, earned(Some("")));
}

#[test]
fn the_models_beside_the_script_are_those_that_storm_writes() {
    let Some(tools) = Tools::installed("models of Storm in examples") else { return };
    tools.run("examples/verification/make.py", &["--out", "."]);
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/verification");
    for file in [
        "corridor.drn",
        "corridor.json",
        "slippery.drn",
        "slippery.json",
        "slippery.tra",
        "slippery.sta",
        "slippery.lab",
        "slippery.srew",
        "slippery.trew",
    ] {
        let [made, committed] =
            [tools.folder.path(), &examples].map(|folder| std::fs::read_to_string(folder.join(file)).unwrap());
        assert!(made == committed, "{file}");
    }
    // These say when they were made.
    for file in ["corridor.umb", "slippery.umb"] {
        let committed = tools.import(examples.join(file).to_str().unwrap(), &["--cost", "energy"]);
        assert!(tools.import(file, &["--cost", "energy"]) == committed, "{file}");
    }
}
