//! Requests with an `Idempotency-Key`, from outside.

use futures_util::future::join_all;
use reqwest::header::LOCATION;
use reqwest::{Client, Response};
use serde_json::{Value, json};

use crate::harness::process::Process;
use crate::harness::service::{Service, answer, example};

const POLICIES: &str = "/v1/policies";

const TRIALS: &str = "/v1/learners/gold/trials";

async fn start() -> Service {
    let service = Service::start(&[]).await;
    for world in ["figure-4", "figure-6"] {
        service.put(&format!("/v1/models/{world}"), &example(&format!("{world}/model.json"))).await;
    }
    let learner = json!({"attributes": ["x", "y", "heading", "gold", "arrows"], "seed": 7});
    for name in ["gold", "silver"] {
        assert_eq!(service.put(&format!("/v1/learners/{name}"), &learner).await.0, 201);
    }
    service
}

async fn post(service: &Service, path: &str, key: &str, body: &Value) -> Response {
    service.client.post(service.url(path)).header("idempotency-key", key).json(body).send().await.unwrap()
}

/// Everything that is to be the same when it is sent again.
async fn whole(response: Response) -> (u16, Option<String>, String) {
    let location = response.headers().get(LOCATION).map(|location| location.to_str().unwrap().to_owned());
    (response.status().as_u16(), location, response.text().await.unwrap())
}

fn kind(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["type"].as_str().unwrap_or_default())
}

/// A request for a policy that is refined.
fn local() -> Value {
    let mut request = example("figure-4/request.json");
    request["lookahead"] = json!(1);
    request
}

fn trial() -> Value {
    json!({"model": "figure-6", "demonstration": example("figure-6/demonstration.json")})
}

async fn n_items(service: &Service, path: &str) -> usize {
    service.get(path).await.1["items"].as_array().unwrap().len()
}

#[tokio::test]
async fn a_request_that_is_sent_again_with_its_key_is_answered_to_the_byte_as_before() {
    let service = start().await;
    let first = whole(post(&service, POLICIES, "a", &local()).await).await;
    assert_eq!(first.0, 201);
    let policy: Value = serde_json::from_str(&first.2).unwrap();
    // Also once more is known of it, and after a restart.
    service.refined(policy["id"].as_str().unwrap()).await;
    assert_eq!(whole(post(&service, POLICIES, "a", &local()).await).await, first);
    let service = Service::start_in(service.stop().await, &[]).await;
    assert_eq!(whole(post(&service, POLICIES, "a", &local()).await).await, first);
    assert_eq!(n_items(&service, POLICIES).await, 2);

    let mut other = local();
    other["lookahead"] = json!(2);
    let refused = answer(post(&service, POLICIES, "a", &other).await).await;
    assert_eq!(kind(&refused), (422, "/problems/idempotency-key-reused"));
    assert_eq!(answer(post(&service, POLICIES, "b", &other).await).await.0, 201);
    // Without its policy, it is done anew.
    assert_eq!(service.delete(first.1.as_ref().unwrap()).await.0, 204);
    let again = whole(post(&service, POLICIES, "a", &local()).await).await;
    assert!(again.0 == 201 && again.1 != first.1);
}

