//! The paper's experiments, whatever they run on.
//!
//! ```text
//! figure_4, figure_7, figure_8 --> Laboratory: maps, draws, learns --> in this process (Local), or a service (cli)
//!            |
//!            +--> WumpusWorld: executes, rewards
//! ```
//!
//! An experiment is determined by its seeds: every laboratory gives the same numbers, bit for bit.

mod curve;
mod local;
mod locations;
mod paths;
pub mod plot;
mod scene;

use std::collections::BTreeMap;

pub use curve::{Curve, CurvePlan, Point, Run, figure_7};
pub use local::{Local, LocalError};
pub use locations::{LocationRow, Locations, figure_8};
pub use paths::{Paths, figure_4};
pub use scene::Scene;

use etude_core::learning::LearnerDocument;

/// What experiments run on: it maps, draws trials and learns. The worlds, which give rewards, are outside of it.
pub trait Laboratory {
    /// Why it failed.
    type Error;

    /// Starts a learner under a name that is its own.
    ///
    /// # Errors
    ///
    /// If it cannot.
    fn start_learner(&mut self, definition: &LearnerDocument) -> Result<LearnerId, Self::Error>;

    /// Draws a trial for `scene`.
    ///
    /// # Errors
    ///
    /// If it cannot.
    fn draw(&mut self, learner: &LearnerId, scene: &Scene) -> Result<Attempt, Self::Error>;

    /// Gives a trial its reward; the learner has learned from it when this returns.
    ///
    /// # Errors
    ///
    /// If it cannot.
    fn learn(&mut self, learner: &LearnerId, attempt: &Attempt, reward: f64) -> Result<(), Self::Error>;

    /// The mean weights of a learner, by attribute.
    ///
    /// # Errors
    ///
    /// If it cannot.
    fn means(&mut self, learner: &LearnerId) -> Result<BTreeMap<String, f64>, Self::Error>;

    /// Maps the demonstration of `scene` with the mean weights of a learner, or with the model's own.
    ///
    /// # Errors
    ///
    /// If it cannot.
    fn map(&mut self, scene: &Scene, learner: Option<&LearnerId>) -> Result<Followed, Self::Error>;
}

/// A learner in a laboratory.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LearnerId(pub String);

/// A trial that was drawn.
#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    /// Its id in the laboratory.
    pub id: String,
    /// The actions to execute.
    pub actions: Vec<String>,
}

/// What experiments use of a mapping.
#[derive(Clone, Debug, PartialEq)]
pub struct Followed {
    /// The actions to execute.
    pub actions: Vec<String>,
    /// Total cost of the mapping.
    pub cost: f64,
}
