//! The mapping while the demonstration is still running: observations in, one by one, committed steps out.
//!
//! Of every state, the cheapest way from the last committed node to that state at the newest observation is known; these ways
//! form a tree whose leaves are the *survivors*. A new observation adds a layer to the tree, from the layer before it
//! alone; branches that no survivor hangs on are cut. Work for an observation is `O(|E| + |V| log |V|)`, however many came
//! before.
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
//! - with a lookahead of H, once the observation H past the root's has come, the cheapest way to it decides: it is
//!   committed up to its first move that advances, and the ways that do not begin so are given up. States that have lost
//!   their way by that get the cheapest one that is left, by sweeping the (at most H) layers after the new root again.
//!
//! Ties go to the way found first: from the lower state, by `skip` before actions in their order; and to the lower state among
//! survivors.

mod layer;
mod tree;

use std::collections::VecDeque;
use std::num::NonZeroU32;
use std::sync::Arc;

use super::cost::Cost;
use super::distances::ObservedDistances;
use super::policy::{Step, StepWriter};
use super::problem::choose_start;
use super::{Mapper, Mapping, Move, MoveKind, Status};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::StateIdx;
use layer::Layer;
use tree::{NO_NODE, NodeId, Tree};

/// A step that will not be revised.
#[derive(Clone, Debug, PartialEq)]
pub struct CommittedStep {
    /// The step.
    pub step: Step,
    /// Whether it is part of a cheapest mapping of the whole demonstration, whatever is still to come, among those that
    /// begin with the steps committed before it.
    pub is_proven: bool,
    /// How many observations had come when it was committed.
    pub after: u32,
}

/// A mapping in the making.
#[derive(Debug)]
pub struct OnlineMapping {
    mapper: Arc<Mapper>,
    weights: Weights,
    start: Option<StateIdx>,
    lookahead: Option<NonZeroU32>,
    /// Of the observations from the root's on.
    distances: VecDeque<ObservedDistances>,
    n_observed: u32,
    tree: Tree,
    layer: Layer,
    /// Kept to be filled again.
    next: Layer,
    /// The last committed node, and the cost of the way to it.
    root: NodeId,
    root_cost: f64,
    writer: StepWriter,
    moves: Vec<Move>,
    cost: Cost,
    was_forced: bool,
}

