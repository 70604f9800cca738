//! Policies through HTTP, beside a bare handler that parses the same body and answers as many bytes, beside the same handler with
//! nothing but the search, and the search and the store, in between, and beside what SQLite can store of policies on the same disk,
//! in one run.
//!
//! Every round measures each contender once, so that a machine that slows down slows all of them down; ratios are taken within
//! a round. Figures are medians over the rounds, and in brackets the least and the most. The service is the program itself, in a
//! process of its own; the other handlers have a runtime of their own in this one. Clients share the two's cores with them, on one
//! thread, and do no more than they must: they send bytes that were prepared before, and count those of the answer.
//!
//! This file is longer than 400 lines because contenders that are compared are read side by side.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

#[path = "worlds/mod.rs"]
mod worlds;

use std::fmt::Write as _;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderValue, StatusCode};
use axum::response::IntoResponse;
use axum::routing::post;
use etude::store::{NewPolicy, PolicyClass, Store};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Mapper, Problem, Request, Settings, Status};
use etude_core::model::{Definition, Limits, Model};
use jiff::Timestamp;
use serde_json::{Value, json};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, Row};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::task::TaskTracker;
use worlds::World;

type Failure = Box<dyn std::error::Error + Send + Sync>;

const N_ROUNDS: usize = 5;

/// How long each contender is measured in a round.
const WINDOW: Duration = Duration::from_millis(1500);

/// How long clients send before they are measured.
const WARM_UP: Duration = Duration::from_millis(200);

/// Connections that are kept open, each of which sends its next request when the one before was answered.
const CLIENTS: [usize; 4] = [1, 16, 64, 256];

/// Demonstrations of a batch.
const N_BATCH: usize = 1000;

fn main() -> Result<(), Failure> {
    let World { model, demonstration, .. } = worlds::example("figure-4");
    let request = json!({"model": "figure-4", "demonstration": demonstration}).to_string();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // The first answer tells how large answers are.
    let service = Service::start(&model, &runtime, 0)?;
    let policy = runtime.block_on(async { Client::connect(service.address).await?.send(&http(&request)).await })?;
    let stored = runtime.block_on(StoredPolicy::read(&service))?;
    drop(service);
    let n_bytes = policy.len();
    let n_stored = stored.summary.len() + stored.steps.len();
    println!("requests of {} bytes, answers of {n_bytes}, of which {n_stored} are stored", request.len());
    let bare = handler(n_bytes, async || Ok(Between::Nothing))?;
    let searching = handler(n_bytes, async || Ok(Between::Search(Searched::read(&model, &request)?)))?;
    let directory = tempfile::tempdir()?;
    let storing = handler(n_bytes, async || {
        let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await?;
        Ok(Between::SearchAndStore(Searched::read(&model, &request)?, Box::new((store, stored.clone()))))
    })?;

    let mut table = Table::default();
    for _ in 0..N_ROUNDS {
        let service = Service::start(&model, &runtime, 0)?;
        for n_clients in CLIENTS {
            let (bare, _) = runtime.block_on(throughput(bare, &request, n_clients))?;
            let (searching, _) = runtime.block_on(throughput(searching, &request, n_clients))?;
            let (storing, _) = runtime.block_on(throughput(storing, &request, n_clients))?;
            let before = service.processor_time()?;
            let (etude, n_answered) = runtime.block_on(throughput(service.address, &request, n_clients))?;
            let processor_time = service.processor_time()?.saturating_sub(before);
            table.note(format!("bare handler, {n_clients} clients"), bare);
            table.note(format!("policies, {n_clients} clients"), etude);
            table.note(format!("  as a part of the bare handler, {n_clients} clients"), etude / bare);
            table.note(format!("  of the bare handler that searches, {n_clients} clients"), etude / searching);
            table.note(format!("  of the bare handler that searches and stores, {n_clients} clients"), etude / storing);
            table.note(format!("  the bare handler that searches, of the bare, {n_clients} clients"), searching / bare);
            table.note(format!("  and that searches and stores, of the bare, {n_clients} clients"), storing / bare);
            table.note(
                format!("  processor time of each, us, {n_clients} clients"),
                1e6 / rate(n_answered, processor_time),
            );
        }
        drop(service);
        for n_rows in [1, 16, 64] {
            let inserted = runtime.block_on(inserts(&stored, n_rows))?;
            table.note(format!("SQLite alone, {n_rows} policies a transaction"), inserted);
        }
        for n_threads in [1, 2] {
            let service = Service::start(&model, &runtime, n_threads)?;
            let single = runtime.block_on(singles(service.address, &request))?;
            let batch = runtime.block_on(batch(service.address, &demonstration))?;
            table.note(format!("{N_BATCH} single requests, {n_threads} search threads"), single);
            table.note(format!("a batch of {N_BATCH}, {n_threads} search threads"), batch);
            table.note(format!("  as a multiple of single requests, {n_threads} search threads"), batch / single);
        }
    }
    table.print();
    Ok(())
}

