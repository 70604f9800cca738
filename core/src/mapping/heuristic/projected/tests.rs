//! Bounds against least costs by definition.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::{Meter, Uninterrupted};
use crate::mapping::by_definition::{
    any_conditions, compiled, distance, fitted, least_costs, moves, nodes, optimum, problem, with_conditions,
};
use crate::mapping::heuristic::projection::Projections;
use crate::model::StateIdx;

/// A model of up to 12 states and three attributes, of which some weigh nothing, and a demonstration.
fn model_and_demonstration() -> impl Strategy<Value = (Value, Value)> {
    (model_and_seen(), any_conditions()).prop_map(|((model, request), conditions)| {
        let request = with_conditions(request, &model, &conditions);
        (model, request)
    })
}

fn model_and_seen() -> impl Strategy<Value = (Value, Value)> {
    let weights = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
    let costs = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
    let row = || prop::array::uniform3(0u8..3);
    let seen = prop::array::uniform3(prop::option::weighted(0.8, 0u8..4));
    (2usize..12).prop_flat_map(move |n_states| {
        let ways = prop::collection::vec((0..n_states, 0usize..3, 0..n_states), 0..3 * n_states);
        let rows = prop::collection::vec(row(), n_states);
        (weights.clone(), costs.clone(), rows, ways, prop::collection::vec(seen.clone(), 1..6)).prop_map(
            |(weights, costs, rows, ways, seen)| {
                let ways = fitted(ways, rows.len());
                let attributes = ["a", "b", "c"].into_iter().zip(weights);
                let attributes =
                    attributes.map(|(name, weight)| json!({"name": name, "kind": "number", "weight": weight}));
                let actions = costs.iter().enumerate().map(|(n, cost)| json!({"name": format!("{n}"), "cost": cost}));
                let model = json!({
                    "attributes": attributes.collect::<Value>(), "actions": actions.collect::<Value>(),
                    "dynamics": {"kind": "table", "states": rows, "transitions": ways, "start": 0},
                });
                (model, json!({"model": "m", "demonstration": seen}))
            },
        )
    })
}

