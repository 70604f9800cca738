//! The HTTP contract, from outside.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself, with few helpers.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};

use crate::harness::service::{Service, answer, example};
use crate::harness::waiting::within;
use reqwest::Method;
use reqwest::header::{ALLOW, CONTENT_TYPE, LOCATION, RETRY_AFTER};
use serde_json::{Value, json};

fn corridor() -> Value {
    json!({
        "attributes": [
            {"name": "x", "kind": "number", "scale": 1, "weight": 1},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]},
            {"name": "door", "kind": "category"},
        ],
        "actions": [{"name": "forward", "cost": 0.5}],
        "dynamics": {
            "kind": "table", "states": [[0, "east", "open"], [1, "east", "open"]],
            "transitions": [[0, "forward", 1]], "start": 0, "unsafe": [],
        },
    })
}

/// The pointers of a 422.
fn pointers(problem: &Value) -> Vec<&str> {
    let errors = problem["errors"].as_array().unwrap();
    errors.iter().map(|error| error["pointer"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn a_model_is_registered_read_listed_and_deleted() {
    let service = Service::start(&[]).await;
    let (status, created) = service.put("/v1/models/corridor", &corridor()).await;
    assert_eq!(status, 201, "{created}");
    assert_eq!(
        created["counts"],
        json!({"attributes": 3, "actions": 1, "states": 2, "transitions": 1, "stochastic": 0, "unsafe": 0})
    );
    assert_eq!(created["attributes"][0], json!({"name": "x", "kind": "number", "scale": 1.0, "weight": 1.0}));
    assert_eq!(created["hash"].as_str().unwrap().len(), 64);

    // The same content, written otherwise: defaults left out, the action by its index.
    let mut same = corridor();
    same["attributes"][0] = json!({"kind": "number", "name": "x"});
    same["dynamics"]["transitions"] = json!([[0, 0, 1]]);
    same["dynamics"].as_object_mut().unwrap().remove("unsafe");
    let (status, again) = service.put("/v1/models/corridor", &same).await;
    assert_eq!((status, &again), (200, &created));

    let mut other = corridor();
    other["actions"][0]["cost"] = json!(0.6);
    let (status, problem) = service.put("/v1/models/corridor", &other).await;
    assert_eq!((status, &problem["type"]), (409, &json!("/problems/conflict")));

    let (status, whole) = service.get("/v1/models/corridor").await;
    assert_eq!((status, &whole["hash"]), (200, &created["hash"]));
    let (status, copy) = service.put("/v1/models/copy", &whole["definition"]).await;
    assert_eq!((status, &copy["hash"]), (201, &created["hash"]));

    let (_, list) = service.get("/v1/models").await;
    let names: Vec<_> = list["items"].as_array().unwrap().iter().map(|model| model["name"].as_str().unwrap()).collect();
    assert_eq!((names, &list["next"]), (vec!["copy", "corridor"], &Value::Null));

    assert_eq!(service.delete("/v1/models/corridor").await.0, 204);
    let (status, problem) = service.delete("/v1/models/corridor").await;
    assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-model")));
    assert_eq!(service.get("/v1/models/corridor").await.0, 404);
    assert_eq!(service.put("/v1/models/corridor", &other).await.0, 201);
}

#[tokio::test]
async fn lists_are_paged_without_gaps_or_repetitions() {
    let service = Service::start(&[]).await;
    for n in 0..7 {
        assert_eq!(service.put(&format!("/v1/models/m{n}"), &corridor()).await.0, 201);
        let request = json!({"model": format!("m{n}"), "demonstration": [[0, "east", "open"]]});
        assert_eq!(service.post("/v1/policies", &request).await.0, 201);
    }
    for (path, name) in [("/v1/models", "name"), ("/v1/policies", "model")] {
        let mut seen = Vec::new();
        let mut query = "?limit=3".to_owned();
        loop {
            let (status, page) = service.get(&format!("{path}{query}")).await;
            assert_eq!(status, 200, "{page}");
            seen.extend(page["items"].as_array().unwrap().iter().map(|item| item[name].clone()));
            let Some(next) = page["next"].as_str() else { break };
            query = format!("?limit=3&after={next}");
        }
        assert_eq!(seen, ["m0", "m1", "m2", "m3", "m4", "m5", "m6"]);
        for query in ["?limit=0", "?limit=1001", "?limit=x", "?page=2"] {
            let (status, problem) = service.get(&format!("{path}{query}")).await;
            assert_eq!((status, pointers(&problem).len()), (422, 1), "{query}: {problem}");
        }
    }
    assert_eq!(service.get("/v1/policies?after=x").await.0, 422);
}

#[tokio::test]
async fn a_demonstration_gives_a_policy_that_can_be_read_again() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let response = service.send(Method::POST, "/v1/policies", &example("figure-4/request.json")).await;
    let location = response.headers()[LOCATION].to_str().unwrap().to_owned();
    let (status, policy) = answer(response).await;
    assert_eq!(status, 201, "{policy}");
    assert_eq!(location, format!("/v1/policies/{}", policy["id"].as_str().unwrap()));
    assert_eq!(policy["cost"], json!({"total": 48.2, "actions": 7.2, "distance": 41.0, "end": 0.0}));
    assert_eq!((&policy["status"], &policy["lower_bound"]), (&json!("optimal"), &json!(48.2)));
    assert_eq!(service.get(&location).await, (200, policy.clone()));

    let (_, list) = service.get("/v1/policies").await;
    assert_eq!((&list["items"][0]["id"], &list["items"][0]["cost"]), (&policy["id"], &policy["cost"]));
    assert_eq!(list["items"][0]["steps"], Value::Null);

    let (status, problem) = service.get("/v1/policies/nothing").await;
    assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-policy")));
}

#[tokio::test]
async fn a_model_that_was_replaced_is_used_from_the_next_request_on() {
    let service = Service::start(&[]).await;
    let (mut model, mut hashes) = (corridor(), Vec::new());
    let request = json!({"model": "corridor", "demonstration": [[0, "east", "open"], [1, "east", "open"]]});
    for cost in [0.5, 0.25] {
        model["actions"][0]["cost"] = json!(cost);
        assert_eq!(service.put("/v1/models/corridor", &model).await.0, 201);
        // Again, when it is known.
        for _ in 0..2 {
            let (status, policy) = service.post("/v1/policies", &request).await;
            assert_eq!((status, &policy["cost"]["actions"]), (201, &json!(cost)), "{policy}");
            hashes.push(policy["model_hash"].clone());
        }
        assert_eq!(service.delete("/v1/models/corridor").await.0, 204);
        let (status, problem) = service.post("/v1/policies", &request).await;
        assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-model")));
    }
    assert!(hashes[0] == hashes[1] && hashes[1] != hashes[2], "{hashes:?}");
}

/// A policy's text without what differs from request to request.
fn comparable(mut policy: Value) -> String {
    policy["id"] = Value::Null;
    policy["search"]["elapsed_us"] = json!(0);
    serde_json::to_string_pretty(&policy).unwrap() + "\n"
}

#[tokio::test]
async fn the_same_request_gives_the_same_bytes_before_and_after_a_restart() {
    let mut service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let request = example("figure-4/request.json");
    let first = service.post("/v1/policies", &request).await.1;
    let again = service.post("/v1/policies", &request).await.1;
    let directory = service.stop().await;
    service = Service::start_in(directory, &[]).await;
    // Now from the stored definition.
    let restarted = service.post("/v1/policies", &request).await.1;
    assert_eq!(comparable(first.clone()), comparable(again));
    assert_eq!(comparable(first.clone()), comparable(restarted));
    assert_eq!(service.get(&format!("/v1/policies/{}", first["id"].as_str().unwrap())).await.1, first);
    // The same text is what `etude map` prints, in a release build too: see .ci/run.
    let expected = include_str!("../../examples/figure-4/policy.json");
    let expected: Value = serde_json::from_str(expected).unwrap();
    assert_eq!(comparable(first), comparable(expected));
}

#[tokio::test]
async fn a_request_is_answered_alike_in_whatever_order_its_members_stand() {
    const DEMONSTRATION: &str = r#"[{"x": 0, "heading": "east", "door": "open"}, [1, "east", null]]"#;
    let service = Service::start(&[]).await;
    let mut wide = corridor();
    wide["attributes"][0]["weight"] = json!(7);
    let mut other = corridor();
    other["attributes"][2]["name"] = json!("gate");
    for (name, model) in [("corridor", &corridor()), ("wide", &wide), ("other", &other)] {
        assert_eq!(service.put(&format!("/v1/models/{name}"), model).await.0, 201);
        // From now on it is at hand.
        service.post("/v1/policies", &json!({"model": name, "demonstration": [[0, "east", "open"]]})).await;
    }
    let post = async |body: String| {
        let request = service.client.post(service.url("/v1/policies")).header(CONTENT_TYPE, "application/json");
        answer(request.body(body).send().await.unwrap()).await
    };
    let (status, policy) = post(format!(r#"{{"demonstration":{DEMONSTRATION},"model":"corridor"}}"#)).await;
    assert_eq!(status, 201, "{policy}");
    let expected = comparable(policy);
    for body in [
        format!(r#"{{"model":"corridor","demonstration":{DEMONSTRATION}}}"#),
        format!(" {{ \"m\\u006fdel\" : \"corridor\" ,\n \"demonstration\" : {DEMONSTRATION} , \"start\" : null }}\n"),
    ] {
        let (status, policy) = post(body.clone()).await;
        assert_eq!((status, comparable(policy)), (201, expected.clone()), "{body}");
    }
    // What stands twice is not clear.
    for body in [
        format!(r#"{{"model":"wide","demonstration":{DEMONSTRATION},"model":"corridor"}}"#),
        format!(r#"{{"model":"other","demonstration":{DEMONSTRATION},"model":"corridor"}}"#),
        format!(r#"{{"model":"corridor","demonstration":[[7, "east", "open"]],"demonstration":{DEMONSTRATION}}}"#),
        format!(r#"{{"model":"corridor","demonstration":[7],"demonstration":{DEMONSTRATION}}}"#),
        format!(r#"{{"model":"no-such","demonstration":{DEMONSTRATION},"model":"corridor"}}"#),
    ] {
        let (status, problem) = post(body.clone()).await;
        assert_eq!((status, &problem["errors"][0]["detail"]), (422, &json!("stands twice in this object")), "{body}");
    }
    let problem = async |body: String| {
        let (status, problem) = post(body).await;
        (status, problem["type"].clone(), problem["errors"].clone(), problem["detail"].clone())
    };
    let wrong = r#"[{"x": "a", "z": 1}, [0], 7]"#;
    for (model, demonstration) in
        [("corridor", wrong), ("other", DEMONSTRATION), ("corridor", "[]"), ("corridor", "null")]
    {
        let before = problem(format!(r#"{{"model":"{model}","demonstration":{demonstration}}}"#)).await;
        let after = problem(format!(r#"{{"demonstration":{demonstration},"model":"{model}"}}"#)).await;
        assert_eq!((before.0, &before), (422, &after), "{demonstration}");
    }
    for rest in ["", "}", "]", " }]", "}x"] {
        let before = problem(format!(r#"{{"model":"corridor","demonstration":{DEMONSTRATION}{rest}"#)).await;
        assert_eq!(before.0, if rest == "}" { 201 } else { 400 }, "{rest:?}: {before:?}");
    }
}

#[tokio::test]
async fn all_faults_of_a_model_are_told_at_once() {
    let service = Service::start(&[]).await;
    let model = json!({
        "attributes": [
            {"name": "x", "kind": "number", "scale": 0, "color": "red"},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "north"], "weight": -1},
            {"name": "door", "kind": "gate"},
            {"name": "mood", "kind": "category", "scale": 2},
            {"name": "mood", "kind": "cyclic"},
        ],
        "actions": [{"name": "forward", "cost": -0.5}, {"name": "back"}, {"name": "back", "price": 1}],
        "dynamics": {
            "kind": "table",
            "states": [[0, "up", 1, 2.5, 0], [1, "east"], "nothing"],
            "transitions": [[0, "fly", 1], [0, "back", 3], [0, "back"], [-1, 7, 0]],
            "start": 9, "unsafe": [3],
        },
        "extra": true,
    });
    let (status, problem) = service.put("/v1/models/m", &model).await;
    assert_eq!(status, 422);
    let mut found = pointers(&problem);
    found.sort_unstable();
    assert_eq!(
        found,
        [
            "/actions/0/cost",
            "/actions/2/name",
            "/actions/2/price",
            "/attributes/0/color",
            "/attributes/0/scale",
            "/attributes/1/weight",
            "/attributes/2/kind",
            "/attributes/3/scale",
            "/attributes/4",
            "/attributes/4/name",
            "/dynamics/start",
            "/dynamics/states/0/3",
            "/dynamics/states/1",
            "/dynamics/states/2",
            "/dynamics/transitions/0/1",
            "/dynamics/transitions/1/2",
            "/dynamics/transitions/2",
            "/dynamics/transitions/3/0",
            "/dynamics/transitions/3/1",
            "/dynamics/unsafe/0",
            "/extra",
        ]
    );
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]), "nothing was registered");
}

#[tokio::test]
async fn all_faults_of_a_cave_are_told_at_once() {
    let service = Service::start(&[]).await;
    let model = json!({
        "attributes": [],
        "actions": [{"name": "fly"}],
        "dynamics": {
            "kind": "wumpus", "width": 0, "height": 3, "pits": [[0, 3]], "wumpi": [[0]], "gold": [["a", 1]],
            "start": {"x": 0, "y": 0, "heading": "up"}, "arrows": -1, "bats": 2,
        },
    });
    let (status, problem) = service.put("/v1/models/m", &model).await;
    assert_eq!(status, 422);
    let mut found = pointers(&problem);
    found.sort_unstable();
    assert_eq!(
        found,
        [
            "/actions/0/name",
            "/attributes",
            "/dynamics/arrows",
            "/dynamics/bats",
            "/dynamics/gold/0/0",
            "/dynamics/pits/0/1",
            "/dynamics/start/heading",
            "/dynamics/width",
            "/dynamics/wumpi/0",
        ]
    );
    let deadly = json!({"dynamics": {"kind": "wumpus", "width": 2, "height": 2, "wumpi": [[0, 0]]}});
    assert_eq!(pointers(&service.put("/v1/models/m", &deadly).await.1), ["/dynamics/wumpi/0"]);
    let deadly = json!({"dynamics": {
        "kind": "wumpus", "width": 0, "height": 2, "wumpi": [[0, 9], [1, 1]], "pits": [[1, 1]], "start": {"x": 1, "y": 1},
    }});
    let (_, problem) = service.put("/v1/models/m", &deadly).await;
    let expected = ["/dynamics/width", "/dynamics/wumpi/0/1", "/dynamics/start", "/dynamics/start"];
    assert_eq!(pointers(&problem), expected, "whatever else is wrong");
}

#[tokio::test]
async fn all_faults_of_a_request_are_told_at_once() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/corridor", &corridor()).await;
    let request = json!({
        "model": "corridor",
        "demonstration": [{"x": "a", "heading": "up", "speed": 1}, [0, "east"], 7, [0, null, 0.5], {"door": ["open"]}],
        "weights": {"x": -1, "mood": 1, "door": "heavy"},
        "start": 2, "lookahead": 0, "heuristic": "magic", "max_expansions": -1, "deadline_ms": 0.5, "hurry": true,
    });
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &problem["type"]), (422, &json!("/problems/invalid")));
    let mut found = pointers(&problem);
    found.sort_unstable();
    assert_eq!(
        found,
        [
            "/deadline_ms",
            "/demonstration/0/heading",
            "/demonstration/0/speed",
            "/demonstration/0/x",
            "/demonstration/1",
            "/demonstration/2",
            "/demonstration/3/2",
            "/demonstration/4/door",
            "/heuristic",
            "/hurry",
            "/lookahead",
            "/max_expansions",
            "/start",
            "/weights/door",
            "/weights/mood",
            "/weights/x",
        ]
    );
    let post = async |request: Value| service.post("/v1/policies", &request).await;
    assert_eq!(pointers(&post(json!({"model": "corridor", "demonstration": []})).await.1), ["/demonstration"]);
    assert_eq!(pointers(&post(json!({"model": "corridor"})).await.1), ["/demonstration"]);
    assert_eq!(pointers(&post(json!({"model": 1, "learner": 2})).await.1), ["/model", "/learner", "/demonstration"]);
    assert_eq!(pointers(&post(json!([])).await.1), [""]);
    let start = json!({"model": "corridor", "demonstration": [[0, null, null]], "start": {"heading": "east"}});
    assert_eq!(pointers(&post(start).await.1), ["/start"], "two states face east");

    // What is unknown is not found, unless there is more to say.
    let (status, problem) = post(json!({"model": "nothing", "demonstration": [{}]})).await;
    assert_eq!(
        (status, &problem["type"], pointers(&problem)),
        (404, &json!("/problems/unknown-model"), vec!["/model"])
    );
    let (status, problem) = post(json!({"model": "nothing", "demonstration": [{}], "hurry": 1})).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/hurry", "/model"]));
    let (_, problem) = post(json!({"model": "x".repeat(100_000), "demonstration": [{}]})).await;
    assert!(problem.to_string().len() < 1000, "{problem}");
    let (status, problem) = post(json!({"model": "corridor", "learner": "nobody", "demonstration": [{}]})).await;
    assert_eq!((status, &problem["type"]), (404, &json!("/problems/unknown-learner")));
    let (status, problem) = post(json!({"model": "nothing", "learner": "nobody", "demonstration": [{}]})).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/learner", "/model"]));
    assert_eq!(service.get("/v1/policies").await.1["items"], json!([]), "nothing was stored");
}

#[tokio::test]
async fn a_start_is_an_index_or_the_values_of_one_state() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/corridor", &corridor()).await;
    for start in [json!(1), json!({"x": 1}), json!({"x": 1, "heading": "east", "door": "open"})] {
        let request = json!({"model": "corridor", "demonstration": [{"x": 0}], "start": start});
        let (status, policy) = service.post("/v1/policies", &request).await;
        assert_eq!((status, &policy["steps"][0]["state_index"]), (201, &json!(1)), "{policy}");
    }
}

#[tokio::test]
async fn clients_make_up_no_labels_of_measurements() {
    let service = Service::start(&[]).await;
    for (method, path) in [("BREW", "/livez"), ("MADE-UP", "/made/up")] {
        service.send(Method::from_bytes(method.as_bytes()).unwrap(), path, &Value::Null).await;
    }
    let (_, text) = service.get("/metrics").await;
    let text = text.as_str().unwrap();
    assert!(!text.contains("BREW") && !text.contains("MADE-UP") && !text.contains("made/up"), "{text}");
    for labels in [r#"method="other",route="/livez""#, r#"method="other",route="(none)""#] {
        assert!(text.contains(labels), "{labels}: {text}");
    }
}

/// Sends a body as it is.
async fn send_text(service: &Service, path: &str, content_type: &str, body: impl Into<reqwest::Body>) -> (u16, Value) {
    let request = service.client.put(service.url(path)).header(CONTENT_TYPE, content_type).body(body);
    answer(request.send().await.unwrap()).await
}

#[tokio::test]
async fn a_body_that_is_no_json_is_refused_with_its_place() {
    let service = Service::start(&[]).await;
    let put = async |body: &'static str| send_text(&service, "/v1/models/m", "application/json", body).await;
    for body in ["", "{", "{\"a\": NaN}", "{\"a\": Infinity}", "nonsense", "{} {}", "\"\\ud800\""] {
        let (status, problem) = put(body).await;
        assert_eq!((status, &problem["type"]), (400, &json!("/problems/malformed-json")), "{body}: {problem}");
        assert!(problem["detail"].as_str().unwrap().contains("line 1, column"), "{problem}");
    }
    let (status, problem) = put("{\"actions\": [{\"name\": \"a\", \"cost\": 1e999}]}").await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/actions/0/cost"]));
    let deep = "[".repeat(100_000);
    assert_eq!(send_text(&service, "/v1/models/m", "application/json", deep).await.0, 400);
    let invalid_utf8 = b"{\"\xff\": 1}".to_vec();
    assert_eq!(send_text(&service, "/v1/models/m", "application/json", invalid_utf8).await.0, 400);
    let (status, problem) = send_text(&service, "/v1/models/m", "text/plain", corridor().to_string()).await;
    assert_eq!((status, &problem["type"]), (415, &json!("/problems/unsupported-media-type")));
    let typed = "application/json; charset=utf-8";
    assert_eq!(send_text(&service, "/v1/models/m", typed, corridor().to_string()).await.0, 201);
}

#[tokio::test]
async fn a_body_over_the_limit_is_refused_announced_or_not() {
    let service = Service::start(&[]).await;
    let million: Vec<Value> = (0..1_000_000).map(|n| json!([n])).collect();
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [],
        "dynamics": {"kind": "table", "states": million, "transitions": []},
    });
    let body = model.to_string();
    let (status, problem) = send_text(&service, "/v1/models/m", "application/json", body.clone()).await;
    assert_eq!((status, &problem["type"]), (413, &json!("/problems/too-large")));
    let chunks: Vec<std::io::Result<String>> =
        body.as_bytes().chunks(100_000).map(|chunk| Ok(String::from_utf8(chunk.to_vec()).unwrap())).collect();
    let streamed = reqwest::Body::wrap_stream(futures_util::stream::iter(chunks));
    assert_eq!(send_text(&service, "/v1/models/m", "application/json", streamed).await.0, 413);
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]));

    let small = Service::start(&["--max-states", "100"]).await;
    let hundred_and_one: Vec<Value> = (0..101).map(|n| json!([n])).collect();
    let mut model = model;
    model["dynamics"]["states"] = hundred_and_one.into();
    assert_eq!(pointers(&small.put("/v1/models/m", &model).await.1), ["/dynamics/states"]);
}

#[tokio::test]
async fn a_world_over_the_limit_is_searched_lazily_and_stays_so() {
    let limited: &[&str] = &["--max-states", "100"];
    let service = Service::start(limited).await;
    // Three pieces of gold in a row, in any of 2600 states with one arrow or none.
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 9, "height": 9, "gold": [[1, 0], [2, 0], [3, 0]]}});
    let (status, model) = service.put("/v1/models/large", &cave).await;
    assert_eq!(status, 201);
    assert_eq!(
        model["counts"],
        json!({"attributes": 9, "actions": 6, "states": null, "transitions": null, "stochastic": 0, "unsafe": 0})
    );
    assert_eq!(service.put("/v1/models/large", &cave).await.0, 200);
    assert_eq!(service.get("/v1/models/large").await.1["counts"], model["counts"]);
    assert_eq!(service.get("/v1/models").await.1["items"], json!([model]));

    let seen = |x: i64, gold: i64| json!({"x": x, "y": 0, "heading": "east", "gold": gold});
    let demonstration = json!([seen(0, 0), seen(1, 0), seen(1, 1), seen(2, 1)]);
    let request = |options: Value| {
        let mut request = json!({"model": "large", "demonstration": demonstration});
        request.as_object_mut().unwrap().extend(options.as_object().unwrap().clone());
        request
    };
    let (status, policy) = service.post("/v1/policies", &request(json!({}))).await;
    assert_eq!(status, 201, "{policy}");
    assert_eq!((&policy["status"], &policy["actions"]), (&json!("optimal"), &json!(["forward", "grab", "forward"])));
    let numbers: Vec<&Value> = policy["steps"].as_array().unwrap().iter().map(|step| &step["state_index"]).collect();
    assert_eq!(numbers, [0, 1, 2, 3]);
    let path = format!("/v1/policies/{}", policy["id"].as_str().unwrap());
    assert_eq!(service.get(&path).await.1["steps"], policy["steps"]);

    // A lookahead needs no more than a search does. What needs all states is refused, and says so.
    let (status, policy) = service.post("/v1/policies", &request(json!({"lookahead": 3}))).await;
    assert_eq!((status, &policy["actions"]), (201, &json!(["forward", "grab", "forward"])), "{policy}");
    let (status, problem) = service.post("/v1/policies", &request(json!({"start": 7}))).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/start"]), "{problem}");

    // Under another limit, what was accepted is still what it was found to be.
    let service = Service::start_in(service.stop().await, &[]).await;
    assert_eq!(service.get("/v1/models/large").await.1["counts"], model["counts"]);
    let (_, again) = service.post("/v1/policies", &request(json!({}))).await;
    assert_eq!(again["steps"], policy["steps"]);
    let (_, known) = service.put("/v1/models/known", &cave).await;
    assert_eq!(known["hash"], model["hash"]);
    assert!(known["counts"]["states"].as_u64().unwrap() > 100, "{known}");
    let (status, policy) = service.post("/v1/policies", &request(json!({"model": "known", "lookahead": 3}))).await;
    assert_eq!((status, &policy["actions"]), (201, &again["actions"]));
    let service = Service::start_in(service.stop().await, limited).await;
    let (status, policy) = service.post("/v1/policies", &request(json!({"model": "known", "lookahead": 3}))).await;
    assert_eq!((status, &policy["actions"]), (201, &again["actions"]));
    service.stop().await;
}

