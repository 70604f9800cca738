//! What an inspection finds, against the same figures found by trying everything, on JSON alone.

mod tried;

use std::collections::BTreeSet;
use std::sync::Arc;

use crate::oracle;
use crate::problems::{cave, close, example, mapper, mapper_within, problem, solve, walked};
use etude_core::document::{Faults, Place};
use etude_core::inspection::{Query, Report, inspect};
use etude_core::interrupt::{Signal, Uninterrupted};
use etude_core::mapping::{Mapper, Request};
use etude_core::model::Limits;
use proptest::prelude::*;
use serde_json::{Value, json};
use tried::{Tried, is_same, observed, strings, term, try_all, weight};

/// What a report has to be asked of a request for a policy.
fn query_of(request: &Value) -> Value {
    let kept = request.as_object().unwrap().iter().filter(|(name, _)| Query::FIELDS.contains(&name.as_str()));
    kept.map(|(name, value)| (name.clone(), value.clone())).collect::<serde_json::Map<_, _>>().into()
}

fn read(mapper: &Mapper, request: &Value) -> Query {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Query::FIELDS, &mut faults).unwrap();
    let query = Query::read(mapper.model(), &object, &mut faults);
    faults.check(query).unwrap()
}

fn inspected(mapper: &Mapper, request: &Value) -> Report {
    inspect(mapper.model(), &read(mapper, request), &mut Uninterrupted).unwrap()
}

