use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::{Signal, Uninterrupted};
use crate::mapping::by_definition::{any_conditions, fitted, least_costs, optimum, prepared, problem, with_conditions};
use crate::mapping::heuristic::HeuristicName;
use crate::mapping::heuristic::abstraction::Abstractions;
use crate::mapping::heuristic::projected::MAX_ENTRIES;
use crate::mapping::mapper::Status;

/// A belt of places with a dial of ten at each, and a demonstration that turns it in a way that the body cannot.
fn belt(n_places: usize, n_observations: usize) -> (Mapper, Value) {
    let states: Value = (0..n_places * 10).map(|state| json!([state / 10, state % 10])).collect();
    let transitions = (0..n_places * 10).flat_map(|state| {
        let (place, dial) = (state / 10, state % 10);
        let on = (place + 1 < n_places).then(|| json!([state, "on", state + 10]));
        let back = (place > 0).then(|| json!([state, "back", state - 10]));
        on.into_iter().chain(back).chain([json!([state, "turn", place * 10 + (dial + 3) % 10])])
    });
    let model = json!({
        "attributes": [{"name": "place", "kind": "number"}, {"name": "dial", "kind": "cyclic", "period": 10}],
        "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}, {"name": "turn", "cost": 0.3}],
        "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions.collect::<Value>()},
    });
    let seen = (0..n_observations).map(|i| json!({"place": i % n_places, "dial": i * 2 % 10}));
    (prepared(&model), json!({"model": "belt", "demonstration": seen.collect::<Value>()}))
}

/// A body in a world of small numbers, and a demonstration. States look alike now and then, and actions may cost nothing.
fn wander() -> impl Strategy<Value = (Value, Value)> {
    let states = prop::collection::vec((0..6_u32, 0..4_u32, 0..3_u32), 5..60);
    let transitions = prop::collection::vec((0..60_usize, 0..3_usize, 0..60_usize), 10..200);
    let seen = (0..8_u32, prop::option::weighted(0.7, 0..4_u32), prop::option::weighted(0.7, 0..3_u32));
    let costs = prop_oneof![Just([0.0, 0.5, 2.0]), Just([0.3, 0.7, 1.1])];
    (states, transitions, prop::collection::vec(seen, 3..16), costs).prop_map(|(states, transitions, seen, costs)| {
        let transitions = fitted(transitions, states.len());
        let model = json!({
            "attributes": [
                {"name": "x", "kind": "number"},
                {"name": "y", "kind": "number", "weight": 2.5},
                {"name": "c", "kind": "category", "weight": 1.3},
            ],
            "actions": (0..3).map(|n| json!({"name": format!("a{n}"), "cost": costs[n]})).collect::<Value>(),
            "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
        });
        (model, json!({"model": "wander", "demonstration": seen}))
    })
}

/// Says to finish when it is asked for the `n`-th time.
fn finish_at(n: u64) -> impl FnMut() -> Signal {
    let mut n_left = n;
    move || {
        n_left = n_left.saturating_sub(1);
        if n_left > 0 { Signal::Continue } else { Signal::Finish }
    }
}

