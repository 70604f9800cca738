//! Dynamics that list every state and transition.

mod document;
mod edges;
mod reading;

use std::io;
use std::sync::Arc;

pub use document::{ActionReference, StartDocument, TableDocument, TransitionDocument};
pub(super) use edges::{Edges, Uneven};
pub(super) use reading::read;

use super::dynamics::{Dynamics, write_definition};
use super::{Action, CompileError, Graph, Limits, Model, Start, StateIdx, States};
use crate::attribute::{AttributeDocument, Schema};
use crate::interrupt::{Interrupt, Meter};

/// Cost of an action that names none.
const DEFAULT_ACTION_COST: f64 = 1.0;

/// A model whose states and transitions are listed. Of those that leave a state by an action, the probabilities sum to 1.
#[derive(Clone, Debug)]
pub struct Table {
    schema: Schema,
    actions: Vec<Action>,
    /// Shared with the models that are compiled from this.
    states: Arc<States>,
    edges: Edges,
    start: Start,
    /// Ascending, all different.
    unsafe_states: Vec<StateIdx>,
}

impl Table {
    /// A table that the caller has checked. `unsafe_states` are ascending, and all different.
    pub(super) fn new(
        schema: Schema,
        actions: Vec<Action>,
        states: States,
        edges: Edges,
        start: Start,
        unsafe_states: Vec<StateIdx>,
    ) -> Self {
        Self { schema, actions, states: Arc::new(states), edges, start, unsafe_states }
    }
}

impl Table {
    /// The table of a model that lists its states. `edges` are its transitions, `unsafe_states` ascending, and all different.
    pub(super) fn of_model(model: &Model, edges: Edges, unsafe_states: Vec<StateIdx>) -> Self {
        Self {
            schema: model.schema.clone(),
            actions: model.actions.clone(),
            states: Arc::clone(&model.states),
            edges,
            start: model.start.clone(),
            unsafe_states,
        }
    }

    /// How many states there are.
    #[must_use]
    pub fn n_states(&self) -> usize {
        self.states.len() as usize
    }

    /// How many transitions there are, those into unsafe states and those without effect too.
    #[must_use]
    pub fn n_transitions(&self) -> usize {
        self.edges.len()
    }

    /// Of how many states and actions there are several outcomes.
    #[must_use]
    pub fn n_stochastic(&self) -> usize {
        self.edges.n_stochastic
    }
}

impl Dynamics for Table {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, _: Limits) -> u64 {
        let n_states = u64::from(self.states.len());
        let n_bytes = Model::compiled_bytes(n_states, self.edges.len() as u64, self.schema.len() as u64);
        n_bytes.saturating_add(self.edges.columns_bytes())
    }

    /// Leaves out transitions that no mapping can use: those into unsafe states, and those without effect, as a `skip` costs no action. Of an
    /// action with several outcomes, all of them stay.
    fn compile(self: Arc<Self>, _: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError> {
        /// How many transitions are looked at between two looks at the interrupt: less than a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let n_states = self.states.len() as usize;
        // Without unsafe states, the list is empty.
        let n_noted = if self.unsafe_states.is_empty() { 0 } else { n_states };
        let mut is_unsafe = vec![false; n_noted];
        for state in &self.unsafe_states {
            is_unsafe[*state as usize] = true;
        }
        let is_useful = |from: StateIdx, to: StateIdx| from != to && is_unsafe.get(to as usize) != Some(&true);
        let graph = if self.edges.has_columns() {
            let outcomes = self.edges.outcomes();
            let outcomes =
                outcomes.filter(|(from, (way, _, probability))| *probability < 1.0 || is_useful(*from, way.to));
            Graph::of_outcomes(n_states, outcomes, &mut meter)?
        } else {
            Graph::new(n_states, self.edges.iter().filter(|(from, way)| is_useful(*from, way.to)), &mut meter)?
        };
        let (states, start) = (Arc::clone(&self.states), self.start.clone());
        Ok(Model {
            n_transitions: self.edges.len(),
            n_stochastic: self.edges.n_stochastic,
            n_unsafe: self.unsafe_states.len(),
            is_unsafe,
            ..Model::listed(self.schema.clone(), self.actions.clone(), states, graph, start)
        })
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        let attributes = self.schema.attributes().iter().map(AttributeDocument::from);
        write_definition(writer, Some(attributes.collect()), &self.actions, self)
    }
}

#[cfg(test)]
mod tests;
