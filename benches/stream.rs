//! Streaming: the core per observation, round trips beside a bare echo, commits of the disk, and memory.
//!
//! Rounds of what is compared are interleaved, so that a machine that slows down slows all of them down. Client and
//! service share the machine. Figures are medians, and in brackets the least and the most.

#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

mod worlds;

use std::io::{BufRead, BufReader};
use std::num::NonZeroU32;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::WebSocketUpgrade;
use axum::routing::get;
use etude::document::{Faults, Place};
use etude::interrupt::Uninterrupted;
use etude::mapping::{Mapper, OnlineMapping};
use etude::model::{Definition, Limits, Model};
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use sqlx::Connection;
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};
use worlds::World;

type Failure = Box<dyn std::error::Error + Send + Sync>;

const N_ROUNDS: usize = 5;

/// How long a round of round trips takes.
const ROUND: Duration = Duration::from_millis(500);

fn main() -> Result<(), Failure> {
    println!("microseconds per observation");
    println!("{:<28} {:>9} {:>24} {:>24} {:>24}", "", "lookahead", "at 10", "at 100", "at 10,000");
    for world in [worlds::example("figure-4"), worlds::cave(20, 5, 50, 1)] {
        for lookahead in [NonZeroU32::new(8), None] {
            observe(&world, lookahead)?;
        }
    }
    tokio::runtime::Runtime::new()?.block_on(async {
        round_trips().await?;
        memory(1000, 0).await?;
        memory(200, 20).await
    })
}

/// Feeds a demonstration that goes on for 10,000 observations, and looks at windows of it.
fn observe(world: &World, lookahead: Option<NonZeroU32>) -> Result<(), Failure> {
    let definition =
        Definition::read(&world.model, Limits::DEFAULT, &mut Uninterrupted).map_err(|error| error.to_string())?;
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).map_err(|_| "too large")?;
    let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted).map_err(|_| "interrupted")?);
    let schema = mapper.model().schema();
    let states = world.demonstration.as_array().ok_or("a demonstration is an array")?;
    let read = |state| schema.read_observation(&Place::root(state), &mut Faults::default()).ok_or("faults");
    let there = states.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    // Back and forth, so that it never jumps.
    let period: Vec<_> = there.iter().chain(there.iter().rev()).collect();
    let mut online = OnlineMapping::new(Arc::clone(&mapper), schema.weights(), None, lookahead);
    let marks = [10, 100, 10_000];
    let half = 9;
    let mut windows: [Vec<Duration>; 3] = Default::default();
    for (n, observation) in period.iter().cycle().take(marks[2] + half).enumerate() {
        let started = Instant::now();
        std::hint::black_box(online.observe(observation, &mut Uninterrupted).map_err(|_| "nothing interrupts")?);
        let taken = started.elapsed();
        for (mark, window) in marks.iter().zip(&mut windows) {
            if n.abs_diff(*mark) <= half {
                window.push(taken);
            }
        }
    }
    let shown = windows.map(|mut times| {
        times.sort_unstable();
        let micros = |time: &Duration| time.as_secs_f64() * 1e6;
        let (least, median, most) =
            (micros(&times[0]), micros(&times[times.len() / 2]), micros(&times[times.len() - 1]));
        format!("{median:.0} [{least:.0} .. {most:.0}]")
    });
    let lookahead = lookahead.map_or("null".to_owned(), |lookahead| lookahead.to_string());
    println!("{:<28} {lookahead:>9} {:>24} {:>24} {:>24}", world.name, shown[0], shown[1], shown[2]);
    Ok(())
}

/// A service in a process of its own; it is killed in the end.
struct Service {
    child: Child,
    address: String,
    _directory: tempfile::TempDir,
}

