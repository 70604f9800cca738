//! What becomes of the service when its disk is full, fails, cannot be written to, or is not the one that it was.
//!
//! This file is longer than 400 lines because every kind of disk is tried with the same round of writes, which is most of it.

use std::fs::{self, File};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::harness::client::Client;
use crate::harness::process::Process;
use crate::harness::service::{answer, example};
use crate::harness::waiting::{LIMIT, within};
use futures_util::{SinkExt, StreamExt};
use reqwest::Method;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

/// Rewards are folded when asked for.
const FLAGS: [&str; 4] = ["--listen", "127.0.0.1:0", "--learn-every", "24h"];

/// A stream, over a websocket.
struct Stream(WebSocketStream<MaybeTlsStream<TcpStream>>);

impl Stream {
    async fn connect(address: &str) -> Self {
        let (socket, _) = tokio_tungstenite::connect_async(format!("ws://{address}/v1/stream")).await.unwrap();
        let mut stream = Self(socket);
        assert_eq!(stream.receive().await["type"], "hello");
        stream
    }

    async fn send(&mut self, frame: Value) {
        self.0.send(Message::text(frame.to_string())).await.unwrap();
    }

    async fn next(&mut self) -> Message {
        within("a message", self.0.next()).await.unwrap().unwrap()
    }

    async fn receive(&mut self) -> Value {
        serde_json::from_str(self.next().await.to_text().unwrap()).unwrap()
    }

    /// Receives frames up to one of type `kind`, and gives that.
    async fn until(&mut self, kind: &str) -> Value {
        loop {
            let frame = self.receive().await;
            assert!(frame["type"] == kind || frame["type"] != "error", "{frame}");
            if frame["type"] == kind {
                return frame;
            }
        }
    }

    /// What comes next, after steps of before, is this problem, and the connection ends with it, to be resumed.
    async fn is_refused(&mut self, problem: &str) {
        let mut frame = self.receive().await;
        while frame["type"] == "step" {
            frame = self.receive().await;
        }
        assert_eq!((&frame["type"], &frame["problem"]["type"]), (&json!("error"), &json!(problem)), "{frame}");
        let Message::Close(Some(close)) = self.next().await else { panic!("it is closed") };
        assert_eq!(u16::from(close.code), 1011, "{close:?}");
    }
}

/// A running service, and what a client needs to try every kind of write.
struct Tried {
    client: Client,
    address: String,
    n_rounds: usize,
}

/// What a round of writes is about, made while all is well.
struct Round {
    n: usize,
    rewarded: String,
    failed: String,
    /// Sessions that wait for an observation, and for the end.
    observed: (Stream, String),
    ended: (Stream, String),
}

/// A model whose canonical text is stored in pieces, which compress well.
fn large_model() -> Value {
    let long = "the same everywhere, ".repeat(12);
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "what", "kind": "category"}],
        "actions": [{"name": "on"}],
        "dynamics": {
            "kind": "table", "transitions": [], "start": 0,
            "states": (0..20_000).map(|x| json!([x, long])).collect::<Vec<_>>(),
        },
    })
}

impl Tried {
    fn new(process: &Process) -> Self {
        let client = Client::new();
        Self { client, address: process.address.clone(), n_rounds: 0 }
    }

    async fn send(&self, method: Method, path: &str, body: &Value) -> (u16, Value) {
        let request = self.client.request(method, format!("http://{}{path}", self.address));
        let request = if body.is_null() { request } else { request.json(body) };
        answer(request.send().await.unwrap()).await
    }

    async fn get(&self, path: &str) -> (u16, Value) {
        self.send(Method::GET, path, &Value::Null).await
    }

    /// What all rounds need.
    async fn set_up(&self) {
        let learner = json!({"attributes": ["x", "y", "heading", "gold", "arrows"]});
        for (path, body) in [("/v1/models/figure-4", example("figure-4/model.json")), ("/v1/learners/gold", learner)] {
            let (status, put) = self.send(Method::PUT, path, &body).await;
            assert_eq!(status, 201, "{put}");
        }
    }

