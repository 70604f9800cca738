//! Generated problems, with all that a request may say of them, over every way into the service, against the independent solver.

use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use serde_json::{Value, json};

use crate::harness::service::Service;
use crate::oracle;
use crate::problems::{close, problem};
use crate::stream::client::Client;

/// So many problems are drawn for each test, the same every time.
const N_PROBLEMS: usize = 400;

/// Models and requests.
fn problems() -> impl Iterator<Item = (Value, Value)> {
    let mut runner = TestRunner::deterministic();
    (0..N_PROBLEMS).map(move |_| problem().new_tree(&mut runner).unwrap().current())
}

/// Registers a model, and gives the request the name of it.
async fn registered(service: &Service, n: usize, model: &Value, mut request: Value) -> Value {
    let name = format!("m{n}");
    let (status, answer) = service.put(&format!("/v1/models/{name}"), model).await;
    assert_eq!(status, 201, "{answer}");
    request["model"] = json!(name);
    request
}

fn with(request: &Value, name: &str, value: Value) -> Value {
    let mut request = request.clone();
    request[name] = value;
    request
}

fn total(policy: &Value) -> f64 {
    policy["cost"]["total"].as_f64().unwrap()
}

/// Checks that a policy costs what the solver says, and says so.
fn check_optimal(policy: &Value, model: &Value, request: &Value) {
    let optimum = oracle::optimal_cost(model, request);
    assert!(close(total(policy), optimum), "{} where {optimum} is possible: {model} {request}", total(policy));
    assert_eq!(policy["status"], "optimal");
    let last = policy["steps"].as_array().unwrap().last().unwrap();
    let ended = last["cost"].as_f64().unwrap() + policy["cost"]["end"].as_f64().unwrap();
    assert!(close(ended, optimum), "{policy}");
}

#[tokio::test]
async fn policies_cost_what_the_independent_solver_says() {
    let service = Service::start(&[]).await;
    for (n, (model, request)) in problems().enumerate() {
        let request = registered(&service, n, &model, request).await;
        for heuristic in ["default", "none", "paper"] {
            let (status, policy) = service.post("/v1/policies", &with(&request, "heuristic", json!(heuristic))).await;
            assert_eq!(status, 201, "{policy}");
            if policy["status"] == "bounded" {
                let bound = policy["lower_bound"].as_f64().unwrap();
                let optimum = oracle::optimal_cost(&model, &request);
                assert!(heuristic == "paper" && bound <= optimum * (1.0 + 1e-9) && optimum <= total(&policy) + 1e-9);
            } else {
                check_optimal(&policy, &model, &request);
            }
        }
    }
}

#[tokio::test]
async fn what_a_batch_says_holds_for_its_items_and_what_an_item_says_for_itself() {
    let service = Service::start(&[]).await;
    for (n, (model, request)) in problems().enumerate() {
        let request = registered(&service, n, &model, request).await;
        let mut batch = request.clone();
        let demonstration = batch.as_object_mut().unwrap().remove("demonstration").unwrap();
        let other = json!({"demonstration": demonstration, "extra_weight": 0, "end_weight": 10});
        batch["items"] = json!([{"demonstration": demonstration}, other]);
        let (status, answer) = service.post("/v1/policies:batch", &batch).await;
        assert_eq!(status, 200, "{answer}");
        check_optimal(&answer["items"][0], &model, &request);
        let own = with(&with(&request, "extra_weight", json!(0)), "end_weight", json!(10));
        check_optimal(&answer["items"][1], &model, &own);
    }
}

#[tokio::test]
async fn trials_cost_what_the_independent_solver_says_under_the_weights_that_they_tell() {
    let service = Service::start(&[]).await;
    for n_attributes in 1..=3 {
        let attributes: Vec<String> = (0..n_attributes).map(|k| format!("k{k}")).collect();
        let learner = json!({"attributes": attributes, "seed": 5});
        assert_eq!(service.put(&format!("/v1/learners/l{n_attributes}"), &learner).await.0, 201);
    }
    for (n, (model, request)) in problems().enumerate() {
        let request = registered(&service, n, &model, request).await;
        let n_attributes = model["attributes"].as_array().unwrap().len();
        let pinned = request["weights"].as_object().cloned().unwrap_or_default();
        let (status, trial) = service.post(&format!("/v1/learners/l{n_attributes}/trials"), &request).await;
        assert_eq!(status, 201, "{trial}");
        check_optimal(&trial["policy"], &model, &with(&request, "weights", trial["weights"].clone()));
        for (attribute, weight) in pinned {
            let told = trial["weights"][&attribute].as_f64();
            assert_eq!(told, weight.as_f64(), "what is pinned is not drawn");
        }
    }
}

#[tokio::test]
async fn streams_cost_what_the_same_lookahead_costs_at_once_and_without_one_what_the_solver_says() {
    let service = Service::start(&[]).await;
    for (n, (model, request)) in problems().enumerate() {
        let request = registered(&service, n, &model, request).await;
        for lookahead in [json!(null), json!(1 + n % 4)] {
            let request = with(&request, "lookahead", lookahead.clone());
            let (status, policy) = service.post("/v1/policies", &request).await;
            assert_eq!(status, 201, "{policy}");
            let done = streamed(&service, &request, n).await;
            assert!(close(total(&done), total(&policy)), "{} and {}: {model} {request}", total(&done), total(&policy));
            // At once, a search for the optimum may find another one of equal cost.
            assert!(lookahead.is_null() || done["end"] == policy["end"], "{done} and {policy}");
            let stored = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await.1;
            assert_eq!(stored["cost"], done["cost"]);
            if done["status"] == "optimal" {
                check_optimal(&stored, &model, &request);
            } else {
                assert!(!lookahead.is_null() && total(&done) >= oracle::optimal_cost(&model, &request) - 1e-9);
                if n % 20 == 0 {
                    let refined = service.refined(done["policy_id"].as_str().unwrap()).await;
                    check_optimal(&refined, &model, &request);
                }
            }
        }
    }
}

/// Streams the demonstration of a request, a few observations at a time; now and then the connection is lost in between. What the
/// observations count is said by `open` or beside them. Gives `done`.
async fn streamed(service: &Service, request: &Value, n: usize) -> Value {
    let demonstration = request["demonstration"].as_array().unwrap();
    let mut open = request.clone();
    let members = open.as_object_mut().unwrap();
    members.remove("demonstration");
    members.insert("type".to_owned(), json!("open"));
    let weights = request["observation_weights"].as_array().filter(|_| !n.is_multiple_of(3));
    if weights.is_some() {
        members.remove("observation_weights");
    }
    let mut client = Client::connect(service).await;
    let session = client.open(open).await;
    let mut seq = 0;
    while seq < demonstration.len() {
        let end = (seq + 1 + n % 3).min(demonstration.len());
        let mut frame = json!({"type": "observe", "seq": seq, "states": demonstration[seq..end]});
        if let Some(weights) = weights {
            frame["observation_weights"] = json!(weights[seq..end]);
        }
        client.send(frame).await;
        client.receive_until("received").await;
        seq = end;
        if n.is_multiple_of(5) {
            client = Client::connect(service).await;
            client.send(json!({"type": "resume", "session": session, "step": 0})).await;
            let opened = client.receive().await;
            assert_eq!((&opened["type"], &opened["received"]), (&json!("opened"), &json!(seq)), "{opened}");
        }
    }
    client.send(json!({"type": "end", "seq": seq})).await;
    client.receive_until("done").await.pop().unwrap()
}
