//! What is read and could be meant otherwise: outcomes, values that no state has, observations that repeat themselves.

use serde_json::{Value, json};

use super::{line, pointers, stream};
use crate::harness::service::Service;

#[tokio::test]
async fn a_model_of_several_outcomes_is_kept_and_refused_where_it_would_be_searched() {
    let service = Service::start(&[]).await;
    let mut slippery = line();
    slippery["dynamics"]["transitions"] =
        json!([[0, "on", 1, 0.9, 2.5], [0, "on", 0, 0.1], [1, "on", 2, 1, 0.5], [2, "back", 1]]);
    let (status, made) = service.put("/v1/models/slippery", &slippery).await;
    assert_eq!(
        (status, &made["counts"]["stochastic"], &made["counts"]["transitions"]),
        (201, &json!(1), &json!(4)),
        "{made}"
    );
    let (_, read) = service.get("/v1/models/slippery").await;
    let written = json!([[0, "on", 1, 0.9, 2.5], [0, "on", 0, 0.1], [1, "on", 2, 1.0, 0.5], [2, "back", 1]]);
    assert_eq!((&read["definition"]["dynamics"]["transitions"], &read["counts"]), (&written, &made["counts"]));
    assert_eq!(service.put("/v1/models/slippery", &read["definition"]).await.0, 200);
    let (_, page) = service.get("/v1/models").await;
    assert_eq!(page["items"][0]["counts"], made["counts"]);
    for other in
        [json!([[0, "on", 1, 0.9], [0, "on", 0, 0.1], [1, "on", 2, 1, 0.5], [2, "back", 1]]), json!([[0, "on", 1]])]
    {
        let mut model = slippery.clone();
        model["dynamics"]["transitions"] = other;
        let (_, made_otherwise) = service.put("/v1/models/other", &model).await;
        assert_ne!(made_otherwise["hash"], made["hash"]);
        service.delete("/v1/models/other").await;
    }

    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    let demonstration = json!([{"x": 0}, {"x": 2}]);
    let request = json!({"model": "slippery", "demonstration": demonstration});
    let batch = json!({"model": "slippery", "items": [{"demonstration": demonstration}]});
    for (path, body) in [("policies", &request), ("policies:batch", &batch), ("learners/l/trials", &request)] {
        let (status, problem) = service.post(&format!("/v1/{path}"), body).await;
        let [fault] = &problem["errors"].as_array().unwrap()[..] else { panic!("{problem}") };
        assert_eq!((status, &fault["pointer"]), (422, &json!("/model")), "{path}: {problem}");
        assert!(fault["detail"].as_str().unwrap().starts_with("this model is stochastic"), "{path}: {problem}");
    }
    let frames = stream(&service, &[json!({"type": "open", "model": "slippery"})]).await;
    let told = &frames[1]["problem"]["errors"][0];
    assert!(told["pointer"] == "/model" && told["detail"].as_str().unwrap().contains("stochastic"), "{frames:?}");
    service.stop().await;
}

#[tokio::test]
async fn policies_warn_of_what_can_hardly_be_meant_and_keep_it() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    let odd = json!([{"x": 0, "door": "Open"}, {"x": 2, "door": "shut"}]);
    let request = json!({"model": "line", "demonstration": odd});
    let at = |pointer: &str| {
        json!([{
            "pointer": pointer,
            "detail": "no state has \"Open\": it differs from all of them alike; is \"open\" meant? (in 1 observation)",
        }])
    };
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &policy["warnings"]), (201, &at("/demonstration/0/door")), "{policy}");
    let (_, read) = service.get(&format!("/v1/policies/{}", policy["id"].as_str().unwrap())).await;
    assert_eq!(read, policy);
    let (_, trial) = service.post("/v1/learners/l/trials", &request).await;
    assert_eq!(trial["policy"]["warnings"], at("/demonstration/0/door"), "{trial}");
    let right = json!([{"x": 0, "door": "open"}]);
    let batch = json!({"model": "line", "items": [{"demonstration": right}, {"demonstration": odd}]});
    let (_, answers) = service.post("/v1/policies:batch", &batch).await;
    let warnings: Vec<_> = answers["items"].as_array().unwrap().iter().map(|item| &item["warnings"]).collect();
    assert_eq!(warnings, [&json!([]), &at("/items/1/demonstration/0/door")], "{answers}");
    // The answer is the same as if nothing had been said.
    let told_of = json!({"model": "line", "demonstration": [{"x": 0, "door": "ajar"}, {"x": 2, "door": "shut"}]});
    assert_eq!(service.post("/v1/policies", &told_of).await.1["steps"], policy["steps"]);
    service.stop().await;
}

