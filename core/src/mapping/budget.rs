//! What a search may spend, and what it ran out of.

use serde::{Deserialize, Serialize};

use crate::model::Space;

/// What a search may spend. Its time is bounded by its caller's [`Interrupt`](crate::interrupt::Interrupt).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Most nodes expanded; without what is looked at to make estimates.
    pub max_expansions: u64,
    /// About the most memory that it takes, in bytes: for the nodes and states that it finds, for tables of estimates, which take
    /// half of it at most, for ways and for the mapping. What does not fit is
    /// left out, and when nothing is left, the search ends.
    ///
    /// Not counted are the problem itself, the model, what its mapper [keeps](super::Mapper::size_bytes) of searches before, and about a
    /// hundred bytes for each observation and step of mappings with many actions for an observation.
    pub max_bytes: usize,
}

impl Budget {
    /// Any number of expansions, within 1 GB.
    pub const DEFAULT: Self = Self { max_expansions: u64::MAX, max_bytes: 1 << 30 };

    /// What is left of it if `n_bytes` are taken.
    pub(in crate::mapping) fn beside(self, n_bytes: usize) -> Self {
        Self { max_bytes: self.max_bytes.saturating_sub(n_bytes), ..self }
    }

    /// Whether there is no more memory: for `n_bytes`, and what was found in `space`.
    #[inline]
    pub(in crate::mapping) fn is_full(self, n_bytes: usize, space: &impl Space) -> bool {
        n_bytes + space.found_bytes() >= self.max_bytes
    }
}

impl Default for Budget {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// What a search ran out of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum StoppedBy {
    /// The expansions that the request allows.
    MaxExpansions,
    /// Time.
    #[serde(rename = "deadline_ms")]
    Deadline,
    /// The memory that a search may take.
    Memory,
}

impl StoppedBy {
    /// What it is called in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::MaxExpansions => "max_expansions",
            Self::Deadline => "deadline_ms",
            Self::Memory => "memory",
        }
    }
}
