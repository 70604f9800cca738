//! A body in its world, as searches run on it, whatever it was made from.

use std::sync::{Arc, OnceLock};

use super::explored::{Explored, Unexplored};
use super::reach::Reach;
use super::{
    Action, ActionIdx, Graph, Implicit, Limits, Operator, Outcome, Space, Start, StateIdx, States, Transition, Whole,
};
use crate::attribute::{ByAttribute, Scalar, Schema, Value};
use crate::interrupt::{Interrupt, Interrupted, Meter};

/// A body in its world, ready to be searched.
#[derive(Debug)]
pub struct Model {
    /// The attributes of its states.
    pub(super) schema: Schema,
    /// What the body can do.
    pub(super) actions: Vec<Action>,
    /// Shared with the table that they come from, if any. If the model is searched lazily: the start states.
    pub(super) states: Arc<States>,
    /// The transitions that the body may make.
    pub(super) graph: Graph,
    /// Where it may start if a request does not say.
    pub(super) start: Start,
    /// See [`Self::n_transitions`].
    pub(super) n_transitions: usize,
    /// See [`Self::n_stochastic`].
    pub(super) n_stochastic: usize,
    /// Shape `[n_states]`; empty if no state is unsafe, or none of those is listed.
    pub(super) is_unsafe: Vec<bool>,
    /// How many states are unsafe.
    pub(super) n_unsafe: usize,
    /// What finds the states, if they are not listed.
    pub(super) unexplored: Option<Arc<dyn Unexplored>>,
    /// See [`Self::state_bytes`].
    pub(super) state_bytes: OnceLock<usize>,
    /// Which values the states have, by attribute.
    pub(super) reaches: OnceLock<Box<[Reach]>>,
}

impl Model {
    /// A model of listed states, none of which is unsafe.
    pub(super) fn listed(
        schema: Schema,
        actions: Vec<Action>,
        states: Arc<States>,
        graph: Graph,
        start: Start,
    ) -> Self {
        Self {
            schema,
            actions,
            states,
            n_transitions: graph.n_transitions(),
            graph,
            start,
            n_stochastic: 0,
            is_unsafe: Vec::new(),
            n_unsafe: 0,
            unexplored: None,
            state_bytes: OnceLock::new(),
            reaches: OnceLock::new(),
        }
    }

