//! The stream protocol, from outside, over both transports.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself; what has helpers of its own is
//! in files of its own.

mod application;
pub(crate) mod client;
mod long_messages;
mod slow_readers;

use self::client::Client;
use crate::harness::service::{Service, answer, example};
use crate::harness::waiting::within;
use futures_util::{SinkExt, StreamExt};
use reqwest::{Body, Method};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};

const NDJSON: &str = "application/x-ndjson";

async fn figure_4() -> (Service, Vec<Value>) {
    let service = Service::start(&[]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    (service, example("figure-4/demonstration.json").as_array().unwrap().clone())
}

fn steps(frames: &[Value]) -> Vec<Value> {
    frames.iter().filter(|frame| frame["type"] == "step").cloned().collect()
}

#[tokio::test]
async fn a_demonstration_is_followed_while_it_runs() {
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    let session = client.open(json!({"type": "open", "model": "figure-4"})).await;
    let mut committed = Vec::new();
    for (seq, state) in demonstration.iter().enumerate() {
        client.send(json!({"type": "observe", "seq": seq, "states": [state]})).await;
        committed.extend(steps(&client.receive_until("received").await));
    }
    let before_the_end = committed.len();
    client.send(json!({"type": "end", "seq": 16})).await;
    let frames = client.receive_until("done").await;
    committed.extend(steps(&frames));
    let done = frames.last().unwrap();
    assert_eq!(client.closed().await, 1000);

    assert!(before_the_end > 5, "{before_the_end} steps came before the end");
    assert!(committed.iter().enumerate().all(|(n, step)| step["step"] == n), "in order, none doubled");
    for step in &committed {
        let (observation, after) = (step["observation"].as_u64().unwrap(), step["after"].as_u64().unwrap());
        assert!(after <= (observation + 8 + 1).min(16), "{step}");
    }
    let policy = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await.1;
    assert_eq!((&policy["actions"], &policy["cost"]), (&done["actions"], &done["cost"]));
    for (step, stored) in committed.iter().zip(policy["steps"].as_array().unwrap()) {
        for field in ["step", "observation", "move", "action", "state", "action_cost", "distance", "cost"] {
            assert_eq!(step[field], stored[field], "{field} of {step}");
        }
    }
    assert_eq!(committed.len(), policy["steps"].as_array().unwrap().len());

    let (_, stored) = service.get(&format!("/v1/sessions/{session}")).await;
    assert_eq!((&stored["status"], &stored["observations"]), (&json!("done"), &json!(16)));
    assert_eq!(stored["policy_id"], done["policy_id"]);
    assert_eq!((&stored["weights"], &stored["weights"]["outside"]), (&policy["weights"], &json!(5.0)));
    assert_eq!(service.get("/v1/sessions").await.1["items"], json!([stored]));
    assert_eq!(service.get("/v1/sessions/nothing").await.1["type"], "/problems/unknown-session");

    // What the same lookahead gives in one request.
    let mut request = example("figure-4/request.json");
    request["lookahead"] = json!(8);
    let (_, at_once) = service.post("/v1/policies", &request).await;
    assert_eq!((&at_once["actions"], &at_once["status"]), (&policy["actions"], &policy["status"]));
}

#[tokio::test]
async fn a_step_may_wait_for_some_time_only() {
    let (service, demonstration) = figure_4().await;
    for wrong in [json!(0), json!(-1), json!(1.5), json!("100"), json!(true)] {
        let mut client = Client::connect(&service).await;
        client.send(json!({"type": "open", "model": "figure-4", "lookahead_ms": wrong})).await;
        let problem = client.receive_until_error().await["problem"].take();
        assert_eq!(
            (&problem["type"], &problem["errors"][0]["pointer"]),
            (&json!("/problems/invalid"), &json!("/lookahead_ms"))
        );
    }
    let mut client = Client::connect(&service).await;
    let open = json!({"type": "open", "model": "figure-4", "lookahead": null, "lookahead_ms": 1});
    let session = client.open(open).await;
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration[..4]})).await;
    // Nothing is sent meanwhile.
    while client.receive_until("step").await.last().unwrap()["observation"] != 3 {}
    client.send(json!({"type": "end", "seq": 4})).await;
    let done = client.receive_until("done").await.pop().unwrap();
    assert_eq!(done["status"], "local", "time has decided");
    let (_, session) = service.get(&format!("/v1/sessions/{session}")).await;
    assert_eq!((&session["lookahead"], &session["lookahead_ms"]), (&json!(null), &json!(1)));
    let mut plain = Client::connect(&service).await;
    let session = plain.open(json!({"type": "open", "model": "figure-4", "lookahead_ms": null})).await;
    let (_, session) = service.get(&format!("/v1/sessions/{session}")).await;
    assert_eq!((&session["lookahead"], &session["lookahead_ms"]), (&json!(8), &json!(null)));
}

