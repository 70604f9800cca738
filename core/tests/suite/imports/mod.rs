//! Files of other tools, against readers of these tests, which share no code with the library, and against the independent solver.

mod gymnasium;
mod mangled;
mod outcomes;
mod sas;
mod verification;

use std::io::Cursor;

use crate::oracle::optimal_cost;
use crate::problems::{close, example_bytes, mapper, solve};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Edits, ImportError, ImportFile, ImportFormat, Limits, import};
use outcomes::{Outcomes, millionths, outcomes};
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
