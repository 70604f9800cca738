//! Where the blocks of nodes are.

use rustc_hash::FxHashMap;

use super::seen::SeenIdx;

/// Which nodes are in a block: those of a state, at as many observations as a block is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Key {
    pub(super) state: SeenIdx,
    /// The first observation, divided by how many a block is for.
    pub(super) number: u32,
}

/// The block that is found where there is none.
pub(super) const NO_BLOCK: u32 = 0;

/// An index of blocks, which are numbered from 1 on.
///
/// For demonstrations of up to [`MAX_ROW_LEN`] blocks a state, each state has a row with a place for each, so that a block is found by
/// one look: a hash table takes searches of 50 observations 1.1 to 1.2 times as long. Longer demonstrations have a hash table.
#[derive(Debug, Default)]
pub(super) struct Index {
    /// Blocks by state and number, [`NO_BLOCK`] where there is none.
    rows: Vec<u32>,
    /// How many places a state has; 0 if hashed.
    row_len: usize,
    hashed: FxHashMap<Key, u32>,
}

/// Most places of a state: two lines of the cache.
const MAX_ROW_LEN: usize = 32;

/// What an entry of the hash table takes at most, in bytes, with one for control: it is less than half full when it has just grown.
const HASHED_BYTES: usize = (size_of::<(Key, u32)>() + 1) * 16 / 7;

impl Index {
    /// How much memory it takes for a block at most, in bytes: a row of a single block, in an array that has just grown, or an entry
    /// of the hash table.
    pub(super) const BLOCK_BYTES: usize = HASHED_BYTES;

    /// Forgets the blocks, which are `keys`, and keeps the memory, of which it clears no more than was in use: there may be rows for
    /// many more states than those of a search. There will be at most `row_len` for each state.
    pub(super) fn clear(&mut self, keys: &[Key], row_len: usize) {
        let row_len = if row_len <= MAX_ROW_LEN { row_len } else { 0 };
        if self.row_len == 0 {
            self.rows.clear();
        }
        for key in keys {
            if let Some(block) = self.place_of(*key).and_then(|place| self.rows.get_mut(place)) {
                *block = NO_BLOCK;
            }
        }
        self.hashed.clear();
        self.row_len = row_len;
    }

    /// How much memory it takes for the blocks of `n_states` states, in bytes. Rows of other states, which searches before this one came
    /// to, do not count.
    pub(super) fn size_bytes(&self, n_states: usize) -> usize {
        let rows = (n_states * self.row_len).next_power_of_two() * size_of::<u32>();
        rows + self.hashed.len() * HASHED_BYTES
    }

    /// How much memory is kept for it, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.rows.capacity() * size_of::<u32>() + self.hashed.capacity() * HASHED_BYTES / 2
    }

    /// Looks for a block.
    #[inline]
    pub(super) fn find(&self, key: Key) -> u32 {
        let block = match self.place_of(key) {
            Some(place) => self.rows.get(place),
            None => self.hashed.get(&key),
        };
        block.copied().unwrap_or(NO_BLOCK)
    }

    /// Takes a block that was not found.
    pub(super) fn insert(&mut self, key: Key, block: u32) {
        let Some(place) = self.place_of(key) else {
            self.hashed.insert(key, block);
            return;
        };
        if place >= self.rows.len() {
            self.rows.resize((place + 1).next_power_of_two(), NO_BLOCK);
        }
        self.rows[place] = block;
    }

    /// Where a block is among the rows, if these are in use.
    #[inline]
    fn place_of(&self, Key { state, number }: Key) -> Option<usize> {
        (self.row_len != 0).then(|| state as usize * self.row_len + number as usize)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use proptest::prelude::*;

    use super::*;

    /// Numbers that no block of a demonstration would have are not asked for.
    fn searches() -> impl Strategy<Value = Vec<(usize, Vec<(SeenIdx, u32)>)>> {
        let search = prop_oneof![1..40_usize, 1..2000_usize].prop_flat_map(|row_len| {
            let number = 0..u32::try_from(row_len).unwrap();
            (Just(row_len), prop::collection::vec((0..300_u32, number), 0..1500))
        });
        prop::collection::vec(search, 1..5)
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 60, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn the_blocks_of_a_search_are_found_and_no_others(searches in searches()) {
            let mut index = Index::default();
            let none = Key { state: SeenIdx::MAX, number: u32::MAX };
            let mut keys = Vec::new();
            for (row_len, wanted) in searches {
                index.clear(&keys, row_len);
                keys = vec![none];
                let mut known = HashSet::new();
                for (state, number) in wanted {
                    let key = Key { state, number };
                    let block = index.find(key);
                    if known.insert((state, number)) {
                        prop_assert_eq!(block, NO_BLOCK);
                        keys.push(key);
                        index.insert(key, u32::try_from(keys.len()).unwrap() - 1);
                    } else {
                        prop_assert_eq!(keys[block as usize], key);
                    }
                }
                for (block, key) in (0..).zip(&keys).skip(1) {
                    prop_assert_eq!(index.find(*key), block);
                }
            }
        }
    }
}