#[tokio::test]
async fn a_local_policy_is_refined_after_the_stream() {
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "figure-4", "lookahead": 1, "weights": {"gold": 1.5}})).await;
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    let done = client.receive_until("done").await.pop().unwrap();
    assert_eq!(done["status"], "local");
    let refined = service.refined(done["policy_id"].as_str().unwrap()).await;
    assert_eq!((&refined["refines"], &refined["status"]), (&done["policy_id"], &json!("optimal")));
    assert_eq!(refined["weights"]["gold"], 1.5);
    assert!(refined["cost"]["total"].as_f64() < done["cost"]["total"].as_f64());
}

#[tokio::test]
async fn lines_go_both_ways_at_the_same_time() {
    let (service, demonstration) = figure_4().await;
    let (lines, body) = mpsc::channel::<Result<String, std::io::Error>>(1);
    let body = Body::wrap_stream(tokio_stream::wrappers::ReceiverStream::new(body));
    let request = service.client.post(service.url("/v1/stream")).header("content-type", NDJSON).body(body);
    let response = within("an answer", request.send()).await.unwrap();
    assert_eq!(response.headers()["content-type"], "application/x-ndjson");
    let mut answer = response.bytes_stream();
    let mut buffer = String::new();
    let mut receive = async || {
        loop {
            if let Some((line, rest)) = buffer.split_once('\n') {
                let frame: Value = serde_json::from_str(line).unwrap();
                buffer = rest.to_owned();
                return Some(frame);
            }
            let chunk = within("more of the answer", answer.next()).await?;
            buffer.push_str(std::str::from_utf8(&chunk.unwrap()).unwrap());
        }
    };
    let send = async |frame: Value| lines.send(Ok(format!("{frame}\r\n\n"))).await.unwrap();
    assert_eq!(receive().await.unwrap()["type"], "hello");
    send(json!({"type": "open", "model": "figure-4", "lookahead": null})).await;
    assert_eq!(receive().await.unwrap()["type"], "opened");
    for (seq, state) in demonstration.iter().enumerate() {
        send(json!({"type": "observe", "seq": seq, "states": [state]})).await;
        // The answer comes while the request is still being sent.
        while receive().await.unwrap()["type"] != "received" {}
    }
    send(json!({"type": "end", "seq": 16})).await;
    let done = loop {
        let frame = receive().await.unwrap();
        if frame["type"] == "done" {
            break frame;
        }
        assert_eq!(frame["proven"], true, "{frame}");
    };
    assert_eq!((&done["status"], &done["cost"]["total"]), (&json!("optimal"), &json!(48.2)));
    assert_eq!(receive().await, None, "the answer ends by itself");
}

#[tokio::test]
async fn lines_are_not_compressed() {
    let service = Service::start(&[]).await;
    let request = service.client.post(service.url("/v1/stream")).header("content-encoding", "gzip").body("\u{1f}");
    let response = within("an answer", request.send()).await.unwrap();
    assert_eq!(
        (response.status().as_u16(), &response.headers()["accept-encoding"]),
        (415, &"identity".parse().unwrap())
    );
    let problem: Value = serde_json::from_str(&response.text().await.unwrap()).unwrap();
    assert_eq!(problem["type"], "/problems/unsupported-encoding");
    let identity = service.client.post(service.url("/v1/stream")).header("content-encoding", "identity");
    let answer = identity.header("content-type", NDJSON).body("{}\n").send().await.unwrap().text().await.unwrap();
    assert!(answer.contains("hello") && answer.contains("bad-frame"), "{answer}");
}

#[tokio::test]
async fn what_was_received_is_ignored_and_what_is_missing_is_asked_for() {
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "figure-4"})).await;
    let observe = |seq: usize, end: usize| json!({"type": "observe", "seq": seq, "states": demonstration[seq..end]});
    client.send(observe(1, 2)).await;
    let error = client.receive().await;
    assert_eq!(error["problem"], json!({"type": "/problems/gap", "detail": "expected seq 0"}));
    client.send(observe(0, 3)).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 3}));
    // Once more, and with something new.
    client.send(observe(0, 3)).await;
    client.send(observe(1, 5)).await;
    assert_eq!(client.receive_until("received").await.last().unwrap()["seq"], 3);
    assert_eq!(client.receive_until("received").await.last().unwrap()["seq"], 5);
    client.send(observe(6, 7)).await;
    loop {
        let frame = client.receive().await;
        if frame["type"] == "error" {
            assert_eq!(frame["problem"]["detail"], "expected seq 5");
            break;
        }
    }
    // A frame with a fault is refused whole.
    client.send(json!({"type": "observe", "seq": 5, "states": [demonstration[5], {"x": "far", "speed": 1}]})).await;
    let problem = client.receive().await["problem"].clone();
    assert_eq!(problem["type"], "/problems/invalid");
    let pointers: Vec<_> = problem["errors"].as_array().unwrap().iter().map(|error| &error["pointer"]).collect();
    assert_eq!(pointers, ["/states/1/speed", "/states/1/x"]);
    client.send(json!({"type": "end", "seq": 16})).await;
    assert_eq!(client.receive().await["problem"]["detail"], "expected seq 5");
    client.send(observe(5, 16)).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    // Frames after the end are not looked at.
    client.send(observe(16, 16)).await;
    client.send(json!({"type": "nonsense"})).await;
    assert_eq!(client.receive_until("done").await.last().unwrap()["type"], "done");
    assert_eq!(client.closed().await, 1000);
}

