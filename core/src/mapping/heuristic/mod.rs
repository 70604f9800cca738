//! Estimates of what is still to be paid from a node to the end.
//!
//! | name | admissible | consistent | made of |
//! |---|---|---|---|
//! | `default` | yes | yes | exact costs of the problem projected on each attribute ([`projection`]); in long searches, on a group of them ([`abstraction`]) |
//! | `none` | yes | yes | nothing: A* becomes Dijkstra's algorithm |
//! | `paper` | no | no | differences and least action cost ([`paper`]) |

pub(super) mod abstraction;
pub(super) mod paper;
pub(super) mod projected;
pub(super) mod projection;
mod shares;

use serde::{Deserialize, Serialize};

use crate::interrupt::{Interrupted, Meter};
use abstraction::{Abstracted, KnownCosts};
use projected::Projected;

/// An estimate of the cost from a node to the end of the demonstration.
///
/// *Admissible*: never above the least cost of a completion; a search with it finds the optimum. *Consistent*: along no
/// move does it fall by more than the move's cost; a search with it expands no node twice.
pub(super) trait Heuristic {
    /// Estimated cost from the node of `observation` and the state with this row to the end. At least 0; 0 at the last
    /// observation if ending is free.
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64;

    /// How much work an estimate for a node at `observation` is, in looks at a distance. At least 1.
    fn work(&self, _observation: usize) -> u64 {
        1
    }
}

/// What guides a best-first search: estimates, and how they are raised if it takes long.
pub(super) struct Guide<'g, 'p> {
    pub(super) projected: &'g Projected<'p>,
    pub(super) raising: Option<Raising<'g, 'p>>,
}

/// How estimates are raised.
pub(super) struct Raising<'g, 'p> {
    /// After so many expansions,
    pub(super) after: u64,
    /// if the cheapest mapping that is known costs so many times what all cost at least. Unless this is 0, that is asked each time after cheaper
    /// ones were looked for.
    pub(super) least_excess: f64,
    /// Makes an abstraction in so many bytes and in this memory, if there is one.
    pub(super) abstract_in: &'g mut Abstracting<'g, 'p>,
}

type Abstracting<'g, 'p> =
    dyn FnMut(usize, &mut KnownCosts, &mut Meter<'_>) -> Result<Option<Abstracted<'p>>, Interrupted> + 'g;

impl<'g, 'p> From<&'g Projected<'p>> for Guide<'g, 'p> {
    fn from(projected: &'g Projected<'p>) -> Self {
        Self { projected, raising: None }
    }
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