fn check(model: &Value, request: &Value) {
    let mapper = mapper(model);
    let report = inspected(&mapper, request);
    let tried = try_all(model, request);
    let states = model["dynamics"]["states"].as_array().unwrap();
    let n_unsafe = model["dynamics"]["unsafe"].as_array().map_or(0, Vec::len);
    let index = |example: &etude_core::inspection::StateExample| example.state_index.unwrap() as usize;

    let reach = report.reach.as_ref().unwrap();
    assert_eq!((reach.starts, reach.states), (tried.starts.len() as u64, tried.reached.len() as u64));
    assert_eq!(reach.transitions, tried.ways.len() as u64);
    assert_eq!(reach.unreachable.states, (states.len() - n_unsafe - tried.reached.len()) as u64);
    assert!(reach.unreachable.examples.iter().all(|example| !tried.reached.contains(&index(example))));
    let leads_on = |s: usize| tried.ways.iter().any(|(from, ..)| *from == s);
    let dead_ends: BTreeSet<usize> = tried.reached.iter().copied().filter(|s| !leads_on(*s)).collect();
    assert_eq!(reach.dead_ends.states, dead_ends.len() as u64);
    assert!(reach.dead_ends.examples.iter().all(|example| dead_ends.contains(&index(example))));

    let to_and_fro = |s: &usize, t: &usize| tried.steps[*s][*t].is_some() && tried.steps[*t][*s].is_some();
    let part_of = |s: usize| tried.reached.iter().copied().filter(|t| to_and_fro(&s, t)).collect::<BTreeSet<_>>();
    let parts: BTreeSet<BTreeSet<usize>> = tried.reached.iter().map(|s| part_of(*s)).collect();
    let is_final =
        |part: &BTreeSet<usize>| tried.ways.iter().all(|(from, _, to)| !part.contains(from) || part.contains(to));
    let found = report.parts.as_ref().unwrap();
    assert_eq!(found.parts, parts.len() as u64);
    assert_eq!(found.n_final, parts.iter().filter(|part| is_final(part)).count() as u64);
    assert_eq!(found.largest.iter().map(|part| part.states).sum::<u64>(), tried.reached.len() as u64);
    assert!(found.largest.windows(2).all(|two| two[0].states >= two[1].states));
    for part in &found.largest {
        let expected = part_of(index(&part.example));
        assert_eq!((part.states, part.is_final), (expected.len() as u64, is_final(&expected)));
        assert_eq!(part.starts, expected.intersection(&tried.starts).count() as u64);
    }

    for (k, attribute) in report.attributes.iter().enumerate() {
        let values: BTreeSet<String> = tried.reached.iter().map(|s| states[*s][k].to_string()).collect();
        assert_eq!(attribute.distinct, values.len() as u64, "{}", attribute.name);
        let n_changing = tried.ways.iter().filter(|(from, _, to)| states[*from][k] != states[*to][k]).count();
        assert_eq!(attribute.changed_by, Some(n_changing as u64), "{}", attribute.name);
        match (&attribute.span, &attribute.values) {
            (Some(span), None) => {
                let numbers = || tried.reached.iter().map(|s| states[*s][k].as_f64().unwrap());
                let (least, greatest) =
                    (numbers().fold(f64::INFINITY, f64::min), numbers().fold(-f64::INFINITY, f64::max));
                assert_eq!((span.least, span.greatest), (least, greatest), "{}", attribute.name);
            }
            (None, Some(listed)) => {
                let listed: BTreeSet<String> = listed.iter().map(|value| json!(value).to_string()).collect();
                assert_eq!(listed, values, "{}", attribute.name);
            }
            both => panic!("{}: {both:?}", attribute.name),
        }
    }

    // What undoes each way, to where all looks as before.
    let weighed: Vec<usize> = (0..report.attributes.len()).filter(|k| weight(model, request, *k) > 0.0).collect();
    let looks_like = |s: usize, t: usize| weighed.iter().all(|k| states[s][*k] == states[t][*k]);
    let undone = |(from, _, to): &(usize, String, usize)| {
        tried.reached.iter().filter(|back| looks_like(*from, **back)).filter_map(|back| tried.steps[*to][*back]).min()
    };
    let mut steps: Vec<usize> = tried.ways.iter().filter_map(undone).collect();
    steps.sort_unstable();
    let undo = report.undo.as_ref().unwrap();
    assert_eq!((undo.exact, undo.examined, undo.not_found), (true, tried.ways.len() as u64, 0));
    assert_eq!(undo.never, (tried.ways.len() - steps.len()) as u64);
    let share = |percent: usize| steps.get((steps.len() * percent).div_ceil(100).saturating_sub(1)).map(|n| *n as u64);
    assert_eq!(undo.steps.map(|steps| steps.median), share(50));
    assert_eq!(undo.steps.map(|steps| steps.p99), share(99));
    assert_eq!(undo.steps.map(|steps| steps.greatest), share(100));
    assert_eq!(report.lookahead, share(100).map(|greatest| greatest + 1));
    let without = strings(&request["without"]);
    let has = model["actions"].as_array().unwrap().iter().map(|action| action["name"].as_str().unwrap());
    let has: Vec<&str> = has.filter(|name| !without.iter().any(|lacked| lacked == name)).collect();
    assert_eq!(report.actions.iter().map(|action| action.name.as_str()).collect::<Vec<_>>(), has);
    for action in &report.actions {
        let own = || tried.ways.iter().filter(|(_, name, _)| *name == action.name);
        let from: BTreeSet<usize> = own().map(|(from, ..)| *from).collect();
        assert_eq!(action.applies_in, Some(from.len() as u64), "{}", action.name);
        assert_eq!(action.undone_in, own().filter_map(undone).max().map(|n| n as u64), "{}", action.name);
        assert_eq!(
            action.never_undone,
            Some(own().filter(|way| undone(way).is_none()).count() as u64),
            "{}",
            action.name
        );
    }
    check_demonstration(model, request, &tried, &report);
}

