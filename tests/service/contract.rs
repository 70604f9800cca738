//! The description of the service is true: of its examples here, of everything else wherever it is sent.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use futures_util::{SinkExt, StreamExt};
use serde_json::{Map, Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::harness::contract::{Answered, CONTRACT, Sent, listed};
use crate::harness::service::{Service, answer};
use crate::harness::waiting::within;

/// Stands in examples for an id that an operation before has answered.
const AN_ID: &str = "paste-an-id-here";

/// The type of the example of a body, and the example.
fn body(operation: &Map<String, Value>) -> Option<(&str, &Value)> {
    let contents = operation.get("requestBody")?["content"].as_object().unwrap();
    let mut examples =
        contents.iter().filter_map(|(content_type, content)| Some((&**content_type, content.get("example")?)));
    examples.next()
}

/// The path of an operation with the examples of its parameters; the ids are those of `ids`, by parameter.
fn path(template: &str, operation: &Map<String, Value>, ids: &BTreeMap<&str, String>) -> String {
    let parameters = operation.get("parameters").and_then(Value::as_array).into_iter().flatten();
    parameters.filter(|parameter| parameter["in"] == "path").fold(template.to_owned(), |path, parameter| {
        let name = parameter["name"].as_str().unwrap();
        let example = parameter["example"].as_str().unwrap_or_else(|| panic!("{template}: {name} has no example"));
        let value = if example == AN_ID { ids[name].clone() } else { example.to_owned() };
        path.replace(&format!("{{{name}}}"), &value)
    })
}

/// A model that is told the example of an experience.
fn explored() -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
        "actions": [{"name": "forward"}, {"name": "push"}],
        "dynamics": {"kind": "experience"},
    })
}

#[tokio::test]
async fn the_example_of_each_operation_works_after_those_before_it() {
    let service = Service::start(&["--learn-every", "1h"]).await;
    let mut ids = BTreeMap::new();
    let (mut trial, mut n_bodies) = (Value::Null, 0);
    for (method, template, operation) in listed() {
        let id = operation["operationId"].as_str().unwrap();
        // A trial ends once.
        if id == "fail_trial" {
            let (_, made) = service.post("/v1/learners/doors/trials", &trial).await;
            ids.insert("trial", made["id"].as_str().unwrap().to_owned());
        }
        if id == "add_experience" {
            assert_eq!(service.put("/v1/models/explored", &explored()).await.0, 201);
        }
        let path = path(&template, &operation, &ids);
        if id == "websocket" {
            let url = format!("ws://{}{path}", service.address);
            let (mut socket, _) = tokio_tungstenite::connect_async(url).await.unwrap();
            let hello = within("hello", socket.next()).await.unwrap().unwrap();
            CONTRACT.check_frame(&serde_json::from_str(hello.to_text().unwrap()).unwrap());
            socket.send(Message::Close(None)).await.unwrap();
            continue;
        }
        let mut request = service.client.request(method.clone(), service.url(&path));
        match body(&operation) {
            Some((content_type, example)) => {
                n_bodies += 1;
                let text = example.as_str().map_or_else(|| example.to_string(), str::to_owned);
                request = request.header("content-type", content_type).body(text);
            }
            None => assert!(!operation.contains_key("requestBody"), "{id} has an example of its body"),
        }
        let (status, answered) = answer(request.send().await.unwrap()).await;
        assert!((200..300).contains(&status), "{method} {path}: {status} {answered}");
        let own = |name: &str| answered[name].as_str().map(str::to_owned);
        match id {
            "make_policy" => drop(ids.insert("policy", own("id").unwrap())),
            "make_trial" => {
                trial = body(&operation).unwrap().1.clone();
                ids.insert("trial", own("id").unwrap());
            }
            "ndjson" => {
                let lines = answered.as_str().unwrap().lines();
                let frames: Vec<Value> = lines.map(|line| serde_json::from_str(line).unwrap()).collect();
                for frame in &frames {
                    CONTRACT.check_frame(frame);
                }
                ids.insert("session", frames[1]["session"].as_str().unwrap().to_owned());
                assert_eq!(frames.last().unwrap()["type"], "done");
            }
            _ => {}
        }
    }
    assert!(n_bodies >= 8, "{n_bodies} bodies");
}

/// Every object below `value`, with where it stands.
fn objects<'v>(pointer: &str, value: &'v Value, found: &mut Vec<(String, &'v Map<String, Value>)>) {
    if let Some(members) = value.as_object() {
        found.push((pointer.to_owned(), members));
        for (name, member) in members {
            objects(&format!("{pointer}/{name}"), member, found);
        }
    }
    for (n, item) in value.as_array().into_iter().flatten().enumerate() {
        objects(&format!("{pointer}/{n}"), item, found);
    }
}

