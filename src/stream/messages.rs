//! What passes between a transport and the protocol.

use serde_json::Value;
use tokio_util::bytes::Bytes;

use super::closing::{Closed, Over};
use super::frames::ClientFrame;
use super::limits::Limits;
use super::problem::StreamProblem;
use super::queue::Weighed;
use super::room::{Crowded, Taken};
use etude_core::document::{self, ParseError};

/// What came from the client.
#[derive(Debug)]
pub enum Incoming {
    /// A frame.
    Frame {
        /// Its text.
        text: Bytes,
        /// What it takes of the memory of the service until it is handled, if it is not small.
        memory: Option<Taken>,
    },
    /// Something that is no frame: a binary message.
    Binary,
    /// A frame over the limit.
    TooLarge,
    /// Text that is not UTF-8.
    NotText,
    /// Something that the transport does not allow, and what.
    Violation(String),
    /// A frame that there is no memory for.
    Crowded,
}

impl Weighed for Incoming {
    fn n_bytes(&self) -> usize {
        if let Self::Frame { text, .. } = self { text.len() } else { 0 }
    }
}

/// What goes to the client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outgoing {
    /// A frame.
    Frame(String),
    /// The end of the connection.
    Close(Closed),
}

impl Weighed for Outgoing {
    fn n_bytes(&self) -> usize {
        if let Self::Frame(text) = self { text.len() } else { 0 }
    }
}

/// The text of what came, and its memory.
pub(super) fn text_of(came: Incoming, limits: Limits) -> Result<(Bytes, Option<Taken>), Over> {
    let bad = |problem| Over::because(Closed::BadFrame, problem);
    match came {
        Incoming::Frame { text, memory } if text.len() <= limits.frame_bytes => Ok((text, memory)),
        Incoming::Frame { .. } | Incoming::TooLarge => {
            let detail = format!("a frame has at most {} bytes", limits.frame_bytes);
            Err(Over::because(Closed::TooLarge, StreamProblem::new("too-large", detail)))
        }
        Incoming::Binary => Err(bad(StreamProblem::new("bad-frame", "expected text, found a binary message"))),
        Incoming::NotText => {
            let problem = StreamProblem::new("malformed-json", "the frame is not UTF-8");
            Err(Over::because(Closed::NotText, problem))
        }
        Incoming::Violation(what) => {
            let detail = format!("against the protocol of websockets: {what}");
            Err(Over::because(Closed::Protocol, StreamProblem::new("bad-frame", detail)))
        }
        Incoming::Crowded => {
            let problem = StreamProblem::new("overloaded", Crowded.to_string());
            Err(Over::because(Closed::Overloaded, problem))
        }
    }
}

/// Reads the text of a frame.
pub(super) fn read_frame(text: &[u8]) -> Result<ClientFrame, Over> {
    let bad = |problem| Over::because(Closed::BadFrame, problem);
    let frame: Value = document::parse(text).map_err(|error| match error {
        ParseError::Syntax { .. } => {
            Over::because(Closed::NotText, StreamProblem::new("malformed-json", error.to_string()))
        }
        ParseError::Faults(faults) => bad(StreamProblem::of("bad-frame", &faults)),
    })?;
    ClientFrame::read(frame).map_err(|faults| bad(StreamProblem::of("bad-frame", &faults)))
}