fn check_demonstration(model: &Value, request: &Value, tried: &Tried, report: &Report) {
    let states = model["dynamics"]["states"].as_array().unwrap();
    let demonstration = request["demonstration"].as_array().unwrap();
    let reached = || tried.reached.iter().map(|s| &states[*s]);
    let e = |i: usize| oracle::observation_weight(request, i);
    let found = report.demonstration.as_ref().unwrap();
    let least = |observation: &Value| {
        reached()
            .map(|state| oracle::distance(model, &request["weights"], observation, state))
            .fold(f64::INFINITY, f64::min)
    };
    let unmet: Vec<u64> = (0..).zip(demonstration).filter(|(_, seen)| least(seen) > 0.0).map(|(i, _)| i).collect();
    assert_eq!(found.met, Some((demonstration.len() - unmet.len()) as u64));
    assert_eq!(found.unmet.as_ref(), Some(&unmet));
    let distance: f64 = demonstration.iter().enumerate().map(|(i, seen)| e(i) * least(seen)).sum();
    assert!(close(found.distance.unwrap(), distance), "{:?} {distance}", found.distance);
    let mut by_attribute = 0.0;
    for (k, attribute) in found.attributes.iter().enumerate() {
        let tells: Vec<usize> =
            (0..demonstration.len()).filter(|i| !observed(model, &demonstration[*i], k).is_null()).collect();
        assert_eq!(attribute.observed, tells.len() as u64);
        let least = |i: usize, weight: f64| {
            reached().map(|state| term(model, &demonstration[i], state, k, weight)).fold(f64::INFINITY, f64::min)
        };
        let unmet: Vec<usize> = tells.iter().copied().filter(|i| least(*i, 1.0) > 0.0).collect();
        assert_eq!(attribute.unmet, unmet.len() as u64, "{}", attribute.name);
        let value = |i: usize| observed(model, &demonstration[i], k).to_string();
        let distinct: BTreeSet<String> = unmet.iter().map(|i| value(*i)).collect();
        let listed: BTreeSet<String> = attribute.values.iter().map(|unmet| json!(unmet.value).to_string()).collect();
        assert_eq!((attribute.distinct, listed.len()), (distinct.len() as u64, distinct.len()), "{}", attribute.name);
        for listed in &attribute.values {
            let own: Vec<usize> = unmet
                .iter()
                .copied()
                .filter(|i| is_same(&json!(listed.value), observed(model, &demonstration[*i], k)))
                .collect();
            assert_eq!((listed.observations, listed.first), (own.len() as u64, own[0] as u64), "{}", attribute.name);
            let mut closest = states[0].clone();
            closest[k] = json!(listed.closest);
            assert!(
                close(term(model, &demonstration[own[0]], &closest, k, 1.0), least(own[0], 1.0)),
                "{}",
                attribute.name
            );
        }
        let expected: f64 = tells.iter().map(|i| e(*i) * least(*i, weight(model, request, k))).sum();
        assert!(close(attribute.distance, expected), "{}: {} {expected}", attribute.name, attribute.distance);
        by_attribute += expected;
    }
    assert!(by_attribute <= distance * (1.0 + 1e-9), "{by_attribute} {distance}");
}

/// The model, some of whose actions lead elsewhere as well.
fn slipping(mut model: Value, elsewhere: &[Option<usize>]) -> Value {
    let n_states = model["dynamics"]["states"].as_array().unwrap().len();
    let transitions = model["dynamics"]["transitions"].as_array().unwrap().clone();
    let slipped = transitions.iter().zip(elsewhere.iter().cycle()).flat_map(|(transition, other)| match other {
        None => vec![transition.clone()],
        Some(other) => {
            let [from, action] = [0, 1].map(|at| transition[at].clone());
            vec![json!([from, action, transition[2], 0.75]), json!([from, action, other % n_states, 0.25])]
        }
    });
    model["dynamics"]["transitions"] = slipped.collect();
    model
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_report_says_what_trying_everything_shows((model, request) in problem()) {
        check(&model, &query_of(&request));
    }

    #[test]
    fn a_report_of_a_body_that_slips_says_what_trying_everything_shows(
        (model, request) in problem(),
        elsewhere in prop::collection::vec(prop::option::of(0usize..100), 1..8),
    ) {
        check(&slipping(model, &elsewhere), &query_of(&request));
    }

    #[test]
    fn no_mapping_has_less_distance_than_a_report_says((model, request) in problem()) {
        let mapper = mapper(&model);
        let found = inspected(&mapper, &query_of(&request)).demonstration.unwrap();
        let distance = solve(&mapper, &request).cost.distance;
        prop_assert!(found.distance.unwrap() <= distance + 1e-9 * (1.0 + distance), "{:?} {distance}", found.distance);
    }

    #[test]
    fn a_world_that_is_searched_lazily_and_is_small_is_known_as_well_as_one_that_is_not((model, walk) in cave()) {
        let request = json!({"demonstration": walked(&model, &walk)});
        let listed = inspected(&mapper(&model), &request);
        let lazy = inspected(&mapper_within(LAZY, &model), &request);
        prop_assert_eq!(&lazy.counts.states, &None);
        let reach = |report: &Report| report.reach.as_ref().map(|reach| (reach.states, reach.transitions, reach.dead_ends.states));
        prop_assert_eq!(reach(&lazy), reach(&listed));
        let parts = |report: &Report| report.parts.as_ref().map(|parts| (parts.parts, parts.n_final));
        prop_assert_eq!(parts(&lazy), parts(&listed));
        let described = |report: &Report| report.parts.as_ref().map(|parts| {
            parts.largest.iter().map(|part| part.example.state.clone()).collect::<Vec<_>>()
        });
        prop_assert_eq!(described(&lazy), described(&listed));
        prop_assert_eq!((&lazy.attributes, &lazy.actions, &lazy.undo), (&listed.attributes, &listed.actions, &listed.undo));
        prop_assert_eq!((&lazy.lookahead, &lazy.demonstration), (&listed.lookahead, &listed.demonstration));
        prop_assert_eq!(&lazy.unknown, &listed.unknown);
    }
}