#[test]
fn every_example_is_valid_against_the_schema_that_it_stands_in() {
    let mut found = Vec::new();
    objects("", &CONTRACT.document, &mut found);
    let mut n_examples = 0;
    for (pointer, members) in found {
        // Members of these are what is described, not what describes it.
        if pointer.ends_with("/properties") || pointer.ends_with("/example") {
            continue;
        }
        let several = members.get("examples").and_then(Value::as_array).into_iter().flatten();
        for example in members.get("example").into_iter().chain(several) {
            // Of a body or a parameter, or of the schema itself.
            let schema = members.get("schema").cloned().unwrap_or_else(|| Value::Object(members.clone()));
            assert_eq!(CONTRACT.broken_by_schema(&schema, example), None, "{pointer}: {example}");
            for invented in ["\"string\"", "additionalProp"] {
                assert!(!example.to_string().contains(invented), "{pointer}: {example}");
            }
            n_examples += 1;
        }
    }
    assert!(n_examples > 40, "{n_examples} examples");
}

/// The schema of the body of an operation.
fn body_schema(operation_id: &str) -> Value {
    let paths = CONTRACT.document["paths"].as_object().unwrap();
    let mut operations = paths.values().flat_map(|path| path.as_object().unwrap().values());
    let operation = operations.find(|operation| operation["operationId"] == operation_id).unwrap();
    operation["requestBody"]["content"]["application/json"]["schema"].clone()
}

#[test]
fn every_file_of_the_examples_is_valid_against_the_schema_of_what_it_is() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let files = |folder: &Path| -> Vec<PathBuf> {
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
    };
    let mut n_files = 0;
    for file in files(&root).iter().filter(|path| path.is_dir()).flat_map(|folder| files(folder)) {
        let name = file.file_name().unwrap().to_str().unwrap();
        if file.extension().is_none_or(|extension| extension != "json") {
            continue;
        }
        let document: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
        let schema = match name {
            // The file of another tool.
            _ if document.get("P").or(document.get("variables")).is_some() => continue,
            _ if document.is_array() => json!({"type": "array", "items": {"$ref": "#/components/schemas/Observation"}}),
            "request.json" if document["model"] == "figure-6" => body_schema("make_trial"),
            "request.json" => body_schema("make_policy"),
            _ if document.get("transitions").is_some() => body_schema("add_experience"),
            "policy.json" => json!({"$ref": "#/components/schemas/Policy"}),
            _ => body_schema("put_model"),
        };
        assert_eq!(CONTRACT.broken_by_schema(&schema, &document), None, "{}", file.display());
        n_files += 1;
    }
    assert!(n_files >= 20, "{n_files} files");
}

