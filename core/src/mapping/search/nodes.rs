//! The nodes that a search has found.
//!
//! Nodes of one state at neighbouring observations lie together, in a *block*. An action is tried both as a match and as an extra action,
//! which lead to neighbouring nodes of one state; mostly both nodes are known already by cheaper paths. To find that out takes one look into the
//! index and one at the costs of the block.

use super::index::{Index, Key, NO_BLOCK};
use super::seen::{Estimates, Seen, SeenIdx};
use super::{Move, MoveKind, NO_ACTION};
use crate::mapping::cost::SLACK;
use crate::mapping::heuristic::projected::{CHUNK_LEN, Estimate};
use crate::mapping::recurrence::Recurrence;
use crate::model::{ActionIdx, Space, make_room};

/// Where a node is in [`Nodes`]: its block, and its place in that.
pub(super) type NodeId = u32;

/// Where a block is in [`Nodes`], [`NO_BLOCK`] if it is not.
pub(super) type BlockIdx = u32;

/// Stands for "no node".
pub(super) const NO_NODE: NodeId = NodeId::MAX;

/// How many observations a block is for.
const BLOCK_LEN: usize = CHUNK_LEN;
const BLOCK_BITS: u32 = BLOCK_LEN.ilog2();
const IN_BLOCK: u32 = (1 << BLOCK_BITS) - 1;

/// Where a node is, and how the way to it ends; all that an expansion asks for but the costs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Position {
    pub(super) state: SeenIdx,
    pub(super) observation: u32,
    /// [`MoveKind::Match`] at the start, too.
    pub(super) kind: MoveKind,
}

/// A node to which a way was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reached {
    pub(super) id: NodeId,
    /// Cost of the way.
    pub(super) g: f64,
    /// What a mapping through it costs at least.
    pub(super) f: f64,
}

/// A way to a node, before its distance is paid.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    pub(super) kind: MoveKind,
    pub(super) observation: u32,
    pub(super) state: SeenIdx,
    pub(super) cost: f64,
    pub(super) parent: NodeId,
    pub(super) action: ActionIdx,
}

/// The last step of the way to a node: its parent, [`NO_NODE`] for the first, and the action, or [`NO_ACTION`].
#[derive(Clone, Copy, Debug)]
struct LastLink {
    parent: NodeId,
    action: ActionIdx,
}

const NO_LINK: LastLink = LastLink { parent: NO_NODE, action: NO_ACTION };

/// Upper bounds, one per node of a block, on the cost of a path: costlier paths are discarded. A bound is the cost of the cheapest path
/// that was found or discarded, or follows from the search's limit. It is before the node's distance is paid if moves of all kinds pay the
/// same of it, and after otherwise. One cache line.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Costs([f64; BLOCK_LEN]);

const NO_LIMITS: Costs = Costs([f64::INFINITY; BLOCK_LEN]);

/// Bit of a node's marks: its estimate was computed.
const ESTIMATED: u8 = 1;
/// Bit of a node's marks: a path to it was found.
const FOUND: u8 = 2;
/// Bit of a node's marks: it was expanded since its path last became cheaper.
const CLOSED: u8 = 4;
/// Bit of a node's marks: its path ends with a skip.
const SKIPPED_TO: u8 = 8;
/// Bit of a node's marks: its path ends with an extra action.
const LINGERED_TO: u8 = 16;
/// Bit of a node's marks: its estimate is not raised any more.
const RAISED: u8 = 32;

/// Blocks of nodes, in the order in which the first node of each was found. `ALIKE` says whether moves of all kinds pay the same part of a
/// distance, for which there is a search of its own: it is what most problems need.
#[derive(Debug, Default)]
pub(super) struct Nodes {
    keys: Vec<Key>,
    marks: Vec<[u8; BLOCK_LEN]>,
    costs: Vec<Costs>,
    estimates: Vec<[Estimate; BLOCK_LEN]>,
    links: Vec<[LastLink; BLOCK_LEN]>,
    index: Index,
    recurrence: Recurrence,
}

/// The key of [`NO_BLOCK`], which never has a node.
const NO_KEY: Key = Key { state: SeenIdx::MAX, number: u32::MAX };

const BLOCK_BYTES: usize = size_of::<Key>()
    + size_of::<[u8; BLOCK_LEN]>()
    + size_of::<Costs>()
    + size_of::<[Estimate; BLOCK_LEN]>()
    + size_of::<[LastLink; BLOCK_LEN]>();