    async fn trial(&self) -> String {
        let (status, trial) = self.send(Method::POST, "/v1/learners/gold/trials", &trial_request()).await;
        assert_eq!(status, 201, "{trial}");
        trial["id"].as_str().unwrap().to_owned()
    }

    async fn session(&self, n_observations: usize) -> (Stream, String) {
        let mut stream = Stream::connect(&self.address).await;
        stream.send(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await;
        let session = stream.until("opened").await["session"].as_str().unwrap().to_owned();
        stream.send(json!({"type": "observe", "seq": 0, "states": observations()[..n_observations]})).await;
        assert_eq!(stream.until("received").await["seq"], n_observations);
        (stream, session)
    }

    async fn begin_round(&mut self) -> Round {
        let n = self.n_rounds;
        self.n_rounds += 1;
        let spare = json!({"dynamics": {"kind": "wumpus", "width": 2, "height": 2}});
        let learner = json!({"attributes": ["x"]});
        for (path, body) in [(format!("/v1/models/spare-{n}"), spare), (format!("/v1/learners/spare-{n}"), learner)] {
            assert_eq!(self.send(Method::PUT, &path, &body).await.0, 201);
        }
        let pending = self.trial().await;
        let (status, _) = self.send(Method::PUT, &format!("/v1/trials/{pending}/reward"), &json!({"reward": n})).await;
        assert_eq!(status, 200);
        Round {
            n,
            rewarded: self.trial().await,
            failed: self.trial().await,
            observed: self.session(3).await,
            ended: self.session(16).await,
        }
    }

    /// Every kind of write but those of streams, with what it is answered if all is well.
    fn writes(round: &Round) -> Vec<(Method, String, Value, u16)> {
        let Round { n, rewarded, failed, .. } = round;
        let policy = example("figure-4/request.json");
        let mut local = policy.clone();
        (local["model"], local["lookahead"]) = ("figure-4".into(), 1.into());
        let batch = json!({"model": "figure-4", "items": vec![json!({"demonstration": policy["demonstration"]}); 3]});
        let small = json!({"dynamics": {"kind": "wumpus", "width": 3, "height": 3}});
        vec![
            (Method::PUT, format!("/v1/models/small-{n}"), small, 201),
            (Method::PUT, format!("/v1/models/large-{n}"), large_model(), 201),
            (Method::POST, "/v1/policies".to_owned(), local, 201),
            (Method::POST, "/v1/policies:batch".to_owned(), batch, 200),
            (Method::PUT, format!("/v1/learners/new-{n}"), json!({"attributes": ["x"]}), 201),
            (Method::POST, "/v1/learners/gold/trials".to_owned(), trial_request(), 201),
            (Method::PUT, format!("/v1/trials/{rewarded}/reward"), json!({"reward": 7}), 200),
            (Method::POST, format!("/v1/trials/{failed}/fail"), json!({"reason": "fell"}), 200),
            (Method::POST, "/v1/learners/gold/learn".to_owned(), Value::Null, 200),
            (Method::DELETE, format!("/v1/models/spare-{n}"), Value::Null, 204),
            (Method::DELETE, format!("/v1/learners/spare-{n}"), Value::Null, 204),
        ]
    }

    async fn refuses_requests(&self, round: &Round, status: u16, problem: &str) {
        for (method, path, body, _) in Self::writes(round) {
            let (found, told) = self.send(method, &path, &body).await;
            assert_eq!((found, &told["type"]), (status, &json!(problem)), "{path}: {told}");
        }
    }

    /// Every kind of write is refused with this status and problem, nothing of it is there, and what is there can be read.
    async fn refuses(&self, round: &mut Round, status: u16, problem: &str) {
        let before = self.contents().await;
        self.refuses_requests(round, status, problem).await;
        let mut opening = Stream::connect(&self.address).await;
        opening.send(json!({"type": "open", "model": "figure-4"})).await;
        opening.is_refused(problem).await;
        let (observed, _) = &mut round.observed;
        observed.send(json!({"type": "observe", "seq": 3, "states": observations()[3..5]})).await;
        observed.is_refused(problem).await;
        let (ended, _) = &mut round.ended;
        ended.send(json!({"type": "end", "seq": 16})).await;
        ended.is_refused(problem).await;
        assert_eq!(self.contents().await, before);
        self.until_ready_is(status, problem).await;
    }

    /// Every kind of write is accepted, and streams that were cut off are taken up where they were.
    async fn accepts(&self, round: &mut Round) {
        self.until_ready_is(200, "ready\n").await;
        for (method, path, body, status) in Self::writes(round) {
            let (found, told) = self.send(method, &path, &body).await;
            assert_eq!(found, status, "{path}: {told}");
        }
        for ((stream, session), n_received) in [(&mut round.observed, 3), (&mut round.ended, 16)] {
            *stream = Stream::connect(&self.address).await;
            stream.send(json!({"type": "resume", "session": session})).await;
            assert_eq!(stream.until("opened").await["received"], n_received);
            if n_received < 16 {
                stream
                    .send(json!({"type": "observe", "seq": n_received, "states": observations()[n_received..]}))
                    .await;
                assert_eq!(stream.until("received").await["seq"], 16);
            }
            stream.send(json!({"type": "end", "seq": 16})).await;
            assert!(stream.until("done").await["policy_id"].is_string());
        }
    }

    /// Readiness is tried again within a second.
    async fn until_ready_is(&self, status: u16, expected: &str) {
        let mut last = Value::Null;
        let asking = async {
            loop {
                let (found, told) = self.get("/readyz").await;
                if found == status && (told == expected || told["type"] == expected) {
                    return;
                }
                last = told;
            }
        };
        assert!(tokio::time::timeout(LIMIT, asking).await.is_ok(), "{status} expected, found {last}");
    }

    /// What clients can read, without times and what is refined in the background.
    async fn contents(&self) -> Value {
        let mut contents = json!({});
        for (path, fields) in [
            ("/v1/models", &["name", "hash"][..]),
            ("/v1/learners", &["name", "hash"]),
            ("/v1/learners/gold/trials", &["id", "status", "reward", "reward_order", "policy_id"]),
            ("/v1/learners/gold/weights/history", &["version", "trials", "weights"]),
            ("/v1/sessions", &["id", "status", "observations", "policy_id"]),
            ("/v1/policies", &["id", "status", "cost", "refines"]),
        ] {
            let (status, page) = self.get(&format!("{path}?limit=1000")).await;
            assert_eq!((status, &page["next"], &page["unreadable"]), (200, &Value::Null, &Value::Null), "{page}");
            let items = page["items"].as_array().unwrap().iter().filter(|item| item["refines"].is_null());
            let items = items.map(|item| fields.iter().map(|field| item[field].clone()).collect::<Value>());
            contents[path] = items.collect();
        }
        for policy in contents["/v1/policies"].as_array().unwrap() {
            assert_eq!(self.get(&format!("/v1/policies/{}", policy[0].as_str().unwrap())).await.0, 200);
        }
        contents
    }
}

fn observations() -> Vec<Value> {
    serde_json::from_value(example("figure-4/demonstration.json")).unwrap()
}

fn trial_request() -> Value {
    json!({"model": "figure-4", "demonstration": observations()})
}

/// A disk of a few megabytes, until it is dropped.
struct Disk {
    directory: TempDir,
}

impl Disk {
    /// Nothing where none can be mounted, which is told.
    fn mount() -> Option<Self> {
        let directory = tempfile::tempdir().unwrap();
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", "size=4m", "tmpfs"]).arg(directory.path()).output();
        let failed = match mounted {
            Ok(output) if output.status.success() => return Some(Self { directory }),
            Ok(output) => String::from_utf8_lossy(&output.stderr).into_owned(),
            Err(error) => error.to_string(),
        };
        skipped(&format!("no tmpfs can be mounted here: {failed}"));
        None
    }

