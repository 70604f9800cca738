//! Files of other tools, against readers of these tests, which share no code with the library, and against the independent solver.

mod gymnasium;
mod mangled;
mod sas;
mod verification;

use std::collections::BTreeMap;
use std::io::Cursor;

use crate::oracle::optimal_cost;
use crate::problems::{close, example_bytes, mapper, solve};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Edits, ImportError, ImportFile, ImportFormat, Limits, import};
use serde_json::Value;

fn file(name: &str, content: &[u8]) -> ImportFile<'static> {
    ImportFile { name: name.to_owned(), content: Box::new(Cursor::new(content.to_vec())) }
}

fn imported(format: ImportFormat, content: &[u8], edits: &Edits) -> Result<Definition, ImportError> {
    import(format, vec![file("", content)], edits, Limits::NONE, &mut Uninterrupted)
}

/// The model in a file of the examples, as JSON.
fn model(format: ImportFormat, path: &str, edits: &Edits) -> Value {
    let definition = imported(format, &example_bytes(path), edits).unwrap();
    serde_json::from_str(&definition.text()).unwrap()
}

/// What is told of a file that gives no model.
fn told(format: ImportFormat, content: &str) -> String {
    imported(format, content.as_bytes(), &Edits::default()).unwrap_err().to_string()
}

fn edits(without: &[&str], costs: &[&str]) -> Edits {
    let mut edits = Edits { without: without.iter().map(ToString::to_string).collect(), ..Edits::default() };
    for cost in costs {
        edits.add_cost(cost).unwrap();
    }
    edits
}

/// The outcomes of every state and action, by the state that they lead to: probability and cost, in millionths. A cost that is never paid is none.
type Outcomes = BTreeMap<(usize, String), BTreeMap<usize, (i64, Option<i64>)>>;

fn millionths(number: f64) -> i64 {
    (number * 1e6).round() as i64
}

fn outcomes(model: &Value) -> Outcomes {
    let mut outcomes = Outcomes::new();
    let cost_of = |name: &str| {
        let action = model["actions"].as_array().unwrap().iter().find(|action| action["name"] == name).unwrap();
        action["cost"].as_f64().unwrap()
    };
    for transition in model["dynamics"]["transitions"].as_array().unwrap() {
        let [from, to] = [0, 2].map(|end| transition[end].as_u64().unwrap() as usize);
        let name = transition[1].as_str().unwrap();
        let probability = transition[3].as_f64().unwrap_or(1.0);
        let cost = transition[4].as_f64().unwrap_or_else(|| cost_of(name));
        let cost = (from != to || probability < 1.0).then(|| millionths(cost));
        let entry = (millionths(probability), cost);
        assert!(outcomes.entry((from, name.to_owned())).or_default().insert(to, entry).is_none());
    }
    outcomes
}

/// The demonstration that goes through these states of a model.
fn through(model: &Value, states: &[usize]) -> Value {
    states.iter().map(|state| model["dynamics"]["states"][*state].clone()).collect()
}

/// Checks that a mapping costs what the independent solver finds.
fn check_optimal(model: &Value, request: &Value) -> f64 {
    let mapped = solve(&mapper(model), request).cost.total;
    let optimum = optimal_cost(model, request);
    assert!(close(mapped, optimum), "{mapped} and {optimum}");
    mapped
}
