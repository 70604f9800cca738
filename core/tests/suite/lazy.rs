//! Worlds that are searched lazily, against the same worlds known in full.

use std::collections::HashMap;

use crate::problems::{cave, close, mapper, mapper_within, solve, walked};
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Budget, Policy, Request, Settings, Status};
use etude_core::model::{Act, Cave, CaveState, Definition, Limits};
use proptest::prelude::*;
use serde_json::{Value, json};

/// Nothing may be known beforehand.
const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };

fn cave_of(model: &Value) -> Cave {
    let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    definition.dynamics::<Cave>().unwrap().clone()
}

/// The values of a state, as they are written outside.
fn described(cave: &Cave, state: &CaveState) -> Vec<Scalar> {
    let n_taken = cave.gold().len() as u32 - state.lying.count_ones();
    let mut values = vec![
        Scalar::Integer(state.cell.0.into()),
        Scalar::Integer(state.cell.1.into()),
        Scalar::Text(state.heading.name().into()),
        Scalar::Integer(n_taken.into()),
        Scalar::Integer(state.arrows.into()),
        Scalar::Boolean(state.outside),
    ];
    let bits = |word: u64, n: usize| (0..n).map(move |k| Scalar::Boolean(word >> k & 1 == 1));
    values.extend(bits(state.alive, cave.wumpi().len()).chain(bits(state.lying, cave.gold().len())));
    values
}

fn values(state: &ByAttribute<Scalar>) -> Vec<Scalar> {
    state.iter().map(|(_, value)| value.clone()).collect()
}

