//! Models that take the place of others, and tags of models, from outside.

use reqwest::Method;
use reqwest::header::{ETAG, IF_MATCH, IF_NONE_MATCH};
use serde_json::{Value, json};

use crate::harness::service::{Service, answer};
use crate::stream::client::Client;

/// A line of four states, on which a step costs so much.
fn line(cost: f64) -> Value {
    let transitions: Vec<Value> = (1..4).map(|x| json!([x - 1, "forward", x])).collect();
    json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "forward", "cost": cost}],
        "dynamics": {
            "kind": "table", "states": (0..4).map(|x| json!([x])).collect::<Vec<_>>(), "transitions": transitions, "start": 0,
        },
    })
}

/// Puts the model `m`, if what is there has this tag.
async fn put(service: &Service, tag: &str, model: &Value) -> (u16, Value) {
    let request = service.client.put(service.url("/v1/models/m")).header(IF_MATCH, tag).json(model);
    answer(request.send().await.unwrap()).await
}

async fn follow(service: &Service) -> Value {
    service.post("/v1/policies", &json!({"model": "m", "demonstration": [{"x": 0}, {"x": 1}]})).await.1
}

fn kind(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["type"].as_str().unwrap_or_default())
}

#[tokio::test]
async fn a_model_is_replaced_at_once_if_it_is_the_one_that_is_expected() {
    let service = Service::start(&[]).await;
    let failed = (412, "/problems/precondition-failed");
    assert_eq!(kind(&put(&service, "*", &line(0.1)).await), failed, "nothing is there");
    assert_eq!(service.get("/v1/models/m").await.0, 404);
    let (status, first) = service.put("/v1/models/m", &line(0.1)).await;
    assert_eq!(status, 201);
    let tag = |model: &Value| format!("\"{}\"", model["hash"].as_str().unwrap());
    let old = follow(&service).await;

    assert_eq!(kind(&service.put("/v1/models/m", &line(0.2)).await), (409, "/problems/conflict"));
    assert_eq!(kind(&put(&service, "\"other\"", &line(0.2)).await), failed);
    let (status, second) = put(&service, &tag(&first), &line(0.2)).await;
    assert_eq!((status, &second["actions"][0]["cost"]), (200, &json!(0.2)), "{second}");
    let new = follow(&service).await;
    assert_eq!((&new["model_hash"], &new["cost"]["total"]), (&second["hash"], &json!(0.2)));
    let (_, kept) = service.get(&format!("/v1/policies/{}", old["id"].as_str().unwrap())).await;
    assert_eq!((&kept["model_hash"], &kept), (&first["hash"], &old));

    // Who did not hear that it was replaced sends it again, and who comes too late is told so.
    assert_eq!(put(&service, &tag(&first), &line(0.2)).await, (200, second.clone()));
    let late = put(&service, &tag(&first), &line(0.3)).await;
    assert_eq!(kind(&late), failed);
    assert!(late.1["detail"].as_str().unwrap().contains(second["hash"].as_str().unwrap()), "{}", late.1);
    assert_eq!(put(&service, &format!("\"a\", {}", tag(&second)), &line(0.3)).await.0, 200);
    assert_eq!(put(&service, "*", &line(0.1)).await.1["hash"], first["hash"]);
    let faulty = put(&service, "*", &json!({"attributes": []})).await;
    assert_eq!(kind(&faulty), (422, "/problems/invalid"));
    let (_, list) = service.get("/v1/models").await;
    assert_eq!((list["items"].as_array().unwrap().len(), &list["items"][0]["hash"]), (1, &first["hash"]));
}

#[tokio::test]
async fn of_those_who_replace_a_model_at_once_one_does() {
    let service = Service::start(&[]).await;
    let (_, first) = service.put("/v1/models/m", &line(1.0)).await;
    let tag = format!("\"{}\"", first["hash"].as_str().unwrap());
    let models: Vec<Value> = (2..10).map(|cost| line(f64::from(cost))).collect();
    let answers = futures_util::future::join_all(models.iter().map(|model| put(&service, &tag, model))).await;
    let replaced: Vec<&Value> = answers.iter().filter(|(status, _)| *status == 200).map(|(_, model)| model).collect();
    assert!(answers.iter().all(|(status, _)| [200, 412].contains(status)), "{answers:?}");
    assert_eq!(replaced.len(), 1, "{answers:?}");
    assert_eq!(follow(&service).await["model_hash"], replaced[0]["hash"]);
}

#[tokio::test]
async fn a_session_goes_on_with_the_model_that_it_was_opened_with_until_it_is_to_be_resumed() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &line(0.1)).await;
    let mut clients = [Client::connect(&service).await, Client::connect(&service).await];
    let mut sessions = Vec::new();
    for client in &mut clients {
        sessions.push(client.open(json!({"type": "open", "model": "m"})).await);
        client.send(json!({"type": "observe", "seq": 0, "states": [{"x": 0}]})).await;
        client.receive_until("received").await;
    }
    let [mut stays, leaves] = clients;
    drop(leaves);
    assert_eq!(put(&service, "*", &line(5.0)).await.0, 200);
    stays.send(json!({"type": "observe", "seq": 1, "states": [{"x": 1}]})).await;
    stays.send(json!({"type": "end", "seq": 2})).await;
    let done = stays.receive_until("done").await.pop().unwrap();
    assert_eq!(done["cost"]["total"], 0.1);
    let mut back = Client::connect(&service).await;
    back.send(json!({"type": "resume", "session": sessions[1]})).await;
    assert_eq!(back.receive_until_error().await["problem"]["type"], "/problems/unknown-model");
    assert_eq!(back.closed().await, 4404);
}

#[tokio::test]
async fn a_model_that_the_client_has_is_not_sent_again() {
    let service = Service::start(&[]).await;
    let response = service.send(Method::PUT, "/v1/models/m", &line(0.1)).await;
    let tag = response.headers()[ETAG].to_str().unwrap().to_owned();
    let (_, model) = answer(response).await;
    assert_eq!(tag, format!("\"{}\"", model["hash"].as_str().unwrap()));
    let get = async |known: &str| {
        let request = service.client.get(service.url("/v1/models/m")).header(IF_NONE_MATCH, known);
        let response = request.send().await.unwrap();
        assert_eq!(response.headers()[ETAG], tag);
        answer(response).await
    };
    assert_eq!(get(&tag).await, (304, json!("")));
    assert_eq!(get("\"other\"").await.0, 200);
    assert_eq!(service.send(Method::GET, "/v1/models/m", &Value::Null).await.headers()[ETAG], tag);
    assert_eq!(service.send(Method::PUT, "/v1/models/m", &line(0.1)).await.headers()[ETAG], tag);
}
