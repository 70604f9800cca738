//! The mapping while the demonstration is still running: observations in, one by one, committed steps out. What is told here of
//! windows, memory and ties holds for all files of this folder.
//!
//! Of every state, the cheapest way from the last committed node, the *root*, to that state at the newest observation is known;
//! these ways form a tree whose leaves are the *survivors*. A new observation adds a layer to the tree, from the layer before it
//! alone; branches that no survivor hangs on die. Work for an observation is `O(|E| + |V| log |V|)`, at most `H` times that where
//! a lookahead of `H` decides, however many observations came before.
//!
//! ```text
//!  committed          tree                   newest layer
//!  o---o---o ----+---o---o---+---o---o
//!          root  |           +---o---o   survivors: every state that can be reached
//!                +---o-------+---o---o
//! ```
//!
//! What is committed is final:
//!
//! - a step that all survivors share is *proven*: whatever is still to come, the cheapest mapping that begins with the
//!   steps committed before it goes on with this one, or with one of equal cost;
//! - where there are several start states, the tree hangs on a root before all of them, from which each is reached for nothing: a start is
//!   committed as a move from there is;
//! - with a lookahead of H, once the observation H past the root's has come, the cheapest way to it decides: it is
//!   committed up to its first move that advances, and the ways that do not begin so are given up: the (at most H) layers after the
//!   new root are swept again. So it is where the caller says that the time for a step is up ([`OnlineMapping::decide`]), whatever has
//!   come by then.
//!
//! Hence all that is still to be committed follows from the root and the observations from its own on, and a mapping can go on from there
//! after a restart ([`OnlineMapping::resume`]): with the same steps, to the bit.
//!
//! **What can be left out.** Nothing is known of what is to come, so no survivor is ruled out by its cost: an observation may
//! still come that only it is close to. What rules one out for good is that another reaches it as cheaply, and that is what
//! extras within the newest layer do: such a state is kept, on the other's branch. A bound from the model's projections
//! rules out no more: they bound what is to come of known observations, and a survivor's way is wanted whether it is
//! the cheapest or not, or else nothing would be proven. But two things are never looked at:
//!
//! - states that cannot be reached from the root any more (what was grabbed stays grabbed);
//! - extras from a state that costs no less than it did at the observation before, if an extra pays the whole distance: the same action
//!   would have led from there as a match, to the same state, for no more.
//!
//! **Memory.** Older layers keep the observation and the nodes that survivors hang on, at most 8 bytes per state; but no costs, and no
//! distances: of the few states that steps lead to, these are computed again. Requests with a lookahead beyond [`longest_lookahead`] are
//! refused.
//!
//! **Ties.** The way found first is kept: a skip, then matches, from the lower state first, then extras, from the cheaper state
//! first; of actions between the same two states the cheapest, the first among equals. Among survivors the lower state is the cheapest.
//! All this depends on the root and the observations alone, so that the same ones give the same steps.

mod committed;
mod layer;
mod memory;
mod root;
mod window;

use std::num::NonZeroU32;
use std::sync::Arc;

use super::distances::{EndDistances, ObservedDistances};
use super::policy::StepWriter;
use super::problem::Starts;
use super::{Conditions, Mapper, Mapping, Move, MoveKind, PolicyEnd, Status};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::{Model, StateIdx};
pub use committed::{CommittedStep, Stopped};
use layer::{Layer, Source, Sweep};
pub(crate) use memory::longest_lookahead;
use memory::n_terms;
pub use root::{CommittedMove, Root};
use window::{NodePlace, Window};

/// A mapping in the making.
#[derive(Debug)]
pub struct OnlineMapping {
    model: Arc<Model>,
    weights: Weights,
    conditions: Conditions,
    lookahead: Option<NonZeroU32>,
    n_observed: u32,
    /// The newest observation. Shape `[n_attributes]`.
    newest: Vec<Option<Value>>,
    n_swept: u64,
    window: Window,
    /// The cost of the way to the window's root, summed as the layers' costs are.
    root_cost: f64,
    sweep: Sweep,
    writer: StepWriter,
    moves: Vec<Move>,
    /// What the action of each of these costs.
    action_costs: Vec<f64>,
    was_forced: bool,
    /// How many terms of distances an observation has, one for each value of an attribute that weighs something.
    n_terms: usize,
    max_bytes: usize,
    /// Whether the survivors' ways are what they should be: not while an observation is taken, nor after one that was broken off.
    is_whole: bool,
}