    /// A model of the states that a body with these `actions` reaches by the rules of `dynamics`, found breadth first and numbered as they
    /// are found. If that are more than `limits` allow, the model [is searched lazily](Self::is_lazy).
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn explore<D: Implicit>(
        schema: Schema,
        actions: Vec<Action>,
        dynamics: Arc<D>,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Self, Interrupted> {
        /// How many successors or transitions are looked at between two looks at the interrupt: well below a millisecond.
        const POLL_EVERY: u64 = 1 << 10;
        /// What a transition takes in the graph, besides the one that was found.
        const TRANSITION_BYTES: usize = 2 * size_of::<Transition>();
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let max_states = limits.max_states.min(limits.max_values / schema.len());
        if dynamics.least_states(&mut meter)? > max_states as u64 {
            return Ok(Self::unexplored(schema, actions, dynamics));
        }
        let work = dynamics.work().max(actions.len() as u64);
        let mut explored = dynamics.explore_from_start();
        let start = start_of(explored.n_found());
        let mut from = 0;
        while from < explored.n_found() {
            let n_bytes = explored.found_bytes() + explored.n_transitions() * TRANSITION_BYTES;
            if explored.n_found() > max_states || n_bytes > limits.max_bytes {
                let n_stochastic = explored.n_stochastic();
                drop(explored);
                return Ok(Self { n_stochastic, ..Self::unexplored(schema, actions, dynamics) });
            }
            meter.spend_or_stop(work)?;
            #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
            explored.explore(from as StateIdx);
            from += 1;
        }
        let (n_stochastic, unsafe_states) = (explored.n_stochastic(), explored.unsafe_states().to_vec());
        let (states, graph) = explored.into_parts(&mut meter)?;
        let mut is_unsafe = vec![false; if unsafe_states.is_empty() { 0 } else { states.len() as usize }];
        for state in &unsafe_states {
            is_unsafe[*state as usize] = true;
        }
        let listed = Self::listed(schema, actions, Arc::new(states), graph, start);
        Ok(Self { n_stochastic, is_unsafe, n_unsafe: unsafe_states.len(), ..listed })
    }

    /// The model of which nothing but the start is known.
    fn unexplored<D: Implicit>(schema: Schema, actions: Vec<Action>, dynamics: Arc<D>) -> Self {
        let states = dynamics.explore_from_start().into_states();
        let n_states = states.len() as usize;
        let (graph, start) = (Graph::without_transitions(n_states), start_of(n_states));
        let listed = Self::listed(schema, actions, Arc::new(states), graph, start);
        Self { unexplored: Some(dynamics), ..listed }
    }

    /// The attributes of its states.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The actions of the body, in the order of their indices.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    /// Whether there are too many states to list them, so that each search finds the states that it comes to and numbers them itself. Then
    /// [`Self::states`] has only the start states, and [`Self::graph`] no transitions.
    #[must_use]
    pub fn is_lazy(&self) -> bool {
        self.unexplored.is_some()
    }

    /// For a model that is searched lazily: the states with these rows, numbered from 0 on, from which a search finds the others. `None` if
    /// the model lists its states.
    ///
    /// # Panics
    ///
    /// If there is no such state; those that [`Self::read_start`] gives are there.
    pub(crate) fn explore_from(&self, rows: &[Vec<u32>]) -> Option<Explored<'_>> {
        let unexplored = self.unexplored.as_ref()?;
        Some(unexplored.explore_from(rows).expect("a search starts in a state of its model"))
    }

