//! Steps on their way to a client.

use std::ops::Deref;

use etude_core::mapping::CommittedStep;
use etude_core::model::Model;

use crate::memory::{Held, Memory, NoRoom};

/// Steps that were committed, and the memory that they take, if it is much.
#[derive(Debug, Default)]
pub struct CommittedSteps {
    steps: Vec<CommittedStep>,
    held: Option<Held>,
    /// How much is counted.
    n_bytes: usize,
}

impl CommittedSteps {
    /// Takes what `n_steps` more of `model` need.
    pub(super) fn take_for(&mut self, n_steps: usize, model: &Model, memory: &Memory) -> Result<(), NoRoom> {
        self.take_more(n_steps.saturating_mul(CommittedStep::bytes_of(model)), memory)
    }

    /// Takes `n_bytes` more, for what comes with the steps.
    pub(super) fn take_more(&mut self, n_bytes: usize, memory: &Memory) -> Result<(), NoRoom> {
        let n_bytes = self.n_bytes.saturating_add(n_bytes);
        memory.reserve(&mut self.held, n_bytes)?;
        self.n_bytes = n_bytes;
        Ok(())
    }

    /// How much memory they take, roughly, in bytes.
    pub(super) fn n_bytes(&self) -> usize {
        self.n_bytes
    }

    /// Gives back `n_bytes` of what was taken more.
    pub(super) fn give_back(&mut self, n_bytes: usize) {
        self.n_bytes -= n_bytes;
        if let Some(held) = &mut self.held {
            held.shrink_to(self.n_bytes as u64);
        }
    }

    /// Holds the memory that was taken by `other`, which has no steps, too.
    pub(super) fn with(mut self, other: Self) -> Self {
        match (&mut self.held, other.held) {
            (Some(held), Some(more)) => held.merge(more),
            (held @ None, more) => *held = more,
            (Some(_), None) => {}
        }
        self.n_bytes += other.n_bytes;
        self
    }

    /// Appends steps, whose memory is counted.
    pub(super) fn extend(&mut self, steps: Vec<CommittedStep>) {
        self.steps.extend(steps);
    }
}

impl Deref for CommittedSteps {
    type Target = [CommittedStep];

    fn deref(&self) -> &[CommittedStep] {
        &self.steps
    }
}