impl Service {
    async fn start(world: &World) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--log-format", "text", "--database"]);
        command.arg(directory.path().join("bench.db")).stderr(Stdio::piped());
        let mut child = command.spawn()?;
        let mut lines = BufReader::new(child.stderr.take().ok_or("no log")?).lines().map_while(Result::ok);
        let listening = lines.find(|line| line.contains("listening on http://")).ok_or("it did not start")?;
        let address = listening.split("http://").nth(1).unwrap_or_default();
        let address = address.split(['"', ' ']).next().unwrap_or_default().to_owned();
        std::thread::spawn(move || lines.for_each(drop));
        let client = reqwest::Client::builder().no_proxy().build()?;
        client.put(format!("http://{address}/v1/models/m")).json(&world.model).send().await?.error_for_status()?;
        Ok(Self { child, address, _directory: directory })
    }

    /// Resident memory, in KiB.
    fn resident_kib(&self) -> Result<u64, Failure> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()))?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
        Ok(line.trim().trim_end_matches(" kB").parse()?)
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // It is gone already if this fails.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

/// A client with a session.
struct Stream {
    socket: Socket,
    n_sent: usize,
    states: Arc<Vec<Value>>,
}

impl Stream {
    async fn open(address: &str, states: &Arc<Vec<Value>>) -> Result<Self, Failure> {
        let (mut socket, _) = tokio_tungstenite::connect_async(format!("ws://{address}/v1/stream")).await?;
        socket.send(Message::text(json!({"type": "open", "model": "m"}).to_string())).await?;
        for _ in ["hello", "opened"] {
            socket.next().await.ok_or("closed")??;
        }
        Ok(Self { socket, n_sent: 0, states: Arc::clone(states) })
    }