/// Whatever takes long is done as soon as may be.
const IMPATIENT: Patience = Patience {
    max_layered_nodes: 0,
    max_banded_expansions: 0,
    few_entries: 0,
    few_entries_per_observation: 8,
    entries_per_expansion: 16,
    min_expansions_before_abstraction: 10,
    nodes_per_expansion_before_abstraction: u64::MAX,
    states_per_class: 1,
    least_excess: 0.0,
    refine_below_extra_weight: 1.0,
    max_groups: 4,
    min_expansions_before_sweep: 40,
    nodes_per_expansion: u64::MAX,
};

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whatever_helps_a_long_search_leads_to_the_optimum_and_to_true_bounds(
        (model, request) in wander(),
        helps in prop_oneof![
            Just(Patience::DEFAULT),
            Just(Patience { max_layered_nodes: 0, ..Patience::DEFAULT }),
            Just(Patience { max_layered_nodes: 0, max_banded_expansions: 30, ..Patience::DEFAULT }),
            Just(IMPATIENT),
            Just(Patience { min_expansions_before_sweep: u64::MAX, ..IMPATIENT }),
        ],
        conditions in any_conditions(),
        few in 0..300_u64,
        looseness in prop_oneof![Just(None), Just(Some(1.0)), Just(Some(1.3))],
    ) {
        // Any attributes are taken together.
        let abstractions = Abstractions::coupling(vec![(0, 1), (1, 2)]);
        let mapper = Mapper { patience: helps, abstractions, ..prepared(&model) };
        let request = problem(mapper.model(), &with_conditions(request, &model, &conditions));
        let optimum = optimum(&request, &least_costs(&request)[0]);
        let close = |cost: f64| (cost - optimum).abs() <= 1e-9 * optimum;
        let settings = Settings { upper_bound: looseness.map(|factor| optimum * factor), ..Settings::default() };
        let map = |budget, interrupt: &mut dyn Interrupt| {
            mapper.map(&request, Settings { budget, ..settings }, interrupt).unwrap()
        };
        let is_true = |mapping: &Mapping| {
            let lower_bound = mapping.lower_bound.unwrap();
            lower_bound <= optimum * (1.0 + 1e-9)
                && optimum * (1.0 - 1e-9) <= mapping.cost.total
                && (mapping.status == Status::Bounded || close(mapping.cost.total))
        };

        let mapping = map(Budget::DEFAULT, &mut Uninterrupted);
        prop_assert!(mapping.status == Status::Optimal && close(mapping.cost.total), "{mapping:?}, not {optimum}");
        let max_bytes = mapper.search_bytes(&request, settings);
        prop_assert!(max_bytes < Budget::DEFAULT.max_bytes);
        let within = map(Budget { max_bytes, ..Budget::DEFAULT }, &mut Uninterrupted);
        prop_assert!(within.status == Status::Optimal && close(within.cost.total), "{within:?}, not {optimum}");
        let mapping = map(Budget { max_expansions: few, ..Budget::DEFAULT }, &mut Uninterrupted);
        prop_assert!(is_true(&mapping) && mapping.n_expanded <= few, "{mapping:?}, of {optimum} and {few}");
        let max_bytes = 64 * usize::try_from(few).unwrap();
        let mapping = map(Budget { max_bytes, ..Budget::DEFAULT }, &mut Uninterrupted);
        prop_assert!(is_true(&mapping), "{mapping:?}, of {optimum} in {max_bytes} bytes");
        let mapping = map(Budget::DEFAULT, &mut finish_at(few / 8));
        prop_assert!(is_true(&mapping), "{mapping:?}, of {optimum}");
    }
}

/// What is asked again and again of one mapper: a demonstration of this length, with these weights of the first two attributes, from
/// this state, within so many bytes.
fn variations() -> impl Strategy<Value = Vec<(usize, [f64; 2], usize, usize)>> {
    let length = prop_oneof![8 => 1..40_usize, 2 => prop::sample::select(vec![8, 9, 16, 17]), 1 => 255..300_usize];
    let weights = prop::array::uniform2(prop_oneof![Just(0.0), Just(1.0), 0.0..5.0]);
    let max_bytes = prop_oneof![Just(usize::MAX), 0..100_000_usize];
    prop::collection::vec((length, weights, 0..5_usize, max_bytes), 2..6)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_a_mapper_searched_before_makes_no_difference(
        (model, request) in wander(),
        variations in variations(),
        patience in prop::sample::select(vec![Patience::DEFAULT, Patience { max_layered_nodes: 0, ..Patience::DEFAULT }, IMPATIENT]),
    ) {
        let fresh = || Mapper { patience, ..prepared(&model) };
        let reused = fresh();
        let seen = request["demonstration"].as_array().unwrap();
        for (n_observations, [x, y], start, max_bytes) in variations.iter().chain(&variations) {
            let demonstration: Vec<&Value> = seen.iter().cycle().take(*n_observations).collect();
            let request = json!({
                "model": "any", "demonstration": demonstration, "weights": {"x": x, "y": y}, "start": start,
            });
            let settings = Settings { budget: Budget { max_bytes: *max_bytes, ..Budget::DEFAULT }, ..Settings::default() };
            let map = |mapper: &Mapper, settings| {
                mapper.map(&problem(mapper.model(), &request), settings, &mut Uninterrupted).unwrap()
            };
            let mapping = map(&reused, settings);
            prop_assert_eq!(&mapping, &map(&fresh(), settings));
            let without = Settings { heuristic: HeuristicName::None, ..Settings::default() };
            let optimum = map(&reused, without).cost.total;
            let is_least = (mapping.cost.total - optimum).abs() <= 1e-9 * optimum;
            prop_assert!(is_least || (*max_bytes < usize::MAX && mapping.status == Status::Bounded), "{mapping:?}, of {optimum}");
            prop_assert!(mapping.lower_bound.unwrap() <= optimum * (1.0 + 1e-9), "{mapping:?}, of {optimum}");
        }
    }
}