/// Checks that the steps are what their actions do by the rules, from `first` on, and that states are numbered as they are passed.
fn check_legal(model: &Value, first: CaveState, policy: &Policy) {
    let cave = cave_of(model);
    let mut state = first;
    let mut numbers = HashMap::new();
    for step in &policy.steps {
        if let Some(action) = &step.action {
            let next = cave.after(state, Act::named(action).unwrap());
            assert!(next != state && !cave.is_deadly(&next), "step {}: {action} has no effect or kills", step.step);
            state = next;
        }
        assert_eq!(values(&step.state), described(&cave, &state), "step {}", step.step);
        let next = numbers.len() as u32;
        assert_eq!(step.state_index, *numbers.entry(state).or_insert(next), "step {}", step.step);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_lazy_search_proves_what_one_that_knows_everything_does(
        (model, walk) in cave(),
        max_expansions in 0u64..40,
        start in any::<prop::sample::Index>(),
    ) {
        let (known, lazy) = (mapper(&model), mapper_within(LAZY, &model));
        prop_assert!(lazy.model().is_lazy() && !known.model().is_lazy());
        let demonstration = walked(&model, &walk);
        let first = cave_of(&model).first_state();
        let request = json!({"model": "m", "demonstration": demonstration});
        let optimum = solve(&known, &request);
        for heuristic in ["default", "none"] {
            let mut request = request.clone();
            request["heuristic"] = heuristic.into();
            let policy = solve(&lazy, &request);
            check_legal(&model, first, &policy);
            prop_assert_eq!(policy.cost, optimum.cost);
            prop_assert_eq!((policy.status, policy.lower_bound), (Status::Optimal, optimum.lower_bound));
        }

        for heuristic in ["default", "none", "paper"] {
            let mut request = request.clone();
            request["heuristic"] = heuristic.into();
            request["max_expansions"] = max_expansions.into();
            let policy = solve(&lazy, &request);
            check_legal(&model, first, &policy);
            let bound = policy.lower_bound.unwrap();
            prop_assert!(bound <= optimum.cost.total * (1.0 + 1e-9), "{bound} above {}", optimum.cost.total);
            prop_assert!(optimum.cost.total <= policy.cost.total);
            prop_assert_eq!(policy.status == Status::Optimal, bound >= policy.cost.total);
        }

        // With a lookahead, as far as the budget lasts.
        for max_expansions in [None, Some(max_expansions)] {
            let mut request = request.clone();
            request["lookahead"] = 3.into();
            request["max_expansions"] = max_expansions.into();
            let policy = solve(&lazy, &request);
            check_legal(&model, first, &policy);
            prop_assert_eq!(policy.steps.last().unwrap().observation as usize + 1, walk.len() + 1);
            prop_assert!(optimum.cost.total <= policy.cost.total * (1.0 + 1e-9));
            prop_assert!(policy.search.stopped_by.is_none() || max_expansions.is_some_and(|most| policy.search.expanded <= most));
        }

        // From any other state, too.
        let state = start.index(known.model().states().len() as usize) as u32;
        let mut request = request;
        request["start"] = serde_json::to_value(known.model().describe(state)).unwrap();
        let (lazily, known) = (solve(&lazy, &request), solve(&known, &request));
        prop_assert_eq!(&lazily.steps[0].state, &known.steps[0].state);
        prop_assert!(close(lazily.cost.total, known.cost.total), "{} and {}", lazily.cost.total, known.cost.total);
    }
}

#[test]
fn a_start_that_the_models_own_does_not_lead_to_is_mapped_at_least_cost() {
    // The body cannot shoot, so the arrows stay as many as they are: two at the model's own start, none where it is asked for.
    let model = json!({
        "actions": [{"name": "forward"}, {"name": "turn_left"}],
        "dynamics": {"kind": "wumpus", "width": 5, "height": 3, "arrows": 2},
    });
    let lazy = mapper_within(LAZY, &model);
    let map = |heuristic| {
        let request = json!({
            "model": "m", "heuristic": heuristic,
            "start": {"x": 4, "y": 2, "heading": "south", "arrows": 0, "outside": false},
            "demonstration": [
                {"arrows": 2, "heading": "west", "x": 2, "y": 1},
                {"arrows": 0, "x": 3},
                {"arrows": 2, "heading": "west", "x": 2, "y": 0},
            ],
        });
        let policy = solve(&lazy, &request);
        (policy.cost.total, policy.status)
    };
    let ((by_default, status), (without, _)) = (map("default"), map("none"));
    assert!(close(by_default, without) && close(without, 20.3), "{by_default} and {without}");
    assert_eq!(status, Status::Optimal);
}

/// A cave of 3600 cells with 20 pieces of gold, that is more than 10^10 states, and what is seen of one who goes along the south wall and
/// takes what lies there.
fn large() -> (Value, Value) {
    let gold: Vec<[u16; 2]> = (0..20).map(|k| [3 * k + 1, if k % 2 == 0 { 0 } else { k }]).collect();
    let model = json!({
        "dynamics": {"kind": "wumpus", "width": 60, "height": 60, "gold": gold, "wumpi": [[40, 0]], "pits": [[5, 5]]},
    });
    let cave = cave_of(&model);
    let mut state = cave.first_state();
    let mut seen = vec![state];
    while seen.len() < 60 {
        let taken = cave.after(state, Act::Grab);
        state = if taken == state { cave.after(state, Act::Forward) } else { taken };
        seen.push(state);
    }
    let observed = seen.iter().map(|state| {
        let values = described(&cave, state);
        json!({"x": values[0], "y": values[1], "heading": values[2], "gold": values[3]})
    });
    (model.clone(), observed.collect())
}

#[test]
fn a_world_far_beyond_the_limit_is_mapped() {
    let (model, demonstration) = large();
    let mapper = mapper_within(Limits { max_states: 1000, ..Limits::DEFAULT }, &model);
    assert!(mapper.model().is_lazy());
    let first = cave_of(&model).first_state();

    let policy = solve(&mapper, &json!({"model": "m", "demonstration": demonstration.as_array().unwrap()[..40]}));
    check_legal(&model, first, &policy);
    assert_eq!((policy.status, policy.coverage.exact, policy.cost.distance), (Status::Optimal, 40, 0.0));
    assert!(close(policy.cost.actions, 0.3 * 39.0), "{}", policy.cost.actions);

    // It went through the live wumpus, and does so again and again.
    let hard: Value = demonstration.as_array().unwrap().iter().cycle().take(500).cloned().collect();
    for heuristic in ["default", "none", "paper"] {
        let request = json!({"model": "m", "demonstration": hard, "max_expansions": 200, "heuristic": heuristic});
        let policy = solve(&mapper, &request);
        check_legal(&model, first, &policy);
        assert_eq!((policy.status, policy.steps.last().unwrap().observation), (Status::Bounded, 499), "{heuristic}");
        assert!(policy.lower_bound.unwrap() < policy.cost.total, "{heuristic}");
        assert!(policy.search.expanded <= 200, "{heuristic}");
    }
}

#[test]
fn states_that_are_found_count_as_memory() {
    let (model, demonstration) = large();
    let mapper = mapper_within(LAZY, &model);
    let request = json!({"model": "m", "demonstration": demonstration});
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
    let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
    let expanded = |max_bytes| {
        let settings = Settings { budget: Budget { max_bytes, ..Budget::DEFAULT }, ..Settings::default() };
        let mapping = mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap();
        assert_eq!(mapping.moves.last().unwrap().observation, 59);
        (mapping.n_expanded, mapping.status)
    };
    assert_eq!(expanded(1).0, 0);
    // Beside what ways take.
    let (n_expanded, status) = expanded(6400 + 60 * 128);
    assert_eq!(status, Status::Bounded);
    assert!((1..50).contains(&n_expanded), "a state takes more than a node does: {n_expanded} expansions");
}

/// The faults of a request with this start, as their details.
fn start_faults(model: &Value, start: &Value) -> Vec<String> {
    let mapper = mapper_within(LAZY, model);
    let request = json!({"model": "m", "demonstration": [{"x": 0}], "start": start});
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
    Request::read(mapper.model(), &object, &mut faults);
    assert!(faults.listed().iter().all(|fault| fault.pointer == "/start"), "{faults}");
    faults.listed().iter().map(|fault| fault.detail.clone()).collect()
}

#[test]
fn a_start_is_named_by_its_values() {
    let model = json!({
        "dynamics": {"kind": "wumpus", "width": 5, "height": 1, "gold": [[1, 0]], "wumpi": [[3, 0]], "pits": [[4, 0]]},
    });
    let start = |x: i64, gold: Value, arrows: i64, wumpus: bool, outside: bool| {
        json!({
            "x": x, "y": 0, "heading": "west", "gold": gold, "arrows": arrows, "outside": outside,
            "wumpus_1": wumpus, "gold_1": true,
        })
    };
    for start in [json!(0), start(2, json!(0), 1, true, false), start(3, Value::Null, 0, false, false)] {
        assert!(start_faults(&model, &start).is_empty(), "{start}");
    }
    let impossible = [
        start(3, json!(0), 1, true, false),
        start(4, json!(0), 1, true, false),
        start(5, json!(0), 1, true, false),
        start(0, json!(1), 1, true, false),
        start(0, json!(0), 1, false, false),
        start(0, json!(0), 2, true, false),
        start(1, json!(0), 1, true, true),
    ];
    for start in impossible {
        assert_eq!(start_faults(&model, &start), ["no state of the model has these values"], "{start}");
    }
    let numbered = start_faults(&model, &json!(1));
    assert!(numbered[0].contains("its states have no numbers"), "{numbered:?}");
    let partial = start_faults(
        &model,
        &json!({"x": 1, "y": 0, "heading": "east", "arrows": 1, "wumpus_1": true, "gold_1": true}),
    );
    assert!(partial[0].ends_with("\"outside\" is missing"), "{partial:?}");
}
