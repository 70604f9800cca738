//! What a search is asked.

use super::conditions::Body;
use super::distances::{Distances, EndDistances, Terms, plain_terms};
use super::recurrence::Recurrence;
use super::{Conditions, Demonstration, Move};
use crate::attribute::{ByAttribute, Weights};
use crate::model::{Model, Origin, Start, StateIdx, States};

/// A demonstration to be followed by a body, under given weights and conditions.
#[derive(Debug)]
pub struct Problem<'m> {
    pub(crate) model: &'m Model,
    pub(crate) demonstration: Demonstration,
    pub(crate) weights: Weights,
    pub(crate) conditions: Conditions,
    pub(crate) starts: Starts,
    pub(crate) distances: Distances<'m>,
    /// What ending costs; `None` if it is free.
    pub(crate) end: Option<EndDistances>,
    pub(super) body: Body,
    collapsed: Option<Box<Collapsed>>,
}

/// What was collapsed.
#[derive(Debug)]
struct Collapsed {
    /// The conditions for the whole demonstration.
    conditions: Conditions,
    /// By observation that is kept, its number in the whole.
    numbers: Vec<u32>,
}

/// What a problem is made of, besides the model: kept between problems that have much in common.
#[derive(Debug)]
pub(super) struct Parts {
    pub(super) demonstration: Demonstration,
    pub(super) weights: Weights,
    /// Without starts, which are as below, and with free ends.
    pub(super) conditions: Conditions,
    pub(super) starts: Starts,
    pub(super) terms: Terms,
    pub(super) body: Body,
}

impl<'m> Problem<'m> {
    /// A problem of parts that belong together, and to `model`.
    pub(super) fn of_parts(model: &'m Model, parts: Parts) -> Self {
        let Parts { demonstration, weights, conditions, starts, terms, body } = parts;
        let distances = Distances::of_terms(model, terms);
        Self { model, demonstration, weights, conditions, starts, distances, end: None, body, collapsed: None }
    }

    /// The parts of a problem that was made of them.
    pub(super) fn into_parts(self) -> Parts {
        let Self { demonstration, weights, conditions, starts, distances, body, .. } = self;
        Parts { demonstration, weights, conditions, starts, terms: distances.into_terms(), body }
    }

    /// A problem. Of a demonstration that is to be [collapsed](Conditions::collapse), only the observations that are kept are followed; they
    /// are counted anew here, and in policies as they were.
    ///
    /// # Panics
    ///
    /// If the conditions name states or actions that the model does not have.
    #[must_use]
    pub fn new(model: &'m Model, demonstration: Demonstration, weights: Weights, conditions: Conditions) -> Self {
        let (demonstration, conditions, collapsed) = match &conditions.collapse {
            None => (demonstration, conditions, None),
            Some(within) => {
                let (kept, numbers) = demonstration.collapsed(model.schema(), within);
                let of_kept = conditions.of_kept(&numbers);
                (kept, of_kept, Some(Box::new(Collapsed { conditions, numbers })))
            }
        };
        let starts = Starts::of(model, conditions.starts.as_deref());
        let body = conditions.body(model);
        let (schema, states) = (model.schema(), model.states());
        let distances = Distances::new(schema, states, &demonstration, &weights, &conditions);
        let last = demonstration.observation(demonstration.len() - 1);
        let end = (conditions.end_weight > 0.0)
            .then(|| EndDistances::new(schema, states, last, &weights, conditions.end_weight));
        Self { model, demonstration, weights, conditions, starts, distances, end, body, collapsed }
    }

    /// The weights of the distance, by attribute.
    #[must_use]
    pub fn named_weights(&self) -> ByAttribute<f64> {
        self.model.schema().by_attribute(self.weights.as_slice().iter().copied())
    }

    /// The demonstration, as far as it is followed.
    #[must_use]
    pub fn demonstration(&self) -> &Demonstration {
        &self.demonstration
    }

    /// The weights of the distance.
    #[must_use]
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// The conditions for the whole demonstration, as they were given.
    #[must_use]
    pub fn conditions(&self) -> &Conditions {
        self.collapsed.as_ref().map_or(&self.conditions, |collapsed| &collapsed.conditions)
    }

    /// The number in the whole demonstration of an observation that is followed.
    #[must_use]
    pub fn number_of(&self, observation: u32) -> u32 {
        self.collapsed.as_ref().map_or(observation, |collapsed| collapsed.numbers[observation as usize])
    }

