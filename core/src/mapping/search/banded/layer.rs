//! The nodes of one observation.

use super::NO_ACTION;
use super::passed::PassedIdx;
use crate::mapping::MoveKind;
use crate::model::ActionIdx;

/// How the cheapest way to a node that was found ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    /// Of the way, before the distance is paid; infinite if there is none.
    pub(super) cost: f64,
    /// The state that it comes from.
    pub(super) parent: PassedIdx,
    pub(super) action: ActionIdx,
    pub(super) kind: MoveKind,
    pub(super) stage: Stage,
}

/// What becomes of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// It is among the layer's open nodes.
    Open,
    /// It waits for a pass with a higher bound.
    Waiting,
    /// It was expanded, or is of no interest.
    Closed,
}

const NO_NODE: Node =
    Node { cost: f64::INFINITY, parent: 0, action: NO_ACTION, kind: MoveKind::Start, stage: Stage::Closed };

/// The nodes of one observation, by state.
#[derive(Debug, Default)]
pub(super) struct Layer {
    /// [`NO_NODE`] where there is none.
    pub(super) nodes: Vec<Node>,
    /// The states of which there are nodes.
    pub(super) found: Vec<PassedIdx>,
    /// Those of which nodes are [open](Stage::Open), in the order in which they came to be.
    pub(super) open: Vec<PassedIdx>,
    /// Those of which nodes [wait](Stage::Waiting), with the `f` that they had, and some that do not wait any more.
    waiting: Vec<(f64, PassedIdx)>,
}

impl Layer {
    /// How much memory a state takes in a layer, in bytes: the place of its node, and that node's in the lists.
    pub(super) const PLACE_BYTES: usize =
        size_of::<Node>() + 2 * size_of::<PassedIdx>() + size_of::<(f64, PassedIdx)>();

    /// Forgets the nodes, and keeps the memory.
    pub(super) fn clear(&mut self) {
        self.found.drain(..).for_each(|state| self.nodes[state as usize] = NO_NODE);
        self.open.clear();
        self.waiting.clear();
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
            + (self.found.capacity() + self.open.capacity()) * size_of::<PassedIdx>()
            + self.waiting.capacity() * size_of::<(f64, PassedIdx)>()
    }

    /// Takes a way to the node of a state, if it is cheaper. There must be [places](Self::make_places).
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    pub(super) fn reach(&mut self, state: PassedIdx, cost: f64, parent: PassedIdx, kind: MoveKind, action: ActionIdx) {
        let node = &mut self.nodes[state as usize];
        if cost < node.cost {
            if node.cost == f64::INFINITY {
                self.found.push(state);
            }
            if node.stage != Stage::Open {
                self.open.push(state);
            }
            *node = Node { cost, parent, action, kind, stage: Stage::Open };
        }
    }

    /// Lets a node wait, of this `f`.
    #[inline]
    pub(super) fn wait(&mut self, state: PassedIdx, f: f64) {
        self.nodes[state as usize].stage = Stage::Waiting;
        self.waiting.push((f, state));
    }

    /// Opens the nodes that wait and whose `f` is below `bound`, and leaves out those that are not below `limit`.
    pub(super) fn open_waiting(&mut self, bound: f64, limit: f64) {
        let Self { nodes, open, waiting, .. } = self;
        waiting.retain(|(f, state)| {
            if *f >= bound {
                return *f < limit;
            }
            let stage = &mut nodes[*state as usize].stage;
            if *stage == Stage::Waiting {
                *stage = Stage::Open;
                open.push(*state);
            }
            false
        });
    }
}
