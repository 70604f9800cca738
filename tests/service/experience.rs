//! Models that are told what was experienced, from outside.

mod lines;

use etude::service::hash_of;
use reqwest::Method;
use reqwest::header::{ETAG, IF_MATCH};
use serde_json::{Value, json};

use crate::harness::service::{Service, answer};
use crate::stream::client::Client;

const EXPERIENCE: &str = "/v1/models/m/experience";

/// A corridor that is explored: walking costs 1 unless it was told what it did, which rounds to halves of a metre.
fn explored(min_count: u64) -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
        "actions": [{"name": "forward"}, {"name": "push", "cost": 0.5}],
        "dynamics": {"kind": "experience", "min_count": min_count, "bin": {"x": 0.5}},
    })
}

fn seen(from: (f64, &str), action: &str, to: (f64, &str), cost: impl Into<Option<f64>>) -> Value {
    let state = |(x, door): (f64, &str)| json!({"x": x, "door": door});
    let mut seen = json!({"state": state(from), "action": action, "next": state(to)});
    if let Some(cost) = cost.into() {
        seen["cost"] = cost.into();
    }
    seen
}

fn batch(id: &str, transitions: &[Value]) -> Value {
    json!({"batch": id, "transitions": transitions})
}

/// The way through the corridor, as a log of floats has it.
fn walk() -> Vec<Value> {
    vec![
        seen((0.02, "shut"), "forward", (0.49, "shut"), 1.0),
        seen((0.51, "shut"), "push", (0.5, "open"), None),
        seen((0.5, "open"), "forward", (1.1, "open"), 3.0),
    ]
}

/// Follows a demonstration through the corridor.
async fn follow(service: &Service) -> (u16, Value) {
    let request = json!({
        "model": "m", "demonstration": [{"x": 0, "door": "shut"}, {"x": 1, "door": "open"}], "weights": {"x": 50, "door": 50},
        "extra_weight": 0, "store": false,
    });
    service.post("/v1/policies", &request).await
}

async fn model(service: &Service) -> Value {
    let (status, model) = service.get("/v1/models/m").await;
    assert_eq!(status, 200, "{model}");
    model
}

fn kind(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["type"].as_str().unwrap_or_default())
}

#[tokio::test]
async fn a_log_of_transitions_becomes_a_model_that_is_followed() {
    let service = Service::start(&[]).await;
    let (status, registered) = service.put("/v1/models/m", &explored(1)).await;
    assert_eq!(status, 201, "{registered}");
    let counts = json!({"attributes": 2, "actions": 2, "states": 0, "transitions": 0, "stochastic": 0, "unsafe": 0});
    assert_eq!(registered["counts"], counts);
    // Nothing was experienced yet.
    let (status, problem) = follow(&service).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/model")), "{problem}");
    assert!(problem.to_string().contains("nothing was experienced yet"), "{problem}");
    assert_eq!(kind(&service.get("/v1/models/m/report").await), (422, "/problems/invalid"));

    let (status, told) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    assert_eq!(status, 200, "{told}");
    let counts = json!({"attributes": 2, "actions": 2, "states": 4, "transitions": 3, "stochastic": 0, "unsafe": 0});
    let canonical = r#"{"batch":"a","transitions":[{"state":[0.02,"shut"],"action":"forward","next":[0.49,"shut"],"cost":1.0},{"state":[0.51,"shut"],"action":"push","next":[0.5,"open"]},{"state":[0.5,"open"],"action":"forward","next":[1.1,"open"],"cost":3.0}]}"#;
    let hash = hash_of(format!("{}{canonical}", registered["hash"].as_str().unwrap()));
    assert_eq!(told, json!({"model": "m", "batch": "a", "hash": hash, "counts": counts}));

    let (status, first) = follow(&service).await;
    assert_eq!((status, &first["model_hash"]), (200, &told["hash"]), "{first}");
    assert_eq!((&first["cost"]["total"], &first["actions"]), (&json!(4.5), &json!(["forward", "push", "forward"])));
    let states: Vec<&Value> = first["steps"].as_array().unwrap().iter().map(|step| &step["state_index"]).collect();
    assert_eq!(states, [0, 1, 2, 3]);

    // The cheaper way is a new revision, and what it costs is a mean.
    let cheaper =
        [seen((0.5, "open"), "forward", (1.0, "open"), 1.0), seen((0.5, "open"), "forward", (1.0, "open"), None)];
    let (_, again) = service.post(EXPERIENCE, &batch("b", &cheaper)).await;
    let (_, second) = follow(&service).await;
    assert_eq!((&second["model_hash"], &again["counts"]), (&again["hash"], &told["counts"]));
    let total = second["cost"]["total"].as_f64().unwrap();
    assert!((total - (1.0 + 0.5 + 5.0 / 3.0)).abs() < 1e-12, "{total}");

    let whole = model(&service).await;
    assert_eq!((&whole["hash"], &whole["counts"]), (&again["hash"], &again["counts"]));
    assert_eq!(whole["definition"]["dynamics"], explored(1)["dynamics"]);
    let list = service.get("/v1/models").await.1;
    assert_eq!((&list["items"][0]["hash"], &list["items"][0]["counts"]), (&again["hash"], &again["counts"]));
    let (status, report) = service.get("/v1/models/m/report").await;
    assert_eq!(
        (status, &report["model_hash"], &report["counts"]["states"]),
        (200, &again["hash"], &json!(4)),
        "{report}"
    );
}