    /// The start state that is closest to the first observation, the first among equals: its number in a search of this problem.
    #[must_use]
    pub fn closest_start(&self) -> StateIdx {
        let distances = self.starts.iter(self.model).map(|(state, row)| (self.distances.distance(0, row), state));
        let closest = distances.min_by(|(distance, _), (other, _)| distance.total_cmp(other));
        closest.map_or(0, |(_, state)| state)
    }

    /// Index of the last observation, `n`.
    pub(crate) fn last(&self) -> usize {
        self.demonstration.len() - 1
    }

    /// What moves cost.
    pub(super) fn recurrence(&self) -> Recurrence {
        self.conditions.recurrence()
    }

    /// Whether the attribute at `position` adds to some distance, or to what ending costs.
    pub(super) fn depends_on(&self, position: usize) -> bool {
        self.distances.is_active(position) || self.end.as_ref().is_some_and(|end| end.has(position))
    }

    /// Whether a step pays something of whatever distance there is.
    pub(super) fn pays_at(&self, step: &Move) -> bool {
        let is_weighed = self.conditions.observation_weight(step.observation as usize) > 0.0;
        is_weighed && self.recurrence().paid(step.kind, 1.0) > 0.0
    }

    /// Whether a state with this row, of `states`, is what was observed, so far as attributes weigh something.
    pub(super) fn is_met(&self, observation: usize, states: &States, row: &[u32]) -> bool {
        let seen = self.demonstration.observation(observation);
        plain_terms(self.model.schema(), states, seen, &self.weights, row).all(|(_, term)| term == 0.0)
    }

    /// What ending costs in a state with this row.
    #[inline]
    pub(super) fn end_cost(&self, row: &[u32]) -> f64 {
        self.end.as_ref().map_or(0.0, |end| end.cost(row))
    }
}

/// The start states, at least one, each once. Searches number them as [`Self::iter`] does.
#[derive(Debug)]
pub(crate) struct Starts {
    /// In the order of their numbers; if the model is searched lazily, these are 0, 1, ..
    states: Vec<StateIdx>,
    /// Their rows, if the model is searched lazily, one after the other.
    rows: Vec<Vec<u32>>,
}

impl Starts {
    /// The start states of `model` that are listed, or all that it has.
    pub(crate) fn of(model: &Model, listed: Option<&[Origin]>) -> Self {
        let mut states = Vec::new();
        let mut rows: Vec<Vec<u32>> = Vec::new();
        match listed {
            Some(origins) => {
                for origin in origins {
                    match origin {
                        Origin::State(state) => states.push(*state),
                        Origin::Row(row) => rows.push(row.0.clone()),
                    }
                }
            }
            None => states = start_states(model),
        }
        if model.is_lazy() {
            // A search that finds its states numbers them from the start states on.
            rows.extend(states.drain(..).map(|state| model.states().row(state).to_vec()));
            let mut seen = std::collections::HashSet::new();
            rows.retain(|row| seen.insert(row.clone()));
            states.extend((0..).take(rows.len()));
        } else {
            states.sort_unstable();
            states.dedup();
        }
        Self { states, rows }
    }

    /// From now on, there is only this one.
    pub(super) fn go_to(&mut self, origin: &Origin) {
        self.states.clear();
        self.rows.clear();
        match origin {
            Origin::State(state) => self.states.push(*state),
            Origin::Row(row) => {
                self.states.push(0);
                self.rows.push(row.0.clone());
            }
        }
    }

    /// Each start state with its row.
    pub(crate) fn iter<'s>(&'s self, model: &'s Model) -> impl Iterator<Item = (StateIdx, &'s [u32])> + Clone {
        let row = |number: usize, state| self.rows.get(number).map_or_else(|| model.states().row(state), Vec::as_slice);
        self.states.iter().enumerate().map(move |(number, state)| (*state, row(number, *state)))
    }

    /// Their numbers.
    pub(crate) fn states(&self) -> &[StateIdx] {
        &self.states
    }

    /// Their rows, if the model is searched lazily.
    pub(crate) fn rows(&self) -> &[Vec<u32>] {
        &self.rows
    }

    /// The value that all of them have of the attribute at `position`, if it is one.
    pub(crate) fn common_value(&self, model: &Model, position: usize) -> Option<u32> {
        let mut values = self.iter(model).map(|(_, row)| row[position]);
        let first = values.next()?;
        values.all(|value| value == first).then_some(first)
    }
}

/// The states that a model says may be started in.
fn start_states(model: &Model) -> Vec<StateIdx> {
    match model.start() {
        Start::State(state) => vec![*state],
        Start::Candidates(candidates) => candidates.clone(),
        Start::Any => (0..model.states().len()).filter(|state| !model.is_unsafe(*state)).collect(),
    }
}
