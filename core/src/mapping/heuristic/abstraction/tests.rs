//! Raised estimates against least costs by definition, however far the abstraction was searched.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::{Signal, Uninterrupted};
use crate::mapping::by_definition::{
    any_conditions, compiled, fitted, least_costs, moves, nodes, optimum, problem, with_conditions,
};
use crate::mapping::heuristic::Heuristic as _;
use crate::mapping::heuristic::projected::{TableBuffers, TableRoom};

/// A model of up to 12 states and three attributes, of which some weigh nothing, some transitions cost something of their own, and some states
/// are unsafe; a demonstration, and any conditions.
fn model_and_request() -> impl Strategy<Value = (Value, Value)> {
    let weights = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
    let costs = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
    let seen = prop::array::uniform3(prop::option::weighted(0.8, 0u8..4));
    let unsafe_states = prop::collection::vec(1usize..12, 0..2);
    let own_costs = prop::collection::vec(prop::option::weighted(0.3, 0.0..2.0), 36);
    let world = (2usize..12).prop_flat_map(move |n_states| {
        let ways = prop::collection::vec((0..n_states, 0usize..3, 0..n_states), 0..3 * n_states);
        (prop::collection::vec(prop::array::uniform3(0u8..3), n_states), ways)
    });
    (world, weights, costs, prop::collection::vec(seen, 1..6), unsafe_states, own_costs, any_conditions()).prop_map(
        |((rows, ways), weights, costs, seen, unsafe_states, own_costs, conditions)| {
            let attributes = ["a", "b", "c"].into_iter().zip(weights);
            let attributes = attributes.map(|(name, weight)| json!({"name": name, "kind": "number", "weight": weight}));
            let actions = costs.iter().enumerate().map(|(n, cost)| json!({"name": format!("{n}"), "cost": cost}));
            let ways = fitted(ways, rows.len()).into_iter().zip(own_costs);
            let ways = ways.map(|((from, action, to), own_cost)| json!([from, action, to, 1, own_cost]));
            let unsafe_states: Vec<usize> = unsafe_states.into_iter().filter(|state| *state < rows.len()).collect();
            let mut model = json!({
                "attributes": attributes.collect::<Value>(), "actions": actions.collect::<Value>(),
                "dynamics": {
                    "kind": "table", "states": rows, "transitions": ways.collect::<Value>(), "start": 0,
                    "unsafe": unsafe_states,
                },
            });
            let request = with_conditions(json!({"model": "m", "demonstration": seen}), &model, &conditions);
            let is_unsafe = |start: &Value| unsafe_states.iter().any(|state| json!(state) == *start);
            if request["start"].as_array().is_some_and(|starts| starts.iter().any(is_unsafe)) {
                model["dynamics"]["unsafe"] = json!([]);
            }
            (model, request)
        },
    )
}

/// Any group of two or three of three attributes.
fn group() -> impl Strategy<Value = Vec<usize>> {
    prop::sample::select(vec![vec![0, 1], vec![0, 2], vec![1, 2], vec![0, 1, 2]])
}