impl Nodes {
    /// Forgets all nodes, and keeps the memory. There will be nodes at so many observations, to which moves cost what `recurrence` says.
    pub(super) fn clear(&mut self, n_observations: usize, recurrence: Recurrence) {
        self.recurrence = recurrence;
        self.index.clear(&self.keys, n_observations.div_ceil(BLOCK_LEN));
        self.keys.clear();
        self.marks.clear();
        self.costs.clear();
        self.estimates.clear();
        self.links.clear();
        self.keys.push(NO_KEY);
        self.marks.push([0; BLOCK_LEN]);
        self.costs.push(NO_LIMITS);
        self.estimates.push([Estimate::default(); BLOCK_LEN]);
        self.links.push([NO_LINK; BLOCK_LEN]);
    }

    /// How much memory they take, in bytes, if they are of `n_states` states.
    pub(super) fn size_bytes(&self, n_states: usize) -> usize {
        self.keys.len() * BLOCK_BYTES + self.index.size_bytes(n_states)
    }

    /// How much memory they take, in bytes, if they are all of a state at so many observations.
    pub(super) fn bytes_for(n_observations: usize) -> usize {
        n_observations.div_ceil(BLOCK_LEN) * (BLOCK_BYTES + Index::BLOCK_BYTES)
    }

    /// Makes room for `growth` times as many, once there is hardly any left.
    pub(super) fn make_room(&mut self, growth: f64) {
        make_room(&mut self.keys, growth);
        make_room(&mut self.marks, growth);
        make_room(&mut self.costs, growth);
        make_room(&mut self.estimates, growth);
        make_room(&mut self.links, growth);
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.keys.capacity() * BLOCK_BYTES + self.index.kept_bytes()
    }

    /// Every node that was not expanded since its way last became cheaper.
    pub(super) fn open<const ALIKE: bool>(&self) -> impl Iterator<Item = Reached> {
        let mut blocks = (0..).zip(&self.marks);
        // Of the current block.
        let (mut number, mut left) = (0, 0);
        std::iter::from_fn(move || {
            while left == 0 {
                let (block, marks) = blocks.next()?;
                let marks = u64::from_le_bytes(*marks);
                // A bit of each byte.
                let has = |mark: u8| marks >> mark.trailing_zeros() & u64::from_le_bytes([1; BLOCK_LEN]);
                (number, left) = (block, has(FOUND) & !has(CLOSED));
            }
            let in_block = left.trailing_zeros() / u8::BITS;
            left &= left - 1;
            Some(self.get::<ALIKE>(number << BLOCK_BITS | in_block))
        })
    }

    /// A node to which a way was found.
    #[inline]
    pub(super) fn get<const ALIKE: bool>(&self, id: NodeId) -> Reached {
        let (block, in_block) = split(id);
        let (cost, estimate) = (self.costs[block].0[in_block], self.estimates[block][in_block]);
        let g = if ALIKE { cost + estimate.distance } else { cost };
        Reached { id, g, f: g + estimate.cost_to_go }
    }

    /// Replaces the estimate of a node by one that is higher, and perhaps as high as it will ever be.
    pub(super) fn raise(&mut self, id: NodeId, estimate: Estimate, is_highest: bool) {
        let (block, in_block) = split(id);
        self.estimates[block][in_block] = estimate;
        self.marks[block][in_block] |= if is_highest { RAISED } else { 0 };
    }

    /// Whether the estimate of a node is as high as it will ever be.
    #[inline]
    pub(super) fn is_raised(&self, id: NodeId) -> bool {
        let (block, in_block) = split(id);
        self.marks[block][in_block] & RAISED != 0
    }

    /// Where a node is, and how the way to it ends.
    #[inline]
    pub(super) fn step(&self, id: NodeId) -> Position {
        let (block, in_block) = split(id);
        let Key { state, number } = self.keys[block];
        let kind = match self.marks[block][in_block] & (SKIPPED_TO | LINGERED_TO) {
            SKIPPED_TO => MoveKind::Skip,
            LINGERED_TO => MoveKind::Extra,
            _ => MoveKind::Match,
        };
        Position { state, observation: number << BLOCK_BITS | id & IN_BLOCK, kind }
    }

    /// Whether a node was expanded since its way last became cheaper.
    #[inline]
    pub(super) fn is_closed(&self, id: NodeId) -> bool {
        let (block, in_block) = split(id);
        self.marks[block][in_block] & CLOSED != 0
    }

    /// Takes note that a node is expanded now.
    #[inline]
    pub(super) fn close(&mut self, id: NodeId) {
        let (block, in_block) = split(id);
        self.marks[block][in_block] |= CLOSED;
    }

    /// Looks for the block of a node.
    #[inline]
    pub(super) fn find(&self, state: SeenIdx, observation: u32) -> BlockIdx {
        self.index.find(Key { state, number: observation >> BLOCK_BITS })
    }

    /// The block of a node that was found.
    #[inline]
    pub(super) fn block_of(id: NodeId) -> BlockIdx {
        id >> BLOCK_BITS
    }