#[test]
fn a_state_with_thousands_of_ways_out_does_not_overrun_the_memory() {
    const N_WAYS: usize = 3_000;
    let actions: Value = (1..=N_WAYS).map(|n| json!({"name": format!("to {n}")})).collect();
    let transitions: Value = (1..=N_WAYS).map(|n| json!([0, format!("to {n}"), n])).collect();
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": actions,
        "dynamics": {
            "kind": "table", "states": (0..=N_WAYS).map(|n| [n]).collect::<Value>(), "transitions": transitions, "start": 0,
        },
    });
    let mapper = prepared(&model);
    let request = problem(mapper.model(), &json!({"model": "star", "demonstration": vec![json!({"x": 0}); 30]}));
    // Less than the nodes take that the first expansion finds.
    let settings = Settings { budget: Budget { max_bytes: 100 * N_WAYS, ..Budget::DEFAULT }, ..Settings::default() };
    assert_eq!(mapper.map(&request, settings, &mut Uninterrupted).unwrap().n_expanded, 1);
}

#[test]
fn tables_left_out_at_first_come_to_the_same_cost_as_a_search_without_heuristic() {
    // The places' table is too large for a first attempt, which is not enough.
    let (mapper, request) = belt(3_000, 30);
    let request = problem(mapper.model(), &request);
    let few_entries = Patience::DEFAULT.few_entries;
    let few = TableRoom::within(usize::MAX).at_first(few_entries);
    let few = mapper.solve(&request, few, &mut Uninterrupted);
    assert!(few.unwrap().unwrap().n_left_out() >= 90_000);
    let map = |heuristic| {
        let settings = Settings { heuristic, ..Settings::default() };
        mapper.map(&request, settings, &mut Uninterrupted).unwrap()
    };
    let (by_default, without) = (map(HeuristicName::Default), map(HeuristicName::None));
    assert_eq!((by_default.cost.total, by_default.status), (without.cost.total, Status::Optimal));

    // Cut short between the two attempts, it keeps what the first one found.
    let optimum = without.cost.total;
    for n_polls in 1..60 {
        let mapping = mapper.map(&request, Settings::default(), &mut finish_at(n_polls)).unwrap();
        let lower_bound = mapping.lower_bound.unwrap();
        assert!(lower_bound <= optimum + 1e-9 && optimum <= mapping.cost.total + 1e-9, "after {n_polls} polls");
    }
    for max_expansions in [0, 10, 1_000, 6_000, 10_000] {
        let settings = Settings { budget: Budget { max_expansions, ..Budget::DEFAULT }, ..Settings::default() };
        let mapping = mapper.map(&request, settings, &mut Uninterrupted).unwrap();
        assert!(mapping.n_expanded <= max_expansions && mapping.lower_bound.unwrap() <= optimum + 1e-9);
    }
}

#[test]
fn a_sweep_that_is_cut_short_raises_the_bound_and_counts() {
    let (mapper, request) = belt(60, 100);
    let patience = Patience {
        max_layered_nodes: 0,
        min_expansions_before_sweep: 10,
        nodes_per_expansion: u64::MAX,
        ..Patience::DEFAULT
    };
    let mapper = Mapper { patience, ..mapper };
    let request = problem(mapper.model(), &request);
    let map_until = |n| mapper.map(&request, Settings::default(), &mut finish_at(n)).unwrap();
    let optimum = mapper.map(&request, Settings::default(), &mut Uninterrupted).unwrap();
    assert_eq!(optimum.n_expanded, 10 + 600 * 100);
    let cut_short = |n| Some(map_until(n)).filter(|mapping| mapping.status == Status::Bounded);
    let swept: Vec<Mapping> = (1..1000).map_while(cut_short).filter(|mapping| mapping.n_expanded > 10).collect();
    assert!(swept.len() > 3, "{}", swept.len());
    let bounds: Vec<f64> = swept.iter().map(|mapping| mapping.lower_bound.unwrap()).collect();
    assert!(bounds.is_sorted() && bounds[0] < bounds[bounds.len() - 1], "{bounds:?}");
    assert!(bounds.iter().all(|bound| *bound <= optimum.cost.total), "{bounds:?}, of {:?}", optimum.cost);
    assert!(swept.iter().all(|mapping| (mapping.n_expanded - 10) % 600 == 0));
}

