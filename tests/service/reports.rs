//! Reports: what inspection finds, over HTTP.

use crate::harness::service::{Service, example};
use serde_json::{Value, json};

/// A ring of four cells that can be gone round one way only, a cell beside it, and one that is never come to.
fn ring() -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "lamp", "kind": "category"}],
        "actions": [{"name": "on", "cost": 0.3}, {"name": "leave"}, {"name": "jump"}],
        "dynamics": {
            "kind": "table", "start": 0, "states": [[0, "off"], [1, "off"], [2, "off"], [3, "off"], [9, "off"], [5, "lit"]],
            "transitions": [[0, "on", 1], [1, "on", 2], [2, "on", 3], [3, "on", 0], [2, "leave", 4], [5, "jump", 0]],
        },
    })
}

fn pointers(problem: &Value) -> Vec<&str> {
    problem["errors"].as_array().unwrap().iter().map(|fault| fault["pointer"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn a_model_is_reported_on_with_what_its_body_comes_to_and_what_it_cannot_undo() {
    let service = Service::start(&[]).await;
    let (_, model) = service.put("/v1/models/ring", &ring()).await;
    let (status, report) = service.get("/v1/models/ring/report").await;
    assert_eq!(status, 200, "{report}");
    assert_eq!(
        (&report["model"], &report["model_hash"], &report["counts"]),
        (&json!("ring"), &model["hash"], &model["counts"])
    );
    let expected = json!({
        "starts": 1, "states": 5, "transitions": 5,
        "unreachable": {"states": 1, "examples": [{"state_index": 5, "state": {"x": 5, "lamp": "lit"}}]},
        "dead_ends": {"states": 1, "examples": [{"state_index": 4, "state": {"x": 9, "lamp": "off"}}]},
    });
    assert_eq!(report["reach"], expected);
    let example = |index: u64, x: u64| json!({"state_index": index, "state": {"x": x, "lamp": "off"}});
    let expected = json!({"parts": 2, "final": 1, "largest": [
        {"states": 4, "starts": 1, "final": false, "example": example(0, 0)},
        {"states": 1, "starts": 0, "final": true, "example": example(4, 9)},
    ]});
    assert_eq!(report["parts"], expected);
    let expected = json!([
        {"name": "x", "kind": "number", "weight": 1.0, "hidden": false, "distinct": 5, "span": {"least": 0.0, "greatest": 9.0}, "values": null, "changed_by": 5},
        {"name": "lamp", "kind": "category", "weight": 1.0, "hidden": false, "distinct": 1, "span": null, "values": ["off"], "changed_by": 0},
    ]);
    assert_eq!(report["attributes"], expected);
    let expected = json!([
        {"name": "on", "cost": 0.3, "applies_in": 4, "undone_in": 3, "never_undone": 0},
        {"name": "leave", "cost": 1.0, "applies_in": 1, "undone_in": null, "never_undone": 1},
        {"name": "jump", "cost": 1.0, "applies_in": 0, "undone_in": null, "never_undone": 0},
    ]);
    assert_eq!(report["actions"], expected);
    let expected = json!({
        "exact": true, "transitions": 5, "examined": 5, "never": 1, "not_found": 0,
        "steps": {"median": 3, "p99": 3, "greatest": 3},
    });
    assert_eq!((&report["undo"], &report["lookahead"]), (&expected, &json!(4)));
    assert_eq!((&report["demonstration"], &report["unknown"]), (&Value::Null, &json!([])));
    assert_eq!(service.get("/v1/models/none/report").await.0, 404);
}

#[tokio::test]
async fn a_demonstration_is_reported_on_with_what_no_state_meets_and_what_that_costs_at_least() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/ring", &ring()).await;
    let request = json!({
        "demonstration": [{"x": 1, "lamp": "lit"}, {"x": 5}, {"lamp": "lit"}, [3, "off"]],
        "weights": {"lamp": 4}, "observation_weights": [1, 2, 0.5, 1],
    });
    let (status, report) = service.post("/v1/models/ring/report", &request).await;
    assert_eq!(status, 200, "{report}");
    let found = &report["demonstration"];
    assert_eq!((&found["observations"], &found["met"], &found["unmet"]), (&json!(4), &json!(1), &json!([0, 1, 2])));
    assert_eq!((&found["distance"], &report["weights"]["lamp"]), (&json!(4.0 + 2.0 * 4.0 + 0.5 * 4.0), &json!(4.0)));
    let expected = json!([
        {"name": "x", "observed": 3, "unmet": 1, "distinct": 1, "distance": 8.0, "values": [{"value": 5, "closest": 3, "observations": 1, "first": 1}]},
        {"name": "lamp", "observed": 3, "unmet": 2, "distinct": 1, "distance": 6.0, "values": [{"value": "lit", "closest": "off", "observations": 2, "first": 0}]},
    ]);
    assert_eq!(found["attributes"], expected);
    // No policy has less.
    let mut policy = request.clone();
    policy["model"] = json!("ring");
    let (_, policy) = service.post("/v1/policies", &policy).await;
    assert!(policy["cost"]["distance"].as_f64().unwrap() >= 14.0, "{policy}");
    // Of a demonstrator with attributes of its own.
    let own = json!({"demonstration": [{"cm": 100}, {"cm": 500}], "observe": {"x": "cm / 100.0"}});
    let (_, report) = service.post("/v1/models/ring/report", &own).await;
    assert_eq!(report["demonstration"]["attributes"][0]["values"][0]["value"], 5, "{report}");
    // From a start that the model does not say, with another body.
    let other = json!({"demonstration": [{"x": 5}], "start": 5, "without": ["on"]});
    let (_, report) = service.post("/v1/models/ring/report", &other).await;
    assert_eq!((&report["reach"]["states"], &report["demonstration"]["met"]), (&json!(2), &json!(1)));
}

#[tokio::test]
async fn all_that_is_wrong_with_a_request_for_a_report_is_told() {
    let service = Service::start(&["--max-deadline", "1s"]).await;
    service.put("/v1/models/ring", &ring()).await;
    let request = json!({
        "weights": {"y": 1}, "without": ["fly"], "start": 9, "heuristic": "none", "deadline_ms": 2000,
        "demonstration": [{"x": "far"}], "observation_weights": [-1],
    });
    let (status, problem) = service.post("/v1/models/ring/report", &request).await;
    let mut found = pointers(&problem);
    found.sort_unstable();
    let expected = [
        "/deadline_ms",
        "/demonstration/0/x",
        "/heuristic",
        "/observation_weights/0",
        "/start",
        "/weights/y",
        "/without/0",
    ];
    assert_eq!((status, found), (422, expected.to_vec()), "{problem}");
    let (status, problem) = service.post("/v1/models/ring/report", &json!({})).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/demonstration"]), "{problem}");
    let (status, problem) = service.post("/v1/models/ring/report", &json!([])).await;
    assert_eq!(status, 422, "{problem}");
}

#[tokio::test]
async fn what_there_is_no_time_for_is_left_out_of_a_report_which_says_so() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let mut request = json!({"demonstration": example("figure-4/request.json")["demonstration"]});
    let (_, whole) = service.post("/v1/models/figure-4/report", &request).await;
    assert_eq!((&whole["lookahead"], &whole["unknown"]), (&json!(6), &json!([])));
    request["deadline_ms"] = json!(0);
    let (status, report) = service.post("/v1/models/figure-4/report", &request).await;
    assert_eq!((status, &report["reach"]), (200, &Value::Null), "{report}");
    assert_eq!(report["unknown"][0]["pointer"], "/reach");
}

#[tokio::test]
async fn a_model_whose_actions_have_several_outcomes_is_reported_on() {
    let service = Service::start(&[]).await;
    let mut model = ring();
    model["dynamics"]["transitions"][0] = json!([0, "on", 1, 0.5]);
    model["dynamics"]["transitions"].as_array_mut().unwrap().push(json!([0, "on", 0, 0.5]));
    assert_eq!(service.put("/v1/models/ring", &model).await.0, 201);
    let (status, report) = service.get("/v1/models/ring/report").await;
    assert_eq!(
        (status, &report["counts"]["stochastic"], &report["lookahead"]),
        (200, &json!(1), &json!(4)),
        "{report}"
    );
}
