//! What a search sees of a model: numbered states, and the transitions from them.

use super::{Graph, OwnCost, StateIdx, States, Transition};

/// The states of a model, as a search walks from one to another. A search of unlisted states adds those that it comes to.
pub(crate) trait Space {
    /// Finds the transitions from `state`, if they are not known yet.
    fn explore(&mut self, state: StateIdx);

    /// The transitions from `state`, which was explored, in the order of their actions.
    fn successors(&self, state: StateIdx) -> &[Transition];

    /// What the body pays itself for each of the [`successors`](Self::successors) of `state`, in their order. May be empty if none of them
    /// has a cost of its own.
    fn own_costs(&self, state: StateIdx) -> &[OwnCost];

    /// The row of `state`: per attribute, the index of its value in the domain. Shape `[n_attributes]`.
    fn row(&self, state: StateIdx) -> &[u32];

    /// Whether a state has the same number in every search.
    fn keeps_numbers(&self) -> bool;

    /// How many states there are; `None` if they are not listed.
    fn n_states(&self) -> Option<usize>;

    /// About how much memory the states and transitions that this search found take, in bytes.
    fn found_bytes(&self) -> usize;

    /// Reserves memory for `growth` times as many states, once there is hardly any left.
    fn make_room(&mut self, growth: f64);
}

/// The states and transitions of a model that lists them all.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Whole<'m> {
    states: &'m States,
    graph: &'m Graph,
}

impl<'m> Whole<'m> {
    pub(super) fn new(states: &'m States, graph: &'m Graph) -> Self {
        Self { states, graph }
    }
}

impl Space for Whole<'_> {
    #[inline]
    fn explore(&mut self, _: StateIdx) {}

    #[inline]
    fn successors(&self, state: StateIdx) -> &[Transition] {
        self.graph.successors(state)
    }

    #[inline]
    fn own_costs(&self, state: StateIdx) -> &[OwnCost] {
        self.graph.own_costs(state)
    }

    #[inline]
    fn row(&self, state: StateIdx) -> &[u32] {
        self.states.row(state)
    }

    fn keeps_numbers(&self) -> bool {
        true
    }

    fn n_states(&self) -> Option<usize> {
        Some(self.graph.n_states())
    }

    #[inline]
    fn found_bytes(&self) -> usize {
        0
    }

    fn make_room(&mut self, _: f64) {}
}