/// Figures by what they are of, in the order in which they were first noted.
#[derive(Default)]
struct Table(Vec<(String, Vec<f64>)>);

impl Table {
    fn note(&mut self, name: String, figure: f64) {
        match self.0.iter_mut().find(|(known, _)| *known == name) {
            Some((_, figures)) => figures.push(figure),
            None => self.0.push((name, vec![figure])),
        }
    }

    fn print(self) {
        for (name, mut figures) in self.0 {
            figures.sort_unstable_by(f64::total_cmp);
            let (least, median, most) = (figures[0], figures[figures.len() / 2], figures[figures.len() - 1]);
            let n_decimals = if name.starts_with(' ') { 2 } else { 0 };
            println!("{name:<56} {median:>9.n_decimals$} [{least:.n_decimals$} .. {most:.n_decimals$}]");
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are small")]
fn rate(count: usize, elapsed: Duration) -> f64 {
    count as f64 / elapsed.as_secs_f64()
}

/// What a handler does between parsing its body and answering.
enum Between {
    /// Nothing.
    Nothing,
    /// It searches for the policy.
    Search(Searched),
    /// It searches for the policy, and has as many bytes of it stored as the service has, durably.
    SearchAndStore(Searched, Box<(Store, StoredPolicy)>),
}

/// A problem that is read already, and what searches it.
struct Searched {
    mapper: &'static Mapper,
    problem: Problem<'static>,
}

impl Searched {
    /// The problem of a request, of which the body is given.
    fn read(model: &Value, request: &str) -> Result<Self, Failure> {
        let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).map_err(|_| "no model")?;
        let model =
            Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).map_err(|_| "too large a model")?;
        let mapper = Mapper::new(model, &mut Uninterrupted).map_err(|_| "interrupted")?;
        // Lasts as long as the handler, which lasts as long as the process.
        let mapper: &'static Mapper = Box::leak(Box::new(mapper));
        let request = serde_json::from_str(request)?;
        let mut faults = Faults::default();
        let object = Place::root(&request).object(Request::FIELDS, &mut faults);
        let read = object.and_then(|object| Request::read(mapper.model(), &object, &mut faults));
        Ok(Self { mapper, problem: read.ok_or("no request")?.problem })
    }

    fn search(&self) -> bool {
        self.mapper.map(&self.problem, Settings::default(), &mut Uninterrupted).is_ok()
    }
}

impl Between {
    /// Whether it was done.
    async fn run(&self) -> bool {
        match self {
            Self::Nothing => true,
            Self::Search(searched) => searched.search(),
            Self::SearchAndStore(searched, stored) => {
                let (store, StoredPolicy { summary, steps }) = &**stored;
                let (id, created_at) = (uuid::Uuid::now_v7().to_string(), Timestamp::now());
                let class = PolicyClass { model: "m".to_owned(), learner: None, status: Status::Optimal };
                let policy = NewPolicy { id, class, summary: summary.clone(), steps: steps.clone(), created_at };
                searched.search() && store.add_policies(vec![policy], Vec::new()).await.is_ok()
            }
        }
    }
}

/// A handler that parses its body, does what is to be done `between`, and answers `n_bytes`, on a runtime that lasts as long as the
/// process.
fn handler(n_bytes: usize, between: impl AsyncFnOnce() -> Result<Between, Failure>) -> Result<SocketAddr, Failure> {
    let runtime = tokio::runtime::Runtime::new()?;
    let between = Arc::new(runtime.block_on(between())?);
    let answer = Bytes::from("x".repeat(n_bytes));
    let handler = move |body: Bytes| {
        let (answer, between) = (answer.clone(), Arc::clone(&between));
        async move {
            let parsed = serde_json::from_slice::<Value>(&body);
            if parsed.is_ok_and(|parsed| parsed["demonstration"].is_array()) && between.run().await {
                let content_type = HeaderValue::from_static("application/json");
                (StatusCode::CREATED, [(CONTENT_TYPE, content_type)], answer).into_response()
            } else {
                StatusCode::BAD_REQUEST.into_response()
            }
        }
    };
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0"))?;
    let address = listener.local_addr()?;
    runtime.spawn(async move {
        use axum::serve::ListenerExt;
        let listener = listener.tap_io(|stream| drop(stream.set_nodelay(true)));
        axum::serve(listener, axum::Router::new().route("/v1/policies", post(handler))).await
    });
    std::mem::forget(runtime);
    Ok(address)
}

/// A service in a process of its own, with a new database; it is killed in the end.
struct Service {
    child: Child,
    address: SocketAddr,
    directory: tempfile::TempDir,
}

impl Service {
    /// A service that knows the world's model. Its log goes nowhere, once it has told the address. As many search threads as
    /// it likes if `n_threads` is 0.
    fn start(model: &Value, runtime: &tokio::runtime::Runtime, n_threads: usize) -> Result<Self, Failure> {
        let directory = tempfile::tempdir()?;
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--search-queue", "1000", "--database"]);
        command.arg(directory.path().join("etude.db")).stderr(Stdio::piped());
        if n_threads > 0 {
            command.args(["--search-threads", &n_threads.to_string()]);
        }
        let mut child = command.spawn()?;
        let mut log = BufReader::new(child.stderr.take().ok_or("no log")?);
        let mut line = String::new();
        let address = loop {
            line.clear();
            if log.read_line(&mut line)? == 0 {
                return Err("the service did not start".into());
            }
            if let Some((_, address)) = line.split_once("http://") {
                break address.split_whitespace().next().unwrap_or_default().parse()?;
            }
        };
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
        let model = model.to_string();
        let head = format!(
            "PUT /v1/models/figure-4 HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
            model.len()
        );
        runtime.block_on(async { Client::connect(address).await?.send(format!("{head}{model}").as_bytes()).await })?;
        Ok(Self { child, address, directory })
    }

