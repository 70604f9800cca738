//! The server's frames as a client reads them: owned, and only as far as they are shown.
//!
//! [`ServerFrame`](crate::stream::frames::ServerFrame) is what is written: it borrows, and cannot be read. What the program maps by
//! itself is written so and read here as what a service sends is, so that the two cannot drift apart unnoticed.

use serde::Deserialize;

use crate::cli::CliError;
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::mapping::{Cost, MoveKind, Status};

/// A frame of the server.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub(in crate::cli) enum Frame {
    Hello,
    Opened { session: String, weights: ByAttribute<f64>, received: u32 },
    Received { seq: u32 },
    Step(StepFrame),
    Done { policy_id: Option<String>, status: Status, cost: Cost },
    Error { problem: Problem },
}

/// A committed step.
#[derive(Debug, Deserialize)]
pub(in crate::cli) struct StepFrame {
    pub(in crate::cli) step: u32,
    pub(in crate::cli) observation: u32,
    #[serde(rename = "move")]
    pub(in crate::cli) kind: MoveKind,
    pub(in crate::cli) action: Option<String>,
    pub(in crate::cli) state: ByAttribute<Scalar>,
    pub(in crate::cli) distance: f64,
    pub(in crate::cli) cost: f64,
    pub(in crate::cli) proven: bool,
    pub(in crate::cli) after: u32,
}

/// What a service found wrong.
#[derive(Debug, Deserialize)]
pub(in crate::cli) struct Problem {
    #[serde(rename = "type")]
    kind: String,
    detail: String,
    #[serde(default)]
    errors: Vec<Fault>,
}

impl Problem {
    /// Whether it is one of the service that passes, so that the session is to be resumed.
    pub(in crate::cli) fn is_passing(&self) -> bool {
        ["/problems/stopping", "/problems/overloaded", "/problems/internal"].contains(&self.kind.as_str())
    }
}

/// What is wrong at one place of a frame.
#[derive(Debug, Deserialize)]
struct Fault {
    pointer: String,
    detail: String,
}

pub(super) fn nothing_observed() -> CliError {
    CliError::Stream("nothing was observed".to_owned())
}

/// What the service found wrong, with the line of the input where it is that.
pub(in crate::cli) fn refused(problem: Problem, line: Option<u64>) -> CliError {
    let Problem { kind, detail, errors } = problem;
    match (kind.as_str(), line) {
        ("/problems/invalid", Some(line)) => {
            let places = errors.iter().map(|Fault { pointer, detail }| {
                // Each frame has one state, which is the line.
                format!("{}: {detail}", pointer.strip_prefix("/states/0").unwrap_or(pointer))
            });
            CliError::Line { line, problem: places.collect::<Vec<_>>().join("\n") }
        }
        ("/problems/empty", _) => nothing_observed(),
        _ => {
            let places = errors.iter().map(|Fault { pointer, detail }| format!("\n{pointer}: {detail}"));
            CliError::Stream(detail + &places.collect::<String>())
        }
    }
}