    fn database(&self) -> PathBuf {
        self.directory.path().join("etude.db")
    }

    fn filler(&self) -> PathBuf {
        self.directory.path().join("filler")
    }

    fn fill(&self) {
        let mut filler = File::create(self.filler()).unwrap();
        loop {
            match filler.write_all(&[0; 4096]) {
                Ok(()) => {}
                Err(error) if error.kind() == ErrorKind::StorageFull => return,
                Err(error) => panic!("{error}"),
            }
        }
    }

    fn make_room(&self) {
        fs::remove_file(self.filler()).unwrap();
    }

    fn forbid_writing(&self) {
        self.remount("ro");
    }

    fn allow_writing(&self) {
        self.remount("rw");
    }

    fn remount(&self, option: &str) {
        let remounted =
            Command::new("mount").args(["-o", &format!("remount,{option}")]).arg(self.directory.path()).status();
        assert!(remounted.unwrap().success());
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let unmounted = Command::new("umount").arg("-l").arg(self.directory.path()).status();
        assert!(unmounted.is_ok_and(|status| status.success()) || std::thread::panicking());
    }
}

#[expect(clippy::print_stderr, reason = "whoever reads the tests' output is to know")]
fn skipped(why: &str) {
    eprintln!("SKIPPED: {why}");
}

#[tokio::test]
async fn a_full_disk_refuses_every_write_and_room_brings_every_write_back() {
    let Some(disk) = Disk::mount() else { return };
    let process = Process::start_with(&FLAGS, &disk.database());
    let mut tried = Tried::new(&process);
    tried.set_up().await;
    for _ in 0..2 {
        let mut round = tried.begin_round().await;
        disk.fill();
        tried.refuses(&mut round, 507, "/problems/storage-full").await;
        disk.make_room();
        tried.accepts(&mut round).await;
    }
    let contents = tried.contents().await;
    process.kill();
    let process = Process::start_with(&FLAGS, &disk.database());
    assert_eq!(Tried::new(&process).contents().await, contents);
}

/// A service in whose process calls on the files of its database fail when told.
struct Faults {
    directory: TempDir,
    shim: PathBuf,
}

impl Faults {
    /// Nothing where the shim cannot be compiled, which is told.
    fn compile() -> Option<Self> {
        let directory = tempfile::tempdir().unwrap();
        let shim = directory.path().join("failing_disk.so");
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/program/faults/failing_disk.c");
        let compiled = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(&shim).arg(source).arg("-ldl").output();
        if compiled.is_ok_and(|output| output.status.success()) {
            return Some(Self { directory, shim });
        }
        skipped("no shim can be compiled here");
        None
    }

