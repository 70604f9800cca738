//! States that look alike.

use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;

use super::Reached;
use crate::interrupt::{Interrupted, Meter};

/// The states that were reached, in classes of those that have the same values of some attributes. Classes are numbered as they are first met.
#[derive(Debug)]
pub(super) struct Classes {
    /// The positions of these attributes.
    positions: Vec<usize>,
    /// By state, its class.
    pub(super) of: Vec<u32>,
    /// By class, its first state.
    pub(super) first: Vec<u32>,
    /// Hashed with a seed, as clients choose the values.
    index: HashTable<u32>,
    hasher: RandomState,
}

impl Classes {
    pub(super) fn of(reached: &Reached<'_>, positions: Vec<usize>, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        let hasher = RandomState::default();
        let mut classes = Self { positions, of: Vec::new(), first: Vec::new(), index: HashTable::new(), hasher };
        #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
        for state in 0..reached.n_states() as u32 {
            meter.spend_or_stop(1 + classes.positions.len() as u64)?;
            let class = classes.find(reached, reached.row(state)).unwrap_or_else(|| classes.add(reached, state));
            classes.of.push(class);
        }
        Ok(classes)
    }

    /// How many classes there are.
    pub(super) fn len(&self) -> usize {
        self.first.len()
    }

    /// The class of the states that look like one with this row, if there is any.
    pub(super) fn find(&self, reached: &Reached<'_>, row: &[u32]) -> Option<u32> {
        let is_like = |class: &u32| {
            let first = reached.row(self.first[*class as usize]);
            self.positions.iter().all(|position| first[*position] == row[*position])
        };
        self.index.find(self.hash(row), is_like).copied()
    }

    fn add(&mut self, reached: &Reached<'_>, state: u32) -> u32 {
        #[expect(clippy::cast_possible_truncation, reason = "no more than states")]
        let class = self.first.len() as u32;
        self.first.push(state);
        let hash = self.hash(reached.row(state));
        let Self { positions, first, index, hasher, .. } = self;
        let rehash = |class: &u32| hash_of(hasher, positions, reached.row(first[*class as usize]));
        index.insert_unique(hash, class, rehash);
        class
    }

    fn hash(&self, row: &[u32]) -> u64 {
        hash_of(&self.hasher, &self.positions, row)
    }
}

fn hash_of(hasher: &RandomState, positions: &[usize], row: &[u32]) -> u64 {
    use std::hash::{Hash, Hasher};
    let mut hasher = hasher.build_hasher();
    for position in positions {
        row[*position].hash(&mut hasher);
    }
    hasher.finish()
}