#[tokio::test]
async fn the_distance_is_what_the_description_of_attributes_says() {
    let told = CONTRACT.document["components"]["schemas"]["Attribute"]["description"].as_str().unwrap();
    for part in
        ["weight * delta^2", "|o - s| / scale", "min(d mod p, p - d mod p) / scale", "0 if they are equal, else 1"]
    {
        assert!(told.contains(part), "{part}: {told}");
    }
    let service = Service::start(&[]).await;
    let model = json!({
        "attributes": [
            {"name": "x", "kind": "number", "scale": 2},
            {"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]},
            {"name": "door", "kind": "category", "weight": 5},
        ],
        "actions": [],
        "dynamics": {"kind": "table", "states": [[3, "south", "shut"]], "transitions": []},
    });
    assert_eq!(service.put("/v1/models/still", &model).await.0, 201);
    let request = json!({"model": "still", "demonstration": [{"x": 0, "heading": "east", "door": "open"}]});
    let (_, policy) = service.post("/v1/policies", &request).await;
    assert!(told.contains(&format!("= {}`", policy["cost"]["distance"])), "{}: {told}", policy["cost"]);
    assert_eq!(policy["steps"][0]["distance_by_attribute"], json!({"x": 2.25, "heading": 1.0, "door": 5.0}));
}

#[tokio::test]
async fn a_fault_of_form_is_refused_and_not_valid() {
    let service = Service::start(&[]).await;
    let mut examples = BTreeMap::new();
    for (method, template, operation) in listed() {
        let id = operation["operationId"].as_str().unwrap().to_owned();
        if let Some((_, example)) = body(&operation).filter(|(content_type, _)| *content_type == "application/json") {
            if id.starts_with("put_") && id != "put_reward" {
                let path = path(&template, &operation, &BTreeMap::new());
                assert_eq!(service.put(&path, example).await.0, 201);
            }
            examples.insert(id, (method, template, operation.clone()));
        }
    }
    assert_eq!(service.put("/v1/models/explored", &explored()).await.0, 201);
    let (_, made) = service.post("/v1/learners/doors/trials", body(&examples["make_trial"].2).unwrap().1).await;
    let ids = BTreeMap::from([("trial", made["id"].as_str().unwrap().to_owned())]);
    for (id, pointer, faulty) in [
        ("put_model", "", json!([])),
        ("put_model", "/hurry", json!(1)),
        ("put_model", "/dynamics/kind", json!("tables")),
        ("put_model", "/dynamics/walls", json!([])),
        ("put_model", "/dynamics/states/0/0", json!([0])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward"])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward", 1, 1, 1, 1])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward", -1])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward", 1, 0])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward", 1, 1.5])),
        ("put_model", "/dynamics/transitions/0", json!([0, "forward", 1, 1, -2])),
        ("put_model", "/dynamics/start", json!("first")),
        ("put_model", "/attributes/0/kind", json!("integer")),
        ("put_model", "/attributes/0/scale", json!(0)),
        ("put_model", "/attributes/0/weight", json!(-1)),
        ("put_model", "/attributes/0/unit", json!("m")),
        ("put_model", "/actions/0/cost", json!(-0.1)),
        ("put_model", "/dynamics", json!({"kind": "wumpus", "width": 0, "height": 4})),
        ("put_model", "/dynamics", json!({"kind": "wumpus", "width": 4, "height": 4, "arrows": 101})),
        ("put_model", "/dynamics", json!({"kind": "wumpus", "width": 4, "height": 4, "gold": [[1, 2, 3]]})),
        ("put_model", "/dynamics", json!({"kind": "wumpus", "width": 4, "height": 4, "start": {"x": 0}})),
        ("put_model", "/dynamics", json!({"kind": "experience", "min_count": 0})),
        ("put_model", "/dynamics", json!({"kind": "experience", "bin": {"x": "wide"}})),
        ("put_model", "/dynamics", json!({"kind": "experience", "start": 0})),
        ("put_model", "/dynamics", json!({"kind": "experience", "unsafe": {}})),
        ("add_experience", "/batch", json!("")),
        ("add_experience", "/speed", json!(1)),
        ("add_experience", "/transitions", json!({})),
        ("add_experience", "/transitions/0/state", json!(1)),
        ("add_experience", "/transitions/0/action", json!(0)),
        ("add_experience", "/transitions/0/count", json!(0)),
        ("add_experience", "/transitions/0/count", json!(1.5)),
        ("add_experience", "/transitions/0/cost", json!(-0.5)),
        ("make_policy", "/model", json!(7)),
        ("make_policy", "/demonstration", json!({})),
        ("make_policy", "/demonstration/0", json!(3)),
        ("make_policy", "/demonstration/0/x", json!([1])),
        ("make_policy", "/weights/x", json!("2")),
        ("make_policy", "/lookahead", json!(0)),
        ("make_policy", "/lookahead", json!(1.5)),
        ("make_policy", "/heuristic", json!("magic")),
        ("make_policy", "/max_expansions", json!(-1)),
        ("make_policy", "/deadline_ms", json!(86_400_001)),
        ("make_policy", "/extra_weight", json!(1.5)),
        ("make_policy", "/end_weight", json!(-1)),
        ("make_policy", "/observation_weights", json!(1)),
        ("make_policy", "/start", json!([[0]])),
        ("make_policy", "/without", json!("forward")),
        ("make_policy", "/action_costs", json!([1])),
        ("make_policy", "/store", json!("no")),
        ("make_policy", "/explore", json!(true)),
        ("make_policies", "/items", json!([])),
        ("make_policies", "/speed", json!(1)),
        ("put_learner", "/attributes", json!("x")),
        ("put_learner", "/lease_s", json!(0)),
        ("put_learner", "/reward_scale", json!(0)),
        ("put_learner", "/algorithm", json!({"kind": "sarsa"})),
        ("put_learner", "/algorithm", json!({"kind": "srv", "beta": 2})),
        ("put_learner", "/seed", json!(-1)),
        ("make_trial", "/learner", json!("doors")),
        ("make_trial", "/demonstration", json!(null)),
        ("put_reward", "/reward", json!("much")),
        ("put_reward", "", json!({})),
        ("fail_trial", "/reason", json!(7)),
    ] {
        let (method, template, operation) = &examples[id];
        let mut document = body(operation).unwrap().1.clone();
        match pointer.rsplit_once('/') {
            None => document = faulty.clone(),
            Some((parent, member)) => match document.pointer_mut(parent).unwrap() {
                Value::Array(items) => items[member.parse::<usize>().unwrap()] = faulty.clone(),
                parent => parent[member] = faulty.clone(),
            },
        }
        let path = path(template, operation, &ids);
        let (status, answered) = answer(service.send(method.clone(), &path, &document).await).await;
        assert_eq!(status, 422, "{id} with {faulty} at {pointer:?}: {answered}");
        assert_ne!(
            CONTRACT.broken_by_schema(&body_schema(id), &document),
            None,
            "{id} with {faulty} at {pointer:?} is valid"
        );
    }
}

