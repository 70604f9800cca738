//! The server's frames as a client reads them: owned, and only as far as they are shown.
//!
//! [`ServerFrame`](crate::stream::frames::ServerFrame) is what is written: it borrows, and cannot be read. What the program maps by
//! itself is written so and read here as what a service sends is, so that the two cannot drift apart unnoticed.

use serde::Deserialize;

use crate::cli::CliError;
use crate::cli::input::Spot;
use crate::cli::options::faulty;
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::document::Fault;
use etude_core::mapping::{Cost, MoveKind, Status, Warning};

/// A frame of the server.
#[derive(Debug, Deserialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub(in crate::cli) enum Frame {
    Hello,
    Opened {
        session: String,
        weights: ByAttribute<f64>,
        received: u32,
    },
    Received {
        seq: u32,
    },
    Step(StepFrame),
    Done {
        policy_id: Option<String>,
        status: Status,
        cost: Cost,
        #[serde(default)]
        warnings: Vec<Warning>,
    },
    Error {
        problem: Problem,
    },
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

pub(super) fn nothing_observed() -> CliError {
    CliError::Stream("nothing was observed".to_owned())
}

impl Problem {
    /// What was wrong, where that was the observation at `spot`, or what `tell` says of the frame that opened the stream.
    pub(in crate::cli) fn told(self, spot: Option<&Spot>, tell: impl FnOnce(&[Fault]) -> CliError) -> CliError {
        let Self { kind, detail, errors } = self;
        match (kind.as_str(), spot) {
            ("/problems/invalid", Some(spot)) => {
                let told = errors.iter().map(|Fault { pointer, detail, .. }| {
                    // Each frame has one state.
                    spot.tell(pointer.strip_prefix("/states/0").unwrap_or(pointer), detail)
                });
                faulty(told.collect(), 0)
            }
            ("/problems/invalid", None) if !errors.is_empty() => tell(&errors),
            ("/problems/empty", _) => nothing_observed(),
            _ => CliError::Stream(detail),
        }
    }
}
