//! The state graph that searches run on.

use super::{ActionIdx, Rows, StateIdx};
use crate::interrupt::{Interrupted, Meter};

/// A transition, of which the state that it leaves is known.
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
    /// By the state that they leave.
    transitions: Rows<Transition>,
}

impl Graph {
    /// A graph of `n_states` states with the transitions that `edges` gives, in any order. It iterates over `edges` twice, so that
    /// nothing but the graph takes memory. `O(n_states + E log d)`, d the most transitions out of a state.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    ///
    /// # Panics
    ///
    /// If there are 2^32 transitions or more.
    pub(super) fn new<E>(n_states: usize, edges: E, meter: &mut Meter<'_>) -> Result<Self, Interrupted>
    where
        E: Iterator<Item = (StateIdx, Transition)> + Clone,
    {
        let mut transitions = Rows::try_of_entries(n_states, edges, || meter.spend_or_stop(1))?;
        for state in 0..n_states {
            let out = transitions.of_mut(state);
            meter.spend_or_stop(1 + out.len() as u64)?;
            out.sort_unstable_by_key(|transition| (transition.action, transition.to));
        }
        Ok(Self { transitions })
    }

    /// A graph of states that no transition leaves.
    pub(super) fn without_transitions(n_states: usize) -> Self {
        Self { transitions: Rows::of_entries(n_states, std::iter::empty()) }
    }

    /// The transitions from `state`, in the order of their actions.
    #[inline]
    #[must_use]
    pub fn successors(&self, state: StateIdx) -> &[Transition] {
        self.transitions.of(state as usize)
    }

    /// How many states there are.
    #[must_use]
    pub fn n_states(&self) -> usize {
        self.transitions.n_rows()
    }

    /// How many transitions there are.
    #[must_use]
    pub fn n_transitions(&self) -> usize {
        self.transitions.n_items()
    }

    /// Every transition with the state that it leaves, in order.
    pub fn iter(&self) -> impl Iterator<Item = (StateIdx, Transition)> + Clone {
        let rows = self.transitions.iter().zip(0..);
        rows.flat_map(|(row, from)| row.iter().map(move |transition| (from, *transition)))
    }

    pub(super) fn size_bytes(&self) -> usize {
        self.transitions.size_bytes()
    }
}
