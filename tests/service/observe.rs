//! Demonstrators whose states are told in another vocabulary, from outside.

use serde_json::{Value, json};

use crate::harness::service::Service;
use crate::stream::client::Client;

/// The next frame of this kind.
async fn last(client: &mut Client, kind: &str) -> Value {
    client.receive_until(kind).await.pop().unwrap()
}

/// A corridor with a door.
fn corridor() -> Value {
    let doors = ["shut", "open"];
    let states: Vec<Value> = doors.iter().flat_map(|door| (0..5).map(move |x| json!([x, door]))).collect();
    let ahead = (0..10).filter(|s| s % 5 < 4).map(|s| json!([s, "forward", s + 1]));
    let opening = (0..5).map(|s| json!([s, "open", s + 5]));
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
        "actions": [{"name": "forward", "cost": 0.3}, {"name": "open", "cost": 0.3}],
        "dynamics": {"kind": "table", "states": states, "transitions": ahead.chain(opening).collect::<Vec<_>>(), "start": 0},
    })
}

fn observe() -> Value {
    json!({"x": "east_m / 0.25", "door": "opening > 0.5 ? 'open' : 'shut'"})
}

/// What a demonstrator with a tape measure saw, and what that is for the imitator.
fn seen() -> (Value, Value) {
    let rows = [(0.0, Some(0.1)), (0.25, Some(0.2)), (0.25, Some(0.75)), (0.75, None), (1.0, Some(1.0))];
    let own = rows.iter().map(|(east, opening)| json!({"east_m": east, "opening": opening}));
    let door = |opening: &Option<f64>| opening.map(|opening| if opening > 0.5 { "open" } else { "shut" });
    let imitators = rows.iter().map(|(east, opening)| json!({"x": east * 4.0, "door": door(opening)}));
    (own.collect(), imitators.collect())
}

/// A policy, without what differs each time.
fn bare(mut policy: Value) -> Value {
    policy["search"]["elapsed_us"] = 0.into();
    for name in ["id", "refined_by", "refines"] {
        policy.as_object_mut().unwrap().remove(name);
    }
    policy
}

#[tokio::test]
async fn a_policy_for_what_is_observed_is_the_one_for_the_imitators_own_observations() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &corridor()).await;
    let (own, imitators) = seen();
    for lookahead in [Value::Null, json!(3)] {
        let request = json!({"model": "m", "demonstration": imitators, "lookahead": lookahead, "collapse": {"x": 0.5}});
        let (status, expected) = service.post("/v1/policies", &request).await;
        assert_eq!(status, 201, "{expected}");
        let request = json!({"model": "m", "demonstration": own, "observe": observe(), "lookahead": lookahead, "collapse": {"x": 0.5}});
        let (status, policy) = service.post("/v1/policies", &request).await;
        assert_eq!(status, 201, "{policy}");
        assert_eq!(bare(policy.clone()), bare(expected));
        if !lookahead.is_null() {
            // In the background, too.
            let refined = service.refined(policy["id"].as_str().unwrap()).await;
            assert_eq!(refined["status"], "optimal", "{refined}");
        }
    }
}

#[tokio::test]
async fn trials_and_items_of_batches_observe_each_in_its_own_way() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &corridor()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x", "door"], "sd": 0})).await;
    let (own, imitators) = seen();
    let (_, expected) = service.post("/v1/policies", &json!({"model": "m", "demonstration": imitators})).await;
    let trial = json!({"model": "m", "demonstration": own, "observe": observe()});
    let (status, trial) = service.post("/v1/learners/l/trials", &trial).await;
    assert_eq!((status, &trial["policy"]["cost"]), (201, &expected["cost"]), "{trial}");

    let in_feet: Vec<Value> = own
        .as_array()
        .unwrap()
        .iter()
        .map(|row| json!({"feet": row["east_m"].as_f64().unwrap() / 0.3048, "opening": row["opening"]}))
        .collect();
    let of_feet = json!({"x": "math.round(feet * 0.3048 / 0.25)", "door": observe()["door"]});
    let batch = json!({"model": "m", "observe": observe(), "items": [
        {"demonstration": own}, {"demonstration": in_feet, "observe": of_feet}, {"demonstration": own, "lookahead": 2},
        {"demonstration": [{"east_m": 0, "opening": "ajar"}, {"east_m": 1}]}, {"demonstration": own, "observe": {"x": "east_m +"}},
        {"demonstration": in_feet}, {"demonstration": own, "observe": {"x": "opening", "speed": "1"}},
    ]});
    let (status, answer) = service.post("/v1/policies:batch", &batch).await;
    assert_eq!(status, 200, "{answer}");
    let items = answer["items"].as_array().unwrap();
    assert_eq!(bare(items[0].clone()), bare(expected.clone()));
    assert_eq!(items[1]["cost"], expected["cost"], "{}", items[1]);
    assert_eq!(service.refined(items[2]["id"].as_str().unwrap()).await["cost"], expected["cost"]);
    let faults = |n: usize| -> Vec<(String, String)> {
        let errors = items[n]["problem"]["errors"].as_array().unwrap_or_else(|| panic!("{}", items[n]));
        let text = |error: &Value, name: &str| error[name].as_str().unwrap().to_owned();
        errors.iter().map(|error| (text(error, "pointer"), text(error, "detail"))).collect()
    };
    let (pointer, detail) = &faults(3)[0];
    assert_eq!(pointer, "/items/3/demonstration/0");
    assert!(detail.starts_with("what is observed as \"door\", column 9: "), "{detail}");
    assert_eq!(faults(4)[0].0, "/items/4/observe/x");
    assert_eq!(faults(5)[0], ("/observe/x".into(), "no state of the demonstration has \"east_m\"".into()));
    assert_eq!(faults(6)[0].0, "/items/6/demonstration/0/speed");
}