    fn database(&self) -> PathBuf {
        self.directory.path().join("etude.db")
    }

    fn orders(&self) -> PathBuf {
        self.directory.path().join("orders")
    }

    /// From now on, `call` fails with the error `code` on every file of the database, after `n_passing` that do not.
    fn fail(&self, call: &str, code: i32, n_passing: u32) {
        // At once, as it may be read at any time.
        let new = self.directory.path().join("new-orders");
        fs::write(&new, format!("{call} {code} {n_passing}\n")).unwrap();
        fs::rename(new, self.orders()).unwrap();
    }

    fn lift(&self) {
        fs::remove_file(self.orders()).unwrap();
    }

    /// Nothing where the shim is not loaded, which is told.
    fn start(&self) -> Option<Process> {
        let (database, orders) = (self.database(), self.orders());
        let variables =
            [("LD_PRELOAD", &*self.shim), ("FAILING_DISK_FILES", &*database), ("FAILING_DISK_ORDERS", &*orders)];
        let process = Process::start_under(&variables, &FLAGS, &database);
        let maps = fs::read_to_string(format!("/proc/{}/maps", process.id())).unwrap_or_default();
        if maps.contains("failing_disk.so") {
            return Some(process);
        }
        skipped("nothing can be preloaded here");
        None
    }
}

const EIO: i32 = 5;
const ENOSPC: i32 = 28;

#[tokio::test]
async fn a_write_a_sync_or_a_commit_that_fails_is_not_acknowledged_and_costs_nothing_after_it() {
    let Some(faults) = Faults::compile() else { return };
    let Some(process) = faults.start() else { return };
    let mut tried = Tried::new(&process);
    tried.set_up().await;
    let (full, not_ready) = ((507, "/problems/storage-full"), (503, "/problems/not-ready"));
    for (call, code, n_passing, (status, problem)) in [
        ("write", ENOSPC, 0, full),
        ("write", EIO, 0, not_ready),
        // In the middle of what a commit writes.
        ("write", EIO, 3, not_ready),
        ("write", ENOSPC, 2, full),
        // At its end.
        ("sync", EIO, 0, not_ready),
    ] {
        let mut round = tried.begin_round().await;
        faults.fail(call, code, n_passing);
        tried.refuses(&mut round, status, problem).await;
        faults.lift();
        tried.accepts(&mut round).await;
    }
    let contents = tried.contents().await;
    process.kill();
    let Some(process) = faults.start() else { return };
    assert_eq!(Tried::new(&process).contents().await, contents, "all that was acknowledged, and nothing else");
}

#[tokio::test]
async fn a_service_starts_on_a_disk_that_fails_and_reads() {
    let Some(faults) = Faults::compile() else { return };
    let Some(process) = faults.start() else { return };
    let mut tried = Tried::new(&process);
    tried.set_up().await;
    let round = tried.begin_round().await;
    let contents = tried.contents().await;
    // The streams are let go, so that the end is clean.
    drop(round);
    process.stop();
    for call in ["write", "truncate"] {
        faults.fail(call, EIO, 0);
        let Some(process) = faults.start() else { return };
        let mut started = Tried::new(&process);
        started.n_rounds = tried.n_rounds;
        assert_eq!(started.contents().await, contents, "{call}");
        started.until_ready_is(503, "/problems/not-ready").await;
        faults.lift();
        started.until_ready_is(200, "ready\n").await;
        assert_eq!(started.contents().await, contents, "{call}");
        process.stop();
    }
}

#[tokio::test]
async fn a_service_starts_on_a_full_or_read_only_disk_reads_and_writes_once_that_can_be() {
    let Some(disk) = Disk::mount() else { return };
    let mut n_rounds = 0;
    let full = (Disk::fill as fn(&Disk), Disk::make_room as fn(&Disk), 507, "/problems/storage-full");
    let read_only = (Disk::forbid_writing as fn(&Disk), Disk::allow_writing as fn(&Disk), 503, "/problems/not-ready");
    for (begins, ends, status, problem) in [full, read_only] {
        // What is left then is a log that the next one goes on with, or a single file.
        for end in [Process::kill, Process::stop] {
            let process = Process::start_with(&FLAGS, &disk.database());
            let mut tried = Tried { n_rounds, ..Tried::new(&process) };
            if n_rounds == 0 {
                tried.set_up().await;
            }
            let mut round = tried.begin_round().await;
            n_rounds = tried.n_rounds;
            let contents = tried.contents().await;
            end(process);
            begins(&disk);
            let process = Process::start_with(&FLAGS, &disk.database());
            let tried = Tried::new(&process);
            assert_eq!(tried.contents().await, contents);
            tried.refuses_requests(&round, status, problem).await;
            tried.until_ready_is(status, problem).await;
            ends(&disk);
            tried.accepts(&mut round).await;
            process.stop();
        }
    }
}

fn etude(arguments: &[&str]) -> (bool, String) {
    let ended = Command::new(env!("CARGO_BIN_EXE_etude")).args(arguments).output().unwrap();
    (ended.status.success(), String::from_utf8(ended.stderr).unwrap())
}

/// Why a service does not start on this database.
fn not_started(database: &Path) -> String {
    let (has_started, told) = etude(&["serve", "--listen", "127.0.0.1:0", "--database", database.to_str().unwrap()]);
    assert!(!has_started, "{told}");
    told
}

#[test]
fn a_database_that_cannot_be_created_says_what_it_needs() {
    let directory = tempfile::tempdir().unwrap();
    let told = not_started(&directory.path().join("nowhere/etude.db"));
    assert!(told.contains("there is no directory"), "{told}");
    let Some(disk) = Disk::mount() else { return };
    disk.fill();
    for _ in 0..2 {
        let told = not_started(&disk.database());
        assert!(told.contains("it cannot be created") && told.contains("the disk of the database is full"), "{told}");
    }
    disk.make_room();
    Process::start_with(&FLAGS, &disk.database()).stop();
}

#[tokio::test]
async fn a_second_service_is_refused_and_commands_that_only_read_work_beside_the_first() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    let mut tried = Tried::new(&process);
    tried.set_up().await;
    let round = tried.begin_round().await;
    tried.send(Method::POST, "/v1/learners/gold/learn", &Value::Null).await;
    // By whatever path it is named.
    let link = directory.path().join("link.db");
    std::os::unix::fs::symlink(&database, &link).unwrap();
    for path in [&database, &link] {
        let told = not_started(path);
        assert!(told.contains("another process works with the database") && told.contains("etude.db-lock"), "{told}");
    }
    let path = database.to_str().unwrap();
    let exported = directory.path().join("gold.json");
    let export = ["learner", "export", "gold", "--database", path, "--out", exported.to_str().unwrap()];
    let import = ["learner", "import", exported.to_str().unwrap(), "--name", "gold-2", "--database", path];
    assert_eq!(etude(&export), (true, String::new()));
    assert_eq!(etude(&["learner", "replay", "gold", "--database", path]), (true, String::new()));
    let (has_imported, told) = etude(&import);
    assert!(
        !has_imported && told.contains("another process works with the database") && told.contains("`--server`"),
        "{told}"
    );
    let server = format!("http://{}", tried.address);
    assert_eq!(
        etude(&["learner", "import", import[2], "--name", "gold-3", "--server", &server]),
        (true, String::new())
    );
    // All goes on as before.
    tried.accepts(&mut { round }).await;
    process.kill();
    assert_eq!(etude(&import), (true, String::new()));
    let process = Process::start_with(&FLAGS, &database);
    let (_, learners) = Tried::new(&process).get("/v1/learners").await;
    let names = learners["items"].as_array().unwrap().iter().map(|learner| learner["name"].as_str().unwrap());
    assert!(["gold", "gold-2", "gold-3"].iter().all(|name| names.clone().any(|found| found == *name)), "{learners}");
}