/// Writes bytes to the service and reads until it closes.
fn talk(service: &Service, request: &[u8], then: Shutdown) -> String {
    let mut stream = TcpStream::connect(service.address).unwrap();
    stream.write_all(request).unwrap();
    stream.shutdown(then).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn a_body_cut_off_in_the_middle_is_refused_and_changes_nothing() {
    let service = Service::start(&[]).await;
    let body = corridor().to_string();
    let head = format!(
        "PUT /v1/models/m HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
        body.len()
    );
    let cut = format!("{head}{}", &body[..body.len() / 2]);
    let answered = tokio::task::block_in_place(|| talk(&service, cut.as_bytes(), Shutdown::Write));
    assert!(answered.starts_with("HTTP/1.1 400 ") && answered.contains("/problems/incomplete-body"), "{answered:?}");
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]));
}

#[tokio::test]
async fn unknown_paths_and_methods_are_problems_too() {
    let service = Service::start(&[]).await;
    for path in ["/v1", "/v2/models", "/v1/models/a/b", "/v1/models/", "/docs/nope"] {
        let (status, problem) = service.get(path).await;
        assert_eq!((status, &problem["type"]), (404, &json!("/problems/not-found")), "{path}");
    }
    let response = service.send(Method::PATCH, "/v1/models/m", &Value::Null).await;
    assert_eq!(response.headers()[CONTENT_TYPE], "application/problem+json");
    let allowed = response.headers()[ALLOW].to_str().unwrap().to_owned();
    for method in ["GET", "PUT", "DELETE"] {
        assert!(allowed.contains(method), "{allowed}");
    }
    let (status, problem) = answer(response).await;
    assert_eq!((status, &problem["type"]), (405, &json!("/problems/method-not-allowed")));
    for name in ["a%20b", "%FF", &"x".repeat(65)] {
        let (status, problem) = service.put(&format!("/v1/models/{name}"), &corridor()).await;
        assert_eq!((status, &problem["type"]), (422, &json!("/problems/invalid")), "{name}");
    }
}

