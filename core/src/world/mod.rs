//! Worlds: where policies are executed and rewards are given.
//!
//! A world is not the imitator's model of it. It executes any action, also one that has no transition in the model, so an execution may
//! differ from what the policy predicts.

mod wumpus;

pub use wumpus::{Execution, Rewards, WumpusWorld};