/// An abstraction of a problem, in memory in which others were searched before.
fn abstracted<'p>(
    abstraction: Abstraction,
    projections: &Projections,
    problem: &'p Problem<'p>,
    projected: &'p Projected<'p>,
    meter: &mut Meter<'_>,
) -> Abstracted<'p> {
    let abstraction = Arc::new(abstraction);
    let mut make =
        |costs| Abstracted::new(Arc::clone(&abstraction), projections, problem, projected, costs, meter).unwrap();
    let mut before = make(KnownCosts::default());
    before.settle(0, 0, f64::INFINITY, &mut Meter::new(&mut Uninterrupted, 1)).unwrap();
    make(before.into_costs())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn raised_estimates_are_admissible_and_consistent_and_those_of_settled_nodes_are_no_lower_later(
        (model, request) in model_and_request(),
        group in group(),
        settled in prop::collection::vec((0usize..6, 0u32..12, 0.0..1.2), 0..6),
    ) {
        let model = compiled(&model);
        let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
        let problem = problem(&model, &request);
        let [from_start, to_end] = least_costs(&problem);
        let optimum = optimum(&problem, &from_start);
        let close = 1e-9 * (1.0 + optimum);
        let room = TableRoom::within(usize::MAX);
        let solved = Projected::solve(&projections, &problem, room, &mut TableBuffers::default(), &mut Uninterrupted);
        let projected = solved.unwrap().unwrap();
        let mut interrupt = Uninterrupted;
        let meter = &mut Meter::new(&mut interrupt, 1);
        let abstraction = Abstraction::new(&model, &projections, group, usize::MAX, meter).unwrap().unwrap();
        let mut abstracted = abstracted(abstraction, &projections, &problem, &projected, meter);
        let row = |state| problem.model.states().row(state);
        let is_reached = |(i, state): &(usize, StateIdx)| from_start[*i][*state as usize].is_finite();
        let reached: Vec<(usize, StateIdx)> = nodes(&problem).into_iter().filter(is_reached).collect();
        let estimate = |abstracted: &Abstracted<'_>, i: usize, state: StateIdx| {
            projected.cost_to_go(i, row(state)) + abstracted.rise(state, i)
        };
        let mut before: Vec<f64> = reached.iter().map(|(i, state)| projected.cost_to_go(*i, row(*state))).collect();
        for (i, state, part) in std::iter::once((0, 0, 0.0)).chain(settled) {
            let (i, state) = (i.min(problem.last()), state % model.states().len());
            let f = part * optimum;
            let is_settled = abstracted.settle(state, i, f, meter).unwrap();
            let now: Vec<f64> = reached.iter().map(|(i, state)| estimate(&abstracted, *i, *state)).collect();
            for ((i, state), h) in reached.iter().zip(&now) {
                prop_assert!(*h <= to_end[*i][*state as usize] + close, "admissible at ({i}, {state})");
                for (next, to, cost) in moves(&problem, *i, *state) {
                    prop_assert!(*h <= cost + estimate(&abstracted, next, to) + close, "consistent at ({i}, {state})");
                }
            }
            prop_assert!(before.iter().zip(&now).all(|(before, now)| *before <= now + close));
            before = now;
            if from_start[i][state as usize].is_finite() {
                // Either it is known exactly, or that it costs more.
                let whole = from_start[i][state as usize] + estimate(&abstracted, i, state);
                let class = abstracted.abstraction.classes[state as usize] as usize;
                prop_assert_eq!(is_settled, abstracted.closed_cost(class, i).is_some());
                prop_assert!(is_settled || whole + close >= f || abstracted.open.is_empty());
            }
        }
    }

    #[test]
    fn a_group_of_all_attributes_knows_what_it_costs_to_go_on(
        (model, request) in model_and_request(),
        weights in prop::array::uniform3(0.1..3.0),
    ) {
        let mut request = request;
        request["weights"] = json!({"a": weights[0], "b": weights[1], "c": weights[2]});
        let model = compiled(&model);
        let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
        let problem = problem(&model, &request);
        let [from_start, _] = least_costs(&problem);
        let optimum = optimum(&problem, &from_start);
        // An attribute of one value has no table.
        prop_assume!((0..3).all(|position| model.states().domain(position).len() > 1));
        let room = TableRoom::within(usize::MAX);
        let solved = Projected::solve(&projections, &problem, room, &mut TableBuffers::default(), &mut Uninterrupted);
        let projected = solved.unwrap().unwrap();
        let mut interrupt = Uninterrupted;
        let meter = &mut Meter::new(&mut interrupt, 1);
        let abstraction = Abstraction::new(&model, &projections, vec![0, 1, 2], usize::MAX, meter).unwrap().unwrap();
        let mut abstracted = abstracted(abstraction, &projections, &problem, &projected, meter);
        let least = problem.starts.iter(problem.model).map(|(start, row)| {
            abstracted.settle(start, 0, f64::INFINITY, meter).unwrap();
            let class = abstracted.abstraction.classes[start as usize] as usize;
            problem.distances.distance(0, row) + abstracted.closed_cost(class, 0).unwrap_or(f64::INFINITY)
        });
        let least = least.fold(f64::INFINITY, f64::min);
        let rows: std::collections::HashSet<&[u32]> = (0..model.states().len()).map(|state| model.states().row(state)).collect();
        // A class has the ways of all states that look alike.
        let may_cost_less = rows.len() < model.states().len() as usize;
        let is_least = (least - optimum).abs() <= 1e-9 * (1.0 + optimum) || (may_cost_less && least < optimum);
        prop_assert!(is_least || (abstracted.open.is_empty() && least.is_infinite()), "{least}, not {optimum}");
    }
}

