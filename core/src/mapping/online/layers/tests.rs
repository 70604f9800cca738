use proptest::prelude::*;
use serde_json::json;

use std::num::NonZeroU32;

use super::*;
use crate::interrupt::Uninterrupted;
use crate::mapping::by_definition::{fitted, prepared};
use crate::mapping::online::ahead::Ahead;
use crate::mapping::{
    CommittedStep, Demonstration, HeuristicName, Mapper, OnlineMapping, Problem, Settings, Status, Stopped,
};

/// States on a line, in any order, with any transitions.
fn mapper(places: &[u32], transitions: &[(usize, usize, usize)]) -> Arc<Mapper> {
    let states: Vec<_> = places.iter().map(|x| json!([x])).collect();
    let actions = [("a", 0.0), ("b", 0.5), ("c", 2.0)];
    let transitions = fitted(transitions.to_vec(), places.len());
    let document = json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": actions.map(|(name, cost)| json!({"name": name, "cost": cost})),
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
    });
    Arc::new(prepared(&document))
}

/// Two loops of as many states each. From state 0 either can be entered, and none is left. All attributes tell all states
/// apart.
fn loops(n_each: usize, n_attributes: usize) -> Arc<Mapper> {
    let on = |first: usize| (0..n_each).map(move |n| json!([first + n, "on", first + (n + 1) % n_each]));
    let entries = [json!([0, "left", 1]), json!([0, "right", 1 + n_each])];
    let transitions: Vec<_> = entries.into_iter().chain(on(1)).chain(on(1 + n_each)).collect();
    let states: Vec<Vec<usize>> = (0..=2 * n_each).map(|state| vec![state; n_attributes]).collect();
    let attributes = (0..n_attributes).map(|n| json!({"name": format!("a{n}"), "kind": "number"}));
    Arc::new(prepared(&json!({
        "attributes": attributes.collect::<Vec<_>>(),
        "actions": [{"name": "left"}, {"name": "right"}, {"name": "on"}],
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
    })))
}

fn layers(online: &OnlineMapping) -> &Layers {
    match &online.ahead {
        Ahead::Layers(layers) => layers,
        Ahead::Windows(_) => panic!("it has layers"),
    }
}

#[test]
fn without_a_lookahead_an_observation_that_commits_nothing_keeps_no_distances() {
    let (n_each, n_attributes) = (150, 8);
    let mapper = loops(n_each, n_attributes);
    let mut online = OnlineMapping::new(&mapper, mapper.model().schema().weights(), Conditions::default(), None);
    let mut sizes = Vec::new();
    for n in 0..900_u32 {
        let observation = vec![Some(Value::Number(f64::from(1 + n % 150))); n_attributes];
        online.observe(&observation, None, &mut Uninterrupted).unwrap();
        assert!(layers(&online).tree.knows_its_size());
        sizes.push(online.size_bytes());
    }
    // Nobody knows yet that the other loop is not meant.
    assert_eq!(online.n_steps(), 1);
    let per_observation = (sizes[899] - sizes[449]) / 450;
    assert!(per_observation < 2048, "{per_observation} bytes, where distances would take {}", 301 * 8 * 8);
    let (_, mapping) = online.end().unwrap();
    assert_eq!((mapping.status, mapping.moves.len()), (Status::Optimal, 901));
}

