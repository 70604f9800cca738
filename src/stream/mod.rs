//! The stream protocol `etude.v1+json`: observations in, committed steps out, while the demonstration is still running.
//!
//! The same JSON frames travel as text messages of a websocket, or one per line (NDJSON) both ways. This module is the
//! protocol itself, whatever the transport: [`run`] takes what came from a queue and puts answers into another.
//!
//! ```text
//! socket -> reader -> queue (bounded in bytes) -> run -> queue (bounded in bytes) -> writer -> socket
//!             |                                    |                                   |
//!            Room (memory)                    Session (durable), pool                 Room
//! ```
//!
#![doc = include_str!("protocol.md")]

mod closing;
mod engine;
pub mod frames;
mod limits;
mod messages;
mod observing;
mod outlet;
pub mod problem;
mod queue;
mod room;

pub use closing::Closed;
pub use engine::{PROTOCOL, run};
pub use limits::Limits;
pub use messages::{Incoming, Outgoing};
pub use queue::{Gone, QUEUE_BYTES, Queued, Receiver, Reserved, Sender, Weighed, queue};
pub use room::{Crowded, NotAdmitted, READ_BUFFER_BYTES, Room, Rooms, SMALL_FRAME_BYTES, Taken, WRITE_BUFFER_BYTES};