/// A yard of `side` by `side` places with three tins, each at a place of its own. A body that can pick up what is where it is.
fn yard(side: usize) -> (Value, Value) {
    let places = [(1, 2), (side - 1, 0), (0, side - 1)];
    let states: Vec<[usize; 6]> = (0..side * side * 8)
        .map(|n| {
            let (place, tins) = (n / 8, n % 8);
            let tin = |k: usize| tins >> k & 1;
            [place / side, place % side, tin(0), tin(1), tin(2), 3 - tin(0) - tin(1) - tin(2)]
        })
        .collect();
    let number = |x: usize, y: usize, tins: usize| (x * side + y) * 8 + tins;
    let mut transitions = Vec::new();
    for (from, [x, y, .., _]) in states.iter().enumerate() {
        let tins = from % 8;
        let mut go = |name: &str, to: usize| transitions.push(json!([from, name, to]));
        (x + 1 < side).then(|| go("east", number(x + 1, *y, tins)));
        (*x > 0).then(|| go("west", number(x - 1, *y, tins)));
        (y + 1 < side).then(|| go("north", number(*x, y + 1, tins)));
        (*y > 0).then(|| go("south", number(*x, y - 1, tins)));
        let here = places.iter().position(|place| *place == (*x, *y)).filter(|k| tins >> k & 1 == 1);
        if let Some(k) = here {
            go("take", number(*x, *y, tins & !(1 << k)));
        }
    }
    let number = |name: &str, weight: f64| json!({"name": name, "kind": "number", "weight": weight});
    let actions = ["east", "west", "north", "south", "take"].map(|name| json!({"name": name, "cost": 0.3}));
    let model = json!({
        "attributes": [number("x", 1.0), number("y", 1.0), number("tin_1", 0.0), number("tin_2", 0.0), number("tin_3", 0.0), number("tins", 9.0)],
        "actions": actions,
        "dynamics": {"kind": "table", "start": 7, "states": states, "transitions": transitions},
    });
    let seen = (0..8).map(|i| json!({"x": i, "y": 2, "tins": i.clamp(1, 3) - 1}));
    (model, json!({"model": "yard", "demonstration": seen.collect::<Value>(), "extra_weight": 0}))
}

fn room_for(max_classes: usize) -> AbstractionRoom {
    AbstractionRoom { n_tries: 4, max_classes, max_bytes: usize::MAX }
}

/// What solving gives, and the names of the group.
fn solve(model: &Model, request: &Value, max_classes: usize) -> Option<Vec<String>> {
    let projections = Projections::new(model, usize::MAX, &mut Uninterrupted).unwrap();
    let problem = problem(model, request);
    let room = TableRoom::within(usize::MAX);
    let solved = Projected::solve(&projections, &problem, room, &mut TableBuffers::default(), &mut Uninterrupted);
    let projected = solved.unwrap().unwrap();
    let mut interrupt = Uninterrupted;
    let meter = &mut Meter::new(&mut interrupt, 1);
    let abstractions = Abstractions::default();
    let solved = abstractions
        .solve(&projections, &problem, &projected, room_for(max_classes), &mut KnownCosts::default(), meter)
        .unwrap();
    assert_eq!(solved.is_some(), abstractions.size_bytes() > 0);
    let name = |position: &usize| model.schema().attributes()[*position].name.clone();
    solved.map(|abstracted| abstracted.abstraction.positions.iter().map(name).collect())
}

#[test]
fn a_group_has_what_changes_at_few_places_and_what_is_missed_on_the_cheapest_way_through_it() {
    let (model, request) = yard(8);
    let model = compiled(&model);
    // The tin at (1, 2) is on the way. It would be taken twice, if nobody looked which tins are left.
    assert_eq!(solve(&model, &request, usize::MAX).unwrap(), ["x", "y", "tin_1", "tins"]);
    // As far as there may be classes.
    assert_eq!(solve(&model, &request, 300).unwrap(), ["x", "y", "tins"]);
    assert_eq!(solve(&model, &request, 200), None);
    let mut without = request;
    without["weights"] = json!({"tins": 0});
    assert_eq!(solve(&model, &without, usize::MAX), None, "x and y are not coupled");
}

#[test]
fn solving_stops_when_it_is_told_to() {
    let (model, request) = yard(6);
    let model = compiled(&model);
    let projections = Projections::new(&model, usize::MAX, &mut Uninterrupted).unwrap();
    let problem = problem(&model, &request);
    let room = TableRoom::within(usize::MAX);
    let solved = Projected::solve(&projections, &problem, room, &mut TableBuffers::default(), &mut Uninterrupted);
    let projected = solved.unwrap().unwrap();
    let mut n_polls = 0;
    let solved_within = |n_left: u64, n_polls: &mut u64| {
        let mut left = n_left;
        let mut interrupt = || {
            *n_polls += 1;
            left = left.saturating_sub(1);
            if left > 0 { Signal::Continue } else { Signal::Finish }
        };
        let meter = &mut Meter::new(&mut interrupt, 64);
        Abstractions::default()
            .solve(&projections, &problem, &projected, room_for(usize::MAX), &mut KnownCosts::default(), meter)
            .map(|_| ())
    };
    assert_eq!(solved_within(u64::MAX, &mut n_polls), Ok(()));
    assert!(n_polls > 50, "{n_polls}");
    for n in (1..n_polls).step_by(7) {
        assert_eq!(solved_within(n, &mut 0), Err(Interrupted::OutOfTime), "after {n} polls");
    }
}