#[tokio::test]
async fn a_world_that_is_searched_lazily_is_streamed_with_a_lookahead_and_goes_on_after_restarts() {
    let mut service = Service::start(&["--max-states", "10"]).await;
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 9, "height": 9, "gold": [[3, 0]], "wumpi": [[2, 2]]}});
    assert_eq!(service.put("/v1/models/large", &cave).await.0, 201);
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "large", "lookahead": null})).await;
    let error = client.receive().await;
    assert_eq!(error["problem"]["type"], "/problems/invalid", "{error}");
    assert_eq!(error["problem"]["errors"][0]["pointer"], "/lookahead", "{error}");
    assert_eq!(client.closed().await, 4400);

    // Along the wall and back, again and again.
    let seen: Vec<Value> = (0..60_i64).map(|i| json!({"x": (i % 16 - 8).abs(), "y": 0})).collect();
    let open = json!({"type": "open", "model": "large", "lookahead": 4});
    let mut client = Client::connect(&service).await;
    client.open(open.clone()).await;
    client.send(json!({"type": "observe", "seq": 0, "states": seen})).await;
    client.send(json!({"type": "end", "seq": 60})).await;
    let unbroken = client.receive_until("done").await;
    let (wanted, done) = (steps(&unbroken), unbroken.last().unwrap());
    assert_eq!(done["status"], "local");
    let request = json!({"model": "large", "lookahead": 4, "demonstration": seen});
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &policy["cost"], &policy["actions"]), (201, &done["cost"], &done["actions"]));

    let mut client = Client::connect(&service).await;
    let session = client.open(open).await;
    let mut committed = Vec::new();
    for (n, states) in seen.chunks(12).enumerate() {
        client.send(json!({"type": "observe", "seq": 12 * n, "states": states})).await;
        client.receive_until("received").await;
        drop(client);
        let directory = service.stop().await;
        service = Service::start_in(directory, &["--max-states", "10"]).await;
        client = Client::connect(&service).await;
        client.send(json!({"type": "resume", "session": session, "step": committed.len()})).await;
        let opened = client.receive().await;
        assert_eq!(opened["received"], 12 * (n + 1));
        for _ in committed.len() as u64..opened["steps"].as_u64().unwrap() {
            committed.push(client.receive().await);
        }
    }
    client.send(json!({"type": "end", "seq": 60})).await;
    committed.extend(steps(&client.receive_until("done").await));
    assert_eq!(committed, wanted);
}

