use serde_json::{Value as Json, json};

use super::{Warning, Watch};
use crate::document::{Faults, Path, Place};
use crate::interrupt::Uninterrupted;
use crate::mapping::{Demonstration, Problem, Request};
use crate::model::{Definition, Limits, Model};

fn model(attributes: &Json, states: &Json, cost: f64) -> Model {
    let n_states = states.as_array().unwrap().len();
    let transitions: Vec<_> = (1..n_states).map(|to| json!([to - 1, "on", to])).collect();
    let document = json!({
        "attributes": attributes, "actions": [{"name": "on", "cost": cost}],
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
    });
    let definition = Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap()
}

/// A door, a lamp and a place.
fn rooms() -> Model {
    let attributes = json!([
        {"name": "door", "kind": "category"}, {"name": "lit", "kind": "category"}, {"name": "x", "kind": "number"},
        {"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]},
    ]);
    model(
        &attributes,
        &json!([["open", true, 0, "east"], ["shut", false, 1, "east"], ["open", false, 2, "north"]]),
        0.3,
    )
}

fn problem<'m>(model: &'m Model, request: &Json) -> Problem<'m> {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let read = Request::read(model, &object, &mut faults);
    faults.check(read).unwrap().problem
}

fn told(model: &Model, request: &Json) -> Vec<String> {
    let warnings = problem(model, request).warnings(&Path::Member(&Path::Root, "demonstration"));
    warnings.into_iter().map(|Warning { pointer, detail }| format!("{pointer}: {detail}")).collect()
}

#[test]
fn a_category_or_a_label_that_no_state_has_is_told_with_what_may_be_meant() {
    let model = rooms();
    let told = |demonstration: Json| told(&model, &json!({"model": "m", "demonstration": demonstration}));
    assert_eq!(
        told(json!([{"door": "Open", "x": 0}, {"door": "shut", "x": 1}])),
        [
            "/demonstration/0/door: no state has \"Open\": it differs from all of them alike; is \"open\" meant? (in 1 observation)"
        ]
    );
    assert_eq!(
        told(json!([{"lit": 1}, {"lit": "false"}])),
        [
            "/demonstration/0/lit: no state has 1, nor others that were observed: it differs from all of them alike; is true \
          meant? (in 2 observations)"
        ]
    );
    assert_eq!(
        told(json!([{"door": "open"}, {"door": "ajar", "heading": "south"}, {"door": "ajar"}])),
        [
            "/demonstration/1/door: no state has \"ajar\": it differs from all of them alike; they have \"open\", \"shut\" (in 2 \
             observations)",
            "/demonstration/1/heading: no state has \"south\": it differs from all of them alike; they have \"east\", \"north\" (in \
             1 observation)",
        ]
    );
    assert!(told(json!([{"door": "open", "lit": false, "heading": "north"}, {}])).is_empty());
}

#[test]
fn numbers_that_all_lie_outside_those_of_the_states_are_told_with_both_ranges() {
    let model = rooms();
    let told = |demonstration: Json| told(&model, &json!({"model": "m", "demonstration": demonstration}));
    assert_eq!(
        told(json!([{}, {"x": 1200}, {"x": 1350}])),
        [
            "/demonstration/1/x: all observed values lie outside those of the states: observed are 1200 to 1350, states have 0 to 2; are \
          they in other units? (in 2 observations)"
        ]
    );
    // One that lies within is enough.
    assert!(told(json!([{"x": 1200}, {"x": 2}])).is_empty());
}

#[test]
fn what_weighs_nothing_is_told_nothing_of() {
    let request = json!({
        "model": "m", "demonstration": [{"door": "Open", "x": 1200, "lit": true}], "weights": {"door": 0, "x": 0},
    });
    assert!(told(&rooms(), &request).is_empty());
}

#[test]
fn a_distance_that_swallows_the_digits_of_others_is_told() {
    let attributes = json!([{"name": "t", "kind": "number"}, {"name": "x", "kind": "number"}]);
    let model = model(&attributes, &json!([[0, 0], [0, 1], [0, 2]]), 0.3);
    let told = |t: f64| {
        let seen: Vec<_> = (0..3).map(|n| json!({"t": t + f64::from(n), "x": n})).collect();
        told(&model, &json!({"model": "m", "demonstration": seen}))
    };
    // Seconds since 1970, where the body's clock stands.
    let since_1970 = told(1.7e9);
    assert_eq!(since_1970.len(), 2, "{since_1970:?}");
    assert!(since_1970[0].starts_with("/demonstration/0/t: all observed values lie outside"), "{since_1970:?}");
    let swallowing =
        "/demonstration/0/t: the distance in this attribute is the same for every state, and so large (8.67";
    assert!(since_1970[1].starts_with(swallowing) && since_1970[1].ends_with("(in 3 observations)"), "{since_1970:?}");
    // Far, but the digits of the others are there.
    assert_eq!(told(100.0).len(), 1);
}

#[test]
fn actions_that_cost_more_than_distances_could_shrink_by_are_told() {
    let attributes = json!([{"name": "x", "kind": "number"}]);
    let request = |x: u32| json!({"model": "m", "demonstration": [{"x": 0}, {"x": x}]});
    let dear = model(&attributes, &json!([[0], [1], [2]]), 4.5);
    let told_of_dear = told(&dear, &request(2));
    let [warning] = &told_of_dear[..] else { panic!("{told_of_dear:?}") };
    assert!(warning.starts_with(
        "/demonstration: the cheapest action costs 4.5, and all distances together could shrink by no more than 4:"
    ));
    // Nothing is to be gained, or enough.
    assert!(told(&dear, &request(0)).is_empty());
    assert!(told(&model(&attributes, &json!([[0], [1], [2]]), 3.5), &request(2)).is_empty());
}

#[test]
fn of_many_values_it_is_known_which_states_have_them() {
    let attributes = json!([{"name": "name", "kind": "category"}]);
    let states: Vec<_> = (0..1000).map(|n| json!([format!("room {n}")])).collect();
    let model = model(&attributes, &states.into(), 0.1);
    let seen: Vec<_> = (990..1010).map(|n| json!({"name": format!("room {n}")})).collect();
    let told = told(&model, &json!({"model": "m", "demonstration": seen}));
    assert_eq!(told.len(), 1, "{told:?}");
    assert!(
        told[0].starts_with("/demonstration/10/name: no state has \"room 1000\", nor others")
            && told[0].ends_with("(in 10 observations)")
    );
}

#[test]
fn a_watch_tells_what_is_new_once_and_all_of_it_in_the_end() {
    let model = rooms();
    let seen = json!([{"x": 7}, {"x": 8, "door": "Open"}, {"x": 1, "door": "Open"}]);
    let demonstration = Demonstration::read(model.schema(), &Place::root(&seen), &mut Faults::default()).unwrap();
    let mut watch = Watch::new(&model.schema().weights());
    let path = Path::Member(&Path::Root, "states");
    let told = demonstration.iter().enumerate().map(|(index, observation)| {
        watch.observe(&model, index, observation);
        let news = watch.news(&model, index, &path);
        news.into_iter().map(|warning| warning.pointer).collect::<Vec<_>>()
    });
    assert_eq!(told.collect::<Vec<_>>(), [vec!["/states/0/x"], vec!["/states/0/door"], vec![]]);
    let all = watch.warnings(&model, &path);
    assert_eq!(all.len(), 1);
    assert!(all[0].pointer == "/states/1/door" && all[0].detail.ends_with("(in 2 observations)"), "{all:?}");
}
