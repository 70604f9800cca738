//! Streaming: round trips beside a bare echo, beside one that does the least that a service must, and beside what the disk can do;
//! memory, and recovery. What the core takes is measured by `lookahead`.
//!
//! `cargo bench --bench stream` runs all of it, `cargo bench --bench stream -- round-trips memory many recovery` the parts named.
//! Rounds of what is compared are interleaved, so that a machine that slows down slows all of them down. Client and
//! service share the machine. Figures are medians, and in brackets the least and the most.
//!
//! This file is longer than 400 lines because its parts share what they measure.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

mod worlds;

use std::io::{BufRead, BufReader, Read, Write};
use std::num::NonZeroU32;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{State, WebSocketUpgrade};
use axum::routing::get;
use etude_core::attribute::Value as AttributeValue;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Mapper, OnlineMapping};
use etude_core::model::{Definition, Limits, Model};
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use sqlx::Connection;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, oneshot};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};
use worlds::World;

type Failure = Box<dyn std::error::Error + Send + Sync>;

const N_ROUNDS: usize = 5;

/// How long a round of round trips takes.
const ROUND: Duration = Duration::from_millis(500);

fn main() -> Result<(), Failure> {
    let parts: Vec<String> = std::env::args().skip(1).filter(|part| !part.starts_with('-')).collect();
    let is_wanted = |name: &str| parts.is_empty() || parts.iter().any(|part| part == name);
    tokio::runtime::Runtime::new()?.block_on(async {
        if parts.first().is_some_and(|part| part == SERVE_ECHO) {
            return serve_echo(parts.get(1).map(String::as_str)).await;
        }
        if is_wanted("round-trips") {
            for world in [CORRIDOR, FIGURE_4].map(world) {
                for n_connections in [1, 100] {
                    round_trips(&world, n_connections).await?;
                }
            }
        }
        if is_wanted("memory") {
            memory(1000, 0, Load::Idle).await?;
            memory(200, 20, Load::Idle).await?;
            memory(200, 20, Load::Busy).await?;
        }
        if is_wanted("many") {
            many(4096, 200).await?;
        }
        if is_wanted("recovery") {
            for world in [worlds::example("figure-4"), worlds::cave(20, 5, 50, 1)] {
                recovery(&world, 100_000).await?;
            }
        }
        Ok(())
    })
}

fn mapper(world: &World) -> Result<Arc<Mapper>, Failure> {
    let definition =
        Definition::read(&world.model, Limits::DEFAULT, &mut Uninterrupted).map_err(|error| error.to_string())?;
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).map_err(|_| "too large")?;
    Ok(Arc::new(Mapper::new(model, &mut Uninterrupted).map_err(|_| "interrupted")?))
}

/// A service in a process of its own; it is killed in the end.
struct Service {
    child: Child,
    address: String,
    directory: Arc<tempfile::TempDir>,
}

impl Service {
    async fn start(world: &World) -> Result<Self, Failure> {
        let service = Self::start_in(Arc::new(tempfile::tempdir()?))?;
        let client = reqwest::Client::builder().no_proxy().build()?;
        let url = format!("http://{}/v1/models/m", service.address);
        client.put(url).json(&world.model).send().await?.error_for_status()?;
        Ok(service)
    }

    fn start_in(directory: Arc<tempfile::TempDir>) -> Result<Self, Failure> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--log-format", "text", "--database"]);
        // One client, as all are here, may have half of the streams.
        command
            .arg(directory.path().join("bench.db"))
            .args(["--max-streams", "16384", "--max-connections", "16384"])
            .stderr(Stdio::piped());
        let mut child = command.spawn()?;
        let mut lines = BufReader::new(child.stderr.take().ok_or("no log")?).lines().map_while(Result::ok);
        let listening = lines.find(|line| line.contains("listening on http://")).ok_or("it did not start")?;
        let address = listening.split("http://").nth(1).unwrap_or_default();
        let address = address.split(['"', ' ']).next().unwrap_or_default().to_owned();
        std::thread::spawn(move || lines.for_each(drop));
        Ok(Self { child, address, directory })
    }

    /// User and system time it has taken so far, in seconds.
    fn cpu_s(&self) -> Result<f64, Failure> {
        /// Of the clock that Linux shows these times by.
        const TICKS_PER_SECOND: f64 = 100.0;
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        // The name of the program, in parentheses, may have blanks.
        let (_, fields) = stat.rsplit_once(") ").ok_or("no name")?;
        let ticks: Result<Vec<f64>, _> = fields.split(' ').skip(11).take(2).map(str::parse).collect();
        Ok(ticks?.iter().sum::<f64>() / TICKS_PER_SECOND)
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
    /// How many messages have come.
    n_messages: usize,
    /// Their texts.
    states: Arc<Vec<String>>,
}

