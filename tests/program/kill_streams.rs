//! The real program is killed with SIGKILL, again and again, in the middle of streams.
//!
//! Nothing that it said was received may be lost, nothing may be doubled, and the steps must be those of a run that
//! nobody disturbed.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdin, Command, Stdio};

use crate::harness::process::Process;
use crate::harness::waiting::{Watchdog, within};
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

const N_KILLS: usize = 100;

/// Observations of a stream: the demonstration of figure 4, there and back.
const N_OBSERVATIONS: usize = 48;

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// What a client knows of its stream.
#[derive(Default)]
struct Watcher {
    session: String,
    /// How many observations were acknowledged.
    n_received: usize,
    /// Every step, by its number.
    steps: Vec<Value>,
    done: Option<Value>,
}

impl Watcher {
    /// Connects, and opens or resumes the session.
    async fn connect(&self, process: &Process) -> Socket {
        let url = format!("ws://{}/v1/stream", process.address);
        let (mut socket, _) = tokio_tungstenite::connect_async(url).await.unwrap();
        let frame = if self.session.is_empty() {
            json!({"type": "open", "model": "figure-4", "lookahead": 4})
        } else {
            json!({"type": "resume", "session": self.session, "step": self.steps.len()})
        };
        socket.send(Message::text(frame.to_string())).await.unwrap();
        socket
    }

    /// Streams from where the service is, until the policy is done or `until` frames have come.
    async fn watch(&mut self, socket: &mut Socket, observations: &[Value], until: usize) {
        for _ in 0..until {
            let message = within("a message", socket.next()).await.unwrap().unwrap();
            let Message::Text(text) = message else { panic!("{message:?}") };
            let frame: Value = serde_json::from_str(&text).unwrap();
            match frame["type"].as_str().unwrap() {
                "hello" => {}
                "opened" => {
                    let durable = usize::try_from(frame["received"].as_u64().unwrap()).unwrap();
                    assert!(durable >= self.n_received, "{} acknowledged, {frame}", self.n_received);
                    frame["session"].as_str().unwrap().clone_into(&mut self.session);
                    // All at once, some in twos, so that writes are under way when the end comes.
                    for (n, states) in observations.chunks(2).enumerate().skip(durable / 2) {
                        let seq = 2 * n;
                        self.send(socket, &json!({"type": "observe", "seq": seq, "states": states})).await;
                    }
                    self.send(socket, &json!({"type": "end", "seq": observations.len()})).await;
                }
                "received" => self.n_received = usize::try_from(frame["seq"].as_u64().unwrap()).unwrap(),
                "step" => {
                    assert_eq!(frame["step"], self.steps.len(), "none is missing, none comes twice");
                    self.steps.push(frame);
                }
                "done" => {
                    self.done = Some(frame);
                    return;
                }
                _ => panic!("{frame}"),
            }
        }
    }

    async fn send(&self, socket: &mut Socket, frame: &Value) {
        socket.send(Message::text(frame.to_string())).await.unwrap();
    }
}

/// A generator of numbers that are the same everywhere (Steele, Lea & Flood 2014).
struct SplitMix(u64);

impl SplitMix {
    fn below(&mut self, bound: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        usize::try_from((z ^ (z >> 31)) >> 1).unwrap() % bound
    }
}

#[tokio::test]
async fn a_service_killed_a_hundred_times_loses_and_doubles_nothing() {
    killed_again_and_again(&["--listen", "127.0.0.1:0"]).await;
}

#[tokio::test]
async fn nor_does_one_whose_worlds_are_searched_lazily() {
    killed_again_and_again(&["--listen", "127.0.0.1:0", "--max-states", "10"]).await;
}

async fn killed_again_and_again(flags: &[&str]) {
    let there: Vec<Value> = serde_json::from_str(include_str!("../../examples/figure-4/demonstration.json")).unwrap();
    let observations: Vec<Value> =
        there.iter().chain(there.iter().rev()).cycle().take(N_OBSERVATIONS).cloned().collect();
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let mut process = Process::start_with(flags, &database);
    let model: Value = serde_json::from_str(include_str!("../../examples/figure-4/model.json")).unwrap();
    let client = crate::harness::client::Client::new();
    let registered = client.put(format!("http://{}/v1/models/figure-4", process.address)).json(&model).send().await;
    assert!(registered.unwrap().status().is_success());

    let mut undisturbed = Watcher::default();
    let mut socket = undisturbed.connect(&process).await;
    undisturbed.watch(&mut socket, &observations, usize::MAX).await;
    let expected_done = undisturbed.done.unwrap();
    assert!(undisturbed.steps.len() >= N_OBSERVATIONS);

    let mut random = SplitMix(3);
    let (mut n_kills, mut n_streams, mut n_resumed_midway) = (0, 0, 0);
    while n_kills < N_KILLS {
        let mut watcher = Watcher::default();
        n_streams += 1;
        loop {
            let mut socket = watcher.connect(&process).await;
            let was = (watcher.n_received, watcher.steps.len());
            // The moment of death: after so many more frames, the first two of which are `hello` and `opened`.
            let until = if n_kills < N_KILLS { 2 + random.below(16) } else { usize::MAX };
            watcher.watch(&mut socket, &observations, until).await;
            if watcher.done.is_some() {
                break;
            }
            process.kill();
            n_kills += 1;
            n_resumed_midway += usize::from(was.1 > 0);
            process = Process::start_with(flags, &database);
        }
        assert_eq!(watcher.steps, undisturbed.steps);
        let done = watcher.done.unwrap();
        assert_eq!((&done["cost"], &done["actions"]), (&expected_done["cost"], &expected_done["actions"]));
        let url = format!("http://{}/v1/sessions/{}", process.address, watcher.session);
        let session: Value = client.get(url).send().await.unwrap().json().await.unwrap();
        assert_eq!((&session["status"], &session["observations"]), (&json!("done"), &json!(N_OBSERVATIONS)));
        assert_eq!(session["policy_id"], done["policy_id"]);
    }
    assert!(n_streams > 5 && n_resumed_midway > N_KILLS / 3, "{n_streams} streams, {n_resumed_midway} resumed midway");
    process.kill();
}