#[tokio::test]
async fn a_batch_counts_once_and_is_answered_alike_however_often_it_is_sent() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(2)).await;
    let first = service.post(EXPERIENCE, &batch("a", &walk())).await;
    assert_eq!((first.0, &first.1["counts"]["transitions"]), (200, &json!(0)), "seen once");
    assert_eq!(service.post(EXPERIENCE, &batch("a", &walk())).await, first);
    let second = service.post(EXPERIENCE, &batch("b", &walk())).await;
    assert_eq!(second.1["counts"]["transitions"], 3);
    // Written in another way, it is the same.
    let mut written = batch("a", &walk());
    written["transitions"][0]["state"] = json!([0.02, "shut"]);
    written["transitions"][1]["count"] = 1.into();
    assert_eq!(service.post(EXPERIENCE, &written).await, first);
    written["transitions"][1]["count"] = 2.into();
    let conflict = service.post(EXPERIENCE, &written).await;
    assert_eq!(kind(&conflict), (409, "/problems/conflict"));
    assert_eq!(model(&service).await["hash"], second.1["hash"]);
    // Another service counts what was stored.
    let service = Service::start_in(service.stop().await, &[]).await;
    assert_eq!(service.post(EXPERIENCE, &batch("a", &walk())).await, first);
    assert_eq!(kind(&service.post(EXPERIENCE, &written).await), (409, "/problems/conflict"));
    assert_eq!(follow(&service).await.1["model_hash"], second.1["hash"]);
    let third = service.post(EXPERIENCE, &batch("c", &walk())).await;
    assert_eq!((third.0, &third.1["counts"]), (200, &second.1["counts"]));
}