#[tokio::test]
async fn whatever_cannot_be_understood_has_its_answer() {
    let (service, _) = figure_4().await;
    let text = |frame: Value| Message::text(frame.to_string());
    let open = || text(json!({"type": "open", "model": "figure-4"}));
    let nested = "[".repeat(10_000);
    let cases = [
        (vec![Message::text("{")], "malformed-json", 1007),
        (vec![Message::text("{\"type\": NaN}")], "malformed-json", 1007),
        (vec![Message::text(nested.as_str())], "malformed-json", 1007),
        (vec![Message::text(" ".repeat(262_145))], "too-large", 1009),
        (vec![Message::text(" ".repeat(2_000_000))], "too-large", 1009),
        (vec![Message::binary(b"{}".to_vec())], "bad-frame", 4400),
        (vec![Message::text("[]")], "bad-frame", 4400),
        (vec![text(json!({"kind": "open"}))], "bad-frame", 4400),
        (vec![text(json!({"type": "close"}))], "bad-frame", 4400),
        (vec![open(), text(json!({"type": "observe", "seq": -1, "states": [], "hurry": 1}))], "bad-frame", 4400),
        (vec![open(), text(json!({"type": "observe", "seq": 0, "states": {}}))], "bad-frame", 4400),
        (vec![open(), text(json!({"type": "end"}))], "bad-frame", 4400),
        (vec![Message::text("{\"type\": \"reward\", \"reward\": 1e999}")], "bad-frame", 4400),
        (
            vec![text(json!({"type": "open", "model": "figure-4", "lookahead": 0, "weights": {"z": -1}}))],
            "invalid",
            4400,
        ),
        (vec![text(json!({"type": "open", "model": "figure-4", "start": 9999, "explore": 1}))], "invalid", 4400),
        (vec![text(json!({"type": "open", "model": "figure-4", "explore": true}))], "invalid", 4400),
        (vec![text(json!({"type": "open", "model": "nothing"}))], "unknown-model", 4404),
        (vec![text(json!({"type": "resume", "session": "nothing", "step": 0}))], "unknown-session", 4404),
        (vec![text(json!({"type": "observe", "seq": 0, "states": []}))], "not-allowed", 1008),
        (vec![text(json!({"type": "end", "seq": 0}))], "not-allowed", 1008),
        (vec![open(), open()], "not-allowed", 1008),
        (vec![open(), text(json!({"type": "reward", "reward": 1}))], "not-allowed", 1008),
    ];
    for (messages, slug, code) in cases {
        let mut client = Client::connect(&service).await;
        let shown = messages.last().map(|message| message.to_string().chars().take(80).collect::<String>());
        let n_before = messages.len() - 1;
        for message in messages {
            client.socket.send(message).await.unwrap();
        }
        for _ in 0..n_before {
            assert_eq!(client.receive().await["type"], "opened");
        }
        let error = client.receive().await;
        assert_eq!(error["problem"]["type"], format!("/problems/{slug}"), "{shown:?}: {error}");
        assert_eq!(client.closed().await, code, "{shown:?}: {error}");
    }
    // Of a request to open a session, everything that is wrong.
    let faulty = json!({
        "type": "open", "model": "figure-4", "learner": 7, "explore": 1, "lookahead": 0, "weights": {"z": -1}, "start": 9999,
        "hurry": true,
    });
    let everywhere = json!({"type": "open", "model": "nothing", "lookahead": 0, "hurry": true});
    let pointers = ["/hurry", "/learner", "/explore", "/lookahead", "/weights/z", "/weights/z", "/start"];
    for (open, expected) in [(faulty, &pointers[..]), (everywhere, &["/hurry", "/lookahead", "/model"])] {
        let mut client = Client::connect(&service).await;
        client.send(open).await;
        let problem = client.receive().await["problem"].take();
        let found: Vec<_> = problem["errors"].as_array().unwrap().iter().map(|error| &error["pointer"]).collect();
        assert_eq!(found, expected, "{problem}");
        assert_eq!((&problem["type"], client.closed().await), (&json!("/problems/invalid"), 4400));
    }
    // Text that is not UTF-8, byte by byte: a masked text frame of two bytes.
    let mut client = Client::connect(&service).await;
    {
        use tokio::io::AsyncWriteExt;
        let stream = client.socket.get_mut();
        stream.write_all(&[0x81, 0x82, 0, 0, 0, 0, 0xff, 0xfe]).await.unwrap();
        stream.flush().await.unwrap();
    }
    assert_eq!(client.receive().await["problem"]["detail"], "the frame is not UTF-8");
    assert_eq!(client.closed().await, 1007);
    // An end without a demonstration leaves the session open.
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "figure-4"})).await;
    client.send(json!({"type": "end", "seq": 0})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/empty");
    client.send(json!({"type": "observe", "seq": 0, "states": [{}]})).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 1}));
}

#[tokio::test]
async fn a_cut_connection_and_a_restarted_server_lose_and_double_nothing() {
    let (service, demonstration) = figure_4().await;
    let mut undisturbed = Client::connect(&service).await;
    undisturbed.open(json!({"type": "open", "model": "figure-4", "lookahead": 3})).await;
    undisturbed.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    undisturbed.send(json!({"type": "end", "seq": 16})).await;
    let expected = steps(&undisturbed.receive_until("done").await);

    let mut client = Client::connect(&service).await;
    let session = client.open(json!({"type": "open", "model": "figure-4", "lookahead": 3})).await;
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration[..7]})).await;
    client.receive_until("received").await;
    let mut seen = vec![client.receive().await, client.receive().await];
    // Cut, without a goodbye.
    drop(client);

    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session, "step": 2})).await;
    let opened = client.receive().await;
    assert_eq!((&opened["session"], &opened["received"]), (&json!(session), &json!(7)));
    let n_steps = opened["steps"].as_u64().unwrap();
    for _ in 2..n_steps {
        seen.push(client.receive().await);
    }
    client.send(json!({"type": "observe", "seq": 7, "states": demonstration[7..12]})).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 12}));
    drop(client);

    let directory = service.stop().await;
    let service = Service::start_in(directory, &[]).await;
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session, "step": n_steps})).await;
    assert_eq!(client.receive().await["received"], 12);
    client.send(json!({"type": "observe", "seq": 12, "states": demonstration[12..]})).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    let frames = client.receive_until("done").await;
    seen.extend(steps(&frames));
    assert_eq!(seen, expected);

    // A session that is done tells it again.
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session, "step": 0})).await;
    let again = client.receive_until("done").await;
    assert_eq!((steps(&again), again.last()), (expected, frames.last()));
    assert_eq!(client.closed().await, 1000);
}

