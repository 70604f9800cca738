//! Tables of groups of several attributes.
//!
//! | table | has | where |
//! |---|---|---|
//! | [`bounded`] | the classes that may be on a mapping cheaper than a known one | these are few |
//! | [`whole`] | all classes | a known mapping rules few of them out, as in a long demonstration that is hard to follow |

mod bounded;
mod whole;

use super::projected::{Estimate, Table};
use super::projection::Group;
use super::shares::Parts;
use crate::interrupt::{Meter, Signal};
use crate::model::States;
use bounded::Bounded;
use whole::Whole;

/// What the tables of the single attributes say, on which those of a group rest.
pub(super) struct Basis<'b> {
    pub(super) states: &'b States,
    /// By the group's digits: where the attribute's values begin in the tables; `None` if it is not in them.
    pub(super) columns: &'b [Option<usize>],
    /// Distances.
    pub(super) table: &'b Table<Estimate>,
    /// Least costs from the start, with the distance.
    pub(super) forward: &'b Table<f64>,
    /// The least distance of any state, and the least of what the group's attributes add to it. Shape `[n_observations]`.
    pub(super) least_distances: &'b [f64],
    pub(super) least_terms: &'b [f64],
    /// What a mapping may cost in this group's part: what costs as much or more is dropped.
    pub(super) limit: f64,
}

/// How many entries tables may have.
#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    /// Those of classes that matter, all groups' together,
    pub(super) bounded: usize,
    /// and those of all classes.
    pub(super) whole: usize,
}

/// The table of a group.
#[derive(Debug)]
pub(super) enum Joint<'p> {
    Bounded(Bounded<'p>),
    Whole(Whole<'p>),
}

/// Why there is no table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unsolved {
    /// It would have too many entries.
    TooLarge,
    /// The interrupt said so.
    Interrupted(Signal),
}

impl<'p> Joint<'p> {
    /// Makes the table, and takes the room that it needs.
    pub(super) fn solve(
        group: &'p Group,
        basis: &Basis<'_>,
        parts: &Parts<'_>,
        room: &mut Room,
        meter: &mut Meter<'_>,
    ) -> Result<Self, Unsolved> {
        let mut n_left = room.bounded;
        match Bounded::solve(group, basis, parts, &mut n_left, meter) {
            Ok(table) => {
                room.bounded = n_left;
                Ok(Self::Bounded(table))
            }
            Err(Unsolved::TooLarge) => {
                room.whole = Whole::room_after(room.whole, group, basis).ok_or(Unsolved::TooLarge)?;
                let whole = Whole::solve(group, basis, parts, meter).map_err(Unsolved::Interrupted)?;
                whole.map(Self::Whole).ok_or(Unsolved::TooLarge)
            }
            Err(unsolved) => Err(unsolved),
        }
    }

    /// The cost-to-go of the class of a state with these domain indices; infinite if no mapping through it is worth finding.
    #[inline]
    pub(super) fn cost_to_go(&self, observation: usize, values: &[u32]) -> f64 {
        match self {
            Self::Bounded(table) => table.cost_to_go(observation, values),
            Self::Whole(table) => table.cost_to_go(observation, values),
        }
    }

    pub(super) fn group(&self) -> &'p Group {
        match self {
            Self::Bounded(table) => table.group(),
            Self::Whole(table) => table.group(),
        }
    }
}
