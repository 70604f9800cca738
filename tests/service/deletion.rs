//! Deletion of policies, trials and sessions, from outside.

use serde_json::{Value, json};

use crate::harness::service::{Service, example};
use crate::stream::client::Client;

async fn figure_4() -> Service {
    let service = Service::start(&[]).await;
    assert_eq!(service.put("/v1/models/figure-4", &example("figure-4/model.json")).await.0, 201);
    service
}

/// A local policy, and the one that refines it.
async fn refined(service: &Service) -> [String; 2] {
    let mut request = example("figure-4/request.json");
    request["lookahead"] = json!(1);
    let (_, local) = service.post("/v1/policies", &request).await;
    let refined = service.refined(local["id"].as_str().unwrap()).await;
    [local, refined].map(|policy| format!("/v1/policies/{}", policy["id"].as_str().unwrap()))
}

fn kind(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["type"].as_str().unwrap_or_default())
}

#[tokio::test]
async fn a_policy_is_deleted_once_and_leaves_no_link_behind() {
    let service = figure_4().await;
    let [local, optimum] = refined(&service).await;
    let before = service.get(&optimum).await.1;
    assert_eq!(service.delete(&local).await, (204, json!("")));
    assert_eq!(kind(&service.delete(&local).await), (404, "/problems/unknown-policy"));
    assert_eq!(kind(&service.get(&local).await), (404, "/problems/unknown-policy"));
    let mut expected = before;
    expected["refines"] = Value::Null;
    assert_eq!(service.get(&optimum).await, (200, expected.clone()));
    for member in ["actions", "steps"] {
        expected.as_object_mut().unwrap().remove(member);
    }
    assert_eq!(service.get("/v1/policies").await.1, json!({"items": [expected], "next": null}));

    let [local, optimum] = refined(&service).await;
    assert_eq!(service.delete(&optimum).await.0, 204);
    assert_eq!(service.get(&local).await.1["refined_by"], Value::Null);
    assert_eq!(kind(&service.delete("/v1/policies/nothing").await), (404, "/problems/unknown-policy"));
}

#[tokio::test]
async fn a_trial_is_deleted_unless_it_has_a_reward_and_no_other_has_its_number() {
    let service = Service::start(&["--learn-every", "1000h"]).await;
    service.put("/v1/models/figure-6", &example("figure-6/model.json")).await;
    let learner = json!({"attributes": ["x", "y", "heading", "gold", "arrows"], "seed": 7});
    service.put("/v1/learners/gold", &learner).await;
    let request = json!({"model": "figure-6", "demonstration": example("figure-6/demonstration.json")});
    let mut trials = Vec::new();
    for _ in 0..3 {
        trials.push(service.post("/v1/learners/gold/trials", &request).await.1);
    }
    let path = |n: usize| format!("/v1/trials/{}", trials[n]["id"].as_str().unwrap());
    let policy = |n: usize| format!("/v1/policies/{}", trials[n]["policy_id"].as_str().unwrap());
    // The policy of a trial is needed as long as that is there.
    assert_eq!(kind(&service.delete(&policy(2)).await), (409, "/problems/in-use"));
    assert_eq!(service.delete(&path(2)).await.0, 204);
    assert_eq!(kind(&service.delete(&path(2)).await), (404, "/problems/unknown-trial"));
    let late = service.put(&format!("{}/reward", path(2)), &json!({"reward": 1})).await;
    assert_eq!(kind(&late), (404, "/problems/unknown-trial"));
    assert_eq!(service.get(&policy(2)).await.0, 200, "it stays");
    assert_eq!(service.delete(&policy(2)).await.0, 204);
    // A reward keeps its trial, learned or not.
    assert_eq!(service.put(&format!("{}/reward", path(0)), &json!({"reward": 5})).await.0, 200);
    assert_eq!(kind(&service.delete(&path(0)).await), (409, "/problems/in-use"));
    service.post("/v1/learners/gold/learn", &Value::Null).await;
    let needed = service.delete(&path(0)).await;
    assert_eq!(kind(&needed), (409, "/problems/in-use"));
    assert!(needed.1["detail"].as_str().unwrap().contains("reward"), "{}", needed.1);
    // A failed one goes.
    service.post(&format!("{}/fail", path(1)), &json!({"reason": "rain"})).await;
    assert_eq!(service.delete(&path(1)).await.0, 204);
    let service = Service::start_in(service.stop().await, &[]).await;
    let (_, next) = service.post("/v1/learners/gold/trials", &request).await;
    assert_eq!(next["number"], 4, "also after a restart");
    assert_eq!(service.get("/v1/learners/gold/trials").await.1["items"].as_array().unwrap().len(), 2);
}

#[tokio::test]
async fn a_session_that_runs_is_deleted_and_whoever_drives_it_is_told() {
    let service = figure_4().await;
    let mut client = Client::connect(&service).await;
    let session = client.open(json!({"type": "open", "model": "figure-4"})).await;
    client.send(json!({"type": "observe", "seq": 0, "states": [{"x": 0}]})).await;
    client.receive_until("received").await;
    let path = format!("/v1/sessions/{session}");
    assert_eq!(service.delete(&path).await.0, 204);
    let error = client.receive_until_error().await;
    assert_eq!(error["problem"]["type"], "/problems/taken-over");
    assert_eq!(client.closed().await, 1008);
    for gone in [service.delete(&path).await, service.get(&path).await] {
        assert_eq!(kind(&gone), (404, "/problems/unknown-session"));
    }
    assert_eq!(service.get("/v1/sessions").await.1["items"], json!([]));
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/unknown-session");
    assert_eq!(client.closed().await, 4404);
}

#[tokio::test]
async fn a_session_that_is_done_and_its_policy_are_deleted_one_without_the_other() {
    let service = figure_4().await;
    let demonstration = example("figure-4/demonstration.json");
    let mut sessions = Vec::new();
    for _ in 0..2 {
        let mut client = Client::connect(&service).await;
        let session = client.open(json!({"type": "open", "model": "figure-4"})).await;
        client.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
        client.send(json!({"type": "end", "seq": 16})).await;
        let done = client.receive_until("done").await.pop().unwrap();
        assert_eq!(client.closed().await, 1000);
        sessions.push((session, done));
    }
    let [(first, _), (second, done)] = &sessions[..] else { panic!("there are two") };
    assert_eq!(service.delete(&format!("/v1/sessions/{first}")).await.0, 204);
    let (_, list) = service.get("/v1/policies").await;
    assert!(list["items"].as_array().unwrap().len() >= 2, "the policy stays");

    let policy = format!("/v1/policies/{}", done["policy_id"].as_str().unwrap());
    assert_eq!(service.delete(&policy).await.0, 204);
    let (_, session) = service.get(&format!("/v1/sessions/{second}")).await;
    assert_eq!((&session["status"], &session["policy_id"]), (&json!("done"), &Value::Null));
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": second})).await;
    let again = client.receive_until("done").await.pop().unwrap();
    assert_eq!((&again["policy_id"], &again["actions"]), (&Value::Null, &done["actions"]));
    assert_eq!(client.closed().await, 1000);
}