#[tokio::test]
async fn a_database_of_another_program_is_refused_and_left_as_it_is() {
    use sqlx::{ConnectOptions, Connection};
    let directory = tempfile::tempdir().unwrap();
    let options = sqlx::sqlite::SqliteConnectOptions::new().create_if_missing(true);
    for (name, made) in [
        ("tables", "CREATE TABLE models (name TEXT)"),
        ("another", "PRAGMA application_id = 7"),
        (
            "migrated",
            "CREATE TABLE _sqlx_migrations (version, description); CREATE TABLE t (x);
                      INSERT INTO _sqlx_migrations VALUES (1, 'init')",
        ),
    ] {
        let database = directory.path().join(format!("{name}.db"));
        let mut connection = options.clone().filename(&database).connect().await.unwrap();
        sqlx::raw_sql(made).execute(&mut connection).await.unwrap();
        connection.close().await.unwrap();
        let before = fs::read(&database).unwrap();
        let told = not_started(&database);
        assert!(told.contains("a database of another program"), "{told}");
        assert!(fs::read(&database).unwrap() == before, "{name}");
        assert!(!directory.path().join(format!("{name}.db-wal")).exists(), "{name}");
    }
}

/// Changes the byte after `before` in the database's file.
fn flip(database: &Path, before: &str) {
    let mut bytes = fs::read(database).unwrap();
    let found = bytes.windows(before.len()).position(|window| window == before.as_bytes());
    bytes[found.unwrap() + before.len()] ^= 1;
    fs::write(database, bytes).unwrap();
}

