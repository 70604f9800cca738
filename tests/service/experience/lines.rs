//! Batches that are sent as lines.

use serde_json::json;

use super::{batch, explored, kind, walk};
use crate::harness::service::{Service, answer};

#[tokio::test]
async fn a_log_of_lines_is_the_same_batch_as_one_of_json() {
    const LINES: &str = "application/x-ndjson";
    let service = Service::start(&[]).await;
    for name in ["m", "n"] {
        assert_eq!(service.put(&format!("/v1/models/{name}"), &explored(1)).await.0, 201);
    }
    let (_, expected) = service.post("/v1/models/m/experience", &batch("monday", &walk())).await;
    let lines: Vec<String> = walk().iter().map(|line| format!("{line}\r\n\n")).collect();
    let lines = lines.concat();
    let send = async |path: &str, kind: &str, text: &str| {
        let request = service.client.post(service.url(path)).header("content-type", kind).body(text.to_owned());
        answer(request.send().await.unwrap()).await
    };
    let (status, sent) = send("/v1/models/n/experience?batch=monday", LINES, &lines).await;
    assert_eq!((status, &sent["hash"], &sent["counts"]), (200, &expected["hash"], &expected["counts"]), "{sent}");
    // However it is sent, it counts once.
    assert_eq!(send("/v1/models/m/experience?batch=monday", LINES, &lines).await, (200, expected.clone()));
    assert_eq!(service.post("/v1/models/n/experience", &batch("monday", &walk())).await.1["hash"], expected["hash"]);
    assert_eq!(kind(&send("/v1/models/m/experience?batch=monday", LINES, "").await), (409, "/problems/conflict"));

    let faulty = format!("{{\"state\": [0], \"action\": \"jump\"}}\n{lines}{{\"state\": 1, \"state\": 2}}\nhello\n");
    let (status, problem) = send("/v1/models/m/experience?batch=tuesday", LINES, &faulty).await;
    let told: Vec<_> =
        problem["errors"].as_array().unwrap().iter().map(|fault| (&fault["line"], &fault["pointer"])).collect();
    assert_eq!(status, 422);
    for expected in [
        (&json!(1), &json!("/action")),
        (&json!(1), &json!("/next")),
        (&json!(8), &json!("/state")),
        (&json!(9), &json!("")),
    ] {
        assert!(told.contains(&expected), "{expected:?}: {problem}");
    }
    for (path, content_type, text) in [
        ("/v1/models/m/experience", LINES, &*lines),
        ("/v1/models/m/experience?batch=", LINES, &*lines),
        ("/v1/models/m/experience?batch=tuesday", "application/json", "{}"),
    ] {
        let (status, problem) = send(path, content_type, text).await;
        assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/batch")), "{path}: {problem}");
    }
}
