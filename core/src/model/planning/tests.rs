//! Planning tasks by hand, and their operators.

use serde_json::{Value as Json, json};

use crate::interrupt::Uninterrupted;
use crate::model::{CompileError, Definition, Limits, Model};

fn task() -> Json {
    json!({
        "attributes": [{"name": "place", "kind": "category"}, {"name": "door", "kind": "category"}, {"name": "n", "kind": "number"}],
        "actions": [{"name": "go"}, {"name": "open", "cost": 0.5}, {"name": "reset"}],
        "dynamics": {
            "kind": "planning",
            "values": [["here", "there"], ["open", "shut"], [0, 1, 2.5]],
            "start": {"place": "here", "door": "shut", "n": 0},
            "operators": [
                {"action": "open", "when": {"door": "shut"}, "then": {"door": "open"},
                 "conditional": [{"when": {"n": 0}, "then": {"n": 1}}, {"when": {"n": 1}, "then": {"n": 2.5}}]},
                {"action": "go", "when": {"place": "here", "door": "open"}, "then": {"place": "there"}},
                {"action": "reset", "then": {"place": "here", "door": "shut"}},
            ],
        },
    })
}

fn definition(task: &Json) -> Definition {
    Definition::read(task, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

#[test]
fn operators_apply_where_their_needs_are_met_and_conditions_are_seen_from_before() {
    let model = Model::compile(&definition(&task()), Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let described = |state| serde_json::to_value(model.describe(state)).unwrap();
    // By hand: here shut 0 -> here open 1 -> there open 1; either is reset; here shut 1 -> here open 2.5, ..
    let ways: Vec<_> =
        model.graph().iter().map(|(from, way)| json!([from, model.action(way.action).name, way.to])).collect();
    assert_eq!(described(1), json!({"place": "here", "door": "open", "n": 1}));
    assert_eq!(
        Json::from(ways),
        json!([
            [0, "open", 1],
            [1, "go", 2],
            [1, "reset", 3],
            [2, "reset", 3],
            [3, "open", 4],
            [4, "go", 5],
            [4, "reset", 6],
            [5, "reset", 6],
            [6, "open", 4],
        ])
    );
}

#[test]
fn the_canonical_text_of_a_task_is_read_as_the_same_task() {
    let text = definition(&task()).text();
    let again = Definition::parse(text.as_bytes(), crate::model::Format::Json, Limits::DEFAULT, &mut Uninterrupted);
    assert_eq!(again.unwrap().text(), text);
}

#[test]
fn operators_allow_all_that_transitions_do() {
    let mut wide = task();
    // So many values that what `reset` changes is not told apart.
    wide["dynamics"]["values"][2] = (0..100).map(Json::from).collect();
    wide["dynamics"]["operators"][0]["conditional"] =
        (0..99).map(|n| json!({"when": {"n": n}, "then": {"n": n + 1}})).collect();
    wide["dynamics"]["operators"][2]["then"]["n"] = json!(7);
    for task in [task(), wide] {
        let definition = definition(&task);
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let lazy = Limits { max_states: 0, ..Limits::DEFAULT };
        let lazy = Model::compile(&definition, lazy, &mut Uninterrupted).unwrap();
        let domains: Vec<_> = (0..3).map(|at| lazy.states().domain(at).to_vec()).collect();
        let operators: Vec<_> = lazy.operators().unwrap().collect();
        for (from, way) in model.graph().iter() {
            let values = |state: u32| -> Vec<u32> {
                let values = model.states().values(state).zip(&domains);
                values.map(|(value, domain)| (0..).zip(domain).find(|(_, known)| *known == value).unwrap().0).collect()
            };
            let (before, after) = (values(from), values(way.to));
            for at in (0..3).filter(|at| before[*at] != after[*at]) {
                let allowed = operators.iter().any(|operator| {
                    let changes = |at: usize| operator.changed.iter().find(|(changed, _, _)| *changed == at);
                    let (from, to) = (before[at], after[at]);
                    operator.action == way.action
                        && changes(at).is_some_and(|(_, was, is)| (*was, *is) == (from, to))
                        && (0..3).all(|other| before[other] == after[other] || changes(other).is_some())
                });
                assert!(allowed, "{before:?} {after:?}");
            }
        }
    }
}

#[test]
fn what_is_no_task_is_told() {
    for (pointer, value, expected) in [
        ("/dynamics/values", json!([["here"]]), "/dynamics/values: expected 3 lists"),
        ("/dynamics/values/0", json!(["here", "here"]), "/dynamics/values/0/1: stands twice"),
        ("/dynamics/values/0", json!([]), "/dynamics/values/0: expected at least one value"),
        ("/dynamics/start", json!({"place": "here", "door": "shut"}), "/dynamics/start/n: is missing"),
        ("/dynamics/start/place", json!("nowhere"), "/dynamics/start/place: is none of the attribute's `values`"),
        (
            "/dynamics/operators/1/action",
            json!("open"),
            "/dynamics/operators/1/action: the action has an operator already: operator 0",
        ),
        ("/dynamics/operators/1/action", json!("jump"), "/dynamics/operators/1/action: expected one of the actions"),
        ("/dynamics/operators/1/when", json!({"x": 1}), "/dynamics/operators/1/when/x: unknown attribute"),
    ] {
        let mut task = task();
        *task.pointer_mut(pointer).unwrap() = value;
        match Definition::read(&task, Limits::DEFAULT, &mut Uninterrupted) {
            Err(CompileError::Faults(faults)) => assert!(faults.to_string().contains(expected), "{faults}"),
            other => panic!("{other:?}"),
        }
    }
}
