//! The program itself: its commands, its output, its signals.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Output, Stdio};

use crate::harness::process::Process;
use crate::harness::waiting::Watchdog;
use serde_json::Value;

pub(crate) fn etude(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
    command.args(arguments).current_dir(env!("CARGO_MANIFEST_DIR")).env_remove("ETUDE_LISTEN").env_remove("ETUDE_LOG");
    command
}

pub(crate) fn run(arguments: &[&str]) -> Output {
    etude(arguments).output().unwrap()
}

pub(crate) fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn the_committed_description_is_the_one_that_the_code_gives() {
    let generated = run(&["openapi"]);
    let committed = include_str!("../../openapi.yaml");
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
        "  0 | oxS | ox  | ox  | o W | ox  | oxG |     |",
        "  12            7  match  grab        gold=1                            1.0  arrows            24.6",
        "cost      48.2 = actions 7.2 + distance 41.0",
        "status    optimal, lower bound 48.2",
        "\n   8 heading=north       1 extra  0 turn_left  lookahead heading=north\n",
        "\n  10 x=4                 5 match  3 forward    lookahead x=2\n",
        "Weights after 31 trials, all 1 at first; their means give a policy with reward 974:",
        "  gold      6.05  ████",
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
fn stream_waits_for_some_time_only_if_it_is_told_so() {
    let model = ["stream", "--model", "examples/figure-4/model.json", "--json"];
    let time = ["--lookahead", "none", "--lookahead-ms", "1"];
    let mut child = etude(&[&model[..], &time].concat()).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let _watched = Watchdog::watch(child.id());
    let demonstration: Vec<Value> =
        serde_json::from_str(include_str!("../../examples/figure-4/demonstration.json")).unwrap();
    let mut input = child.stdin.take().unwrap();
    for state in &demonstration[..3] {
        writeln!(input, "{state}").unwrap();
    }
    // The input goes on.
    let lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let mut steps = lines.map(|line| serde_json::from_str::<Value>(&line).unwrap());
    let timed = steps.find(|step| step["observation"] == 2).unwrap();
    assert_eq!((&timed["proven"], &timed["after"]), (&false.into(), &3.into()), "{timed}");
    drop(input);
    assert!(child.wait().unwrap().success());
    let wrong = run(&[&model[..], &["--lookahead-ms", "0"]].concat());
    assert!(text(&wrong.stderr).contains("--lookahead-ms"), "{}", text(&wrong.stderr));
}

#[test]
fn map_reads_standard_input_and_bounds_its_search() {
    let arguments = ["map", "--model", "examples/figure-4/model.json", "--demonstration", "-", "--json"];
    let bounded = ["--heuristic", "none", "--max-expansions", "10"];
    let mut child =
        etude(&[&arguments[..], &bounded].concat()).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let demonstration = include_bytes!("../../examples/figure-4/demonstration.json");
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
    assert!(faults.contains(&format!("{demonstration}: /0/speed: unknown attribute \"speed\"")), "{faults}");
    assert!(faults.contains(&format!("{demonstration}: /1/x: expected a number, found \"a\"")), "{faults}");
    assert!(told(good, &file("broken.json", "[{]")).contains("not JSON at line 1, column 3"));
    let request = file("request.json", r#"{"demonstration": [{}], "weights": 3}"#);
    let weighted = run(&["map", "--model", good, "--demonstration", &request, "--weight", "x=2"]);
    assert_eq!(weighted.status.code(), Some(1));
    assert!(
        text(&weighted.stderr).contains("--weight x=2: the request has \"weights\" already"),
        "{}",
        text(&weighted.stderr)
    );
    assert!(told("nowhere.json", &demonstration).contains("cannot read nowhere.json: No such file"));
}

#[test]
fn sigterm_and_sigint_end_the_service_cleanly() {
    let directory = tempfile::tempdir().unwrap();
    for (signal, flags) in [
        ("-TERM", ["--log-format", "text", "--log", "etude=debug"]),
        ("-INT", ["--log-format", "json", "--log", "etude=debug"]),
    ] {
        let service = Process::start_with(
            &[&["--listen", "127.0.0.1:0"][..], &flags].concat(),
            &directory.path().join("etude.db"),
        );
        let healthy = run(&["healthcheck", "--listen", &service.address]);
        assert!(healthy.status.success(), "{}", text(&healthy.stderr));
        let address = service.address.clone();
        let (code, log) = service.signal(signal);
        assert_eq!(code, Some(0), "{log}");
        assert!(log.contains("readyz") && log.contains("request_id") && log.contains("stopped"), "{log}");
        assert!(log.lines().all(|line| flags[1] == "text" || serde_json::from_str::<Value>(line).is_ok()), "{log}");
        let gone = run(&["healthcheck", "--listen", &address]);
        assert_eq!(gone.status.code(), Some(1));
        let told = format!("etude: no service answers at http://{address}/readyz: nothing listens there. Start one");
        assert!(text(&gone.stderr).starts_with(&told), "{}", text(&gone.stderr));
    }
    let mut left: Vec<_> = std::fs::read_dir(directory.path()).unwrap().map(|file| file.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["etude.db", "etude.db-lock"]);
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

/// `etude stream`, fed line by line.
pub(crate) struct Streaming {
    child: Child,
    input: Option<std::process::ChildStdin>,
    output: BufReader<std::process::ChildStdout>,
    _watched: Watchdog,
}

impl Streaming {
    pub(crate) fn start(flags: &[&str]) -> Self {
        let mut command = etude(&[&["stream"][..], flags].concat());
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        Self { input: child.stdin.take(), _watched: Watchdog::watch(child.id()), child, output }
    }

    pub(crate) fn write(&mut self, line: &str) {
        writeln!(self.input.as_ref().unwrap(), "{line}").unwrap();
    }

    pub(crate) fn read(&mut self) -> String {
        let mut line = String::new();
        self.output.read_line(&mut line).unwrap();
        line
    }

    /// Ends the input; gives the rest of the output, and the exit code with the errors.
    pub(crate) fn end(mut self) -> (String, Option<i32>, String) {
        drop(self.input.take());
        let mut rest = String::new();
        std::io::Read::read_to_string(&mut self.output, &mut rest).unwrap();
        let ended = self.child.wait_with_output().unwrap();
        (rest, ended.status.code(), text(&ended.stderr).to_owned())
    }
}

fn demonstration() -> Vec<String> {
    let demonstration: Value =
        serde_json::from_str(include_str!("../../examples/figure-4/demonstration.json")).unwrap();
    demonstration.as_array().unwrap().iter().map(Value::to_string).collect()
}

/// Writes the demonstration with a line read in between, and gives all that was printed.
fn stream(flags: &[&str]) -> Vec<String> {
    let observations = demonstration();
    let mut streaming = Streaming::start(flags);
    // The start is committed by the first observation, long before the input has ended.
    streaming.write(&observations[0]);
    let mut lines = vec![streaming.read()];
    streaming.write("");
    for observation in &observations[1..15] {
        streaming.write(observation);
    }
    lines.extend((0..3).map(|_| streaming.read()));
    streaming.write(&observations[15]);
    let (rest, code, errors) = streaming.end();
    assert_eq!((code, errors.as_str()), (Some(0), ""), "{rest}");
    lines.iter().map(|line| line.trim_end()).chain(rest.lines()).map(str::to_owned).collect()
}

#[test]
fn steps_are_printed_before_the_input_has_ended() {
    let readable = stream(&["--model", "examples/figure-4/model.json"]);
    assert!(readable[0].starts_with("step  observation  move   action      state"), "{readable:?}");
    assert!(
        readable[1].starts_with("   0            0  start  -           x=0 y=0 heading=east gold=0"),
        "{readable:?}"
    );
    assert_eq!(readable.last().unwrap(), "status    local");
    assert!(readable[readable.len() - 2].starts_with("cost      48.2 = actions"), "{readable:?}");
    let proven = stream(&["--model", "examples/figure-4/model.json", "--lookahead", "none", "--weight", "gold=2"]);
    assert_eq!(proven.last().unwrap(), "status    optimal");
}

#[test]
fn a_service_streams_the_same_steps_as_the_program_itself() {
    let directory = tempfile::tempdir().unwrap();
    let service = Process::start(&directory.path().join("etude.db"));
    let url = format!("http://{}", service.address);
    let json = |line: &String| serde_json::from_str::<Value>(line).unwrap();
    let options = &["--json", "--lookahead", "3", "--weight", "gold=2", "--start", "0"][..];
    let model = ["--model", "examples/figure-4/model.json"];
    let here = stream(&[&model[..], options].concat());
    let there = stream(&[&model[..], options, &["--server", &url]].concat());
    let (done, steps) = there.split_last().unwrap();
    assert_eq!(steps, &here[..here.len() - 1]);
    let (done, done_here) = (json(done), json(here.last().unwrap()));
    assert_eq!(
        (&done["type"], &done["cost"], &done["actions"]),
        (&"done".into(), &done_here["cost"], &done_here["actions"])
    );
    assert!(done["policy_id"].is_string() && done_here["policy_id"].is_null());
    // By now it is registered under the file's name.
    let by_name = stream(&[&["--model", "model", "--server", &url][..], options].concat());
    assert_eq!(by_name[..by_name.len() - 1], *steps);

    // Faults are told alike, but for what only a service knows.
    for server in [&[][..], &["--server", &url]] {
        let told = |lines: &[&str], flags: &[&str]| {
            let mut streaming = Streaming::start(&[&model[..], flags, server].concat());
            for line in lines {
                streaming.write(line);
            }
            let (_, code, errors) = streaming.end();
            assert_eq!(code, Some(1), "{errors}");
            errors
        };
        let errors = told(&[r#"{"x": 1}"#, "", r#"{"x": "far", "speed": 1}"#], &[]);
        assert!(errors.contains("line 3 of the input: /speed: unknown attribute"), "{errors}");
        assert!(errors.contains("line 3 of the input: /x: expected a number, found \"far\""), "{errors}");
        let errors = told(&[r#"{"x": 1}"#, "{"], &[]);
        assert!(errors.contains("line 2 of the input: not JSON at column 1"), "{errors}");
        assert!(told(&[], &[]).contains("nothing was observed"));
        assert!(told(&[], &["--weight", "z=1"]).contains("--weight z=1: unknown attribute"));
    }
    let mut unknown = Streaming::start(&["--model", "nothing", "--server", &url]);
    unknown.write("{}");
    let (_, code, errors) = unknown.end();
    assert_eq!((code, errors.contains("nothing")), (Some(1), true), "{errors}");
    service.signal("-TERM");
}

#[test]
fn a_reader_that_leaves_ends_the_stream_quietly() {
    let mut streaming = Streaming::start(&["--model", "examples/figure-4/model.json", "--lookahead", "1"]);
    let mut input = streaming.input.take().unwrap();
    drop(streaming.output);
    // Whether the program is there to read them does not matter.
    let _ = demonstration().iter().try_for_each(|line| writeln!(input, "{line}"));
    drop(input);
    let ended = streaming.child.wait_with_output().unwrap();
    assert_eq!((ended.status.code(), text(&ended.stderr)), (Some(0), ""));
}
