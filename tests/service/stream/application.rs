//! The protocol without a connection: the application alone, asked as a transport asks it.

use std::sync::Arc;
use std::time::Duration;

use etude::clock::{Clock, Ids};
use etude::service::{Caller, Coming, Etude, Session};
use etude::stream::{Closed, Incoming, Outgoing, Receiver, Sender, queue};
use etude_core::document::Place;
use jiff::Timestamp;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::figure_4;
use crate::harness::service::{Service, flags, long_way, to_and_fro};
use crate::harness::waiting::within;

mod commits;

/// Whoever speaks the protocol without a connection.
const CLIENT: etude::client::Client = etude::client::Client::LOCAL;

/// The application that was a service, without the service.
async fn without_service(service: Service, abort: &CancellationToken) -> (Etude, TempDir) {
    by_clock(service, abort, Clock::system()).await
}

/// The same, by another clock.
async fn by_clock(service: Service, abort: &CancellationToken, clock: Clock) -> (Etude, TempDir) {
    let directory = service.stop().await;
    let database = directory.path().join("etude.db");
    let flags = flags(&["--database", database.to_str().unwrap()]);
    (Etude::open(&flags.settings(clock, Ids::random()), &TaskTracker::new(), abort.clone()).await.unwrap(), directory)
}

/// Receives the states from `seq` on.
async fn receive(etude: &Etude, session: &mut Session, seq: u32, states: &Place<'_, '_>, now: Timestamp) {
    let mut coming = Coming::default();
    session.take_in(&mut coming, seq, states, None).unwrap();
    session.receive(etude, coming, now).await.unwrap();
}

#[tokio::test]
async fn resuming_and_repeating_keep_a_session_from_expiring() {
    let (service, demonstration) = figure_4().await;
    let (etude, _directory) = without_service(service, &CancellationToken::new()).await;
    let at = |minute: i64| Timestamp::from_second(60 * minute).unwrap();
    let caller = |minute| Caller { client: CLIENT, arrived: Clock::system().instant(), now: at(minute) };
    let states = json!(demonstration);
    let states = Place::root(&states);
    let open = json!({"type": "open", "model": "figure-4"});
    let mut session = etude.open_session(&open, caller(0)).await.unwrap();
    let id = session.id().to_owned();
    let active_at = async || etude.session(&id).await.unwrap().active_at;
    receive(&etude, &mut session, 0, &states, at(1)).await;
    assert_eq!(active_at().await, at(1));
    receive(&etude, &mut session, 0, &states, at(2)).await;
    assert_eq!(active_at().await, at(2));
    drop(session);
    let mut resumed = etude.resume_session(&id, caller(3)).await.unwrap();
    assert_eq!((active_at().await, resumed.session.n_received()), (at(3), 16));
    // What is not settled yet came before.
    let more = json!([demonstration[0]]);
    receive(&etude, &mut resumed.session, 16, &Place::root(&more), at(4)).await;
    drop(resumed);
    assert_eq!(etude.resume_session(&id, caller(5)).await.unwrap().session.n_received(), 17);
    assert_eq!(active_at().await, at(5));
    etude.close().await;
}

/// A client that reads nothing: the session's own search waits for it, and is given up.
#[tokio::test]
async fn who_stays_slow_is_closed_as_overloaded() {
    let (service, _) = figure_4().await;
    let abort = CancellationToken::new();
    let (etude, _directory) = without_service(service, &abort).await;
    let limits = flags(&["--slow-reader-timeout", "100ms"]).stream_limits();
    let (came, mut incoming) = queue(1000);
    // Room for `hello` alone.
    let (outgoing, mut goes) = queue(1);
    came.send(frame(&json!({"type": "open", "model": "figure-4"}))).await.unwrap();
    let there = std::future::pending();
    let closed = etude::stream::run(&etude, CLIENT, limits, &mut incoming, &outgoing, &abort, there).await;
    assert_eq!((closed, closed.code().0), (Closed::Overloaded, 1013));
    let hello = goes.try_recv().unwrap().item;
    assert!(matches!(&hello, Outgoing::Frame(hello) if hello.contains("hello")), "{hello:?}");
    etude.close().await;
}