impl OnlineMapping {
    /// A mapping of a demonstration of which nothing has come yet. `start` overrides the model's; `lookahead` is how many
    /// observations past the current one a decision may wait for, `None` for all.
    ///
    /// # Panics
    ///
    /// If the model is searched lazily: each layer looks at all states.
    #[must_use]
    pub fn new(mapper: Arc<Mapper>, weights: Weights, start: Option<StateIdx>, lookahead: Option<NonZeroU32>) -> Self {
        assert!(!mapper.model().is_lazy(), "each layer needs all states");
        let n_states = mapper.model().graph().n_states();
        Self {
            mapper,
            weights,
            start,
            lookahead,
            distances: VecDeque::new(),
            n_observed: 0,
            tree: Tree::default(),
            layer: Layer::new(n_states),
            next: Layer::new(n_states),
            root: 0,
            root_cost: 0.0,
            writer: StepWriter::default(),
            moves: Vec::new(),
            cost: Cost::default(),
            was_forced: false,
        }
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

    /// How many nodes are in memory, besides those of the newest layer's buffers.
    #[must_use]
    pub fn n_nodes(&self) -> usize {
        self.tree.n_alive()
    }

    /// Takes the next observation, shape `[n_attributes]`, and gives the steps that it commits.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so; the mapping is then of no more use. It is not asked to finish.
    pub fn observe(
        &mut self,
        observation: &[Option<Value>],
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Cancelled> {
        let mut committed = Vec::new();
        let model = self.mapper.model();
        let observed = ObservedDistances::new(model.schema(), model.states(), observation, &self.weights);
        self.n_observed += 1;
        if self.n_observed == 1 {
            let state =
                self.start.unwrap_or_else(|| choose_start(model, |state| observed.distance(model.states(), state)));
            self.root_cost = observed.distance(model.states(), state);
            self.distances.push_back(observed);
            self.root = self.tree.plant(0, state);
            let first = Move { kind: MoveKind::Start, action: None, observation: 0, state };
            // There is no other start.
            committed.push(self.commit(first, true));
            self.sweep_from_root(interrupt)?;
        } else {
            self.distances.push_back(observed);
            self.extend(self.distances.len() - 1, interrupt)?;
        }
        self.commit_shared(&mut committed);
        while self.must_decide() {
            self.decide(&mut committed);
            self.sweep_from_root(interrupt)?;
            self.commit_shared(&mut committed);
        }
        Ok(committed)
    }

    /// Ends the demonstration, and commits the rest of the cheapest mapping. `None` if nothing was observed.
    #[must_use]
    pub fn end(mut self) -> Option<(Vec<CommittedStep>, Mapping)> {
        let survivor = self.layer.cheapest()?;
        let mut committed = Vec::new();
        for step in self.tree.path(self.root, self.layer.nodes[survivor]) {
            committed.push(self.commit(step, true));
        }
        let status = if self.was_forced { Status::Local } else { Status::Optimal };
        let lower_bound = (status == Status::Optimal).then_some(self.cost.total);
        // Each observation looks at every state once.
        let n_expanded = u64::from(self.n_observed) * self.layer.costs.len() as u64;
        let n_generated = u64::from(self.n_observed) * self.mapper.model().graph().n_transitions() as u64;
        let mapping =
            Mapping { moves: self.moves, cost: self.cost, status, lower_bound, n_expanded, n_generated, states: None };
        Some((committed, mapping))
    }

    /// The observation that the root belongs to.
    fn root_observation(&self) -> u32 {
        self.tree.get(self.root).observation
    }

    fn newest(&self) -> u32 {
        self.n_observed - 1
    }

    /// Whether the lookahead past the root is used up.
    fn must_decide(&self) -> bool {
        self.lookahead.is_some_and(|lookahead| self.root_observation() + lookahead.get() <= self.newest())
    }

    /// Commits every step that all survivors share.
    fn commit_shared(&mut self, committed: &mut Vec<CommittedStep>) {
        while self.root_observation() < self.newest()
            && let Some(child) = self.tree.only_child(self.root)
        {
            let step = self.tree.step(child);
            self.advance(child, &step);
            committed.push(self.commit(step, true));
            self.tree.cut_above(child);
        }
    }

    /// Commits the cheapest way to the newest observation, up to its first move that advances, and gives up the rest.
    fn decide(&mut self, committed: &mut Vec<CommittedStep>) {
        self.was_forced = true;
        let Some(survivor) = self.layer.cheapest() else { return };
        let observation = self.root_observation();
        let path = self.tree.path(self.root, self.layer.nodes[survivor]);
        for step in path {
            self.root_cost = self.cost_after(&step);
            committed.push(self.commit(step, false));
            if step.observation > observation {
                self.tree.clear();
                self.root = self.tree.plant(step.observation, step.state);
                self.forget_before(step.observation);
                return;
            }
        }
    }

    /// Makes `child` the root.
    fn advance(&mut self, child: NodeId, step: &Move) {
        self.root_cost = self.cost_after(step);
        self.root = child;
        self.forget_before(step.observation);
    }

    fn cost_after(&self, step: &Move) -> f64 {
        let model = self.mapper.model();
        let action_cost = step.action.map_or(0.0, |action| model.action(action).cost);
        self.root_cost + action_cost + self.distances_of(step.observation).distance(model.states(), step.state)
    }

    fn distances_of(&self, observation: u32) -> &ObservedDistances {
        let first = self.n_observed as usize - self.distances.len();
        &self.distances[observation as usize - first]
    }

    fn forget_before(&mut self, observation: u32) {
        let first = self.n_observed as usize - self.distances.len();
        self.distances.drain(..observation as usize - first);
    }

    fn commit(&mut self, step: Move, is_proven: bool) -> CommittedStep {
        let model = self.mapper.model();
        let mut writer = self.writer;
        let terms = self.distances_of(step.observation).terms(model.states(), step.state);
        let written = writer.write(model, model.states(), &step, terms);
        self.cost = writer.cost();
        self.writer = writer;
        self.moves.push(step);
        CommittedStep { step: written, is_proven, after: self.n_observed }
    }

    /// Makes the layers from the root's to the newest anew.
    fn sweep_from_root(&mut self, interrupt: &mut dyn Interrupt) -> Result<(), Cancelled> {
        let root = *self.tree.get(self.root);
        self.layer.clear();
        self.layer.costs[root.state as usize] = self.root_cost;
        self.layer.nodes[root.state as usize] = self.root;
        let model = self.mapper.model();
        self.layer.spread(model, &self.distances[0]);
        self.layer.grow(&mut self.tree, root.observation);
        for index in 1..self.distances.len() {
            self.extend(index, interrupt)?;
        }
        Ok(())
    }

    /// Adds the layer of the observation at `index` of `distances`.
    fn extend(&mut self, index: usize, interrupt: &mut dyn Interrupt) -> Result<(), Cancelled> {
        if interrupt.poll() == Signal::Cancel {
            return Err(Cancelled);
        }
        let model = self.mapper.model();
        self.next.clear();
        self.next.follow(&self.layer, model);
        self.next.spread(model, &self.distances[index]);
        let first = self.n_observed as usize - self.distances.len();
        #[expect(clippy::cast_possible_truncation, reason = "observations are counted in u32")]
        self.next.grow(&mut self.tree, (first + index) as u32);
        for node in self.layer.nodes.iter().filter(|node| **node != NO_NODE) {
            self.tree.cut_if_childless(*node, self.root);
        }
        std::mem::swap(&mut self.layer, &mut self.next);
        Ok(())
    }
}