impl OnlineMapping {
    /// A mapping of a demonstration of which nothing has come yet. `lookahead` is how many observations past the current one a decision may
    /// wait for, `None` for all.
    ///
    /// # Panics
    ///
    /// If the model is searched lazily: each layer looks at all states.
    #[must_use]
    pub fn new(mapper: &Mapper, weights: Weights, conditions: Conditions, lookahead: Option<NonZeroU32>) -> Self {
        let model = mapper.shared_model();
        assert!(!model.is_lazy(), "each layer needs all states");
        let n_terms = n_terms(&model, |position| weights.as_slice()[position] > 0.0);
        let sweep = Sweep::new(&model, &conditions);
        let window = Window::new(model.states().len());
        Self {
            model,
            weights,
            conditions,
            lookahead,
            n_observed: 0,
            newest: Vec::new(),
            n_swept: 0,
            window,
            root_cost: 0.0,
            sweep,
            writer: StepWriter::default(),
            moves: Vec::new(),
            action_costs: Vec::new(),
            was_forced: false,
            n_terms,
            max_bytes: usize::MAX,
            is_whole: true,
        }
    }

    /// The same, in about `max_bytes` at most: an observation that would take more is not taken.
    #[must_use]
    pub fn within(self, max_bytes: usize) -> Self {
        Self { max_bytes, ..self }
    }

    /// How many observations have come.
    #[must_use]
    pub fn n_observed(&self) -> u32 {
        self.n_observed
    }

