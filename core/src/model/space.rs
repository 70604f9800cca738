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

/// Makes room for `growth` times as many items and half as many more, once there is room for only a few. So they are copied no more, as
/// they are whenever a vector that is full grows by itself; and what is not filled takes no memory. Nothing if there are no addresses for it.
pub(crate) fn make_room<T>(items: &mut Vec<T>, growth: f64) {
    // Without it, they grow as they come.
    let _ = items.try_reserve_exact(room_to_make(items.len(), items.capacity(), growth));
}

/// For how many more of `n_items` that does.
pub(crate) fn room_to_make(n_items: usize, capacity: usize, growth: f64) -> usize {
    const FEW: usize = 1 << 12;
    /// As not all items become more at the same pace.
    const MORE: f64 = 1.5;
    #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "about")]
    let times = |factor: f64| (n_items as f64 * factor) as usize;
    if capacity - n_items >= FEW || capacity >= times(growth) {
        return 0;
    }
    (times(growth * MORE) - n_items).max(FEW)
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
