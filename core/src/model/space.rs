//! What a search sees of a model: states by number, and the ways out of them.

use super::{Graph, StateIdx, States, Transition};

/// States as a search walks on them. What is known of them may grow as it goes.
pub(crate) trait Space {
    /// Finds the ways out of `state`, if they are not known yet.
    fn explore(&mut self, state: StateIdx);

    /// The ways out of `state`, which was explored, in the order of their actions.
    fn successors(&self, state: StateIdx) -> &[Transition];

    /// The row of `state`: per attribute, the index of its value in the domain. Shape `[n_attributes]`.
    fn row(&self, state: StateIdx) -> &[u32];

    /// Whether a state has the same number in every search.
    fn keeps_numbers(&self) -> bool;

    /// How many states there are, if that is known.
    fn n_states(&self) -> Option<usize>;

    /// About how much memory what was found so far takes, in bytes.
    fn found_bytes(&self) -> usize;

    /// Makes room for `growth` times as many states, once there is hardly any left.
    fn make_room(&mut self, growth: f64);
}

/// All states and transitions of a model, known beforehand.
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