#[tokio::test]
async fn batches_that_come_at_once_count_once_each_in_some_order() {
    const N_BATCHES: u32 = 60;
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(N_BATCHES.into())).await;
    // Costs are powers of two, so that their sum tells which of them were counted, and how often.
    let cost = |n: u32| f64::from(1u32 << (n % 24));
    let told = |n: u32| batch(&format!("b{n}"), &[seen((0.0, "shut"), "forward", (1.0, "open"), cost(n))]);
    let batches: Vec<Value> = (0..N_BATCHES).map(told).collect();
    let requests = batches.iter().chain(&batches).map(|batch| service.post(EXPERIENCE, batch));
    let answers = futures_util::future::join_all(requests).await;
    assert!(answers.iter().all(|(status, _)| *status == 200), "{answers:?}");
    let (first, again) = answers.split_at(batches.len());
    assert_eq!(first, again);
    let mut hashes: Vec<&str> = first.iter().map(|(_, told)| told["hash"].as_str().unwrap()).collect();
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), batches.len());
    let counted: Vec<&(u16, Value)> = first.iter().filter(|(_, told)| told["counts"]["transitions"] == 1).collect();
    assert_eq!(counted.len(), 1, "only the last one brings the pair to its least count");
    assert_eq!(model(&service).await["hash"], counted[0].1["hash"]);
    // What the only way costs is the mean of what was told.
    let mean = (0..N_BATCHES).map(cost).sum::<f64>() / f64::from(N_BATCHES);
    let request = json!({"model": "m", "demonstration": [{"x": 0}, {"x": 1}], "weights": {"x": 1e140}, "store": false});
    let paid = async |service: &Service| {
        let policy = service.post("/v1/policies", &request).await.1;
        assert_eq!(policy["model_hash"], counted[0].1["hash"]);
        policy["cost"]["total"].as_f64().unwrap()
    };
    let total = paid(&service).await;
    assert!((total - mean).abs() < 1e-9 * mean, "{total} {mean}");
    let service = Service::start_in(service.stop().await, &[]).await;
    assert_eq!(paid(&service).await.to_bits(), total.to_bits());
}

#[tokio::test]
async fn a_definition_is_the_same_whatever_it_was_told_and_another_begins_with_nothing() {
    let service = Service::start(&[]).await;
    let (_, registered) = service.put("/v1/models/m", &explored(1)).await;
    let (_, told) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    let (status, again) = service.put("/v1/models/m", &explored(1)).await;
    assert_eq!((status, &again["hash"], &again["counts"]), (200, &told["hash"], &told["counts"]));
    assert_eq!(kind(&service.put("/v1/models/m", &explored(2)).await), (409, "/problems/conflict"));
    let put = async |tag: &Value, model: &Value| {
        let tag = format!("\"{}\"", tag.as_str().unwrap());
        let request = service.client.put(service.url("/v1/models/m")).header(IF_MATCH, tag).json(model);
        answer(request.send().await.unwrap()).await
    };
    // What it was told came in between.
    assert_eq!(kind(&put(&registered["hash"], &explored(2)).await), (412, "/problems/precondition-failed"));
    assert_eq!(put(&told["hash"], &explored(1)).await, (200, again.clone()));
    let tag = service.send(Method::GET, "/v1/models/m", &Value::Null).await.headers()[ETAG].clone();
    assert_eq!(tag, format!("\"{}\"", told["hash"].as_str().unwrap()));

    let (status, other) = put(&told["hash"], &explored(2)).await;
    assert_eq!((status, &other["counts"]["states"]), (200, &json!(0)));
    let fresh = service.post(EXPERIENCE, &batch("a", &walk())).await;
    assert_eq!((fresh.0, &fresh.1["counts"]["transitions"]), (200, &json!(0)), "seen once by this one");
    assert_eq!(service.delete("/v1/models/m").await.0, 204);
    assert_eq!(kind(&service.post(EXPERIENCE, &batch("a", &walk())).await), (404, "/problems/unknown-model"));
    let (status, anew) = service.put("/v1/models/m", &explored(1)).await;
    assert_eq!((status, &anew["hash"], &anew["counts"]["states"]), (201, &registered["hash"], &json!(0)));
    assert_eq!(service.post(EXPERIENCE, &batch("a", &walk())).await.1, told);
}