#[tokio::test]
async fn a_trial_is_drawn_once_for_each_key_of_its_learner() {
    let service = start().await;
    let first = whole(post(&service, TRIALS, "a", &trial()).await).await;
    assert_eq!(first.0, 201);
    let reward = format!("{}/reward", first.1.as_ref().unwrap());
    assert_eq!(service.put(&reward, &json!({"reward": 5})).await.0, 200);
    service.post("/v1/learners/gold/learn", &Value::Null).await;
    assert_eq!(whole(post(&service, TRIALS, "a", &trial()).await).await, first, "as it was drawn");
    assert_eq!(n_items(&service, TRIALS).await, 1);
    // Another learner's, and a policy's, are others.
    let others = answer(post(&service, "/v1/learners/silver/trials", "a", &trial()).await).await;
    assert_eq!((others.0, &others.1["number"]), (201, &json!(1)));
    assert_eq!(answer(post(&service, POLICIES, "a", &local()).await).await.0, 201);
    let next = answer(post(&service, TRIALS, "b", &trial()).await).await;
    assert_eq!((next.0, &next.1["number"]), (201, &json!(2)));
    let mut other = trial();
    other["lookahead"] = json!(3);
    let refused = answer(post(&service, TRIALS, "b", &other).await).await;
    assert_eq!(kind(&refused), (422, "/problems/idempotency-key-reused"));
    // A deleted trial is drawn anew, with a number of its own.
    assert_eq!(service.delete(&format!("/v1/trials/{}", next.1["id"].as_str().unwrap())).await.0, 204);
    let again = answer(post(&service, TRIALS, "b", &other).await).await;
    assert_eq!((again.0, &again.1["number"]), (201, &json!(3)));
}

#[tokio::test]
async fn of_requests_that_come_at_once_with_one_key_one_is_done_and_all_have_its_answer() {
    let service = start().await;
    for (path, body) in [(POLICIES, local()), (TRIALS, trial())] {
        let sent = (0..20).map(|_| async { whole(post(&service, path, "a", &body).await).await });
        let answers = join_all(sent).await;
        assert_eq!(answers[0].0, 201, "{}", answers[0].2);
        assert!(answers.iter().all(|answer| *answer == answers[0]));
    }
    assert_eq!(n_items(&service, TRIALS).await, 1);
    assert_eq!(answer(post(&service, TRIALS, "b", &trial()).await).await.1["number"], 2, "no number was lost");
}

#[tokio::test]
async fn what_failed_or_is_not_stored_may_be_asked_for_with_the_same_key() {
    let service = start().await;
    let mut request = local();
    request["model"] = json!("later");
    assert_eq!(answer(post(&service, POLICIES, "a", &request).await).await.0, 404);
    service.put("/v1/models/later", &example("figure-4/model.json")).await;
    assert_eq!(answer(post(&service, POLICIES, "a", &request).await).await.0, 201);
    let mut unstored = local();
    unstored["store"] = json!(false);
    for lookahead in [1, 2] {
        unstored["lookahead"] = json!(lookahead);
        assert_eq!(answer(post(&service, POLICIES, "b", &unstored).await).await.0, 200);
    }
}

#[tokio::test]
async fn a_key_that_is_none_is_a_fault_of_the_request() {
    let service = start().await;
    let long = "k".repeat(256);
    for (path, body) in [(POLICIES, local()), (TRIALS, trial())] {
        for key in ["", "a b", &long] {
            let refused = answer(post(&service, path, key, &body).await).await;
            assert_eq!(kind(&refused), (422, "/problems/invalid"), "{key}");
            assert!(refused.1["detail"].as_str().unwrap().contains("`Idempotency-Key`"), "{}", refused.1);
        }
        let two = service.client.post(service.url(path)).header("idempotency-key", "a").header("idempotency-key", "b");
        assert_eq!(answer(two.json(&body).send().await.unwrap()).await.0, 422);
        assert_eq!(answer(post(&service, path, &long[1..], &body).await).await.0, 201);
    }
}

#[tokio::test]
async fn a_key_is_durable_before_its_request_is_answered() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let http = Client::builder().no_proxy().build().unwrap();
    let mut answers = Vec::new();
    for _ in 0..2 {
        let process = Process::start(&database);
        let url = |path: &str| format!("http://{}{path}", process.address);
        let model = http.put(url("/v1/models/figure-4")).json(&example("figure-4/model.json")).send().await.unwrap();
        assert!(model.status().is_success());
        let request = http.post(url(POLICIES)).header("idempotency-key", "a").json(&local());
        answers.push(whole(request.send().await.unwrap()).await);
        process.kill();
    }
    assert_eq!(answers[0].0, 201);
    assert_eq!(answers[0], answers[1]);
}