#[tokio::test]
async fn the_json_requests_of_the_readme_are_what_the_description_says() {
    let readme = include_str!("../../README.md").replace("\\\n", " ");
    let service = Service::start(&[]).await;
    let (mut trial, mut n_sent) = (String::new(), 0);
    let blocks = readme.split("```sh\n").skip(1).map(|block| block.split_once("```").unwrap());
    for (commands, after) in blocks {
        for command in commands.lines().filter(|line| line.contains("curl ")) {
            let json = command.split("--json ").nth(1);
            let path =
                command.split("http://127.0.0.1:8080").nth(1).and_then(|path| path.split([' ', '|', ')']).next());
            // What is made by another program, or compressed, or streamed, is not here to be read.
            let (Some(json), Some(path)) = (json.filter(|json| !json.starts_with("@-")), path) else { continue };
            let document: Value = match json.strip_prefix('@') {
                Some(file) => {
                    crate::harness::service::example(file.split(' ').next().unwrap().strip_prefix("examples/").unwrap())
                }
                None => serde_json::from_str(json.split('\'').nth(1).unwrap()).unwrap(),
            };
            let method = if command.contains("-X PUT") { reqwest::Method::PUT } else { reqwest::Method::POST };
            let path = path.replace("$trial", &trial);
            // If it is accepted, the harness holds it against its schema.
            let (status, answered) = answer(service.send(method, &path, &document).await).await;
            let is_faulty = after.trim_start().starts_with("```json\n{\"type\":\"/problems/");
            assert!(if is_faulty { status == 422 } else { status < 300 }, "{command}: {status} {answered}");
            if path.ends_with("/trials") {
                answered["id"].as_str().unwrap().clone_into(&mut trial);
            }
            n_sent += 1;
        }
    }
    assert!(n_sent >= 6, "{n_sent} requests");
}

#[test]
fn what_breaks_the_contract_is_found() {
    let sent = |body: &str| Sent {
        method: reqwest::Method::PUT,
        url: "http://127.0.0.1/v1/trials/7/reward".parse().unwrap(),
        content_type: Some("application/json".to_owned()),
        body: Some(body.into()),
    };
    let is_kept = |sent: Sent, status: u16, body: &Value| {
        let text = body.to_string();
        let content_type = Some(if status < 300 { "application/json" } else { "application/problem+json" });
        let answered = Answered { status, content_type, body: Some(text.as_bytes()) };
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| CONTRACT.check(&sent, &answered))).is_ok()
    };
    let trial = json!({
        "id": "7", "learner": "gold", "number": 1, "status": "rewarded", "weights": {"x": 1}, "weights_version": 0, "reward": 1,
        "reward_order": 1, "learned_version": null, "reason": null, "lease_expires_at": "2026-01-01T00:00:00Z", "policy_id": "8",
    });
    let but = |member: &str, value: Value| {
        let mut other = trial.clone();
        other[member] = value;
        other
    };
    let problem = json!({"type": "/problems/x", "title": "X", "status": 422, "detail": "x", "request_id": "y"});
    assert!(is_kept(sent(r#"{"reward": 1}"#), 200, &trial));
    assert!(is_kept(sent("nonsense"), 422, &problem), "what is refused may be anything");
    assert!(!is_kept(sent(r#"{"reward": "1"}"#), 200, &trial), "accepted, though it is not valid");
    assert!(!is_kept(sent(r#"{"reward": 1, "hurry": 1}"#), 200, &trial));
    assert!(!is_kept(sent(r#"{"reward": 1}"#), 201, &trial), "a status that is not told");
    assert!(!is_kept(sent(r#"{"reward": 1}"#), 200, &problem), "another answer");
    assert!(!is_kept(sent(r#"{"reward": 1}"#), 200, &but("mood", json!("good"))), "a member that is not described");
    assert!(!is_kept(sent(r#"{"reward": 1}"#), 200, &but("status", json!("lost"))));
    assert!(!is_kept(sent(r#"{"reward": 1}"#), 200, &but("lease_expires_at", json!("soon"))));
}
