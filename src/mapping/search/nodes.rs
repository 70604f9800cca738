//! The nodes that a search has found.

use std::ops::RangeInclusive;

use super::{Move, MoveKind, NO_ACTION};
use crate::mapping::heuristic::projected::{Estimate, EstimatesAt};
use crate::model::{ActionIdx, Space, StateIdx};

/// Where a node is in [`Nodes`].
pub(super) type NodeId = u32;

/// Stands for "no node".
pub(super) const NO_NODE: NodeId = NodeId::MAX;

/// A node `(i, s)`, and the cheapest way to it that was found.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    /// Cost of the way, before the distance is paid.
    cost: f64,
    pub(super) state: StateIdx,
    pub(super) observation: u32,
    pub(super) estimate: Estimate,
    /// The node before, [`NO_NODE`] for the first.
    pub(super) parent: NodeId,
    /// The action that led here, or [`NO_ACTION`].
    pub(super) action: ActionIdx,
    /// How the way ends.
    pub(super) kind: MoveKind,
    /// Whether it was expanded since its way last became cheaper.
    pub(super) is_closed: bool,
}

/// What most looks at a node are for: whether it is the one that is looked for, and whether another way is cheaper.
#[derive(Clone, Copy, Debug)]
struct Key {
    /// Cost of the way, before the distance is paid.
    cost: f64,
    state: StateIdx,
    observation: u32,
}

/// The rest of a node.
#[derive(Clone, Copy, Debug)]
struct Rest {
    estimate: Estimate,
    parent: NodeId,
    action: ActionIdx,
    kind: MoveKind,
    is_closed: bool,
}

impl Node {
    /// Cost of the way to it.
    #[inline]
    pub(super) fn g(&self) -> f64 {
        self.cost + self.estimate.distance
    }

    /// What a mapping through it costs at least.
    #[inline]
    pub(super) fn f(&self) -> f64 {
        self.g() + self.estimate.cost_to_go
    }
}

/// A way to a node, before its distance is paid.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    pub(super) kind: MoveKind,
    pub(super) observation: u32,
    pub(super) state: StateIdx,
    pub(super) cost: f64,
    pub(super) parent: NodeId,
    pub(super) action: ActionIdx,
}

/// Nodes in the order in which they were found, and an index of them by observation and state: a hash table with linear
/// probing that holds no keys, as the nodes do.
#[derive(Debug, Default)]
pub(super) struct Nodes {
    keys: Vec<Key>,
    /// The rest of each node, in the same order.
    rest: Vec<Rest>,
    /// Ids, [`NO_NODE`] where free. Of these, the first `2^bits` are in use.
    index: Vec<NodeId>,
    bits: u32,
}

/// Sizes of an index at first, by how many nodes there may be at most: 4 kB to 128 kB.
const FIRST_BITS: RangeInclusive<u32> = 10..=15;

impl Nodes {
    /// Forgets all nodes, and keeps the memory. At most `most` nodes will come.
    pub(super) fn clear(&mut self, most: usize) {
        self.keys.clear();
        self.rest.clear();
        let bits = usize::BITS - most.saturating_mul(2).leading_zeros();
        self.resize_index(bits.clamp(*FIRST_BITS.start(), *FIRST_BITS.end()));
    }

    pub(super) fn len(&self) -> usize {
        self.keys.len()
    }

    /// How many nodes there is memory for.
    pub(super) fn capacity(&self) -> usize {
        self.keys.capacity()
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (NodeId, Node)> {
        (0..).zip(self.keys.iter().zip(&self.rest).map(|(key, rest)| joined(key, rest)))
    }

    #[inline]
    pub(super) fn get(&self, id: NodeId) -> Node {
        joined(&self.keys[id as usize], &self.rest[id as usize])
    }

    /// Takes a new estimate of a node.
    pub(super) fn estimate(&mut self, id: NodeId, estimate: Estimate) {
        self.rest[id as usize].estimate = estimate;
    }

    #[inline]
    pub(super) fn close(&mut self, id: NodeId) {
        self.rest[id as usize].is_closed = true;
    }

    /// Takes a way to a node, if it is cheaper than any before and a mapping that goes on from there may cost less than `limit`.
    /// Gives the node's id then.
    #[expect(clippy::inline_always, reason = "without it a search takes a fifth more instructions")]
    #[inline(always)]
    pub(super) fn offer(
        &mut self,
        arrival: Arrival,
        space: &impl Space,
        estimates: &EstimatesAt<'_>,
        limit: f64,
    ) -> Option<NodeId> {
        let Arrival { kind, observation, state, cost, parent, action } = arrival;
        let mut place = self.place_of(observation, state);
        loop {
            let id = self.index[place];
            let Some(key) = self.keys.get_mut(id as usize) else { break };
            if key.state == state && key.observation == observation {
                if cost >= key.cost {
                    return None;
                }
                key.cost = cost;
                let rest = &mut self.rest[id as usize];
                *rest = Rest { parent, action, kind, is_closed: false, ..*rest };
                return (cost + rest.estimate.distance + rest.estimate.cost_to_go < limit).then_some(id);
            }
            place = (place + 1) & self.mask();
        }
        let estimate = estimates.of(space.row(state));
        if cost + estimate.distance + estimate.cost_to_go >= limit {
            return None;
        }
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        let id = self.keys.len() as NodeId;
        self.keys.push(Key { cost, state, observation });
        self.rest.push(Rest { estimate, parent, action, kind, is_closed: false });
        self.index[place] = id;
        if self.keys.len() * 2 > self.mask() {
            self.resize_index(self.bits + 1);
        }
        Some(id)
    }

    fn mask(&self) -> usize {
        (1 << self.bits) - 1
    }

    /// Where the search for a node in the index begins.
    #[inline]
    fn place_of(&self, observation: u32, state: StateIdx) -> usize {
        /// 2^64 divided by the golden ratio (Knuth 1973, multiplicative hashing).
        const MULTIPLIER: u64 = 0x9e37_79b9_7f4a_7c15;
        let key = u64::from(observation) << 32 | u64::from(state);
        #[expect(clippy::cast_possible_truncation, reason = "the upper bits, of which there are few")]
        let place = (key.wrapping_mul(MULTIPLIER) >> (64 - self.bits)) as usize;
        place
    }

    #[cold]
    fn resize_index(&mut self, bits: u32) {
        self.bits = bits;
        let size = 1 << bits;
        self.index.truncate(size);
        self.index.fill(NO_NODE);
        self.index.resize(size, NO_NODE);
        for id in 0..self.keys.len() {
            let Key { observation, state, .. } = self.keys[id];
            let mut place = self.place_of(observation, state);
            while self.index[place] != NO_NODE {
                place = (place + 1) & self.mask();
            }
            #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
            {
                self.index[place] = id as NodeId;
            }
        }
    }

    /// The way from the start to a node.
    pub(super) fn path(&self, mut id: NodeId) -> Vec<Move> {
        let mut moves = Vec::new();
        while id != NO_NODE {
            let Node { state, observation, parent, action, kind, .. } = self.get(id);
            let action = (action != NO_ACTION).then_some(action);
            moves.push(Move { kind, action, observation, state });
            id = parent;
        }
        moves.reverse();
        moves
    }
}

#[inline]
fn joined(key: &Key, rest: &Rest) -> Node {
    let Key { cost, state, observation } = *key;
    let Rest { estimate, parent, action, kind, is_closed } = *rest;
    Node { cost, state, observation, estimate, parent, action, kind, is_closed }
}
