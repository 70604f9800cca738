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

/// What the body pays for a transition itself, if anything: without, it pays what the action costs. Finite and at least 0, dimensionless.
#[derive(Clone, Copy, Debug)]
pub struct OwnCost(
    /// NaN: none.
    f64,
);

impl OwnCost {
    /// What the action costs.
    pub const NONE: Self = Self(f64::NAN);

    /// Wraps a cost that the caller knows to be finite and at least 0.
    #[must_use]
    pub fn of(cost: Option<f64>) -> Self {
        debug_assert!(cost.is_none_or(|cost| cost.is_finite() && cost >= 0.0), "{cost:?}");
        cost.map_or(Self::NONE, Self)
    }

    /// The cost, if there is one.
    #[must_use]
    pub fn get(self) -> Option<f64> {
        (!self.0.is_nan()).then_some(self.0)
    }

    /// What the body pays where the action costs `action_cost`.
    #[inline]
    #[must_use]
    pub fn or(self, action_cost: f64) -> f64 {
        if self.0.is_nan() { action_cost } else { self.0 }
    }
}

/// Transitions as a flat adjacency (compressed sparse rows), ordered by state, then action, then the state that they lead to.
#[derive(Debug)]
pub struct Graph {
    /// By the state that they leave.
    transitions: Rows<Transition>,
    /// One for each transition, in the same order; empty if none has a cost of its own.
    own_costs: Vec<OwnCost>,
    /// Likewise; empty if all are 1.
    probabilities: Vec<f64>,
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
        Ok(Self { transitions, own_costs: Vec::new(), probabilities: Vec::new() })
    }

    /// As [`Self::new`], of transitions with their own costs and their probabilities.
    pub(super) fn of_outcomes<E>(n_states: usize, edges: E, meter: &mut Meter<'_>) -> Result<Self, Interrupted>
    where
        E: Iterator<Item = (StateIdx, (Transition, OwnCost, f64))> + Clone,
    {
        let mut rows = Rows::try_of_entries(n_states, edges, || meter.spend_or_stop(1))?;
        for state in 0..n_states {
            let out = rows.of_mut(state);
            meter.spend_or_stop(1 + out.len() as u64)?;
            out.sort_unstable_by_key(|(transition, ..)| (transition.action, transition.to));
        }
        let outcomes = || rows.iter().flatten();
        let has_own_costs = outcomes().any(|(_, cost, _)| cost.get().is_some());
        let is_stochastic = outcomes().any(|(_, _, probability)| *probability < 1.0);
        let own_costs = outcomes().map(|(_, cost, _)| *cost).take_while(|_| has_own_costs).collect();
        let probabilities = outcomes().map(|(_, _, probability)| *probability).take_while(|_| is_stochastic).collect();
        Ok(Self { transitions: rows.map(|(transition, ..)| *transition), own_costs, probabilities })
    }

    /// A graph of states that no transition leaves.
    pub(super) fn without_transitions(n_states: usize) -> Self {
        Self {
            transitions: Rows::of_entries(n_states, std::iter::empty()),
            own_costs: Vec::new(),
            probabilities: Vec::new(),
        }
    }

    /// The transitions from `state`, in the order of their actions.
    #[inline]
    #[must_use]
    pub fn successors(&self, state: StateIdx) -> &[Transition] {
        self.transitions.of(state as usize)
    }

    /// What the body pays itself for each of the [`successors`](Self::successors) of `state`, in their order. Empty if no transition of the graph
    /// has a cost of its own.
    #[inline]
    #[must_use]
    pub fn own_costs(&self, state: StateIdx) -> &[OwnCost] {
        if self.own_costs.is_empty() { &[] } else { &self.own_costs[self.transitions.range(state as usize)] }
    }

    /// Whether some transitions have a cost of their own.
    #[must_use]
    pub fn has_own_costs(&self) -> bool {
        !self.own_costs.is_empty()
    }

    /// How probable each of the [`successors`](Self::successors) of `state` is once its action is taken, in their order. Empty if each action of
    /// the graph has one outcome.
    #[must_use]
    pub fn probabilities(&self, state: StateIdx) -> &[f64] {
        if self.probabilities.is_empty() { &[] } else { &self.probabilities[self.transitions.range(state as usize)] }
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
            + size_of_val(self.own_costs.as_slice())
            + size_of_val(self.probabilities.as_slice())
    }
}
