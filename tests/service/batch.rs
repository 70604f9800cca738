//! Batches, from outside.

use crate::harness::service::{Service, answer, example, long_way, to_and_fro};
use crate::harness::waiting::until;
use reqwest::Method;
use serde_json::{Value, json};

const BATCH: &str = "/v1/policies:batch";

/// A service that knows the body of figure 4.
async fn figure_4(flags: &[&str]) -> Service {
    let service = Service::start(flags).await;
    assert_eq!(service.put("/v1/models/figure-4", &example("figure-4/model.json")).await.0, 201);
    service
}

/// The first `n` observations of figure 4.
fn demonstration(n: usize) -> Value {
    let whole = example("figure-4/demonstration.json");
    whole.as_array().unwrap()[..n].iter().cloned().collect()
}

/// A demonstration that takes minutes with the paper's heuristic.
fn long_demonstration() -> Value {
    let whole = example("figure-4/demonstration.json");
    whole.as_array().unwrap().iter().cycle().take(20_000).cloned().collect()
}

/// The items of an answered batch.
async fn items(service: &Service, batch: &Value) -> Vec<Value> {
    let (status, answer) = service.post(BATCH, batch).await;
    assert_eq!(status, 200, "{answer}");
    answer["items"].as_array().unwrap().clone()
}

/// The pointers of a 422.
fn pointers(problem: &Value) -> Vec<&str> {
    let errors = problem["errors"].as_array().unwrap();
    errors.iter().map(|error| error["pointer"].as_str().unwrap()).collect()
}

/// A policy without what differs from request to request.
fn comparable(policy: &Value) -> Value {
    let mut policy = policy.clone();
    assert!(policy["id"].take().is_string(), "{policy}");
    policy["search"]["elapsed_us"] = json!(0);
    policy
}

#[tokio::test]
async fn a_batch_gives_what_single_requests_give_in_the_order_of_its_items() {
    let service = figure_4(&["--search-threads", "2"]).await;
    let own = [
        json!({"demonstration": demonstration(16)}),
        json!({"demonstration": demonstration(9), "weights": {"gold": 3}}),
        json!({"demonstration": demonstration(12), "start": 7, "max_expansions": 5}),
        json!({"demonstration": demonstration(4), "lookahead": 3, "heuristic": "none"}),
        json!({"demonstration": demonstration(1), "weights": null, "start": {"x": 0, "y": 0, "heading": "west", "gold": 0, "outside": false}}),
    ];
    let shared = json!({"weights": {"x": 2, "gold": 1}, "heuristic": "paper", "start": {"x": 0, "y": 0, "heading": "north", "gold": 0, "outside": false}});
    for shared in [json!({}), shared] {
        // So many that every thread comes by more than once.
        let sent: Vec<&Value> = own.iter().cycle().take(60).collect();
        let mut batch = shared.clone();
        batch["model"] = json!("figure-4");
        batch["items"] = json!(sent);
        let answered = items(&service, &batch).await;
        assert_eq!(answered.len(), sent.len());
        let mut expected = Vec::new();
        for item in &own {
            let mut single = shared.clone();
            single["model"] = json!("figure-4");
            for (name, value) in item.as_object().unwrap().iter().filter(|(_, value)| !value.is_null()) {
                match single.get_mut(name).and_then(Value::as_object_mut).filter(|_| name == "weights") {
                    Some(weights) => weights.extend(value.as_object().unwrap().clone()),
                    None => single[name] = value.clone(),
                }
            }
            let (status, policy) = service.post("/v1/policies", &single).await;
            assert_eq!(status, 201, "{policy}");
            expected.push(comparable(&policy));
        }
        for (n, policy) in answered.iter().enumerate() {
            assert_eq!(comparable(policy), expected[n % own.len()], "item {n} beside {shared}");
        }
    }
}

