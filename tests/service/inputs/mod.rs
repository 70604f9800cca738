//! How inputs are read: what is taken, and what is told of what is not.

mod meaning;

use reqwest::Method;
use reqwest::header::CONTENT_TYPE;
use serde_json::{Value, json};

use crate::harness::service::{Service, answer};

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

/// Sends text as JSON.
async fn send_text(service: &Service, method: Method, path: &str, text: impl Into<reqwest::Body>) -> (u16, Value) {
    let request = service.client.request(method, service.url(path)).header(CONTENT_TYPE, "application/json");
    answer(request.body(text).send().await.unwrap()).await
}

/// The pointers of what is told to be wrong.
fn pointers(errors: &Value) -> Vec<&str> {
    errors.as_array().unwrap().iter().map(|error| error["pointer"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn a_key_given_twice_is_a_fault_with_its_place_wherever_it_stands() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    let (_, trial) =
        service.post("/v1/learners/l/trials", &json!({"model": "line", "demonstration": [{"x": 1}]})).await;
    let reward = format!("/v1/trials/{}/reward", trial["id"].as_str().unwrap());
    let model = line().to_string().replacen("\"cost\":0.3", "\"cost\":0.3,\"cost\":0.4", 1);
    for (method, path, text, pointer) in [
        (
            Method::POST,
            "/v1/policies",
            r#"{"model": "line", "demonstration": [{"x": 1}], "weights": {"x": 1, "x": 5}}"#,
            "/weights/x",
        ),
        (
            Method::POST,
            "/v1/policies",
            r#"{"model": "line", "demonstration": [{"x": 1}, {"x": 1, "x": 2}]}"#,
            "/demonstration/1/x",
        ),
        (Method::POST, "/v1/policies", r#"{"model": "line", "demonstration": [{"x": 1}], "model": "line"}"#, "/model"),
        (
            Method::POST,
            "/v1/policies:batch",
            r#"{"model": "line", "items": [{"demonstration": [{"x": 1}], "weights": {"x": 1, "x": 5}}]}"#,
            "/items/0/weights/x",
        ),
        (
            Method::POST,
            "/v1/policies:batch",
            r#"{"model": "line", "items": [{"demonstration": [{"x": 1, "x": 1}]}]}"#,
            "/items/0/demonstration/0/x",
        ),
        (
            Method::POST,
            "/v1/learners/l/trials",
            r#"{"model": "line", "demonstration": [{"x": null, "x": 1}]}"#,
            "/demonstration/0/x",
        ),
        (Method::PUT, "/v1/learners/k", r#"{"attributes": ["x"], "mean": {"x": 1, "x": 2}}"#, "/mean/x"),
        (Method::PUT, &reward, r#"{"reward": 1, "reward": 2}"#, "/reward"),
        (Method::PUT, "/v1/models/other", &model, "/actions/0/cost"),
    ] {
        let (status, problem) = send_text(&service, method, path, text.to_owned()).await;
        assert_eq!((status, pointers(&problem["errors"])), (422, vec![pointer]), "{path} {text}: {problem}");
        assert!(problem["errors"][0]["detail"].as_str().unwrap().contains("twice"), "{problem}");
    }
    let frames = stream_text(&service, r#"{"type": "open", "model": "line", "weights": {"x": 1, "x": 2}}"#).await;
    assert_eq!(pointers(&frames[1]["problem"]["errors"]), ["/weights/x"], "{frames:?}");
    let observing = "{\"type\": \"open\", \"model\": \"line\"}\n{\"type\": \"observe\", \"seq\": 0, \"states\": [{\"x\": 1, \"x\": 2}]}\n";
    let frames = stream_text(&service, observing).await;
    assert_eq!(pointers(&frames[2]["problem"]["errors"]), ["/states/0/x"], "{frames:?}");
    service.stop().await;
}

#[tokio::test]
async fn a_body_a_frame_or_a_line_may_begin_with_a_byte_order_mark() {
    let service = Service::start(&[]).await;
    let marked = |value: &Value| format!("\u{feff}{value}");
    assert_eq!(send_text(&service, Method::PUT, "/v1/models/line", marked(&line())).await.0, 201);
    // Large enough to be read as it comes.
    let spaces = " ".repeat(2 << 20);
    let large = format!("\u{feff}{spaces}{}", line());
    assert_eq!(send_text(&service, Method::PUT, "/v1/models/large", large).await.0, 201);
    let request = json!({"model": "line", "demonstration": [{"x": 0}, {"x": 2}]});
    let (status, policy) = send_text(&service, Method::POST, "/v1/policies", marked(&request)).await;
    assert_eq!((status, &policy["cost"]["total"]), (201, &json!(1.3)), "{policy}");
    let batch = json!({"model": "line", "items": [{"demonstration": [{"x": 0}]}]});
    assert_eq!(send_text(&service, Method::POST, "/v1/policies:batch", marked(&batch)).await.0, 200);
    assert_eq!(send_text(&service, Method::PUT, "/v1/learners/l", marked(&json!({"attributes": ["x"]}))).await.0, 201);
    let frames = [
        json!({"type": "open", "model": "line"}),
        json!({"type": "observe", "seq": 0, "states": [{"x": 1}]}),
        json!({"type": "end", "seq": 1}),
    ];
    let answered = stream_text(&service, frames.iter().map(marked).collect::<Vec<_>>().join("\n")).await;
    assert_eq!(answered.last().unwrap()["type"], "done", "{answered:?}");
    service.stop().await;
}

#[tokio::test]
async fn whole_numbers_may_be_written_with_a_point_or_an_exponent() {
    let service = Service::start(&[]).await;
    let mut model = line();
    model["dynamics"]["transitions"] = json!([[0.0, "on", 1.0], [1, 0.0, 2.0], [1.0, 1.0, 0], [2, "back", 1]]);
    model["dynamics"]["start"] = json!(0.0);
    let (_, plain) = service.put("/v1/models/plain", &line()).await;
    let (status, made) = service.put("/v1/models/line", &model).await;
    assert_eq!((status, &made["hash"]), (201, &plain["hash"]), "{made}");
    let text = r#"{"model": "line", "demonstration": [{"x": 0}, {"x": 2}], "lookahead": 8.0, "max_expansions": 1e2, "deadline_ms": 1.5e3, "start": 1.0}"#;
    let (status, policy) = send_text(&service, Method::POST, "/v1/policies", text).await;
    assert_eq!(
        (status, &policy["lookahead"], &policy["steps"][0]["state_index"]),
        (201, &json!(8), &json!(1)),
        "{policy}"
    );
    let cave = r#"{"dynamics": {"kind": "wumpus", "width": 4.0, "height": 3e0, "pits": [[1.0, 1]], "start": {"x": 0.0, "y": 0}, "arrows": 1.0}}"#;
    assert_eq!(send_text(&service, Method::PUT, "/v1/models/cave", cave).await.0, 201);
    let seed = r#"{"attributes": ["x"], "seed": 7.0, "lease_s": 6e2}"#;
    assert_eq!(send_text(&service, Method::PUT, "/v1/learners/l", seed).await.0, 201);
    let frames = stream_text(
        &service,
        "{\"type\": \"open\", \"model\": \"line\", \"lookahead\": 1.0}\n{\"type\": \"observe\", \"seq\": 0.0, \"states\": [{}]}\n\
         {\"type\": \"end\", \"seq\": 1.0}\n",
    )
    .await;
    assert_eq!(frames.last().unwrap()["type"], "done", "{frames:?}");
    for text in ["8.5", "-8.0", "1e-1"] {
        let text = format!(r#"{{"model": "line", "demonstration": [{{}}], "lookahead": {text}}}"#);
        let (status, problem) = send_text(&service, Method::POST, "/v1/policies", text).await;
        assert_eq!((status, pointers(&problem["errors"])), (422, vec!["/lookahead"]), "{problem}");
    }
    service.stop().await;
}

#[tokio::test]
async fn an_integer_that_no_number_holds_exactly_is_told_to_be_a_category() {
    const BEYOND: u64 = 9_007_199_254_740_993;
    let service = Service::start(&[]).await;
    let mut model = line();
    model["dynamics"]["states"] = json!([[BEYOND, "a"], [BEYOND - 1, "a"], [-9_007_199_254_740_993_i64, "a"]]);
    let (status, problem) = service.put("/v1/models/m", &model).await;
    assert_eq!((status, pointers(&problem["errors"])), (422, vec!["/dynamics/states/0/0", "/dynamics/states/2/0"]));
    assert!(problem["errors"][0]["detail"].as_str().unwrap().contains("a category"), "{problem}");
    service.put("/v1/models/line", &line()).await;
    let observed =
        json!({"model": "line", "demonstration": [{"x": BEYOND - 1}, {"x": BEYOND}], "start": {"x": BEYOND}});
    let (status, problem) = service.post("/v1/policies", &observed).await;
    assert_eq!((status, pointers(&problem["errors"])), (422, vec!["/demonstration/1/x", "/start/x"]), "{problem}");
    // As categories, they are told apart.
    model["attributes"][0]["kind"] = json!("category");
    assert_eq!(service.put("/v1/models/m", &model).await.0, 201);
    let request = json!({"model": "m", "demonstration": [{"x": BEYOND - 1}], "start": {"x": BEYOND - 1}});
    let (_, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((&policy["steps"][0]["state_index"], &policy["cost"]["total"]), (&json!(1), &json!(0.0)), "{policy}");
    service.stop().await;
}

#[tokio::test]
async fn a_fault_at_every_observation_is_told_once_with_how_often() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    let seen: Vec<Value> = (0..92)
        .map(|n| if n < 2 { json!({"x": n}) } else { json!({"x": n.to_string(), "gold": n, "door": n}) })
        .collect();
    let told = json!([
        {"pointer": "/demonstration/2/gold", "detail": "unknown attribute \"gold\"; the model has \"x\", \"door\" (and in 89 more observations)"},
        {"pointer": "/demonstration/2/x", "detail": "expected a number, found \"2\" (and in 89 more observations)"},
        {"pointer": "/demonstration/91", "detail": "expected 2 values, one per attribute, found 1"},
    ]);
    let mut seen_with_more = seen.clone();
    seen_with_more[91] = json!([1]);
    let (status, problem) =
        service.post("/v1/policies", &json!({"model": "line", "demonstration": seen_with_more})).await;
    let told = told.to_string().replace("89 more", "88 more");
    assert_eq!((status, problem["errors"].to_string()), (422, told), "{problem}");
    let batch = json!({"model": "line", "items": [{"demonstration": [{"x": 1}]}, {"demonstration": seen}]});
    let (_, answers) = service.post("/v1/policies:batch", &batch).await;
    let errors = &answers["items"][1]["problem"]["errors"];
    assert_eq!(pointers(errors), ["/items/1/demonstration/2/gold", "/items/1/demonstration/2/x"], "{answers}");
    let frames = [json!({"type": "open", "model": "line"}), json!({"type": "observe", "seq": 0, "states": seen})];
    let frames = stream(&service, &frames).await;
    assert_eq!(pointers(&frames[2]["problem"]["errors"]), ["/states/2/gold", "/states/2/x"], "{frames:?}");
    service.stop().await;
}

/// Each letter with an accent as one, and as the letter and the accent.
fn forms(text: &str) -> [String; 2] {
    [text.replace("o\u{308}", "\u{f6}").replace("u\u{308}", "\u{fc}"), text.to_owned()]
}

#[tokio::test]
async fn names_and_texts_that_differ_by_normalization_alone_are_equal() {
    let service = Service::start(&[]).await;
    let model = |form: usize| {
        let text = json!({
            "attributes": [
                {"name": "gro\u{308}\u{df}e", "kind": "number"}, {"name": "tu\u{308}r", "kind": "category"},
                {"name": "richtung", "kind": "cyclic", "labels": ["su\u{308}d", "nord"]},
            ],
            "actions": [{"name": "o\u{308}ffnen", "cost": 0.3}],
            "dynamics": {
                "kind": "table", "states": [[0, "zu", "nord"], [0, "geo\u{308}ffnet", "su\u{308}d"]],
                "transitions": [[0, "o\u{308}ffnen", 1]], "start": 0,
            },
        });
        forms(&text.to_string())[form].clone()
    };
    let (status, composed) = send_text(&service, Method::PUT, "/v1/models/m", model(0)).await;
    assert_eq!((status, &composed["attributes"][0]["name"]), (201, &json!("gr\u{f6}\u{df}e")), "{composed}");
    let (status, same) = send_text(&service, Method::PUT, "/v1/models/m", model(1)).await;
    assert_eq!((status, &same["hash"]), (200, &composed["hash"]));
    // In ASCII, as some programs write it.
    let (status, _) = send_text(&service, Method::PUT, "/v1/models/m", model(1).replace('\u{308}', "\\u0308")).await;
    assert_eq!(status, 200);
    let request = json!({
        "model": "m", "weights": {"gro\u{308}\u{df}e": 2}, "start": {"tu\u{308}r": "zu"},
        "demonstration": [{"tu\u{308}r": "zu"}, {"tu\u{308}r": "geo\u{308}ffnet", "richtung": "su\u{308}d"}, [0, "geo\u{308}ffnet", "su\u{308}d"]],
    });
    for form in forms(&request.to_string()) {
        let (status, policy) = send_text(&service, Method::POST, "/v1/policies", form).await;
        assert_eq!((status, &policy["cost"]["total"], &policy["warnings"]), (201, &json!(0.3), &json!([])), "{policy}");
        assert_eq!(policy["weights"]["gr\u{f6}\u{df}e"], 2.0, "{policy}");
    }
    let learner = json!({"attributes": ["gro\u{308}\u{df}e"], "mean": {"gr\u{f6}\u{df}e": 3}});
    assert_eq!(service.put("/v1/learners/l", &learner).await.0, 201);
    let (status, trial) = service.post("/v1/learners/l/trials", &json!({"model": "m", "demonstration": [{}]})).await;
    assert_eq!(status, 201, "{trial}");
    // Both at once are one twice.
    let twice = json!({
        "model": "m", "weights": {"gro\u{308}\u{df}e": 2, "gr\u{f6}\u{df}e": 2},
        "demonstration": [{"gro\u{308}\u{df}e": 2, "gr\u{f6}\u{df}e": 2}],
    });
    let (status, problem) = service.post("/v1/policies", &twice).await;
    assert_eq!(
        (status, pointers(&problem["errors"])),
        (422, vec!["/demonstration/0/gr\u{f6}\u{df}e", "/weights/gr\u{f6}\u{df}e"])
    );
    let alike = json!([{"name": "o\u{308}", "kind": "number"}, {"name": "\u{f6}", "kind": "number"}]);
    let mut model: Value = serde_json::from_str(&model(0)).unwrap();
    model["attributes"] = alike;
    model["actions"] = json!([{"name": "o\u{308}"}, {"name": "\u{f6}"}]);
    let (_, problem) = service.put("/v1/models/alike", &model).await;
    let twice = problem["errors"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|error| error["detail"].as_str().unwrap().contains("already"));
    assert_eq!(twice.map(|error| &error["pointer"]).collect::<Vec<_>>(), ["/attributes/1/name", "/actions/1/name"]);
    service.stop().await;
}
