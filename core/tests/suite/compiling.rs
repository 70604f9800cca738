//! What it takes to make models ready to be searched.

use etude_core::interrupt::{Cancelled, Interrupt, Signal, Uninterrupted};
use etude_core::mapping::Mapper;
use etude_core::model::{CompileError, Definition, Limits, Model};
use serde_json::{Value, json};

/// A line of states, of which each leads on to the next two; the attribute tells all of them apart.
fn line(n_states: usize) -> Value {
    let edges = (2..n_states).flat_map(|n| [json!([n - 2, "a", n - 1]), json!([n - 2, "b", n])]);
    json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "a"}, {"name": "b"}],
        "dynamics": {
            "kind": "table", "states": (0..n_states).map(|n| [n]).collect::<Vec<_>>(), "transitions": edges.collect::<Vec<_>>(),
        },
    })
}

fn read(definition: &Value) -> Definition {
    Definition::read(definition, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

fn compile(definition: &Definition, interrupt: &mut dyn Interrupt) -> Result<Mapper, CompileError> {
    let model = Model::compile(definition, Limits::DEFAULT, interrupt)?;
    Ok(Mapper::new(model, interrupt)?)
}

#[test]
fn compiling_asks_again_and_again_whether_to_go_on_and_has_no_result_if_its_time_is_up_before() {
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 30, "height": 30}});
    for definition in [line(30_000), cave] {
        let definition = read(&definition);
        let mut n_polls = 0_usize;
        let mut count = || {
            n_polls += 1;
            Signal::Continue
        };
        assert!(compile(&definition, &mut count).is_ok());
        assert!(n_polls > 10, "{n_polls}");
        let ends = [(Signal::Finish, CompileError::OutOfTime), (Signal::Cancel, CompileError::Cancelled(Cancelled))];
        for n in (1..=n_polls).step_by(n_polls / 10) {
            for (signal, expected) in ends.clone() {
                let mut n_left = n;
                let compiled = compile(&definition, &mut || {
                    n_left -= 1;
                    if n_left == 0 { signal } else { Signal::Continue }
                });
                assert_eq!(compiled.err().as_ref(), Some(&expected), "{n} of {n_polls}");
            }
        }
    }
}

#[test]
fn what_a_model_takes_is_foretold() {
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 20, "height": 20, "gold": [[5, 5], [6, 6]]}});
    let small = json!({"dynamics": {"kind": "wumpus", "width": 2, "height": 2}});
    for definition in [line(10_000), cave, small] {
        let model = Model::compile(&read(&definition), Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let counts = [model.graph().n_states(), model.n_transitions(), model.schema().len()].map(|n| n as u64);
        let foretold = Model::compiled_bytes(counts[0], counts[1], counts[2]);
        let n_bytes = Mapper::new(model, &mut Uninterrupted).unwrap().size_bytes() as u64;
        // Reading and compiling take about twice what is left.
        assert!((n_bytes..3 * n_bytes + (1 << 17)).contains(&foretold), "{foretold} for {n_bytes}");
    }
}

#[test]
fn what_does_not_fit_is_not_projected_and_changes_no_optimum() {
    let definition = read(&line(3000));
    let model = || Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let [whole, bounded] = [usize::MAX, model().size_bytes() + (1 << 17)]
        .map(|max_bytes| Mapper::within(model(), max_bytes, &mut Uninterrupted).unwrap());
    assert!(bounded.size_bytes() < whole.size_bytes());
    let total = |mapper: &Mapper| {
        let seen: Value = (0..100).map(|i| json!({"x": i * 3})).collect();
        let request = json!({"model": "line", "demonstration": seen});
        let mut faults = etude_core::document::Faults::default();
        let place = etude_core::document::Place::root(&request);
        let object = place.object(etude_core::mapping::Request::FIELDS, &mut faults).unwrap();
        let request = etude_core::mapping::Request::read(mapper.model(), &object, &mut faults).unwrap();
        let mapping = mapper.map(&request.problem, request.settings, &mut Uninterrupted).unwrap();
        (mapping.cost, mapping.status)
    };
    assert_eq!(total(&whole), total(&bounded));
}
