//! The stream protocol `etude.v1+json`: observations in, committed steps out, while the demonstration is still running.
//!
//! The same JSON frames travel as text messages of a websocket, or one per line (NDJSON) both ways. This module is the
//! protocol itself, whatever the transport: [`run`] takes what came from a queue and puts answers into another.
//!
//! ```text
//! socket -> reader -> queue (bounded) -> run -> queue (bounded) -> writer -> socket
//!                                         |
//!                                    Session (durable), pool
//! ```
//!
#![doc = include_str!("protocol.md")]

mod engine;
pub mod frames;

pub use engine::{Closed, Incoming, Limits, Outgoing, PROTOCOL, run};