#[tokio::test]
async fn every_answer_carries_a_request_id_and_problems_repeat_it() {
    let service = Service::start(&[]).await;
    let given = service.client.get(service.url("/v1/models/m")).header("x-request-id", "mine-1").send().await.unwrap();
    assert_eq!(given.headers()["x-request-id"], "mine-1");
    assert_eq!(answer(given).await.1["request_id"], "mine-1");
    let odd = service.client.get(service.url("/livez")).header("x-request-id", "not{plain}").send().await.unwrap();
    let made = odd.headers()["x-request-id"].to_str().unwrap();
    assert_eq!((odd.status().as_u16(), made.len()), (200, 36), "{made}");
}

#[tokio::test]
async fn a_browser_is_led_from_the_root_to_the_page_that_describes_the_service() {
    let service = Service::start(&[]).await;
    let response = service.client.get(service.url("/")).send().await.unwrap();
    assert_eq!((response.status().as_u16(), response.url().path()), (200, "/docs/"));
    assert!(response.text().await.unwrap().contains("<html"));
    let stays = reqwest::Client::builder().no_proxy().redirect(reqwest::redirect::Policy::none()).build().unwrap();
    let response = stays.get(service.url("/")).send().await.unwrap();
    assert_eq!((response.status().as_u16(), &response.headers()[LOCATION]), (307, &"/docs/".parse().unwrap()));
}

