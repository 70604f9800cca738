//! What transitions with costs and probabilities of their own come to.

use serde_json::{Value, json};

use crate::document::Faults;
use crate::interrupt::Uninterrupted;
use crate::model::{CompileError, Definition, Limits, Model, ModelBuilder, Outcome};

fn definition(transitions: &Value) -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "on", "cost": 0.5}, {"name": "back", "cost": 2}],
        "dynamics": {"kind": "table", "states": [[0], [1], [2], [3]], "transitions": transitions, "unsafe": [3]},
    })
}

fn read(transitions: &Value) -> Result<Definition, Faults> {
    Definition::read(&definition(transitions), Limits::DEFAULT, &mut Uninterrupted).map_err(|error| match error {
        CompileError::Faults(faults) => faults,
        error => panic!("{error}"),
    })
}

/// The transitions in canonical form.
fn written(transitions: &Value) -> Value {
    let definition: Value = serde_json::from_str(&read(transitions).unwrap().text()).unwrap();
    definition["dynamics"]["transitions"].clone()
}

fn compiled(transitions: &Value) -> Model {
    Model::compile(&read(transitions).unwrap(), Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

fn told(transitions: &Value) -> Vec<String> {
    let faults = read(transitions).unwrap_err();
    faults.listed().iter().map(|fault| format!("{}: {}", fault.pointer, fault.detail)).collect()
}

#[test]
fn a_transition_keeps_its_own_cost_wherever_it_stands() {
    let model = compiled(&json!([[1, "back", 0, null, 7], [1, "on", 2], [0, 0, 1, 1, 0.25]]));
    let outcomes = |state| model.outcomes(state).collect::<Vec<_>>();
    assert_eq!(outcomes(0), [(0, Outcome::certain(1).at_cost(0.25))]);
    assert_eq!(outcomes(1), [(0, Outcome::certain(2)), (1, Outcome::certain(0).at_cost(7.0))]);
    assert_eq!((model.n_stochastic(), model.n_transitions()), (0, 3));
    // One by one: an array of costs stands beside that of the transitions.
    let own_costs = model.graph().own_costs(1).iter().map(|cost| cost.or(0.5)).collect::<Vec<_>>();
    assert_eq!(own_costs, [0.5, 7.0]);
}

#[test]
fn what_says_nothing_new_is_left_out_of_the_canonical_text_and_so_of_the_hash() {
    let plain = json!([[0, "on", 1], [1, "back", 0]]);
    assert_eq!(written(&plain), plain);
    assert_eq!(written(&json!([[0, "on", 1, 1], [1, "back", 0, null, null]])), plain);
    assert_eq!(written(&json!([[0, "on", 1, 1.0, null], [1, "back", 0, 1]])), plain);
    // That of the action is new: it stays where a request gives the action another one.
    let own = json!([[0, "on", 1, 1.0, 0.5], [1, "back", 0]]);
    assert_eq!(written(&own), own);
    assert_ne!(read(&own).unwrap().text(), read(&plain).unwrap().text());
    let slippery = json!([[0, "on", 1, 0.75], [0, "on", 0, 0.25, 3.0], [1, "back", 0]]);
    assert_eq!(written(&slippery), slippery);
}

#[test]
fn entries_to_the_same_state_add_up_and_their_cost_is_the_mean_by_probability() {
    // As a slippery lake lists them: at an edge, two of three directions lead to the same cell.
    let third = 1.0 / 3.0;
    let lake =
        json!([[0, "on", 0, third], [0, "on", 1, third], [0, "on", 0, third], [1, "on", 2, 0.5], [1, "on", 2, 0.5]]);
    assert_eq!(written(&lake), json!([[0, "on", 0, 2.0 * third], [0, "on", 1, third], [1, "on", 2]]));
    let model = compiled(&lake);
    assert_eq!((model.n_stochastic(), model.n_transitions()), (1, 3));
    // Without effect, with a probability, it is an outcome like others.
    let outcomes: Vec<_> = model.outcomes(0).map(|(_, outcome)| (outcome.to, outcome.probability)).collect();
    assert_eq!(outcomes, [(0, 2.0 * third), (1, third)]);
    let costs = json!([[0, "on", 1, 0.5, 4], [0, "on", 1, 0.25], [0, "on", 2, 0.25]]);
    assert_eq!(written(&costs), json!([[0, "on", 1, 0.75, (0.5 * 4.0 + 0.25 * 0.5) / 0.75], [0, "on", 2, 0.25]]));
    // An unsafe outcome stays, so that it can be told from none.
    assert_eq!(compiled(&json!([[0, "on", 3, 0.5], [0, "on", 1, 0.5], [1, "on", 3]])).graph().n_transitions(), 2);
}

#[test]
fn probabilities_that_do_not_sum_to_1_are_told_with_their_sum() {
    let told =
        told(&json!([[0, "on", 1, 0.5], [1, "on", 0, 0.25], [1, "on", 2, 0.5], [2, "on", 0], [2, "on", 1, 0.5]]));
    assert_eq!(
        told,
        [
            "/dynamics/transitions/0: the probabilities of state 0 and this action sum to 0.5, not to 1",
            "/dynamics/transitions/1: the probabilities of state 1 and this action sum to 0.75, not to 1",
            "/dynamics/transitions/3: the probabilities of state 2 and this action sum to 1.5, not to 1",
        ]
    );
    assert!(read(&json!([[0, "on", 1, 0.333_333_333_3], [0, "on", 2, 0.666_666_666_7]])).is_ok());
    assert!(read(&json!([[0, "on", 1, 0.33], [0, "on", 2, 0.66]])).is_err());
}

#[test]
fn a_table_that_names_several_successors_without_probabilities_is_told_so_once() {
    let transitions: Vec<_> = (0..3).flat_map(|from| (0..4).map(move |to| json!([from, "on", to]))).collect();
    let told_of_many = told(&transitions.into());
    let [told_once] = &told_of_many[..] else { panic!("{told_of_many:?}") };
    let wanted = "/dynamics/transitions/1: state 0 has a transition by this action already: transition 0; there are 9 like \
                  this: transitions 1, 2, 3, ..; an action with several outcomes needs their probabilities: [from, action, to, probability]";
    assert_eq!(told_once, wanted);
    let told_of_one = told(&json!([[0, "on", 1], [0, "on", 2]]));
    assert!(told_of_one[0].contains("transition 0; an action with"), "{told_of_one:?}");
}

#[test]
fn what_is_no_probability_or_cost_is_told() {
    let told = told(&json!([
        [0, "on", 1, 0],
        [0, "back", 1, 1.5, -1],
        [1, "on", 0, "1", [2]],
        [1, "back", 0, 1, 1e151],
        [2, "on", 0, 1, 1, 1]
    ]));
    assert_eq!(
        told,
        [
            "/dynamics/transitions/0/3: expected a number above 0 and at most 1, found 0",
            "/dynamics/transitions/1/3: expected a number above 0 and at most 1, found 1.5",
            "/dynamics/transitions/1/4: expected a number from 0 to 1e150, found -1",
            "/dynamics/transitions/2/3: expected a number above 0 and at most 1, found \"1\"",
            "/dynamics/transitions/2/4: expected a number from 0 to 1e150, found an array of 1",
            "/dynamics/transitions/3/4: expected a number from 0 to 1e150, found 1e+151",
            "/dynamics/transitions/4: expected [from, action, to, probability, cost], of which the last two may be left out, \
             found an array of 6",
        ]
    );
}

#[test]
fn what_is_built_with_outcomes_is_what_is_read() {
    let mut builder = ModelBuilder::new(read(&json!([])).unwrap().schema().clone());
    let (on, back) = (builder.action("on", 0.5).unwrap(), builder.action("back", 2.0).unwrap());
    for x in 0..4 {
        builder.state([x.into()]).unwrap();
    }
    builder.forbid(3).unwrap();
    builder.outcome(1, on, Outcome::certain(2).with_probability(0.5).at_cost(4.0)).unwrap();
    builder.outcome(1, on, Outcome::certain(0).with_probability(0.25)).unwrap();
    builder.outcome(1, on, Outcome::certain(2).with_probability(0.25)).unwrap();
    builder.transition(1, back, 0).unwrap();
    let read = read(&json!([[1, "on", 2, 0.5, 4], [1, "on", 0, 0.25], [1, "on", 2, 0.25], [1, "back", 0]])).unwrap();
    assert_eq!(builder.definition().unwrap().text(), read.text());
}
