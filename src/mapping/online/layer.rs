//! The cheapest ways to every state at one observation, made from those at the observation before.

use std::collections::BinaryHeap;

use super::tree::{NO_ACTION, NO_NODE, NodeId, Tree, TreeNode};
use crate::mapping::distances::ObservedDistances;
use crate::mapping::open_list::CheapestFirst;
use crate::model::{ActionIdx, Graph, Model, StateIdx};

/// The cheapest ways to every state at one observation.
#[derive(Debug)]
pub(super) struct Layer {
    /// Cost of the way; infinite where there is none. Shape `[n_states]`.
    pub(super) costs: Vec<f64>,
    /// The tree's node of the state, [`NO_NODE`] until it has grown. Shape `[n_states]`.
    pub(super) nodes: Vec<NodeId>,
    /// How the way comes to the state. Shape `[n_states]`.
    origins: Vec<Origin>,
    /// Distances of the states to the observation. Shape `[n_states]`.
    distances: Vec<f64>,
    open: BinaryHeap<CheapestFirst>,
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
    pub(super) fn new(n_states: usize) -> Self {
        Self {
            costs: vec![f64::INFINITY; n_states],
            nodes: vec![NO_NODE; n_states],
            origins: vec![Origin::Before(NO_NODE, NO_ACTION); n_states],
            distances: vec![0.0; n_states],
            open: BinaryHeap::new(),
        }
    }

    pub(super) fn clear(&mut self) {
        self.costs.fill(f64::INFINITY);
        self.nodes.fill(NO_NODE);
    }

    /// The state with the cheapest way, the lowest among equals. `None` if no state has one.
    pub(super) fn cheapest(&self) -> Option<usize> {
        let reached = self.costs.iter().enumerate().filter(|(_, cost)| cost.is_finite());
        reached.min_by(|(_, cost), (_, other)| cost.total_cmp(other)).map(|(state, _)| state)
    }

    /// Skips and matches from the layer `before`; distances are added by [`Self::spread`].
    pub(super) fn follow(&mut self, before: &Self, model: &Model) {
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
    pub(super) fn spread(&mut self, model: &Model, observed: &ObservedDistances) {
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
        while let Some(CheapestFirst { cost, id: state }) = self.open.pop() {
            if cost <= self.costs[state as usize] {
                self.extras(model, graph, state, cost);
            }
        }
    }

    fn extras(&mut self, model: &Model, graph: &Graph, state: StateIdx, cost: f64) {
        for transition in graph.successors(state) {
            let cost = cost + model.action(transition.action).cost + self.distances[transition.to as usize];
            if self.offer(transition.to, cost, Origin::Within(state, transition.action)) {
                self.open.push(CheapestFirst { cost, id: transition.to });
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
    pub(super) fn grow(&mut self, tree: &mut Tree, observation: u32) {
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
