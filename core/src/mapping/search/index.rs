//! Where the blocks of nodes are.

use super::seen::SeenIdx;

/// Which nodes are in a block: those of a state, at as many observations as a block is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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
/// one look. Others have a hash table with linear probing; it holds no keys, as the blocks do.
#[derive(Debug, Default)]
pub(super) struct Index {
    /// Blocks, [`NO_BLOCK`] where free. If hashed, the first `2^bits` are in use.
    slots: Vec<u32>,
    /// How many slots a state has; 0 if hashed.
    row_len: usize,
    bits: u32,
}

/// Most slots of a state: two lines of the cache.
const MAX_ROW_LEN: usize = 32;

/// A hash table grows so that it has more slots than this for each block, and twice as many then. Fewer take longer: a chain of two
/// is a branch that goes the other way than it most often does.
const SLOTS_PER_BLOCK: usize = 8;

/// The size of a hash table at first: 16 kB.
const FIRST_BITS: u32 = 12;

impl Index {
    /// How much memory it takes for a block at most, in bytes: a hash table that has just grown.
    pub(super) const BLOCK_BYTES: usize = 2 * SLOTS_PER_BLOCK * size_of::<u32>();

    /// Forgets the blocks, which are `keys`, and keeps the memory, of which it clears no more than was in use: there may be rows for
    /// many more states than those of a search. There will be at most `row_len` for each state.
    pub(super) fn clear(&mut self, keys: &[Key], row_len: usize) {
        let row_len = if row_len <= MAX_ROW_LEN { row_len } else { 0 };
        if row_len == 0 {
            self.row_len = 0;
            self.resize(FIRST_BITS, &[]);
        } else if self.row_len == 0 {
            self.row_len = row_len;
            self.slots.clear();
        } else {
            for key in keys {
                let slot = self.slot_of(*key);
                self.slots.get_mut(slot).into_iter().for_each(|slot| *slot = NO_BLOCK);
            }
            self.row_len = row_len;
        }
    }

    /// How much memory it takes for the blocks of `n_states` states, in bytes. Rows of other states, which searches before this one came
    /// to, do not count.
    pub(super) fn size_bytes(&self, n_states: usize) -> usize {
        let n_slots = if self.row_len == 0 { self.slots.len() } else { (n_states * self.row_len).next_power_of_two() };
        n_slots * size_of::<u32>()
    }

    /// How much memory is kept for it, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.slots.capacity() * size_of::<u32>()
    }

    /// Looks for a block among `keys`. Gives it, and its slot.
    #[inline]
    pub(super) fn find(&self, key: Key, keys: &[Key]) -> (u32, usize) {
        let mut slot = self.slot_of(key);
        if self.row_len != 0 {
            return (self.slots.get(slot).copied().unwrap_or(NO_BLOCK), slot);
        }
        loop {
            let block = self.slots[slot];
            if block == NO_BLOCK || keys[block as usize] == key {
                return (block, slot);
            }
            slot = (slot + 1) & self.mask();
        }
    }

    /// Takes a block that was not found, the last of `keys`.
    pub(super) fn insert(&mut self, slot: usize, keys: &[Key]) {
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        let block = keys.len() as u32 - 1;
        if self.row_len != 0 && slot >= self.slots.len() {
            self.slots.resize((slot + 1).next_power_of_two(), NO_BLOCK);
        }
        self.slots[slot] = block;
        if self.row_len == 0 && keys.len() * SLOTS_PER_BLOCK > self.slots.len() {
            self.resize(self.bits + 1, keys);
        }
    }

    fn mask(&self) -> usize {
        (1 << self.bits) - 1
    }

    /// Where the search for a block begins.
    #[inline]
    fn slot_of(&self, Key { state, number }: Key) -> usize {
        /// 2^64 divided by the golden ratio (Knuth 1973, multiplicative hashing).
        const MULTIPLIER: u64 = 0x9e37_79b9_7f4a_7c15;
        if self.row_len != 0 {
            return state as usize * self.row_len + number as usize;
        }
        let key = u64::from(number) << 32 | u64::from(state);
        #[expect(clippy::cast_possible_truncation, reason = "the upper bits, of which there are few")]
        let slot = (key.wrapping_mul(MULTIPLIER) >> (64 - self.bits)) as usize;
        slot
    }

    #[cold]
    fn resize(&mut self, bits: u32, keys: &[Key]) {
        self.bits = bits;
        self.slots.clear();
        self.slots.resize(1 << bits, NO_BLOCK);
        for (block, key) in (0..).zip(keys).skip(1) {
            let mut slot = self.slot_of(*key);
            while self.slots[slot] != NO_BLOCK {
                slot = (slot + 1) & self.mask();
            }
            self.slots[slot] = block;
        }
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
                    let (block, slot) = index.find(key, &keys);
                    if known.insert((state, number)) {
                        prop_assert_eq!(block, NO_BLOCK);
                        keys.push(key);
                        index.insert(slot, &keys);
                    } else {
                        prop_assert_eq!(keys[block as usize], key);
                    }
                }
                for (block, key) in (0..).zip(&keys).skip(1) {
                    prop_assert_eq!(index.find(*key, &keys).0, block);
                }
            }
        }
    }
}
