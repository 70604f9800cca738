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
    /// A graph of `n_states` states with the transitions that `edges` gives, in any order. It goes through them twice, so that
    /// nothing is kept but the graph. `O(n_states + E log d)`, d the most transitions out of a state.
    ///
    /// # Panics
    ///
    /// If there are 2^32 transitions or more.
    pub(super) fn new<E>(n_states: usize, edges: E) -> Self
    where
        E: Iterator<Item = (StateIdx, Transition)> + Clone,
    {
        // First `offsets[s + 1]` is where the transitions out of `s` begin, and moves on as they are put in; in the end it is
        // where they end.
        let mut offsets = vec![0u32; n_states + 1];
        let mut n_transitions = 0usize;
        for (from, _) in edges.clone() {
            n_transitions += 1;
            if let Some(next) = offsets.get_mut(from as usize + 2) {
                *next += 1;
            }
        }
        assert!(u32::try_from(n_transitions).is_ok(), "at most 2^32 transitions");
        for state in 2..=n_states {
            offsets[state] += offsets[state - 1];
        }
        let mut transitions = vec![Transition { action: 0, to: 0 }; n_transitions];
        for (from, transition) in edges {
            let next = &mut offsets[from as usize + 1];
            transitions[*next as usize] = transition;
            *next += 1;
        }
        for bounds in offsets.windows(2) {
            transitions[bounds[0] as usize..bounds[1] as usize]
                .sort_unstable_by_key(|transition| (transition.action, transition.to));
        }
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