/// Nobody can say which steps time decides, but none of those that were told may ever be told otherwise.
#[tokio::test]
async fn what_time_has_decided_stays_so_in_a_service_that_is_killed_again_and_again() {
    const N_KILLS: usize = 40;
    let there: Vec<Value> = serde_json::from_str(include_str!("../../examples/figure-4/demonstration.json")).unwrap();
    let observations: Vec<Value> = there.iter().chain(there.iter().rev()).cycle().take(2000).cloned().collect();
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let mut process = Process::start(&database);
    let model: Value = serde_json::from_str(include_str!("../../examples/figure-4/model.json")).unwrap();
    let client = crate::harness::client::Client::new();
    let registered = client.put(format!("http://{}/v1/models/figure-4", process.address)).json(&model).send().await;
    assert!(registered.unwrap().status().is_success());

    let mut random = SplitMix(7);
    let (mut session, mut told, mut n_received, mut n_timed) = (Value::Null, Vec::<Value>::new(), 0, 0);
    for n_kills in 0..=N_KILLS {
        let url = format!("ws://{}/v1/stream", process.address);
        let (mut socket, _) = tokio_tungstenite::connect_async(url).await.unwrap();
        let first = if session.is_null() {
            json!({"type": "open", "model": "figure-4", "lookahead": null, "lookahead_ms": 3})
        } else {
            json!({"type": "resume", "session": session})
        };
        socket.send(Message::text(first.to_string())).await.unwrap();
        let (mut n_steps, mut n_new, mut has_ended) = (0, 0, false);
        let until = 1 + random.below(12);
        while n_kills == N_KILLS || n_new < until {
            let message = within("a message", socket.next()).await.unwrap().unwrap();
            let mut frame: Value = serde_json::from_str(message.to_text().unwrap()).unwrap();
            // What goes on once it is there.
            let goes_on = match frame["type"].as_str().unwrap() {
                "hello" => false,
                "opened" => {
                    assert!(frame["received"].as_u64() >= Some(n_received), "{n_received} were acknowledged: {frame}");
                    n_received = frame["received"].as_u64().unwrap();
                    session = frame["session"].take();
                    true
                }
                "received" => {
                    n_received = frame["seq"].as_u64().unwrap();
                    random.below(2) == 0
                }
                "step" => {
                    let is_newest = frame["observation"].as_u64() == n_received.checked_sub(1);
                    if let Some(before) = told.get(n_steps) {
                        assert_eq!(frame, *before);
                    } else {
                        n_new += 1;
                        n_timed += usize::from(frame["proven"] == false);
                        told.push(frame);
                    }
                    n_steps += 1;
                    is_newest && n_new > 0
                }
                "done" => {
                    let id = frame["policy_id"].as_str().unwrap();
                    let policy = client.get(format!("http://{}/v1/policies/{id}", process.address)).send().await;
                    let policy: Value = policy.unwrap().json().await.unwrap();
                    let steps = policy["steps"].as_array().unwrap();
                    assert_eq!(steps.len(), told.len());
                    for (step, told) in steps.iter().zip(&told) {
                        for field in ["step", "observation", "move", "action", "state", "distance", "cost"] {
                            assert_eq!(step[field], told[field], "{field} of {told}");
                        }
                    }
                    assert!(n_timed > 0, "{n_timed} of {} steps were decided by time", told.len());
                    process.kill();
                    return;
                }
                "error" => {
                    assert_eq!(frame["problem"]["type"], "/problems/gap", "something came before the end");
                    has_ended = false;
                    true
                }
                _ => panic!("{frame}"),
            };
            if goes_on && !has_ended {
                let seq = usize::try_from(n_received).unwrap();
                has_ended = n_kills == N_KILLS && n_new >= until;
                let next = if has_ended {
                    json!({"type": "end", "seq": seq})
                } else {
                    json!({"type": "observe", "seq": seq, "states": observations[seq..=seq + random.below(2)]})
                };
                socket.send(Message::text(next.to_string())).await.unwrap();
            }
        }
        process.kill();
        process = Process::start(&database);
    }
}

