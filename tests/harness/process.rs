//! A service in a process of its own.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use tokio::sync::mpsc;

use crate::harness::waiting::{Watchdog, send_signal, within};

/// A service in a process of its own.
pub(crate) struct Process {
    child: Child,
    pub(crate) address: String,
    log: mpsc::UnboundedReceiver<String>,
    /// So that neither its start nor its end is waited for without end.
    _watched: Watchdog,
}

impl Process {
    pub(crate) fn start(database: &Path) -> Self {
        Self::start_with(&["--listen", "127.0.0.1:0"], database)
    }

    pub(crate) fn start_with(flags: &[&str], database: &Path) -> Self {
        Self::start_under(&[], flags, database)
    }

    /// Starts the service with variables in its environment.
    pub(crate) fn start_under(variables: &[(&str, &Path)], flags: &[&str], database: &Path) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.env_remove("ETUDE_LISTEN").env_remove("ETUDE_LOG").envs(variables.iter().copied());
        Self::start_as(command, flags, database)
    }

    /// Starts a service within the limits that `ulimit` sets with these options.
    pub(crate) fn start_within(ulimit: &str, flags: &[&str], database: &Path) -> Self {
        let mut shell = Command::new("sh");
        let script = format!("ulimit {ulimit} && exec \"$0\" \"$@\"");
        shell.args(["-c", &script, env!("CARGO_BIN_EXE_etude")]).env_remove("ETUDE_LISTEN").env_remove("ETUDE_LOG");
        Self::start_as(shell, flags, database)
    }

    fn start_as(mut command: Command, flags: &[&str], database: &Path) -> Self {
        command.arg("serve").args(flags).arg("--database").arg(database);
        if !flags.contains(&"--log-format") {
            command.args(["--log-format", "text"]);
        }
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
        let watched = Watchdog::watch(child.id());
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let (sender, log) = mpsc::unbounded_channel();
        let listening = |line: &String| {
            sender.send(line.clone()).unwrap();
            line.contains("listening on http://")
        };
        let listening = lines.find(|line| listening(line)).expect("the service starts");
        let address = listening.split("http://").nth(1).unwrap().split(['"', ' ']).next().unwrap().to_owned();
        // Nobody may listen any more.
        std::thread::spawn(move || lines.for_each(|line| drop(sender.send(line))));
        Self { child, address, log, _watched: watched }
    }

    /// Completes once a line of the log has all of `parts`.
    pub(crate) async fn has_logged(&mut self, parts: &[&str]) {
        let reading = async {
            loop {
                let line = self.log.recv().await.expect("the service runs");
                if parts.iter().all(|part| line.contains(part)) {
                    return;
                }
            }
        };
        within(&format!("a log line with {parts:?}"), reading).await;
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// SIGTERM, and waits for the clean end.
    pub(crate) fn stop(mut self) {
        send_signal("-TERM", self.id());
        assert!(self.child.wait().unwrap().success());
    }

    /// Sends a signal that ends it, and gives the exit code and the rest of the log.
    pub(crate) fn signal(mut self, signal: &str) -> (Option<i32>, String) {
        send_signal(signal, self.id());
        let code = self.child.wait().unwrap().code();
        let rest: Vec<String> = std::iter::from_fn(|| self.log.blocking_recv()).collect();
        (code, rest.join("\n"))
    }

    /// SIGKILL: no handler runs, nothing is flushed.
    pub(crate) fn kill(self) {
        drop(self);
    }
}

/// `SIGKILL`, also when a test fails.
impl Drop for Process {
    fn drop(&mut self) {
        let killed = self.child.kill().and_then(|()| self.child.wait());
        // A second panic would hide what failed.
        assert!(killed.is_ok() || std::thread::panicking(), "{killed:?}");
    }
}
