//! An open list of buckets: nodes in the order of `f`, but for differences that do not matter.

use super::nodes::{NodeId, Reached};
use crate::model::make_room;

/// An open list for nodes of `f` below a known limit. A bucket holds the nodes whose `f` agree in their first
/// [`MANTISSA_BITS`] binary digits, so its width is about a thousandth of `f`; of the nodes in one bucket, the one that came last is
/// taken first. Adding and taking are constant work.
#[derive(Debug, Default)]
pub(super) struct Buckets {
    /// The entry that came last to each bucket, plus 1; 0 for none.
    heads: Vec<u32>,
    entries: Vec<Entry>,
    /// The entry that was taken last, plus 1, to be filled again; 0 for none.
    free: u32,
    /// Added to every `f`, so that no range of costs has too many binary orders of magnitude.
    offset: f64,
    /// The leading bits of what is in the first bucket.
    first: u64,
    /// Nothing is in the buckets before this one.
    current: usize,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    g: f64,
    f: f64,
    id: NodeId,
    /// The entry before it in its bucket, as in the heads, or before it among those that are free.
    next: u32,
}

/// Binary digits of `f` that matter, after the first.
const MANTISSA_BITS: u32 = 10;

/// How far below the limit costs are told apart as well as near it, as a power of two; which bounds how many buckets there are.
const MAX_OCTAVES: i32 = 16;

impl Buckets {
    /// Empties the list, which takes nothing until it is [reset](Self::reset).
    pub(super) fn clear(&mut self) {
        self.heads.clear();
        self.entries.clear();
        self.free = 0;
    }

    /// How much memory the nodes take that were there at the same time, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(self.entries.as_slice())
    }

    /// How much memory a node takes that was added, in bytes.
    pub(super) const ENTRY_BYTES: usize = size_of::<Entry>();

    /// Makes room for `growth` times as many nodes, once there is hardly any left.
    pub(super) fn make_room(&mut self, growth: f64) {
        make_room(&mut self.entries, growth);
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.entries.capacity() * size_of::<Entry>() + self.heads.capacity() * size_of::<u32>()
    }

    /// Empties the list, which is then for nodes of `least <= f < limit`.
    pub(super) fn reset(&mut self, least: f64, limit: f64) {
        self.offset = limit * 0.5_f64.powi(MAX_OCTAVES);
        self.first = 0;
        self.first = self.bucket_of(least) as u64;
        self.heads.clear();
        self.heads.resize(self.bucket_of(limit) + 1, 0);
        self.entries.clear();
        self.free = 0;
        self.current = 0;
    }

    #[inline]
    fn bucket_of(&self, f: f64) -> usize {
        let leading = (f + self.offset).to_bits() >> (f64::MANTISSA_DIGITS - 1 - MANTISSA_BITS);
        leading.saturating_sub(self.first) as usize
    }

    /// Adds a node.
    #[inline]
    pub(super) fn push(&mut self, node: Reached) {
        // By rounding, what comes later may be a little less.
        let bucket = self.bucket_of(node.f).max(self.current);
        let Some(head) = self.heads.get_mut(bucket) else { return };
        let Reached { id, g, f } = node;
        let entry = Entry { g, f, id, next: *head };
        if let Some(free) = (self.free as usize).checked_sub(1) {
            *head = self.free;
            self.free = std::mem::replace(&mut self.entries[free], entry).next;
        } else {
            self.entries.push(entry);
            #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
            let entry = self.entries.len() as u32;
            *head = entry;
        }
    }

    /// Takes a node of the first bucket that has one.
    #[inline]
    pub(super) fn pop(&mut self) -> Option<Reached> {
        while let Some(head) = self.heads.get_mut(self.current) {
            if let Some(entry) = (*head as usize).checked_sub(1) {
                let Entry { g, f, id, next } = self.entries[entry];
                self.entries[entry].next = self.free;
                self.free = *head;
                *head = next;
                return Some(Reached { id, g, f });
            }
            self.current += 1;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_come_in_the_order_of_f_to_within_a_bucket() {
        let mut open = Buckets::default();
        for (least, limit) in [(0.0, 100.0), (63.4, 138.8), (0.0, 1e150), (5.4, 5.400_000_1), (1e-9, 1e9)] {
            open.reset(least, limit);
            let f = |n: u32| least + (limit - least) * f64::from(n * 7919 % 1000) / 1000.0;
            (0..1000).for_each(|id| open.push(Reached { id, g: 0.0, f: f(id) }));
            let order: Vec<f64> = std::iter::from_fn(|| open.pop()).map(|node| node.f).collect();
            assert_eq!(order.len(), 1000);
            let width = |f: f64| (f + limit / 65536.0) / 1024.0;
            assert!(order.windows(2).all(|pair| pair[1] > pair[0] - width(pair[0])), "{least} to {limit}");
        }
    }

    #[test]
    fn as_much_memory_is_taken_as_for_the_most_nodes_at_a_time_until_the_list_is_emptied() {
        let mut open = Buckets::default();
        open.reset(1.0, 2.0);
        (0..3).for_each(|id| open.push(Reached { id, g: 0.0, f: 1.5 }));
        for id in 3..100 {
            assert_eq!(open.pop().map(|node| node.id), Some(id - 1));
            open.push(Reached { id, g: 0.0, f: 1.5 });
        }
        assert_eq!(open.size_bytes(), 3 * size_of::<Entry>());
        open.clear();
        assert_eq!((open.size_bytes(), open.pop()), (0, None));
    }

    #[test]
    fn of_equals_the_last_comes_first() {
        let mut open = Buckets::default();
        open.reset(1.0, 2.0);
        (0..3).for_each(|id| open.push(Reached { id, g: 0.0, f: 1.5 }));
        let order: Vec<_> = std::iter::from_fn(|| open.pop()).map(|node| node.id).collect();
        assert_eq!(order, [2, 1, 0]);
    }
}
