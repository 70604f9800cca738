//! What a request may say of starts, of what counts, and of the body: small tasks that need it, and caves on which it must not cost much.

use crate::oracle;
use crate::problems::{close, example, mapper, mapper_within, solve};
use etude_core::mapping::{Policy, Status};
use etude_core::model::Limits;
use serde_json::{Value, json};

#[path = "../../../benches/worlds/mod.rs"]
mod worlds;

/// Ten steps to the right, of 0.1 each.
fn road() -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "on", "cost": 0.1}],
        "dynamics": {
            "kind": "table", "states": (0..=10).map(|x| [x]).collect::<Vec<_>>(),
            "transitions": (0..10).map(|x| json!([x, "on", x + 1])).collect::<Vec<_>>(), "start": 0,
        },
    })
}

fn solved(model: &Value, mut request: Value) -> Policy {
    request["model"] = json!("m");
    let policy = solve(&mapper(model), &request);
    assert_eq!(policy.status, Status::Optimal);
    let blind = solve(&mapper(model), &{
        request["heuristic"] = json!("none");
        request
    });
    assert!(close(policy.cost.total, blind.cost.total), "{} and {}", policy.cost.total, blind.cost.total);
    policy
}

fn end(policy: &Policy) -> Value {
    serde_json::to_value(&policy.steps.last().unwrap().state).unwrap()
}

#[test]
fn way_points_that_are_far_apart_are_reached_if_only_the_steps_that_meet_them_pay() {
    let seen = json!([{"x": 0}, {"x": 10}]);
    let by_default = solved(&road(), json!({"demonstration": seen}));
    assert_eq!((by_default.cost.total, end(&by_default)), (50.4, json!({"x": 4})));
    assert_eq!(by_default.end.distance, 36.0);
    let way_points = solved(&road(), json!({"demonstration": seen, "extra_weight": 0}));
    assert_eq!((way_points.cost.total, end(&way_points)), (1.0, json!({"x": 10})));
    assert_eq!(way_points.end.distance, 0.0);
}

#[test]
fn a_task_whose_end_matters_is_ended() {
    let seen = json!([{"x": 0}, {"x": 10}]);
    let policy = solved(&road(), json!({"demonstration": seen, "end_weight": 100}));
    assert_eq!((policy.cost.total, policy.cost.end, end(&policy)), (86.0, 0.0, json!({"x": 10})));
    // It costs more than it saves to go all the way.
    let policy = solved(&road(), json!({"demonstration": seen, "end_weight": 1}));
    assert_eq!(end(&policy), json!({"x": 5}));
    assert_eq!((policy.cost.end, policy.end.distance, policy.cost.total), (25.0, 25.0, 80.5));
    assert_eq!(policy.steps.last().unwrap().cost, 55.5, "the last step is told without the end");
}

#[test]
fn an_observation_that_counts_nothing_is_not_followed_and_may_still_be_met() {
    let seen = json!([{"x": 0}, {"x": 10}, {"x": 1}]);
    let policy = solved(&road(), json!({"demonstration": seen, "observation_weights": [1, 0, null]}));
    assert_eq!((policy.cost.total, policy.cost.distance), (0.1, 0.0));
    assert_eq!((policy.coverage.exact, policy.coverage.observed), (2, 3));
}

#[test]
fn the_start_is_part_of_the_optimum() {
    // Places that look alike: one of the three that look like `e` is beside the one that looks like `c`.
    let ways = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (2, 6), (4, 7), (5, 8), (7, 9)];
    let both: Vec<Value> =
        ways.iter().flat_map(|(from, to)| [json!([from, "go", to]), json!([to, "back", from])]).collect();
    let transitions: Vec<Value> = both
        .iter()
        .enumerate()
        .map(|(n, way)| json!([way[0], format!("{}{n}", way[1].as_str().unwrap()), way[2]]))
        .collect();
    let actions: Vec<Value> = transitions.iter().map(|way| json!({"name": way[1], "cost": 0.1})).collect();
    let states = ["a", "b", "c", "b", "d", "e", "e", "e", "f", "f"].map(|seen| [seen]);
    let model = json!({
        "attributes": [{"name": "seen", "kind": "category"}], "actions": actions,
        "dynamics": {
            "kind": "table", "transitions": transitions,
            "states": states,
        },
    });
    let policy = solved(&model, json!({"demonstration": [{"seen": "e"}, {"seen": "c"}]}));
    assert_eq!((policy.cost.total, policy.steps[0].state_index), (0.1, 6));
    let from_two = solved(&model, json!({"demonstration": [{"seen": "e"}, {"seen": "c"}], "start": [5, 7]}));
    assert!(from_two.cost.total > 0.1 && [5, 7].contains(&from_two.steps[0].state_index));
    // What is not seen at first does not decide.
    let free = solved(
        &{
            let mut road = road();
            road["dynamics"]["start"] = Value::Null;
            road
        },
        json!({"demonstration": [{}, {"x": 7}]}),
    );
    assert_eq!((free.cost.total, end(&free)), (0.0, json!({"x": 7})));
}

