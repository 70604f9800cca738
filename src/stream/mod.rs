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
//! The server speaks first: `hello`. Then the client opens or resumes a session, observes, and ends; see
//! [`frames`] for each frame. What is wrong is answered by an `error` frame with a problem:
//!
//! | what | problem | then |
//! |---|---|---|
//! | not JSON, or not UTF-8 | `malformed-json` | close 1007 |
//! | a frame over the limit | `too-large` | close 1009 |
//! | a binary message; no object; an unknown type; missing, unknown or faulty fields of a frame | `bad-frame` | close 4400 |
//! | `open` with faults | `invalid`, with pointers | close 4400 |
//! | an unknown model, learner or session; one that has expired | `unknown-model`, .. `expired` | close 4404 |
//! | `observe` or `end` without a session; a second `open` or `resume`; a reward without a trial | `not-allowed` | close 1008 |
//! | `seq` beyond what was received | `gap` | goes on; nothing was taken |
//! | states with faults | `invalid`, with pointers | goes on; none of the frame's states was taken |
//! | more observations than a session may have; an end without any | `too-many-observations`, `empty` | goes on |
//! | `observe` or `end` after the end of an exploring session; a second, other reward | `ended`, `already-rewarded` | goes on |
//! | the session is resumed on another connection | `taken-over` | close 1008 |
//! | nothing came for too long | `idle` | close 1008 |
//! | too many sessions; the client does not read | `overloaded` | close 1013, to be resumed |
//! | the server shuts down | `stopping` | close 1001, to be resumed |
//! | the server failed | `internal` | close 1011, to be resumed |
//!
//! Observations that were received before are ignored, so a client may send again whatever it is not sure of. After `done`
//! the server closes with 1000, and what still comes is ignored; a session that explores waits for its reward before.

mod engine;
pub mod frames;

pub use engine::{Closed, Incoming, Limits, Outgoing, PROTOCOL, run};