impl Stream {
    async fn open(address: &str, states: &Arc<Vec<String>>) -> Result<Self, Failure> {
        let (mut socket, _) = tokio_tungstenite::connect_async(format!("ws://{address}/v1/stream")).await?;
        socket.send(Message::text(json!({"type": "open", "model": "m"}).to_string())).await?;
        for _ in ["hello", "opened"] {
            socket.next().await.ok_or("closed")??;
        }
        Ok(Self { socket, n_sent: 0, n_messages: 0, states: Arc::clone(states) })
    }

    /// Sends the next observation, and waits until it was received; steps that were committed come before or after.
    async fn round_trip(&mut self) -> Result<(), Failure> {
        let state = &self.states[self.n_sent % self.states.len()];
        let frame = format!(r#"{{"type":"observe","seq":{},"states":[{state}]}}"#, self.n_sent);
        self.socket.send(Message::text(frame)).await?;
        self.n_sent += 1;
        loop {
            let message = self.socket.next().await.ok_or("closed")??;
            self.n_messages += 1;
            if message.to_text()?.starts_with(r#"{"type":"received""#) {
                return Ok(());
            }
        }
    }
}

/// What a service cannot do without: it keeps what comes, and searches.
struct Least {
    mapper: Arc<Mapper>,
    observations: Vec<Vec<Option<AttributeValue>>>,
    keeper: mpsc::Sender<oneshot::Sender<()>>,
}

impl Least {
    /// For `world`, with a writer that takes what waits into one commit, as a row.
    async fn start(world: &World) -> Result<Self, Failure> {
        const MOST_AT_ONCE: usize = 256;
        let mapper = mapper(world)?;
        let schema = mapper.model().schema();
        let read = |state| schema.read_observation(&Place::root(state), &mut Faults::default()).ok_or("faults");
        let observations = world.demonstration.as_array().into_iter().flatten().map(read).collect::<Result<_, _>>()?;
        let (mut connection, directory) = rows().await?;
        let (keeper, mut waiting) = mpsc::channel::<oneshot::Sender<()>>(2 * MOST_AT_ONCE);
        tokio::spawn(async move {
            let (_directory, mut group) = (directory, Vec::new());
            while waiting.recv_many(&mut group, MOST_AT_ONCE).await > 0 {
                let row = LINE.repeat(group.len());
                let insert = sqlx::query("INSERT INTO t (observation) VALUES ($1)").bind(row);
                insert.execute(&mut connection).await.expect("a row can be written");
                for kept in group.drain(..) {
                    // Whoever is gone does not want to know.
                    let _ = kept.send(());
                }
                tokio::task::yield_now().await;
            }
        });
        Ok(Self { mapper, observations, keeper })
    }

