//! Durable rewards through HTTP, beside plain inserts into SQLite on the same disk, in one run.
//!
//! Every round measures each contender once, so that a machine that slows down slows all of them down. Figures are per second: the
//! median over the rounds, and in brackets the least and the most. Clients share the machine with the service; each keeps one
//! connection open and sends its next reward when the one before was answered.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

use std::net::SocketAddr;
use std::path::Path;
use std::time::Instant;

use clap::Parser;
use etude::config::ServeConfig;
use etude::server::Server;
use serde_json::{Value, json};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

const N_ROUNDS: usize = 5;
const N_INSERTS_ONE: usize = 2_000;
const N_INSERTS_HUNDRED: usize = 20_000;
const N_TRIALS: usize = 2_000;
/// Clients, and how many rewards they send together in a round.
const CLIENTS: [(usize, usize); 3] = [(1, 1_000), (16, 8_000), (64, 16_000)];

#[derive(Parser)]
struct Flags {
    #[command(flatten)]
    config: ServeConfig,
}

#[tokio::main]
async fn main() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let mut rows: Vec<(String, Vec<f64>)> = Vec::new();
    for round in 0..N_ROUNDS {
        let mut note = |name: String, per_second: f64| match rows.iter_mut().find(|(known, _)| *known == name) {
            Some((_, figures)) => figures.push(per_second),
            None => rows.push((name, vec![per_second])),
        };
        let file = directory.path().join(format!("inserts-{round}.db"));
        note("inserts, one a transaction".into(), inserts(&file, N_INSERTS_ONE, 1).await);
        note("inserts, a hundred a transaction".into(), inserts(&file, N_INSERTS_HUNDRED, 100).await);
        let service = Service::start(&directory.path().join(format!("etude-{round}.db"))).await;
        let started = Instant::now();
        let mut trials = service.draw(N_TRIALS, 16).await;
        note("trials drawn, mapped and stored, 16 clients".into(), rate(N_TRIALS, started));
        let n_rewards: usize = CLIENTS.iter().map(|(_, n_rewards)| n_rewards).sum();
        trials.extend(service.draw(n_rewards.saturating_sub(N_TRIALS), 16).await);
        for (n_clients, n_rewards) in CLIENTS {
            let batch = trials.split_off(trials.len() - n_rewards);
            note(format!("rewards, {n_clients} clients"), service.reward(&batch, n_clients).await);
        }
        service.stop().await;
    }
    for (name, mut figures) in rows {
        figures.sort_unstable_by(f64::total_cmp);
        let (least, median, most) = (figures[0], figures[N_ROUNDS / 2], figures[N_ROUNDS - 1]);
        println!("{name:<44} {median:>9.0} /s   [{least:.0} .. {most:.0}]");
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are small")]
fn rate(count: usize, started: Instant) -> f64 {
    count as f64 / started.elapsed().as_secs_f64()
}

/// Inserts rows like those of the log of rewards, one statement a row.
async fn inserts(file: &Path, n_rows: usize, per_transaction: usize) -> f64 {
    let options = SqliteConnectOptions::new()
        .filename(file)
        .create_if_missing(true)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .disable_statement_logging();
    let mut connection = sqlx::SqliteConnection::connect_with(&options).await.expect("a new database");
    let table =
        "CREATE TABLE IF NOT EXISTS rewards (trial INTEGER PRIMARY KEY, learner INTEGER, reward REAL, at INTEGER)";
    sqlx::query(table).execute(&mut connection).await.expect("a new table");
    let started = Instant::now();
    for _ in 0..n_rows / per_transaction {
        let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await.expect("a transaction");
        for _ in 0..per_transaction {
            let insert = sqlx::query("INSERT INTO rewards (learner, reward, at) VALUES ($1, $2, $3)");
            let insert = insert.bind(1_i64).bind(974.0).bind(1_800_000_000_000_i64);
            insert.execute(&mut *transaction).await.expect("an insert");
        }
        transaction.commit().await.expect("a commit");
    }
    let per_second = rate(n_rows, started);
    connection.close().await.expect("a clean end");
    per_second
}

/// A service in this process.
struct Service {
    address: SocketAddr,
    stop: tokio::sync::oneshot::Sender<()>,
    running: tokio::task::JoinHandle<()>,
}

impl Service {
    async fn start(database: &Path) -> Self {
        let database = database.to_str().expect("a plain path");
        let flags = ["etude", "--listen", "127.0.0.1:0", "--database", database, "--search-queue", "1000"];
        let server = Server::start(&Flags::parse_from(flags).config).await.expect("a service");
        let address = server.address();
        let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
        let running = tokio::spawn(async move {
            server.run(async { drop(stopped.await) }).await;
        });
        let mut client = Client::connect(address).await;
        let model: Value = serde_json::from_str(include_str!("../examples/figure-6/model.json")).expect("JSON");
        client.send("PUT", "/v1/models/figure-6", &model.to_string()).await;
        let learner = json!({"attributes": ["x", "y", "heading", "gold", "arrows"]});
        client.send("PUT", "/v1/learners/gold", &learner.to_string()).await;
        Self { address, stop, running }
    }

    async fn stop(self) {
        drop(self.stop);
        self.running.await.expect("a clean end");
    }

    /// Draws trials, and gives their ids.
    async fn draw(&self, n_trials: usize, n_clients: usize) -> Vec<String> {
        let demonstration: Value =
            serde_json::from_str(include_str!("../examples/figure-6/demonstration.json")).expect("JSON");
        let request = json!({"model": "figure-6", "demonstration": demonstration}).to_string();
        let tasks: Vec<_> = (0..n_clients)
            .map(|n| {
                let (address, request) = (self.address, request.clone());
                let n_own = n_trials / n_clients + usize::from(n < n_trials % n_clients);
                tokio::spawn(async move {
                    let mut client = Client::connect(address).await;
                    let mut ids = Vec::with_capacity(n_own);
                    for _ in 0..n_own {
                        let answer = client.send("POST", "/v1/learners/gold/trials", &request).await;
                        let id = answer.split("\"id\":\"").nth(1).and_then(|rest| rest.split('"').next());
                        ids.push(id.expect("a trial").to_owned());
                    }
                    ids
                })
            })
            .collect();
        let mut ids = Vec::with_capacity(n_trials);
        for task in tasks {
            ids.extend(task.await.expect("a client"));
        }
        ids
    }

    /// Rewards trials, and gives how many a second.
    async fn reward(&self, trials: &[String], n_clients: usize) -> f64 {
        let mut clients = Vec::with_capacity(n_clients);
        for own in trials.chunks(trials.len().div_ceil(n_clients)) {
            clients.push((Client::connect(self.address).await, own.to_vec()));
        }
        let started = Instant::now();
        let tasks: Vec<_> = clients
            .into_iter()
            .map(|(mut client, own)| {
                tokio::spawn(async move {
                    for id in own {
                        client.send("PUT", &format!("/v1/trials/{id}/reward"), "{\"reward\":974}").await;
                    }
                })
            })
            .collect();
        for task in tasks {
            task.await.expect("a client");
        }
        rate(trials.len(), started)
    }
}

/// A client that does no more than it must, so that the service is what is measured.
struct Client {
    stream: TcpStream,
    buffer: Vec<u8>,
}

impl Client {
    async fn connect(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).await.expect("a connection");
        stream.set_nodelay(true).expect("a TCP connection");
        Self { stream, buffer: Vec::with_capacity(64 * 1024) }
    }

    async fn send(&mut self, method: &str, path: &str, body: &str) -> String {
        let length = body.len();
        let request = format!(
            "{method} {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: {length}\r\n\r\n{body}"
        );
        self.stream.write_all(request.as_bytes()).await.expect("a service that reads");
        self.buffer.clear();
        loop {
            let n_read = self.stream.read_buf(&mut self.buffer).await.expect("an answer");
            assert!(n_read > 0, "the connection was closed");
            let text = std::str::from_utf8(&self.buffer).unwrap_or_default();
            let Some((head, body)) = text.split_once("\r\n\r\n") else { continue };
            let length = head.split("content-length: ").nth(1).and_then(|rest| rest.split("\r\n").next()?.parse().ok());
            if body.len() >= length.unwrap_or(usize::MAX) {
                assert!(head.starts_with("HTTP/1.1 2"), "{text}");
                return body.to_owned();
            }
        }
    }
}