/// Nothing may be known beforehand.
const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };

/// A cave of this size, without anything in it, and a body that cannot shoot, grab or climb, and turns as it can.
fn empty_cave(width: usize, height: usize, turns: &[&str]) -> Value {
    let actions = turns.iter().chain(&["forward"]).map(|name| json!({"name": name, "cost": 0.3}));
    json!({
        "actions": actions.collect::<Vec<_>>(),
        "dynamics": {
            "kind": "wumpus", "width": width, "height": height, "pits": [], "wumpi": [], "gold": [], "arrows": 1,
            "start": {"x": 0, "y": 0, "heading": "east"},
        },
    })
}

#[test]
fn of_a_large_world_that_is_searched_lazily_what_is_known_is_told_and_what_is_not_says_why() {
    let mut model = empty_cave(200, 200, &["turn_left", "turn_right"]);
    model["actions"].as_array_mut().unwrap().push(json!({"name": "grab", "cost": 0.3}));
    let request = json!({"demonstration": [{"x": 3, "heading": "east"}, {"x": 777}]});
    let report = inspected(&mapper_within(LAZY, &model), &request);
    assert_eq!((&report.counts.states, &report.reach, &report.parts), (&None, &None, &None));
    let action = |name: &str| report.actions.iter().find(|action| action.name == name).unwrap();
    // There is no gold; and a body turns round, goes back, and turns round again.
    assert_eq!((action("grab").applies_in, action("forward").applies_in), (Some(0), None));
    assert_eq!((action("forward").undone_in, action("turn_left").undone_in), (Some(5), Some(1)));
    let undo = report.undo.as_ref().unwrap();
    assert_eq!((undo.exact, undo.never, undo.not_found, report.lookahead), (false, 0, 0, Some(6)));
    assert!(undo.examined > 10_000 && undo.transitions > undo.examined, "{undo:?}");
    let changed_by: Vec<_> = report.attributes.iter().map(|attribute| attribute.changed_by).collect();
    assert_eq!(changed_by, [None, None, None, Some(0), Some(0), Some(0)]);
    let found = report.demonstration.as_ref().unwrap();
    assert_eq!((found.met, found.distance, found.attributes[0].distance), (None, None, 578.0 * 578.0));
    let pointers: Vec<_> = report.unknown.iter().map(|unknown| unknown.pointer.as_str()).collect();
    assert_eq!(pointers, ["/reach", "/demonstration/distance"]);
}

