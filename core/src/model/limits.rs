//! What a model may at most be, and why a definition gives none.

use crate::document::Faults;
use crate::interrupt::{Cancelled, Interrupted};

/// What a model may at most be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most states. A table with more is refused; where states follow from rules and more are reached, they are left to searches.
    pub max_states: usize,
    /// Most transitions of a table.
    pub max_transitions: usize,
    /// Most values of states that follow from rules: one for each state and attribute. If more are reached, the states are left to
    /// searches. This bounds the time that compiling takes.
    pub max_values: usize,
    /// About how much memory the model may take while it is compiled, in bytes. A table that would take more is refused
    /// ([`ReadError::TooLarge`](super::ReadError::TooLarge)); states that follow from rules are then left to searches.
    pub max_bytes: usize,
}

impl Limits {
    /// One million states and ten million transitions, which take a few hundred MB, at most 4 GB; and no more values than are made in a
    /// few seconds.
    pub const DEFAULT: Self =
        Self { max_states: 1_000_000, max_transitions: 10_000_000, max_values: 1 << 27, max_bytes: 4 << 30 };
    /// As much as can be told apart by indices.
    pub const NONE: Self =
        Self { max_states: usize::MAX, max_transitions: usize::MAX, max_values: usize::MAX, max_bytes: usize::MAX };
}

/// Why a definition gives no model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CompileError {
    /// The definition is at fault.
    #[error(transparent)]
    Faults(#[from] Faults),
    /// The caller asked for it to be cancelled.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// The caller's time was up.
    #[error("out of time")]
    OutOfTime,
}

impl From<Interrupted> for CompileError {
    fn from(interrupted: Interrupted) -> Self {
        match interrupted {
            Interrupted::Cancelled(cancelled) => Self::Cancelled(cancelled),
            Interrupted::OutOfTime => Self::OutOfTime,
        }
    }
}
