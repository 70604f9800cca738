//! The cheapest ways to every state at one observation, made from those at the observation before.

use std::collections::BinaryHeap;

use rustc_hash::FxHashMap;

use crate::mapping::conditions::Body;
use crate::mapping::distances::ObservedDistances;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Conditions, MoveKind};
use crate::model::{Model, StateIdx};

/// Where a way comes from: a state of the layer before (by a skip if it is the same state, else by a match) or of the same
/// layer (by an extra). The action is the cheapest that leads from there, the first among equals. The highest bit tells
/// which: memory ends before there are 2^31 states.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Source(u32);

impl Source {
    const WITHIN: u32 = 1 << 31;
    /// Of the root, and of states that no way leads to.
    pub(super) const NONE: Self = Self(u32::MAX);

    pub(super) fn before(state: StateIdx) -> Self {
        Self(state)
    }

    pub(super) fn within(state: StateIdx) -> Self {
        Self(state | Self::WITHIN)
    }

    pub(super) fn is_within(self) -> bool {
        self.0 & Self::WITHIN != 0
    }

    pub(super) fn state(self) -> StateIdx {
        self.0 & !Self::WITHIN
    }
}

/// A state at an observation, as part of a way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) source: Source,
    /// How many nodes with a survivor have it as their source; [`Self::DEAD`] if no survivor hangs on it.
    pub(super) n_children: u32,
}

impl Node {
    pub(super) const DEAD: u32 = u32::MAX;
    const ABSENT: Self = Self { source: Source::NONE, n_children: Self::DEAD };

    pub(super) fn is_alive(self) -> bool {
        self.n_children != Self::DEAD
    }
}

/// How much memory a state takes in a layer that is whole, in bytes.
pub(super) const NODE_BYTES: usize = size_of::<f64>() + size_of::<Node>();

/// The cheapest ways to every state at one observation.
#[derive(Debug)]
pub(super) struct Layer {
    /// Of the states to the observation.
    pub(super) observed: ObservedDistances,
    /// Costs of the ways; infinite where there is none. Shape `[n_states]`; empty once they were forgotten.
    pub(super) costs: Vec<f64>,
    nodes: LayerNodes,
    n_alive: usize,
    /// How many states there may be a way to, if nothing was written of others; else 0.
    n_reached: usize,
}

#[derive(Debug)]
enum LayerNodes {
    /// Shape `[n_states]`.
    Dense(Vec<Node>),
    /// Those that are alive.
    Sparse(FxHashMap<StateIdx, Node>),
}

/// Arrays that a layer has no more use for, kept to be filled again.
#[derive(Debug, Default)]
pub(super) struct Spare {
    pub(super) costs: Vec<f64>,
    pub(super) nodes: Vec<Node>,
    /// How many states were written of, since all was cleared.
    pub(super) n_reached: usize,
}

impl Spare {
    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.costs.capacity() * size_of::<f64>() + self.nodes.capacity() * size_of::<Node>()
    }

    /// Arrays that say of states out of reach that no way leads there. As what is within reach only ever shrinks, those
    /// written of as many states as now are have nothing to be cleared.
    fn cleared(mut self, n_states: usize, n_reached: usize) -> Self {
        if self.costs.len() != n_states || self.nodes.len() != n_states || self.n_reached != n_reached {
            self.costs.clear();
            self.costs.resize(n_states, f64::INFINITY);
            self.nodes.clear();
            self.nodes.resize(n_states, Node::ABSENT);
        }
        self
    }
}

impl Layer {
    /// How many nodes survivors hang on.
    pub(super) fn n_alive(&self) -> usize {
        self.n_alive
    }

    pub(super) fn node(&self, state: StateIdx) -> Node {
        match &self.nodes {
            LayerNodes::Dense(nodes) => nodes[state as usize],
            LayerNodes::Sparse(nodes) => nodes.get(&state).copied().unwrap_or(Node::ABSENT),
        }
    }

    /// The node of a state that there is one of.
    fn node_mut(&mut self, state: StateIdx) -> &mut Node {
        match &mut self.nodes {
            LayerNodes::Dense(nodes) => &mut nodes[state as usize],
            LayerNodes::Sparse(nodes) => nodes.get_mut(&state).expect("what a survivor hangs on is kept"),
        }
    }

    pub(super) fn set_source(&mut self, state: StateIdx, source: Source) {
        self.node_mut(state).source = source;
    }

    /// Counts a child of `state`. Says whether that brought it to life.
    pub(super) fn add_child(&mut self, state: StateIdx) -> bool {
        let node = self.node_mut(state);
        let was_dead = !node.is_alive();
        node.n_children = if was_dead { 1 } else { node.n_children + 1 };
        self.n_alive += usize::from(was_dead);
        was_dead
    }

