//! How a connection ends: its close code, and what the client is told.

use std::error::Error;

use super::problem::StreamProblem;
use crate::service::{Outage, OutageKind, PoolError, ServiceError, SessionError};

/// Why a connection ended: a websocket close code.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closed {
    /// The policy is done.
    Done,
    /// The client said nothing more.
    ByClient,
    /// The client gave no sign of life; the session is to be resumed.
    Silent,
    /// The server shuts down; the session is to be resumed.
    GoingAway,
    /// Something that a websocket does not allow.
    Protocol,
    /// Not JSON, or not UTF-8.
    NotText,
    /// Not allowed now.
    NotAllowed,
    /// A frame over the limit, whoever was to send it, or a policy.
    TooLarge,
    /// The server failed; the session is to be resumed.
    Failed,
    /// The server has too much to do, or the client is too slow; the session is to be resumed.
    Overloaded,
    /// A frame that cannot be understood.
    BadFrame,
    /// A model, learner or session that is unknown.
    Unknown,
}

impl Closed {
    /// The close code and reason of a websocket.
    #[must_use]
    pub fn code(self) -> (u16, &'static str) {
        match self {
            Self::Done | Self::ByClient => (1000, "done"),
            Self::GoingAway => (1001, "the server shuts down; resume"),
            Self::Protocol => (1002, "against the protocol of websockets"),
            Self::NotText => (1007, "not JSON"),
            Self::NotAllowed => (1008, "not allowed"),
            Self::Silent => (1008, "no sign of life; resume"),
            Self::TooLarge => (1009, "too large"),
            Self::Failed => (1011, "the server failed; resume"),
            Self::Overloaded => (1013, "overloaded or too slow a reader; resume"),
            Self::BadFrame => (4400, "bad frame"),
            Self::Unknown => (4404, "unknown model, learner or session"),
        }
    }
}

/// Why the connection is over.
pub(super) struct Over {
    pub(super) closed: Closed,
    pub(super) problem: Option<StreamProblem>,
}

impl Over {
    pub(super) fn because(closed: Closed, problem: StreamProblem) -> Self {
        Self { closed, problem: Some(problem) }
    }
}

pub(super) fn not_allowed(detail: &str) -> Over {
    Over::because(Closed::NotAllowed, StreamProblem::new("not-allowed", detail))
}

/// How an error ends the connection.
pub(super) fn ends(error: &SessionError) -> Over {
    let detail = error.to_string();
    match error {
        SessionError::Faults(faults) => Over::because(Closed::BadFrame, StreamProblem::of("invalid", faults)),
        SessionError::NotOpen => Over::because(Closed::Unknown, StreamProblem::new("expired", detail)),
        SessionError::TakenOver => Over::because(Closed::NotAllowed, StreamProblem::new("taken-over", detail)),
        SessionError::TooManySteps(_) => {
            Over::because(Closed::TooLarge, StreamProblem::new("policy-too-large", detail))
        }
        SessionError::Gap { .. } | SessionError::TooMany | SessionError::Empty | SessionError::Ended => {
            not_allowed(&detail)
        }
        SessionError::Service(ServiceError::Unknown { kind, .. }) => {
            Over::because(Closed::Unknown, StreamProblem::new(&format!("unknown-{}", kind.name()), detail))
        }
        SessionError::Service(ServiceError::Pool(PoolError::Stopped) | ServiceError::Closed) => {
            Over::because(Closed::GoingAway, StreamProblem::new("stopping", detail))
        }
        SessionError::Service(
            ServiceError::Pool(PoolError::Busy)
            | ServiceError::NoRoom(_)
            | ServiceError::Shortage(_)
            | ServiceError::Compiling { .. }
            | ServiceError::Unavailable(Outage { kind: OutageKind::Slow, .. }),
        ) => Over::because(Closed::Overloaded, StreamProblem::new("overloaded", detail)),
        SessionError::Service(ServiceError::Unavailable(Outage { kind: OutageKind::Full, .. })) => {
            Over::because(Closed::Failed, StreamProblem::new("storage-full", detail))
        }
        SessionError::Service(ServiceError::Unavailable(_)) => {
            Over::because(Closed::Failed, StreamProblem::new("not-ready", detail))
        }
        SessionError::Service(_) => {
            tracing::error!(error = error as &dyn Error, "a stream failed");
            let problem = StreamProblem::new("internal", "an internal error was logged; resume the session");
            Over::because(Closed::Failed, problem)
        }
    }
}