#[tokio::test]
async fn several_outcomes_are_counted_inspected_and_refused_by_what_cannot_search_them() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let slips = seen((0.0, "shut"), "forward", (0.0, "shut"), None);
    let (_, told) = service.post(EXPERIENCE, &batch("a", &[walk(), vec![slips]].concat())).await;
    assert_eq!((&told["counts"]["stochastic"], &told["counts"]["transitions"]), (&json!(1), &json!(4)));
    let (status, report) = service.get("/v1/models/m/report").await;
    assert_eq!((status, &report["counts"]["stochastic"]), (200, &json!(1)), "{report}");
    let (status, problem) = follow(&service).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/model")), "{problem}");
    assert!(problem.to_string().contains("this model is stochastic"), "{problem}");
}

#[tokio::test]
async fn what_is_wrong_with_a_batch_is_told_all_at_once_and_nothing_of_it_counts() {
    let service = Service::start(&["--max-states", "5"]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let (_, told) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    let mut faulty = batch("b", &[walk(), walk()].concat());
    faulty["transitions"][1]["action"] = "jump".into();
    faulty["transitions"][2]["state"] = json!({"x": "far"});
    faulty["transitions"][3]["count"] = 0.into();
    faulty["transitions"][4]["cost"] = json!(-1);
    faulty["transitions"][5]["speed"] = json!(1);
    let (status, problem) = service.post(EXPERIENCE, &faulty).await;
    let mut pointers: Vec<&str> =
        problem["errors"].as_array().unwrap().iter().map(|error| error["pointer"].as_str().unwrap()).collect();
    pointers.sort_unstable();
    let expected = [
        "/transitions/1/action",
        "/transitions/2/state/door",
        "/transitions/2/state/x",
        "/transitions/3/count",
        "/transitions/4/cost",
        "/transitions/5/speed",
    ];
    assert_eq!((status, pointers), (422, expected.to_vec()), "{problem}");
    let far: Vec<Value> =
        (5..9).map(|x| seen((f64::from(x), "open"), "forward", (f64::from(x) + 1.0, "open"), None)).collect();
    let (status, problem) = service.post(EXPERIENCE, &batch("b", &far)).await;
    assert_eq!((status, &problem["errors"][0]["pointer"]), (422, &json!("/transitions")), "{problem}");
    assert_eq!(model(&service).await["hash"], told["hash"]);

    let table = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [],
        "dynamics": {"kind": "table", "states": [[0]], "transitions": []},
    });
    service.put("/v1/models/table", &table).await;
    let (status, problem) = service.post("/v1/models/table/experience", &batch("a", &[])).await;
    assert_eq!((status, kind(&(status, problem.clone())).1), (422, "/problems/invalid"), "{problem}");
    assert_eq!(service.post("/v1/models/other/experience", &batch("a", &[])).await.0, 404);
    let cut =
        service.client.post(service.url(EXPERIENCE)).header("content-type", "application/json").body("{\"batch\":");
    assert_eq!(kind(&answer(cut.send().await.unwrap()).await), (400, "/problems/malformed-json"));
}

#[tokio::test]
async fn a_session_goes_on_with_the_revision_that_it_was_opened_with_also_once_it_is_resumed() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let (_, told) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    let mut clients = [Client::connect(&service).await, Client::connect(&service).await];
    let mut sessions = Vec::new();
    for client in &mut clients {
        let open = json!({"type": "open", "model": "m", "weights": {"x": 50, "door": 50}, "extra_weight": 0});
        sessions.push(client.open(open).await);
        client.send(json!({"type": "observe", "seq": 0, "states": [{"x": 0, "door": "shut"}]})).await;
        client.receive_until("received").await;
    }
    let [mut stays, leaves] = clients;
    drop(leaves);
    // A way around the door, and what makes the whole stochastic.
    let around = [
        seen((0.0, "shut"), "push", (1.0, "open"), 0.1),
        seen((0.5, "shut"), "forward", (0.0, "shut"), None),
        seen((0.5, "shut"), "forward", (9.0, "shut"), None),
    ];
    assert_eq!(service.post(EXPERIENCE, &batch("b", &around)).await.0, 200);
    let finish = async |client: &mut Client| {
        client.send(json!({"type": "observe", "seq": 1, "states": [{"x": 1, "door": "open"}]})).await;
        client.send(json!({"type": "end", "seq": 2})).await;
        client.receive_until("done").await.pop().unwrap()
    };
    let done = finish(&mut stays).await;
    assert_eq!(done["cost"]["total"], 4.5, "{done}");
    let policy = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await.1;
    assert_eq!(policy["model_hash"], told["hash"]);

    let service = Service::start_in(service.stop().await, &[]).await;
    let mut back = Client::connect(&service).await;
    back.send(json!({"type": "resume", "session": sessions[1]})).await;
    back.receive_until("opened").await;
    let done = finish(&mut back).await;
    assert_eq!(done["cost"]["total"], 4.5, "{done}");
    let policy = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await.1;
    assert_eq!(policy["model_hash"], told["hash"]);
}