    /// How many steps were committed.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.moves.len()
    }

    /// How many nodes of observations from the last committed one on survivors hang on. Looks at each of these observations.
    #[must_use]
    pub fn n_nodes(&self) -> usize {
        self.window.n_alive()
    }

    /// How many nodes were looked at: every state once for each layer that was swept.
    pub(super) fn n_expanded(&self) -> u64 {
        self.n_swept * self.model.graph().n_states() as u64
    }

    /// How many nodes the next observation looks at, at most.
    pub(super) fn next_expanded(&self) -> u64 {
        let lookahead = self.lookahead.map_or(0, NonZeroU32::get);
        // Whatever is decided leaves so many layers that are swept again.
        let is_due = self.lookahead.is_some() && self.window.n_before.saturating_add(lookahead) <= self.n_observed + 1;
        let n_sweeps = 1 + if is_due { u64::from(lookahead) } else { 0 };
        n_sweeps.saturating_mul(self.model.graph().n_states() as u64)
    }

    /// How many transitions were looked at.
    pub(super) fn n_generated(&self) -> u64 {
        self.n_swept * self.model.graph().n_transitions() as u64
    }

    /// The cheapest way to what has come; where an observation was broken off, the committed steps.
    pub(super) fn into_moves(self) -> Vec<Move> {
        if self.is_whole { self.end().map(|(_, mapping)| mapping.moves).unwrap_or_default() } else { self.moves }
    }

    /// Takes the next observation, shape `[n_attributes]`, and gives the steps that it commits. `observation_weight` is
    /// finite and at least 0; `None`: as the conditions say.
    ///
    /// # Errors
    ///
    /// [`Stopped::Cancelled`] if `interrupt` said so; it is not asked to finish. [`Stopped::Memory`] if the mapping would come to take
    /// more than it [may](Self::within). The mapping is then of no more use.
    pub fn observe(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: Option<f64>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Stopped> {
        self.check_memory(self.next_layer_bytes())?;
        self.is_whole = false;
        let of_conditions = || self.conditions.observation_weight(self.n_observed as usize);
        let observation_weight = observation_weight.unwrap_or_else(of_conditions);
        let committed = self.take(observation, observation_weight, interrupt)?;
        self.is_whole = true;
        Ok(committed)
    }

    fn take(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Stopped> {
        let mut committed = Vec::new();
        let model = &*Arc::clone(&self.model);
        let observed = ObservedDistances::new(model, observation, &self.weights, observation_weight);
        self.n_observed += 1;
        self.newest.clear();
        self.newest.extend_from_slice(observation);
        if self.is_resumed() {
            self.begin(&[(self.window.root, self.root_cost)], Source::NONE, observed);
        } else if self.n_observed == 1 {
            let starts = Starts::of(model, self.conditions.starts.as_deref());
            let arrived = |state: &StateIdx| {
                let distance = observed.distance(model, *state);
                (*state, self.sweep.recurrence.arrive(MoveKind::Start, 0.0, distance))
            };
            let first: Vec<(StateIdx, f64)> = starts.states().iter().map(arrived).collect();
            self.window.add(Layer::before_starts(model.graph().n_states()));
            self.begin(&first, Source::before(self.window.root), observed);
        } else {
            let layer = self.follow(observed, interrupt)?;
            self.window.push(layer);
        }
        self.commit_shared(&mut committed);
        while self.must_decide() {
            self.commit_cheapest(&mut committed, interrupt)?;
        }
        Ok(committed)
    }

    /// Commits the cheapest way to the newest observation, up to and including its first move that advances from the root's, for a step
    /// whose time is up; and whatever all ways that are left share then. The start counts as a move that advances from before the first
    /// observation. Commits nothing if no observation has come after the root's. What is decided so is forced: the status is local.
    ///
    /// # Errors
    ///
    /// As [`Self::observe`].
    pub fn decide(&mut self, interrupt: &mut dyn Interrupt) -> Result<Vec<CommittedStep>, Stopped> {
        let mut committed = Vec::new();
        if self.window.layers.len() > 1 {
            self.is_whole = false;
            self.commit_cheapest(&mut committed, interrupt)?;
            self.is_whole = true;
        }
        Ok(committed)
    }

    /// How many steps would be committed if the demonstration ended now.
    #[must_use]
    pub fn n_rest(&self) -> usize {
        self.survivor().map_or(0, |survivor| self.window.path(survivor).len())
    }

    /// The state in which the cheapest mapping of what has come ends; `None` if nothing has.
    fn survivor(&self) -> Option<StateIdx> {
        let newest = self.window.layers.back()?;
        match self.end_distances() {
            Some(end) => newest.cheapest_to_end(|state| end.cost(self.model.states().row(state))),
            None => newest.cheapest(),
        }
    }

    /// What ending costs now, unless it is free.
    fn end_distances(&self) -> Option<EndDistances> {
        let (schema, states, end_weight) = (self.model.schema(), self.model.states(), self.conditions.end_weight);
        (end_weight > 0.0).then(|| EndDistances::new(schema, states, &self.newest, &self.weights, end_weight))
    }

    /// Ends the demonstration, and commits the rest of the cheapest mapping. `None` if nothing was observed.
    #[must_use]
    pub fn end(mut self) -> Option<(Vec<CommittedStep>, Mapping)> {
        let survivor = self.survivor()?;
        let row = self.model.states().row(survivor);
        let end_cost = self.end_distances().map_or(0.0, |end| end.cost(row));
        let end = PolicyEnd::at(&self.model, row, &self.newest, &self.weights);
        let path = self.window.path(survivor);
        let committed = path.into_iter().map(|place| self.commit_at(place, true)).collect();
        let status = if self.was_forced { Status::Local } else { Status::Optimal };
        let cost = self.writer.cost_with_end(end_cost);
        let lower_bound = (status == Status::Optimal).then_some(cost.total);
        let (n_expanded, n_generated) = (self.n_expanded(), self.n_generated());
        let mapping = Mapping {
            moves: self.moves,
            action_costs: self.action_costs,
            cost,
            end,
            status,
            lower_bound,
            stopped_by: None,
            n_expanded,
            n_generated,
            states: None,
        };
        Some((committed, mapping))
    }

    /// Whether the lookahead past the root is used up.
    fn must_decide(&self) -> bool {
        // So many layers are before the one of the newest observation.
        let newest = self.n_observed;
        self.lookahead.is_some_and(|lookahead| self.window.n_before.saturating_add(lookahead.get()) <= newest)
    }

    /// Commits every step that all survivors share.
    fn commit_shared(&mut self, committed: &mut Vec<CommittedStep>) {
        while let Some(child) = self.window.only_child(&self.model) {
            committed.push(self.commit_at(child, true));
            self.window.advance(child);
        }
    }

    /// Commits the cheapest way to the newest observation, up to its first move that advances, and what all ways share that are left.
    fn commit_cheapest(
        &mut self,
        committed: &mut Vec<CommittedStep>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(), Stopped> {
        self.was_forced = true;
        let survivor = self.window.layers.back().and_then(Layer::cheapest);
        for place in survivor.map(|survivor| self.window.path(survivor)).unwrap_or_default() {
            committed.push(self.commit_at(place, false));
            let (index, _) = place;
            if index > 0 {
                self.window.advance(place);
                break;
            }
        }
        self.restore(interrupt)?;
        self.commit_shared(committed);
        Ok(())
    }

    fn commit_at(&mut self, place: NodePlace, is_proven: bool) -> CommittedStep {
        let (step, action_cost) = self.window.step(&self.model, &self.sweep.body, place);
        let (model, recurrence) = (&self.model, self.sweep.recurrence);
        let layer = &self.window.layers[self.window.index_of(step.observation)];
        let distance = layer.observed.distance(model, step.state);
        self.root_cost = recurrence.arrive(step.kind, self.root_cost + action_cost, distance);
        let terms = layer.observed.terms(model, step.state);
        let paid = terms.map(|(position, term)| (position, recurrence.paid(step.kind, term)));
        let written = self.writer.write(model, model.states(), &step, action_cost, paid);
        self.moves.push(step);
        self.action_costs.push(action_cost);
        CommittedStep { step: written, is_proven, after: self.n_observed }
    }

    /// Finds the ways from the root anew.
    fn restore(&mut self, interrupt: &mut dyn Interrupt) -> Result<(), Stopped> {
        let model = &*Arc::clone(&self.model);
        let root = self.window.root;
        let mut observed = self.window.clear().into_iter();
        if let Some(mut first) = observed.next() {
            first.fill_tables(model);
            self.window.root = root;
            self.begin(&[(root, self.root_cost)], Source::NONE, first);
        }
        for mut observed in observed {
            observed.fill_tables(model);
            let layer = self.follow(observed, interrupt)?;
            self.window.push(layer);
        }
        Ok(())
    }

    /// Begins with the layer of these states, which come from `source`, and to which the way costs so much.
    fn begin(&mut self, first: &[(StateIdx, f64)], source: Source, observed: ObservedDistances) {
        self.n_swept += 1;
        let spare = self.window.spare();
        let first = first.iter().map(|(state, cost)| (*state, *cost, source));
        let layer = self.sweep.begin(&self.model, first, &self.window.reached, observed, spare);
        self.window.add(layer);
        self.window.shrink();
        self.window.recount();
    }

    /// The layer of the observation after the newest.
    fn follow(&mut self, observed: ObservedDistances, interrupt: &mut dyn Interrupt) -> Result<Layer, Stopped> {
        if interrupt.poll() == Signal::Cancel {
            return Err(Cancelled.into());
        }
        self.check_memory(self.window.layer_bytes(self.model.graph().n_states()))?;
        self.n_swept += 1;
        let spare = self.window.spare();
        let before = self.window.layers.back().expect("the first observation's layer begins a window");
        Ok(self.sweep.follow(&self.model, &before.costs, &self.window.reached, observed, spare))
    }
}

#[cfg(test)]
mod tests;
