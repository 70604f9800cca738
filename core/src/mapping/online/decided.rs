//! What looking ahead comes to: steps that are to be committed, or why there are none.

use serde::{Deserialize, Serialize};

use crate::interrupt::Cancelled;
use crate::mapping::{Move, PolicyEnd, StoppedBy};
use crate::model::{Origin, OriginRow, StateIdx};

/// A step that is to be committed.
#[derive(Debug)]
pub(super) struct Decided {
    /// In a model that is searched lazily, its state is told by `row`.
    pub(super) step: Move,
    /// What its action costs.
    pub(super) action_cost: f64,
    /// The terms of the distance at the node that it leads to, by position.
    pub(super) terms: Vec<(usize, f64)>,
    /// Its state's row, if the model is searched lazily.
    pub(super) row: Option<OriginRow>,
}

impl Decided {
    /// The state that it leads to.
    pub(super) fn origin(&self) -> Origin {
        self.row.clone().map_or(Origin::State(self.step.state), Origin::Row)
    }
}

/// The cheapest way from the root to the end.
#[derive(Debug)]
pub(super) struct Rest {
    pub(super) steps: Vec<Decided>,
    /// What ending costs.
    pub(super) end_cost: f64,
    pub(super) end: PolicyEnd,
    /// What its search ran out of, so that there may be cheaper ways.
    pub(super) stopped_by: Option<StoppedBy>,
    /// If nothing is committed: no mapping costs less.
    pub(super) lower_bound: f64,
    pub(super) work: Work,
}

/// How much was looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Work {
    /// Nodes.
    pub(super) n_expanded: u64,
    /// Transitions.
    pub(super) n_generated: u64,
}

impl std::ops::AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        self.n_expanded += other.n_expanded;
        self.n_generated += other.n_generated;
    }
}

/// The last committed node.
#[derive(Clone, Debug)]
pub(super) struct RootNode {
    pub(super) observation: u32,
    /// In a model that is searched lazily, told by `row`.
    pub(super) state: StateIdx,
    /// Its state's row, if the model is searched lazily.
    pub(super) row: Option<OriginRow>,
    /// The cost of the way to it, summed as those of all ways are.
    pub(super) cost: f64,
}

/// Why there is no decision.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::mapping) enum Halt {
    /// The caller lost interest.
    Cancelled,
    /// This ran out.
    OutOf(StoppedBy),
}

impl From<Cancelled> for Halt {
    fn from(_: Cancelled) -> Self {
        Self::Cancelled
    }
}
