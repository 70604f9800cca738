//! What one request may take of the service: time, memory, and the patience of others.

use crate::harness::service::{Service, answer, example, flags, long_way, to_and_fro};
use crate::harness::waiting::until;
use etude::client::Client;
use etude::clock::{Clock, Ids};
use etude::memory::SMALL_BYTES;
use etude::service::{Caller, Etude, ModelText, Name, Registered, ServiceError};
use etude_core::model::Format;
use jiff::Timestamp;
use reqwest::Method;
use serde_json::{Value, json};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

/// A table in which nothing tells the ways apart: searches of it take long.
fn hard_model(n_states: usize) -> Value {
    let next = |from: usize, k: usize| (from * 7919 + k * 104_729 + 13) % n_states;
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "y", "kind": "number"}],
        "actions": [{"name": "a", "cost": 0.3}, {"name": "b", "cost": 0.3}, {"name": "c", "cost": 0.3}],
        "dynamics": {
            "kind": "table",
            "states": (0..n_states).map(|n| json!([n * 31 % 101, n * 17 % 97])).collect::<Vec<_>>(),
            "transitions": (0..n_states)
                .flat_map(|from| ["a", "b", "c"].into_iter().enumerate().map(move |(k, name)| json!([from, name, next(from, k)])))
                .collect::<Vec<_>>(),
            "start": 0,
        },
    })
}

fn hard_request(n_observations: usize) -> Value {
    let seen = (0..n_observations).map(|n| json!({"x": n * 37 % 101, "y": n * 53 % 97}));
    json!({"model": "hard", "demonstration": seen.collect::<Vec<_>>()})
}

/// A service with the hard model.
async fn with_hard_model(flags: &[&str]) -> Service {
    let service = Service::start(flags).await;
    assert_eq!(service.put("/v1/models/hard", &hard_model(5_000)).await.0, 201);
    service
}

#[tokio::test]
async fn a_request_without_a_deadline_has_that_of_the_service() {
    let service = with_hard_model(&["--default-deadline", "20ms"]).await;
    let (status, policy) = service.post("/v1/policies", &hard_request(2_000)).await;
    assert_eq!((status, &policy["status"]), (201, &json!("bounded")));
    assert_eq!(policy["search"]["stopped_by"], "deadline_ms");
    let batch = json!({"model": "hard", "items": [{"demonstration": hard_request(2_000)["demonstration"]}]});
    let (status, answer) = service.post("/v1/policies:batch", &batch).await;
    assert_eq!((status, &answer["items"][0]["status"]), (200, &json!("bounded")));
    let learner = json!({"attributes": ["x", "y"], "algorithm": {"kind": "srv"}, "mean": 1.0, "sd": 1.0});
    assert_eq!(service.put("/v1/learners/l", &learner).await.0, 201);
    let (status, trial) = service.post("/v1/learners/l/trials", &hard_request(2_000)).await;
    assert_eq!((status, &trial["policy"]["status"]), (201, &json!("bounded")));
}

#[tokio::test]
async fn a_longer_deadline_than_the_service_allows_is_a_fault() {
    let service = with_hard_model(&["--max-deadline", "1s"]).await;
    let mut request = hard_request(2);
    request["deadline_ms"] = json!(1000);
    assert_eq!(service.post("/v1/policies", &request).await.0, 201);
    request["deadline_ms"] = json!(1001);
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/deadline_ms")));
    let batch = json!({"model": "hard", "deadline_ms": 1001, "items": [{"demonstration": [{}]}]});
    let (status, problem) = service.post("/v1/policies:batch", &batch).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/deadline_ms")));
}

#[tokio::test]
async fn a_deadline_counts_while_a_cold_model_is_compiled_which_goes_on_for_the_next_request() {
    let service = with_hard_model(&[]).await;
    let directory = service.stop().await;
    let service = Service::start_in(directory, &[]).await;
    let mut request = hard_request(2);
    request["deadline_ms"] = json!(0);
    let response = service.send(Method::POST, "/v1/policies", &request).await;
    assert!(response.headers().contains_key("retry-after"));
    let (status, problem) = answer(response).await;
    assert_eq!((status, &problem["type"]), (503, &json!("/problems/busy")));
    assert!(problem["detail"].as_str().unwrap().contains("still being compiled"), "{problem}");
    // Whoever comes again without waiting finds it ready in the end.
    let is_ready = async || (service.post("/v1/policies", &request).await.0 == 201).then_some(());
    until("the compiled model", is_ready).await;
}

#[tokio::test]
async fn a_model_that_takes_too_long_to_compile_is_refused() {
    let service = Service::start(&["--max-compile-time", "1ns"]).await;
    let (status, problem) = service.put("/v1/models/hard", &hard_model(5_000)).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/dynamics")), "{problem}");
    assert!(problem["detail"].as_str().unwrap().contains("ETUDE_MAX_COMPILE_TIME"), "{problem}");
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]));
}

