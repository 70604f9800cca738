//! Observations on their way into a session.

use super::committed::CommittedSteps;

/// An observation as it was read.
#[derive(Clone, Debug)]
pub struct Observation {
    /// Shape `[n_attributes]`; `None` where an attribute was not observed.
    pub values: Vec<Option<etude_core::attribute::Value>>,
    /// Its weight; `None`: what the session was opened with.
    pub weight: Option<f64>,
}

/// What was received and is not mapped yet, or not in full.
#[derive(Debug, Default)]
pub struct Waiting {
    pub(super) observations: std::vec::IntoIter<Observation>,
    /// What was committed before.
    pub(super) steps: CommittedSteps,
}

impl From<Vec<Observation>> for Waiting {
    fn from(observations: Vec<Observation>) -> Self {
        Self { observations: observations.into_iter(), steps: CommittedSteps::default() }
    }
}

/// What became of observations that were received, besides being durable.
#[derive(Debug)]
pub enum Received {
    /// They were mapped at the same time, and commit these steps.
    Mapped(CommittedSteps),
    /// They take longer to be mapped: see [`Session::advance`](super::Session::advance).
    Waiting(Waiting),
}
