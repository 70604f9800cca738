//! The nodes of one observation.

use std::hint::select_unpredictable;

use super::bands::{BandIdx, Bands};
use super::passed::{Estimates, PassedIdx};
use crate::mapping::MoveKind;
use crate::mapping::heuristic::projected::Estimate;
use crate::model::ActionIdx;

/// The cheapest way to a node that was found.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    /// Before the distance is paid; infinite if there is none.
    pub(super) cost: f64,
    pub(super) link: Link,
}

/// How the way to a node ends, and what becomes of the node. In one number, so that a cheaper way is taken without a branch: whether one is
/// cheaper cannot be foreseen, and a branch that was not takes as long as following a way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link(u64);

impl Link {
    const KINDS: [MoveKind; 4] = [MoveKind::Start, MoveKind::Match, MoveKind::Extra, MoveKind::Skip];
    const KIND_AT: u32 = 16;
    const STAGE_AT: u32 = 24;
    const PARENT_AT: u32 = 32;

    /// That of a fresh node, to which this action or none leads from a state.
    #[inline]
    pub(super) fn new(parent: PassedIdx, action: ActionIdx, kind: MoveKind) -> Self {
        let last = u64::from(action) | (kind as u64) << Self::KIND_AT | (Stage::Fresh as u64) << Self::STAGE_AT;
        Self(u64::from(parent) << Self::PARENT_AT | last)
    }

    /// The state that the way comes from.
    pub(super) fn parent(self) -> PassedIdx {
        (self.0 >> Self::PARENT_AT) as PassedIdx
    }

    #[expect(clippy::cast_possible_truncation, reason = "these bits are meant")]
    pub(super) fn action(self) -> ActionIdx {
        self.0 as ActionIdx
    }

    #[inline]
    pub(super) fn kind(self) -> MoveKind {
        Self::KINDS[(self.0 >> Self::KIND_AT) as usize % Self::KINDS.len()]
    }

    #[inline]
    #[expect(clippy::cast_possible_truncation, reason = "these bits are meant")]
    pub(super) fn is_at(self, stage: Stage) -> bool {
        (self.0 >> Self::STAGE_AT) as u8 == stage as u8
    }

    #[inline]
    pub(super) fn move_to(&mut self, stage: Stage) {
        self.0 = self.0 & !(0xff << Self::STAGE_AT) | (stage as u64) << Self::STAGE_AT;
    }

    /// 0 if the node is fresh, else 1.
    #[inline]
    fn is_not_fresh(self) -> usize {
        (self.0 >> (Self::PARENT_AT - 1)) as usize & 1
    }
}

/// What becomes of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Stage {
    /// It is among the layer's fresh nodes.
    Fresh = 0,
    /// It waits in its band.
    Waiting = 0x80,
    /// It was expanded, or is of no interest.
    Closed,
}

const NO_NODE: Node = Node { cost: f64::INFINITY, link: Link((Stage::Closed as u64) << Link::STAGE_AT) };

/// The nodes of one observation, by state.
#[derive(Debug, Default)]
pub(super) struct Layer {
    /// [`NO_NODE`] where there is none.
    pub(super) nodes: Vec<Node>,
    /// The states of which nodes were found, or found to cost less, and are in no band yet.
    pub(super) fresh: Vec<PassedIdx>,
    /// How many these are: the first ones. For the others there is room.
    pub(super) n_fresh: usize,
    /// By band, its last entry.
    lasts: Vec<EntryIdx>,
    /// The nodes that were put into bands, and those that are of no interest.
    pub(super) entries: Vec<Entry>,
}

/// A node in its band.
#[derive(Clone, Copy, Debug)]
pub(super) struct Entry {
    /// What the way to the node costs, with the distance.
    pub(super) g: f64,
    pub(super) state: PassedIdx,
    /// The entry before it in the band.
    pub(super) before: EntryIdx,
}

/// One more than an entry's place; 0 for none.
pub(super) type EntryIdx = u32;

impl Layer {
    /// How much memory a state takes in a layer, in bytes: the place of its node, and that node's in the lists.
    pub(super) const PLACE_BYTES: usize = size_of::<Node>() + size_of::<PassedIdx>() + size_of::<Entry>();

    /// Forgets the nodes, and keeps the memory.
    pub(super) fn clear(&mut self) {
        self.entries.drain(..).for_each(|entry| self.nodes[entry.state as usize] = NO_NODE);
        self.fresh[..self.n_fresh].iter().for_each(|state| self.nodes[*state as usize] = NO_NODE);
        self.n_fresh = 0;
        self.lasts.clear();
    }

    /// Makes room for the nodes of so many states.
    #[inline]
    pub(super) fn make_places(&mut self, n_states: usize) {
        if self.nodes.len() < n_states {
            self.grow(n_states);
        }
    }

    #[cold]
    fn grow(&mut self, n_states: usize) {
        // A part more, as there are many layers.
        const PART: usize = 8;
        if self.nodes.capacity() < n_states {
            self.nodes.reserve_exact(n_states + n_states / PART - self.nodes.len());
        }
        self.nodes.resize(n_states, NO_NODE);
    }

