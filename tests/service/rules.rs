//! Models that are told by rules, from outside.

use serde_json::{Value, json};

use crate::harness::service::Service;

/// A corridor with a door that opens now and then, or always.
fn corridor(opens: f64) -> Value {
    let opened = json!({"door": "'open'"});
    let outcomes = match opens {
        1.0 => json!([{"probability": 1, "then": opened}]),
        _ => json!([{"probability": opens, "then": opened}, {"probability": 1.0 - opens, "then": {}}]),
    };
    json!({
        "attributes": [
            {"name": "x", "kind": "number", "values": {"from": 0, "to": 9, "step": 1}},
            {"name": "door", "kind": "category", "values": ["open", "shut"]},
            {"name": "fuel", "kind": "number", "values": {"from": 0, "to": 9}, "hidden": true},
        ],
        "actions": [{"name": "forward", "cost": 1.0}, {"name": "open", "cost": 0.5}],
        "dynamics": {
            "kind": "rules", "constants": {"walls": [7]}, "start": {"x": 0, "door": "shut", "fuel": 9},
            "rules": [
                {
                    "action": "forward", "when": "fuel > 0 && x < 9 && !(x + 1 in walls)", "then": {"x": "x + 1", "fuel": "fuel - 1"},
                    "cost": "1.0 + double(x) / 10.0",
                },
                {"action": "open", "when": "door == 'shut'", "outcomes": outcomes},
            ],
            "unsafe": "x == 5 && door == 'shut'",
        },
    })
}

#[tokio::test]
async fn a_model_told_by_rules_is_registered_read_and_followed_also_after_a_restart() {
    let service = Service::start(&[]).await;
    let (status, model) = service.put("/v1/models/m", &corridor(1.0)).await;
    assert_eq!(status, 201, "{model}");
    assert_eq!(
        model["counts"],
        json!({"attributes": 3, "actions": 2, "states": 12, "transitions": 15, "stochastic": 0, "unsafe": 0})
    );
    assert_eq!(
        model["attributes"][2],
        json!({"name": "fuel", "kind": "number", "scale": 1.0, "weight": 0.0, "hidden": true})
    );
    assert_eq!(service.put("/v1/models/m", &corridor(1.0)).await.0, 200);
    let request = json!({"model": "m", "demonstration": [{"x": 0}, {"x": 3}, {"x": 6, "door": "shut"}], "extra_weight": 0, "weights": {"x": 9}, "store": false});
    let follow = async |service: &Service| {
        let (status, mut policy) = service.post("/v1/policies", &request).await;
        assert_eq!(status, 200, "{policy}");
        policy["search"]["elapsed_us"] = 0.into();
        policy
    };
    let policy = follow(&service).await;
    // Six steps at 1.0 to 1.5, the door that must be open at 5 and then is not as it was seen.
    assert_eq!((&policy["cost"]["total"], &policy["status"]), (&json!(9.0), &json!("optimal")), "{policy}");
    assert_eq!(
        policy["steps"].as_array().unwrap().last().unwrap()["state"],
        json!({"x": 6, "door": "open", "fuel": 3})
    );
    let service = Service::start_in(service.stop().await, &[]).await;
    assert_eq!(follow(&service).await, policy);
}

#[tokio::test]
async fn rules_of_more_states_than_the_limit_are_searched_lazily() {
    let service = Service::start(&["--max-states", "11"]).await;
    let (status, model) = service.put("/v1/models/m", &corridor(1.0)).await;
    assert_eq!((status, &model["counts"]["states"]), (201, &Value::Null), "{model}");
    let request = json!({"model": "m", "demonstration": [{"x": 0}, {"x": 3}, {"x": 6, "door": "shut"}], "extra_weight": 0, "weights": {"x": 9}});
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!(
        (status, &policy["cost"]["total"], &policy["status"]),
        (201, &json!(9.0), &json!("optimal")),
        "{policy}"
    );
}

#[tokio::test]
async fn rules_with_several_outcomes_are_counted_and_refused_by_what_cannot_search_them() {
    for max_states in ["1000", "1"] {
        let service = Service::start(&["--max-states", max_states]).await;
        let (status, model) = service.put("/v1/models/m", &corridor(0.9)).await;
        assert_eq!(status, 201, "{model}");
        assert!(model["counts"]["stochastic"].as_u64() > Some(0), "{model}");
        let (status, problem) = service.post("/v1/policies", &json!({"model": "m", "demonstration": [{"x": 0}]})).await;
        assert_eq!(status, 422, "{problem}");
    }
}

#[tokio::test]
async fn faults_of_rules_are_told_with_rule_and_column_also_those_that_only_a_state_shows() {
    let service = Service::start(&[]).await;
    let mut model = corridor(1.0);
    model["dynamics"]["rules"][0]["when"] = "fule > 0".into();
    model["dynamics"]["unsafe"] = "x + 'a' == 2".into();
    let (status, problem) = service.put("/v1/models/m", &model).await;
    assert_eq!(status, 422);
    let told = |problem: &Value, n: usize| {
        let error = &problem["errors"][n];
        (error["pointer"].as_str().unwrap().to_owned(), error["detail"].as_str().unwrap().to_owned())
    };
    let (pointer, detail) = told(&problem, 0);
    assert!(pointer == "/dynamics/rules/0/when" && detail.starts_with("rule 0, column 1: unknown name"), "{detail}");
    assert_eq!(
        told(&problem, 1),
        ("/dynamics/unsafe".into(), "column 3: + cannot be applied to int and string".into())
    );

    let mut model = corridor(1.0);
    model["dynamics"]["rules"][0]["when"] = "x < 9".into();
    let (status, problem) = service.put("/v1/models/m", &model).await;
    assert_eq!(status, 201, "there is fuel enough: {problem}");
    model["dynamics"]["rules"][0]["then"]["fuel"] = "fuel - 2".into();
    let (status, problem) = service.put("/v1/models/n", &model).await;
    assert_eq!(status, 422);
    let (pointer, detail) = told(&problem, 0);
    assert_eq!(pointer, "/dynamics/rules/0/then/fuel");
    assert!(
        detail.starts_with(
            "rule 0, column 1: this is -1, which is none of the values of \"fuel\", which are 0 to 9, in the state"
        ),
        "{detail}"
    );
}

#[tokio::test]
async fn a_hidden_attribute_is_neither_observed_nor_weighed() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &corridor(1.0)).await;
    let request = json!({
        "model": "m", "demonstration": [{"x": 0, "fuel": 3}, [1, "open", null], [1, "open", 2]], "weights": {"fuel": 1},
        "start": {"x": 1, "fuel": 8, "door": "shut"},
    });
    let (status, problem) = service.post("/v1/policies", &request).await;
    let mut pointers: Vec<&str> =
        problem["errors"].as_array().unwrap().iter().map(|error| error["pointer"].as_str().unwrap()).collect();
    pointers.sort_unstable();
    assert_eq!((status, pointers), (422, vec!["/demonstration/0/fuel", "/demonstration/2/2", "/weights/fuel"]));
}