#[tokio::test]
async fn many_frames_that_are_answered_at_once_let_others_have_their_turn() {
    const N_FRAMES: u64 = 200;
    let (service, _) = figure_4().await;
    let abort = CancellationToken::new();
    let (etude, _directory) = without_service(service, &abort).await;
    let limits = flags(&[]).stream_limits();
    let (came, mut incoming) = queue(65_536);
    let (outgoing, mut goes) = queue(1 << 20);
    came.send(frame(&json!({"type": "open", "model": "figure-4"}))).await.unwrap();
    let there = std::future::pending();
    let mut running = Box::pin(etude::stream::run(&etude, CLIENT, limits, &mut incoming, &outgoing, &abort, there));
    let opened = async {
        while !matches!(goes.recv().await.unwrap().item, Outgoing::Frame(frame) if frame.contains("opened")) {}
    };
    tokio::select! {
        closed = &mut running => panic!("{closed:?}"),
        () = opened => {}
    }
    for _ in 0..N_FRAMES {
        came.send(frame(&json!({"type": "observe", "seq": 1, "states": [{"unknown": 1}]}))).await.unwrap();
    }
    let mut answered = Vec::new();
    while answered.iter().sum::<u64>() < N_FRAMES {
        // As if it was polled anew by the runtime.
        let is_pending =
            tokio::task::coop::unconstrained(async { futures_util::poll!(&mut running).is_pending() }).await;
        assert!(is_pending);
        answered.push(std::iter::from_fn(|| goes.try_recv()).count() as u64);
        tokio::task::yield_now().await;
    }
    assert!(answered.iter().all(|n| *n <= 40), "{answered:?} at a time");
    drop(running);
    etude.close().await;
}

/// A frame that came.
fn frame(frame: &Value) -> Incoming {
    Incoming::Frame { text: frame.to_string().into(), memory: None }
}

/// A connection of the application alone, without a transport: one frame fits into the queue to the client.
struct Wire {
    to_server: Sender<Incoming>,
    from_server: Receiver<Outgoing>,
    running: JoinHandle<Closed>,
}

impl Wire {
    fn connect(etude: &Arc<Etude>, stopping: &CancellationToken) -> Self {
        let (to_server, mut incoming) = queue(65_536);
        let (outgoing, from_server) = queue(1);
        let (etude, stopping) = (Arc::clone(etude), stopping.clone());
        let limits = flags(&["--slow-reader-timeout", "1h"]).stream_limits();
        let running = tokio::spawn(async move {
            let there = std::future::pending();
            etude::stream::run(&etude, CLIENT, limits, &mut incoming, &outgoing, &stopping, there).await
        });
        Self { to_server, from_server, running }
    }

    async fn send(&self, sent: Value) {
        self.to_server.send(frame(&sent)).await.unwrap();
    }

    async fn receive_until(&mut self, kind: &str) -> Value {
        loop {
            let frame = self.receive().await;
            if frame["type"] == kind {
                return frame;
            }
        }
    }

    async fn receive(&mut self) -> Value {
        let came = within("a frame", self.from_server.recv()).await;
        let Some(Outgoing::Frame(text)) = came.map(|queued| queued.item) else { panic!("an end") };
        serde_json::from_str(&text).unwrap()
    }
}

/// What is sent of a demonstration, with all that may be wrong with it on the way.
fn script(demonstration: &[Value]) -> Vec<Value> {
    let observe = |seq: usize, n: usize| json!({"type": "observe", "seq": seq, "states": demonstration[seq..seq + n]});
    let mut weighted = observe(5, 2);
    weighted["observation_weights"] = json!([2.0, null]);
    let unknown = json!({"type": "observe", "seq": 7, "states": [demonstration[7], {"z": 1}]});
    let mut script = vec![observe(0, 1), observe(1, 3), observe(2, 2), observe(9, 1), observe(3, 2), weighted, unknown];
    script.push(json!({"type": "end", "seq": 6}));
    script.extend((7..demonstration.len()).map(|seq| observe(seq, 1)));
    script.push(json!({"type": "observe", "seq": demonstration.len(), "states": [{"x": -1000}]}));
    script.push(json!({"type": "observe", "seq": 3, "states": []}));
    script
}

