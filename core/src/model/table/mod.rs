//! Dynamics that list every state and transition.

mod document;
mod reading;

use std::io;
use std::sync::Arc;

pub use document::{ActionReference, StartDocument, TableDocument, TransitionDocument};
pub(super) use reading::read;

use super::dynamics::{Dynamics, write_definition};
use super::{Action, ActionIdx, Graph, Limits, Model, Start, StateIdx, States, Transition};
use crate::attribute::Schema;
use crate::interrupt::{Interrupt, Interrupted, Meter};

/// Cost of an action that names none.
const DEFAULT_ACTION_COST: f64 = 1.0;

/// A model whose states and transitions are listed. At most one transition leaves a state by an action.
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

/// Transitions in the order of the document, by column: 10 bytes each.
#[derive(Clone, Debug, Default)]
pub(super) struct Edges {
    from: Vec<StateIdx>,
    action: Vec<ActionIdx>,
    to: Vec<StateIdx>,
}

impl Edges {
    pub(super) fn push(&mut self, from: StateIdx, action: ActionIdx, to: StateIdx) {
        self.from.push(from);
        self.action.push(action);
        self.to.push(to);
    }

    fn len(&self) -> usize {
        self.from.len()
    }

    fn iter(&self) -> impl Iterator<Item = (StateIdx, Transition)> + Clone {
        let transitions = self.action.iter().zip(&self.to).map(|(action, to)| Transition { action: *action, to: *to });
        self.from.iter().copied().zip(transitions)
    }
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

impl Dynamics for Table {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, _: Limits) -> u64 {
        let n_states = u64::from(self.states.len());
        Model::compiled_bytes(n_states, self.edges.len() as u64, self.schema.len() as u64)
    }

    /// Leaves out transitions that no mapping can use: those into unsafe states, and those without effect, as a `skip` costs no action.
    fn compile(self: Arc<Self>, _: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, Interrupted> {
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
        let is_useful = |(from, transition): &(StateIdx, Transition)| {
            *from != transition.to && is_unsafe.get(transition.to as usize) != Some(&true)
        };
        let graph = Graph::new(n_states, self.edges.iter().filter(is_useful), &mut meter)?;
        let (states, start) = (Arc::clone(&self.states), self.start.clone());
        Ok(Model {
            n_transitions: self.edges.len(),
            n_unsafe: self.unsafe_states.len(),
            is_unsafe,
            ..Model::listed(self.schema.clone(), self.actions.clone(), states, graph, start)
        })
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        write_definition(writer, Some(&self.schema), &self.actions, self)
    }
}