#[test]
fn a_transition_may_cost_more_than_its_action() {
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "y", "kind": "number"}],
        "actions": [{"name": "right", "cost": 0.3}, {"name": "up", "cost": 0.3}, {"name": "down", "cost": 0.3}],
        "dynamics": {
            "kind": "table", "start": 0, "states": [[0, 0], [1, 0], [2, 0], [3, 0], [0, 1], [1, 1], [2, 1], [3, 1]],
            "transitions": [
                [0, "right", 0, 1, 100], [0, "up", 4], [4, "right", 5], [5, "right", 6], [6, "right", 7], [7, "down", 3],
                [5, "down", 0, 1, 100], [6, "down", 0, 1, 100],
            ],
        },
    });
    let policy = solved(&model, json!({"demonstration": [{"x": 0, "y": 0}, {"x": 3, "y": 0}], "extra_weight": 0}));
    assert_eq!((policy.cost.total, end(&policy)), (1.5, json!({"x": 3, "y": 0})));
    // What falls pays for it, in the step that falls.
    let fallen = solved(
        &model,
        json!({
            "demonstration": [{"x": 2, "y": 1}, {"x": 0, "y": 0}, {"x": 0, "y": 0}], "start": 6, "weights": {"x": 1000},
        }),
    );
    assert_eq!((fallen.steps[1].action.as_deref(), fallen.steps[1].action_cost), (Some("down"), 100.0));
}

#[test]
fn a_body_by_request_is_the_body_of_a_model_that_is_so() {
    for (model, demonstration) in [
        (example("figure-4/model.json"), example("figure-4/demonstration.json")),
        (worlds::cave(12, 3, 30, 4).model, worlds::cave(12, 3, 30, 4).demonstration),
    ] {
        let mut other = model.clone();
        let actions = other["actions"].as_array_mut().unwrap();
        actions.retain(|action| action["name"] != "grab");
        actions.iter_mut().filter(|action| action["name"] == "forward").for_each(|action| action["cost"] = json!(2.0));
        let expected = solved(&other, json!({"demonstration": demonstration}));
        let request = json!({"demonstration": demonstration, "without": ["grab"], "action_costs": {"forward": 2.0}});
        let policy = solved(&model, request);
        assert_eq!((policy.cost, policy.actions), (expected.cost, expected.actions));
        // The bounds are as strong.
        let (expanded, known) = (policy.search.expanded, expected.search.expanded);
        assert!(expanded <= known + known / 10, "{expanded} and {known}");
    }
}

