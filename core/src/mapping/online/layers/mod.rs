//! The cheapest ways from the root to every state, layer by layer.
//!
//! Of every state, the cheapest way from the root to that state at the newest observation is known; these ways form a [`Tree`] whose leaves
//! are the *survivors*. A new observation adds a [`Layer`] to the tree, from the layer before it alone; branches that no survivor hangs on
//! die.
//!
//! ```text
//!  committed          tree                   newest layer
//!  o---o---o ----+---o---o---+---o---o
//!          root  |           +---o---o   survivors: every state that can be reached
//!                +---o-------+---o---o
//! ```
//!
//! Where there are several start states, the tree hangs on a root before all of them, from which each is reached for nothing: a start is
//! decided as a move from there is. When a step is decided that not all survivors share, the ways that do not begin so are given up, and the
//! layers from the new root on are swept again.
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
//! **Time.** A layer is made by one look at each way into each state, in the order in which these lie in memory. Of extras, those are
//! tried first that the layer before had: where the demonstration goes on as it did, next to nothing is left for a queue. A state on which
//! no survivor hangs any more is looked at once more, when it dies.
//!
//! **Memory.** Older layers keep the observation and the nodes that survivors hang on, each as the number of the way by which it is reached
//! and that of its children: 2 bytes per state, or 8 where some state has more than 126 ways; but no costs, and no distances: of the few
//! states that steps lead to, these are computed again.

mod layer;
mod memory;
mod sweep;
mod tree;
mod ways_in;

use std::sync::Arc;

use super::decided::{Decided, Halt, Rest, RootNode, Work};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Interrupt, Signal};
use crate::mapping::conditions::Body;
use crate::mapping::distances::{EndDistances, ObservedDistances};
use crate::mapping::problem::Starts;
use crate::mapping::{Budget, Conditions, Mapper, MoveKind, PolicyEnd, StoppedBy};
use crate::model::{Model, Origin, StateIdx};
use layer::{Layer, Link};
pub(crate) use memory::longest_lookahead;
pub(super) use memory::most_bytes;
use memory::n_terms;
use sweep::Sweep;
use tree::{NodePlace, Tree};
pub(in crate::mapping) use ways_in::SharedWaysIn;

/// The ways to every state.
#[derive(Debug)]
pub(in crate::mapping) struct Layers {
    mapper: Arc<Mapper>,
    weights: Weights,
    /// What the ways are that this body has.
    body: Body,
    /// The listed start states.
    starts: Option<Vec<Origin>>,
    end_weight: f64,
    /// The newest observation. Shape `[n_attributes]`; empty before the first.
    newest: Vec<Option<Value>>,
    tree: Tree,
    /// The cost of the way to the tree's root, summed as the layers' costs are.
    pub(super) root_cost: f64,
    sweep: Sweep,
    /// How many terms of distances an observation has, one for each value of an attribute that weighs something.
    n_terms: usize,
    /// Every state counts once for each layer that was swept.
    pub(super) work: Work,
}

impl Layers {
    /// Nothing was observed yet.
    pub(super) fn new(mapper: &Arc<Mapper>, weights: Weights, conditions: &Conditions) -> Self {
        let model = mapper.model();
        assert!(!model.is_lazy(), "each layer needs all states");
        Self {
            n_terms: n_terms(model, |position| weights.as_slice()[position] > 0.0),
            sweep: Sweep::new(conditions),
            body: conditions.body(model),
            tree: Tree::new(model.states().len()),
            starts: conditions.starts.clone(),
            end_weight: conditions.end_weight,
            newest: Vec::new(),
            root_cost: 0.0,
            work: Work::default(),
            mapper: Arc::clone(mapper),
            weights,
        }
    }

    fn model(&self) -> &Model {
        self.mapper.model()
    }

    /// Goes on from `root`, when nothing was observed yet.
    pub(super) fn go_to(&mut self, root: &RootNode, work: Work) {
        self.tree.n_before = root.observation + 1;
        self.tree.root = root.state;
        (self.root_cost, self.work) = (root.cost, work);
    }

