//! What a fuzz target makes of its bytes: `fuzz/fuzz_targets` and the tests that replay its corpus share this.

use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Signal, Uninterrupted};
use etude_core::mapping::{Mapper, Perception};
use etude_core::model::{Definition, Edits, ImportFile, ImportFormat, Limits, Model, Tally, import};
use serde_json::{Value, json};

/// As little as a service might allow.
const LIMITS: Limits = Limits { max_states: 1000, max_transitions: 10_000, max_values: 1 << 20, max_bytes: 1 << 22 };

/// A file of another tool. The first byte says which format the others are of. Whether there is a model in it.
pub(crate) fn read_import(bytes: &[u8]) -> Option<ImportFormat> {
    let (first, content) = bytes.split_first()?;
    let format = ImportFormat::ALL[usize::from(*first) % ImportFormat::ALL.len()];
    let mut edits = Edits::default();
    // So that files with several rewards get further.
    if first & 0x80 != 0 {
        edits.costs.push(("*".to_owned(), 1.0));
    }
    let file = ImportFile { name: String::new(), content: Box::new(content) };
    import(format, vec![file], &edits, LIMITS, &mut Uninterrupted).is_ok().then_some(format)
}

/// A model told by rules, as JSON. Whether it is one.
pub(crate) fn read_rules(bytes: &[u8]) -> bool {
    let Ok(document) = serde_json::from_slice::<Value>(bytes) else { return false };
    // Other dynamics have tests of their own.
    if document["dynamics"]["kind"] != "rules" {
        return false;
    }
    compile(&document)
}

/// A model of experience and what it is told, as JSON: one a line. How many batches are read; `None` if there is no such model.
pub(crate) fn read_experience(bytes: &[u8]) -> Option<usize> {
    let mut documents = bytes.split(|byte| *byte == b'\n').map(serde_json::from_slice::<Value>);
    let definition = Definition::read(&documents.next()?.ok()?, LIMITS, &mut Uninterrupted).ok()?;
    let mut tally = Tally::new(&definition)?;
    let read = |tally: &Tally, document: &Value| {
        let mut faults = Faults::default();
        let batch = tally.read_batch(&Place::root(document), &mut faults, &mut Uninterrupted).ok()??;
        tally.check(&batch, LIMITS, &mut faults);
        faults.is_empty().then_some(batch)
    };
    // The same lines, as if each were a transition.
    let rest = &bytes[bytes.iter().position(|byte| *byte == b'\n').map_or(bytes.len(), |end| end + 1)..];
    let mut faults = Faults::default();
    if let Ok(Some(batch)) = tally.read_lines("lines", rest, &mut faults, &mut Uninterrupted) {
        let again: Value = serde_json::from_str(&batch.text).expect("it is JSON");
        assert_eq!(read(&tally, &again).expect("it is a batch").text, batch.text);
        tally.add(&batch);
    }
    let mut n_read = 0;
    for document in documents.filter_map(Result::ok) {
        let Some(batch) = read(&tally, &document) else { continue };
        let again: Value = serde_json::from_str(&batch.text).expect("it is JSON");
        assert_eq!(read(&tally, &again).expect("it is a batch").text, batch.text);
        tally.add(&batch);
        n_read += 1;
    }
    if let Some(table) = tally.definition(&mut Uninterrupted).ok()? {
        let model = Model::compile(&table, LIMITS, &mut Uninterrupted).expect("a table compiles");
        let counts = tally.counts();
        assert_eq!((model.n_transitions(), model.n_stochastic()), (counts.n_transitions, counts.n_stochastic));
        assert_eq!((model.graph().n_states(), model.n_unsafe()), (counts.n_states, counts.n_unsafe));
    }
    Some(n_read)
}

/// Expressions, one a line: when a rule applies, what it gives three attributes, what it costs, and where the body must not be; and the same
/// expressions as what is observed of a demonstrator. Whether there is a model in it, and a perception.
pub(crate) fn read_expressions(bytes: &[u8]) -> (bool, bool) {
    let Ok(text) = std::str::from_utf8(bytes) else { return (false, false) };
    let mut lines = text.lines();
    let mut next = || lines.next().unwrap_or_default();
    let (when, number, half, door, cost, deadly) = (next(), next(), next(), next(), next(), next());
    let rules = json!({
        "attributes": [
            {"name": "n", "kind": "number", "values": {"from": -2, "to": 5}},
            {"name": "x", "kind": "number", "values": {"from": 0, "to": 3, "step": 0.5}},
            {"name": "door", "kind": "category", "values": ["open", "shut"]},
            {"name": "lit", "kind": "category", "values": [false, true]},
        ],
        "actions": [{"name": "go"}, {"name": "switch"}],
        "dynamics": {
            "kind": "rules", "start": {"n": 1, "x": 0.5, "door": "shut", "lit": false}, "unsafe": or(deadly, "false"),
            "constants": {"walls": [1, 3], "far": 2.5, "rooms": ["open", "shut", ""], "all": [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]},
            "rules": [
                {"action": "go", "when": or(when, "n >= 0"), "then": {"n": or(number, "(n + 1) % 6"), "x": or(half, "x"), "door": or(door, "door")}, "cost": or(cost, "1")},
                {"action": "switch", "then": {"lit": "!lit"}},
            ],
        },
    });
    let observe = json!({"n": or(number, "n"), "x": or(half, "x"), "door": or(door, "door"), "lit": or(when, "lit")});
    let mut faults = Faults::default();
    let perception = Perception::read(&Place::root(&observe), &mut faults);
    if let Some(perception) = &perception {
        let row = json!({"n": 3, "x": 1.5, "door": "open", "lit": true, "ranges": [1, 2.5, null], "arm": {"angle": 90}, "long": "a".repeat(500)});
        for state in [row, json!({"n": null, "x": "far"})] {
            let _ = perception.observe(&Place::root(&state), &mut faults);
        }
    }
    (compile(&rules), perception.is_some())
}

fn or<'t>(text: &'t str, default: &'t str) -> &'t str {
    if text.is_empty() { default } else { text }
}

/// Reads a model and compiles it, or finds at least that it is none; and has it searched lazily, if it is one.
fn compile(document: &Value) -> bool {
    let Ok(definition) = Definition::read(document, LIMITS, &mut Uninterrupted) else { return false };
    for max_states in [LIMITS.max_states, 0] {
        // Some take seconds, as they may.
        let mut n_polls = 0;
        let mut interrupt = || {
            n_polls += 1;
            if n_polls > 100 { Signal::Cancel } else { Signal::Continue }
        };
        let limits = Limits { max_states, ..LIMITS };
        let Ok(model) = Model::compile(&definition, limits, &mut interrupt) else { return false };
        let _ = Mapper::new(model, &mut interrupt);
    }
    true
}