#[test]
fn a_long_search_whose_mappings_cost_far_more_than_attributes_tell_one_by_one_is_guided_by_attributes_taken_together() {
    // A yard with tins here and there, and a demonstration that picks up as many on its way through the middle.
    const SIDE: usize = 16;
    let places = [(2, 4), (5, 12), (8, 3), (11, 13), (14, 5)];
    let number = |x: usize, y: usize, tins: usize| (x * SIDE + y) * 32 + tins;
    let (mut states, mut transitions) = (Vec::new(), Vec::new());
    for from in 0..SIDE * SIDE * 32 {
        let (place, tins) = (from / 32, from % 32);
        let (x, y) = (place / SIDE, place % SIDE);
        states.push(json!([x, y, tins, tins.count_ones()]));
        let mut go = |name: &str, to: usize| transitions.push(json!([from, name, to]));
        (x + 1 < SIDE).then(|| go("east", number(x + 1, y, tins)));
        (x > 0).then(|| go("west", number(x - 1, y, tins)));
        (y + 1 < SIDE).then(|| go("north", number(x, y + 1, tins)));
        (y > 0).then(|| go("south", number(x, y - 1, tins)));
        let here = places.iter().position(|at| *at == (x, y)).filter(|tin| tins >> tin & 1 == 0);
        if let Some(tin) = here {
            go("take", number(x, y, tins | 1 << tin));
        }
    }
    let actions = ["east", "west", "north", "south", "take"].map(|name| json!({"name": name, "cost": 0.3}));
    let attribute = |name: &str, weight: f64| json!({"name": name, "kind": "number", "weight": weight});
    let mapper = prepared(&json!({
        "attributes": [attribute("x", 1.0), attribute("y", 1.0), attribute("which", 0.0), attribute("tins", 9.0)],
        "actions": actions,
        "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions},
    }));
    let seen = (0..45).map(|i| json!({"x": i / 3, "y": 8, "tins": i / 8}));
    let request = json!({"model": "yard", "demonstration": seen.collect::<Value>()});
    let map = |mapper: &Mapper, heuristic| {
        let settings = Settings { heuristic, ..Settings::default() };
        mapper.map(&problem(mapper.model(), &request), settings, &mut Uninterrupted).unwrap()
    };
    // In bands, it would not be long.
    let long = Patience { max_banded_expansions: 0, ..Patience::DEFAULT };
    let mapper = Mapper { patience: long, ..mapper };
    let guided = map(&mapper, HeuristicName::Default);
    let alone = Patience { least_excess: f64::INFINITY, ..long };
    let mapper = Mapper { patience: alone, ..mapper };
    let (alone, without) = (map(&mapper, HeuristicName::Default), map(&mapper, HeuristicName::None));
    assert!((guided.cost.total - without.cost.total).abs() < 1e-9 && guided.status == Status::Optimal);
    assert!(guided.n_expanded < alone.n_expanded / 2, "{} and {}", guided.n_expanded, alone.n_expanded);
}

