//! The program as its surroundings treat it: signals, and logs that nobody reads.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};

use crate::harness::waiting::{LIMIT, Watchdog, send_signal};
use tempfile::TempDir;

/// A service in a process of its own, whose log is read only when a test reads it.
struct Process {
    child: Child,
    address: String,
    log: BufReader<ChildStderr>,
    _watched: Watchdog,
    _directory: TempDir,
}

impl Drop for Process {
    fn drop(&mut self) {
        // It has ended already, unless the test failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn serve(address: &str, directory: &TempDir, flags: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
    command.args(["serve", "--log-format", "text", "--listen", address]).args(flags);
    command.arg("--database").arg(directory.path().join("etude.db"));
    command.env_remove("ETUDE_LOG").stdout(Stdio::null());
    command
}

impl Process {
    fn start(flags: &[&str]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let mut child = serve("127.0.0.1:0", &directory, flags).stderr(Stdio::piped()).spawn().unwrap();
        let log = BufReader::new(child.stderr.take().unwrap());
        let watched = Watchdog::watch(child.id());
        let mut process = Self { child, address: String::new(), log, _watched: watched, _directory: directory };
        let listening = process.until_logged("listening on http://");
        let address = listening.split("http://").nth(1).unwrap().split(' ').next().unwrap().trim();
        address.clone_into(&mut process.address);
        process
    }

    /// Reads the log up to a line that has `part`.
    fn until_logged(&mut self, part: &str) -> String {
        loop {
            let mut line = String::new();
            assert_ne!(self.log.read_line(&mut line).unwrap(), 0, "it has ended without {part:?}");
            if line.contains(part) {
                return line;
            }
        }
    }

    fn signal(&self, signal: &str) {
        send_signal(signal, self.child.id());
    }

    fn ended(&mut self) -> ExitStatus {
        self.child.wait().unwrap()
    }
}

/// Sends a request, and gives the answer, on a connection that stays open.
fn ask(connection: &mut BufReader<TcpStream>, request: &str) -> String {
    connection.get_mut().write_all(request.as_bytes()).unwrap();
    let (mut head, mut n_bytes) = (String::new(), 0);
    loop {
        let start = head.len();
        assert_ne!(connection.read_line(&mut head).unwrap(), 0, "{head}");
        match head[start..].trim().split_once(": ") {
            Some(("content-length", value)) => n_bytes = value.parse().unwrap(),
            None if head[start..].trim().is_empty() => break,
            _ => {}
        }
    }
    let mut body = vec![0; n_bytes];
    connection.read_exact(&mut body).unwrap();
    head + &String::from_utf8(body).unwrap()
}

fn connect(address: &str) -> BufReader<TcpStream> {
    let connection = TcpStream::connect(address).unwrap();
    connection.set_read_timeout(Some(LIMIT)).unwrap();
    BufReader::new(connection)
}

/// Sends requests until far more is logged of them than fits into a pipe and what waits before it.
fn fill_log(process: &Process) {
    let mut connection = connect(&process.address);
    let request = format!("GET /{} HTTP/1.1\r\nhost: {}\r\n\r\n", "x".repeat(4000), process.address);
    for _ in 0..3000 {
        assert!(ask(&mut connection, &request).starts_with("HTTP/1.1 404"));
    }
    let measured = ask(&mut connection, &format!("GET /metrics HTTP/1.1\r\nhost: {}\r\n\r\n", process.address));
    let dropped = measured.lines().find_map(|line| line.strip_prefix("etude_log_lines_dropped_total "));
    let n_dropped = dropped.expect("it is measured").parse::<u64>().unwrap();
    assert!((1000..3000).contains(&n_dropped), "{n_dropped}");
}

#[test]
fn a_log_that_nobody_reads_holds_up_neither_requests_nor_the_end() {
    let mut process = Process::start(&["--log", "info"]);
    fill_log(&process);
    process.signal("-TERM");
    assert_eq!(process.ended().code(), Some(0));
}

#[test]
fn how_many_log_lines_were_dropped_is_logged_once_the_log_is_read_again() {
    let mut process = Process::start(&["--log", "info"]);
    fill_log(&process);
    let line = process.until_logged("log lines were dropped");
    assert!(line.contains("WARN") && line.contains("n_dropped="), "{line}");
    process.signal("-TERM");
    process.until_logged("stopped");
    assert_eq!(process.ended().code(), Some(0));
}

#[test]
fn without_standard_error_requests_are_answered_and_signals_heard() {
    let directory = tempfile::tempdir().unwrap();
    // An address that is this process's alone, as nothing tells which one was taken.
    let [.., high, low] = std::process::id().to_be_bytes();
    let address = format!("127.77.{high}.{}:8080", low.max(1));
    let plain = serve(&address, &directory, &["--log", "info"]);
    let mut command = Command::new("sh");
    command.args(["-c", r#"exec "$0" "$@" 2>&-"#]).arg(plain.get_program()).args(plain.get_args());
    let mut child = command.stdout(Stdio::null()).spawn().unwrap();
    let _watched = Watchdog::watch(child.id());
    while TcpStream::connect(&address).is_err() {
        assert_eq!(child.try_wait().unwrap(), None, "it runs");
        std::thread::yield_now();
    }
    let mut connection = connect(&address);
    for _ in 0..3000 {
        let answer = ask(&mut connection, &format!("GET /v1/models HTTP/1.1\r\nhost: {address}\r\n\r\n"));
        assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    }
    send_signal("-TERM", child.id());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    let log = std::fs::read(directory.path().join("etude.db")).unwrap();
    assert!(log.starts_with(b"SQLite format 3"), "nothing was logged into what was opened next");
}

/// A request that is being served until `rest` is sent.
fn begin_request(process: &Process) -> (BufReader<TcpStream>, &'static str) {
    let mut connection = connect(&process.address);
    let body = r#"{"attributes": ["x"]}"#;
    let head = format!(
        "PUT /v1/learners/slow HTTP/1.1\r\nhost: {}\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\
         expect: 100-continue\r\n\r\n",
        process.address,
        body.len()
    );
    assert!(ask(&mut connection, &head).starts_with("HTTP/1.1 100"));
    (connection, body)
}

#[test]
fn a_second_sigterm_or_sigint_ends_the_service_at_once() {
    for (first, second, code) in [("-TERM", "-TERM", 143), ("-INT", "-INT", 130), ("-TERM", "-INT", 130)] {
        let mut process = Process::start(&["--drain-timeout", "1h"]);
        let _waiting = begin_request(&process);
        process.signal(first);
        process.until_logged("stopping");
        process.signal(second);
        assert_eq!(process.ended().code(), Some(code), "{first}, {second}");
    }
}

#[test]
fn sighup_lets_requests_end_as_sigterm_does_and_a_second_one_changes_nothing() {
    let mut process = Process::start(&["--drain-timeout", "1h"]);
    let (mut connection, rest) = begin_request(&process);
    process.signal("-HUP");
    process.until_logged("stopping");
    process.signal("-HUP");
    let answer = ask(&mut connection, rest);
    assert!(answer.starts_with("HTTP/1.1 201"), "{answer}");
    process.until_logged("stopped");
    assert_eq!(process.ended().code(), Some(0));
}