/// What a search takes a node to cost, alone and among its neighbours.
fn estimate_of(projected: &Projected<'_>, i: usize, row: &[u32]) -> Estimate {
    let classes: Vec<u32> = projected.classes(row).collect();
    let estimate = projected.estimate(i, &classes, || row);
    if projected.are_all_in_columns() {
        assert_eq!(projected.estimate_chunk(i - i % CHUNK_LEN, &classes)[i % CHUNK_LEN], estimate);
    }
    estimate
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn estimates_are_admissible_and_consistent((model, request) in model_and_demonstration()) {
        let model = compiled(&model);
        let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
        let problem = problem(&model, &request);
        let [from_start, to_end] = least_costs(&problem);
        let optimum = optimum(&problem, &from_start);
        let close = 1e-9 * (1.0 + optimum);

        let room = TableRoom::within(usize::MAX);
        let solved = Projected::solve(&projections, &problem, room, &mut TableBuffers::default(), &mut Uninterrupted).unwrap();
        let projected = solved.unwrap();
        // What no action changes is taken to be as it is at the start, so nothing is said of states that it does not lead to.
        let is_reached = |(i, state): &(usize, StateIdx)| from_start[*i][*state as usize].is_finite();
        for (i, state) in nodes(&problem).into_iter().filter(is_reached) {
            let estimate = estimate_of(&projected, i, problem.model.states().row(state));
            prop_assert!((estimate.distance - distance(&problem, i, state)).abs() <= close);
            let h = estimate.cost_to_go;
            prop_assert!(h <= to_end[i][state as usize] + close, "admissible at ({i}, {state})");
            for (next, to, cost) in moves(&problem, i, state) {
                let next_h = estimate_of(&projected, next, problem.model.states().row(to)).cost_to_go;
                prop_assert!(h <= cost + next_h + close, "consistent at ({i}, {state})");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    /// Problems one after the other in the same memory, of the same model.
    #[test]
    fn tables_of_small_problems_have_the_same_bits(
        (model, seen) in model_and_seen(),
        conditions in prop::collection::vec(any_conditions(), 3),
    ) {
        let document = model;
        let model = compiled(&document);
        let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
        let (room, mut tables) = (TableRoom::within(usize::MAX), LayerTables::default());
        for conditions in conditions {
            let mut request = with_conditions(seen.clone(), &document, &conditions);
            request["end_weight"] = json!(0);
            let problem = problem(&model, &request);
            let are_solved =
                tables.solve(&projections, &problem, room, &mut Meter::new(&mut Uninterrupted, 1)).unwrap();
            let projected = |max_small_entries| {
                let mut buffers = TableBuffers::default();
                let interrupt = &mut Uninterrupted;
                let solved =
                    Projected::solve_by(&projections, &problem, room, &mut buffers, max_small_entries, interrupt);
                solved.unwrap().unwrap()
            };
            prop_assert_eq!(format!("{:?}", projected(usize::MAX)), format!("{:?}", projected(0)));
            let projected = projected(0);
            prop_assert_eq!(are_solved, projected.are_all_in_columns());
            if !are_solved {
                continue;
            }
            prop_assert_eq!(tables.changing_columns(), projected.changing_columns());
            for (i, state) in nodes(&problem) {
                let row = problem.model.states().row(state);
                if !projected.speaks_of(row) {
                    continue;
                }
                let (entries, mut sum) = tables.at(i);
                tables.classes(row).for_each(|class| sum += entries[class as usize]);
                prop_assert_eq!(sum, estimate_of(&projected, i, row), "at ({}, {})", i, state);
                prop_assert_eq!(tables.cost_to_go(i, row), projected.cost_to_go(i, row));
            }
        }
    }
}

#[test]
fn tables_have_no_more_entries_than_allowed_however_short_the_demonstration() {
    let states: Value = (0..100).map(|n| json!([n, n % 7])).collect();
    let model = json!({
        "attributes": [{"name": "a", "kind": "number"}, {"name": "b", "kind": "number"}],
        "actions": [{"name": "go", "cost": 1}],
        "dynamics": {"kind": "table", "states": states, "transitions": [[0, "go", 1]], "start": 0},
    });
    let model = compiled(&model);
    let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
    let mut buffers = TableBuffers::default();
    for n_observations in [1, 2, 8, 9] {
        let request = json!({"model": "m", "demonstration": vec![json!({"a": 50, "b": 3}); n_observations]});
        let problem = problem(&model, &request);
        for max_entries in [0, 7, 107, 856, 1_000, 1_712] {
            let solved = Projected::solve(
                &projections,
                &problem,
                TableRoom::within(usize::MAX).at_first(max_entries),
                &mut buffers,
                &mut Uninterrupted,
            )
            .unwrap();
            let n_entries = solved.unwrap().table.n_entries();
            assert!(n_entries <= max_entries, "{n_entries}, not {max_entries}, of {n_observations} observations");
        }
    }
}

#[test]
fn buffers_of_other_problems_change_no_table() {
    let states: Value = (0..12).map(|n| json!([n % 4, n / 4])).collect();
    let ways: Value = (0..11).map(|n| json!([n, n % 2, n + 1])).collect();
    let model = json!({
        "attributes": [{"name": "a", "kind": "number"}, {"name": "b", "kind": "number"}],
        "actions": [{"name": "on", "cost": 1}, {"name": "far", "cost": 3}],
        "dynamics": {"kind": "table", "states": states, "transitions": ways, "start": 0},
    });
    let model = compiled(&model);
    let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
    let mut buffers = TableBuffers::default();
    for (a, b, n_observations) in [(1, 1, 5), (1, 0, 5), (0, 1, 9), (1, 1, 2), (2, 1, 2), (0, 0, 1), (1, 1, 5)] {
        let demonstration: Value = (0..n_observations).map(|i| json!({"a": i % 4, "b": 2})).collect();
        let request = json!({"model": "m", "demonstration": demonstration, "weights": {"a": a, "b": b}});
        let problem = problem(&model, &request);
        let table = |buffers| {
            let solved =
                Projected::solve(&projections, &problem, TableRoom::within(usize::MAX), buffers, &mut Uninterrupted);
            format!("{:?}", solved.unwrap().unwrap().table)
        };
        assert_eq!(table(&mut buffers), table(&mut TableBuffers::default()), "weights {a} and {b}");
    }
}