#[tokio::test]
async fn flipped_bytes_are_never_served_and_a_list_goes_on_without_the_row() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    let tried = Tried::new(&process);
    tried.set_up().await;
    let cave = json!({"dynamics": {"kind": "wumpus", "width": 3, "height": 3}});
    assert_eq!(tried.send(Method::PUT, "/v1/models/cave", &cave).await.0, 201);
    assert_eq!(tried.send(Method::PUT, "/v1/learners/other", &json!({"attributes": ["x", "hay"]})).await.0, 201);
    let request = json!({"model": "cave", "demonstration": [{"x": 0}], "weights": {"y": 0.123_456}});
    let mut ids = Vec::new();
    for weight in [0.123_456, 0.625, 0.654_321] {
        let mut request = request.clone();
        request["weights"]["y"] = weight.into();
        ids.push(tried.send(Method::POST, "/v1/policies", &request).await.1["id"].as_str().unwrap().to_owned());
    }
    process.stop();
    flip(&database, "\"y\":0.12345");
    flip(&database, "\"width\":");
    flip(&database, "\"x\",\"ha");
    let process = Process::start_with(&FLAGS, &database);
    let tried = Tried::new(&process);
    for (method, path, body) in [
        (Method::GET, format!("/v1/policies/{}", ids[0]), &Value::Null),
        (Method::GET, "/v1/models/cave".to_owned(), &Value::Null),
        (Method::POST, "/v1/policies".to_owned(), &request),
        (Method::GET, "/v1/learners/other".to_owned(), &Value::Null),
    ] {
        let (status, told) = tried.send(method, &path, body).await;
        assert_eq!((status, &told["type"]), (500, &json!("/problems/internal")), "{path}: {told}");
    }
    for (list, unreadable, n_items) in [("policies", ids[0].as_str(), 2), ("learners", "other", 1)] {
        let (status, page) = tried.get(&format!("/v1/{list}")).await;
        assert_eq!((status, &page["unreadable"]), (200, &json!([unreadable])), "{page}");
        assert_eq!(page["items"].as_array().unwrap().len(), n_items);
        // Where it ends a page, the next one goes on behind it.
        let (_, first) = tried.get(&format!("/v1/{list}?limit=1")).await;
        let next = first["next"].as_str().unwrap();
        let (_, second) = tried.get(&format!("/v1/{list}?after={next}")).await;
        let n_read = [&first, &second].iter().map(|page| page["items"].as_array().unwrap().len()).sum::<usize>();
        assert_eq!(n_read, n_items);
    }
    for path in [format!("/v1/policies/{}", ids[1]), "/v1/models/figure-4".to_owned(), "/v1/learners/gold".to_owned()] {
        assert_eq!(tried.get(&path).await.0, 200, "{path}");
    }
}

