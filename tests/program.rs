//! The program itself: its commands, its output, its signals.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;

fn etude(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
    command.args(arguments).current_dir(env!("CARGO_MANIFEST_DIR")).env_remove("ETUDE_LISTEN").env_remove("ETUDE_LOG");
    command
}

fn run(arguments: &[&str]) -> Output {
    etude(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn the_committed_description_is_the_one_that_the_code_gives() {
    let generated = run(&["openapi"]);
    let committed = include_str!("../openapi.yaml");
    assert!(
        text(&generated.stdout) == committed,
        "run `cargo run -- openapi > openapi.yaml` and review the difference"
    );
}

#[test]
fn the_demo_shows_the_cave_the_steps_and_the_totals() {
    let demo = run(&["demo"]);
    let shown = text(&demo.stdout);
    assert!(demo.status.success(), "{}", text(&demo.stderr));
    for expected in [
        "  1 |  x  |  x  |  x  |  x  |  x  |  x  |     |",
        "  0 | oxS | o   | o   | o W | ox  | oxG |     |",
        "12             7   match   grab         x=5 y=0 heading=east gold=1 arrows=1 outside=false         1.0   24.6",
        "cost      48.0 = actions 6.0 + distance 42.0",
        "status    optimal, lower bound 48.0",
        "Weights after 34 trials, all 1 at first; their means give a policy with reward 974:",
        "  gold      5.24  ████",
    ] {
        assert!(shown.contains(expected), "{expected:?} is not in\n{shown}");
    }
    assert_eq!(text(&demo.stderr), "");
}

#[test]
fn map_prints_a_table_or_the_policy() {
    let files = ["map", "--model", "examples/taxi/no-west.json", "--demonstration", "examples/taxi/request.json"];
    let table = run(&files);
    assert!(table.status.success(), "{}", text(&table.stderr));
    assert!(text(&table.stdout).contains("cost      71.9 = actions 3.9 + distance 68.0"), "{}", text(&table.stdout));
    let lighter = run(&[&files[..], &["--weight", "passenger=3", "--json"]].concat());
    let policy: Value = serde_json::from_slice(&lighter.stdout).unwrap();
    assert_eq!((&policy["cost"]["total"], &policy["weights"]["passenger"]), (&62.0.into(), &3.0.into()));
    assert_eq!((&policy["model"], &policy["id"]), (&"taxi-no-west".into(), &Value::Null));
}

#[test]
fn map_reads_standard_input_and_bounds_its_search() {
    let arguments = ["map", "--model", "examples/figure-4/model.json", "--demonstration", "-", "--json"];
    let bounded = ["--heuristic", "none", "--max-expansions", "10"];
    let mut child =
        etude(&[&arguments[..], &bounded].concat()).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let demonstration = include_bytes!("../examples/figure-4/demonstration.json");
    child.stdin.take().unwrap().write_all(demonstration).unwrap();
    let policy: Value = serde_json::from_slice(&child.wait_with_output().unwrap().stdout).unwrap();
    assert_eq!((&policy["status"], &policy["search"]["expanded"]), (&"bounded".into(), &10.into()));
}

#[test]
fn faults_of_files_are_told_with_their_places() {
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &str| {
        let path = directory.path().join(name);
        std::fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let told = |model: &str, demonstration: &str| {
        let failed = run(&["map", "--model", model, "--demonstration", demonstration]);
        assert_eq!((failed.status.code(), failed.stdout.len()), (Some(1), 0));
        text(&failed.stderr).to_owned()
    };
    let model = file("model.json", r#"{"actions": [{"name": "fly"}], "dynamics": {"kind": "wumpus", "width": 3}}"#);
    let demonstration = file("demonstration.json", r#"[{"speed": 1}, {"x": "a"}]"#);
    let good = "examples/figure-4/model.json";
    let faults = told(&model, &demonstration);
    assert!(
        faults.contains("/actions/0/name: unknown action \"fly\"") && faults.contains("/dynamics/height: is missing")
    );
    let faults = told(good, &demonstration);
    assert!(faults.contains("/demonstration/0/speed: unknown attribute \"speed\""), "{faults}");
    assert!(faults.contains("/demonstration/1/x: expected a number, found \"a\""), "{faults}");
    assert!(told(good, &file("broken.json", "[{]")).contains("not JSON at line 1, column 3"));
    assert!(told("nowhere.json", &demonstration).contains("cannot read nowhere.json: No such file"));
}

/// A service in a process of its own.
struct Process {
    child: Child,
    address: String,
    log: std::thread::JoinHandle<String>,
}

impl Process {
    fn start(database: &Path, flags: &[&str]) -> Self {
        let serve = ["serve", "--listen", "127.0.0.1:0", "--database", database.to_str().unwrap()];
        let mut child = etude(&[&serve[..], flags].concat()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        let first = lines.find(|line| line.contains("listening on http://")).unwrap();
        let address = first.split("http://").nth(1).unwrap();
        let address = address.split(['"', ' ']).next().unwrap().to_owned();
        let log = std::thread::spawn(move || lines.collect::<Vec<_>>().join("\n"));
        Self { child, address, log }
    }

    /// Sends a signal, and gives the exit code and the log.
    fn signal(mut self, signal: &str) -> (Option<i32>, String) {
        let killed = Command::new("kill").args([signal, &self.child.id().to_string()]).status().unwrap();
        assert!(killed.success());
        (self.child.wait().unwrap().code(), self.log.join().unwrap())
    }
}

#[test]
fn sigterm_and_sigint_end_the_service_cleanly() {
    let directory = tempfile::tempdir().unwrap();
    for (signal, flags) in [("-TERM", ["--log-format", "text"]), ("-INT", ["--log-format", "json"])] {
        let service = Process::start(&directory.path().join("etude.db"), &flags);
        let healthy = run(&["healthcheck", "--listen", &service.address]);
        assert!(healthy.status.success(), "{}", text(&healthy.stderr));
        let address = service.address.clone();
        let (code, log) = service.signal(signal);
        assert_eq!(code, Some(0), "{log}");
        assert!(log.contains("readyz") && log.contains("request_id") && log.contains("stopped"), "{log}");
        assert!(log.lines().all(|line| flags[1] == "text" || serde_json::from_str::<Value>(line).is_ok()), "{log}");
        let gone = run(&["healthcheck", "--listen", &address]);
        assert_eq!(gone.status.code(), Some(1));
        assert!(text(&gone.stderr).contains("cannot ask http://"), "{}", text(&gone.stderr));
    }
    let left: Vec<_> = std::fs::read_dir(directory.path()).unwrap().map(|file| file.unwrap().file_name()).collect();
    assert_eq!(left, ["etude.db"]);
}

#[test]
fn what_cannot_be_started_says_why() {
    let directory = tempfile::tempdir().unwrap();
    let broken = directory.path().join("broken.db");
    std::fs::write(&broken, "this is no database, whatever its name says, and long enough to be looked at").unwrap();
    let failed = run(&["serve", "--listen", "127.0.0.1:0", "--database", broken.to_str().unwrap()]);
    assert_eq!(failed.status.code(), Some(1));
    assert!(text(&failed.stderr).contains("file is not a database"), "{}", text(&failed.stderr));

    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let database = directory.path().join("etude.db");
    let failed = run(&["serve", "--listen", &address, "--database", database.to_str().unwrap()]);
    assert!(text(&failed.stderr).contains(&format!("cannot listen on {address}: Address already in use")));
}
