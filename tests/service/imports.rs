//! Files of other tools, registered as they are.

use crate::harness::service::{Service, answer};
use crate::problems::example_bytes;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Edits, ImportFile, ImportFormat, Limits, import};
use reqwest::header::CONTENT_TYPE;
use serde_json::{Value, json};

async fn put(service: &Service, path: &str, content_type: &str, body: Vec<u8>) -> (u16, Value) {
    let request = service.client.put(service.url(&format!("/v1/models/{path}"))).header(CONTENT_TYPE, content_type);
    answer(request.body(body).send().await.unwrap()).await
}

#[tokio::test]
async fn a_file_is_registered_by_its_content_type_as_the_model_that_it_gives() {
    let service = Service::start(&[]).await;
    let cases = [
        (ImportFormat::Gymnasium, "gymnasium/taxi.json", "?without=w*&cost=dropoff=1&rename=east=right"),
        (ImportFormat::Sas, "planning/blocksworld-4.sas", "?without=stack%20c%20*"),
        (ImportFormat::Drn, "verification/slippery.drn", "?cost=time"),
        (ImportFormat::Umb, "verification/slippery.umb", "?cost=energy&rename=lane=y"),
    ];
    for (format, path, query) in cases {
        let body = example_bytes(path);
        let mut edits = Edits::default();
        let query_text = query.replace("%20", " ");
        for (name, value) in query_text.trim_start_matches('?').split('&').filter_map(|part| part.split_once('=')) {
            match name {
                "without" => edits.without.push(value.to_owned()),
                "cost" => edits.add_cost(value).unwrap(),
                _ => edits.add_rename(value).unwrap(),
            }
        }
        let content = std::io::Cursor::new(body.clone());
        let content: Box<dyn std::io::BufRead> = match body.as_slice() {
            [0x1f, 0x8b, ..] => Box::new(std::io::BufReader::new(flate2::bufread::GzDecoder::new(content))),
            _ => Box::new(content),
        };
        let file = ImportFile { name: String::new(), content };
        let definition = import(format, vec![file], &edits, Limits::NONE, &mut Uninterrupted).unwrap();
        let name = format.name();
        let (status, registered) = put(&service, &format!("{name}{query}"), format.media_type(), body.clone()).await;
        assert_eq!(status, 201, "{registered}");
        let (status, _) = put(&service, &format!("{name}{query}"), format.media_type(), body).await;
        assert_eq!(status, 200, "the same again");
        let (_, model) =
            answer(service.client.get(service.url(&format!("/v1/models/{name}"))).send().await.unwrap()).await;
        assert_eq!(
            model["definition"].to_string(),
            serde_json::from_str::<Value>(&definition.text()).unwrap().to_string()
        );
    }
    service.stop().await;
}

#[tokio::test]
async fn what_is_wrong_with_a_file_is_told_with_its_place() {
    let service = Service::start(&[]).await;
    let gymnasium = ImportFormat::Gymnasium.media_type();
    let (status, problem) = put(&service, "m", gymnasium, b"[[[[0.5, 0, 0, false]]]]".to_vec()).await;
    let detail = "the probabilities of state 0 and action \"0\" sum to 0.5, not to 1";
    assert_eq!((status, &problem["errors"]), (422, &json!([{"pointer": "/P/0/0", "detail": detail}])));
    let (status, problem) = put(&service, "m", gymnasium, b"{\n\"P\": [".to_vec()).await;
    assert_eq!((status, &problem["errors"][0]["line"]), (422, &json!(2)));
    let (status, problem) = put(&service, "m?cost=x=-1&speed=1", gymnasium, b"[]".to_vec()).await;
    let pointers: Vec<_> = problem["errors"].as_array().unwrap().iter().map(|fault| fault["pointer"].clone()).collect();
    assert_eq!((status, pointers), (422, vec![json!("/cost"), json!("/speed")]));
    let (status, problem) = put(&service, "m?without=x", "application/json", b"{}".to_vec()).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/without")));
    let (status, _) = put(&service, "m", "application/vnd.unknown", b"{}".to_vec()).await;
    assert_eq!(status, 415);
    service.stop().await;
}
