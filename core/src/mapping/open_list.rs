//! The open list of Dijkstra's algorithm.

use std::cmp::Ordering;

/// An entry: something numbered, and what it costs to get there. The greatest is the cheapest, the lowest number among
/// equals, so that a [`BinaryHeap`](std::collections::BinaryHeap) gives that first.
#[derive(Clone, Copy, Debug)]
pub(super) struct CheapestFirst {
    pub(super) cost: f64,
    pub(super) id: u32,
}

impl Ord for CheapestFirst {
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then_with(|| other.id.cmp(&self.id))
    }
}

impl PartialOrd for CheapestFirst {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for CheapestFirst {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for CheapestFirst {}
