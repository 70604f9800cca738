//! Sweeps against least costs by definition.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::Uninterrupted;
use crate::mapping::by_definition::{any_conditions, compiled, fitted, least_costs, optimum, problem, with_conditions};
use crate::mapping::cost::{action_costs, cost_of};

/// A model of up to 14 states, and a demonstration. Actions may cost nothing, states look alike, and not all is observed, so that many
/// extra actions may follow each other.
fn model_and_demonstration() -> impl Strategy<Value = (Value, Value)> {
    (model_and_seen(), any_conditions()).prop_map(|((model, request), conditions)| {
        let request = with_conditions(request, &model, &conditions);
        (model, request)
    })
}

fn model_and_seen() -> impl Strategy<Value = (Value, Value)> {
    let costs = prop::array::uniform3(prop_oneof![Just(0.0), Just(0.1), 0.1..3.0]);
    let rows = prop::collection::vec((0..5u8, 0..3u8), 1..14);
    let ways = prop::collection::vec((0..14usize, 0..3usize, 0..14usize), 0..40);
    let seen = prop::collection::vec((prop::option::weighted(0.4, 0..6u8), prop::option::weighted(0.3, 0..3u8)), 1..14);
    (costs, rows, ways, seen).prop_map(|(costs, rows, ways, seen)| {
        let ways = fitted(ways, rows.len());
        let actions = costs.iter().enumerate().map(|(n, cost)| json!({"name": format!("a{n}"), "cost": cost}));
        let model = json!({
            "attributes": [{"name": "x", "kind": "number", "weight": 4}, {"name": "c", "kind": "category", "weight": 1.7}],
            "actions": actions.collect::<Value>(),
            "dynamics": {"kind": "table", "states": rows, "transitions": ways, "start": 0},
        });
        (model, json!({"model": "m", "demonstration": seen}))
    })
}

/// Whether each of `moves` leads on from the one before, and the last one to the end.
fn is_a_mapping(problem: &Problem<'_>, moves: &[Move]) -> bool {
    let leads_on = |pair: &[Move]| {
        let (before, after) = (pair[0], pair[1]);
        let is_there = problem
            .model
            .graph()
            .successors(before.state)
            .iter()
            .any(|transition| Some(transition.action) == after.action && transition.to == after.state);
        let n_advanced = after.observation - before.observation;
        match after.kind {
            MoveKind::Start => false,
            MoveKind::Skip => n_advanced == 1 && after.action.is_none() && after.state == before.state,
            MoveKind::Match => n_advanced == 1 && is_there,
            // What comes after a skip would have led there itself, for no more than the whole distance.
            MoveKind::Extra => {
                n_advanced == 0 && is_there && (problem.conditions.extra_weight < 1.0 || before.kind != MoveKind::Skip)
            }
        }
    };
    let is_start = |first: &Move| {
        let Move { kind, action, observation, state } = *first;
        kind == MoveKind::Start && action.is_none() && observation == 0 && problem.starts.states().contains(&state)
    };
    moves.first().is_some_and(is_start)
        && moves.windows(2).all(leads_on)
        && moves.last().is_some_and(|end| end.observation as usize == problem.last())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_sweep_in_sections_of_any_length_finds_the_cheapest_mapping((model, request) in model_and_demonstration()) {
        let model = compiled(&model);
        let problem = problem(&model, &request);
        let [from_start, _] = least_costs(&problem);
        let least = optimum(&problem, &from_start);
        let n_observations = problem.demonstration.len();
        for section_len in 1..=n_observations {
            let swept = in_sections(&problem, section_len, Meter::new(&mut Uninterrupted, 1)).unwrap();
            let Swept::Done(found) = swept else { panic!("{swept:?}") };
            prop_assert!(is_a_mapping(&problem, &found.paths[0]), "{:?}", found.paths);
            let moves = &found.paths[0];
            let costs = action_costs(&problem, &model.whole(), moves);
            let cost = cost_of(&problem, &model.whole(), moves, &costs).total;
            prop_assert!((cost - least).abs() <= 1e-9 * least.max(1.0), "{cost}, not {least}, in sections of {section_len}");
        }
    }
}

#[test]
fn sections_are_as_long_as_there_is_room_for_and_a_sweep_without_room_is_not_begun() {
    let states: Value = (0..100).map(|n| json!([n])).collect();
    let ways: Value = (0..99).map(|n| json!([n, 0, n + 1])).collect();
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "on"}],
        "dynamics": {"kind": "table", "states": states, "transitions": ways, "start": 0},
    });
    let model = compiled(&model);
    let request = json!({"model": "m", "demonstration": vec![json!({"x": 50}); 900]});
    let problem = problem(&model, &request);
    let within = |max_bytes| section_len(&problem, Budget { max_bytes, ..Budget::DEFAULT });
    let basis = Ways::bytes_for(model.graph()) + 8 * 100 * 8;
    assert_eq!(within(usize::MAX), Some(900));
    assert_eq!(within(basis + 100 * (8 + 900 * 2)), Some(900));
    assert_eq!(within(basis + 100 * (8 + 900 * 2) - 1), Some(450));
    let least = (1..=31).map(|n: usize| n * 8 + 900_usize.div_ceil(n) * 2).min().unwrap();
    assert!(within(basis + 100 * least).is_some_and(|len| len < 100));
    assert_eq!(within(basis + 100 * (least - 1)), None);
    assert_eq!(within(0), None);
    let too_small = Budget { max_bytes: basis, ..Budget::DEFAULT };
    assert!(matches!(sweep(&problem, too_small, &mut Uninterrupted), Ok(Swept::TooLarge)));
    assert!(matches!(sweep(&problem, Budget::DEFAULT, &mut || Signal::Cancel), Err(Cancelled)));
    let cut_short = sweep(&problem, Budget::DEFAULT, &mut || Signal::Finish);
    assert!(matches!(cut_short, Ok(Swept::CutShort { known: KnownLayer { observation: 899, .. }, n_expanded: 0, .. })));
}