#[test]
fn an_observation_that_would_take_more_memory_than_there_is_is_not_taken_and_what_came_before_can_be_ended() {
    let mapper = loops(150, 8);
    let weights = mapper.model().schema().weights();
    let observe = |online: &mut OnlineMapping, n: u32| {
        let observation = vec![Some(Value::Number(f64::from(1 + n % 150))); 8];
        online.observe(&observation, None, &mut Uninterrupted)
    };
    for lookahead in [None, Some(100), Some(10_000)] {
        let lookahead = lookahead.and_then(NonZeroU32::new);
        let new = || OnlineMapping::looking_ahead(&mapper, weights.clone(), Conditions::default(), lookahead, true);
        let mut unbounded = new();
        let mut most = 0;
        for n in 0..300 {
            observe(&mut unbounded, n).unwrap();
            most = most.max(unbounded.size_bytes());
        }
        let foretold = most_bytes(mapper.model(), lookahead, 300) + 300 * 100;
        assert!(most <= foretold, "{most} of {foretold}");
        for max_bytes in [0, 10_000, most / 4, most / 2, most - 1] {
            let mut online = new().within(max_bytes);
            let stopped = (0..300).find_map(|n| {
                let stopped = observe(&mut online, n).err();
                assert!(n == 0 || stopped.is_some() || online.size_bytes() <= max_bytes);
                stopped
            });
            assert_eq!(stopped, Some(Stopped::Memory), "{max_bytes} of {most}");
            let n_observed = online.n_observed();
            assert_eq!(n_observed > 0, max_bytes > 10_000, "{n_observed} in {max_bytes} of {most}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn what_is_decided_is_as_cheap_as_any_search_finds_and_so_is_every_survivors_way(
        places in prop::collection::vec(0..12_u32, 5..25),
        transitions in prop::collection::vec((0..25_usize, 0..3_usize, 0..25_usize), 10..70),
        observed in prop::collection::vec(0..12_u32, 5..25),
        lookahead in 1..7_u32,
    ) {
        let mapper = mapper(&places, &transitions);
        let weights = mapper.model().schema().weights();
        let observations: Vec<_> = observed.iter().map(|x| vec![Some(Value::Number(f64::from(*x)))]).collect();
        // What it costs to go on from a node to the observation `to`, by a search of its own.
        let to_go = |(i, state): (u32, StateIdx), to: u32| {
            let rest = Demonstration::of(observations[i as usize..=to as usize].to_vec()).unwrap();
            let problem = Problem::new(mapper.model(), rest, weights.clone(), Conditions::starting_at(Origin::State(state)));
            let settings = Settings { heuristic: HeuristicName::None, ..Settings::default() };
            let cost = mapper.map(&problem, settings, &mut Uninterrupted).unwrap().cost.total;
            cost - problem.distances.distance(0, mapper.model().states().row(state))
        };
        let lookahead = NonZeroU32::new(lookahead);
        let mut online = OnlineMapping::new(&mapper, weights.clone(), Conditions::default(), lookahead);
        let mut at = (0, 0);
        for (i, observation) in (0..).zip(&observations) {
            let committed = online.observe(observation, None, &mut Uninterrupted).unwrap();
            prop_assert!(layers(&online).tree.knows_its_size());
            let mut paid = 0.0;
            let mut from = at;
            for (n, CommittedStep { step, is_proven, after }) in committed.iter().enumerate() {
                at = (step.observation, step.state_index);
                prop_assert_eq!(*after, i + 1);
                if step.kind == MoveKind::Start {
                    from = at;
                    continue;
                }
                paid += step.action_cost + step.distance;
                // What the lookahead decides is decided up to the step that advances.
                let next = committed.get(n + 1);
                if !is_proven && at.0 == from.0 && next.is_some_and(|next| !next.is_proven) {
                    continue;
                }
                let (best, taken) = (to_go(from, i), paid + to_go(at, i));
                prop_assert!((best - taken).abs() <= 1e-9 * (1.0 + best), "{taken} where {best} was possible");
                (from, paid) = (at, 0.0);
            }
            // Every survivor's way, also where no commit depends on it: as that of a sweep that begins at the root.
            let (first, root) = (layers(&online).tree.n_before as usize - 1, layers(&online).tree.root);
            let mut swept = OnlineMapping::new(&mapper, weights.clone(), Conditions::starting_at(Origin::State(root)), None);
            for observation in &observations[first..=i as usize] {
                swept.observe(observation, None, &mut Uninterrupted).unwrap();
            }
            let before = layers(&online).root_cost - layers(&online).tree.layers[0].observed.distance(mapper.model(), root);
            let newest = |online: &OnlineMapping| layers(online).tree.layers.back().unwrap().costs.clone();
            for (cost, swept) in newest(&online).into_iter().zip(newest(&swept)) {
                let is_same = cost == before + swept || (cost - before - swept).abs() <= 1e-9 * (1.0 + cost);
                prop_assert!(is_same, "{cost}, not {before} + {swept}");
            }
        }
        let cost = online.committed.writer.cost_with_end(0.0).total;
        let rest = to_go(at, u32::try_from(observations.len()).unwrap() - 1);
        let (_, mapping) = online.end().unwrap();
        prop_assert!((mapping.cost.total - cost - rest).abs() <= 1e-9 * (1.0 + cost + rest));
    }
}