#[tokio::test]
async fn the_policies_of_a_batch_are_read_and_listed_before_and_after_a_restart() {
    let service = figure_4(&[]).await;
    // As many as take several statements of several lengths.
    let demonstrations = (0..45).map(|n| json!({"demonstration": demonstration(1 + n % 16)}));
    let batch = json!({"model": "figure-4", "items": demonstrations.collect::<Vec<_>>()});
    let answered = items(&service, &batch).await;
    let ids: Vec<&Value> = answered.iter().map(|policy| &policy["id"]).collect();
    let service = Service::start_in(service.stop().await, &[]).await;
    let (_, list) = service.get("/v1/policies").await;
    let listed: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|policy| &policy["id"]).collect();
    assert_eq!(listed, ids, "in the order of the batch");
    for policy in &answered {
        let path = format!("/v1/policies/{}", policy["id"].as_str().unwrap());
        assert_eq!(service.get(&path).await, (200, policy.clone()));
    }
}

#[tokio::test]
async fn what_is_wrong_with_an_item_is_told_in_its_place_and_keeps_nobody_from_a_policy() {
    let service = figure_4(&[]).await;
    let good = json!({"demonstration": demonstration(3)});
    let bad = json!({
        "demonstration": [{"x": "far", "speed": 1}, 7], "weights": {"gold": -1, "mood": 1}, "start": 100_000,
        "lookahead": 0, "heuristic": "magic", "max_expansions": -1, "model": "other", "deadline_ms": 5, "learner": "x",
    });
    let batch = json!({"model": "figure-4", "items": [good, bad, 7, {}, {"demonstration": []}, good]});
    let response = service.send(Method::POST, BATCH, &batch).await;
    let request_id = response.headers()["x-request-id"].to_str().unwrap().to_owned();
    let (status, answer) = answer(response).await;
    assert_eq!(status, 200, "{answer}");
    let items = answer["items"].as_array().unwrap();
    assert_eq!((items.len(), comparable(&items[0])), (6, comparable(&items[5])));
    let found = |n: usize| {
        let problem = &items[n]["problem"];
        assert_eq!((&problem["type"], &problem["status"]), (&json!("/problems/invalid"), &json!(422)));
        assert_eq!(problem["request_id"], request_id);
        let mut found = pointers(problem);
        found.sort_unstable();
        found
    };
    assert_eq!(
        found(1),
        [
            "/items/1/deadline_ms",
            "/items/1/demonstration/0/speed",
            "/items/1/demonstration/0/x",
            "/items/1/demonstration/1",
            "/items/1/heuristic",
            "/items/1/learner",
            "/items/1/lookahead",
            "/items/1/max_expansions",
            "/items/1/model",
            "/items/1/start",
            "/items/1/weights/gold",
            "/items/1/weights/mood",
        ]
    );
    assert_eq!(found(2), ["/items/2"]);
    assert_eq!(found(3), ["/items/3/demonstration"]);
    assert_eq!(found(4), ["/items/4/demonstration"]);
    assert_eq!(service.get("/v1/policies").await.1["items"].as_array().unwrap().len(), 2);

    let (status, answer) = service.post(BATCH, &json!({"model": "figure-4", "items": [{}]})).await;
    assert_eq!((status, pointers(&answer["items"][0]["problem"])), (200, vec!["/items/0/demonstration"]));
}

#[tokio::test]
async fn what_is_wrong_with_the_batch_itself_fails_it_as_a_whole() {
    let service = figure_4(&[]).await;
    let post = async |batch: Value| service.post(BATCH, &batch).await;
    let items = json!([{"demonstration": demonstration(2)}]);
    let (status, problem) = post(json!({
        "model": "figure-4", "items": items, "weights": {"mood": 1, "x": -1}, "start": "here", "lookahead": 0,
        "heuristic": "magic", "max_expansions": 0.5, "deadline_ms": -1, "demonstration": [], "hurry": true,
    }))
    .await;
    let mut found = pointers(&problem);
    found.sort_unstable();
    let expected = [
        "/deadline_ms",
        "/demonstration",
        "/heuristic",
        "/hurry",
        "/lookahead",
        "/max_expansions",
        "/start",
        "/weights/mood",
        "/weights/x",
    ];
    assert_eq!((status, found), (422, expected.to_vec()));
    for (batch, expected) in [
        (json!([]), vec![""]),
        (json!({"model": "figure-4"}), vec!["/items"]),
        (json!({"model": "figure-4", "items": []}), vec!["/items"]),
        (json!({"model": "figure-4", "items": {"demonstration": []}}), vec!["/items"]),
        (json!({"model": 1, "learner": 2}), vec!["/model", "/learner", "/items"]),
        (json!({"model": "nothing", "items": items, "hurry": 1}), vec!["/hurry", "/model"]),
    ] {
        let (status, problem) = post(batch).await;
        assert_eq!((status, pointers(&problem)), (422, expected), "{problem}");
    }
    let (status, problem) = post(json!({"model": "nothing", "items": items})).await;
    assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-model")));
    let (status, problem) = post(json!({"model": "figure-4", "learner": "nobody", "items": items})).await;
    assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-learner")));
    assert_eq!(service.get("/v1/policies").await.1["items"], json!([]), "nothing was stored");
    // The path is one of its own.
    assert_eq!(service.get(BATCH).await.0, 405);
}

