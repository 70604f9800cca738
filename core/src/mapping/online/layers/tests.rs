use proptest::prelude::*;
use serde_json::{Value as Json, json};

use std::num::NonZeroU32;

use super::*;
use crate::interrupt::Uninterrupted;
use crate::mapping::by_definition::{any_conditions, fitted, least_costs, prepared, problem, with_conditions};
use crate::mapping::online::ahead::Ahead;
use crate::mapping::{
    CommittedStep, Demonstration, HeuristicName, Mapper, OnlineMapping, Problem, Settings, Shortage, Status, Stopped,
};

/// States on a line, in any order, with any transitions, of which the cheapest cost so much.
fn line(places: &[u32], transitions: &[(usize, usize, usize)], least_cost: f64) -> Json {
    let states: Vec<_> = places.iter().map(|x| json!([x])).collect();
    let actions = [("a", least_cost), ("b", 0.5), ("c", 2.0)];
    let transitions = fitted(transitions.to_vec(), places.len());
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": actions.map(|(name, cost)| json!({"name": name, "cost": cost})),
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
    })
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
            let shortage = online.shortage().unwrap();
            let Shortage { n_states, n_observations, taken_bytes, layer_bytes, max_bytes: told } = shortage;
            assert_eq!((n_states, told), (301, max_bytes));
            assert!(taken_bytes + layer_bytes > max_bytes, "{shortage}");
            assert!(n_observations <= 300 && shortage.to_string().contains("a lookahead, such as 8"), "{shortage}");
            let n_observed = online.n_observed();
            assert_eq!(n_observed > 0, max_bytes > 10_000, "{n_observed} in {max_bytes} of {most}");
        }
    }
}

#[test]
fn a_state_to_which_hundreds_of_others_lead_is_one_like_any() {
    // From everywhere one action leads back to the beginning.
    let n_states = 300;
    let on = (0..n_states - 1).map(|n| json!([n, "on", n + 1]));
    let back = (1..n_states).map(|n| json!([n, "back", 0]));
    let mapper = Arc::new(prepared(&json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "on", "cost": 0.1}, {"name": "back", "cost": 0.7}],
        "dynamics": {
            "kind": "table", "states": (0..n_states).map(|n| json!([n])).collect::<Vec<_>>(),
            "transitions": on.chain(back).collect::<Vec<_>>(), "start": 0,
        },
    })));
    let weights = mapper.model().schema().weights();
    let mut online = OnlineMapping::new(&mapper, weights.clone(), Conditions::default(), None);
    let observations: Vec<_> = (0..100).map(|n| vec![Some(Value::Number(f64::from(n * 3 % 70)))]).collect();
    for observation in &observations {
        online.observe(observation, None, &mut Uninterrupted).unwrap();
        assert!(layers(&online).tree.knows_its_size());
    }
    let problem =
        Problem::new(mapper.model(), Demonstration::of(observations).unwrap(), weights, Conditions::default());
    let whole = mapper.map(&problem, Settings::default(), &mut Uninterrupted).unwrap();
    let (_, followed) = online.end().unwrap();
    assert!(whole.moves.iter().any(|step| step.state == 0 && step.kind != MoveKind::Start), "it goes back");
    assert!(
        (followed.cost.total - whole.cost.total).abs() < 1e-9,
        "{} against {}",
        followed.cost.total,
        whole.cost.total
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn without_a_lookahead_every_survivors_way_costs_what_the_definition_says_and_is_there_to_be_followed(
        places in prop::collection::vec(0..12_u32, 5..16),
        transitions in prop::collection::vec((0..25_usize, 0..3_usize, 0..25_usize), 10..50),
        observed in prop::collection::vec(prop::option::weighted(0.9, 0..12_u32), 1..12),
        least_cost in prop_oneof![Just(0.0), Just(0.25)],
        conditions in any_conditions(),
    ) {
        let document = line(&places, &transitions, least_cost);
        let mapper = Arc::new(prepared(&document));
        let demonstration: Vec<_> = observed.iter().map(|x| json!({"x": x})).collect();
        let request = with_conditions(json!({"model": "m", "demonstration": demonstration}), &document, &conditions);
        let problem = problem(mapper.model(), &request);
        let [from_start, _] = least_costs(&problem);
        let conditions = problem.conditions.clone();
        let mut online = OnlineMapping::new(&mapper, problem.weights.clone(), conditions, None);
        for (observation, costs) in problem.demonstration.iter().zip(from_start) {
            online.observe(observation, None, &mut Uninterrupted).unwrap();
            let layers = layers(&online);
            for (state, cost) in (0..).zip(costs) {
                let known = layers.sweep.costs[state as usize];
                prop_assert!(known == cost || (known - cost).abs() <= 1e-9 * (1.0 + cost), "{known}, not {cost}");
                if cost.is_infinite() {
                    continue;
                }
                let steps = layers.tree.path(&layers.sweep.ways_in, state).into_iter().map(|place| layers.decided(place));
                let paid = steps.fold(layers.root_cost, |paid, step| {
                    let distance = step.terms.iter().map(|(_, term)| term).sum();
                    layers.sweep.recurrence.arrive(step.step.kind, paid + step.action_cost, distance)
                });
                prop_assert!((paid - cost).abs() <= 1e-9 * (1.0 + cost), "{paid} is paid, not {cost}");
            }
        }
    }

    #[test]
    fn what_is_decided_is_as_cheap_as_any_search_finds_and_so_is_every_survivors_way(
        places in prop::collection::vec(0..12_u32, 5..25),
        transitions in prop::collection::vec((0..25_usize, 0..3_usize, 0..25_usize), 10..70),
        observed in prop::collection::vec(0..12_u32, 5..25),
        lookahead in 1..7_u32,
        least_cost in prop_oneof![Just(0.0), Just(0.25)],
    ) {
        let mapper = Arc::new(prepared(&line(&places, &transitions, least_cost)));
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
            let newest = |online: &OnlineMapping| layers(online).sweep.costs.clone();
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
