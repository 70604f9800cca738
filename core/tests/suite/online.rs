//! The mapping in the making, against its definition.

use std::sync::Arc;

use crate::cases::{Case, begun, case, observations};
use crate::oracle;
use crate::problems::{close, example, mapper};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Cancelled, Signal, Uninterrupted};
use etude_core::mapping::{
    CommittedMove, CommittedStep, Conditions, Mapper, Mapping, OnlineMapping, Policy, Request, Root, Stamp, Status,
    Stopped, StoppedBy,
};
use proptest::prelude::*;
use serde_json::{Value, json};

/// Feeds the demonstration of a request, and gives what was committed and the mapping.
fn follow(mapper: &Mapper, mut online: OnlineMapping, request: &Value) -> (Vec<CommittedStep>, Mapping) {
    let mut committed = Vec::new();
    for observation in observations(mapper, request) {
        committed.extend(online.observe(&observation, None, &mut Uninterrupted).unwrap());
    }
    let (rest, mapping) = online.end().unwrap();
    committed.extend(rest);
    (committed, mapping)
}

/// The same request with a demonstration that begins with the first `n` observations and goes on otherwise.
fn another_end(request: &Value, n: usize, turn: usize) -> Value {
    let other = |values: &Vec<Value>| {
        let mut other = values[..n].to_vec();
        other.extend(values.iter().cycle().skip(turn).step_by(2).take(4).cloned());
        Value::from(other)
    };
    let mut request = request.clone();
    for name in ["demonstration", "observation_weights"] {
        if let Some(values) = request[name].as_array() {
            request[name] = other(values);
        }
    }
    request
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn every_commit_is_what_the_definition_says(
        case in case(),
        lookahead in prop::option::weighted(0.8, 1u32..6),
        searches in any::<bool>(),
        turn in 0usize..8,
    ) {
        let mapper = case.mapper();
        let lookahead = lookahead.or(case.lazy.is_some().then_some(3));
        let (committed, mapping) = follow(&mapper, case.begun(&mapper, lookahead, searches), &case.request);
        let Case { model, request, .. } = &case;
        let node = |step: &CommittedStep| case.node(step);
        let n = request["demonstration"].as_array().unwrap().len() - 1;
        let starts = oracle::starts(model, request);
        let step_cost = |step: &CommittedStep| step.step.action_cost + step.step.distance;
        // What it costs at least to come to the observation `to` from a node, or from before the start.
        let to_go = |request: &Value, from: Option<(usize, usize)>, to: usize, ends: bool| match from {
            Some(node) => oracle::cost_to_go(model, request, node, to, ends),
            None => oracle::cost_from(model, request, &starts, to, ends),
        };

        // A run of forced steps, up to the one that advances, is decided at once.
        let mut is_forced_once = false;
        let mut index = 0;
        while index < committed.len() {
            let from = index.checked_sub(1).map(|before| node(&committed[before]));
            let after = committed[index].after as usize;
            let mut end = index;
            let mut cost = step_cost(&committed[end]);
            // The observation at which the lookahead is used up.
            let window = |lookahead: u32| from.map_or(0, |(i, _)| i + 1) + lookahead as usize - 1;
            if committed[index].is_proven {
                // Whatever is still to come: this end of the demonstration, and, unless it had ended, another.
                let other = (after <= n).then(|| another_end(request, after, turn));
                for request in [Some(request), other.as_ref()].into_iter().flatten() {
                    let last = request["demonstration"].as_array().unwrap().len() - 1;
                    let best = to_go(request, from, last, true);
                    let taken = cost + to_go(request, Some(node(&committed[index])), last, true);
                    prop_assert!(close(best, taken), "step {index}: {taken} where {best} was possible");
                }
            } else {
                is_forced_once = true;
                while from.is_some_and(|(i, _)| committed[end].step.observation as usize == i) {
                    end += 1;
                    cost += step_cost(&committed[end]);
                    prop_assert!(!committed[end].is_proven && committed[end].after as usize == after);
                }
                let window = window(lookahead.unwrap());
                prop_assert_eq!(after, window + 1, "decided when the lookahead was used up, not before and not after");
                let best = to_go(request, from, window, false);
                let taken = cost + to_go(request, Some(node(&committed[end])), window, false);
                prop_assert!(close(best, taken), "steps {index}..={end}: {taken} where {best} was possible");
            }
            // Never later than the lookahead allows.
            let latest = lookahead.map_or(n + 1, |lookahead| (window(lookahead) + 1).min(n + 1));
            prop_assert!(after <= latest, "step {index} was committed after {after}, not by {latest}");
            index = end + 1;
        }

        prop_assert_eq!(mapping.status, if is_forced_once { Status::Local } else { Status::Optimal });
        let optimum = oracle::optimal_cost(model, request);
        if mapping.status == Status::Optimal {
            prop_assert!(close(mapping.cost.total, optimum), "{} against {optimum}", mapping.cost.total);
            prop_assert_eq!(mapping.lower_bound, Some(mapping.cost.total));
        } else {
            prop_assert!(mapping.cost.total >= optimum - 1e-9 && mapping.lower_bound.is_none());
        }
        let must_be_optimal = lookahead.is_none_or(|lookahead| lookahead as usize > n + 1);
        prop_assert!(!must_be_optimal || mapping.status == Status::Optimal);
        let sum: f64 = committed.iter().map(step_cost).sum();
        prop_assert!(close(sum + mapping.cost.end, mapping.cost.total));
        prop_assert_eq!(committed.len(), mapping.moves.len());
    }

    #[test]
    fn a_step_whose_time_is_up_is_the_first_of_the_cheapest_way_to_what_has_come(
        case in case(),
        lookahead in prop::option::weighted(0.5, 1u32..6),
        searches in any::<bool>(),
        times in prop::collection::vec(0..3_u32, 25),
    ) {
        let mapper = case.mapper();
        let mut online = case.begun(&mapper, lookahead, searches);
        let Case { model, request, .. } = &case;
        let node = |step: &CommittedStep| case.node(step);
        let starts = oracle::starts(model, request);
        let to_go = |from: Option<(usize, usize)>, to: usize| match from {
            Some(node) => oracle::cost_to_go(model, request, node, to, false),
            None => oracle::cost_from(model, request, &starts, to, false),
        };
        prop_assert_eq!(online.decide(&mut Uninterrupted).unwrap(), []);
        let mut at = None;
        let mut is_forced_once = false;
        for (i, (observation, n_up)) in observations(&mapper, request).into_iter().zip(times).enumerate() {
            let observed = online.observe(&observation, None, &mut Uninterrupted).unwrap();
            is_forced_once |= observed.iter().any(|step| !step.is_proven);
            at = observed.last().map(node).or(at);
            for _ in 0..n_up {
                let decided = online.decide(&mut Uninterrupted).unwrap();
                let next = at.map_or(0, |(observation, _)| observation + 1);
                prop_assert_eq!(decided.is_empty(), next > i, "something is decided wherever there is something");
                let Some(n_forced) = decided.iter().position(|step| step.step.observation as usize == next) else { continue };
                is_forced_once = true;
                let (forced, shared) = decided.split_at(n_forced + 1);
                prop_assert!(forced.iter().all(|step| !step.is_proven && step.after as usize == i + 1));
                prop_assert!(shared.iter().all(|step| step.is_proven));
                let paid: f64 = forced.iter().map(|step| step.step.action_cost + step.step.distance).sum();
                let (best, taken) = (to_go(at, i), paid + to_go(forced.last().map(node), i));
                prop_assert!(close(best, taken), "{taken} where {best} was possible");
                at = decided.last().map(node);
            }
        }
        let (_, mapping) = online.end().unwrap();
        prop_assert_eq!(mapping.status, if is_forced_once { Status::Local } else { Status::Optimal });
    }

    #[test]
    fn a_mapping_that_goes_on_from_its_root_gives_what_the_unbroken_one_gives(
        case in case(),
        lookahead in prop::option::weighted(0.8, 1u32..6),
        searches in any::<bool>(),
        times in prop::collection::vec(prop::bool::weighted(0.3), 25),
        (kept, broken) in (0_usize..25, 0_usize..25),
    ) {
        let mapper = case.mapper();
        let observations = observations(&mapper, &case.request);
        let take = |online: &mut OnlineMapping, i: usize| {
            let mut steps = online.observe(&observations[i], None, &mut Uninterrupted).unwrap();
            if times[i] {
                steps.extend(online.decide(&mut Uninterrupted).unwrap());
            }
            steps
        };
        let new = || case.begun(&mapper, lookahead, searches);
        let mut unbroken = new();
        // The root is kept once so many observations have come, and others come after it.
        let (kept, broken) = (kept.min(broken) % observations.len(), kept.max(broken) % observations.len());
        (0..kept).for_each(|i| drop(take(&mut unbroken, i)));
        let stored = serde_json::to_string(&(unbroken.root(), unbroken.moves_from(0).collect::<Vec<_>>())).unwrap();
        let (root, moves): (Root, Vec<CommittedMove>) = serde_json::from_str(&stored).unwrap();
        prop_assert_eq!(root, unbroken.root());
        prop_assert_eq!(root.n_steps(), unbroken.n_steps());

        let moves_before = moves.iter().take(moves.len().saturating_sub(1)).cloned();
        prop_assert_eq!(new().resumed(&root, moves_before).is_some(), moves.is_empty());
        let mut resumed = new().resumed(&root, moves).unwrap();
        if case.lazy.is_some() || (searches && lookahead.is_some()) {
            // Among mappings of equal cost, memory does not decide.
            resumed = resumed.within(1);
        }
        prop_assert_eq!(resumed.root(), root);
        prop_assert_eq!(resumed.n_observed(), root.first_observation());
        for observation in &observations[root.first_observation() as usize..kept] {
            prop_assert_eq!(resumed.observe(observation, None, &mut Uninterrupted).unwrap(), []);
        }
        prop_assert_eq!(resumed.n_observed(), unbroken.n_observed());
        prop_assert_eq!(resumed.root(), root);
        for i in kept..observations.len() {
            if i == broken {
                prop_assert_eq!(unbroken.n_rest(), resumed.n_rest());
            }
            prop_assert_eq!(take(&mut unbroken, i), take(&mut resumed, i));
        }
        prop_assert_eq!(resumed.root(), unbroken.root());
        prop_assert_eq!(resumed.end().unwrap(), unbroken.end().unwrap());
    }

    #[test]
    fn a_decision_that_was_cancelled_is_made_again_as_if_it_had_never_been(
        case in case(),
        lookahead in 1u32..6,
        patience in prop::collection::vec(0..3_u32, 50),
    ) {
        let mapper = case.mapper();
        let (mut unbroken, mut cancelled) = (case.begun(&mapper, Some(lookahead), true), case.begun(&mapper, Some(lookahead), true));
        prop_assert!(cancelled.searches());
        let mut patience = patience.into_iter();
        for observation in observations(&mapper, &case.request) {
            let mut steps = cancelled.receive(&observation, None, &mut Uninterrupted).unwrap();
            loop {
                let mut left = patience.next().unwrap_or(u32::MAX);
                let decided = cancelled.decide_next(&mut || match left.checked_sub(1) {
                    None => Signal::Cancel,
                    Some(fewer) => {
                        left = fewer;
                        Signal::Continue
                    }
                });
                match decided {
                    Ok(Some(decided)) => steps.extend(decided),
                    Ok(None) => break,
                    Err(stopped) => prop_assert_eq!(stopped, Stopped::Cancelled(Cancelled)),
                }
            }
            prop_assert_eq!(steps, unbroken.observe(&observation, None, &mut Uninterrupted).unwrap());
        }
        // Where there is little to find, nobody is asked.
        prop_assert!(matches!(cancelled.find_rest(&mut || Signal::Cancel), Ok(()) | Err(Cancelled)));
        prop_assert_eq!(cancelled.end().unwrap(), unbroken.end().unwrap());
    }
}