    /// How long it has kept a processor busy so far; tells more than the clock on a machine that has other work.
    fn processor_time(&self) -> Result<Duration, Failure> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.child.id()))?;
        // The name of the program, in parentheses, may hold anything.
        let fields = stat.rsplit_once(')').ok_or("no statistics")?.1;
        let ticks = fields.split_whitespace().skip(11).take(2).map(str::parse::<u32>);
        let n_ticks: u32 = ticks.sum::<Result<_, _>>()?;
        Ok(n_ticks * TICK)
    }
}

/// The unit of time in a process's statistics.
const TICK: Duration = Duration::from_millis(10);

impl Drop for Service {
    fn drop(&mut self) {
        // Already gone, if this fails.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// A request for a policy as it goes over the wire.
fn http(body: &str) -> Vec<u8> {
    http_to("/v1/policies", body)
}

fn http_to(path: &str, body: &str) -> Vec<u8> {
    let mut request = format!("POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n");
    // Writing to a string cannot fail.
    let _ = write!(request, "content-length: {}\r\n\r\n{body}", body.len());
    request.into_bytes()
}

/// Answers a second to `n_clients`, and how many there were, those before and after what was measured included.
async fn throughput(address: SocketAddr, body: &str, n_clients: usize) -> Result<(f64, usize), Failure> {
    let request: Arc<[u8]> = http(body).into();
    let mut clients = Vec::with_capacity(n_clients);
    for _ in 0..n_clients {
        clients.push(Client::connect(address).await?);
    }
    let from = Instant::now() + WARM_UP;
    let until = from + WINDOW;
    let tasks = clients.into_iter().map(|mut client| {
        let request = Arc::clone(&request);
        tokio::spawn(async move {
            let (mut n_measured, mut n_answered) = (0, 0);
            loop {
                client.round_trip(&request).await?;
                n_answered += 1;
                let now = Instant::now();
                if now >= until {
                    return Ok::<(usize, usize), Failure>((n_measured, n_answered));
                }
                n_measured += usize::from(now >= from);
            }
        })
    });
    let (mut n_measured, mut n_answered) = (0, 0);
    for task in tasks.collect::<Vec<_>>() {
        let (own_measured, own_answered) = task.await??;
        n_measured += own_measured;
        n_answered += own_answered;
    }
    Ok((rate(n_measured, WINDOW), n_answered))
}

/// Policies a second, asked for one by one by as many clients as keep the service busy.
async fn singles(address: SocketAddr, body: &str) -> Result<f64, Failure> {
    const N_CLIENTS: usize = 16;
    let request: Arc<[u8]> = http(body).into();
    let mut clients = Vec::with_capacity(N_CLIENTS);
    for _ in 0..N_CLIENTS {
        clients.push(Client::connect(address).await?);
    }
    let started = Instant::now();
    let tasks = clients.into_iter().enumerate().map(|(n, mut client)| {
        let request = Arc::clone(&request);
        tokio::spawn(async move {
            for _ in (n..N_BATCH).step_by(N_CLIENTS) {
                client.round_trip(&request).await?;
            }
            Ok::<_, Failure>(())
        })
    });
    for task in tasks.collect::<Vec<_>>() {
        task.await??;
    }
    Ok(rate(N_BATCH, started.elapsed()))
}

/// Policies a second of a single request for a batch.
async fn batch(address: SocketAddr, demonstration: &Value) -> Result<f64, Failure> {
    let items = vec![json!({"demonstration": demonstration}); N_BATCH];
    let request = http_to("/v1/policies:batch", &json!({"model": "figure-4", "items": items}).to_string());
    let mut client = Client::connect(address).await?;
    let started = Instant::now();
    client.round_trip(&request).await?;
    Ok(rate(N_BATCH, started.elapsed()))
}

/// Rows a second that SQLite stores of policies like this one, as the service stored it, `n_rows` a transaction, one statement a
/// row, as durably as the service does.
async fn inserts(stored: &StoredPolicy, n_rows: usize) -> Result<f64, Failure> {
    let directory = tempfile::tempdir()?;
    let mut connection = open(directory.path()).await?;
    sqlx::raw_sql(include_str!("../migrations/0001_schema.sql")).execute(&mut connection).await?;
    let started = Instant::now();
    let mut n_inserted = 0;
    while started.elapsed() < WINDOW {
        let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
        for _ in 0..n_rows {
            sqlx::query(
                "INSERT INTO policies (id, summary, steps, checksum, created_at_ms) VALUES ($1, $2, $3, 0, $4)",
            )
            .bind(uuid::Uuid::now_v7().to_string())
            .bind(&stored.summary)
            .bind(&stored.steps)
            .bind(1_800_000_000_000_i64)
            .execute(&mut *transaction)
            .await?;
        }
        transaction.commit().await?;
        n_inserted += n_rows;
    }
    let per_second = rate(n_inserted, started.elapsed());
    connection.close().await?;
    Ok(per_second)
}

/// What the service stores of a policy.
#[derive(Clone)]
struct StoredPolicy {
    summary: String,
    steps: Vec<u8>,
}

impl StoredPolicy {
    /// The one in the database of `service`.
    async fn read(service: &Service) -> Result<Self, Failure> {
        let options = SqliteConnectOptions::new().filename(service.directory.path().join("etude.db")).read_only(true);
        let mut connection = options.connect().await?;
        let row = sqlx::query("SELECT summary, steps FROM policies").fetch_one(&mut connection).await?;
        let stored = Self { summary: row.try_get("summary")?, steps: row.try_get("steps")? };
        connection.close().await?;
        Ok(stored)
    }
}

async fn open(directory: &Path) -> Result<sqlx::SqliteConnection, Failure> {
    let options = SqliteConnectOptions::new()
        .filename(directory.join("inserts.db"))
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .disable_statement_logging();
    Ok(options.connect().await?)
}

/// A client that does no more than it must, so that the service is what is measured.
struct Client {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Client {
    async fn connect(address: SocketAddr) -> Result<Self, Failure> {
        let stream = TcpStream::connect(address).await?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, buffer: Vec::with_capacity(64 * 1024) })
    }

    /// Sends a request and gives the body of the answer.
    async fn send(&mut self, request: &[u8]) -> Result<String, Failure> {
        let n_head = self.round_trip(request).await?;
        Ok(String::from_utf8(self.buffer[n_head..].to_vec())?)
    }

    /// Sends a request and reads its answer. Gives the length of its head.
    async fn round_trip(&mut self, request: &[u8]) -> Result<usize, Failure> {
        self.stream.write_all(request).await?;
        self.buffer.clear();
        // Where the head ends, and the answer.
        let mut ends: Option<(usize, usize)> = None;
        loop {
            if self.stream.read_buf(&mut self.buffer).await? == 0 {
                return Err("the connection was closed".into());
            }
            if ends.is_none() {
                let Some(n_head) = self.buffer.windows(4).position(|window| window == b"\r\n\r\n") else { continue };
                let head = std::str::from_utf8(&self.buffer[..n_head])?;
                if !head.starts_with("HTTP/1.1 2") {
                    return Err(String::from_utf8_lossy(&self.buffer).into());
                }
                let length = head.lines().find_map(|line| line.strip_prefix("content-length: "));
                let length: usize = length.ok_or("an answer without its length")?.parse()?;
                ends = Some((n_head + 4, n_head + 4 + length));
                self.buffer.reserve(length);
            }
            if let Some((n_head, end)) = ends
                && self.buffer.len() >= end
            {
                return Ok(n_head);
            }
        }
    }
}
