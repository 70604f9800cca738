//! The ways into the states of a model, in one array, so that the cheapest way to a state is found with one look at each.

use std::sync::{Arc, Mutex, PoisonError, Weak};

use crate::mapping::conditions::Body;
use crate::model::{Model, Rows, StateIdx};

/// The ways of a body into each state: from each other state the cheapest; from lower states first.
#[derive(Debug, Default)]
pub(in crate::mapping) struct WaysIn {
    /// By state, those that they come from.
    sources: Rows<StateIdx>,
    /// What each of them costs, in the same order. Finite, at least 0.
    costs: Vec<f64>,
    pub(super) body: Body,
    /// The most ways into a state, or out of one.
    pub(super) most: usize,
    /// The least cost of a way; infinite if there is none.
    pub(super) least_cost: f64,
}

impl WaysIn {
    fn new(model: &Model, body: &Body) -> Self {
        let (space, n_states) = (model.whole(), model.graph().n_states());
        let from_each = (0..model.states().len()).flat_map(|from| {
            let ways = body.ways(&space, from).filter(move |(way, _)| way.to != from);
            ways.map(move |(way, cost)| (way.to, (from, cost)))
        });
        let mut ways = Rows::of_entries(n_states, from_each);
        ways.dedup(|(last, least_cost), (from, cost)| {
            let is_same = last == from;
            if is_same {
                *least_cost = least_cost.min(*cost);
            }
            is_same
        });
        let most_in = ways.iter().map(<[_]>::len).max().unwrap_or(0);
        let most_out = (0..model.states().len()).map(|state| model.graph().successors(state).len()).max().unwrap_or(0);
        let costs: Vec<f64> = ways.items().iter().map(|(_, cost)| *cost).collect();
        Self {
            sources: ways.map(|(from, _)| *from),
            least_cost: costs.iter().copied().fold(f64::INFINITY, f64::min),
            costs,
            body: body.clone(),
            most: most_in.max(most_out),
        }
    }

    /// The states that ways into a state come from.
    #[inline]
    pub(super) fn sources(&self, state: StateIdx) -> &[StateIdx] {
        self.sources.of(state as usize)
    }

    /// The ways into a state: where each comes from, and what it costs.
    #[inline]
    pub(super) fn of(&self, state: StateIdx) -> impl Iterator<Item = (StateIdx, f64)> {
        let range = self.sources.range(state as usize);
        self.sources(state).iter().copied().zip(self.costs[range].iter().copied())
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.sources.size_bytes() + size_of_val(self.costs.as_slice())
    }
}

/// How much memory the ways into the states of `model` take at most, in bytes.
pub(super) fn most_bytes(model: &Model) -> usize {
    model.graph().n_transitions() * size_of::<(StateIdx, f64)>() + model.graph().n_states() * size_of::<u32>()
}

/// The ways that were made last, for as long as somebody has them: most bodies are alike.
#[derive(Debug, Default)]
pub(in crate::mapping) struct SharedWaysIn(Mutex<Weak<WaysIn>>);

impl SharedWaysIn {
    /// The ways of `body` into the states of `model`, which is the same every time.
    pub(super) fn of(&self, model: &Model, body: &Body) -> Arc<WaysIn> {
        let shared = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(ways) = shared().upgrade().filter(|ways| ways.body == *body) {
            return ways;
        }
        let ways = Arc::new(WaysIn::new(model, body));
        *shared() = Arc::downgrade(&ways);
        ways
    }
}
