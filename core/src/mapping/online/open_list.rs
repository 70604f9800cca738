//! The open list of a layer's sweep.

use crate::model::StateIdx;

/// An open list for costs that never fall below the one taken last: a radix heap (Ahuja, Mehlhorn, Orlin & Tarjan, "Faster
/// Algorithms for the Shortest Path Problem", 1990). Costs are told apart by the highest bit, of their representation as
/// a float, in which they differ from the cost taken last; floats that are not negative are ordered as these bits are.
#[derive(Debug)]
pub(super) struct OpenList {
    /// By the number of the bit plus 1; 0 where none differs.
    buckets: Vec<Vec<(u64, StateIdx)>>,
    /// Which buckets hold something: bit `n` is bucket `n + 1`'s.
    is_filled: u64,
    last: u64,
}

impl OpenList {
    pub(super) fn new() -> Self {
        Self { buckets: vec![Vec::new(); 65], is_filled: 0, last: 0 }
    }

    /// Size in memory, in bytes: what it once held there is room for.
    pub(super) fn size_bytes(&self) -> usize {
        let n_slots: usize = self.buckets.iter().map(Vec::capacity).sum();
        n_slots * size_of::<(u64, StateIdx)>() + self.buckets.len() * size_of::<Vec<(u64, StateIdx)>>()
    }

    /// Adds a state at its cost: at least 0, and at least what was taken last, until the list has been empty.
    #[inline]
    pub(super) fn push(&mut self, cost: f64, state: StateIdx) {
        let bits = cost.to_bits();
        self.place(bits, state);
    }

    #[inline]
    fn place(&mut self, bits: u64, state: StateIdx) {
        let bucket = u64::BITS - (bits ^ self.last).leading_zeros();
        self.buckets[bucket as usize].push((bits, state));
        if bucket > 0 {
            self.is_filled |= 1 << (bucket - 1);
        }
    }

    /// Takes a state of least cost.
    pub(super) fn pop(&mut self) -> Option<(f64, StateIdx)> {
        loop {
            if let Some((bits, state)) = self.buckets[0].pop() {
                return Some((f64::from_bits(bits), state));
            }
            if self.is_filled == 0 {
                self.last = 0;
                return None;
            }
            let bucket = self.is_filled.trailing_zeros() as usize + 1;
            self.is_filled &= self.is_filled - 1;
            let mut entries = std::mem::take(&mut self.buckets[bucket]);
            self.last = entries.iter().map(|(bits, _)| *bits).min().unwrap_or_default();
            for (bits, state) in entries.drain(..) {
                self.place(bits, state);
            }
            self.buckets[bucket] = entries;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn states_come_out_in_the_order_of_their_costs(
            first in prop::collection::vec(0.0..1e3, 1..40),
            steps in prop::collection::vec(prop_oneof![Just(0.0), 0.0..1e-3, 0.0..1e9], 0..80),
        ) {
            let mut open = OpenList::new();
            // Twice, as what is empty can be filled again with less.
            for _ in 0..2 {
                let mut waiting = first.clone();
                for cost in &first {
                    open.push(*cost, 7);
                }
                let mut steps = steps.iter();
                while let Some((cost, state)) = open.pop() {
                    waiting.sort_by(f64::total_cmp);
                    prop_assert_eq!((cost, state), (waiting.remove(0), 7));
                    if let Some(step) = steps.next() {
                        open.push(cost + step, 7);
                        waiting.push(cost + step);
                    }
                }
                prop_assert!(waiting.is_empty());
            }
        }
    }
}
