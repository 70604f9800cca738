//! Attackers: each sends what a client must not send, or does not read what it asked for, on a bounded number of connections.
//!
//! This file is longer than 400 lines because it is a list of attacks, each of which stands by itself.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::future::pending;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use flate2::Compression;
use flate2::write::GzEncoder;
use futures_util::FutureExt;
use futures_util::future::join_all;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::{sleep, timeout};

use super::{Failure, table};
use crate::worlds::World;

macro_rules! attacks {
    ($($(#[$doc:meta])* $name:ident,)*) => {
        /// What is attacked, and how.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Attack { $($(#[$doc])* $name,)* }

        impl Attack {
            pub(crate) const ALL: &[Self] = &[$(Self::$name),*];
        }
    };
}

attacks! {
    /// Websockets that send pings and read no pongs.
    PingFlood,
    /// A small batch of a great many large policies.
    WideBatch,
    /// Lists of models with long labels that are asked for and not read.
    UnreadList,
    /// Large policies that are asked for and not read.
    UnreadPolicy,
    /// What a page of another origin, or of a name that was bound anew, makes a browser send.
    ForeignOrigin,
    /// A lookahead on a large table with many observations, and its refinement later.
    Lookahead,
    /// The same cave of a million cells, 64 wumpi and 64 pieces of gold, registered again and again.
    HugeCave,
    /// Large models, each of which drives another one out of memory, with deadlines of 50 ms.
    ColdModels,
    /// Searches that take minutes, without deadlines.
    HardSearches,
    /// Bodies of which a byte a second comes.
    SlowBodies,
    /// Likewise, of a type that is not read.
    SlowTypes,
    /// Models of 1.1 MB of which the end does not come.
    SlowUploads,
    /// Bodies that announce 8 MB, of which two bytes come.
    Announced,
    /// Connections on which nothing is ever asked.
    Idle,
    /// Websockets whose peer is gone without a word.
    HalfOpen,
    /// Streams as JSON lines that send all they have and read nothing.
    UnreadStream,
    /// Frames of 256 KiB sent ahead.
    QueuedFrames,
    /// Frames that break the rules of websockets, or of the protocol.
    MalformedFrames,
    /// Small bodies that become large ones once they are decompressed.
    Bombs,
    /// Demonstrations that observe nothing of many attributes, alone and in batches.
    SparseDemonstrations,
    /// Long sessions of as many attributes that are resumed and ended at the same time.
    LongSessions,
    /// A large policy that is asked for on many connections at the same time.
    LargePolicy,
    /// Streams that send one frame of almost 256 KiB each, and stay.
    LargeFrames,
    /// Streams that look far ahead on a large table, all at once.
    ComputingStreams,
    /// Large models, each of which drives another one out of memory, asked for again and again with deadlines of 1 ms.
    ColdAgain,
}

/// How much of everything.
#[derive(Clone, Copy)]
pub(crate) struct Size {
    /// States of models that are searched.
    pub(crate) n_states: usize,
    /// States of models that have to be compiled.
    pub(crate) n_cold: usize,
    /// Observations that a lookahead is tried with, and a fifth of those that a stream has.
    pub(crate) n_observations: usize,
    /// Bytes that queued frames and decompressed bodies come to on each connection, lists to half of it, pings to 16 times.
    pub(crate) n_bytes: usize,
    /// How long a connection is held.
    pub(crate) hold: Duration,
}

/// What a connection sends.
#[derive(Default)]
struct Message {
    first: Vec<u8>,
    /// Sent then, so many times, after a pause each.
    then: Vec<u8>,
    n_times: usize,
    pause: Duration,
}

/// Whether an attacker reads what it is answered.
#[derive(Clone, Copy, PartialEq)]
enum Answers {
    Read,
    Unread,
}

/// Somebody who carries out an attack, from an address of its own.
pub(crate) struct Attacker {
    pub(crate) attack: Attack,
    pub(crate) from: Ipv4Addr,
    address: SocketAddr,
    hold: Duration,
    /// At a time.
    n_connections: usize,
    answers: Answers,
    /// What its connections send, in turn.
    messages: Vec<Message>,
    outcomes: Mutex<BTreeMap<String, usize>>,
}

impl Attacker {
    /// Registers what the attack needs.
    pub(crate) async fn prepare(attack: Attack, address: SocketAddr, size: Size) -> Result<Self, Failure> {
        let target = Target { address, client: reqwest::Client::builder().no_proxy().build()? };
        let (n_connections, answers, messages) = target.prepare(attack, size).await?;
        // From 127.0.0.2 on.
        let (from, outcomes) = (Ipv4Addr::new(127, 0, 0, 2 + attack as u8), Mutex::default());
        Ok(Self { attack, from, address, hold: size.hold, n_connections, answers, messages, outcomes })
    }

    /// Carries it out once, on all its connections.
    pub(crate) async fn attack(&self) {
        let connections = (0..self.n_connections).map(async |n| {
            let outcome = self.connection(&self.messages[n % self.messages.len()]).await;
            *self.outcomes.lock().unwrap_or_else(PoisonError::into_inner).entry(outcome).or_default() += 1;
        });
        join_all(connections).await;
    }

    /// How many connections ended how: with the status of an answer, `closed` or `refused` by the service, or `held` as long as
    /// the attacker liked.
    pub(crate) fn outcomes(&self) -> BTreeMap<String, usize> {
        self.outcomes.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    async fn connection(&self, message: &Message) -> String {
        let Ok(stream) = self.connect().await else { return "refused".to_owned() };
        let (mut reader, mut writer) = stream.into_split();
        let writing = async {
            writer.write_all(&message.first).await?;
            for _ in 0..message.n_times {
                if !message.pause.is_zero() {
                    sleep(message.pause).await;
                }
                writer.write_all(&message.then).await?;
            }
            pending::<io::Result<()>>().await
        };
        let (mut status, mut buffer) = (String::new(), vec![0; 1 << 16]);
        let is_closed = if self.answers == Answers::Read {
            let reading = async {
                while let Ok(n_read @ 1..) = reader.read(&mut buffer).await {
                    if status.is_empty() {
                        let head = String::from_utf8_lossy(&buffer[..n_read.min(32)]);
                        head.split(' ').nth(1).unwrap_or("?").clone_into(&mut status);
                    }
                    // Who is refused has nothing to wait for.
                    if status.starts_with(['4', '5']) {
                        break;
                    }
                }
            };
            // What is refused before all of it was sent is answered nevertheless.
            tokio::select! {
                read = timeout(self.hold, reading) => read.is_ok(),
                () = writing.then(|_| pending::<()>()) => unreachable!("it waits for ever"),
            }
        } else {
            let broke = timeout(self.hold, writing).await.is_ok();
            // What the kernel holds, and then the end if it has come.
            let mut reads = std::iter::repeat_with(|| reader.try_read(&mut buffer)).take(64);
            broke || reads.any(|read| read.map_or_else(|error| error.kind() != io::ErrorKind::WouldBlock, |n| n == 0))
        };
        match (status.as_str(), is_closed) {
            ("", true) => "closed".to_owned(),
            ("", false) => "held".to_owned(),
            (status, true) => status.to_owned(),
            (status, false) => format!("{status} and held"),
        }
    }

    async fn connect(&self) -> io::Result<TcpStream> {
        let socket = TcpSocket::new_v4()?;
        if self.answers == Answers::Unread {
            // So that it is the service that holds what is not read.
            socket.set_recv_buffer_size(4096)?;
        }
        socket.bind((self.from, 0).into())?;
        timeout(self.hold, socket.connect(self.address)).await?
    }
}

/// Where the attack goes to.
struct Target {
    address: SocketAddr,
    client: reqwest::Client,
}

impl Target {
    #[expect(clippy::too_many_lines, reason = "one attack after another")]
    async fn prepare(&self, attack: Attack, size: Size) -> Result<(usize, Answers, Vec<Message>), Failure> {
        use Answers::{Read, Unread};
        let at_once = |first: Vec<u8>| Message { first, ..Message::default() };
        let socket = |frames: &[u8]| at_once([upgrade(&self.host(), "").as_slice(), frames].concat());
        Ok(match attack {
            Attack::PingFlood => {
                let then = frame(0x89, &[b'x'; 125]).repeat(64);
                let n_times = 16 * size.n_bytes / then.len();
                (8, Unread, vec![Message { then, n_times, ..socket(&[]) }])
            }
            Attack::WideBatch => {
                self.put("line", &line(size.n_states)).await?;
                let items = vec![json!({"demonstration": [{}, {"end": 1}]}); 300];
                (2, Read, vec![at_once(self.post("/v1/policies:batch", &json!({"model": "line", "items": items})))])
            }
            Attack::UnreadList => {
                const LABEL_BYTES: usize = 1 << 10;
                const N_LABELS: usize = 1 << 10;
                for n in 0..size.n_bytes / (2 * LABEL_BYTES * N_LABELS) {
                    self.put(&format!("labels-{n}"), &labels(N_LABELS, LABEL_BYTES)).await?;
                }
                (10, Unread, vec![at_once(self.get("/v1/models?limit=1000"))])
            }
            Attack::UnreadPolicy => {
                self.put("line", &line(size.n_states)).await?;
                let request = json!({"model": "line", "demonstration": [{}, {"end": 1}]});
                let answer =
                    self.client.post(format!("http://{}/v1/policies", self.address)).json(&request).send().await?;
                let policy: Value = answer.error_for_status()?.json().await?;
                let path = format!("/v1/policies/{}", policy["id"].as_str().unwrap_or_default());
                (20, Unread, vec![at_once(self.get(&path))])
            }
            Attack::ForeignOrigin => {
                let (host, foreign) = (self.host(), "origin: http://elsewhere.example\r\n");
                let open = json!({"type": "open", "model": "figure-4"}).to_string();
                let post =
                    |path: &str, headers: &str, body: &str| request("POST", path, &host, headers, body.as_bytes());
                let messages = vec![
                    at_once(post("/v1/stream", &format!("{foreign}content-type: text/plain\r\n"), &open)),
                    at_once(post("/v1/stream", "content-type: text/plain\r\n", &open)),
                    at_once(upgrade(&host, foreign)),
                    at_once(post("/v1/learners/gold/learn", foreign, "")),
                    at_once(post("/v1/policies", &format!("{foreign}{JSON}"), "{}")),
                    at_once(request("GET", "/v1/models", "elsewhere.example", "", b"")),
                    at_once(request("DELETE", "/v1/models/none", "elsewhere.example", "", b"")),
                    at_once(upgrade("elsewhere.example", "")),
                ];
                (8, Read, messages)
            }
            Attack::Lookahead => {
                let World { demonstration, .. } = self.put_table(size.n_states, size.n_observations).await?;
                let request = json!({"model": "table", "demonstration": demonstration, "lookahead": 1});
                (4, Read, vec![at_once(self.post("/v1/policies", &request))])
            }
            Attack::HugeCave => {
                let cells = |y: usize| (1..65).map(|x| json!([x * 15, y])).collect::<Vec<_>>();
                let (wumpi, gold) = (cells(500), cells(700));
                let dynamics = json!({"kind": "wumpus", "width": 1000, "height": 1000, "wumpi": wumpi, "gold": gold});
                let cave = json!({"dynamics": dynamics}).to_string();
                (2, Read, vec![at_once(request("PUT", "/v1/models/huge", &self.host(), JSON, cave.as_bytes()))])
            }
            Attack::ColdModels => {
                let names: Vec<String> = (0..4).map(|n| format!("cold-{n}")).collect();
                for name in &names {
                    self.put(name, &line(size.n_cold)).await?;
                }
                let demonstration = [json!({}), json!({"end": 1})];
                let ask = |name: &String| json!({"model": name, "demonstration": demonstration, "deadline_ms": 50});
                (4, Read, names.iter().map(|name| at_once(self.post("/v1/policies", &ask(name)))).collect())
            }
            Attack::HardSearches => {
                let World { demonstration, .. } = self.put_table(size.n_states, 2000).await?;
                let request = json!({"model": "table", "demonstration": demonstration});
                (64, Read, vec![at_once(self.post("/v1/policies", &request))])
            }
            Attack::SlowBodies => (50, Read, vec![slowly(&self.announce("POST", "/v1/policies", JSON, 1000), b"{")]),
            Attack::SlowTypes => {
                let types = ["content-type: text/plain\r\n", "", "content-encoding: br\r\n"];
                let heads = types.map(|headers| self.announce("PUT", "/v1/models/slow", headers, 1_100_000));
                (50, Read, heads.map(|head| slowly(&head, b"{")).into())
            }
            Attack::SlowUploads => {
                let head = self.announce("PUT", "/v1/models/slow", JSON, 1_100_000);
                (10, Read, vec![slowly(&[head.as_slice(), b"{", " ".repeat(1_060_000).as_bytes()].concat(), b" ")])
            }
            Attack::Announced => {
                let paths = [("POST", "/v1/policies"), ("PUT", "/v1/models/announced"), ("POST", "/v1/policies:batch")];
                let announced = paths.map(|(method, path)| self.announce(method, path, JSON, 8 << 20));
                // Fewer than one client may have connections where there is little memory.
                (700, Unread, announced.map(|head| Message { n_times: 2, pause: MOMENT, ..slowly(&head, b"{") }).into())
            }
            Attack::Idle => (500, Unread, vec![Message::default(), at_once(b"GET /readyz HTT".to_vec())]),
            Attack::HalfOpen => {
                let open = json!({"type": "open", "model": "figure-4"}).to_string();
                (200, Unread, vec![socket(&[]), socket(&frame(0x81, open.as_bytes()))])
            }
            Attack::UnreadStream => {
                let n_frames = size.n_observations * 5 / 1000;
                let frames = (0..n_frames).map(|n| observing(n * 1000, 1000)).collect::<String>();
                let end = json!({"type": "end", "seq": n_frames * 1000});
                let lines = format!("{}\n{frames}{end}\n", json!({"type": "open", "model": "figure-4"}));
                (8, Unread, vec![at_once(request("POST", "/v1/stream", &self.host(), LINES, lines.as_bytes()))])
            }
            Attack::QueuedFrames => {
                // A frame's limit is 262,144 bytes. The first keeps the session busy while the others come.
                let open = json!({"type": "open", "model": "figure-4", "lookahead": 1}).to_string();
                let first = [frame(0x81, open.as_bytes()), frame(0x81, observing(0, 9_300).as_bytes())].concat();
                let then = frame(0x81, format!("{}{}", observing(0, 1), " ".repeat(262_000)).as_bytes());
                let n_times = size.n_bytes / then.len();
                (16, Unread, vec![Message { then, n_times, ..socket(&first) }])
            }
            Attack::MalformedFrames => {
                let text = |text: &str| frame(0x81, text.as_bytes());
                let frames = [
                    frame(0xf1, b"{}"),                                              // bits that mean nothing
                    frame(0x80, b"{}"),                                              // goes on with nothing
                    frame(0x09, b"x"),                                               // a ping in pieces
                    frame(0x89, &[b'x'; 126]),                                       // a ping that is too long
                    frame(0x88, &[0x03, 0xed]),                                      // a code that nobody may send
                    frame(0x81, &[0xff, 0xfe]),                                      // no UTF-8
                    b"\x81\x02{}".to_vec(),                                          // without a mask
                    [b"\x81\xff".as_slice(), &[0x7f; 8], &[0; 4]].concat(),          // of 2^63 bytes
                    [frame(0x01, b"{"), frame(0x81, b"}")].concat(),                 // a message within another
                    [frame(0x01, b" "), frame(0x00, b" ").repeat(300_000)].concat(), // pieces without an end
                    text("{"),
                    text(&"[".repeat(200_000)),
                    text(r#"{"type":"observe","seq":18446744073709551616,"states":[]}"#),
                    text(r#"{"type":"reward","reward":1e999}"#),
                    text(r#"{"type":"open","model":"figure-4","lookahead":18446744073709551615}"#),
                ];
                let lines = request("POST", "/v1/stream", &self.host(), LINES, &b"{".repeat(300_000));
                (16, Read, frames.iter().map(|frames| socket(frames)).chain([at_once(lines)]).collect())
            }
            Attack::Bombs => {
                let (blank, string) = (bomb(b"", b' ', size.n_bytes)?, bomb(b"{\"", b'a', size.n_bytes)?);
                let deep = bomb(b"{\"attributes\":", b'[', size.n_bytes)?;
                let headers = format!("{JSON}content-encoding: gzip\r\n");
                let (put, post) = (("PUT", "/v1/models/bomb"), ("POST", "/v1/policies"));
                let sent = [(put, &blank), (put, &string), (put, &deep), (post, &string)];
                let send = |((method, path), bomb): ((&str, &str), &Vec<u8>)| {
                    at_once(request(method, path, &self.host(), &headers, bomb))
                };
                (16, Read, sent.map(send).into())
            }
            Attack::SparseDemonstrations => {
                self.put("wide", &wide()).await?;
                let long = vec![json!({}); 10 * size.n_observations];
                let single = json!({"model": "wide", "demonstration": long});
                let one = json!({"model": "wide", "items": [{"demonstration": long}]});
                let items: Vec<_> = long.chunks(100).map(|chunk| json!({"demonstration": chunk})).collect();
                let many = json!({"model": "wide", "items": items});
                let messages = [("/v1/policies", single), ("/v1/policies:batch", one), ("/v1/policies:batch", many)];
                (12, Read, messages.map(|(path, body)| at_once(self.post(path, &body))).into())
            }
            Attack::LongSessions => {
                const N_SESSIONS: usize = 8;
                const N_STATES: usize = 200;
                self.put("wide", &wide()).await?;
                let n_frames = size.n_observations / N_STATES;
                let states = vec![json!({}); N_STATES];
                let frames = (0..n_frames).map(|n| json!({"type": "observe", "seq": n * N_STATES, "states": states}));
                let open = json!({"type": "open", "model": "wide"});
                let lines = std::iter::once(open).chain(frames).flat_map(|frame| [frame.to_string(), "\n".to_owned()]);
                let lines: String = lines.collect();
                let mut messages = Vec::new();
                for _ in 0..N_SESSIONS {
                    let session = self.begin(lines.clone()).await?;
                    let resume = json!({"type": "resume", "session": session});
                    let end = json!({"type": "end", "seq": n_frames * N_STATES});
                    let lines = format!("{resume}\n{end}\n");
                    messages.push(at_once(request("POST", "/v1/stream", &self.host(), LINES, lines.as_bytes())));
                }
                (N_SESSIONS, Read, messages)
            }
            Attack::LargePolicy => {
                /// Of a larger one, the policy is larger than it may be.
                const MAX_OBSERVATIONS: usize = 20_000;
                self.put("wide", &wide()).await?;
                let n_observations = MAX_OBSERVATIONS.min(2 * size.n_observations);
                let path = self.make_policy(&vec![json!({}); n_observations]).await?;
                (60, Read, vec![at_once(self.get(&path))])
            }
            Attack::LargeFrames => {
                let open = json!({"type": "open", "model": "figure-4", "lookahead": 1}).to_string();
                let large = format!("{}{}", observing(0, 1), " ".repeat(250_000));
                let frames = [open, large].map(|text| frame(0x81, text.as_bytes())).concat();
                // Fewer than one client may have streams where there is little memory.
                (190, Unread, vec![socket(&frames)])
            }
            Attack::ComputingStreams => {
                let World { demonstration, .. } = self.put_table(size.n_states, size.n_observations).await?;
                // About as far as a small memory allows.
                let lookahead = 2_000_000 / size.n_states;
                let open = json!({"type": "open", "model": "table", "lookahead": lookahead}).to_string();
                let states = demonstration.as_array().ok_or("a demonstration is a list")?;
                let observe = |(n, states): (usize, &[Value])| {
                    json!({"type": "observe", "seq": n * STATES_PER_FRAME, "states": states}).to_string()
                };
                let observing = states.chunks(STATES_PER_FRAME).enumerate().map(observe);
                let frames: Vec<u8> =
                    std::iter::once(open).chain(observing).flat_map(|text| frame(0x81, text.as_bytes())).collect();
                (64, Read, vec![socket(&frames)])
            }
            Attack::ColdAgain => {
                let names: Vec<String> = (0..4).map(|n| format!("again-{n}")).collect();
                for name in &names {
                    self.put(name, &line(size.n_cold)).await?;
                }
                let demonstration = [json!({}), json!({"end": 1})];
                let ask = |name: &String| {
                    let request = json!({"model": name, "demonstration": demonstration, "deadline_ms": 1}).to_string();
                    let head = head("POST", "/v1/policies", &self.host(), JSON, request.len());
                    let then = (head.replace("connection: close\r\n", "") + &request).into_bytes();
                    Message { then, n_times: 1000, ..Message::default() }
                };
                (64, Unread, names.iter().map(ask).collect())
            }
        })
    }

    fn host(&self) -> String {
        self.address.to_string()
    }

    /// Begins a session with these frames. Gives its id.
    async fn begin(&self, lines: String) -> Result<String, Failure> {
        let post = self.client.post(format!("http://{}/v1/stream", self.address));
        let answer = post.header("content-type", "application/x-ndjson").body(lines).send().await?;
        let answer = answer.error_for_status()?.text().await?;
        let mut frames = answer.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        let opened = frames.find(|frame| frame["type"] == "opened").ok_or("no session")?;
        Ok(opened["session"].as_str().unwrap_or_default().to_owned())
    }

    /// Makes a policy of the model `wide`. Gives its path.
    async fn make_policy(&self, demonstration: &[Value]) -> Result<String, Failure> {
        let request = json!({"model": "wide", "demonstration": demonstration});
        let answer = self.client.post(format!("http://{}/v1/policies", self.address)).json(&request).send().await?;
        let policy: Value = answer.error_for_status()?.json().await?;
        Ok(format!("/v1/policies/{}", policy["id"].as_str().unwrap_or_default()))
    }

    fn get(&self, path: &str) -> Vec<u8> {
        request("GET", path, &self.host(), "", b"")
    }

    fn post(&self, path: &str, body: &Value) -> Vec<u8> {
        request("POST", path, &self.host(), JSON, body.to_string().as_bytes())
    }

    /// The head of a request whose body would have so many bytes.
    fn announce(&self, method: &str, path: &str, headers: &str, n_bytes: usize) -> Vec<u8> {
        head(method, path, &self.host(), headers, n_bytes).into_bytes()
    }

    /// Registers a random table as `table`.
    async fn put_table(&self, n_states: usize, n_observations: usize) -> Result<World, Failure> {
        let world = table::table(n_states, n_observations, 1);
        let put = self.put_as("table", "application/json", &world.model.to_string()).await;
        put.map(|()| world)
    }

    async fn put(&self, name: &str, lines: &str) -> Result<(), Failure> {
        self.put_as(name, "application/x-ndjson", lines).await
    }

    async fn put_as(&self, name: &str, content_type: &str, text: &str) -> Result<(), Failure> {
        let put = self.client.put(format!("http://{}/v1/models/{name}", self.address));
        let put = put.header("content-type", content_type).header("content-encoding", "zstd");
        let answer = put.body(zstd::encode_all(text.as_bytes(), 1)?).send().await?;
        let status = answer.status();
        if status.is_success() { Ok(()) } else { Err(format!("{name}: {status}: {}", answer.text().await?).into()) }
    }
}

/// Observations in a frame.
const STATES_PER_FRAME: usize = 1000;

/// Between the bytes of a body that does not go on.
const MOMENT: Duration = Duration::from_millis(50);

const JSON: &str = "content-type: application/json\r\n";

const LINES: &str = "content-type: application/x-ndjson\r\n";

fn head(method: &str, path: &str, host: &str, headers: &str, n_bytes: usize) -> String {
    format!(
        "{method} {path} HTTP/1.1\r\nhost: {host}\r\nconnection: close\r\n{headers}content-length: {n_bytes}\r\n\r\n"
    )
}

fn request(method: &str, path: &str, host: &str, headers: &str, body: &[u8]) -> Vec<u8> {
    [head(method, path, host, headers, body.len()).as_bytes(), body].concat()
}

/// What opens a websocket.
fn upgrade(host: &str, headers: &str) -> Vec<u8> {
    format!(
        "GET /v1/stream HTTP/1.1\r\nhost: {host}\r\nconnection: upgrade\r\nupgrade: websocket\r\n{headers}\
         sec-websocket-version: 13\r\nsec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
         sec-websocket-protocol: etude.v1+json\r\n\r\n"
    )
    .into_bytes()
}

/// A frame of a websocket, masked with zeros, so that it stays as it is.
fn frame(first: u8, payload: &[u8]) -> Vec<u8> {
    let length = match (u8::try_from(payload.len()), u16::try_from(payload.len())) {
        (Ok(length @ ..126), _) => vec![0x80 | length],
        (_, Ok(length)) => [&[0x80 | 0x7e], length.to_be_bytes().as_slice()].concat(),
        _ => [&[0x80 | 0x7f], (payload.len() as u64).to_be_bytes().as_slice()].concat(),
    };
    [&[first], length.as_slice(), &[0; 4], payload].concat()
}

/// A byte a second, for an hour.
fn slowly(first: &[u8], then: &[u8]) -> Message {
    Message { first: first.to_vec(), then: then.to_vec(), n_times: 3600, pause: Duration::from_secs(1) }
}

/// So many observations from `seq` on, back and forth, as a line.
fn observing(seq: usize, n: usize) -> String {
    let states: Vec<String> = (seq..seq + n).map(|n| format!("{{\"x\":{},\"y\":{}}}", n / 3 % 7, n % 4)).collect();
    format!("{{\"type\":\"observe\",\"seq\":{seq},\"states\":[{}]}}\n", states.join(","))
}

/// A line of states, only the last of which differs from the others in what is observed: whoever saw it goes all the way.
fn line(n_states: usize) -> String {
    let attributes =
        json!([{"name": "x", "kind": "number", "weight": 0}, {"name": "end", "kind": "number", "weight": 1e9}]);
    let head = json!({"attributes": attributes, "actions": [{"name": "on", "cost": 0.3}], "dynamics": {"kind": "table", "start": 0}});
    let mut text = format!("{head}\n");
    for state in 0..n_states {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{{\"states\":[[{state},{}]]}}", u8::from(state + 1 == n_states));
    }
    for state in 1..n_states {
        let _ = writeln!(text, "{{\"transitions\":[[{},\"on\",{state}]]}}", state - 1);
    }
    text
}

/// A model of one state that has many attributes.
fn wide() -> String {
    const N_ATTRIBUTES: usize = 256;
    let attribute = |n: usize| json!({"name": n.to_string(), "kind": "number"});
    let attributes: Vec<_> = (0..N_ATTRIBUTES).map(attribute).collect();
    let head = json!({"attributes": attributes, "actions": [], "dynamics": {"kind": "table", "start": 0}});
    format!("{head}\n{{\"states\":[{}],\"transitions\":[]}}\n", json!(vec![0; N_ATTRIBUTES]))
}

/// A model of one state that is described at length.
fn labels(n_labels: usize, n_bytes: usize) -> String {
    let labels: Vec<String> = (0..n_labels).map(|n| format!("{n:0>n_bytes$}")).collect();
    let attributes = json!([{"name": "label", "kind": "cyclic", "labels": labels}]);
    let head =
        json!({"attributes": attributes, "actions": [{"name": "on"}], "dynamics": {"kind": "table", "start": 0}});
    format!("{head}\n{{\"states\":[[{}]],\"transitions\":[]}}\n", json!(labels[0]))
}

/// Much of the same, compressed: a member of gzip for what is first, and as many as it takes for a MiB of the rest.
fn bomb(first: &[u8], then: u8, n_bytes: usize) -> io::Result<Vec<u8>> {
    let member = |text: &[u8]| {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
        io::Write::write_all(&mut encoder, text)?;
        encoder.finish()
    };
    Ok([member(first)?, member(&vec![then; 1 << 20])?.repeat(n_bytes >> 20)].concat())
}
