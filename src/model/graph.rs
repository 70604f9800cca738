//! The state graph that searches run on.

use super::{ActionIdx, StateIdx};

/// One way out of a state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transition {
    /// The action that leads along it.
    pub action: ActionIdx,
    /// The state that it leads to.
    pub to: StateIdx,
}

/// Transitions as a flat adjacency (compressed sparse rows), ordered by state, then action.
#[derive(Debug)]
pub struct Graph {
    /// `offsets[s]..offsets[s + 1]` are the transitions out of `s`. Shape `[n_states + 1]`.
    offsets: Vec<u32>,
    transitions: Vec<Transition>,
}

impl Graph {
    /// A graph of `n_states` states with the given transitions, in any order.
    ///
    /// # Panics
    ///
    /// If there are 2^32 transitions or more.
    pub(super) fn new(n_states: usize, mut edges: Vec<(StateIdx, Transition)>) -> Self {
        assert!(u32::try_from(edges.len()).is_ok(), "at most 2^32 transitions");
        edges.sort_unstable_by_key(|(from, transition)| (*from, transition.action, transition.to));
        let mut offsets = vec![0u32; n_states + 1];
        for (from, _) in &edges {
            offsets[*from as usize + 1] += 1;
        }
        for state in 0..n_states {
            offsets[state + 1] += offsets[state];
        }
        let transitions = edges.into_iter().map(|(_, transition)| transition).collect();
        Self { offsets, transitions }
    }

    /// The ways out of `state`, in the order of their actions.
    #[inline]
    #[must_use]
    pub fn successors(&self, state: StateIdx) -> &[Transition] {
        let state = state as usize;
        &self.transitions[self.offsets[state] as usize..self.offsets[state + 1] as usize]
    }

    /// How many states there are.
    #[must_use]
    pub fn n_states(&self) -> usize {
        self.offsets.len() - 1
    }

    /// How many transitions there are.
    #[must_use]
    pub fn n_transitions(&self) -> usize {
        self.transitions.len()
    }

    /// Every transition with the state that it leaves, in order.
    pub fn iter(&self) -> impl Iterator<Item = (StateIdx, Transition)> + '_ {
        let rows = self.offsets.windows(2).zip(0..);
        rows.flat_map(|(bounds, from)| {
            let row = &self.transitions[bounds[0] as usize..bounds[1] as usize];
            row.iter().map(move |transition| (from, *transition))
        })
    }

    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(self.offsets.as_slice()) + size_of_val(self.transitions.as_slice())
    }
}
