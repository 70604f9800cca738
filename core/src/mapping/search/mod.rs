//! Searches for the cheapest mapping.
//!
//! | module | is | used with |
//! |---|---|---|
//! | [`layered`] | beams, and what they leave, layer by layer | the default heuristic, in small problems |
//! | [`banded`] | the same for more states than can be listed, in bands of `f` | the default heuristic, in larger ones of the same kind |
//! | [`best_first`] | A* for consistent estimates, with an incumbent and buckets | the default heuristic, in others and in long searches, and none |
//! | [`sweep`] | what it costs to go on from every node, from the last layer back | what takes the others long |
//! | [`astar`] | A* as in the textbook | the paper's heuristic, which is not consistent |
//! | [`seen`], [`nodes`] with [`index`], [`buckets`] | the states, the closed and the open list of [`best_first`]; the first of [`banded`], too | |

pub(super) mod astar;
pub(super) mod banded;
pub(super) mod best_first;
mod buckets;
mod index;
pub(super) mod layered;
mod nodes;
mod seen;
pub(super) mod sweep;

use serde::{Deserialize, Serialize};

use super::StoppedBy;
use crate::model::{ActionIdx, StateIdx};

/// How a step advances.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum MoveKind {
    /// The first step: `s_0` against `o_0`.
    Start,
    /// An action, to the next observation.
    Match,
    /// An action, under the same observation.
    Extra,
    /// No action, to the next observation.
    Skip,
}

/// A step of a mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Move {
    /// How it advances.
    pub kind: MoveKind,
    /// The action, unless `kind` is `Start` or `Skip`.
    pub action: Option<ActionIdx>,
    /// The observation after the step.
    pub observation: u32,
    /// The imitator's state after the step.
    pub state: StateIdx,
}

/// What a search found.
#[derive(Debug)]
pub(in crate::mapping) struct Found {
    /// The way from `(0, s_0)` to each of these nodes: one that ends at the last observation if `is_complete`, else the
    /// most promising ones, all to be completed.
    pub(in crate::mapping) paths: Vec<Vec<Move>>,
    /// Whether the search came to its end.
    pub(in crate::mapping) is_complete: bool,
    /// What ran out, if it did not.
    pub(in crate::mapping) stopped_by: Option<StoppedBy>,
    /// No mapping costs less than this, or than the cheapest of the paths, if the heuristic is admissible.
    pub(in crate::mapping) least_f: f64,
    /// Nodes expanded, again counted if they were reached more cheaply later.
    pub(in crate::mapping) n_expanded: u64,
    /// Successors looked at.
    pub(in crate::mapping) n_generated: u64,
}

/// How a part of a search ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// All is done that was to be done.
    Done,
    /// This was used up.
    CutShort(StoppedBy),
}

impl End {
    fn stopped_by(self) -> Option<StoppedBy> {
        match self {
            Self::Done => None,
            Self::CutShort(stopped_by) => Some(stopped_by),
        }
    }
}

/// How many distances are looked at between two looks at the interrupt: less than a millisecond with a few attributes.
pub(in crate::mapping) const POLL_EVERY: u64 = 2048;

/// Stands for "no action" in a node.
const NO_ACTION: ActionIdx = ActionIdx::MAX;