#[tokio::test]
async fn operators_find_what_they_need() {
    let service = Service::start(&[]).await;
    assert_eq!(service.get("/livez").await, (200, json!("alive\n")));
    assert_eq!(service.get("/readyz").await, (200, json!("ready\n")));
    let (status, yaml) = service.get("/openapi.yaml").await;
    assert!(status == 200 && yaml.as_str().unwrap().starts_with("openapi: 3.1.0"));
    let (status, page) = service.get("/docs/").await;
    assert!(status == 200 && page.as_str().unwrap().contains("swagger"), "{page}");
    // Nothing that the page loads comes from elsewhere.
    assert!(!page.as_str().unwrap().contains("https://"), "{page}");
    let (status, metrics) = service.get("/metrics").await;
    assert!(status == 200 && metrics.as_str().unwrap().contains("etude_http_request_duration_seconds_bucket"));
}

/// A request that takes minutes: the paper's heuristic looks at every observation ahead, for every node.
fn slow_request() -> Value {
    let demonstration = example("figure-4/demonstration.json");
    let demonstration: Vec<Value> = demonstration.as_array().unwrap().iter().cycle().take(20_000).cloned().collect();
    json!({"model": "figure-4", "demonstration": demonstration, "heuristic": "paper"})
}

#[tokio::test]
async fn a_client_that_goes_away_cancels_its_search() {
    let service = Service::start(&["--default-deadline", "10m"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let request = service.client.post(service.url("/v1/policies")).json(&slow_request());
    let waiting = tokio::spawn(request.send());
    service.until_searching().await;
    waiting.abort();
    service.until_idle().await;
    assert_eq!(service.post("/v1/policies", &example("figure-4/request.json")).await.0, 201);
}

#[tokio::test]
async fn a_small_request_in_a_world_searched_lazily_leaves_the_service_awake() {
    let service = Service::start(&["--max-states", "1000"]).await;
    let gold: Vec<_> = (0..19).map(|k| json!([(7 * k + 15) % 30, (11 * k + 24) % 30])).collect();
    let model = json!({"dynamics": {"kind": "wumpus", "width": 30, "height": 30, "gold": gold}});
    assert_eq!(service.put("/v1/models/lazy", &model).await.0, 201);
    let seen: Vec<_> = (0..30).map(|k| json!({"x": 7 * k % 30, "y": 11 * k % 30, "gold": k / 2})).collect();
    // Only for the case that nothing else ends it.
    let request = json!({"model": "lazy", "demonstration": seen, "deadline_ms": 20_000});
    let waiting = tokio::spawn(service.client.post(service.url("/v1/policies")).json(&request).send());
    service.until_searching().await;
    assert_eq!(service.get("/livez").await.0, 200);
    assert_eq!(service.measurement("etude_search_jobs").await, 1.0, "it is still being searched");

    waiting.abort();
    service.until_idle().await;
    assert_eq!(service.get("/v1/policies").await.1["items"], json!([]), "it was cancelled");
}

#[tokio::test]
async fn a_deadline_holds_for_those_who_wait_for_a_thread() {
    let service = Service::start(&["--search-threads", "1", "--default-deadline", "10m"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let waiting = tokio::spawn(service.client.post(service.url("/v1/policies")).json(&slow_request()).send());
    service.until_searching().await;
    let mut small = example("figure-4/request.json");
    small["deadline_ms"] = json!(20);
    assert_eq!(service.post("/v1/policies", &small).await.0, 201);
    let mut large = slow_request();
    large["deadline_ms"] = json!(20);
    let (status, policy) = service.post("/v1/policies", &large).await;
    assert_eq!((status, &policy["status"]), (201, &json!("bounded")));
    let batch = json!({
        "model": "figure-4", "deadline_ms": 20,
        "items": [
            {"demonstration": small["demonstration"]}, {"demonstration": large["demonstration"]},
            {"demonstration": large["demonstration"], "lookahead": 8},
        ],
    });
    let (status, answer) = service.post("/v1/policies:batch", &batch).await;
    assert_eq!((status, &answer["items"][1]["status"]), (200, &json!("bounded")));
    assert_eq!(answer["items"][2]["status"], "local");
    large["heuristic"] = Value::Null;
    large["lookahead"] = json!(8);
    let (status, policy) = service.post("/v1/policies", &large).await;
    assert_eq!((status, &policy["status"]), (201, &json!("local")));
    assert_eq!(policy["steps"].as_array().unwrap().last().unwrap()["observation"], 19_999);
    assert!(!waiting.is_finished(), "the one before them is still searched");
    waiting.abort();
    service.until_idle().await;
}

#[tokio::test]
async fn a_deadline_gives_the_best_mapping_so_far_and_a_bound() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let mut request = slow_request();
    request["deadline_ms"] = json!(50);
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &policy["status"]), (201, &json!("bounded")), "{}", policy["detail"]);
    let (bound, total) = (policy["lower_bound"].as_f64().unwrap(), policy["cost"]["total"].as_f64().unwrap());
    assert!(0.0 <= bound && bound < total);
    assert_eq!(policy["steps"].as_array().unwrap().last().unwrap()["observation"], 19_999);
}

#[tokio::test]
async fn a_policy_with_a_lookahead_is_local_and_is_refined_in_the_background() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let mut request = example("figure-4/request.json");
    request["lookahead"] = json!(1);
    let (status, local) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &local["status"], &local["lookahead"]), (201, &json!("local"), &json!(1)));
    assert_eq!((&local["lower_bound"], &local["refined_by"]), (&Value::Null, &Value::Null));
    assert!(local["cost"]["total"].as_f64().unwrap() > 48.2);
    let refined = service.refined(local["id"].as_str().unwrap()).await;
    assert_eq!((&refined["refines"], &refined["status"]), (&local["id"], &json!("optimal")));
    assert_eq!((&refined["cost"]["total"], &refined["lookahead"]), (&json!(48.2), &Value::Null));
    let (_, list) = service.get("/v1/policies").await;
    assert_eq!(list["items"][0]["refined_by"], refined["id"]);

    // A lookahead that reaches beyond the end decides nothing before it.
    request["lookahead"] = json!(16);
    let (_, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((&policy["status"], &policy["cost"]["total"]), (&json!("optimal"), &json!(48.2)));
}