#[tokio::test]
async fn a_session_that_is_resumed_elsewhere_is_taken_over() {
    let (service, demonstration) = figure_4().await;
    let mut first = Client::connect(&service).await;
    let session = first.open(json!({"type": "open", "model": "figure-4"})).await;
    let mut second = Client::connect(&service).await;
    second.send(json!({"type": "resume", "session": session})).await;
    assert_eq!(second.receive().await["type"], "opened");
    assert_eq!(first.receive().await["problem"]["type"], "/problems/taken-over");
    assert_eq!(first.closed().await, 1008);
    second.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    second.send(json!({"type": "end", "seq": 16})).await;
    assert_eq!(second.receive_until("done").await.last().unwrap()["type"], "done");
}

/// Those it is taken from are cut off wherever they are: in the middle of writing, mapping or sending.
#[tokio::test]
async fn a_session_that_goes_from_hand_to_hand_loses_and_doubles_nothing() {
    let (service, demonstration) = figure_4().await;
    let demonstration: Vec<&Value> = demonstration.iter().cycle().take(60).collect();
    let open = json!({"type": "open", "model": "figure-4", "lookahead": 3});
    let mut undisturbed = Client::connect(&service).await;
    undisturbed.open(open.clone()).await;
    undisturbed.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    undisturbed.send(json!({"type": "end", "seq": 60})).await;
    let expected = steps(&undisturbed.receive_until("done").await);

    let mut first = Client::connect(&service).await;
    let session = first.open(open).await;
    let (mut hands, mut n_durable) = (vec![first], 0);
    for n_awaited in (0..4).cycle() {
        let mut client = Client::connect(&service).await;
        client.send(json!({"type": "resume", "session": session})).await;
        let opened = client.receive().await;
        let received = opened["received"].as_u64().unwrap();
        assert!(received >= n_durable, "{opened}, and {n_durable} were durable");
        n_durable = received;
        for (seq, state) in demonstration.iter().enumerate().skip(usize::try_from(received).unwrap()) {
            client.send(json!({"type": "observe", "seq": seq, "states": [state]})).await;
        }
        if received == 60 {
            client.send(json!({"type": "end", "seq": 60})).await;
            let told = client.receive_until("done").await;
            assert_eq!(steps(&told), expected);
            break;
        }
        for _ in 0..n_awaited.min(60 - received) {
            n_durable = client.receive_until("received").await.last().unwrap()["seq"].as_u64().unwrap();
        }
        hands.push(client);
    }
    assert_eq!(undisturbed.closed().await, 1000);
}

#[tokio::test]
async fn pings_are_answered() {
    let (service, _) = figure_4().await;
    let mut client = Client::connect(&service).await;
    client.socket.send(Message::Ping(b"there?".as_slice().into())).await.unwrap();
    assert_eq!(client.next().await, Message::Pong(b"there?".as_slice().into()));
}

#[tokio::test]
async fn a_shutdown_ends_streams_so_that_they_can_be_resumed() {
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    let session = client.open(json!({"type": "open", "model": "figure-4"})).await;
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration[..5]})).await;
    client.receive_until("received").await;
    let stopping = tokio::spawn(service.stop());
    loop {
        let frame = client.receive().await;
        if frame["type"] == "error" {
            assert_eq!(frame["problem"]["type"], "/problems/stopping");
            break;
        }
    }
    assert_eq!(client.closed().await, 1001);
    drop(client);
    let service = Service::start_in(stopping.await.unwrap(), &[]).await;
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session})).await;
    assert_eq!(client.receive().await["received"], 5);
}

#[tokio::test]
async fn idle_sessions_expire() {
    // Opened while there is time enough, and expired by a service that has less.
    let (service, _) = figure_4().await;
    let session = Client::connect(&service).await.open(json!({"type": "open", "model": "figure-4"})).await;
    let service = Service::start_in(service.stop().await, &["--session-idle-timeout", "100ms"]).await;
    service.until_status(&format!("/v1/sessions/{session}"), "expired").await;
    let mut client = Client::connect(&service).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/idle");
    assert_eq!(client.closed().await, 1008);
    let service = Service::start_in(service.stop().await, &[]).await;
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "resume", "session": session})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/expired");
    assert_eq!(client.closed().await, 4404);
}

