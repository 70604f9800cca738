//! `etude stream` on a terminal, where a progress line stands below the steps, and in a pipe, where none does; tables that fit.

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::process::{Child, ChildStdin, Command, Stdio};

use crate::harness::waiting::Watchdog;
use rustix::fs::{Mode, OFlags};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Winsize, tcsetwinsize};
use serde_json::Value;

/// A terminal, with what is shown on it.
struct Terminal {
    controller: File,
    n_columns: u16,
    lines: Vec<String>,
    /// Row and column of the cursor.
    cursor: (usize, usize),
    /// What has come and is not shown yet, as the end of it is missing.
    rest: Vec<u8>,
}

impl Terminal {
    /// Opens a terminal. Gives the side that a program has.
    fn open(n_columns: u16) -> (Self, OwnedFd) {
        let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&controller).unwrap();
        unlockpt(&controller).unwrap();
        let name = ptsname(&controller, Vec::new()).unwrap();
        let side = rustix::fs::open(name, OFlags::RDWR | OFlags::NOCTTY, Mode::empty()).unwrap();
        tcsetwinsize(&side, Winsize { ws_row: 50, ws_col: n_columns, ws_xpixel: 0, ws_ypixel: 0 }).unwrap();
        let controller = File::from(controller);
        (Self { controller, n_columns, lines: vec![String::new()], cursor: (0, 0), rest: Vec::new() }, side)
    }

    /// Shows what comes next; gives whether something came.
    fn show_more(&mut self) -> bool {
        let mut bytes = [0; 4096];
        // There is nothing but an error to be read once the program has ended.
        let Ok(n_bytes @ 1..) = self.controller.read(&mut bytes) else { return false };
        self.rest.extend_from_slice(&bytes[..n_bytes]);
        let n_valid = std::str::from_utf8(&self.rest).map_or_else(|error| error.valid_up_to(), str::len);
        let text = String::from_utf8(self.rest.drain(..n_valid).collect()).unwrap();
        let mut chars = text.chars();
        loop {
            let before = chars.as_str();
            match chars.next() {
                None => return true,
                Some('\x1b') => {
                    let Some(end) = before.find(|c: char| c.is_ascii_alphabetic()) else {
                        self.rest.splice(..0, before.bytes());
                        return true;
                    };
                    self.control(&before[..=end]);
                    chars = before[end + 1..].chars();
                }
                Some('\r') => self.cursor.1 = 0,
                Some('\n') => {
                    self.cursor.0 += 1;
                    self.lines.resize(self.lines.len().max(self.cursor.0 + 1), String::new());
                }
                Some(shown) => {
                    let (row, column) = self.cursor;
                    let mut line: Vec<char> = self.lines[row].chars().collect();
                    line.resize(line.len().max(column + 1), ' ');
                    line[column] = shown;
                    self.lines[row] = line.into_iter().collect();
                    self.cursor.1 += 1;
                    assert!(self.cursor.1 <= self.n_columns.into(), "{:?}", self.lines[row]);
                }
            }
        }
    }

    fn control(&mut self, sequence: &str) {
        let n = sequence.trim_matches(|c: char| !c.is_ascii_digit()).parse().unwrap_or(1);
        match sequence.chars().last().unwrap() {
            'K' => self.lines[self.cursor.0].clear(),
            'A' => self.cursor.0 -= n,
            'B' => self.cursor.0 += n,
            'm' => {}
            _ => panic!("{sequence:?} on a line of progress"),
        }
    }

    /// Shows what comes until `is_wanted` is on the screen.
    fn show_until(&mut self, is_wanted: impl Fn(&[String]) -> bool) {
        while !is_wanted(&self.lines) {
            assert!(self.show_more(), "{:#?}", self.lines);
        }
    }
}

fn stream(output: impl Into<Stdio>, errors: impl Into<Stdio>) -> (Child, ChildStdin, Watchdog) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
    command.args(["stream", "--model", "examples/figure-4/model.json"]).env("TERM", "xterm").env_remove("ETUDE_LOG");
    let mut child = command.stdin(Stdio::piped()).stdout(output).stderr(errors).spawn().unwrap();
    let input = child.stdin.take().unwrap();
    let watched = Watchdog::watch(child.id());
    (child, input, watched)
}

#[test]
fn a_terminal_has_a_progress_line_below_the_steps_and_a_pipe_has_the_same_steps_alone() {
    let demonstration = include_str!("../../examples/figure-4/demonstration.json");
    let observations: Vec<Value> = serde_json::from_str(demonstration).unwrap();

    let (child, mut input, _piped) = stream(Stdio::piped(), Stdio::piped());
    for observation in &observations {
        writeln!(input, "{observation}").unwrap();
    }
    drop(input);
    let piped = child.wait_with_output().unwrap();
    let (output, errors) = (std::str::from_utf8(&piped.stdout).unwrap(), std::str::from_utf8(&piped.stderr).unwrap());
    assert_eq!(errors, "");
    assert!(!output.contains(['\x1b', '\r']), "{output:?}");
    let lines: Vec<&str> = output.lines().collect();

    let (mut terminal, side) = Terminal::open(100);
    let (mut child, mut input, _shown) = stream(side.try_clone().unwrap(), side);
    writeln!(input, "{}", observations[0]).unwrap();
    let progress = |lines: &[String]| lines.last().unwrap().trim_end().to_owned();
    // Below the header and the start, whose state takes two lines.
    terminal.show_until(|lines| lines.len() == 4 && progress(lines).ends_with("1 observations in, 1 steps committed"));
    assert_eq!(terminal.lines[..3], lines[..3]);
    for observation in &observations[1..] {
        writeln!(input, "{observation}").unwrap();
    }
    terminal.show_until(|lines| progress(lines).contains(" 16 observations in, "));
    let n_lines = terminal.lines.len();
    assert!(n_lines > 5, "{:#?}", terminal.lines);
    assert_eq!(terminal.lines[..n_lines - 1], lines[..n_lines - 1]);
    drop(input);
    while terminal.show_more() {}
    assert!(child.wait().unwrap().success());
    // The progress is gone.
    assert_eq!(terminal.lines.pop().as_deref(), Some(""));
    assert_eq!(terminal.lines, lines);
}

#[test]
fn a_table_fits_the_terminal_and_has_one_width_without_one() {
    let arguments =
        ["map", "--model", "examples/figure-4/model.json", "--demonstration", "examples/figure-4/demonstration.json"];
    let etude = |output: Stdio| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(arguments).stdout(output).spawn().unwrap()
    };
    for (n_columns, least) in [(60, 50), (150, 110)] {
        let (mut terminal, side) = Terminal::open(n_columns);
        let mut child = etude(side.into());
        let _watched = Watchdog::watch(child.id());
        while terminal.show_more() {}
        assert!(child.wait().unwrap().success());
        let widest = terminal.lines.iter().map(|line| line.chars().count()).max().unwrap();
        assert!((least..=n_columns.into()).contains(&widest), "{:#?}", terminal.lines);
    }
    let piped = etude(Stdio::piped()).wait_with_output().unwrap();
    let output = std::str::from_utf8(&piped.stdout).unwrap();
    let widest = output.lines().map(|line| line.chars().count()).max().unwrap();
    assert!((90..=100).contains(&widest), "{output}");
    assert!(!output.contains('\x1b'), "{output:?}");
}
