//! Lists of what is wanted alone, from outside.

use serde_json::{Value, json};

use crate::harness::service::{Service, example};
use crate::stream::client::Client;

/// The ids of all items of a list, read in pages of two.
async fn ids(service: &Service, path: &str) -> Vec<String> {
    let (mut ids, mut after) = (Vec::new(), String::new());
    loop {
        let (status, page) = service.get(&format!("{path}&limit=2{after}")).await;
        assert_eq!(status, 200, "{page}");
        let items = page["items"].as_array().unwrap();
        ids.extend(items.iter().map(|item| item["id"].as_str().unwrap().to_owned()));
        match page["next"].as_str() {
            Some(next) => after = format!("&after={next}"),
            None => return ids,
        }
    }
}

fn pointers(problem: &Value) -> Vec<&str> {
    let errors = problem["errors"].as_array().unwrap();
    errors.iter().map(|error| error["pointer"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn policies_are_listed_by_model_learner_and_status() {
    let service = Service::start(&[]).await;
    for name in ["a", "b"] {
        service.put(&format!("/v1/models/{name}"), &example("figure-4/model.json")).await;
    }
    let attributes = json!({"attributes": ["x", "y", "heading", "gold", "arrows"]});
    service.put("/v1/learners/gold", &attributes).await;
    let demonstration = example("figure-4/demonstration.json");
    let mut made = Vec::new();
    for n in 0..12 {
        let mut request = json!({"model": if n % 2 == 0 { "a" } else { "b" }, "demonstration": demonstration});
        if n % 3 == 0 {
            request["learner"] = json!("gold");
        }
        if n % 4 == 0 {
            request["max_expansions"] = json!(1);
        }
        made.push(service.post("/v1/policies", &request).await.1);
    }
    for (query, wanted) in [
        ("model=a", json!({"model": "a"})),
        ("learner=gold", json!({"learner": "gold"})),
        ("status=bounded", json!({"status": "bounded"})),
        ("status=optimal&model=b", json!({"status": "optimal", "model": "b"})),
        ("model=b&learner=gold&status=optimal", json!({"model": "b", "learner": "gold", "status": "optimal"})),
        ("model=b&status=bounded", json!({"model": "b", "status": "bounded"})),
        ("model=c", json!({"model": "c"})),
    ] {
        let has_all = |policy: &&Value| wanted.as_object().unwrap().iter().all(|(name, value)| policy[name] == *value);
        let expected: Vec<_> = made.iter().filter(has_all).map(|policy| policy["id"].as_str().unwrap()).collect();
        assert_eq!(ids(&service, &format!("/v1/policies?{query}")).await, expected, "{query}");
    }
    // A page goes on where the last one has ended, whatever is made or deleted in between.
    let (_, page) = service.get("/v1/policies?model=a&limit=2").await;
    let path = |n: usize| format!("/v1/policies/{}", made[n]["id"].as_str().unwrap());
    assert_eq!(service.delete(&path(2)).await.0, 204);
    service.post("/v1/policies", &json!({"model": "a", "demonstration": demonstration})).await;
    let rest = ids(&service, &format!("/v1/policies?model=a&after={}", page["next"].as_str().unwrap())).await;
    assert_eq!((rest.len(), rest[0].as_str()), (5, made[4]["id"].as_str().unwrap()));

    let (status, problem) = service.get("/v1/policies?model=%20&status=done&learner=..&state=1&limit=0").await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/model", "/status", "/learner", "/state", "/limit"]));
}

#[tokio::test]
async fn refined_policies_and_sessions_are_listed_by_what_they_are() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/a", &example("figure-4/model.json")).await;
    let mut sessions = Vec::new();
    for n in 0..4 {
        let mut client = Client::connect(&service).await;
        let session = client.open(json!({"type": "open", "model": "a", "lookahead": 1})).await;
        if n % 2 == 0 {
            client.send(json!({"type": "observe", "seq": 0, "states": example("figure-4/demonstration.json")})).await;
            client.send(json!({"type": "end", "seq": 16})).await;
            let done = client.receive_until("done").await.pop().unwrap();
            assert_eq!(done["status"], "local");
            service.refined(done["policy_id"].as_str().unwrap()).await;
        }
        sessions.push(session);
    }
    for (status, n) in [("local", 2), ("optimal", 2), ("bounded", 0)] {
        assert_eq!(ids(&service, &format!("/v1/policies?status={status}")).await.len(), n, "{status}");
    }
    let of = |which: [usize; 2]| which.map(|n| sessions[n].clone());
    assert_eq!(ids(&service, "/v1/sessions?status=done").await, of([0, 2]));
    assert_eq!(ids(&service, "/v1/sessions?status=open&model=a").await, of([1, 3]));
    assert_eq!(ids(&service, "/v1/sessions?model=a").await, sessions);
    assert_eq!(ids(&service, "/v1/sessions?model=b").await, Vec::<String>::new());
    let (status, problem) = service.get("/v1/sessions?status=optimal&learner=gold").await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/status", "/learner"]));
}