#[tokio::test]
async fn a_shutdown_answers_what_still_runs_and_closes_the_database() {
    let service = Service::start(&["--drain-timeout", "0s"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let request = service.client.post(service.url("/v1/policies")).json(&slow_request());
    let waiting = tokio::spawn(request.send());
    service.until_searching().await;
    let directory = service.stop().await;
    let (status, problem) = answer(waiting.await.unwrap().unwrap()).await;
    assert_eq!((status, &problem["type"]), (503, &json!("/problems/stopping")));
    let mut left: Vec<_> = std::fs::read_dir(directory.path()).unwrap().map(|file| file.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["etude.db", "etude.db-lock"], "the write-ahead log was folded in");
}

#[tokio::test]
async fn a_client_that_does_not_finish_its_request_finds_its_connection_closed() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let service = Service::start(&["--head-timeout", "1s"]).await;
    for begun in ["", "GET /livez HTTP/1.1\r\nhost: ", "GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n"] {
        let mut stream = tokio::net::TcpStream::connect(service.address).await.unwrap();
        stream.write_all(begun.as_bytes()).await.unwrap();
        let mut answer = String::new();
        // Ends with the connection, which this side leaves open.
        within("the end of the connection", stream.read_to_string(&mut answer)).await.unwrap();
        assert_eq!(answer.starts_with("HTTP/1.1 200"), begun.ends_with("\r\n\r\n"), "{answer}");
    }
}

#[tokio::test]
async fn a_database_that_another_process_holds_is_no_internal_error() {
    use sqlx::{ConnectOptions, Connection};
    let service = Service::start(&[]).await;
    let path = service.directory.path().join("etude.db");
    let mut other = sqlx::sqlite::SqliteConnectOptions::new().filename(path).connect().await.unwrap();
    let held = other.begin_with("BEGIN IMMEDIATE").await.unwrap();
    let put = async |name: &str| service.send(Method::PUT, &format!("/v1/models/{name}"), &corridor()).await;
    // Both wait for the lock once, not one after the other.
    let (first, second) = tokio::join!(put("a"), put("b"));
    for response in [first, second] {
        assert_eq!(response.headers()[RETRY_AFTER], "1");
        assert_eq!(answer(response).await.1["type"], "/problems/not-ready");
    }
    held.rollback().await.unwrap();
    assert_eq!(put("a").await.status(), 201);
    assert_eq!(service.get("/readyz").await.0, 200);
}

#[tokio::test]
async fn a_small_request_for_an_enormous_policy_is_refused() {
    let service = Service::start(&[]).await;
    let attribute = |n: usize| json!({"name": format!("{n:0>64}"), "kind": "number"});
    let model = json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    });
    assert_eq!(service.put("/v1/models/wide", &model).await.0, 201);
    let request = json!({"model": "wide", "demonstration": vec![json!({}); 10_800]});
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/demonstration"]), "{problem}");
    assert!(problem["detail"].as_str().unwrap().contains("64 MB is the most"), "{problem}");
}

