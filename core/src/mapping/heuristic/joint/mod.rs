//! Tables of groups of several attributes.
//!
//! | table | has | where |
//! |---|---|---|
//! | [`bounded`] | the classes that may be on a mapping cheaper than a known one | these are few |
//! | [`full`] | all classes | a known mapping rules few of them out, as in a long demonstration that is hard to follow |

mod bounded;
mod full;

use super::projected::{Estimate, Table};
use super::projection::{Group, Unbuilt};
use super::shares::Parts;
use crate::interrupt::{Meter, Signal};
use crate::model::States;
use bounded::Bounded;
use full::Full;

/// What the table of a group is made from.
pub(super) struct Basis<'b> {
    pub(super) group: &'b Group,
    pub(super) parts: Parts<'b>,
    pub(super) states: &'b States,
    /// By the group's digits: where the attribute's values begin in the tables; `None` if it is not in them.
    pub(super) columns: Vec<Option<usize>>,
    /// Distances, in tables of the single attributes.
    pub(super) table: &'b Table<Estimate>,
    /// Least costs from the start, with the distance.
    pub(super) forward: &'b Table<f64>,
    /// The least distance of any state. Shape `[n_observations]`.
    pub(super) least_distances: &'b [f64],
    /// The least of what the group's attributes add to it. Shape `[n_observations]`.
    pub(super) least_terms: Vec<f64>,
    /// What a mapping may cost in this group's part: what costs as much or more is dropped.
    pub(super) limit: f64,
}

/// How large all tables of a level may be.
#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    /// In entries of tables that are bounded,
    pub(super) bounded: usize,
    /// and of those that are full.
    pub(super) full: usize,
    /// In bytes, with what it takes to make them. Tables take no more than [`MAX_BYTES`] of these.
    pub(super) bytes: usize,
}

/// The table of a group.
#[derive(Debug)]
pub(super) enum Joint {
    Bounded(Bounded),
    Full(Full),
}

/// Why there are no tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unsolved {
    /// They would have too many entries.
    TooLarge,
    /// There never can be.
    Impossible,
    /// The interrupt said so.
    Interrupted(Signal),
}

impl From<Unbuilt> for Unsolved {
    fn from(unbuilt: Unbuilt) -> Self {
        match unbuilt {
            Unbuilt::TooLarge => Self::TooLarge,
            Unbuilt::Interrupted(interrupted) => Self::Interrupted(interrupted.into()),
        }
    }
}

/// Most bytes of the tables of a level, 256 MB, whatever room they are given.
const MAX_BYTES: usize = 1 << 28;

/// Makes the tables of all groups, or of none. Those that have too many entries if they are [`bounded`] are made [`full`].
pub(super) fn solve(bases: &[Basis<'_>], room: Room, meter: &mut Meter<'_>) -> Result<Vec<Joint>, Unsolved> {
    let making = bases.iter().map(Bounded::bytes_to_make).max().unwrap_or_default();
    let max_bytes = room.bytes.checked_sub(making).ok_or(Unsolved::TooLarge)?.min(MAX_BYTES);
    let mut n_left = room.bounded.min(max_bytes / Bounded::ENTRY_BYTES);
    let (mut joint, mut too_large) = (Vec::new(), Vec::new());
    let mut n_bytes = 0;
    for basis in bases {
        let n_before = n_left;
        match Bounded::solve(basis, &mut n_left, meter) {
            Ok(table) => {
                n_bytes += (n_before - n_left) * Bounded::ENTRY_BYTES;
                joint.push(Joint::Bounded(table));
            }
            Err(Unsolved::TooLarge) => {
                n_left = n_before;
                too_large.push(basis);
            }
            Err(unsolved) => return Err(unsolved),
        }
    }
    let n_full = too_large.iter().map(|basis| Full::n_entries(basis)).fold(0, usize::saturating_add);
    if n_full > room.full.min((max_bytes - n_bytes) / Full::ENTRY_BYTES) {
        return Err(Unsolved::TooLarge);
    }
    let making = too_large.iter().map(|basis| Full::bytes_to_make(basis)).max().unwrap_or_default();
    if n_bytes + n_full * Full::ENTRY_BYTES + making > room.bytes {
        return Err(Unsolved::TooLarge);
    }
    for basis in too_large {
        joint.push(Joint::Full(Full::solve(basis, meter)?));
    }
    Ok(joint)
}

impl Joint {
    /// The cost-to-go of the class of a state with these domain indices; infinite if no mapping through it is worth finding.
    #[inline]
    pub(super) fn cost_to_go(&self, observation: usize, values: &[u32]) -> f64 {
        match self {
            Self::Bounded(table) => table.cost_to_go(observation, values),
            Self::Full(table) => table.cost_to_go(observation, values),
        }
    }

    /// Whether the attribute at `position` is in the group.
    pub(super) fn has(&self, position: usize) -> bool {
        match self {
            Self::Bounded(table) => table.classes().has(position),
            Self::Full(table) => table.classes().has(position),
        }
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        match self {
            Self::Bounded(table) => table.size_bytes(),
            Self::Full(table) => table.size_bytes(),
        }
    }
}