    /// Adds the layer of an observation.
    pub(super) fn observe(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: f64,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(), Halt> {
        self.check_memory(self.next_layer_bytes(), budget)?;
        let mapper = Arc::clone(&self.mapper);
        let model = mapper.model();
        if !self.sweep.is_ready() {
            self.sweep.make_ready(mapper.shared_ways_in().of(model, &self.body), model.graph().n_states());
        }
        let observed = ObservedDistances::new(model, observation, &self.weights, observation_weight);
        self.newest.clear();
        self.newest.extend_from_slice(observation);
        if !self.tree.layers.is_empty() {
            self.follow(observed, budget, interrupt)?;
        } else if self.tree.n_before > 0 {
            self.begin(&[(self.tree.root, self.root_cost)], Link::NONE, observed, budget)?;
        } else {
            let starts = Starts::of(model, self.starts.as_deref());
            let arrived = |state: &StateIdx| {
                let distance = observed.distance(model, *state);
                (*state, self.sweep.recurrence.arrive(MoveKind::Start, 0.0, distance))
            };
            let first: Vec<(StateIdx, f64)> = starts.states().iter().map(arrived).collect();
            self.tree.add(Layer::before_starts());
            self.begin(&first, Link::SKIP, observed, budget)?;
        }
        Ok(())
    }

    /// The next step, if all survivors share it.
    pub(super) fn shared(&mut self) -> Option<Decided> {
        let child = self.tree.only_child(self.model(), &self.sweep.ways_in)?;
        let decided = self.decided(child);
        self.go_on(&decided, child);
        Some(decided)
    }

    /// The first steps of the cheapest way to the newest observation.
    pub(super) fn decide(&mut self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Vec<Decided>, Halt> {
        let cheapest = self.sweep.cheapest();
        let path = cheapest.map(|survivor| self.tree.path(&self.sweep.ways_in, survivor)).unwrap_or_default();
        let mut steps = Vec::new();
        for place in path {
            let decided = self.decided(place);
            let (index, _) = place;
            if index > 0 {
                self.go_on(&decided, place);
                steps.push(decided);
                break;
            }
            self.pay(&decided);
            steps.push(decided);
        }
        self.restore(budget, interrupt)?;
        Ok(steps)
    }

    /// The cheapest way to the end.
    pub(super) fn rest(&self) -> Option<Rest> {
        let (schema, states) = (self.model().schema(), self.model().states());
        let end = (self.end_weight > 0.0)
            .then(|| EndDistances::new(schema, states, &self.newest, &self.weights, self.end_weight));
        let end_cost = |state| end.as_ref().map_or(0.0, |end| end.cost(states.row(state)));
        let survivor = self.sweep.cheapest_to_end(end_cost)?;
        let path = self.tree.path(&self.sweep.ways_in, survivor);
        Some(Rest {
            steps: path.into_iter().map(|place| self.decided(place)).collect(),
            end_cost: end_cost(survivor),
            end: PolicyEnd::at(self.model(), states.row(survivor), &self.newest, &self.weights),
            stopped_by: None,
            lower_bound: f64::INFINITY,
            work: Work::default(),
        })
    }

    /// How many nodes survivors hang on. Looks at every layer.
    pub(super) fn n_nodes(&self) -> usize {
        self.tree.n_alive()
    }

    /// How much was looked at besides the layers that are there.
    pub(super) fn work_before(&self) -> Work {
        let n_kept = self.tree.n_layers_of_observations() as u64;
        let layer = self.layer_work();
        Work {
            n_expanded: self.work.n_expanded - n_kept * layer.n_expanded,
            n_generated: self.work.n_generated - n_kept * layer.n_generated,
        }
    }

    /// How much a layer looks at.
    fn layer_work(&self) -> Work {
        let graph = self.model().graph();
        Work { n_expanded: graph.n_states() as u64, n_generated: graph.n_transitions() as u64 }
    }

    /// The step that leads to a node.
    fn decided(&self, place: NodePlace) -> Decided {
        let (step, action_cost) = self.tree.step(self.model(), &self.sweep.ways_in, place);
        let observed = &self.tree.layers[place.0].observed;
        Decided { step, action_cost, terms: observed.terms(self.model(), step.state).collect(), row: None }
    }

    /// Adds what a step costs to what the root does.
    fn pay(&mut self, decided: &Decided) {
        let distance = decided.terms.iter().fold(0.0, |sum, (_, term)| sum + term);
        let before = self.root_cost + decided.action_cost;
        self.root_cost = self.sweep.recurrence.arrive(decided.step.kind, before, distance);
    }

    /// Makes the node the root to which this step leads.
    fn go_on(&mut self, decided: &Decided, place: NodePlace) {
        self.pay(decided);
        self.tree.advance(place);
    }

    /// Finds the ways from the root anew.
    fn restore(&mut self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<(), Halt> {
        let mapper = Arc::clone(&self.mapper);
        let model = mapper.model();
        let root = self.tree.root;
        let mut observed = self.tree.clear().into_iter();
        if let Some(mut first) = observed.next() {
            first.fill_tables(model);
            self.tree.root = root;
            self.begin(&[(root, self.root_cost)], Link::NONE, first, budget)?;
        }
        for mut observed in observed {
            observed.fill_tables(model);
            self.follow(observed, budget, interrupt)?;
        }
        Ok(())
    }

    /// Begins with the layer of these states, which hang on by `link`, and to which the way costs so much.
    fn begin(
        &mut self,
        first: &[(StateIdx, f64)],
        link: Link,
        observed: ObservedDistances,
        budget: Budget,
    ) -> Result<(), Halt> {
        self.spend(budget)?;
        let Self { mapper, tree, sweep, .. } = self;
        let model = mapper.model();
        let nodes = tree.nodes(model.graph().n_states(), usize::MAX, &sweep.ways_in);
        let layer = sweep.begin(model, first.iter().copied(), link, &mut tree.reached, observed, nodes);
        tree.begin(layer, &sweep.ways_in);
        Ok(())
    }

    /// Adds the layer of the observation after the newest.
    fn follow(
        &mut self,
        observed: ObservedDistances,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(), Halt> {
        match interrupt.poll() {
            Signal::Continue => {}
            Signal::Finish => return Err(Halt::OutOf(StoppedBy::Deadline)),
            Signal::Cancel => return Err(Halt::Cancelled),
        }
        let n_states = self.model().graph().n_states();
        self.check_memory(self.tree.layer_bytes(n_states, &self.sweep.ways_in), budget)?;
        self.spend(budget)?;
        let Self { mapper, tree, sweep, .. } = self;
        let model = mapper.model();
        let nodes = tree.nodes(n_states, tree.reached.len(), &sweep.ways_in);
        let reached = std::mem::take(&mut tree.reached);
        let layer = sweep.follow(model, tree.newest(), &reached, observed, nodes);
        tree.reached = reached;
        tree.push(layer, &mut sweep.childless, &sweep.ways_in);
        Ok(())
    }

    /// Counts a layer that is about to be swept.
    fn spend(&mut self, budget: Budget) -> Result<(), Halt> {
        let layer = self.layer_work();
        if self.work.n_expanded.saturating_add(layer.n_expanded) > budget.max_expansions {
            return Err(Halt::OutOf(StoppedBy::MaxExpansions));
        }
        self.work += layer;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