/// To prove that gold cannot be laid back, and arrows do not come back, by walking would take longer than there is time for.
#[test]
fn what_changes_one_way_only_is_never_undone_however_many_states_there_are() {
    let mut model = empty_cave(60, 60, &["turn_left", "turn_right", "grab", "shoot"]);
    model["dynamics"]["gold"] = json!([[1, 0], [3, 2], [50, 50], [9, 40]]);
    let report = inspected(&mapper_within(LAZY, &model), &json!({}));
    let action = |name: &str| report.actions.iter().find(|action| action.name == name).unwrap();
    for name in ["grab", "shoot"] {
        let found = action(name);
        assert!(found.undone_in.is_none() && found.never_undone.unwrap() > 0, "{found:?}");
    }
    let undo = report.undo.as_ref().unwrap();
    assert_eq!((report.reach.is_none(), undo.not_found, action("forward").undone_in), (true, 0, Some(5)));
}

#[test]
fn a_body_that_turns_right_alone_follows_well_with_the_lookahead_that_a_report_says_and_badly_with_little() {
    let model = empty_cave(5, 5, &["turn_right"]);
    let mapper = Arc::new(mapper(&model));
    let report = inspected(&mapper, &json!({}));
    let undone_in: Vec<_> = report.actions.iter().map(|action| (action.name.as_str(), action.undone_in)).collect();
    assert_eq!((undone_in, report.lookahead), (vec![("turn_right", Some(3)), ("forward", Some(5))], Some(6)));
    // To the east, then north, then west: to the left twice.
    let cells = [(0, 0, "east"), (1, 0, "east"), (2, 0, "east"), (2, 0, "north"), (2, 1, "north"), (2, 2, "north")];
    let back = [(2, 2, "west"), (1, 2, "west"), (0, 2, "west"), (0, 2, "west"), (0, 2, "west")];
    let seen: Vec<_> =
        cells.iter().chain(&back).map(|(x, y, heading)| json!({"x": x, "y": y, "heading": heading})).collect();
    let cost = |lookahead: Option<u64>| {
        let request = json!({"model": "m", "demonstration": seen, "lookahead": lookahead});
        let mut faults = Faults::default();
        let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
        let request = Request::read(mapper.model(), &object, &mut faults).unwrap();
        request.solve(&mapper, &mut Uninterrupted).unwrap().cost.total
    };
    let optimum = cost(None);
    assert!(cost(report.lookahead) < optimum * 1.01, "{} {optimum}", cost(report.lookahead));
    assert!(cost(Some(1)) > optimum * 1.5, "{} {optimum}", cost(Some(1)));
}

#[test]
fn a_report_whose_time_is_up_says_what_was_not_found_and_one_that_nobody_waits_for_ends() {
    let model = example("figure-4/model.json");
    let mapper = mapper(&model);
    let request = example("figure-4/request.json");
    let query = read(&mapper, &query_of(&request));
    let whole = inspect(mapper.model(), &query, &mut Uninterrupted).unwrap();
    let mut n_polls = 0u32;
    let counted = inspect(mapper.model(), &query, &mut || {
        n_polls += 1;
        Signal::Continue
    });
    assert_eq!(counted.unwrap(), whole);
    for n_before in 0..=n_polls {
        let mut n_left = n_before;
        let mut after = |signal: Signal| {
            n_left = n_left.saturating_sub(1);
            if n_left == 0 { signal } else { Signal::Continue }
        };
        let report = inspect(mapper.model(), &query, &mut || after(Signal::Finish)).unwrap();
        let is_told = |pointer: &str| report.unknown.iter().any(|unknown| unknown.pointer == pointer);
        assert_eq!(report.reach.is_none(), is_told("/reach"));
        assert!(report.parts.is_some() || is_told("/parts") || is_told("/reach"));
        assert!(report.undo.as_ref().is_none_or(|undo| undo.exact == (undo.examined == undo.transitions)));
        if report != whole {
            assert!(report.undo.as_ref().is_none_or(|undo| !undo.exact) || !report.unknown.is_empty(), "{n_before}");
        }
        let mut n_left = n_before;
        let cancelled = inspect(mapper.model(), &query, &mut || {
            n_left = n_left.saturating_sub(1);
            if n_left == 0 { Signal::Cancel } else { Signal::Continue }
        });
        assert!(cancelled.is_err() || n_before > n_polls);
    }
}