#[test]
fn a_world_that_is_searched_lazily_knows_all_of_it() {
    const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };
    let worlds::World { model, demonstration, .. } = worlds::cave(8, 2, 20, 3);
    let (known, lazy) = (mapper(&model), mapper_within(LAZY, &model));
    assert!(lazy.model().is_lazy());
    let at = |x: u32, y: u32| {
        json!({"x": x, "y": y, "heading": "north", "arrows": 1, "outside": false,
        "wumpus_1": true, "wumpus_2": true, "gold_1": true, "gold_2": true, "gold": 0})
    };
    let n_observations = demonstration.as_array().unwrap().len();
    let counts: Vec<f64> = (0..n_observations).map(|i| f64::from(u8::try_from(i % 3).unwrap())).collect();
    for conditions in [
        json!({"extra_weight": 0}),
        json!({"end_weight": 10}),
        json!({"extra_weight": 0.25, "end_weight": 3, "observation_weights": counts}),
        json!({"without": ["turn_left"], "action_costs": {"grab": 1.5}, "end_weight": 10}),
        json!({"start": [at(0, 0), at(7, 7), at(3, 7)]}),
        json!({"start": [at(1, 0), at(7, 7)], "extra_weight": 0, "end_weight": 10}),
    ] {
        for heuristic in ["default", "none"] {
            let mut request = conditions.clone();
            request["model"] = json!("m");
            request["demonstration"] = demonstration.clone();
            request["heuristic"] = json!(heuristic);
            let (known, lazy) = (solve(&known, &request), solve(&lazy, &request));
            assert_eq!((lazy.status, known.status), (Status::Optimal, Status::Optimal));
            assert!(
                close(lazy.cost.total, known.cost.total),
                "{conditions}: {} and {}",
                lazy.cost.total,
                known.cost.total
            );
        }
    }
}
#[test]
fn long_searches_where_extra_actions_pay_little_find_what_the_definition_says() {
    let worlds::World { mut model, demonstration, .. } = worlds::cave(7, 3, 20, 2);
    model["dynamics"]["pits"] = json!([]);
    model["dynamics"]["start"] = json!({"x": 0, "y": 0, "heading": "east"});
    model["dynamics"]["arrows"] = json!(1);
    let table = oracle::wumpus::as_table(&model);
    let mapper = mapper(&model);
    let counts: Vec<f64> =
        (0..demonstration.as_array().unwrap().len()).map(|i| f64::from(u8::try_from(i % 3).unwrap())).collect();
    let at = |x: u32, y: u32| {
        json!({"x": x, "y": y, "heading": "north", "arrows": 1, "outside": false,
        "wumpus_1": true, "wumpus_2": true, "gold_1": true, "gold_2": true, "gold_3": true, "gold": 0})
    };
    let mut n_long = 0;
    for conditions in [
        json!({"extra_weight": 0}),
        json!({"extra_weight": 0, "end_weight": 10}),
        json!({"extra_weight": 0.2, "end_weight": 3, "observation_weights": counts}),
        json!({"extra_weight": 0.1, "weights": {"gold": 4, "heading": 0}, "without": ["climb"]}),
        json!({"extra_weight": 0, "without": ["turn_left"], "action_costs": {"grab": 1.5, "forward": 0.1}}),
        json!({"extra_weight": 0, "end_weight": 10, "start": [at(0, 0), at(6, 6), at(3, 6)]}),
    ] {
        let mut request = conditions.clone();
        request["model"] = json!("m");
        request["demonstration"] = demonstration.clone();
        let policy = solve(&mapper, &request);
        if let Some(starts) = request["start"].as_array_mut() {
            for start in starts {
                *start = json!(index_of(&table, start));
            }
        }
        let optimum = oracle::optimal_cost(&table, &request);
        assert!(close(policy.cost.total, optimum), "{conditions}: {}, not {optimum}", policy.cost.total);
        assert_eq!((policy.status, policy.lower_bound), (Status::Optimal, Some(policy.cost.total)));
        n_long += u32::from(policy.search.expanded > 2_048);
    }
    assert!(n_long >= 4, "{n_long}");
}

/// The number of the state with these values.
fn index_of(table: &Value, values: &Value) -> usize {
    let names = table["attributes"].as_array().unwrap().iter().map(|attribute| attribute["name"].as_str().unwrap());
    let row: Value = names.map(|name| values[name].clone()).collect();
    table["dynamics"]["states"].as_array().unwrap().iter().position(|state| *state == row).unwrap()
}

#[test]
fn way_points_and_an_end_that_matters_take_no_more_than_three_times_the_expansions() {
    let caves = (1..=3).map(|seed| worlds::cave(20, 5, 50, seed));
    let figure = worlds::World {
        name: "figure 4".to_owned(),
        model: example("figure-4/model.json"),
        demonstration: example("figure-4/demonstration.json"),
    };
    let mut n_default = Vec::new();
    for worlds::World { name, model, demonstration } in [figure].into_iter().chain(caves) {
        let mapper = mapper(&model);
        let expanded = |conditions: Value| {
            let mut request = conditions;
            request["model"] = json!("m");
            request["demonstration"] = demonstration.clone();
            let policy = solve(&mapper, &request);
            assert_eq!(policy.status, Status::Optimal);
            policy.search.expanded
        };
        let by_default = expanded(json!({}));
        n_default.push(by_default);
        for conditions in
            [json!({"extra_weight": 0}), json!({"end_weight": 10}), json!({"extra_weight": 0, "end_weight": 10})]
        {
            let n_expanded = expanded(conditions.clone());
            assert!(n_expanded <= 3 * by_default, "{name}, {conditions}: {n_expanded}, and {by_default} by default");
        }
    }
    // As before there was anything but the default.
    assert_eq!(n_default[..2], [685, 5622]);
}