    /// Takes off a child of `state`, and gives how many are left.
    pub(super) fn remove_child(&mut self, state: StateIdx) -> u32 {
        let node = self.node_mut(state);
        node.n_children -= 1;
        node.n_children
    }

    /// Lets a node die.
    pub(super) fn kill(&mut self, state: StateIdx) {
        self.n_alive -= 1;
        match &mut self.nodes {
            LayerNodes::Dense(nodes) => nodes[state as usize].n_children = Node::DEAD,
            LayerNodes::Sparse(nodes) => drop(nodes.remove(&state)),
        }
    }

    /// Lets every node die.
    pub(super) fn kill_all(&mut self) {
        self.n_alive = 0;
        match &mut self.nodes {
            LayerNodes::Dense(nodes) => nodes.iter_mut().for_each(|node| node.n_children = Node::DEAD),
            LayerNodes::Sparse(nodes) => nodes.clear(),
        }
    }

    /// Lets every node that has a way live: the newest layer's are the survivors. There are none but at `reached`.
    pub(super) fn revive_all(&mut self, reached: &[StateIdx]) {
        let LayerNodes::Dense(nodes) = &mut self.nodes else { return };
        self.n_alive = 0;
        for state in reached.iter().map(|state| *state as usize) {
            let is_reached = self.costs[state].is_finite();
            nodes[state].n_children = if is_reached { 0 } else { Node::DEAD };
            self.n_alive += usize::from(is_reached);
        }
    }

    /// What stands before the first observation's layer while the start is not decided: a node 0 from which all starts come, for nothing.
    pub(super) fn before_starts(n_states: usize) -> Self {
        let (mut costs, mut nodes) = (vec![f64::INFINITY; n_states], vec![Node::ABSENT; n_states]);
        costs[0] = 0.0;
        nodes[0].n_children = 0;
        let nodes = LayerNodes::Dense(nodes);
        Self { observed: ObservedDistances::default(), costs, nodes, n_alive: 1, n_reached: 0 }
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        /// Of a hash table, with the free ones beside it.
        const ENTRY_BYTES: usize = 16;
        let n_node_bytes = match &self.nodes {
            LayerNodes::Dense(nodes) => nodes.len() * size_of::<Node>(),
            LayerNodes::Sparse(nodes) => nodes.capacity() * ENTRY_BYTES,
        };
        size_of::<Self>() + n_node_bytes + self.costs.len() * size_of::<f64>() + self.observed.size_bytes()
    }

    /// Forgets the costs and the tables of distances, and where few survivors hang on it, all nodes but theirs. Gives what can
    /// be filled again.
    pub(super) fn forget(&mut self) -> Spare {
        self.observed.drop_tables();
        let nodes = self.thin().unwrap_or_default();
        Spare { costs: std::mem::take(&mut self.costs), nodes, n_reached: self.n_reached }
    }

    /// Keeps only nodes that are alive, if that takes less memory. Gives the array that is free then.
    pub(super) fn thin(&mut self) -> Option<Vec<Node>> {
        /// A hash table's entry is taken for this many of an array's.
        const ENTRY: usize = 16;
        let LayerNodes::Dense(nodes) = &self.nodes else { return None };
        if self.n_alive * ENTRY > nodes.len() {
            return None;
        }
        let alive = (0..).zip(nodes.iter().copied()).filter(|(_, node)| node.is_alive()).collect();
        match std::mem::replace(&mut self.nodes, LayerNodes::Sparse(alive)) {
            LayerNodes::Dense(nodes) => Some(nodes),
            LayerNodes::Sparse(_) => None,
        }
    }

    /// What can be filled again.
    pub(super) fn into_spare(self) -> (Spare, ObservedDistances) {
        let nodes = match self.nodes {
            LayerNodes::Dense(nodes) => nodes,
            LayerNodes::Sparse(_) => Vec::new(),
        };
        (Spare { costs: self.costs, nodes, n_reached: self.n_reached }, self.observed)
    }

    /// The state with the cheapest way, the lowest among equals. `None` if no state has one.
    pub(super) fn cheapest(&self) -> Option<StateIdx> {
        self.cheapest_to_end(|_| 0.0)
    }

    /// The state with the cheapest way where to end in a state costs `end`, the lowest among equals. `None` if no state has one.
    pub(super) fn cheapest_to_end(&self, end: impl Fn(StateIdx) -> f64) -> Option<StateIdx> {
        let reached = (0..).zip(&self.costs).filter(|(_, cost)| cost.is_finite());
        let costs = reached.map(|(state, cost)| (state, cost + end(state)));
        costs.min_by(|(_, cost), (_, other)| cost.total_cmp(other)).map(|(state, _)| state)
    }
}

