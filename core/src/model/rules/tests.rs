use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::Uninterrupted;
use crate::model::{Definition, Implicit, Limits, Model, Operator};

fn definition(model: &Value) -> Definition {
    Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

/// A body that shifts boxes along a line of `n` places, with conditions that read more than what changes.
fn shifting(n: u32, whens: &[&str]) -> Value {
    let place = |name: &str| json!({"name": name, "kind": "number", "values": {"from": 0, "to": n - 1}});
    let when = |k: usize| whens[k % whens.len()];
    json!({
        "attributes": [place("a"), place("b"), place("c"), {"name": "held", "kind": "category", "values": [false, true]}],
        "actions": [{"name": "shift"}, {"name": "take"}],
        "dynamics": {
            "kind": "rules", "start": {"a": 0, "b": 1, "c": 2, "held": false}, "unsafe": "a == b && b == c",
            "rules": [
                {"action": "shift", "when": when(0), "then": {"a": format!("(a + 1) % {n}"), "held": "!held"}},
                {"action": "shift", "when": when(1), "then": {"b": "c", "c": "b"}, "cost": "b > c ? 0.5 : 2.0"},
                {"action": "take", "when": when(2), "then": {"held": "a == b", "c": format!("math.least(c + 2, {})", n - 1)}},
            ],
        },
    })
}

/// Checks that the operators cover what a transition changes of the attributes that they tell, as [`Operator`] says.
fn assert_covered(
    (operators, is_told): (&[Operator], &[bool]),
    (action, cost): (ActionIdx, Option<f64>),
    (row, after): (&[u32], &[u32]),
    what: &str,
) {
    let changed: Vec<usize> = (0..row.len()).filter(|at| is_told[*at] && row[*at] != after[*at]).collect();
    for at in &changed {
        let found = operators.iter().any(|operator| {
            let changes = |at: &usize| operator.changed.iter().find(|(known, ..)| known == at);
            operator.action == action
                && changes(at).is_some_and(|(_, from, to)| (*from, *to) == (row[*at], after[*at]))
                && changed.iter().all(|at| changes(at).is_some())
                && operator.kept.iter().all(|(at, value)| row[*at] == *value && after[*at] == *value)
                && match (operator.cost, cost) {
                    (Some(least), Some(cost)) => least <= cost,
                    (None, None) => true,
                    _ => false,
                }
        });
        assert!(found, "{what}: {row:?} to {after:?}, attribute {at}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 30, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn operators_cover_every_transition_whatever_is_known_of_conditions(
        whens in prop::collection::vec(prop::sample::select(vec![
            "true", "a != c", "!held", "a + b + c < 7", "a in [1, 3] || b == 2", "[a, c] in [[0, 2], [1, 3], [2, 2]]",
        ]), 3),
    ) {
        let model = definition(&shifting(5, &whens));
        let rules = model.dynamics::<Rules>().unwrap();
        let compiled = Model::compile(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        for most in [u64::MAX, 60, 12] {
            let told = rules.plans_within(most);
            let operators: Vec<Operator> = rules.operators_by(&told).collect();
            for (from, transition) in compiled.graph().iter() {
                let mut outcomes = compiled.outcomes(from);
                let (action, outcome) = outcomes.find(|(action, outcome)| (*action, outcome.to) == (transition.action, transition.to)).unwrap();
                let rows = (compiled.states().row(from), compiled.states().row(transition.to));
                assert_covered((&operators, &told.is_told), (action, outcome.cost), rows, &format!("{most}, {whens:?}"));
            }
            // A dozen values are those of one place, or of one and whether it is held.
            let are_many = most > 12;
            assert_eq!(&told.is_told, &[true, are_many, are_many, are_many]);
        }
    }
}

#[test]
fn steps_of_a_domain_are_numbers_as_they_are_written() {
    let model = json!({
        "attributes": [{"name": "x", "kind": "number", "values": {"from": -0.3, "to": 0.9, "step": 0.1}}],
        "actions": [{"name": "up"}],
        "dynamics": {"kind": "rules", "start": {"x": 0.1}, "rules": [{"action": "up", "when": "x < 0.85", "then": {"x": "x + 0.1"}}]},
    });
    let model = Model::compile(&definition(&model), Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let values = (0..model.states().len()).map(|state| serde_json::to_string(&model.describe(state)).unwrap());
    let expected = (1..10).map(|n| format!(r#"{{"x":0.{n}}}"#));
    assert_eq!(values.collect::<Vec<_>>(), expected.collect::<Vec<_>>());
}

#[test]
fn a_search_takes_what_the_rules_take() {
    let model = definition(&shifting(5, &["true"]));
    let rules = model.dynamics::<Rules>().unwrap();
    assert!(Implicit::work(rules) >= 10 && Implicit::state_bytes(rules) >= 16, "{}", Implicit::work(rules));
}