#[tokio::test]
async fn the_limits_in_hello_are_those_that_are_kept() {
    let flags = ["--max-streams", "2", "--session-idle-timeout", "20s", "--slow-reader-timeout", "1500ms"];
    let service = Service::start(&flags).await;
    let stream = TcpStream::connect(service.address).await.unwrap();
    let (socket, _) =
        tokio_tungstenite::client_async(format!("ws://{}/v1/stream", service.address), stream).await.unwrap();
    let mut client = Client { socket, unanswered: Vec::new() };
    let limits = client.receive().await["limits"].take();
    let expected = json!({
        "frame_bytes": 262_144, "message_bytes": 262_144, "observations": 100_000,
        "streams": 2, "idle_timeout_ms": 20_000, "slow_reader_timeout_ms": 1500, "ping_interval_ms": 30_000,
    });
    assert_eq!(limits, expected);

    // Fragments count as the message that they are parts of, up to the last byte.
    let end = json!({"type": "end", "seq": 0}).to_string();
    for (n_bytes, problem) in [(262_144, "not-allowed"), (262_145, "too-large")] {
        let mut client = Client::connect(&service).await;
        let padding = " ".repeat(n_bytes - end.len());
        let (first, second) = padding.split_at(padding.len() / 2);
        for (fragment, opcode, is_final) in
            [(end.as_str(), Data::Text, false), (first, Data::Continue, false), (second, Data::Continue, true)]
        {
            let frame = Frame::message(fragment.as_bytes().to_vec(), OpCode::Data(opcode), is_final);
            client.socket.send(Message::Frame(frame)).await.unwrap();
        }
        assert_eq!(client.receive().await["problem"]["type"], format!("/problems/{problem}"), "{n_bytes} bytes");
    }
}

#[tokio::test]
async fn no_more_streams_run_than_may() {
    let service = Service::start(&["--max-streams", "1"]).await;
    let first = Client::connect(&service).await;
    let second = tokio_tungstenite::connect_async(format!("ws://{}/v1/stream", service.address)).await;
    let error = second.unwrap_err().to_string();
    assert!(error.contains("503"), "{error}");
    drop(first);
}

#[tokio::test]
async fn a_lookahead_that_reaches_too_far_for_its_model_opens_no_session() {
    let service = Service::start(&[]).await;
    let world = json!({"dynamics": {"kind": "wumpus", "width": 40, "height": 40, "gold": [[1, 1], [2, 2]]}});
    assert_eq!(service.put("/v1/models/world", &world).await.0, 201);
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "world", "lookahead": 100_000})).await;
    let problem = client.receive().await["problem"].clone();
    assert_eq!(problem["errors"][0]["pointer"], "/lookahead", "{problem}");
    assert_eq!(client.closed().await, 4400);
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "world", "lookahead": 1000})).await;
}

#[tokio::test]
async fn a_client_that_waits_to_be_told_to_send_its_frames_is_told() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let service = Service::start(&[]).await;
    let mut client = TcpStream::connect(service.address).await.unwrap();
    let head = "POST /v1/stream HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/x-ndjson\r\ntransfer-encoding: chunked\r\n\
                expect: 100-continue\r\n\r\n";
    client.write_all(head.as_bytes()).await.unwrap();
    let mut answer = [0; 12];
    client.read_exact(&mut answer).await.unwrap();
    assert_eq!(str::from_utf8(&answer).unwrap(), "HTTP/1.1 100");
}

#[tokio::test]
async fn who_asks_for_a_stream_without_a_websocket_is_told_to_upgrade() {
    let service = Service::start(&[]).await;
    let response = service.send(Method::GET, "/v1/stream", &Value::Null).await;
    assert_eq!(response.headers()["upgrade"], "websocket");
    let (status, problem) = answer(response).await;
    assert_eq!((status, &problem["type"]), (426, &json!("/problems/upgrade-required")), "{problem}");
}

#[tokio::test]
async fn streams_are_opened_and_go_on_while_a_search_takes_long() {
    let flags = ["--search-threads", "1", "--search-queue", "0", "--default-deadline", "10m"];
    let service = Service::start(&flags).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let demonstration = example("figure-4/demonstration.json").as_array().unwrap().clone();
    let open = json!({"type": "open", "model": "figure-4"});
    let mut before = Client::connect(&service).await;
    before.open(open.clone()).await;

    // A request that takes minutes: the paper's heuristic looks at every observation ahead, for every node.
    let long: Vec<&Value> = demonstration.iter().cycle().take(20_000).collect();
    let request = json!({"model": "figure-4", "demonstration": long, "heuristic": "paper"});
    let request = service.client.post(service.url("/v1/policies")).json(&request);
    let searching = tokio::spawn(request.send());
    service.until_searching().await;
    Client::connect(&service).await.open(open).await;
    before.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    assert_eq!(before.receive().await, json!({"type": "received", "seq": 16}));
    before.send(json!({"type": "end", "seq": 16})).await;

    before.receive_until("done").await;
    assert!(!searching.is_finished());
    searching.abort();
    service.until_idle().await;
}