#[tokio::test]
async fn a_model_that_is_there_already_is_not_compiled_again() {
    let directory = with_hard_model(&[]).await.stop().await;
    let database = directory.path().join("etude.db");
    let flags = flags(&["--database", database.to_str().unwrap()]);
    let etude =
        Etude::open(&flags.settings(Clock::system(), Ids::random()), &TaskTracker::new(), CancellationToken::new())
            .await
            .unwrap();
    // Without memory, nothing can be compiled.
    let memory = etude.memory();
    let mut taken = vec![memory.try_take(memory.free_for_large()).unwrap()];
    taken.extend(std::iter::from_fn(|| memory.try_take(SMALL_BYTES).or_else(|_| memory.try_take(4096)).ok()));
    let put = async |name: &str, n_states: usize| {
        let text = ModelText::Whole(hard_model(n_states).to_string().into_bytes());
        let caller = Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Timestamp::UNIX_EPOCH };
        etude.put_model(&Name::new(name).unwrap(), text, Format::Json, caller).await.map(|(registered, _)| registered)
    };
    assert_eq!(put("hard", 5_000).await.unwrap(), Registered::Already);
    assert!(matches!(put("hard", 5_001).await, Err(ServiceError::Conflict { .. })));
    assert!(matches!(put("other", 5_000).await, Err(ServiceError::NoRoom(_))));
    drop(taken);
    assert_eq!(put("other", 5_000).await.unwrap(), Registered::New);
    etude.close().await;
}

#[tokio::test]
async fn a_small_request_is_answered_while_any_number_of_hard_ones_run() {
    let service = with_hard_model(&["--default-deadline", "10m"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let hard: Vec<_> = (0..40)
        .map(|_| tokio::spawn(service.client.post(service.url("/v1/policies")).json(&hard_request(20_000)).send()))
        .collect();
    let are_running = async || (service.measurement("etude_search_jobs").await >= 10.0).then_some(());
    until("the begin of ten searches", are_running).await;
    assert_eq!(service.post("/v1/policies", &example("figure-4/request.json")).await.0, 201);
    // Neither does one that another thread takes over wait for all of them.
    let mut large = example("figure-4/request.json");
    large["max_expansions"] = json!(10);
    large["heuristic"] = json!("paper");
    let (status, policy) = service.post("/v1/policies", &large).await;
    assert_eq!(status, 201, "{policy}");
    assert!(service.measurement("etude_search_jobs").await > 0.0, "they still run");
    hard.iter().for_each(tokio::task::JoinHandle::abort);
    service.until_idle().await;
}

#[tokio::test]
async fn a_batch_says_which_items_its_answer_has_no_room_for() {
    let service = Service::start(&["--max-memory", "160M"]).await;
    assert_eq!(service.put("/v1/models/long", &long_way()).await.0, 201);
    let items: Vec<_> = (0..60).map(|_| json!({"demonstration": to_and_fro(9)})).collect();
    let (status, answer) = service.post("/v1/policies:batch", &json!({"model": "long", "items": items})).await;
    assert_eq!(status, 200, "{answer}");
    let items = answer["items"].as_array().unwrap();
    let (made, refused): (Vec<_>, Vec<_>) = items.iter().partition(|item| item["id"].is_string());
    assert!(!made.is_empty() && !refused.is_empty(), "{} of {}", made.len(), items.len());
    for item in refused {
        assert_eq!(item["problem"]["type"], "/problems/batch-full");
    }
    for item in made {
        let (status, policy) = service.get(&format!("/v1/policies/{}", item["id"].as_str().unwrap())).await;
        assert_eq!((status, &policy), (200, item));
    }
    let (_, list) = service.get("/v1/policies?limit=1000").await;
    assert_eq!(list["items"].as_array().unwrap().len(), items.iter().filter(|item| item["id"].is_string()).count());
    // What it took was given back.
    assert_eq!(service.post("/v1/policies", &json!({"model": "long", "demonstration": to_and_fro(9)})).await.0, 201);
}

#[tokio::test]
async fn a_demonstration_that_takes_more_memory_than_there_is_is_refused() {
    let service = Service::start(&["--max-memory", "160M"]).await;
    let attribute = |n: usize| json!({"name": format!("{n}"), "kind": "number"});
    let wide = json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    });
    assert_eq!(service.put("/v1/models/wide", &wide).await.0, 201);
    // Three bytes each, and seven kilobytes once they are read. Their policy is half as large.
    let demonstration = vec![json!({}); 13_000];
    let request = json!({"model": "wide", "demonstration": demonstration, "max_expansions": 1});
    let (status, answer) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &answer["type"]), (503, &json!("/problems/busy")), "{answer}");
    let items = json!([{"demonstration": demonstration}, {"demonstration": [{}]}]);
    let (status, answer) = service.post("/v1/policies:batch", &json!({"model": "wide", "items": items})).await;
    assert_eq!((status, &answer["items"][0]["problem"]["type"]), (200, &json!("/problems/batch-full")));
    assert!(answer["items"][1]["id"].is_string(), "there is room for the other one");
}
