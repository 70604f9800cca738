//! How inputs are read: what is taken, and what is told of what is not.

use reqwest::header::CONTENT_TYPE;
use serde_json::{Value, json};

use crate::harness::service::Service;

/// A line of three states, over which a body goes on or back.
fn line() -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
        "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}],
        "dynamics": {
            "kind": "table", "states": [[0, "open"], [1, "open"], [2, "shut"]],
            "transitions": [[0, "on", 1], [1, "on", 2], [1, "back", 0], [2, "back", 1]], "start": 0,
        },
    })
}

/// What a stream answers to these frames, which are all it is sent.
async fn stream(service: &Service, frames: &[Value]) -> Vec<Value> {
    let lines: Vec<String> = frames.iter().map(ToString::to_string).collect();
    stream_text(service, lines.join("\n")).await
}

async fn stream_text(service: &Service, text: impl Into<reqwest::Body>) -> Vec<Value> {
    let request = service.client.post(service.url("/v1/stream")).header(CONTENT_TYPE, "application/x-ndjson");
    let answered = request.body(text).send().await.unwrap().text().await.unwrap();
    answered.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

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