#[tokio::test]
async fn a_policy_that_is_not_to_be_stored_is_answered_and_nothing_of_it_is_kept() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let mut request = example("figure-4/request.json");
    // It would be refined.
    request["lookahead"] = json!(1);
    let mut unstored = request.clone();
    unstored["store"] = json!(false);
    let response = service.send(Method::POST, "/v1/policies", &unstored).await;
    assert!(!response.headers().contains_key(LOCATION));
    let (status, mut policy) = answer(response).await;
    assert_eq!((status, &policy["status"]), (200, &json!("local")), "{policy}");
    assert!(policy.get("id").is_none(), "{policy}");
    assert_eq!(service.get("/v1/policies").await.1["items"], json!([]));

    request["store"] = json!(true);
    let (status, mut stored) = service.post("/v1/policies", &request).await;
    assert_eq!(status, 201);
    service.refined(stored["id"].as_str().unwrap()).await;
    assert_eq!(service.get("/v1/policies").await.1["items"].as_array().unwrap().len(), 2, "only the other is refined");
    stored.as_object_mut().unwrap().remove("id");
    for policy in [&mut policy, &mut stored] {
        policy["search"]["elapsed_us"] = Value::Null;
    }
    assert_eq!(policy, stored);

    request["store"] = json!("no");
    request["start"] = json!(-1);
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/store", "/start"]), "{problem}");
}