#[tokio::test]
async fn a_database_that_another_process_holds_is_no_internal_error() {
    use sqlx::{ConnectOptions, Connection};
    let (service, demonstration) = figure_4().await;
    let mut client = Client::connect(&service).await;
    let session = client.open(json!({"type": "open", "model": "figure-4"})).await;
    let path = service.directory.path().join("etude.db");
    let mut other = sqlx::sqlite::SqliteConnectOptions::new().filename(path).connect().await.unwrap();
    let held = other.begin_with("BEGIN IMMEDIATE").await.unwrap();
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/overloaded");
    assert_eq!(client.closed().await, 1013);
    held.rollback().await.unwrap();
    let mut again = Client::connect(&service).await;
    again.send(json!({"type": "resume", "session": session})).await;
    assert_eq!(again.receive().await["received"], 0);
}

#[tokio::test]
async fn a_stream_follows_a_learners_weights_or_explores_and_is_rewarded() {
    let (service, demonstration) = figure_4().await;
    let learner = json!({"attributes": ["x", "gold"], "mean": {"x": 2, "gold": 3}, "sd": 0.5, "seed": 7});
    assert_eq!(service.put("/v1/learners/gold", &learner).await.0, 201);

    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "figure-4", "learner": "gold", "weights": {"y": 4}})).await;
    let opened = client.receive().await;
    let weights = &opened["weights"];
    assert_eq!((&weights["x"], &weights["y"], &weights["gold"]), (&json!(2.0), &json!(4.0), &json!(3.0)));
    assert_eq!(opened["trial"], Value::Null);

    let mut client = Client::connect(&service).await;
    let explore = json!({"type": "open", "model": "figure-4", "learner": "gold", "explore": true});
    client.send(explore).await;
    let opened = client.receive().await;
    let trial = format!("/v1/trials/{}", opened["trial"].as_str().unwrap());
    let (_, active) = service.get(&trial).await;
    assert_eq!((&active["number"], &active["status"], &active["policy"]), (&json!(1), &json!("active"), &Value::Null));
    assert_eq!(active["weights"]["gold"], opened["weights"]["gold"]);
    assert_ne!(opened["weights"]["gold"], json!(3.0), "drawn, not the mean");
    client.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    let done = client.receive_until("done").await.pop().unwrap();
    client.send(json!({"type": "observe", "seq": 16, "states": [{}]})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/ended");
    client.send(json!({"type": "reward", "reward": 974})).await;
    let rewarded = client.receive().await;
    assert_eq!((&rewarded["type"], &rewarded["reward_order"]), (&json!("rewarded"), &json!(1)));
    assert_eq!(client.closed().await, 1000);

    let (_, rewarded) = service.get(&trial).await;
    assert_eq!((&rewarded["reward"], &rewarded["policy_id"]), (&json!(974.0), &done["policy_id"]));
    assert_eq!((&rewarded["policy"]["learner"], &rewarded["policy"]["weights_version"]), (&json!("gold"), &json!(0)));
    let mut client = Client::connect(&service).await;
    client.send(json!({"type": "open", "model": "figure-4", "learner": "nobody"})).await;
    assert_eq!(client.receive().await["problem"]["type"], "/problems/unknown-learner");
    assert_eq!(client.closed().await, 4404);
}