#[tokio::test]
async fn frames_are_answered_alike_one_by_one_or_one_behind_the_other_and_whether_or_not_they_are_read_as_documents() {
    let (service, demonstration) = figure_4().await;
    let (etude, _directory) = without_service(service, &CancellationToken::new()).await;
    let (etude, stopping) = (Arc::new(etude), CancellationToken::new());
    let script = script(&demonstration);
    for lookahead in [json!(1), json!(8), json!(null)] {
        let mut answers = Vec::new();
        for (are_sent_together, is_null_told) in [(false, false), (true, false), (false, true), (true, true)] {
            let mut wire = Wire::connect(&etude, &stopping);
            wire.send(json!({"type": "open", "model": "figure-4", "lookahead": lookahead})).await;
            wire.receive_until("opened").await;
            let mut came = Vec::new();
            for sent in &script {
                let mut sent = sent.clone();
                // What tells it, if only that there are none, is read as a document.
                if is_null_told && sent["type"] == "observe" && sent["observation_weights"].is_null() {
                    sent["observation_weights"] = Value::Null;
                }
                wire.send(sent).await;
                let mut is_answered = are_sent_together;
                while !is_answered {
                    came.push(wire.receive().await);
                    is_answered = came.last().unwrap()["type"] != "step";
                }
            }
            wire.send(json!({"type": "end", "seq": demonstration.len() + 1})).await;
            while came.last().is_none_or(|last| last["type"] != "done") {
                came.push(wire.receive().await);
            }
            came.last_mut().unwrap()["policy_id"].take();
            answers.push(came);
        }
        let n_warned = answers[0].iter().filter(|frame| frame["warnings"].is_array()).count();
        assert!(n_warned >= 1, "{answers:?}");
        assert!(answers.iter().all(|others| *others == answers[0]), "{answers:?}");
    }
    etude.close().await;
}

#[tokio::test]
async fn observations_are_read_again_after_a_break_however_they_were_written() {
    let (service, demonstration) = figure_4().await;
    let request = json!({"model": "figure-4", "demonstration": demonstration, "lookahead": 8, "store": false});
    let (_, expected) = service.post("/v1/policies", &request).await;
    let (etude, _directory) = without_service(service, &CancellationToken::new()).await;
    let (etude, stopping) = (Arc::new(etude), CancellationToken::new());
    let mut wire = Wire::connect(&etude, &stopping);
    wire.send(json!({"type": "open", "model": "figure-4"})).await;
    let session = wire.receive_until("opened").await["session"].clone();
    // The names escaped, whole numbers as floats, and blanks wherever there may be some.
    for (seq, state) in demonstration.iter().enumerate() {
        let states = serde_json::to_string_pretty(&json!([state])).unwrap();
        let states = states.replace("\"x\": ", "\"\\u0078\" :\t").replace("\"gold\": 1", "\"gold\": 1.0e0");
        let text = format!("{{ \"states\" :\n{states}, \"seq\": {seq} ,\"type\": \"observe\" }}");
        assert!(serde_json::from_str::<Value>(&text).is_ok() && text.contains("u0078"), "{text}");
        wire.to_server.send(Incoming::Frame { text: text.into(), memory: None }).await.unwrap();
        wire.receive_until("received").await;
        if seq % 5 == 3 {
            wire = Wire::connect(&etude, &stopping);
            wire.send(json!({"type": "resume", "session": session})).await;
            assert_eq!(wire.receive_until("opened").await["received"], seq + 1);
        }
    }
    wire.send(json!({"type": "end", "seq": demonstration.len()})).await;
    let done = wire.receive_until("done").await;
    assert_eq!((&done["cost"], &done["actions"]), (&expected["cost"], &expected["actions"]));
    etude.close().await;
}