#[tokio::test]
async fn a_batch_that_is_too_large_is_refused_before_it_is_searched() {
    let service = figure_4(&[]).await;
    let small = json!({"demonstration": [{}]});
    for (n_items, expected) in [(10_000, 200), (10_001, 422)] {
        let items = vec![small.clone(); n_items];
        let (status, answer) = service.post(BATCH, &json!({"model": "figure-4", "items": items})).await;
        assert_eq!(status, expected, "{}", answer["detail"]);
        if status == 422 {
            assert_eq!(pointers(&answer), ["/items"]);
        }
    }
    let attribute = |n: usize| json!({"name": format!("{n:0>64}"), "kind": "number"});
    let wide = json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    });
    assert_eq!(service.put("/v1/models/wide", &wide).await.0, 201);
    // Each by itself is small enough.
    let items = vec![json!({"demonstration": vec![json!({}); 1000]}); 9];
    let (status, problem) = service.post(BATCH, &json!({"model": "wide", "items": items})).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/items"]), "{}", problem["detail"]);
}

#[tokio::test]
async fn a_policy_of_more_steps_than_can_be_stored_is_a_fault_of_its_demonstration() {
    let service = figure_4(&[]).await;
    assert_eq!(service.put("/v1/models/wide", &long_way()).await.0, 201);
    let item = |n_observations| json!({"demonstration": to_and_fro(n_observations)});
    let mut request = item(200);
    request["model"] = json!("wide");
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/demonstration"]), "{}", problem["detail"]);
    assert!(problem["detail"].as_str().unwrap().contains(" steps"), "{problem}");
    let batch = json!({"model": "wide", "items": [item(5), item(200)]});
    let answered = items(&service, &batch).await;
    assert!(answered[0]["id"].is_string());
    assert_eq!(pointers(&answered[1]["problem"]), ["/items/1/demonstration"]);
}

#[tokio::test]
async fn a_batch_uses_the_means_of_a_learner() {
    let service = figure_4(&[]).await;
    let learner = json!({"attributes": ["x", "gold"], "mean": {"x": 0.5, "gold": 7}});
    assert_eq!(service.put("/v1/learners/gold", &learner).await.0, 201);
    let batch = json!({
        "model": "figure-4", "learner": "gold", "weights": {"y": 2},
        "items": [{"demonstration": demonstration(5)}, {"demonstration": demonstration(5), "weights": {"gold": 1}}],
    });
    let answered = items(&service, &batch).await;
    for (policy, gold) in answered.iter().zip([7.0, 1.0]) {
        assert_eq!((&policy["learner"], &policy["weights_version"]), (&json!("gold"), &json!(0)));
        let weights = &policy["weights"];
        assert_eq!((&weights["x"], &weights["y"], &weights["gold"]), (&json!(0.5), &json!(2.0), &json!(gold)));
    }
    let other = json!({"attributes": ["gold", "silver"]});
    assert_eq!(service.put("/v1/learners/silver", &other).await.0, 201);
    let batch = json!({"model": "figure-4", "learner": "silver", "items": [{"demonstration": demonstration(1)}]});
    let (status, problem) = service.post(BATCH, &batch).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/learner"]), "{problem}");
}