#[test]
fn figure_4_reaches_its_optimum_with_a_lookahead_of_8_and_commits_early_without() {
    let mapper = Arc::new(mapper(&example("figure-4/model.json")));
    let demonstration = example("figure-4/demonstration.json");
    let request = json!({"model": "m", "demonstration": demonstration});
    let total = |lookahead| follow(&mapper, begun(&mapper, &request, lookahead, false), &request).1.cost.total;
    assert_eq!(total(None), 48.2);
    assert_eq!(total(Some(16)), 48.2);
    assert!(total(Some(8)) <= 48.2 * 1.01, "{}", total(Some(8)));
    assert!(total(Some(1)) > 48.2, "a short lookahead is short-sighted: {}", total(Some(1)));
}

/// A corridor of `n` cells, walked from end to end and back, again and again.
fn corridor(n: u32) -> Value {
    let states: Vec<Value> = (0..n).map(|x| json!([x])).collect();
    let right = (0..n - 1).map(|x| json!([x, "right", x + 1]));
    let left = (1..n).map(|x| json!([x, "left", x - 1]));
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "right", "cost": 0.3}, {"name": "left", "cost": 0.3}],
        "dynamics": {"kind": "table", "states": states, "transitions": right.chain(left).collect::<Vec<_>>(), "start": 0},
    })
}