#[tokio::test]
async fn a_large_definition_that_was_changed_is_cut_off_and_not_searched() {
    use sqlx::ConnectOptions;
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    let tried = Tried::new(&process);
    let mut other = large_model();
    other["dynamics"]["states"][0][0] = (-1).into();
    for (name, model) in [("large", large_model()), ("other", other)] {
        assert_eq!(tried.send(Method::PUT, &format!("/v1/models/{name}"), &model).await.0, 201);
    }
    process.kill();
    let mut connection = sqlx::sqlite::SqliteConnectOptions::new().filename(&database).connect().await.unwrap();
    let changed = sqlx::query(
        "UPDATE definition_pieces SET piece = (SELECT o.piece FROM definition_pieces o JOIN models m ON m.definition_id = o.definition_id
             WHERE m.name = 'other' AND o.seq = 0)
         WHERE seq = 0 AND definition_id = (SELECT definition_id FROM models WHERE name = 'large')",
    );
    assert_eq!(changed.execute(&mut connection).await.unwrap().rows_affected(), 1);
    drop(connection);
    let process = Process::start_with(&FLAGS, &database);
    let tried = Tried::new(&process);
    let whole = async |name: &str| {
        let answer = tried.client.get(format!("http://{}/v1/models/{name}", tried.address)).send().await.unwrap();
        answer.bytes().await.is_ok()
    };
    assert!(whole("other").await && !whole("large").await);
    let request = |name: &str| json!({"model": name, "demonstration": [{"x": 3}]});
    assert_eq!(tried.send(Method::POST, "/v1/policies", &request("other")).await.0, 201);
    assert_eq!(tried.send(Method::POST, "/v1/policies", &request("large")).await.0, 500);
}

