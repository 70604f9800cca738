//! Estimates of what is still to be paid from a node to the end.
//!
//! | name | admissible | consistent | made of |
//! |---|---|---|---|
//! | `default` | yes | yes | exact costs of small projected problems ([`projection`]) |
//! | `none` | yes | yes | nothing: A* becomes Dijkstra's algorithm |
//! | `paper` | no | no | differences and least action cost ([`paper`]) |

mod edges;
mod grouping;
mod joint;
pub(super) mod paper;
pub(super) mod projected;
pub(super) mod projection;
mod shares;

use serde::{Deserialize, Serialize};

/// An estimate of the cost from a node to the end of the demonstration.
///
/// *Admissible*: never above the least cost of a completion; a search with it finds the optimum. *Consistent*: along no
/// move does it fall by more than the move's cost; a search with it expands no node twice.
pub(super) trait Heuristic {
    /// Estimated cost from the node of `observation` and the state with this row to the end. At least 0; infinite only for nodes
    /// that cannot be on a mapping cheaper than one that is known, else 0 at the last observation.
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64;

    /// How much work an estimate for a node at `observation` is, in looks at a distance. At least 1.
    fn work(&self, _observation: usize) -> u64 {
        1
    }
}

/// Estimates nothing.
#[derive(Clone, Copy, Debug)]
pub(super) struct Blind;

impl Heuristic for Blind {
    #[inline]
    fn cost_to_go(&self, _: usize, _: &[u32]) -> f64 {
        0.0
    }
}

/// When attributes are projected together, which makes estimates better and takes longer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Grouping {
    /// When a search takes so long that better estimates shorten it.
    #[default]
    WhenItPays,
    /// At once, the largest groups: the fewest expansions, whatever the estimates cost.
    Widest,
}

/// When that is, for [`Grouping::WhenItPays`].
#[derive(Clone, Copy, Debug)]
pub(super) struct GroupingPatience {
    /// After this many expansions,
    pub(super) min_expansions: u64,
    /// and after so many for each of the model's transitions: looking at one takes about as long.
    pub(super) expansions_per_transition: u64,
    /// How many expansions must have been done for each entry of a level's tables of the classes that matter; if 0, these may be of
    /// any size.
    pub(super) expansions_per_entry: u64,
    /// How many entries of tables of all classes are made for each expansion that was done.
    pub(super) full_entries_per_expansion: u64,
}

impl GroupingPatience {
    pub(super) const DEFAULT: Self = Self {
        min_expansions: 1 << 16,
        expansions_per_transition: 1,
        // An entry takes about as long as two; attempts that fail should not take much of the search, and they are repeated
        // whenever it has doubled.
        expansions_per_entry: 16,
        // In searches that are long enough, an entry takes a tenth of the time of an expansion: they wait for memory, and tables do not.
        full_entries_per_expansion: 16,
    };
}

/// Which estimate guides a search.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum HeuristicName {
    /// Exact costs of the problem projected on its attributes: admissible and consistent.
    #[default]
    Default,
    /// The paper's own estimate, which can miss the optimum; for reproduction.
    Paper,
    /// No estimate: Dijkstra's algorithm.
    None,
}

impl HeuristicName {
    /// Every heuristic, by its name in JSON.
    pub const ALL: [(&'static str, Self); 3] =
        [("default", Self::Default), ("paper", Self::Paper), ("none", Self::None)];
}