/// There and back again, faster than the body is.
fn rush(n: u32, n_observations: u32) -> Value {
    (0..n_observations).map(|i| json!([(i * 3 % (2 * n)).abs_diff(n)])).collect()
}

fn read<'m>(mapper: &'m Mapper, request: &Value) -> Result<Request<'m>, Faults> {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let read = Request::read(mapper.model(), &object, &mut faults);
    faults.check(read)
}

#[test]
fn where_time_or_expansions_are_up_what_a_lookahead_has_not_decided_is_followed_greedily() {
    let mapper = Arc::new(mapper(&corridor(30)));
    let request = json!({"model": "corridor", "demonstration": rush(29, 120), "lookahead": 4});
    let request = read(&mapper, &request).unwrap();
    let whole = request.solve(&mapper, &mut Uninterrupted).unwrap();
    assert_eq!(whole.stopped_by, None);
    let check = |mapping: &Mapping, stopped_by| {
        assert_eq!((mapping.status, mapping.lower_bound, mapping.stopped_by), (Status::Local, None, Some(stopped_by)));
        assert_eq!(mapping.moves[0], whole.moves[0]);
        assert_eq!(mapping.moves.last().unwrap().observation, 119);
        // As legal as any: it can be followed again.
        let policy = Policy::new(&Stamp::default(), &request.problem, mapping).unwrap();
        assert!(close(policy.steps.last().unwrap().cost, mapping.cost.total));
        let n_same = mapping.moves.iter().zip(&whole.moves).take_while(|(step, other)| step == other).count();
        mapping.moves[n_same.min(mapping.moves.len() - 1)].observation
    };
    let after = |n_polls: u32, last: Signal| {
        let mut n_left = n_polls;
        request.solve(&mapper, &mut || {
            n_left = n_left.saturating_sub(1);
            if n_left > 0 { Signal::Continue } else { last }
        })
    };
    for n_polls in 1..=400 {
        let mapping = after(n_polls, Signal::Finish).unwrap();
        // A look before each observation, one in it, and those of what is swept again.
        let n_same = check(&mapping, StoppedBy::Deadline);
        assert!(n_same + 6 >= n_polls / 20, "{n_same} of {n_polls}");
        assert_eq!(after(n_polls, Signal::Cancel), Err(Cancelled));
    }
    for max_bytes in [0, 100, 1000, 2000, 3000, 4000, 5000, 6000] {
        let mut request = read(&mapper, &json!({"model": "corridor", "demonstration": rush(29, 120), "lookahead": 4}));
        let request = request.as_mut().unwrap();
        request.settings.budget.max_bytes = max_bytes;
        let mapping = request.solve(&mapper, &mut Uninterrupted).unwrap();
        check(&mapping, StoppedBy::Memory);
    }
    let max_bytes = request.search_bytes(&mapper);
    assert!(max_bytes < 1 << 17, "{max_bytes}");
    let mut within =
        read(&mapper, &json!({"model": "corridor", "demonstration": rush(29, 120), "lookahead": 4})).unwrap();
    within.settings.budget.max_bytes = max_bytes;
    assert!(within.solve(&mapper, &mut Uninterrupted).unwrap() == whole);
    for max_expansions in [0, 29, 30, 31, 1000, 2000] {
        let mut request = read(&mapper, &json!({"model": "corridor", "demonstration": rush(29, 120), "lookahead": 4}));
        let request = request.as_mut().unwrap();
        request.settings.budget.max_expansions = max_expansions;
        let mapping = request.solve(&mapper, &mut Uninterrupted).unwrap();
        check(&mapping, StoppedBy::MaxExpansions);
        assert!(mapping.n_expanded <= max_expansions, "{} of {max_expansions}", mapping.n_expanded);
    }
}

