//! What holds for the repository as a whole: its layers, its files and its container. Nothing is run.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

mod circles;
mod container;
mod layers;
mod lengths;
mod sources;