    /// Returns once a line is on disk.
    async fn keep(&self) -> Option<()> {
        let (kept, is_kept) = oneshot::channel();
        self.keeper.send(kept).await.ok()?;
        is_kept.await.ok()
    }
}

/// Sends each message back as often as its first digit says, in one write; if it is to do the least that a service does, once that is done.
async fn echo(State(least): State<Option<Arc<Least>>>, upgrade: WebSocketUpgrade) -> axum::response::Response {
    upgrade.on_upgrade(async move |mut socket| {
        let mut followed = least.as_deref().map(|Least { mapper, observations, .. }| {
            let weights = mapper.model().schema().weights();
            let online = OnlineMapping::new(mapper, weights, Conditions::default(), NonZeroU32::new(8));
            (online, observations.iter().cycle())
        });
        while let Some(Ok(message)) = socket.recv().await {
            if let (Some(least), Some((online, observations))) = (&least, &mut followed) {
                let steps = observations.next().map(|next| online.observe(next, None, &mut Uninterrupted).is_ok());
                if steps != Some(true) || least.keep().await.is_none() {
                    return;
                }
            }
            let digit = message.to_text().ok().and_then(|text| text.chars().next()?.to_digit(10));
            for _ in 0..digit.unwrap_or(1) {
                if socket.feed(message.clone()).await.is_err() {
                    return;
                }
            }
            if socket.flush().await.is_err() {
                return;
            }
        }
    })
}

/// A client of the echo, to which as many messages come as to one of the service.
struct Echoed {
    socket: Socket,
    /// Messages for each that is sent, as the service has sent for an observation.
    n_messages: f64,
    /// What is left of the part of a message.
    rest: f64,
}

impl Echoed {
    async fn round_trip(&mut self) -> Result<(), Failure> {
        self.rest += self.n_messages;
        let n_back = (1..9_u32).take_while(|n| f64::from(*n) <= self.rest).count().max(1);
        self.rest -= f64::from(u32::try_from(n_back)?);
        self.socket.send(Message::text(format!("{n_back}{}", "e".repeat(127)))).await?;
        for _ in 0..n_back {
            self.socket.next().await.ok_or("closed")??;
        }
        Ok(())
    }
}

/// What this program does when it is started by [`Echo::start`].
const SERVE_ECHO: &str = "serve-echo";

/// The echo, alone in a process as the service is; it ends with its standard input. With the name of a world, it does the least that a
/// service does there.
async fn serve_echo(name: Option<&str>) -> Result<(), Failure> {
    let least = match name {
        Some(name) => Some(Arc::new(Least::start(&world(name)).await?)),
        None => None,
    };
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    println!("{}", listener.local_addr()?);
    std::thread::spawn(|| {
        // Whatever comes, it is the end.
        let _ = std::io::stdin().read(&mut [0]);
        std::process::exit(0);
    });
    Ok(axum::serve(listener, axum::Router::new().route("/", get(echo)).with_state(least)).await?)
}

struct Echo {
    child: Child,
    address: String,
}

impl Echo {
    fn start(name: Option<&str>) -> Result<Self, Failure> {
        let mut command = Command::new(std::env::current_exe()?);
        let mut child = command.arg(SERVE_ECHO).args(name).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let mut address = String::new();
        BufReader::new(child.stdout.take().ok_or("no output")?).read_line(&mut address)?;
        Ok(Self { child, address: address.trim().to_owned() })
    }
}

impl Drop for Echo {
    fn drop(&mut self) {
        // It is gone already if this fails.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

const CORRIDOR: &str = "corridor";
const FIGURE_4: &str = "figure-4";

/// One of these.
fn world(name: &str) -> World {
    if name == CORRIDOR { corridor() } else { worlds::example(name) }
}

/// A line of four states: next to nothing to be mapped.
fn corridor() -> World {
    World {
        name: CORRIDOR.to_owned(),
        model: json!({
            "attributes": [{"name": "x", "kind": "number"}],
            "actions": [{"name": "forward", "cost": 1}],
            "dynamics": {
                "kind": "table", "states": [[0], [1], [2], [3]], "start": 0,
                "transitions": [[0, "forward", 1], [1, "forward", 2], [2, "forward", 3]],
            },
        }),
        demonstration: json!([{"x": 0}, {"x": 1}, {"x": 2}, {"x": 3}]),
    }
}

/// The states of a demonstration as they are sent. Written once: it is the service that is measured.
fn texts(world: &World) -> Arc<Vec<String>> {
    Arc::new(world.demonstration.as_array().into_iter().flatten().map(Value::to_string).collect())
}

/// Round trips of `n_connections` at the same time, beside what bounds them.
async fn round_trips(world: &World, n_connections: usize) -> Result<(), Failure> {
    let service = Service::start(world).await?;
    let (texts, states) = (texts(world), Arc::new(world.demonstration.as_array().cloned().unwrap_or_default()));
    let echoing = [Echo::start(None)?, Echo::start(Some(&world.name))?];
    let mapper = mapper(world)?;
    let mut streams = Vec::new();
    let mut echoes = [Vec::new(), Vec::new()];
    for _ in 0..n_connections {
        streams.push(Stream::open(&service.address, &texts).await?);
        for (echo, echoes) in echoing.iter().zip(&mut echoes) {
            let socket = tokio_tungstenite::connect_async(format!("ws://{}/", echo.address)).await?.0;
            echoes.push(Echoed { socket, n_messages: 1.0, rest: 0.0 });
        }
    }
    // By what is measured; the service comes first.
    let mut rates: [Vec<f64>; 6] = Default::default();
    let (mut cpu_us, mut n_for_each) = (Vec::new(), Vec::new());
    for _ in 0..N_ROUNDS {
        let cpu_before_s = service.cpu_s()?;
        let round = async |mut stream: Stream| -> Result<_, Failure> {
            stream.round_trip().await?;
            Ok(stream)
        };
        let (rate, back) = per_second(streams, round).await?;
        streams = back;
        rates[0].push(rate);
        let (n_messages, n_sent) = streams
            .iter()
            .fold((0, 0), |(messages, sent), stream| (messages + stream.n_messages, sent + stream.n_sent));
        let for_each = f64::from(u32::try_from(n_messages)?) / f64::from(u32::try_from(n_sent)?);
        for echoed in echoes.iter_mut().flatten() {
            echoed.n_messages = for_each;
        }
        n_for_each.push(for_each);
        cpu_us.push((service.cpu_s()? - cpu_before_s) / ROUND.as_secs_f64() / rate * 1e6);
        let round = async |mut echoed: Echoed| -> Result<_, Failure> {
            echoed.round_trip().await?;
            Ok(echoed)
        };
        for (echoes, rates) in echoes.iter_mut().zip(&mut rates[1..]) {
            let (rate, back) = per_second(std::mem::take(echoes), round).await?;
            *echoes = back;
            rates.push(rate);
        }
        rates[3].push(rows_per_second(n_connections).await?);
        let (mapper, states) = (Arc::clone(&mapper), Arc::clone(&states));
        let blocking = tokio::task::spawn_blocking(move || {
            Ok::<_, Failure>((lines_per_second(n_connections)?, observations_per_second(&mapper, &states)?))
        });
        let (lines, observations) = blocking.await??;
        rates[4].push(lines);
        rates[5].push(observations);
    }
    println!("\n{}, {n_connections} at a time: a second, and the service's as a multiple", world.name);
    let row = |name: &str, rates: &[f64], ratios: &[f64]| {
        println!(
            "{name:<44} {:>32} {:>24}",
            spread(rates, 0),
            if ratios.is_empty() { String::new() } else { spread(ratios, 2) }
        );
    };
    row("round trips of the service", &rates[0], &[]);
    let names = [
        "round trips of an echo, as many messages".to_owned(),
        "  that searches and keeps a line of each".to_owned(),
        format!("rows into SQLite, {n_connections} a commit"),
        format!("lines into a file, {n_connections} a sync"),
        "observations mapped, on one core".to_owned(),
    ];
    for (name, others) in names.iter().zip(&rates[1..]) {
        let ratios: Vec<f64> = rates[0].iter().zip(others).map(|(rate, other)| rate / other).collect();
        row(name, others, &ratios);
    }
    println!("{:<44} {:>32}", "messages of the service a round trip", spread(&n_for_each, 2));
    println!("{:<44} {:>32}", "microseconds of the service's CPU a round trip", spread(&cpu_us, 1));
    Ok(())
}

/// Median, and in brackets the least and the most.
fn spread(values: &[f64], n_decimals: usize) -> String {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let (least, median, most) = (values[0], values[values.len() / 2], values[values.len() - 1]);
    format!("{median:.n_decimals$} [{least:.n_decimals$} .. {most:.n_decimals$}]")
}

/// What the search alone takes: observations per second of a session, with the lookahead of one that names none.
fn observations_per_second(mapper: &Arc<Mapper>, states: &[Value]) -> Result<f64, Failure> {
    let schema = mapper.model().schema();
    let read = |state| schema.read_observation(&Place::root(state), &mut Faults::default()).ok_or("faults");
    let observations = states.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let mut online = OnlineMapping::new(mapper, schema.weights(), Conditions::default(), NonZeroU32::new(8));
    let started = Instant::now();
    let mut n_mapped = 0_u32;
    for observation in observations.iter().cycle() {
        std::hint::black_box(online.observe(observation, None, &mut Uninterrupted).map_err(|_| "nothing interrupts")?);
        n_mapped += 1;
        if n_mapped.is_multiple_of(64) && started.elapsed() >= ROUND / 2 {
            break;
        }
    }
    Ok(f64::from(n_mapped) / started.elapsed().as_secs_f64())
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

/// A line such as an observation that is to be kept.
const LINE: &str = r#"["01a20166-6aab-731d-84f8-704a7d58ef84",7,1,[{"x":3,"y":0,"heading":"east","gold":0,"arrows":1}],1790000000000]"#;

/// What SQLite can do: rows per second, `n_rows` a durable commit, one commit after the other. With a row each this is what bounds a single connection.
async fn rows_per_second(n_rows: usize) -> Result<f64, Failure> {
    let (mut connection, _directory) = rows().await?;
    let insert = format!("INSERT INTO t (observation) VALUES {}", vec!["($1)"; n_rows].join(", "));
    let started = Instant::now();
    let mut n_inserted = 0_u32;
    while started.elapsed() < ROUND / 2 {
        sqlx::query(sqlx::AssertSqlSafe(insert.as_str())).bind(LINE).execute(&mut connection).await?;
        n_inserted += u32::try_from(n_rows)?;
    }
    Ok(f64::from(n_inserted) / started.elapsed().as_secs_f64())
}

/// A database of rows, set up as the service sets its own up, and where it is.
async fn rows() -> Result<(sqlx::SqliteConnection, tempfile::TempDir), Failure> {
    let directory = tempfile::tempdir()?;
    let options = sqlx::sqlite::SqliteConnectOptions::new()
        .filename(directory.path().join("rows.db"))
        .create_if_missing(true)
        .journal_mode(sqlx::sqlite::SqliteJournalMode::Wal)
        .synchronous(sqlx::sqlite::SqliteSynchronous::Full);
    let mut connection = sqlx::SqliteConnection::connect_with(&options).await?;
    sqlx::query("CREATE TABLE t (n INTEGER PRIMARY KEY, observation TEXT)").execute(&mut connection).await?;
    Ok((connection, directory))
}

/// What the disk can do: lines per second appended to a bare file, `n_lines` a sync, one sync after the other.
fn lines_per_second(n_lines: usize) -> Result<f64, Failure> {
    let mut file = tempfile::tempfile()?;
    let lines = LINE.repeat(n_lines);
    let started = Instant::now();
    let mut n_written = 0_u32;
    while started.elapsed() < ROUND / 2 {
        file.write_all(lines.as_bytes())?;
        file.sync_data()?;
        n_written += u32::try_from(n_lines)?;
    }
    Ok(f64::from(n_written) / started.elapsed().as_secs_f64())
}

/// What sessions do while their memory is measured.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Load {
    /// They wait.
    Idle,
    /// Each has an observation in flight, all the time.
    Busy,
}

/// Opens sessions, each of which then sees so many observations.
async fn open_all(
    service: &Service,
    states: &Arc<Vec<String>>,
    n_sessions: usize,
    n_observations: usize,
) -> Result<Vec<Stream>, Failure> {
    let mut streams = Vec::with_capacity(n_sessions);
    for _ in 0..n_sessions {
        let mut stream = Stream::open(&service.address, states).await?;
        for _ in 0..n_observations {
            stream.round_trip().await?;
        }
        streams.push(stream);
    }
    Ok(streams)
}

/// Memory of sessions, each of which has seen `n_observations` before.
async fn memory(n_sessions: usize, n_observations: usize, load: Load) -> Result<(), Failure> {
    let world = worlds::example("figure-4");
    let service = Service::start(&world).await?;
    let states = texts(&world);
    let before = service.resident_kib()?;
    let mut streams = open_all(&service, &states, n_sessions, n_observations).await?;
    let (mut most, what) = (service.resident_kib()?, if load == Load::Busy { "busy" } else { "idle" });
    if load == Load::Busy {
        let round = async |mut stream: Stream| -> Result<_, Failure> {
            stream.round_trip().await?;
            Ok(stream)
        };
        let mut n_reads = 0;
        let busy = tokio::spawn(async move {
            let mut n_rounds = 0.0;
            for _ in 0..N_ROUNDS {
                let (rate, back) = per_second(streams, round).await?;
                n_rounds += rate * ROUND.as_secs_f64();
                streams = back;
            }
            Ok::<_, Failure>((n_rounds, streams))
        });
        while !busy.is_finished() {
            most = most.max(service.resident_kib()?);
            n_reads += 1;
            tokio::time::sleep(ROUND / 20).await;
        }
        let (n_rounds, _streams) = busy.await??;
        println!("\n{n_rounds:.0} observations by {n_sessions} sessions while memory was read {n_reads} times");
    }
    #[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
    let each = most.saturating_sub(before) as f64 / n_sessions as f64;
    println!(
        "memory of {n_sessions} {what} sessions that had each seen {n_observations} observations: at most {most} KiB \
         resident, {before} KiB before them, {each:.1} KiB each"
    );
    Ok(())
}

/// Memory of many sessions that are open at once, each of which has seen some observations, and how long an observation takes until it is
/// received while some of them are busy.
async fn many(n_sessions: usize, n_busy: usize) -> Result<(), Failure> {
    const N_SEEN: usize = 20;
    let world = worlds::cave(20, 5, 50, 1);
    let service = Service::start(&world).await?;
    let states = texts(&world);
    let before = service.resident_kib()?;
    let mut streams = open_all(&service, &states, n_sessions, N_SEEN).await?;
    let idle = service.resident_kib()?;
    let busy = streams.split_off(n_sessions - n_busy);
    let started = Instant::now();
    let tasks = busy.into_iter().map(|mut stream| {
        tokio::spawn(async move {
            let mut took_us = Vec::new();
            while started.elapsed() < 10 * ROUND {
                let sent = Instant::now();
                stream.round_trip().await?;
                took_us.push(sent.elapsed().as_micros());
            }
            Ok::<_, Failure>(took_us)
        })
    });
    let mut took_us = Vec::new();
    for task in tasks.collect::<Vec<_>>() {
        took_us.extend(task.await??);
    }
    took_us.sort_unstable();
    let at = |percent: usize| took_us[(took_us.len() - 1) * percent / 100];
    #[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
    let each = |kib: u64| kib.saturating_sub(before) as f64 / n_sessions as f64;
    println!(
        "\n{n_sessions} sessions on {}, each of which has seen {N_SEEN} observations: {:.1} KiB each, {:.1} KiB while {n_busy} of them are \
         busy, {} observations in {:?}: received after {} us (median), {} us (p99), {} us (most)",
        world.name,
        each(idle),
        each(service.resident_kib()?),
        took_us.len(),
        started.elapsed(),
        at(50),
        at(99),
        at(100)
    );
    Ok(())
}

/// How long it takes to resume a session of many observations, in a service that was killed and has just been started.
async fn recovery(world: &World, n_observations: usize) -> Result<(), Failure> {
    /// Of a frame.
    const N_AT_ONCE: usize = 100;
    let service = Service::start(world).await?;
    let states = world.demonstration.as_array().cloned().unwrap_or_default();
    let (mut socket, _) = tokio_tungstenite::connect_async(format!("ws://{}/v1/stream", service.address)).await?;
    let receive = async |socket: &mut Socket, kind: &str| -> Result<Value, Failure> {
        loop {
            let frame: Value = serde_json::from_str(socket.next().await.ok_or("closed")??.to_text()?)?;
            if frame["type"] == kind {
                return Ok(frame);
            }
        }
    };
    socket.send(Message::text(json!({"type": "open", "model": "m"}).to_string())).await?;
    let session = receive(&mut socket, "opened").await?["session"].take();
    let streaming = Instant::now();
    for seq in (0..n_observations).step_by(N_AT_ONCE) {
        let seen: Vec<&Value> = (seq..seq + N_AT_ONCE).map(|index| &states[index % states.len()]).collect();
        socket.send(Message::text(json!({"type": "observe", "seq": seq, "states": seen}).to_string())).await?;
        receive(&mut socket, "received").await?;
    }
    let streamed = streaming.elapsed();
    let directory = Arc::clone(&service.directory);
    drop(service);
    let mut took_ms = Vec::new();
    for _ in 0..N_ROUNDS {
        let service = Service::start_in(Arc::clone(&directory))?;
        let (mut socket, _) = tokio_tungstenite::connect_async(format!("ws://{}/v1/stream", service.address)).await?;
        receive(&mut socket, "hello").await?;
        let started = Instant::now();
        let resume = json!({"type": "resume", "session": session, "step": n_observations});
        socket.send(Message::text(resume.to_string())).await?;
        let opened = receive(&mut socket, "opened").await?;
        took_ms.push(started.elapsed().as_secs_f64() * 1e3);
        assert_eq!(opened["received"], n_observations);
    }
    println!(
        "\n{}: a session of {n_observations} observations, streamed in {streamed:.1?}, is resumed in a service just started in ms: {}",
        world.name,
        spread(&took_ms, 0)
    );
    Ok(())
}