#[tokio::test]
async fn whoever_follows_while_batches_come_gets_one_of_the_revisions() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let (_, first) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    let mut hashes = vec![first["hash"].clone()];
    let telling = async {
        for n in 0..40 {
            let far = seen((f64::from(n), "far"), "push", (f64::from(n + 1), "far"), None);
            let (status, told) = service.post(EXPERIENCE, &batch(&n.to_string(), &[far])).await;
            assert_eq!(status, 200, "{told}");
            hashes.push(told["hash"].clone());
        }
    };
    let following = async {
        let mut policies = Vec::new();
        for _ in 0..40 {
            policies.push(follow(&service).await);
        }
        policies
    };
    let ((), policies) = tokio::join!(telling, following);
    for (status, policy) in policies {
        assert_eq!(status, 200, "{policy}");
        assert!(hashes.contains(&policy["model_hash"]), "{policy}");
        assert_eq!(policy["cost"]["total"], 4.5);
    }
    assert_eq!(follow(&service).await.1["model_hash"], *hashes.last().unwrap());
}

#[tokio::test]
async fn a_local_policy_is_refined_with_the_revision_that_it_was_made_with() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let (_, told) = service.post(EXPERIENCE, &batch("a", &walk())).await;
    let long = json!({"model": "m", "demonstration": vec![json!({"x": 0}); 20_000], "lookahead": 3});
    let (_, policy) = service.post("/v1/policies", &long).await;
    assert_eq!((&policy["status"], &policy["model_hash"]), (&json!("local"), &told["hash"]), "{}", policy["detail"]);
    let cheap = seen((0.0, "shut"), "push", (0.0, "open"), 0.0);
    assert_eq!(service.post(EXPERIENCE, &batch("b", &[cheap])).await.0, 200);
    let refined = service.refined(policy["id"].as_str().unwrap()).await;
    assert_eq!(refined["model_hash"], told["hash"]);
}

#[tokio::test]
async fn a_large_batch_is_read_off_the_way_of_others_and_bounded_by_the_limit_of_bodies() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/m", &explored(1)).await;
    let x = |n: u32| f64::from(n) / 2.0;
    let many: Vec<Value> = (0..2000).map(|n| seen((x(n), "open"), "forward", (x(n + 1), "open"), None)).collect();
    let (status, told) = service.post(EXPERIENCE, &batch("a", &many)).await;
    assert_eq!((status, &told["counts"]["states"]), (200, &json!(2001)), "{told}");
    assert_eq!(service.post(EXPERIENCE, &batch("a", &many)).await.1, told);
    let service = Service::start_in(service.stop().await, &["--max-body-bytes", "65536"]).await;
    let request = json!({"model": "m", "demonstration": [{"x": 0}, {"x": 3}], "store": false});
    assert_eq!(service.post("/v1/policies", &request).await.1["model_hash"], told["hash"]);
    assert_eq!(service.post(EXPERIENCE, &batch("b", &many)).await.0, 413);
}
