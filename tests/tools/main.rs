//! The tools themselves, as `PyPI` has them, against what is imported from them: Gymnasium, Storm, and the translator of Fast Downward.
//!
//! The core's tests read files that these tools have once written; here they write them anew, and say themselves what is in them. They are
//! installed, 70 MB, only with `ETUDE_TEST_TOOLS` in the environment, as in `.ci/run`. Elsewhere nothing is tested, which is said on standard error.

#![expect(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::too_many_lines,
    reason = "tests may panic and are read top to bottom, and numbers here are small"
)]

#[path = "../harness/mod.rs"]
mod harness;
#[path = "../../core/tests/suite/oracle/mod.rs"]
mod oracle;
#[path = "../../core/tests/suite/imports/outcomes.rs"]
mod outcomes;

mod environments;
mod planning;
mod verification;

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::harness::python::{install, run, say_untested};
use crate::outcomes::{Outcomes, millionths, outcomes};
use serde_json::{Value, json};

const PACKAGES: [&str; 3] = ["gymnasium==1.4.0", "stormpy==2.0.0", "fast-downward-translate==26.6.0"];

/// The tools, and a folder for what they make.
struct Tools {
    environment: PathBuf,
    folder: tempfile::TempDir,
}

impl Tools {
    /// `None`, and it is said why, where they are not wanted.
    fn installed(what: &str) -> Option<Self> {
        if std::env::var_os("ETUDE_TEST_TOOLS").is_none() {
            say_untested(what, "its tools (70 MB) are installed where ETUDE_TEST_TOOLS is set");
            return None;
        }
        let environment = install("tools", &PACKAGES).unwrap_or_else(|reason| panic!("{reason}"));
        Some(Self { environment, folder: tempfile::tempdir().unwrap() })
    }

    /// Runs a script of the repository.
    fn run(&self, script: &str, arguments: &[&str]) {
        let mut python = Command::new(self.environment.join("bin/python"));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(script);
        run(python.arg(script).args(arguments).current_dir(self.folder.path()))
            .unwrap_or_else(|error| panic!("{error}"));
    }

    fn read(&self, name: &str) -> Value {
        serde_json::from_slice(&std::fs::read(self.folder.path().join(name)).unwrap()).unwrap()
    }

    /// What `etude model import` makes of a file, with these flags.
    fn import(&self, file: &str, flags: &[&str]) -> Value {
        let mut etude = Command::new(env!("CARGO_BIN_EXE_etude"));
        etude.args(["model", "import", file, "--out", "imported.json"]).args(flags).current_dir(self.folder.path());
        run(&mut etude).unwrap_or_else(|error| panic!("{error}"));
        self.read("imported.json")
    }

    /// Checks that `etude map` finds what the independent solver does, where a demonstrator was seen in these states of a model, and its first attribute
    /// matters most.
    fn check_mapping(&self, model: &Value, states: &[usize]) {
        let demonstration: Vec<&Value> = states.iter().map(|state| &model["dynamics"]["states"][*state]).collect();
        let name = model["attributes"][0]["name"].as_str().unwrap();
        let request = json!({"demonstration": demonstration, "weights": {name: 3}});
        let path = |name: &str| self.folder.path().join(name);
        std::fs::write(path("mapped.json"), model.to_string()).unwrap();
        std::fs::write(path("request.json"), request.to_string()).unwrap();
        let mut etude = Command::new(env!("CARGO_BIN_EXE_etude"));
        etude.args(["map", "--json", "--model", "mapped.json", "--demonstration", "request.json"]);
        let mapped = run(etude.current_dir(self.folder.path())).unwrap_or_else(|error| panic!("{error}"));
        let policy: Value = serde_json::from_str(&mapped).unwrap();
        let (mapped, optimum) = (policy["cost"]["total"].as_f64().unwrap(), oracle::optimal_cost(model, &request));
        assert!(
            (mapped - optimum).abs() <= 1e-9 * (1.0 + optimum) && policy["status"] == "optimal",
            "{mapped} and {optimum}"
        );
    }
}

/// Checks a model against what its tool says: names and values, starts, and the outcomes of each action, whose cost is what `cost` makes of the
/// last member of a way.
fn check(what: &str, model: &Value, told: &Value, cost: impl Fn(&Value) -> f64) {
    let names = |attributes: &Value| -> Vec<String> {
        let name = |attribute: &Value| attribute["name"].as_str().or(attribute.as_str()).unwrap().to_owned();
        attributes.as_array().unwrap().iter().map(name).collect()
    };
    let rows = |names: &[String], states: &Value| -> Vec<Value> {
        let row = |state: &Value| names.iter().cloned().zip(state.as_array().unwrap().iter().cloned()).collect();
        states.as_array().unwrap().iter().map(row).collect()
    };
    let (own, expected) = (names(&model["attributes"]), names(&told["names"]));
    let (own, expected) = (rows(&own, &model["dynamics"]["states"]), rows(&expected, &told["states"]));
    assert_eq!(own, expected, "{what}");
    check_ways(what, model, told, cost);
}

/// As [`check`], without the values of states.
fn check_ways(what: &str, model: &Value, told: &Value, cost: impl Fn(&Value) -> f64) {
    let start = told["start"].as_array().unwrap();
    assert_eq!(model["dynamics"]["start"], if let [one] = &start[..] { one.clone() } else { json!(start) }, "{what}");
    let mut expected = Outcomes::new();
    for choice in told["choices"].as_array().unwrap() {
        let (from, ways) = (choice[0].as_u64().unwrap() as usize, choice[2].as_array().unwrap());
        let way = |way: &Value| {
            let to = way[0].as_u64().unwrap() as usize;
            let is_paid = ways.len() > 1 || to != from;
            (to, (millionths(way[1].as_f64().unwrap()), is_paid.then(|| millionths(cost(&way[2])))))
        };
        let is_new = expected.insert((from, choice[1].as_str().unwrap().to_owned()), ways.iter().map(way).collect());
        assert!(is_new.is_none(), "{what}: {choice}");
    }
    assert_eq!(outcomes(model), expected, "{what}");
}

/// Whether no action has several outcomes.
fn is_deterministic(told: &Value) -> bool {
    told["choices"].as_array().unwrap().iter().all(|choice| choice[2].as_array().unwrap().len() == 1)
}
