//! What a search is asked.

use super::Demonstration;
use super::distances::Distances;
use crate::attribute::{ByAttribute, Weights};
use crate::model::{Model, Origin, Start, StateIdx};

/// A demonstration to be followed by a body, under given weights, from a given start.
#[derive(Debug)]
pub struct Problem<'m> {
    pub(crate) model: &'m Model,
    pub(crate) demonstration: Demonstration,
    pub(crate) weights: Weights,
    /// `s_0`: its number in a search of this problem.
    pub(crate) start: StateIdx,
    /// The row of `s_0`. Shape `[n_attributes]`.
    pub(crate) start_row: Vec<u32>,
    pub(crate) distances: Distances<'m>,
}

impl<'m> Problem<'m> {
    /// A problem. `start` overrides the model's; without either, `s_0` is the candidate closest to `o_0`, the lowest
    /// index among equals.
    #[must_use]
    pub fn new(model: &'m Model, demonstration: Demonstration, weights: Weights, start: Option<Origin>) -> Self {
        let distances = Distances::new(model.schema(), model.states(), &demonstration, &weights);
        let row_of = |state| model.states().row(state).to_vec();
        let (state, start_row) = match start {
            None => {
                let state = choose_start(model, |state| distances.distance(0, model.states().row(state)));
                (state, row_of(state))
            }
            Some(Origin::State(state)) => (state, row_of(state)),
            Some(Origin::Row(row)) => (0, row.0.to_vec()),
        };
        // A search that finds its states numbers them from the start on.
        let start = if model.is_lazy() { 0 } else { state };
        Self { model, demonstration, weights, start, start_row, distances }
    }

    /// The weights of the distance, by attribute.
    #[must_use]
    pub fn named_weights(&self) -> ByAttribute<f64> {
        self.model.schema().by_attribute(self.weights.as_slice().iter().copied())
    }

    /// The demonstration.
    #[must_use]
    pub fn demonstration(&self) -> &Demonstration {
        &self.demonstration
    }

    /// The weights of the distance.
    #[must_use]
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// Where the imitator starts, `s_0`; always 0 if the model is searched lazily.
    #[must_use]
    pub fn start(&self) -> StateIdx {
        self.start
    }

    /// Index of the last observation, `n`.
    pub(crate) fn last(&self) -> usize {
        self.demonstration.len() - 1
    }

    /// The least cost of an action; 0 if the body has none.
    pub(crate) fn least_action_cost(&self) -> f64 {
        self.model.actions().iter().map(|action| action.cost).reduce(f64::min).unwrap_or(0.0)
    }
}

/// `s_0` where the request names none, given the distances to `o_0`.
pub(super) fn choose_start(model: &Model, distance: impl Fn(StateIdx) -> f64) -> StateIdx {
    match model.start() {
        Start::State(state) => *state,
        Start::Candidates(candidates) => closest(candidates.iter().copied(), distance),
        Start::Any => closest((0..model.states().len()).filter(|state| !model.is_unsafe(*state)), distance),
    }
}

fn closest(candidates: impl Iterator<Item = StateIdx>, distance: impl Fn(StateIdx) -> f64) -> StateIdx {
    let measured = candidates.map(|state| (distance(state), state));
    let closest = measured.min_by(|(d, state), (other_d, other)| d.total_cmp(other_d).then(state.cmp(other)));
    // Readers of models see to it that there is a candidate.
    closest.map_or(0, |(_, state)| state)
}