    /// How much memory is kept, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.nodes.capacity() * size_of::<Node>()
            + self.fresh.capacity() * size_of::<PassedIdx>()
            + self.lasts.capacity() * size_of::<EntryIdx>()
            + self.entries.capacity() * size_of::<Entry>()
    }

    /// The states of which there are nodes, some more than once.
    pub(super) fn found(&self) -> impl Iterator<Item = PassedIdx> {
        self.entries.iter().map(|entry| entry.state).chain(self.fresh[..self.n_fresh].iter().copied())
    }

    /// Puts the fresh nodes into their bands, but into none before `first`; those that are not below `limit` into none.
    pub(super) fn sort_in(&mut self, estimates: Estimates<'_>, bands: Bands, first: BandIdx, limit: f64) {
        const NO_ENTRY: Entry = Entry { g: 0.0, state: 0, before: 0 };
        let Self { nodes, fresh, lasts, entries, .. } = self;
        let (nodes, lasts) = (nodes.as_mut_slice(), lasts.as_mut_slice());
        let (n_entries, n_fresh) = (entries.len(), std::mem::take(&mut self.n_fresh));
        entries.resize(n_entries + n_fresh, NO_ENTRY);
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep them far below 2^32")]
        let mut entry_idx = n_entries as EntryIdx;
        for (entry, &state) in entries[n_entries..].iter_mut().zip(&fresh[..n_fresh]) {
            entry_idx += 1;
            let node = &mut nodes[state as usize];
            let Estimate { distance, cost_to_go } = estimates.of(state);
            let g = node.cost + distance;
            let f = g + cost_to_go;
            let mut before = 0;
            node.link.move_to(Stage::Closed);
            if f < limit {
                node.link.move_to(Stage::Waiting);
                before = std::mem::replace(&mut lasts[bands.of(f, first) as usize], entry_idx);
            }
            *entry = Entry { g, state, before };
        }
    }

    /// Takes all fresh nodes, none of which goes on.
    pub(super) fn close_fresh(&mut self, mut close: impl FnMut(PassedIdx, f64)) {
        for &state in &self.fresh[..std::mem::take(&mut self.n_fresh)] {
            let node = &mut self.nodes[state as usize];
            node.link.move_to(Stage::Closed);
            close(state, node.cost);
            self.entries.push(Entry { g: node.cost, state, before: 0 });
        }
    }

    /// Makes so many bands.
    pub(super) fn make_bands(&mut self, n_bands: u32) {
        self.lasts.resize(n_bands as usize, 0);
    }

    /// Empties a band. Gives its last entry.
    #[inline]
    pub(super) fn take(&mut self, band: BandIdx) -> EntryIdx {
        std::mem::take(&mut self.lasts[band as usize])
    }

    /// What takes up to so many ways to nodes of the first `n_states` states.
    #[inline]
    pub(super) fn reaching(&mut self, n_states: usize, n_ways: usize) -> Reaching<'_> {
        self.make_places(n_states);
        // There is room for one that is none.
        if self.fresh.len() <= self.n_fresh + n_ways {
            self.fresh.resize(2 * (self.n_fresh + n_ways) + 1, 0);
        }
        Reaching { nodes: &mut self.nodes[..n_states], fresh: &mut self.fresh, n_fresh: self.n_fresh }
    }
}

/// Takes ways to the nodes of a layer. It has room for all, so that it calls nothing.
pub(super) struct Reaching<'l> {
    nodes: &'l mut [Node],
    fresh: &'l mut [PassedIdx],
    /// How many fresh nodes there are with those that it has found.
    pub(super) n_fresh: usize,
}

impl Reaching<'_> {
    /// Takes a way, if it is cheaper.
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    pub(super) fn reach(&mut self, state: PassedIdx, cost: f64, link: Link) {
        let node = &mut self.nodes[state as usize];
        // Of numbers that are not negative, bits are in the same order.
        let [cost, known] = [cost, node.cost].map(f64::to_bits);
        let is_cheaper = cost < known;
        self.fresh[self.n_fresh] = state;
        self.n_fresh += usize::from(is_cheaper) & node.link.is_not_fresh();
        node.cost = f64::from_bits(select_unpredictable(is_cheaper, cost, known));
        node.link = Link(select_unpredictable(is_cheaper, link.0, node.link.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_tells_what_it_was_made_of_at_every_stage() {
        for kind in Link::KINDS {
            for (parent, action) in [(0, 0), (7, ActionIdx::MAX), (PassedIdx::MAX, 3)] {
                let mut link = Link::new(parent, action, kind);
                assert!(link.is_at(Stage::Fresh) && link.is_not_fresh() == 0);
                for stage in [Stage::Waiting, Stage::Closed] {
                    link.move_to(stage);
                    assert!(link.is_at(stage) && link.is_not_fresh() == 1);
                    assert_eq!((link.parent(), link.action(), link.kind()), (parent, action, kind));
                }
            }
        }
    }
}