    /// Whether the node before that of `observation`, of the same state, is in the same block.
    #[inline]
    pub(super) fn are_together(observation: u32) -> bool {
        observation & IN_BLOCK != 0
    }

    /// Whether a way to a node may be of interest, if it costs so much before the distance is paid. `block` is its block.
    #[inline]
    pub(super) fn may_take(&self, block: BlockIdx, observation: u32, cost: f64) -> bool {
        cost < self.costs[block as usize].0[(observation & IN_BLOCK) as usize]
    }

    /// Takes a way to a node that [may be](Self::may_take) of interest, if a mapping that goes on from there may cost less than
    /// `limit`. Gives the node then. `block` is its block as it was found, or that of its neighbour
    /// [together](Self::are_together) with it.
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    pub(super) fn take<const ALIKE: bool>(
        &mut self,
        block: &mut BlockIdx,
        arrival: Arrival,
        estimates: &Estimates<'_, '_, impl Space>,
        limit: f64,
    ) -> Option<Reached> {
        let Arrival { kind, observation, state, cost, parent, action } = arrival;
        if *block == NO_BLOCK && !self.add::<ALIKE>(block, state, observation, (kind, cost), estimates, limit) {
            return None;
        }
        let (at, in_block) = (*block as usize, (observation & IN_BLOCK) as usize);
        let mark = &mut self.marks[at][in_block];
        let estimate = &mut self.estimates[at][in_block];
        if *mark & ESTIMATED == 0 {
            *mark |= ESTIMATED;
            *estimate = estimates.of(state, observation);
        }
        let known = &mut self.costs[at].0[in_block];
        let (g, compared) = if ALIKE {
            (cost + estimate.distance, cost)
        } else {
            let g = self.recurrence.arrive(kind, cost, estimate.distance);
            if g >= *known {
                return None;
            }
            (g, g)
        };
        *known = compared;
        let reached = Reached { id: *block << BLOCK_BITS | observation & IN_BLOCK, g, f: g + estimate.cost_to_go };
        if reached.f >= limit && *mark & FOUND == 0 {
            return None;
        }
        *mark = *mark & (ESTIMATED | RAISED)
            | FOUND
            | match kind {
                MoveKind::Skip => SKIPPED_TO,
                MoveKind::Extra => LINGERED_TO,
                MoveKind::Start | MoveKind::Match => 0,
            };
        self.links[at][in_block] = LastLink { parent, action };
        (reached.f < limit).then_some(reached)
    }

    /// Adds a block, unless the way is not of interest for which that is done. Says whether it did.
    #[inline(never)]
    fn add<const ALIKE: bool>(
        &mut self,
        block: &mut BlockIdx,
        state: SeenIdx,
        observation: u32,
        (kind, cost): (MoveKind, f64),
        estimates: &Estimates<'_, '_, impl Space>,
        limit: f64,
    ) -> bool {
        let estimate = estimates.of(state, observation);
        if self.recurrence.arrive(kind, cost, estimate.distance) + estimate.cost_to_go >= limit {
            return false;
        }
        let number = observation >> BLOCK_BITS;
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        {
            *block = self.keys.len() as u32;
        }
        let key = Key { state, number };
        self.keys.push(key);
        self.index.insert(key, *block);
        self.links.push([NO_LINK; BLOCK_LEN]);
        if let Some(estimates) = estimates.of_all(state, number << BLOCK_BITS) {
            // A little more, as sums differ by rounding.
            let most = limit * (1.0 + SLACK);
            self.marks.push([ESTIMATED; BLOCK_LEN]);
            let paid_later = if ALIKE { 1.0 } else { 0.0 };
            self.costs.push(Costs(estimates.map(|own| most - paid_later * own.distance - own.cost_to_go)));
            self.estimates.push(estimates);
        } else {
            self.marks.push([0; BLOCK_LEN]);
            self.costs.push(NO_LIMITS);
            self.estimates.push([Estimate::default(); BLOCK_LEN]);
        }
        true
    }

    /// The way from the start to a node.
    pub(super) fn path(&self, mut id: NodeId, seen: &Seen) -> Vec<Move> {
        let mut moves = Vec::new();
        while id != NO_NODE {
            let (block, in_block) = split(id);
            let LastLink { parent, action } = self.links[block][in_block];
            let Position { state, observation, kind } = self.step(id);
            let kind = if parent == NO_NODE { MoveKind::Start } else { kind };
            let action = (action != NO_ACTION).then_some(action);
            // There is one for each observation up to here at least.
            moves.reserve(observation as usize + 1);
            moves.push(Move { kind, action, observation, state: seen.state(state) });
            id = parent;
        }
        moves.reverse();
        moves
    }
}

/// A node's block, and its place in that.
#[inline]
fn split(id: NodeId) -> (usize, usize) {
    ((id >> BLOCK_BITS) as usize, (id & IN_BLOCK) as usize)
}