#[test]
fn a_lookahead_may_not_span_more_than_memory_holds() {
    let mapper = mapper(&corridor(2000));
    let request = |lookahead: u32, n_observations: usize| {
        let demonstration = vec![json!({}); n_observations];
        read(&mapper, &json!({"model": "corridor", "demonstration": demonstration, "lookahead": lookahead}))
    };
    // The window: 134 million nodes.
    assert!(request(67_107, 100_000).is_ok());
    assert!(request(100_000, 67_108).is_ok(), "no more than there is to look ahead to");
    for (lookahead, n_observations) in [(67_108, 100_000), (100_000, 67_109)] {
        let faults = request(lookahead, n_observations).unwrap_err();
        let [fault] = faults.listed() else { panic!("{faults}") };
        assert_eq!(fault.pointer, "/lookahead");
        assert!(fault.detail.contains("over 67108 observations") && fault.detail.contains("it may be 67107"));
    }
}

#[test]
fn without_a_lookahead_proven_steps_come_early_and_memory_stays_flat() {
    let n = 12;
    let mapper = Arc::new(mapper(&corridor(n)));
    let schema = mapper.model().schema().clone();
    let mut online = OnlineMapping::new(&mapper, schema.weights(), Conditions::default(), None);
    let mut most_nodes = 0;
    let mut longest_wait = 0;
    for i in 0..5000_u32 {
        let x = if i / (n - 1) % 2 == 0 { i % (n - 1) } else { n - 1 - i % (n - 1) };
        let observation = schema.read_observation(&Place::root(&json!([x])), &mut Faults::default()).unwrap();
        for committed in online.observe(&observation, None, &mut Uninterrupted).unwrap() {
            assert!(committed.is_proven);
            longest_wait = longest_wait.max(committed.after - committed.step.observation);
        }
        most_nodes = most_nodes.max(online.n_nodes());
    }
    assert!(longest_wait <= n + 1, "the survivors' ways meet within the corridor's length: {longest_wait}");
    assert!(most_nodes <= (n * n) as usize, "{most_nodes} nodes");
    let (_, mapping) = online.end().unwrap();
    assert_eq!((mapping.status, mapping.cost.distance), (Status::Optimal, 0.0));
}
