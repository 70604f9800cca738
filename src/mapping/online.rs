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

use std::cmp::Ordering;
use std::collections::{BinaryHeap, VecDeque};
use std::num::NonZeroU32;
use std::sync::Arc;

use super::cost::Cost;
use super::distances::ObservedDistances;
use super::policy::{Step, StepWriter};
use super::problem::choose_start;
use super::{Mapper, Mapping, Move, MoveKind, Status};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::{ActionIdx, StateIdx};

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
    #[must_use]
    pub fn new(mapper: Arc<Mapper>, weights: Weights, start: Option<StateIdx>, lookahead: Option<NonZeroU32>) -> Self {
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
        let mapping = Mapping { moves: self.moves, cost: self.cost, status, lower_bound, n_expanded, n_generated };
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
        let written = writer.write(model, &step, terms);
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

type NodeId = u32;

const NO_NODE: NodeId = NodeId::MAX;

/// Stands for "no action".
const NO_ACTION: ActionIdx = ActionIdx::MAX;

/// The cheapest ways to every state at one observation.
#[derive(Debug)]
struct Layer {
    /// Cost of the way; infinite where there is none. Shape `[n_states]`.
    costs: Vec<f64>,
    /// The tree's node of the state, [`NO_NODE`] until it has grown. Shape `[n_states]`.
    nodes: Vec<NodeId>,
    /// How the way comes to the state. Shape `[n_states]`.
    origins: Vec<Origin>,
    /// Distances of the states to the observation. Shape `[n_states]`.
    distances: Vec<f64>,
    open: BinaryHeap<Open>,
}

/// How a way comes to a state.
#[derive(Clone, Copy, Debug)]
enum Origin {
    /// From this node of the layer before.
    Before(NodeId, ActionIdx),
    /// From this state of the same layer.
    Within(StateIdx, ActionIdx),
}

impl Layer {
    fn new(n_states: usize) -> Self {
        Self {
            costs: vec![f64::INFINITY; n_states],
            nodes: vec![NO_NODE; n_states],
            origins: vec![Origin::Before(NO_NODE, NO_ACTION); n_states],
            distances: vec![0.0; n_states],
            open: BinaryHeap::new(),
        }
    }

    fn clear(&mut self) {
        self.costs.fill(f64::INFINITY);
        self.nodes.fill(NO_NODE);
    }

    /// The state with the cheapest way, the lowest among equals. `None` if no state has one.
    fn cheapest(&self) -> Option<usize> {
        let reached = self.costs.iter().enumerate().filter(|(_, cost)| cost.is_finite());
        reached.min_by(|(_, cost), (_, other)| cost.total_cmp(other)).map(|(state, _)| state)
    }

    /// Skips and matches from the layer `before`; distances are added by [`Self::spread`].
    fn follow(&mut self, before: &Self, model: &crate::model::Model) {
        let graph = model.graph();
        for (state, cost) in (0..).zip(before.costs.iter().copied()).filter(|(_, cost)| cost.is_finite()) {
            let node = before.nodes[state as usize];
            self.offer(state, cost, Origin::Before(node, NO_ACTION));
            for transition in graph.successors(state) {
                let cost = cost + model.action(transition.action).cost;
                self.offer(transition.to, cost, Origin::Before(node, transition.action));
            }
        }
    }

    /// Adds the distances to the observation, where a way comes from the layer before, and then takes extra actions
    /// wherever they lead to a state more cheaply (Dijkstra's algorithm from all states at once).
    fn spread(&mut self, model: &crate::model::Model, observed: &ObservedDistances) {
        let (states, graph) = (model.states(), model.graph());
        for (state, distance) in (0..).zip(&mut self.distances) {
            *distance = observed.distance(states, state);
        }
        for ((cost, node), distance) in self.costs.iter_mut().zip(&self.nodes).zip(&self.distances) {
            // The root has paid already.
            if *node == NO_NODE {
                *cost += distance;
            }
        }
        for state in 0..states.len() {
            let cost = self.costs[state as usize];
            if cost.is_finite() {
                self.extras(model, graph, state, cost);
            }
        }
        while let Some(Open { cost, state }) = self.open.pop() {
            if cost <= self.costs[state as usize] {
                self.extras(model, graph, state, cost);
            }
        }
    }

    fn extras(&mut self, model: &crate::model::Model, graph: &crate::model::Graph, state: StateIdx, cost: f64) {
        for transition in graph.successors(state) {
            let cost = cost + model.action(transition.action).cost + self.distances[transition.to as usize];
            if self.offer(transition.to, cost, Origin::Within(state, transition.action)) {
                self.open.push(Open { cost, state: transition.to });
            }
        }
    }

    /// Takes a way if it is cheaper.
    fn offer(&mut self, state: StateIdx, cost: f64, origin: Origin) -> bool {
        let state = state as usize;
        let is_cheaper = cost < self.costs[state];
        if is_cheaper {
            self.costs[state] = cost;
            self.origins[state] = origin;
        }
        is_cheaper
    }

    /// Adds the states' nodes to the tree.
    fn grow(&mut self, tree: &mut Tree, observation: u32) {
        let mut waiting = Vec::new();
        for state in 0..self.costs.len() {
            if self.costs[state].is_infinite() || self.nodes[state] != NO_NODE {
                continue;
            }
            waiting.push(state);
            // Origins within the layer come first. Each is strictly cheaper than what comes from it, or was there
            // before it, so this ends.
            while let Some(state) = waiting.last().copied() {
                let (parent, action) = match self.origins[state] {
                    Origin::Before(parent, action) => (parent, action),
                    Origin::Within(from, action) => (self.nodes[from as usize], action),
                };
                if parent == NO_NODE
                    && let Origin::Within(from, _) = self.origins[state]
                {
                    waiting.push(from as usize);
                    continue;
                }
                #[expect(clippy::cast_possible_truncation, reason = "states are counted in u32")]
                let node = TreeNode { parent, action, state: state as StateIdx, observation, ..TreeNode::default() };
                self.nodes[state] = tree.add(node);
                waiting.pop();
            }
        }
    }
}

/// An entry of the open list; the greatest is the cheapest.
#[derive(Clone, Copy, Debug)]
struct Open {
    cost: f64,
    state: StateIdx,
}

impl Ord for Open {
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then_with(|| other.state.cmp(&self.state))
    }
}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Open {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Open {}

/// The ways to the survivors, from the root on.
#[derive(Debug, Default)]
struct Tree {
    nodes: Vec<TreeNode>,
    free: Vec<NodeId>,
}

#[derive(Clone, Copy, Debug, Default)]
struct TreeNode {
    parent: NodeId,
    state: StateIdx,
    observation: u32,
    n_children: u32,
    /// All children's ids, combined by exclusive or: of a node with one child, that child.
    children: NodeId,
    action: ActionIdx,
}

impl Tree {
    fn n_alive(&self) -> usize {
        self.nodes.len() - self.free.len()
    }

    fn get(&self, id: NodeId) -> &TreeNode {
        &self.nodes[id as usize]
    }

    fn get_mut(&mut self, id: NodeId) -> &mut TreeNode {
        &mut self.nodes[id as usize]
    }

    fn clear(&mut self) {
        self.nodes.clear();
        self.free.clear();
    }

    /// Adds a root.
    fn plant(&mut self, observation: u32, state: StateIdx) -> NodeId {
        self.place(TreeNode { parent: NO_NODE, action: NO_ACTION, state, observation, ..TreeNode::default() })
    }

    /// Adds a node below its parent.
    fn add(&mut self, node: TreeNode) -> NodeId {
        let id = self.place(node);
        let parent = self.get_mut(node.parent);
        parent.n_children += 1;
        parent.children ^= id;
        id
    }

    fn place(&mut self, node: TreeNode) -> NodeId {
        if let Some(id) = self.free.pop() {
            *self.get_mut(id) = node;
            return id;
        }
        self.nodes.push(node);
        NodeId::try_from(self.nodes.len() - 1).expect("memory ends before ids do")
    }

    /// The only child of a node that has just one.
    fn only_child(&self, id: NodeId) -> Option<NodeId> {
        let node = self.get(id);
        (node.n_children == 1).then_some(node.children)
    }

    /// Removes a node that nothing hangs on, and so on up, but not the root.
    fn cut_if_childless(&mut self, mut id: NodeId, root: NodeId) {
        while id != root && self.get(id).n_children == 0 {
            let parent_id = self.get(id).parent;
            let parent = self.get_mut(parent_id);
            parent.n_children -= 1;
            parent.children ^= id;
            self.release(id);
            id = parent_id;
        }
    }

    fn release(&mut self, id: NodeId) {
        // Not childless, so that it is not released twice.
        self.get_mut(id).n_children = u32::MAX;
        self.free.push(id);
    }

    /// Removes the parent of `id`, which becomes a root.
    fn cut_above(&mut self, id: NodeId) {
        let parent = std::mem::replace(&mut self.get_mut(id).parent, NO_NODE);
        self.release(parent);
    }

    /// The step that leads from its parent to `id`.
    fn step(&self, id: NodeId) -> Move {
        let node = self.get(id);
        let advances = self.get(node.parent).observation < node.observation;
        let (kind, action) = match (node.action, advances) {
            (NO_ACTION, _) => (MoveKind::Skip, None),
            (action, true) => (MoveKind::Match, Some(action)),
            (action, false) => (MoveKind::Extra, Some(action)),
        };
        Move { kind, action, observation: node.observation, state: node.state }
    }

    /// The steps from `root` to `id`.
    fn path(&self, root: NodeId, mut id: NodeId) -> Vec<Move> {
        let mut steps = Vec::new();
        while id != root {
            steps.push(self.step(id));
            id = self.get(id).parent;
        }
        steps.reverse();
        steps
    }
}