/// `etude stream` at a service.
struct Program {
    child: Child,
    input: Option<ChildStdin>,
    _watched: Watchdog,
}

impl Program {
    fn start(flags: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(["stream", "--json", "--lookahead", "4"]).args(flags).env_remove("ETUDE_LOG");
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        Self { input: child.stdin.take(), _watched: Watchdog::watch(child.id()), child }
    }

    fn write(&mut self, observations: &[Value]) {
        for observation in observations {
            writeln!(self.input.as_ref().unwrap(), "{observation}").unwrap();
        }
    }

    /// Ends the input; gives the lines that were printed, whether all is well, and the errors.
    fn end(mut self) -> (Vec<Value>, bool, String) {
        drop(self.input.take());
        let ended = self.child.wait_with_output().unwrap();
        let lines = std::str::from_utf8(&ended.stdout).unwrap().lines();
        let frames = lines.map(|line| serde_json::from_str(line).unwrap()).collect();
        (frames, ended.status.success(), String::from_utf8(ended.stderr).unwrap())
    }
}

#[tokio::test]
async fn the_command_goes_on_by_itself_when_its_service_is_killed_and_restarted() {
    const N_RESTARTS: usize = 20;
    let there: Vec<Value> = serde_json::from_str(include_str!("../../examples/figure-4/demonstration.json")).unwrap();
    let observations: Vec<Value> =
        there.iter().chain(there.iter().rev()).cycle().take(20 * N_RESTARTS).cloned().collect();
    let mut undisturbed = Program::start(&["--model", "examples/figure-4/model.json"]);
    undisturbed.write(&observations);
    let (mut expected, _, _) = undisturbed.end();

    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let mut process = Process::start(&database);
    let address = process.address.clone();
    let server = format!("http://{address}");
    let mut program = Program::start(&["--model", "examples/figure-4/model.json", "--server", &server]);
    let mut output = BufReader::new(program.child.stdout.take().unwrap());
    let mut printed = Vec::new();
    let mut read = |printed: &mut Vec<Value>| {
        let mut line = String::new();
        output.read_line(&mut line).unwrap();
        printed.push(serde_json::from_str(&line).unwrap_or_else(|_| panic!("{line:?} after {} lines", printed.len())));
    };
    let mut random = SplitMix(5);
    for chunk in observations.chunks(observations.len() / N_RESTARTS) {
        // The moment of death: after so many steps of those to come, while other lines are on their way.
        program.write(chunk);
        let n_steps = 1 + random.below(8);
        (0..n_steps).for_each(|_| read(&mut printed));
        process.kill();
        process = Process::start_with(&["--listen", &address], &database);
    }
    drop(program.input.take());
    while printed.len() < expected.len() {
        read(&mut printed);
    }
    let mut rest = String::new();
    output.read_to_string(&mut rest).unwrap();
    let (_, is_well, errors) = program.end();
    assert_eq!((rest.as_str(), is_well, errors.as_str()), ("", true, ""));
    let policy_id = printed.last_mut().unwrap()["policy_id"].take();
    assert!(policy_id.is_string());
    let total = |done: Option<Value>| done.unwrap()["cost"]["total"].as_f64().unwrap();
    let (done, expected_done) = (printed.pop(), expected.pop());
    assert_eq!(total(done), total(expected_done));
    assert_eq!(printed, expected, "no step is missing, none comes twice");

    let client = crate::harness::client::Client::new();
    let sessions: Value = client.get(format!("{server}/v1/sessions")).send().await.unwrap().json().await.unwrap();
    let [session] = sessions["items"].as_array().unwrap().as_slice() else { panic!("{sessions}") };
    assert_eq!((&session["status"], &session["observations"]), (&json!("done"), &json!(observations.len())));
    process.kill();
}

#[test]
fn a_service_that_stays_away_is_given_up() {
    let directory = tempfile::tempdir().unwrap();
    let process = Process::start(&directory.path().join("etude.db"));
    let server = format!("http://{}", process.address);
    let flags = ["--model", "examples/figure-4/model.json", "--server", &server, "--retries", "2"];
    let mut program = Program::start(&flags);
    // As many as the lookahead needs to decide the start.
    program.write(&vec![json!({"x": 0}); 4]);
    let mut first = String::new();
    BufReader::new(program.child.stdout.take().unwrap()).read_line(&mut first).unwrap();
    assert!(first.contains(r#""step":0"#), "{first}");
    process.kill();
    program.write(&[json!({"x": 1})]);
    let ended = program.child.wait_with_output().unwrap();
    let errors = String::from_utf8(ended.stderr).unwrap();
    assert!(!ended.status.success() && errors.contains("the connection is lost; session 0"), "{errors}");
}