#[tokio::test]
async fn what_repeats_itself_is_left_out_where_a_request_says_so() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    // Of ten observations, those at 0, 5 and 9 are kept.
    let seen: Vec<Value> =
        (0..10).map(|n| json!({"x": f64::from(n / 5) + 0.01 * f64::from(n), "door": "open"})).collect();
    let mut request =
        json!({"model": "line", "demonstration": seen, "observation_weights": [1, 9, 9, 9, 9, 2, 9, 9, 9, 3]});
    let collapse = json!({"x": 0.5});
    request["collapse"] = collapse.clone();
    let (status, policy) = service.post("/v1/policies", &request).await;
    let observations: Vec<_> =
        policy["steps"].as_array().unwrap().iter().map(|step| step["observation"].as_u64().unwrap()).collect();
    assert_eq!((status, observations), (201, vec![0, 5, 9]), "{policy}");
    assert_eq!(policy["coverage"]["observed"], 3);
    let alone = json!({
        "model": "line", "demonstration": [seen[0], seen[5], seen[9]], "observation_weights": [1, 2, 3],
    });
    let (_, alone) = service.post("/v1/policies", &alone).await;
    assert_eq!((&alone["cost"], &alone["end"]), (&policy["cost"], &policy["end"]));
    let (_, read) = service.get(&format!("/v1/policies/{}", policy["id"].as_str().unwrap())).await;
    assert_eq!(read, policy);

    // Likewise in a batch, by all items or by one, and as it is refined.
    let batch = json!({"model": "line", "collapse": collapse, "items": [{"demonstration": seen}, {"demonstration": seen, "collapse": {}}]});
    let (_, answers) = service.post("/v1/policies:batch", &batch).await;
    let n_observed = |n: usize| answers["items"][n]["coverage"]["observed"].as_u64().unwrap();
    assert_eq!((n_observed(0), n_observed(1)), (3, 10), "{answers}");
    request["lookahead"] = json!(1);
    let (_, local) = service.post("/v1/policies", &request).await;
    if local["status"] == "local" {
        let refined = service.refined(local["id"].as_str().unwrap()).await;
        assert_eq!((&refined["cost"], &refined["coverage"]), (&policy["cost"], &policy["coverage"]));
    }
    // A warning leads to where the value stands in what was sent.
    let odd =
        json!({"model": "line", "collapse": {"x": 9}, "demonstration": [{"x": 0}, {"x": 1}, {"door": "ajar"}, {}]});
    let (_, warned) = service.post("/v1/policies", &odd).await;
    assert_eq!(pointers(&warned["warnings"]), ["/demonstration/2/door"], "{warned}");

    for (collapse, pointer) in [
        (json!({"y": 1}), "/collapse/y"),
        (json!({"door": 1}), "/collapse/door"),
        (json!({"x": -1}), "/collapse/x"),
        (json!(0.5), "/collapse"),
    ] {
        request["collapse"] = collapse;
        let (status, problem) = service.post("/v1/policies", &request).await;
        assert_eq!((status, pointers(&problem["errors"])), (422, vec![pointer]), "{problem}");
    }
    let trial = json!({"model": "line", "demonstration": seen, "collapse": {"x": 1}});
    let (status, problem) = service.post("/v1/learners/l/trials", &trial).await;
    assert_eq!((status, pointers(&problem["errors"])), (422, vec!["/collapse"]), "{problem}");
    service.stop().await;
}