#[tokio::test]
async fn local_items_of_a_batch_are_refined_in_the_background() {
    let service = figure_4(&[]).await;
    let item = json!({"demonstration": demonstration(16)});
    let batch = json!({"model": "figure-4", "lookahead": 1, "weights": {"gold": 1}, "items": [item, item]});
    for local in items(&service, &batch).await {
        assert_eq!((&local["status"], &local["lookahead"]), (&json!("local"), &json!(1)));
        let id = local["id"].as_str().unwrap();
        let refined = service.refined(id).await;
        assert_eq!((&refined["refines"], &refined["status"]), (&local["id"], &json!("optimal")));
        assert_eq!(refined["cost"]["total"], 48.2);
    }
}

#[tokio::test]
async fn a_batch_takes_one_place_and_lets_others_in_between() {
    let service = figure_4(&["--search-threads", "1", "--search-queue", "1"]).await;
    // Many times as many items as there are places. It ends with one that takes minutes, so that it is not over before others.
    let mut items = vec![json!({"demonstration": demonstration(16)}); 2_000];
    items.push(json!({"demonstration": long_demonstration(), "heuristic": "paper"}));
    let batch = json!({"model": "figure-4", "items": items, "deadline_ms": 60_000});
    let waiting = tokio::spawn(service.client.post(service.url(BATCH)).json(&batch).send());
    service.until_searching().await;
    let request = example("figure-4/request.json");
    assert_eq!(service.post("/v1/policies", &request).await.0, 201);
    assert!(!waiting.is_finished(), "the batch was over before the single request");
    waiting.abort();
    service.until_idle().await;
}

#[tokio::test]
async fn a_client_that_goes_away_leaves_nothing_of_its_batch() {
    let service = figure_4(&["--search-threads", "1", "--search-queue", "0"]).await;
    let quick = json!({"demonstration": demonstration(16)});
    let slow = json!({"demonstration": long_demonstration(), "heuristic": "paper"});
    let batch = json!({"model": "figure-4", "items": [quick, slow, quick]});
    let waiting = tokio::spawn(service.client.post(service.url(BATCH)).json(&batch).send());
    service.until_searching().await;
    waiting.abort();
    service.until_idle().await;
    // Its place is given back a moment after its search has ended.
    let batch = json!({"model": "figure-4", "items": [quick]});
    let again = async || {
        let (status, answer) = service.post(BATCH, &batch).await;
        assert!([200, 503].contains(&status), "{answer}");
        (status == 200).then_some(answer)
    };
    let answer = until("a place for the next batch", again).await;
    let ids: Vec<&Value> = answer["items"].as_array().unwrap().iter().map(|policy| &policy["id"]).collect();
    let (_, list) = service.get("/v1/policies").await;
    let listed: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|policy| &policy["id"]).collect();
    assert_eq!((ids.len(), listed), (1, ids), "nothing is left of the first");
}

#[tokio::test]
async fn a_deadline_holds_for_the_whole_batch() {
    let service = figure_4(&["--search-threads", "1"]).await;
    let slow = json!({"demonstration": long_demonstration()});
    let batch = json!({"model": "figure-4", "items": [slow, slow], "heuristic": "paper", "deadline_ms": 50});
    for policy in items(&service, &batch).await {
        assert_eq!(policy["status"], "bounded", "{}", policy["detail"]);
        assert_eq!(policy["steps"].as_array().unwrap().last().unwrap()["observation"], 19_999);
    }
}

#[tokio::test]
async fn the_policies_of_a_batch_that_is_not_to_be_stored_have_no_ids() {
    let service = figure_4(&[]).await;
    let batch = json!({
        "model": "figure-4", "store": false, "lookahead": 1,
        "items": [{"demonstration": demonstration(3)}, {"demonstration": []}, {"demonstration": demonstration(5)}],
    });
    let items = items(&service, &batch).await;
    assert!(items[0]["steps"].is_array() && items[1]["problem"].is_object() && items[2]["steps"].is_array());
    assert!(items.iter().all(|item| item.get("id").is_none()), "{items:?}");
    assert_eq!(service.get("/v1/policies").await.1["items"], json!([]));
}