#[tokio::test]
async fn a_damaged_file_is_refused_with_what_is_wrong_with_it() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    Tried::new(&process).set_up().await;
    process.stop();
    let mut bytes = fs::read(&database).unwrap();
    // The heads of all pages but the first say how their cells lie.
    for page in (4096..bytes.len()).step_by(4096) {
        bytes[page + 3] ^= 0x15;
    }
    fs::write(&database, &bytes).unwrap();
    let told = not_started(&database);
    assert!(told.contains("the file of the database is damaged"), "{told}");
    assert!(fs::read(&database).unwrap() == bytes);
}

#[tokio::test]
async fn a_database_that_is_deleted_or_replaced_acknowledges_nothing_until_it_is_back() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    let mut tried = Tried::new(&process);
    tried.set_up().await;
    let at = |end: &str| directory.path().join(format!("etude.db{end}"));
    // All of it, or what was written last.
    for (files, is_replaced) in [(&["", "-wal", "-shm"][..], false), (&[""], true), (&["-wal"], false)] {
        let mut round = tried.begin_round().await;
        for end in files {
            fs::rename(at(end), at(&format!("{end}-moved"))).unwrap();
        }
        if is_replaced {
            fs::copy(at("-moved"), &database).unwrap();
        }
        let contents = tried.contents().await;
        tried.refuses(&mut round, 503, "/problems/not-ready").await;
        let (_, told) = tried.get("/readyz").await;
        assert!(told["detail"].as_str().unwrap().contains("deleted or replaced"), "{told}");
        assert_eq!(tried.contents().await, contents, "what is open can be read");
        for end in files {
            fs::rename(at(&format!("{end}-moved")), at(end)).unwrap();
        }
        tried.accepts(&mut round).await;
    }
}

#[tokio::test]
async fn the_files_of_a_new_database_are_its_owners_alone() {
    use std::os::unix::fs::PermissionsExt;
    let directory = tempfile::tempdir().unwrap();
    let process = Process::start_with(&FLAGS, &directory.path().join("etude.db"));
    Tried::new(&process).set_up().await;
    let files = fs::read_dir(directory.path()).unwrap().map(|file| {
        let file = file.unwrap();
        (file.file_name().into_string().unwrap(), file.metadata().unwrap().permissions().mode() & 0o777)
    });
    let mut files: Vec<_> = files.collect();
    files.sort();
    let names = ["etude.db", "etude.db-lock", "etude.db-shm", "etude.db-wal"];
    assert_eq!(files, names.map(|name| (name.to_owned(), 0o600)));
}

#[tokio::test]
async fn a_locked_database_is_not_ready_within_two_seconds_and_can_be_read() {
    use sqlx::ConnectOptions;
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let process = Process::start_with(&FLAGS, &database);
    let tried = Tried::new(&process);
    tried.set_up().await;
    let mut foreign = sqlx::sqlite::SqliteConnectOptions::new().filename(&database).connect().await.unwrap();
    sqlx::raw_sql("BEGIN IMMEDIATE").execute(&mut foreign).await.unwrap();
    tried.until_ready_is(503, "/problems/not-ready").await;
    let (_, told) = tried.get("/readyz").await;
    assert!(told["detail"].as_str().unwrap().contains("locked"), "{told}");
    let (status, told) = tried.send(Method::PUT, "/v1/learners/late", &json!({"attributes": ["x"]})).await;
    assert_eq!((status, &told["type"]), (503, &json!("/problems/not-ready")), "{told}");
    assert_eq!(tried.get("/v1/learners/gold").await.0, 200);
    sqlx::raw_sql("ROLLBACK").execute(&mut foreign).await.unwrap();
    tried.until_ready_is(200, "ready\n").await;
}

#[tokio::test]
async fn a_session_that_expires_is_logged_with_what_is_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let flags = ["--listen", "127.0.0.1:0", "--session-idle-timeout", "100ms"];
    let mut process = Process::start_with(&flags, &directory.path().join("etude.db"));
    let tried = Tried::new(&process);
    tried.set_up().await;
    let (_stream, session) = tried.session(3).await;
    process.has_logged(&["a session has expired", &session, "idle_s=", "n_observations=3"]).await;
}
