//! Mapping: the imitator's best way to follow a demonstration.
//!
//! A node is a pair `(i, s)` of an observation index and an imitator's state. A mapping starts at any `(0, s_0)`, with `s_0` among the
//! start states, at cost `e_0 D(o_0, s_0)`, ends at any `(n, s)` at cost `w D(o_n, s)`, and consists of these moves:
//!
//! | move | from -> to | cost |
//! |---|---|---|
//! | `match` | action a: `(i, s) -> (i+1, s')` | `A(s, a, s') + e_{i+1} D(o_{i+1}, s')` |
//! | `extra` | action a: `(i, s) -> (i, s')` | `A(s, a, s') + x e_i D(o_i, s')` |
//! | `skip` | no action: `(i, s) -> (i+1, s)` | `e_{i+1} D(o_{i+1}, s)` |
//!
//! The weights of observations `e`, the part x of the distance that extra actions pay, and the weight w of the end are 1, 1 and 0 unless
//! the [`Conditions`] say otherwise; `A` is what the transition costs itself, or else its action.
//!
//! That is dynamic time warping of a sequence against a walk in a graph (Gudla & Huber, "Cost-Based Policy Mapping for
//! Imitation", FLAIRS 2003). Skipping everything is always possible, so a mapping always exists.
//!
//! ```text
//! Problem (model, demonstration, weights, conditions)
//!    |                     Projections (per model) --> Projected (per problem: distances, costs-to-go)
//!    v                                                     |
//! Mapper::map ---- search (layer by layer, best first) <---+
//!    |                |  long: a sweep over all nodes; budget over: the incumbent, or completion (greedy)
//!    v                v
//! Mapping (moves, status, lower bound, counts) --> WrittenPolicy (as it is stored and answered) --> Policy (read from the answer)
//! ```
//!
//! [`OnlineMapping`] does the same while the demonstration is still running.
//!
//! Which search is chosen, by the problem and the budget alone:
//!
//! | search | chosen when | why |
//! |---|---|---|
//! | `search::layered` | default heuristic; extra actions pay whole distances and ending is free; at most 65,536 nodes (observations times states); expansions allowed for twice as many, and memory for all | an expansion takes less than half of the time: figure 4 takes 13 microseconds rather than 24 |
//! | `search::banded` | default heuristic, in larger problems of this kind, of at most 256 observations, whose estimates are sums of entries of tables of at most eight attributes that change; up to 131,072 expansions, or until its memory is used up | it looks at a small part of the nodes, and an expansion takes half of the time |
//! | `search::best_first` | default heuristic, in all other problems, also where states are found as it goes, and after a search in bands that has not come to its end; and no heuristic, where it has no estimates | it looks at a small part of the nodes |
//! | `search::sweep` | one of these has expanded 65,536 nodes, or one in 16 if that is more, or memory is used up; all states are known | it takes a sixteenth of the time for a node and two bytes of memory |
//! | `search::astar` | the paper's heuristic | that one is not consistent, and which of its mappings is found is part of what is reproduced |
//! | `online` | a lookahead, or the demonstration is still running | with a lookahead, one of the above for each window; else, and where windows are small, layers of all states |
//! | `completion` | a budget ran out before the last observation | there is always an answer |
//!
//! Searches in bands and best first begin with those tables of estimates alone that are small, and make the others once they have expanded a
//! sixteenth of their entries, as large tables may take longer than the search (`mapper::by_default`). Where a best-first search takes long,
//! estimates are raised by a group of attributes that are projected together (`heuristic::abstraction`): if extra actions pay less than a
//! quarter of the distance, after 2,048 expansions, or one for 1,024 nodes if that is more; else after as many, as soon as a probe for cheaper
//! mappings leaves one that costs twice as much as all cost at least. What moves cost is said in `recurrence`, for all of them.
//!
//! **Ties.** Answers are deterministic. The first path found to a node wins ties: it is replaced only by a cheaper one, by the sums of
//! floats along the paths. A node's successors are generated in this order: the `skip`, then for each action the `match` and the `extra`.
//!
//! - `search::layered` expands each layer in the order in which its nodes were found, those within a beam first.
//! - `search::banded` goes through the layers as beams, which expand a layer's nodes in the order in which they were found, and then in passes,
//!   one for each band of `f`, which expand those of the band that were found last first, and then those to which extra actions led from them.
//! - `search::best_first` expands nodes in the order of `f` to a thousandth, the most recently found of equals first.
//! - `search::sweep` leaves a node by the skip unless a match is cheaper, and by a match unless an extra action is cheaper. Whether it
//!   replaces a best-first search depends on the problem and the budget alone.

mod budget;
#[cfg(test)]
mod by_definition;
mod completion;
mod conditions;
mod cost;
mod demonstration;
mod distances;
mod documents;
mod end;
mod heuristic;
mod mapper;
mod online;
mod open_list;
mod options;
#[cfg(feature = "rules")]
mod perception;
mod policy;
mod problem;
mod recurrence;
mod request;
mod search;
mod searchable;
mod warnings;
mod written;

pub use budget::{Budget, StoppedBy};
pub use conditions::Conditions;
pub use cost::Cost;
pub use demonstration::{Demonstration, Weighted, WellFormed};
pub(crate) use distances::Distances;
pub use documents::{ObservationDocument, ObservedDocument, StartReference, StateReference};
pub use end::PolicyEnd;
pub use heuristic::HeuristicName;
pub use mapper::{Mapper, Mapping, Settings, Status};
pub(crate) use online::longest_lookahead;
pub use online::{CommittedMove, CommittedStep, OnlineMapping, PassedStates, Root, Shortage, Stopped};
pub use options::{Options, RequestKind};
#[cfg(feature = "rules")]
pub use perception::Perception;
pub use policy::{Coverage, Policy, PolicySummary, SearchReport, Stamp, Step, TooManySteps};
pub use problem::Problem;
pub(crate) use problem::Starts;
pub use request::Request;
pub use search::{Move, MoveKind};
pub use warnings::{Warning, Watch};
pub use written::{ShortSteps, WriteError, WrittenPolicy};
