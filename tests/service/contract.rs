//! The description of the service is true: of its examples here, of everything else wherever it is sent.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use futures_util::{SinkExt, StreamExt};
use serde_json::{Map, Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::harness::contract::{CONTRACT, listed};
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
            "demonstration.json" => json!({"type": "array", "items": {"$ref": "#/components/schemas/Observation"}}),
            "request.json" if document["model"] == "figure-6" => body_schema("make_trial"),
            "request.json" => body_schema("make_policy"),
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
