//! What an observation gives: committed steps, or why it was not taken.

use std::sync::Arc;

use crate::attribute::Scalar;
use crate::interrupt::Cancelled;
use crate::mapping::policy::Step;
use crate::model::Model;

/// A step that will not be revised.
#[derive(Clone, Debug, PartialEq)]
pub struct CommittedStep {
    /// The step.
    pub step: Step,
    /// Whether it is part of a cheapest mapping of the whole demonstration, whatever is still to come, among those that
    /// begin with the steps committed before it.
    pub is_proven: bool,
    /// How many observations had come when it was committed.
    pub after: u32,
}

impl CommittedStep {
    /// About how many bytes of memory a step of `model` takes.
    pub fn bytes_of(model: &Model) -> usize {
        const ATTRIBUTE_BYTES: usize = size_of::<(Arc<str>, Scalar)>() + size_of::<(Arc<str>, f64)>();
        size_of::<Self>() + model.schema().len() * ATTRIBUTE_BYTES
    }
}

/// Why an observation was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stopped {
    /// The caller lost interest.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// It would take more memory than the mapping may.
    #[error("what may still turn out to be the cheapest mapping takes more memory than there is for it")]
    Memory,
}
