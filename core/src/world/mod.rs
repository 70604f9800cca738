//! Worlds: where policies are executed and rewards are given.
//!
//! A world is apart from the imitator's model of it. It executes whatever it is told, whatever the model thinks, so that
//! the execution may differ from the prediction.

mod wumpus;

pub use wumpus::{Execution, Rewards, WumpusWorld};