#[test]
fn a_search_in_bands_comes_to_the_same_cost_as_best_first_with_few_more_expansions() {
    let (mapper, request) = belt(60, 100);
    let map = |mapper: &Mapper, n_observations: usize| {
        let seen = &request["demonstration"].as_array().unwrap()[..n_observations];
        let request = json!({"model": "belt", "demonstration": seen});
        mapper.map(&problem(mapper.model(), &request), Settings::default(), &mut Uninterrupted).unwrap()
    };
    let patience = Patience { max_layered_nodes: 0, ..Patience::DEFAULT };
    let mapper = Mapper { patience, ..mapper };
    let banded = [20, 60, 100].map(|n_observations| map(&mapper, n_observations));
    let mapper = Mapper { patience: Patience { max_banded_expansions: 0, ..patience }, ..mapper };
    for (banded, n_observations) in banded.iter().zip([20, 60, 100]) {
        let best_first = map(&mapper, n_observations);
        assert_eq!((banded.cost, banded.status), (best_first.cost, Status::Optimal));
        let [n_banded, n] = [banded, &best_first].map(|mapping| mapping.n_expanded);
        assert!(n_banded != n && n_banded < n + n / 2 + 12 * n_observations as u64, "{n_banded} and {n}");
    }
}

#[test]
fn an_upper_bound_below_the_optimum_proves_that_there_is_no_such_mapping() {
    let (mapper, request) = belt(6, 40);
    let request = problem(mapper.model(), &request);
    let optimum = mapper.map(&request, Settings::default(), &mut Uninterrupted).unwrap().cost.total;
    for factor in [0.0, 0.5, 0.99, 0.999_999] {
        let upper_bound = Some(optimum * factor);
        let settings = Settings { upper_bound, ..Settings::default() };
        let mapping = mapper.map(&request, settings, &mut Uninterrupted).unwrap();
        assert_eq!(mapping.status, Status::Bounded, "{factor}");
        assert!(mapping.lower_bound.unwrap() <= optimum && optimum <= mapping.cost.total, "{factor}: {mapping:?}");
        assert!(mapping.lower_bound.unwrap() >= optimum * factor);
    }
}

#[test]
fn a_small_search_that_is_cut_short_tells_what_its_open_nodes_cost_at_least() {
    let (mapper, request) = belt(60, 100);
    let request = problem(mapper.model(), &request);
    let optimum = mapper.map(&request, Settings::default(), &mut Uninterrupted).unwrap().cost.total;
    let map_until = |n| mapper.map(&request, Settings::default(), &mut finish_at(n)).unwrap();
    let mappings: Vec<Mapping> = (2..1000).map(map_until).take_while(|found| found.status == Status::Bounded).collect();
    assert!(mappings.len() > 3, "{}", mappings.len());
    for mapping in &mappings {
        let bound = mapping.lower_bound.unwrap();
        assert!(bound <= optimum && optimum <= mapping.cost.total, "{bound}, {optimum}, {}", mapping.cost.total);
    }
    let bounds: Vec<f64> = mappings.iter().map(|mapping| mapping.lower_bound.unwrap()).collect();
    // The start's alone would stay the same once there are estimates.
    let n_rises = bounds.windows(2).filter(|pair| pair[0] < pair[1]).count();
    assert!(bounds.is_sorted() && n_rises > 2, "{bounds:?}, {optimum}");
}

#[test]
fn a_search_goes_on_where_there_is_no_room_for_a_sweep_and_none_is_begun_that_would_take_too_many_expansions() {
    let (mapper, request) = belt(3_000, 30);
    let patience = Patience {
        few_entries: MAX_ENTRIES,
        min_expansions_before_sweep: 100,
        nodes_per_expansion: u64::MAX,
        ..Patience::DEFAULT
    };
    let mapper = Mapper { patience, ..mapper };
    let request = problem(mapper.model(), &request);
    let map = |budget| {
        let settings = Settings { budget, ..Settings::default() };
        mapper.map(&request, settings, &mut Uninterrupted).unwrap()
    };
    let swept = map(Budget::DEFAULT);
    assert_eq!((swept.status, swept.n_expanded), (Status::Optimal, 100 + 30_000 * 30));
    let searched = map(Budget { max_bytes: 98_000 * 64, ..Budget::DEFAULT });
    assert_eq!((searched.status, searched.cost.total), (Status::Optimal, swept.cost.total));
    assert!(searched.n_expanded < swept.n_expanded / 4, "a search alone: {}", searched.n_expanded);

    let n_all = swept.n_expanded;
    assert_eq!(map(Budget { max_expansions: n_all, ..Budget::DEFAULT }).n_expanded, n_all);
    let searched = map(Budget { max_expansions: n_all - 1, ..Budget::DEFAULT });
    assert!(searched.status == Status::Optimal && searched.n_expanded < 30_000, "{}", searched.n_expanded);
}