#[tokio::test]
async fn all_that_is_wrong_with_what_a_request_says_of_starts_weights_and_the_body_is_told_at_once() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let faults = async |request: Value| {
        let (status, problem) = service.post("/v1/policies", &request).await;
        assert_eq!(status, 422, "{problem}");
        let errors = problem["errors"].as_array().unwrap();
        let mut pointers: Vec<String> =
            errors.iter().map(|error| error["pointer"].as_str().unwrap().to_owned()).collect();
        pointers.sort_unstable();
        pointers
    };
    let request = json!({
        "model": "figure-4", "demonstration": [{"x": 0}, {"x": 1}], "observation_weights": [1, -1, 1], "extra_weight": 1.5,
        "end_weight": -1, "without": ["fly", 7], "action_costs": {"forward": -1, "fly": 1}, "start": [0, "x", 99999], "unsafe_cost": 3,
    });
    let expected = [
        "/action_costs/fly",
        "/action_costs/forward",
        "/end_weight",
        "/extra_weight",
        "/observation_weights",
        "/observation_weights/1",
        "/start/1",
        "/start/2",
        "/unsafe_cost",
        "/without/0",
        "/without/1",
    ];
    assert_eq!(faults(request).await, expected);
    let empty = json!({"model": "figure-4", "demonstration": [{}], "start": [], "observation_weights": 1});
    assert_eq!(faults(empty).await, ["/observation_weights", "/start"]);
}