#[tokio::test]
async fn an_exploring_session_ends_with_its_policy_if_no_reward_is_to_come_any_more() {
    let (service, demonstration) = figure_4().await;
    let learner = json!({"attributes": ["x", "gold"], "seed": 7});
    assert_eq!(service.put("/v1/learners/gold", &learner).await.0, 201);
    let explore = json!({"type": "open", "model": "figure-4", "learner": "gold", "explore": true});
    let observe = json!({"type": "observe", "seq": 0, "states": demonstration});
    let resume = async |session: &str| {
        let mut client = Client::connect(&service).await;
        client.send(json!({"type": "resume", "session": session})).await;
        client
    };

    // Rewarded before its end.
    let mut client = Client::connect(&service).await;
    let session = client.open(explore.clone()).await;
    client.send(observe.clone()).await;
    client.send(json!({"type": "reward", "reward": 3})).await;
    let rewarded = client.receive_until("rewarded").await.pop().unwrap();
    client.send(json!({"type": "end", "seq": 16})).await;
    client.receive_until("done").await;
    assert_eq!(client.closed().await, 1000);
    let mut again = resume(&session).await;
    again.receive_until("done").await;
    assert_eq!(again.receive().await, rewarded, "it may not have been heard");
    assert_eq!(again.closed().await, 1000);

    // Failed before its end.
    let mut client = Client::connect(&service).await;
    client.send(explore.clone()).await;
    let opened = client.receive().await;
    let fail = format!("/v1/trials/{}/fail", opened["trial"].as_str().unwrap());
    assert_eq!(service.post(&fail, &json!({"reason": "it fell"})).await.0, 200);
    client.send(observe.clone()).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    client.receive_until("done").await;
    assert_eq!(client.closed().await, 1000);

    // The learner is deleted after its end.
    let mut client = Client::connect(&service).await;
    let session = client.open(explore).await;
    client.send(observe).await;
    client.send(json!({"type": "end", "seq": 16})).await;
    client.receive_until("done").await;
    assert_eq!(service.delete("/v1/learners/gold").await.0, 204);
    let mut again = resume(&session).await;
    again.receive_until("done").await;
    assert_eq!(again.closed().await, 1000);
}

#[tokio::test]
async fn pings_are_answered_while_the_service_searches() {
    let service = Service::start(&["--search-threads", "1", "--drain-timeout", "1h"]).await;
    let cave = json!({
        "actions": [{"name": "forward"}, {"name": "turn_left"}, {"name": "grab"}],
        "dynamics": {"kind": "wumpus", "width": 20, "height": 20, "gold": [[5, 5], [9, 2], [3, 12]]},
    });
    assert_eq!(service.put("/v1/models/cave", &cave).await.0, 201);
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "cave"})).await;
    let states: Vec<Value> = (0..10_000).map(|n| json!({"x": n % 20, "y": n / 20 % 20})).collect();
    client.send(json!({"type": "observe", "seq": 0, "states": states})).await;
    assert_eq!(client.receive().await, json!({"type": "received", "seq": 10_000}));
    // Ten thousand layers are under way, none of whose steps is sent before all of them are done.
    client.socket.send(Message::Ping(b"there?".as_slice().into())).await.unwrap();
    assert_eq!(client.next().await, Message::Pong(b"there?".as_slice().into()));
    // Who vanishes now ends the search, so that another has its turn, and a shutdown waits for neither.
    drop(client);
    let request = json!({"model": "cave", "demonstration": [{"x": 0}]});
    let other = within("an answer", service.post("/v1/policies", &request)).await;
    assert_eq!(other.0, 201);
    within("the end of the service", service.stop()).await;
}

/// Two loops of as many states each; which of them is entered cannot be told apart by what is observed.
fn two_loops(n_each: usize) -> Value {
    let on = |first: usize| (0..n_each).map(move |n| json!([first + n, "on", first + (n + 1) % n_each]));
    let entries = [json!([0, "left", 1]), json!([0, "right", 1 + n_each])];
    let states = std::iter::once(json!([0])).chain((0..2 * n_each).map(|n| json!([1 + n % n_each])));
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "left"}, {"name": "right"}, {"name": "on"}],
        "dynamics": {
            "kind": "table", "states": states.collect::<Vec<_>>(),
            "transitions": entries.into_iter().chain(on(1)).chain(on(1 + n_each)).collect::<Vec<_>>(), "start": 0,
        },
    })
}

#[tokio::test]
async fn a_stream_of_which_nothing_is_proven_is_told_what_does_not_fit_and_to_set_a_lookahead() {
    // Of which 64 MiB are not for requests.
    let max_memory = (64 << 20) + (6 << 20);
    let directory = tempfile::tempdir().unwrap();
    let service = Service::start_set_up(directory, &[], |config| config.max_memory = Some(max_memory)).await;
    assert_eq!(service.put("/v1/models/loops", &two_loops(2_000)).await.0, 201);
    let mut client = Client::connect(&service).await;
    client.open(json!({"type": "open", "model": "loops", "lookahead": null})).await;
    let states: Vec<Value> = (0..2000).map(|n| json!([1 + n])).collect();
    client.send(json!({"type": "observe", "seq": 0, "states": states})).await;
    let problem = client.receive_until_error().await["problem"].clone();
    assert_eq!(problem["type"], "/problems/overloaded");
    let detail = problem["detail"].as_str().unwrap();
    for part in ["all 4001 states", "observations since the last proven step", "bytes", "a lookahead, such as 8"] {
        assert!(detail.contains(part), "{detail}");
    }
    assert_eq!(client.closed().await, 1013);
}