#[tokio::test]
async fn faults_of_what_is_observed_are_told_with_row_and_column() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &corridor()).await;
    let faults = async |observe: Value, demonstration: Value| -> Vec<(String, String)> {
        let request = json!({"model": "m", "observe": observe, "demonstration": demonstration});
        let (status, problem) = service.post("/v1/policies", &request).await;
        assert_eq!(status, 422, "{problem}");
        let text = |error: &Value, name: &str| error[name].as_str().unwrap().to_owned();
        let errors = problem["errors"].as_array().unwrap();
        errors.iter().map(|error| (text(error, "pointer"), text(error, "detail"))).collect()
    };
    let told = faults(json!({"x": "east_m * 'a'", "door": "jump(opening)"}), json!([{"east_m": 1}])).await;
    assert_eq!(told[0].0, "/observe/door");
    assert!(told[0].1.starts_with("column 1: unknown function jump()"), "{told:?}");
    assert!(
        told[1].0 == "/observe/x" && told[1].1.starts_with("column 8: * cannot be applied to any value and string"),
        "{told:?}"
    );
    let told = faults(json!({"x": "10.0 / east_m"}), json!([{"east_m": 1}, {"east_m": 0}, {"east_m": "far"}])).await;
    assert_eq!(
        told[0],
        ("/demonstration/1".into(), "what is observed as \"x\", column 1: inf is no value of an attribute".into())
    );
    assert!(
        told[1].0 == "/demonstration/2"
            && told[1].1.contains("\"x\", column 6: this cannot be done with double (10) and string"),
        "{told:?}"
    );
    let told = faults(json!({"x": "east", "speed": "east"}), json!([{"east": "near"}])).await;
    assert_eq!(
        told.iter().map(|(pointer, _)| pointer.as_str()).collect::<Vec<_>>(),
        ["/demonstration/0/speed", "/demonstration/0/x"]
    );
    let told = faults(json!("x"), json!([{"east": 1}])).await;
    assert_eq!(told[0].0, "/observe");
}

#[tokio::test]
async fn a_stream_observes_in_its_own_way_also_after_a_restart() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &corridor()).await;
    let (own, imitators) = seen();
    let own = own.as_array().unwrap();
    let (_, expected) = service.post("/v1/policies", &json!({"model": "m", "demonstration": imitators})).await;

    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "m", "lookahead": null, "observe": {"x": "east_m *"}})).await;
    let problem = client.receive_until_error().await;
    assert_eq!(problem["problem"]["errors"][0]["pointer"], "/observe/x", "{problem}");

    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "m", "lookahead": null, "observe": observe()})).await;
    let opened = last(&mut client, "opened").await;
    client.send(json!({"type": "observe", "seq": 0, "states": own[..2]})).await;
    last(&mut client, "received").await;
    let service = Service::start_in(service.stop().await, &[]).await;
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": opened["session"], "step": 0})).await;
    assert_eq!(last(&mut client, "opened").await["received"], 2);
    client.send(json!({"type": "observe", "seq": 2, "states": own[2..]})).await;
    client.send(json!({"type": "end", "seq": own.len()})).await;
    let done = last(&mut client, "done").await;
    assert_eq!((&done["cost"], &done["status"]), (&expected["cost"], &json!("optimal")), "{done}");
}