/// Makes layers.
#[derive(Debug)]
pub(super) struct Sweep {
    pub(super) body: Body,
    pub(super) recurrence: Recurrence,
    /// Distances to the observation in hand. Shape `[n_states]`.
    distances: Vec<f64>,
    pub(super) open: BinaryHeap<CheapestFirst>,
}

impl Sweep {
    pub(super) fn new(model: &Model, conditions: &Conditions) -> Self {
        let (body, recurrence) = (conditions.body(model), conditions.recurrence());
        Self { body, recurrence, distances: vec![0.0; model.graph().n_states()], open: BinaryHeap::new() }
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.distances.len() * size_of::<f64>() + self.open.capacity() * size_of::<CheapestFirst>()
    }

    /// The layer of these states, each with what it costs and where its way comes from: extras lead on from there (Dijkstra's algorithm).
    /// They lead to none but `reached`.
    pub(super) fn begin(
        &mut self,
        model: &Model,
        first: impl IntoIterator<Item = (StateIdx, f64, Source)>,
        reached: &[StateIdx],
        observed: ObservedDistances,
        spare: Spare,
    ) -> Layer {
        for state in reached {
            self.distances[*state as usize] = observed.distance(model, *state);
        }
        let Spare { mut costs, mut nodes, .. } = spare.cleared(model.graph().n_states(), usize::MAX);
        for (state, cost, source) in first {
            costs[state as usize] = cost;
            nodes[state as usize].source = source;
            self.open.push(CheapestFirst { cost, id: state });
        }
        while let Some(CheapestFirst { cost, id: state }) = self.open.pop() {
            if cost <= costs[state as usize] {
                self.extras(model, state, &mut costs, &mut nodes, |_, _| true);
            }
        }
        let mut layer =
            Layer { observed, costs, nodes: LayerNodes::Dense(nodes), n_alive: 0, n_reached: reached.len() };
        layer.revive_all(reached);
        layer
    }

    /// The layer after one with the costs `before`: skips and matches from there, and extras wherever they lead to a state
    /// more cheaply. There are no ways but to `reached`.
    ///
    /// If an extra pays the whole distance, one from a state is worth a look only where the state costs less than it did in the layer before:
    /// from there, the same action would have matched.
    pub(super) fn follow(
        &mut self,
        model: &Model,
        before: &[f64],
        reached: &[StateIdx],
        observed: ObservedDistances,
        spare: Spare,
    ) -> Layer {
        let (space, recurrence) = (model.whole(), self.recurrence);
        let Spare { mut costs, mut nodes, .. } = spare.cleared(before.len(), reached.len());
        for state in reached {
            costs[*state as usize] = before[*state as usize];
            nodes[*state as usize] = Node { source: Source::before(*state), n_children: 0 };
        }
        for state in reached {
            let from = before[*state as usize];
            for (transition, action_cost) in self.body.ways(&space, *state) {
                let cost = from + action_cost;
                let to = transition.to as usize;
                if cost < costs[to] {
                    costs[to] = cost;
                    nodes[to].source = Source::before(*state);
                }
            }
        }
        for state in reached {
            let at = *state as usize;
            self.distances[at] = observed.distance(model, *state);
            costs[at] = recurrence.arrive(MoveKind::Match, costs[at], self.distances[at]);
        }
        let is_lower = |state: StateIdx, cost: f64| !recurrence.pays_alike() || cost < before[state as usize];
        for state in reached {
            let cost = costs[*state as usize];
            if is_lower(*state, cost) {
                self.open.push(CheapestFirst { cost, id: *state });
            }
        }
        while let Some(CheapestFirst { cost, id: state }) = self.open.pop() {
            if cost <= costs[state as usize] {
                self.extras(model, state, &mut costs, &mut nodes, is_lower);
            }
        }
        let n_alive = reached.len();
        Layer { observed, costs, nodes: LayerNodes::Dense(nodes), n_alive, n_reached: n_alive }
    }

    /// Takes extras from `state`; what they improve is looked at later if `leads_on`.
    fn extras(
        &mut self,
        model: &Model,
        state: StateIdx,
        costs: &mut [f64],
        nodes: &mut [Node],
        leads_on: impl Fn(StateIdx, f64) -> bool,
    ) {
        let from = costs[state as usize];
        let space = model.whole();
        for (transition, action_cost) in self.body.ways(&space, state) {
            let to = transition.to as usize;
            let cost = from + action_cost;
            // A distance is never negative.
            if cost >= costs[to] {
                continue;
            }
            let cost = self.recurrence.arrive(MoveKind::Extra, cost, self.distances[to]);
            if cost < costs[to] {
                costs[to] = cost;
                nodes[to].source = Source::within(state);
                if leads_on(transition.to, cost) {
                    self.open.push(CheapestFirst { cost, id: transition.to });
                }
            }
        }
    }
}
