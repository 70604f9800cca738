//! What holds for the repository as a whole: its layers and its container. Nothing is run.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

mod container;
mod layers;