    /// Sends the next observation, and waits until it was received; steps that were committed come before or after.
    async fn round_trip(&mut self) -> Result<(), Failure> {
        let state = &self.states[self.n_sent % self.states.len()];
        let frame = format!(r#"{{"type":"observe","seq":{},"states":[{state}]}}"#, self.n_sent);
        self.socket.send(Message::text(frame)).await?;
        self.n_sent += 1;
        loop {
            let message = self.socket.next().await.ok_or("closed")??;
            if message.to_text()?.starts_with(r#"{"type":"received""#) {
                return Ok(());
            }
        }
    }
}

async fn echo(upgrade: WebSocketUpgrade) -> axum::response::Response {
    upgrade.on_upgrade(async |mut socket| {
        while let Some(Ok(message)) = socket.recv().await {
            if socket.send(message).await.is_err() {
                return;
            }
        }
    })
}

async fn round_trips() -> Result<(), Failure> {
    let world = worlds::example("figure-4");
    let service = Service::start(&world).await?;
    let states = Arc::new(world.demonstration.as_array().cloned().unwrap_or_default());
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let echo_address = listener.local_addr()?;
    let serving = tokio::spawn(async move { axum::serve(listener, axum::Router::new().route("/", get(echo))).await });

    println!("\nround trips per second");
    println!(
        "{:<14} {:>28} {:>28} {:>28} {:>8}",
        "connections", "etude", "echo of 128 bytes", "SQLite commits", "ratio"
    );
    for n_connections in [1, 100] {
        let mut streams = Vec::new();
        let mut echoes = Vec::new();
        for _ in 0..n_connections {
            streams.push(Stream::open(&service.address, &states).await?);
            echoes.push(tokio_tungstenite::connect_async(format!("ws://{echo_address}/")).await?.0);
        }
        let (mut rates, mut echo_rates, mut commit_rates) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..N_ROUNDS {
            let round = async |mut stream: Stream| -> Result<_, Failure> {
                stream.round_trip().await?;
                Ok(stream)
            };
            let (rate, back) = per_second(streams, round).await?;
            streams = back;
            rates.push(rate);
            let round = async |mut socket: Socket| -> Result<_, Failure> {
                socket.send(Message::text("e".repeat(128))).await?;
                socket.next().await.ok_or("closed")??;
                Ok(socket)
            };
            let (rate, back) = per_second(echoes, round).await?;
            echoes = back;
            echo_rates.push(rate);
            commit_rates.push(commits_per_second().await?);
        }
        let shown = |rates: &mut Vec<f64>| {
            rates.sort_by(f64::total_cmp);
            let (least, median, most) = (rates[0], rates[rates.len() / 2], rates[rates.len() - 1]);
            (median, format!("{median:.0} [{least:.0} .. {most:.0}]"))
        };
        let (etude, etude_shown) = shown(&mut rates);
        let (echo, echo_shown) = shown(&mut echo_rates);
        let (_, commits_shown) = shown(&mut commit_rates);
        println!("{n_connections:<14} {etude_shown:>28} {echo_shown:>28} {commits_shown:>28} {:>8.2}", etude / echo);
    }
    serving.abort();
    Ok(())
}

/// Rounds per second of all clients together, each in a task of its own.
async fn per_second<C, F>(
    clients: Vec<C>,
    round: impl Fn(C) -> F + Clone + Send + 'static,
) -> Result<(f64, Vec<C>), Failure>
where
    C: Send + 'static,
    F: Future<Output = Result<C, Failure>> + Send,
{
    let started = Instant::now();
    let tasks: Vec<_> = clients
        .into_iter()
        .map(|mut client| {
            let round = round.clone();
            tokio::spawn(async move {
                let mut n_rounds = 0_u32;
                while started.elapsed() < ROUND {
                    client = round(client).await?;
                    n_rounds += 1;
                }
                Ok::<_, Failure>((n_rounds, client))
            })
        })
        .collect();
    let mut clients = Vec::new();
    let mut n_rounds = 0;
    for task in tasks {
        let (n, client) = task.await??;
        n_rounds += n;
        clients.push(client);
    }
    Ok((f64::from(n_rounds) / started.elapsed().as_secs_f64(), clients))
}

/// What bounds a single connection: durable commits, one after the other, set up as the service sets its own up.
async fn commits_per_second() -> Result<f64, Failure> {
    let directory = tempfile::tempdir()?;
    let options = sqlx::sqlite::SqliteConnectOptions::new()
        .filename(directory.path().join("commits.db"))
        .create_if_missing(true)
        .journal_mode(sqlx::sqlite::SqliteJournalMode::Wal)
        .synchronous(sqlx::sqlite::SqliteSynchronous::Full);
    let mut connection = sqlx::SqliteConnection::connect_with(&options).await?;
    sqlx::query("CREATE TABLE t (n INTEGER PRIMARY KEY, states TEXT)").execute(&mut connection).await?;
    let started = Instant::now();
    let mut n_commits = 0_u32;
    while started.elapsed() < ROUND / 2 {
        let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
        sqlx::query("INSERT INTO t (states) VALUES ('{\"x\": 1}')").execute(&mut *transaction).await?;
        transaction.commit().await?;
        n_commits += 1;
    }
    Ok(f64::from(n_commits) / started.elapsed().as_secs_f64())
}

/// Memory of sessions, each of which has seen `n_observations`.
async fn memory(n_sessions: u32, n_observations: usize) -> Result<(), Failure> {
    let world = worlds::example("figure-4");
    let service = Service::start(&world).await?;
    let states = Arc::new(world.demonstration.as_array().cloned().unwrap_or_default());
    let before = service.resident_kib()?;
    let mut streams = Vec::new();
    for _ in 0..n_sessions {
        let mut stream = Stream::open(&service.address, &states).await?;
        for _ in 0..n_observations {
            stream.round_trip().await?;
        }
        streams.push(stream);
    }
    let after = service.resident_kib()?;
    let each = f64::from(u32::try_from(after.saturating_sub(before))?) / f64::from(n_sessions);
    println!(
        "\nmemory of {n_sessions} sessions that have each seen {n_observations} observations: {after} KiB resident, \
         {before} KiB before them, {each:.1} KiB each"
    );
    Ok(())
}