    /// For a model that is searched lazily: every way in which its actions change attributes. `None` if the model lists its transitions.
    pub(crate) fn operators(&self) -> Option<Box<dyn Iterator<Item = Operator> + '_>> {
        Some(self.unexplored.as_ref()?.operators())
    }

    /// Whether the [operators](Self::operators) tell all changes of the attribute at `attribute`; so do listed transitions.
    pub(crate) fn is_told(&self, attribute: usize) -> bool {
        self.unexplored.as_ref().is_none_or(|unexplored| unexplored.is_told(attribute))
    }

    /// What searches see of a model that lists its states.
    pub(crate) fn whole(&self) -> Whole<'_> {
        Whole::new(&self.states, &self.graph)
    }

    /// The states.
    #[must_use]
    pub fn states(&self) -> &States {
        &self.states
    }

    /// The transitions that a body may make: those that have an effect and do not lead into an unsafe state, and all outcomes of an action
    /// that has several.
    #[must_use]
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// Where each action that has an effect may lead from `state`, in the order of the actions.
    pub fn outcomes(&self, state: StateIdx) -> impl Iterator<Item = (ActionIdx, Outcome<StateIdx>)> {
        let (costs, probabilities) = (self.graph.own_costs(state), self.graph.probabilities(state));
        self.graph.successors(state).iter().enumerate().map(move |(n, Transition { action, to })| {
            let probability = probabilities.get(n).copied().unwrap_or(1.0);
            (*action, Outcome { to: *to, probability, cost: costs.get(n).and_then(|cost| cost.get()) })
        })
    }

    /// Whether a state has this `value` of a category or of labels, the attribute at `attribute`. `O(1)` after the first call.
    pub(crate) fn has_value(&self, attribute: usize, value: &Value) -> bool {
        self.reaches()[attribute].has(value, self.states.domain(attribute))
    }

    /// From where to where the states' values go, if the attribute at `attribute` is a number. `O(1)` after the first call.
    #[inline]
    pub(crate) fn range(&self, attribute: usize) -> Option<(f64, f64)> {
        match self.reaches()[attribute] {
            Reach::Numbers { least, greatest } => Some((least, greatest)),
            Reach::Few | Reach::Many { .. } => None,
        }
    }

    #[inline]
    fn reaches(&self) -> &[Reach] {
        self.reaches.get_or_init(|| {
            let attributes = self.schema.attributes().iter().enumerate();
            attributes.map(|(at, attribute)| Reach::of(&attribute.kind, self.states.domain(at))).collect()
        })
    }

    /// Where the imitator may start if a request does not say.
    #[must_use]
    pub fn start(&self) -> &Start {
        &self.start
    }

    /// Whether `state` must never be entered.
    #[must_use]
    pub fn is_unsafe(&self, state: StateIdx) -> bool {
        self.is_unsafe.get(state as usize).copied().unwrap_or(false)
    }

    /// How many transitions its definition lists, including those that are not in [`Self::graph`].
    #[must_use]
    pub fn n_transitions(&self) -> usize {
        self.n_transitions
    }

    /// Of how many states and actions there are several outcomes, with a probability each. Searches need there to be none.
    #[must_use]
    pub fn n_stochastic(&self) -> usize {
        self.n_stochastic
    }

    /// How many of the listed states must never be entered.
    #[must_use]
    pub fn n_unsafe(&self) -> usize {
        self.n_unsafe
    }

    /// The values of `state`, as they are written outside.
    #[must_use]
    pub fn describe(&self, state: StateIdx) -> ByAttribute<Scalar> {
        self.describe_one_of(&self.states, state)
    }

    /// The values of one of `states`, which have this model's attributes, as they are written outside.
    pub(crate) fn describe_one_of(&self, states: &States, state: StateIdx) -> ByAttribute<Scalar> {
        let values = states.values(state);
        let written =
            self.schema.attributes().iter().zip(values).map(|(attribute, value)| attribute.write_value(value));
        self.schema.by_attribute(written)
    }

    /// About how many bytes of JSON the values of a state take: the length of those of the first state. `O(1)` after the first call.
    pub fn state_bytes(&self) -> usize {
        let first = || serde_json::to_string(&self.describe(0)).map_or(usize::MAX, |text| text.len());
        *self.state_bytes.get_or_init(first)
    }

    /// About how much memory it takes to read and compile a model of so many states, transitions and attributes, in bytes. It is enough for
    /// most models. A model takes more if nearly every state has its own value in several attributes, or if texts are long;
    /// [`Self::size_bytes`] tells what it takes, once the model is compiled.
    #[must_use]
    pub fn compiled_bytes(n_states: u64, n_transitions: u64, n_attributes: u64) -> u64 {
        /// Besides its row, a state has an offset into the transitions, and a value of its own.
        const STATE_BYTES: u64 = 32;
        /// A transition is listed, in the graph, and in a projection.
        const TRANSITION_BYTES: u64 = 20;
        /// Domains, actions, and whatever else a model has once.
        const OTHER_BYTES: u64 = 1 << 16;
        // Lists of rows grow while they are read, and have room to spare.
        let row_bytes = n_attributes * (size_of::<u32>() as u64) * 3 / 2;
        let states = n_states.saturating_mul(row_bytes + STATE_BYTES);
        states.saturating_add(n_transitions.saturating_mul(TRANSITION_BYTES)).saturating_add(OTHER_BYTES)
    }

    /// Approximate size in memory, in bytes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        let start = if let Start::Candidates(states) = &self.start { size_of_val(states.as_slice()) } else { 0 };
        start + self.states.size_bytes() + self.graph.size_bytes() + self.is_unsafe.len()
    }

    /// The action at `index`.
    #[must_use]
    pub fn action(&self, index: ActionIdx) -> &Action {
        &self.actions[usize::from(index)]
    }

    /// The name of the action at `index`, shared.
    #[must_use]
    pub fn action_name(&self, index: ActionIdx) -> Arc<str> {
        self.action(index).name.clone()
    }
}

/// The start where the first `n_states` states are those to start in.
fn start_of(n_states: usize) -> Start {
    #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
    let n_states = n_states as StateIdx;
    if n_states == 1 { Start::State(0) } else { Start::Candidates((0..n_states).collect()) }
}
