//! The mapping against the independent solver and the published figures.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself, with few helpers.

use std::collections::HashMap;

use crate::oracle;
use crate::problems::{cave, close, example, mapper, mapper_within, problem, solve, walked};
use etude_core::attribute::Scalar;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Cancelled, Signal, Uninterrupted};
use etude_core::mapping::{
    Budget, Mapper, Mapping, MoveKind, Policy, Request, Settings, Stamp, Status, Step, StoppedBy,
};
use etude_core::model::Limits;
use proptest::prelude::*;
use serde_json::{Value, json};

/// Checks everything that a policy promises about itself, against the model's JSON (`table` dynamics) and the request.
fn check_policy(model: &Value, request: &Value, policy: &Policy) {
    let (dynamics, demonstration, weights) = (&model["dynamics"], &request["demonstration"], &request["weights"]);
    let costs: HashMap<&str, f64> = model["actions"]
        .as_array()
        .unwrap()
        .iter()
        .map(|action| (action["name"].as_str().unwrap(), action["cost"].as_f64().unwrap()))
        .collect();
    let action_cost = |from: u32, action: &str, to: u32| {
        let mut transitions = dynamics["transitions"].as_array().unwrap().iter();
        let taken = transitions.find(|t| t[0] == from && t[1] == action && t[2] == to);
        let lacks = request["without"].as_array().is_some_and(|without| without.contains(&json!(action)));
        let of_action = request["action_costs"][action].as_f64().unwrap_or(costs[action]);
        taken.filter(|_| !lacks).map(|taken| taken[4].as_f64().unwrap_or(of_action))
    };
    let is_unsafe = |state: u32| dynamics["unsafe"].as_array().is_some_and(|listed| listed.contains(&json!(state)));
    let distance = |step: &Step| {
        let state = &dynamics["states"][step.state_index as usize];
        oracle::distance(model, weights, &demonstration[step.observation as usize], state)
    };

    let steps = &policy.steps;
    let mut total = 0.0;
    for (n, step) in steps.iter().enumerate() {
        assert_eq!(step.step as usize, n);
        assert!(!is_unsafe(step.state_index), "step {n} enters an unsafe state");
        let part = if step.kind == MoveKind::Extra { request["extra_weight"].as_f64().unwrap_or(1.0) } else { 1.0 };
        let d = part * oracle::observation_weight(request, step.observation as usize) * distance(step);
        assert!(close(step.distance, d), "step {n}: distance {} is {d} by definition", step.distance);
        let explained: f64 = step.distance_by_attribute.iter().map(|(_, term)| term).sum();
        assert!(close(explained, d), "step {n}: the terms add up to {explained}, not {d}");
        if n == 0 {
            assert_eq!((step.kind, step.observation, &step.action), (MoveKind::Start, 0, &None));
            assert!(oracle::starts(model, request).contains(&(step.state_index as usize)));
        } else {
            let before = &steps[n - 1];
            let advance = step.observation - before.observation;
            match step.kind {
                MoveKind::Skip => {
                    assert_eq!((advance, step.state_index, &step.action), (1, before.state_index, &None));
                }
                kind => {
                    let action = step.action.as_deref().unwrap();
                    let cost = action_cost(before.state_index, action, step.state_index);
                    assert!(cost.is_some_and(|cost| close(step.action_cost, cost)), "step {n} is not legal");
                    assert_eq!(advance, u32::from(kind == MoveKind::Match));
                    assert_ne!(kind, MoveKind::Start);
                }
            }
        }
        total += step.action_cost + step.distance;
        assert!(close(step.cost, total), "step {n}: cumulative cost {} is not {total}", step.cost);
    }
    let last = steps.last().unwrap();
    let n_observations = demonstration.as_array().unwrap().len();
    assert_eq!(last.observation as usize, n_observations - 1, "the mapping ends at the last observation");
    assert!(close(policy.end.distance, distance(last)), "{:?}", policy.end);
    let explained: f64 = policy.end.distance_by_attribute.iter().map(|(_, term)| term).sum();
    assert!(close(explained, policy.end.distance));
    let end = oracle::end_weight(request) * distance(last);
    assert!(close(policy.cost.end, end), "the end costs {}, not {end}", policy.cost.end);
    assert!(close(last.cost + end, policy.cost.total));
    assert!(end > 0.0 || last.cost.to_bits() == policy.cost.total.to_bits());
    assert!(close(policy.cost.actions + policy.cost.distance + policy.cost.end, policy.cost.total));
    let exact: std::collections::BTreeSet<u32> =
        steps.iter().filter(|step| distance(step) == 0.0).map(|step| step.observation).collect();
    assert_eq!(policy.coverage.exact as usize, exact.len());
    assert_eq!(policy.coverage.observed as usize, n_observations);
    let taken: Vec<&str> = steps.iter().filter_map(|step| step.action.as_deref()).collect();
    assert_eq!(policy.actions.iter().map(|action| &**action).collect::<Vec<_>>(), taken);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn costs_equal_the_independent_solvers((model, mut request) in problem()) {
        let optimum = oracle::optimal_cost(&model, &request);
        let mapper = mapper(&model);
        for heuristic in ["default", "none"] {
            request["heuristic"] = heuristic.into();
            let policy = solve(&mapper, &request);
            prop_assert!(close(policy.cost.total, optimum), "{heuristic}: {} against {optimum}", policy.cost.total);
            prop_assert_eq!(policy.status, Status::Optimal);
            check_policy(&model, &request, &policy);
        }
    }

    #[test]
    fn a_budget_and_the_papers_heuristic_still_give_legal_mappings_and_true_bounds(
        (model, mut request) in problem(),
        max_expansions in 0u64..12,
        heuristic in prop_oneof![Just("default"), Just("none"), Just("paper")],
    ) {
        let optimum = oracle::optimal_cost(&model, &request);
        let mapper = mapper(&model);
        request["heuristic"] = heuristic.into();
        request["max_expansions"] = max_expansions.into();
        let policy = solve(&mapper, &request);
        check_policy(&model, &request, &policy);
        let bound = policy.lower_bound.unwrap();
        prop_assert!(bound <= optimum + 1e-9 * (1.0 + optimum), "bound {bound} above the optimum {optimum}");
        prop_assert!(optimum <= policy.cost.total + 1e-9 * (1.0 + optimum));
        prop_assert!(policy.search.expanded <= max_expansions);
        match policy.status {
            Status::Optimal => prop_assert!(close(policy.cost.total, optimum) && bound == policy.cost.total),
            Status::Bounded => prop_assert!(bound < policy.cost.total),
            Status::Local => prop_assert!(false, "nothing here is local"),
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_cave_is_the_table_of_its_rules((model, walk) in cave()) {
        let table = oracle::wumpus::as_table(&model);
        let (cave_mapper, table_mapper) = (mapper(&model), mapper(&table));
        let (a, b) = (cave_mapper.model(), table_mapper.model());
        prop_assert_eq!(a.graph().n_states(), b.graph().n_states());
        prop_assert!(a.graph().iter().eq(b.graph().iter()));
        prop_assert!((0..a.states().len()).all(|state| a.describe(state) == b.describe(state)));

        let demonstration = walked(&model, &walk);
        let request = json!({"model": "m", "demonstration": demonstration});
        let optimum = oracle::optimal_cost(&table, &request);
        let policy = solve(&cave_mapper, &request);
        prop_assert!(close(policy.cost.total, optimum), "{} against {optimum}", policy.cost.total);
        prop_assert_eq!(policy.status, Status::Optimal);
        check_policy(&table, &request, &policy);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn one_observation_far_off_does_not_hide_what_the_others_cost(
        seen in prop::collection::vec(0u32..12, 4..14),
        at in any::<prop::sample::Index>(),
        ways in prop::collection::btree_map((0usize..12, 0usize..2), 0usize..12, 8..24),
    ) {
        let transitions: Value = ways.iter().map(|((from, action), to)| json!([from, action, to])).collect();
        let states: Value = (0..12).map(|x| json!([x])).collect();
        let model = json!({
            "attributes": [{"name": "x", "kind": "number"}],
            "actions": [{"name": "a", "cost": 0.3}, {"name": "b", "cost": 1.1}],
            "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
        });
        let mut demonstration: Vec<Value> = seen.iter().map(|x| json!({"x": x})).collect();
        // A sensor that failed once: this observation alone costs 10^12, of which a float still tells thousandths.
        let far = at.index(seen.len());
        demonstration[far] = json!({"x": 1e6});
        let mapper = mapper(&model);
        let map = |heuristic| {
            let request = json!({"model": "m", "demonstration": demonstration, "heuristic": heuristic});
            solve(&mapper, &request).cost.total
        };
        let (by_default, without) = (map("default"), map("none"));
        prop_assert!((by_default - without).abs() < 0.05, "{by_default} and {without}");
    }
}

/// The policy for an example, checked against the solver.
fn example_policy(model: &str, demonstration: &str, weights: &Value) -> Policy {
    let (model, demonstration) = (example(model), example(demonstration));
    let request = json!({"model": "m", "demonstration": demonstration, "weights": weights});
    let policy = solve(&mapper(&model), &request);
    let table = if model["dynamics"]["kind"] == "wumpus" { oracle::wumpus::as_table(&model) } else { model };
    check_policy(&table, &request, &policy);
    assert!(close(policy.cost.total, oracle::optimal_cost(&table, &request)));
    policy
}

#[test]
fn the_figures_cost_what_was_published() {
    let cost =
        |model: &str, demonstration: &str, weights: &Value| example_policy(model, demonstration, weights).cost.total;
    assert_eq!(cost("figure-4/model.json", "figure-4/demonstration.json", &json!({})), 48.2);
    assert_eq!(cost("figure-6/model.json", "figure-6/demonstration.json", &json!({})), 10.0);
    assert_eq!(cost("figure-6/model.json", "figure-6/demonstration.json", &json!({"gold": 3})), 20.1);
    assert_eq!(cost("figure-8/model-l1.json", "figure-8/demonstration.json", &json!({})), 14.5);
    assert_eq!(cost("figure-8/model-l1.json", "figure-8/demonstration.json", &json!({"gold": 6})), 18.6);
}

#[test]
fn figure_4_goes_around_the_wumpus_and_takes_the_gold() {
    let policy = example_policy("figure-4/model.json", "figure-4/demonstration.json", &json!({}));
    assert_eq!((policy.cost.actions, policy.cost.distance), (7.2, 41.0));
    // From the shot on, the demonstrator has an arrow less than a body that cannot shoot.
    assert_eq!((policy.coverage.observed, policy.coverage.exact), (16, 1));
    assert!(policy.actions.iter().any(|action| &**action == "grab"));
    let at = |x: i64, y: i64| {
        let is_at = move |step: &&etude_core::mapping::Step| {
            step.state.get("x") == Some(&Scalar::Integer(x)) && step.state.get("y") == Some(&Scalar::Integer(y))
        };
        policy.steps.iter().filter(is_at).count()
    };
    assert_eq!((at(3, 0), at(3, 1) > 0, at(5, 0) > 0), (0, true, true));
}

#[test]
fn a_long_search_is_cut_short_wherever_it_is() {
    let request = long_request(2_000, &json!({}));
    let mapper = mapper(&example("figure-4/model.json"));
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
    let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
    let settings = request.settings;
    let map_until = |n: u32, signal: Signal| {
        let mut n_polls = 0;
        let mut interrupt = || {
            n_polls += 1;
            if n_polls >= n { signal } else { Signal::Continue }
        };
        let mapping = mapper.map(&request.problem, settings, &mut interrupt);
        (n_polls, mapping)
    };
    let (n_polls, optimal) = map_until(u32::MAX, Signal::Continue);
    let optimal = optimal.unwrap();
    assert_eq!(optimal.status, Status::Optimal);
    for n in (1..n_polls).step_by((n_polls as usize / 40).max(1)) {
        let (_, mapping) = map_until(n, Signal::Finish);
        let mapping = mapping.unwrap();
        assert!(mapping.lower_bound.unwrap() <= optimal.cost.total * (1.0 + 1e-9));
        assert!(optimal.cost.total <= mapping.cost.total * (1.0 + 1e-9));
        assert_eq!(mapping.moves.last().unwrap().observation, 1_999);
        let (n_cancelled, mapping) = map_until(n, Signal::Cancel);
        assert_eq!((n_cancelled, mapping.err()), (n, Some(Cancelled)));
    }
}

#[test]
fn a_taxi_that_cannot_drive_west_fetches_the_passenger_and_stays() {
    let demonstration = "taxi/demonstration.json";
    let own = example_policy("taxi/model.json", demonstration, &json!({}));
    assert_eq!((own.cost.total, own.cost.distance), (5.4, 0.0));
    let no_west = example_policy("taxi/no-west.json", demonstration, &json!({}));
    assert_eq!((no_west.cost.total, no_west.cost.actions), (71.9, 3.9));
    let costly = example_policy("taxi/costly-pickup.json", demonstration, &json!({}));
    assert_eq!((costly.cost.total, costly.cost.distance), (8.1, 0.0));
}

#[test]
fn the_demonstrations_are_what_the_demonstrators_actions_do() {
    let cases = [
        ("figure-4/demonstrator.json", "figure-4/demonstration.json", "SFFFFFGLLFFFFFC"),
        ("figure-6/demonstrator.json", "figure-6/demonstration.json", "SFFFGLLFFFC"),
        ("figure-8/demonstrator-l1.json", "figure-8/demonstration.json", "FFLFFFGLLFFFRFFC"),
        ("figure-8/demonstrator-l2.json", "figure-8/demonstration.json", "FFLFFFGLLFFFRFFC"),
        ("figure-8/demonstrator-l3.json", "figure-8/demonstration.json", "FFLFFFGLLFFFRFFC"),
        ("figure-8/demonstrator-l4.json", "figure-8/demonstration.json", "FFLFFFGLLFFFRFFC"),
    ];
    for (model, demonstration, acts) in cases {
        let table = oracle::wumpus::as_table(&example(model));
        let demonstration = example(demonstration);
        let names: Vec<&str> =
            table["attributes"].as_array().unwrap().iter().map(|a| a["name"].as_str().unwrap()).collect();
        let mut at = json!(0);
        for (n, observation) in demonstration.as_array().unwrap().iter().enumerate() {
            if n > 0 {
                let act = acts.as_bytes()[n - 1];
                let name = match act {
                    b'F' => "forward",
                    b'L' => "turn_left",
                    b'R' => "turn_right",
                    b'S' => "shoot",
                    b'G' => "grab",
                    _ => "climb",
                };
                let transitions = table["dynamics"]["transitions"].as_array().unwrap();
                let taken = transitions.iter().find(|t| t[0] == at && t[1] == name).unwrap();
                at = taken[2].clone();
            }
            let state = &table["dynamics"]["states"][at.as_u64().unwrap() as usize];
            for (k, name) in names.iter().enumerate().filter(|(_, name)| !observation[**name].is_null()) {
                assert_eq!(observation[*name], state[k], "{model}: observation {n}, {name}");
            }
        }
        assert_eq!(demonstration.as_array().unwrap().len(), acts.len() + 1);
    }
}

#[test]
fn the_papers_heuristic_misses_the_optimum_of_figure_8_at_l3() {
    let mapper = mapper(&example("figure-8/model-l3.json"));
    let request = |heuristic: &str| json!({"model": "m", "demonstration": example("figure-8/demonstration.json"), "heuristic": heuristic});
    let optimal = solve(&mapper, &request("default"));
    assert_eq!((optimal.cost.total, optimal.status), (14.4, Status::Optimal));
    let paper = solve(&mapper, &request("paper"));
    assert_eq!((paper.cost.total, paper.status), (14.5, Status::Bounded));
    assert!(paper.lower_bound.unwrap() <= optimal.cost.total);
}

/// A demonstration that goes through figure 4 again and again, to be followed as `options` say.
fn long_request(n_observations: usize, options: &Value) -> Value {
    let demonstration = example("figure-4/demonstration.json");
    let demonstration: Vec<Value> =
        demonstration.as_array().unwrap().iter().cycle().take(n_observations).cloned().collect();
    let mut request = json!({"model": "m", "demonstration": demonstration});
    request.as_object_mut().unwrap().extend(options.as_object().unwrap().clone());
    request
}

/// Maps, giving the `n`-th poll and all later ones `signal`. Gives the number of polls, and the mapping.
fn map_until(request: &Value, n: u32, signal: Signal) -> (u32, Result<Mapping, Cancelled>) {
    let mapper = mapper(&example("figure-4/model.json"));
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
    let mut n_polls = 0;
    let mut interrupt = || {
        n_polls += 1;
        if n_polls >= n { signal } else { Signal::Continue }
    };
    let mapping = mapper.map(&request.problem, request.settings, &mut interrupt);
    (n_polls, mapping)
}

#[test]
fn a_policy_that_is_not_optimal_says_what_ran_out_and_one_that_is_says_nothing() {
    let mapper = mapper(&example("figure-4/model.json"));
    for (heuristic, n_observations) in [("default", 16), ("default", 200), ("none", 200), ("paper", 200)] {
        let request = long_request(n_observations, &json!({"heuristic": heuristic}));
        let mut faults = Faults::default();
        let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
        let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
        let map = |budget, signal: Signal| {
            let settings = Settings { budget, ..request.settings };
            let mapping = mapper.map(&request.problem, settings, &mut || signal).unwrap();
            let policy = Policy::new(&Stamp::default(), &request.problem, &mapping).unwrap();
            let report = serde_json::to_value(policy.search).unwrap();
            assert_eq!(report.get("stopped_by"), mapping.stopped_by.map(|by| json!(by.name())).as_ref());
            (mapping.stopped_by, mapping.status == Status::Optimal)
        };
        let whole = map(Budget::DEFAULT, Signal::Continue);
        assert_eq!(whole, (None, heuristic != "paper"), "{heuristic}");
        let few = Budget { max_expansions: 10, ..Budget::DEFAULT };
        assert_eq!(map(few, Signal::Continue), (Some(StoppedBy::MaxExpansions), false), "{heuristic}");
        assert_eq!(map(Budget::DEFAULT, Signal::Finish), (Some(StoppedBy::Deadline), false), "{heuristic}");
        let small = Budget { max_bytes: 5000, ..Budget::DEFAULT };
        assert_eq!(map(small, Signal::Continue), (Some(StoppedBy::Memory), false), "{heuristic}");
    }
}

#[test]
fn a_search_takes_as_much_memory_as_its_problem_is_large_and_its_budget_at_most() {
    let bytes = |mapper: &Mapper, n_observations, heuristic: &str| {
        let request = long_request(n_observations, &json!({"heuristic": heuristic}));
        let mut faults = Faults::default();
        let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
        let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
        let n_bytes = mapper.search_bytes(&request.problem, request.settings);
        let within = Budget { max_bytes: n_bytes, ..Budget::DEFAULT };
        let map =
            |budget| mapper.map(&request.problem, Settings { budget, ..request.settings }, &mut Uninterrupted).unwrap();
        assert_eq!(map(within), map(Budget::DEFAULT), "{n_observations}, {heuristic}");
        n_bytes
    };
    let model = example("figure-4/model.json");
    let figure_4 = mapper(&model);
    assert!(bytes(&figure_4, 16, "default") < 1 << 19);
    for heuristic in ["default", "none"] {
        let [small, large] = [16, 500].map(|n_observations| bytes(&figure_4, n_observations, heuristic));
        assert!(small < large && large < 100 << 20, "{heuristic}: {small} and {large}");
    }
    let lazy = mapper_within(Limits { max_states: 0, ..Limits::DEFAULT }, &model);
    assert_eq!(bytes(&lazy, 16, "default"), Budget::DEFAULT.max_bytes);
}

#[test]
fn what_a_mapper_keeps_of_searches_counts_and_can_be_released() {
    let mapper = mapper(&example("figure-4/model.json"));
    let request = long_request(200, &json!({}));
    let at_first = mapper.size_bytes();
    let policy = solve(&mapper, &request);
    assert!(mapper.size_bytes() > 2 * at_first, "{} and {at_first}", mapper.size_bytes());
    mapper.release();
    assert_eq!(mapper.size_bytes(), at_first);
    assert_eq!(solve(&mapper, &request).search.expanded, policy.search.expanded);
}

#[test]
fn a_search_with_the_papers_heuristic_asks_while_it_estimates() {
    // Each estimate looks at most of 50,000 distances.
    let request = long_request(50_000, &json!({"heuristic": "paper", "max_expansions": 4}));
    let (n_polls, mapping) = map_until(&request, 3, Signal::Cancel);
    assert_eq!((n_polls, mapping.err()), (3, Some(Cancelled)), "within the first expansion");
    let (_, mapping) = map_until(&request, 3, Signal::Finish);
    let mapping = mapping.unwrap();
    assert_eq!((mapping.n_expanded, mapping.status), (1, Status::Bounded));
    assert_eq!(mapping.moves.last().unwrap().observation, 49_999);
}

#[test]
fn the_completion_of_a_search_asks_too() {
    for heuristic in ["none", "default"] {
        let request = long_request(100_000, &json!({"heuristic": heuristic, "max_expansions": 0}));
        let (n_polls, mapping) = map_until(&request, u32::MAX, Signal::Continue);
        let moves = mapping.unwrap().moves;
        // What it completes are two paths, each in two ways.
        let n_looks = 4 * moves.len();
        assert!(n_polls as usize > n_looks / 2048, "{n_polls} polls");
        let (n_cancelled, mapping) = map_until(&request, n_polls / 2, Signal::Cancel);
        assert_eq!((n_cancelled, mapping.err()), (n_polls / 2, Some(Cancelled)));
    }
    // Told to finish, it skips on to the end before long.
    let request = long_request(100_000, &json!({"heuristic": "none"}));
    let (n_polls, mapping) = map_until(&request, 1, Signal::Finish);
    let moves = mapping.unwrap().moves;
    assert!(n_polls < 2000, "{n_polls} polls");
    assert_eq!(moves.last().unwrap().observation, 99_999);
}