#[tokio::test]
async fn a_session_whose_policy_is_too_large_says_so_and_can_still_be_read() {
    let service = Service::start(&[]).await;
    assert_eq!(service.put("/v1/models/wide", &long_way()).await.0, 201);
    let stopping = CancellationToken::new();
    let (etude, _directory) = without_service(service, &stopping).await;
    let etude = Arc::new(etude);
    let mut wire = Wire::connect(&etude, &stopping);
    wire.send(json!({"type": "open", "model": "wide", "lookahead": null})).await;
    let session = wire.receive_until("opened").await["session"].take();
    wire.send(json!({"type": "observe", "seq": 0, "states": to_and_fro(200)})).await;
    wire.send(json!({"type": "end", "seq": 200})).await;
    let problem = wire.receive_until("error").await["problem"].take();
    assert_eq!(problem["type"], "/problems/policy-too-large", "{problem}");
    assert!(problem["detail"].as_str().unwrap().contains(" steps"), "{problem}");
    assert_eq!(wire.running.await.unwrap(), Closed::TooLarge);

    let id = session.as_str().unwrap();
    let row = etude.session(id).await.unwrap();
    assert_eq!((row.status.name(), row.n_observations, row.policy_id), ("open", 200, None));
    let mut again = Wire::connect(&etude, &stopping);
    again.send(json!({"type": "resume", "session": id, "step": 1_000_000})).await;
    assert_eq!(again.receive_until("opened").await["received"], 200);
    etude.close().await;
}

#[tokio::test]
async fn a_step_that_is_due_comes_while_the_client_is_silent_and_is_on_disk_before() {
    let (service, demonstration) = figure_4().await;
    let (clock, stopping) = (Clock::stepped(Timestamp::UNIX_EPOCH), CancellationToken::new());
    let (etude, _directory) = by_clock(service, &stopping, clock.clone()).await;
    let etude = Arc::new(etude);
    let mut wire = Wire::connect(&etude, &stopping);
    wire.send(json!({"type": "open", "model": "figure-4", "lookahead": null, "lookahead_ms": 200})).await;
    let session = wire.receive_until("opened").await["session"].take();
    wire.send(json!({"type": "observe", "seq": 0, "states": demonstration[..3]})).await;
    assert_eq!(wire.receive_until("step").await["proven"], true, "the start");
    clock.step(Duration::from_millis(200));
    let mut steps = vec![wire.receive_until("step").await];
    while steps.last().unwrap()["observation"] != 2 {
        steps.push(wire.receive_until("step").await);
    }
    assert!(steps.iter().all(|step| step["after"] == 3), "{steps:?}");
    // It is still read from, and goes on.
    wire.send(json!({"type": "observe", "seq": 3, "states": demonstration[3..4]})).await;
    assert_eq!(wire.receive_until("received").await["seq"], 4);
    let mut again = Wire::connect(&etude, &stopping);
    again.send(json!({"type": "resume", "session": session, "step": 1})).await;
    for step in &steps {
        assert_eq!(again.receive_until("step").await, *step);
    }
    etude.close().await;
}

#[tokio::test]
async fn a_slow_reader_holds_up_neither_who_resumes_its_session_nor_a_shutdown() {
    let (service, demonstration) = figure_4().await;
    let (etude, _directory) = without_service(service, &CancellationToken::new()).await;
    let (etude, stopping) = (Arc::new(etude), CancellationToken::new());
    let mut slow = Wire::connect(&etude, &stopping);
    slow.send(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await;
    let session = slow.receive_until("opened").await["session"].take();
    slow.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
    // From here on it reads nothing, and the server is in the middle of sending steps.
    slow.receive_until("step").await;

    let resume = json!({"type": "resume", "session": session});
    let mut next = Wire::connect(&etude, &stopping);
    next.send(resume.clone()).await;
    assert_eq!(next.receive_until("opened").await["received"], 16);
    assert_eq!(slow.receive_until("error").await["problem"]["type"], "/problems/taken-over");
    assert_eq!(slow.running.await.unwrap(), Closed::NotAllowed);

    // Now this one reads nothing.
    next.receive_until("step").await;
    stopping.cancel();
    assert_eq!(next.receive_until("error").await["problem"]["type"], "/problems/stopping");
    assert_eq!(next.running.await.unwrap(), Closed::GoingAway);
    let mut last = Wire::connect(&etude, &CancellationToken::new());
    last.send(resume).await;
    last.receive_until("opened").await;
    last.send(json!({"type": "end", "seq": 16})).await;
    last.receive_until("done").await;
    etude.close().await;
}
