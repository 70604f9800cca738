//! Many observations in a frame, and frames that would be longer than any may be.

use serde_json::{Value, json};

use super::client::Client;
use super::{figure_4, steps};
use crate::harness::service::Service;

#[tokio::test]
async fn a_thousand_observations_fit_into_a_frame() {
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "figure-4"})).await;
    let thousand: Vec<Value> = demonstration.iter().cycle().take(1000).map(|state| json!({"x": state["x"]})).collect();
    client.send(json!({"type": "observe", "seq": 0, "states": thousand})).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 1000}));
    client.send(json!({"type": "end", "seq": 1000})).await;
    let frames = client.receive_until("done").await;
    assert_eq!(steps(&frames).last().unwrap()["observation"], 999);
}

/// With thousands of actions of long names, `done` would be larger than any message may be.
#[tokio::test]
async fn no_message_is_longer_than_announced_though_the_actions_of_a_long_session_are() {
    let service = Service::start(&[]).await;
    // Four bytes a character, of which a name has 64 at most.
    let step = "\u{1f463}".repeat(64);
    let toggle = json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": step, "cost": 0}],
        "dynamics": {"kind": "table", "states": [[0], [1]], "transitions": [[0, step, 1], [1, step, 0]], "start": 0},
    });
    assert_eq!(service.put("/v1/models/toggle", &toggle).await.0, 201);
    // As many as fit, and more.
    for n_states in [1000, 6000] {
        let mut client = Client::connect(&service).await;
        let session = client.open(json!({"type": "open", "model": "toggle", "lookahead": 1})).await;
        let states: Vec<Value> = (0..n_states).map(|n| json!([n % 2])).collect();
        client.send(json!({"type": "observe", "seq": 0, "states": states})).await;
        client.send(json!({"type": "end", "seq": n_states})).await;
        let done = client.receive_until("done").await.pop().unwrap();
        assert_eq!(client.closed().await, 1000);
        let (_, policy) = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await;
        assert_eq!(policy["actions"].as_array().unwrap().len(), n_states - 1);
        let told = if n_states == 1000 { &policy["actions"] } else { &Value::Null };
        assert_eq!((&done["actions"], &done["cost"]["total"]), (told, &policy["cost"]["total"]));
        // And once more to who has lost it.
        let mut client = Client::connect(&service).await;
        client.send(json!({"type": "resume", "session": session, "step": n_states - 1})).await;
        assert_eq!(client.receive_until("done").await.last().unwrap(), &done);
        assert_eq!(client.closed().await, 1000);
    }
}

/// As many attributes of as long names and values as a model may have.
#[tokio::test]
async fn a_model_whose_steps_are_longer_than_a_message_ends_the_stream_and_says_so() {
    let service = Service::start(&[]).await;
    let name = |n: usize| format!("{n:0>3}{}", "\u{1f463}".repeat(61));
    let attributes: Vec<Value> = (0..256).map(|n| json!({"name": name(n), "kind": "category"})).collect();
    let state = |letter: &str| vec![letter.repeat(1024); 256];
    let wide = json!({
        "attributes": attributes, "actions": [{"name": "on", "cost": 1}],
        "dynamics": {"kind": "table", "states": [state("a"), state("b")], "transitions": [[0, "on", 1]], "start": 0},
    });
    let (status, answer) = service.put("/v1/models/wide", &wide).await;
    assert_eq!(status, 201, "{answer}");
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "wide", "lookahead": 1})).await;
    client.send(json!({"type": "observe", "seq": 0, "states": [{}]})).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 1}));
    let error = client.receive().await;
    assert_eq!(error["problem"]["type"], "/problems/too-large", "{error}");
    assert_eq!(client.closed().await, 1009);
    // Faults are told as far as they fit.
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "wide"})).await;
    let faulty: serde_json::Map<_, _> = (0..256).map(|n| (name(n), json!([]))).collect();
    let unknown: serde_json::Map<_, _> = (256..512).map(|n| (name(n), json!(0))).collect();
    client.send(json!({"type": "observe", "seq": 0, "states": [faulty, unknown, faulty]})).await;
    let error = client.receive().await;
    let n_told = error["problem"]["errors"].as_array().unwrap().len();
    assert!((100..512).contains(&n_told), "{n_told}");
    assert!(error["problem"]["detail"].as_str().unwrap().contains("512 faults"), "{}", error["problem"]["detail"]);
}
