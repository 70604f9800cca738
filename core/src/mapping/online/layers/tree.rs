//! The ways to the survivors: layers from the root's to the newest, of which only what survivors hang on is alive.

use std::collections::VecDeque;

use super::layer::{Layer, NODE_BYTES, Source, Spare};
use crate::mapping::conditions::Body;
use crate::mapping::distances::ObservedDistances;
use crate::mapping::{Move, MoveKind};
use crate::model::{ActionIdx, Model, StateIdx};

/// A node's place: the index of its layer in the tree, and its state.
pub(super) type NodePlace = (usize, StateIdx);

/// Layers from the root's to the newest.
#[derive(Debug)]
pub(super) struct Tree {
    pub(super) layers: VecDeque<Layer>,
    /// How many layers there were before the first one. The layer of the observation i has i + 1 before it: the one
    /// [before the starts](Layer::before_starts), and those of earlier observations.
    pub(super) n_before: u32,
    /// The last committed node's state; it is in the first layer. Before the starts, 0.
    pub(super) root: StateIdx,
    /// The states that a way may lead to, ascending; they only ever become fewer.
    pub(super) reached: Vec<StateIdx>,
    spare: Vec<Spare>,
    /// Of all layers.
    layer_bytes: usize,
}

impl Tree {
    pub(super) fn new(n_states: StateIdx) -> Self {
        let reached = (0..n_states).collect();
        Self { layers: VecDeque::new(), n_before: 0, root: 0, reached, spare: Vec::new(), layer_bytes: 0 }
    }

    /// Approximate size in memory, in bytes. Looks at no layer.
    pub(super) fn size_bytes(&self) -> usize {
        let spare: usize = self.spare.iter().map(Spare::size_bytes).sum();
        self.layer_bytes + spare + self.reached.capacity() * size_of::<StateIdx>()
    }

    /// How many layers there are of observations.
    pub(super) fn n_layers_of_observations(&self) -> usize {
        let is_before_starts = self.n_before == 0;
        self.layers.len().saturating_sub(usize::from(is_before_starts))
    }

    /// How many nodes survivors hang on. Looks at every layer.
    pub(super) fn n_alive(&self) -> usize {
        self.layers.iter().map(Layer::n_alive).sum()
    }

    /// Whether the running total is right.
    #[cfg(test)]
    pub(super) fn knows_its_size(&self) -> bool {
        self.layer_bytes == self.layers.iter().map(Layer::size_bytes).sum::<usize>()
    }

    /// How much memory a layer takes that is made now, in bytes, besides its distances.
    pub(super) fn layer_bytes(&self, n_states: usize) -> usize {
        let has_spare = self.spare.last().is_some_and(|spare| spare.size_bytes() >= n_states * NODE_BYTES);
        size_of::<Layer>() + if has_spare { 0 } else { n_states * NODE_BYTES }
    }

    /// Arrays to be filled.
    pub(super) fn spare(&mut self) -> Spare {
        self.spare.pop().unwrap_or_default()
    }

    /// Drops all layers, and gives the distances to their observations.
    pub(super) fn clear(&mut self) -> Vec<ObservedDistances> {
        self.layer_bytes = 0;
        let layers = std::mem::take(&mut self.layers);
        let observed = layers.into_iter().map(|layer| {
            let (spare, observed) = layer.into_spare();
            self.recycle(spare);
            observed
        });
        observed.collect()
    }

    fn recycle(&mut self, spare: Spare) {
        /// A layer comes, another goes; more are used where all are swept anew.
        const MAX_SPARE: usize = 2;
        if self.spare.len() < MAX_SPARE {
            self.spare.push(spare);
        }
    }

    /// The source of a node; `None` of the root.
    pub(super) fn source(&self, place: NodePlace) -> Option<NodePlace> {
        let (index, state) = place;
        let source = self.layers[index].node(state).source;
        if source == Source::NONE {
            None
        } else if source.is_within() {
            Some((index, source.state()))
        } else {
            Some((index.checked_sub(1)?, source.state()))
        }
    }

    /// Adds a layer, of whose nodes nothing is counted yet.
    pub(super) fn add(&mut self, layer: Layer) {
        self.layer_bytes += layer.size_bytes();
        self.layers.push_back(layer);
    }

    /// Has the layer at `index` keep less.
    fn lighten<T>(&mut self, index: usize, lighten: impl FnOnce(&mut Layer) -> T) -> T {
        let layer = &mut self.layers[index];
        self.layer_bytes -= layer.size_bytes();
        let freed = lighten(layer);
        self.layer_bytes += layer.size_bytes();
        freed
    }

    /// Adds a layer, whose nodes hang on those of the layer before or on each other.
    pub(super) fn push(&mut self, layer: Layer) {
        self.add(layer);
        let newest = self.layers.len() - 1;
        let reached = std::mem::take(&mut self.reached);
        for state in reached.iter().copied() {
            self.attach((newest, state));
        }
        if newest > 0 {
            for state in reached.iter().copied() {
                if self.layers[newest - 1].node(state).n_children == 0 {
                    self.cut((newest - 1, state), newest - 1);
                }
            }
            let spare = self.lighten(newest - 1, Layer::forget);
            self.recycle(spare);
        }
        self.reached = reached;
    }

    /// States that no way leads to any more are out of reach for good.
    pub(super) fn shrink(&mut self) {
        if let Some(newest) = self.layers.back() {
            self.reached.retain(|state| newest.costs[*state as usize].is_finite());
        }
    }

    /// Counts a node as a child of its source, and so on up if that brings the source to life.
    fn attach(&mut self, mut place: NodePlace) {
        while let Some((index, state)) = self.source(place) {
            if !self.layers[index].add_child(state) {
                return;
            }
            place = (index, state);
        }
    }

    /// Lets a childless node die, and so on up, but not the root. The layer at `held` is not thinned.
    fn cut(&mut self, mut place: NodePlace, held: usize) {
        while place != (0, self.root) {
            let source = self.source(place);
            let (index, state) = place;
            self.layers[index].kill(state);
            if index != held {
                // It is left to the allocator: there is one for the next layer already.
                drop(self.lighten(index, Layer::thin));
            }
            let Some(source) = source else { return };
            if self.layers[source.0].remove_child(source.1) > 0 {
                return;
            }
            place = source;
        }
    }

    /// Finds anew what is alive.
    pub(super) fn recount(&mut self) {
        let newest = self.layers.len() - 1;
        for layer in self.layers.range_mut(..newest) {
            layer.kill_all();
        }
        let reached = std::mem::take(&mut self.reached);
        self.layers[newest].revive_all(&reached);
        for state in reached.iter().copied() {
            if self.layers[newest].node(state).is_alive() {
                self.attach((newest, state));
            }
        }
        self.reached = reached;
    }

    /// The only child of the root, if the root has just one, and is not in the newest layer itself.
    pub(super) fn only_child(&self, model: &Model) -> Option<NodePlace> {
        let root = self.root;
        if self.layers.len() == 1 || self.layers[0].node(root).n_children != 1 {
            return None;
        }
        let is_child = |(index, state): NodePlace| {
            self.layers[index].node(state).is_alive() && self.source((index, state)) == Some((0, root))
        };
        if self.n_before == 0 {
            return self.reached.iter().map(|state| (1, *state)).find(|at| is_child(*at));
        }
        let successors = model.graph().successors(root).iter().map(|transition| transition.to);
        std::iter::once((1, root)).chain(successors.flat_map(|state| [(1, state), (0, state)])).find(|at| is_child(*at))
    }

    /// Makes a node the root. Layers before its own go.
    pub(super) fn advance(&mut self, (index, state): NodePlace) {
        if index == 0 {
            self.layers[0].kill(self.root);
        }
        for _ in 0..index {
            if let Some(layer) = self.layers.pop_front() {
                self.layer_bytes -= layer.size_bytes();
                let (spare, _) = layer.into_spare();
                self.recycle(spare);
                self.n_before += 1;
            }
        }
        self.root = state;
        self.layers[0].set_source(state, Source::NONE);
    }

    /// The places of the way from the root, without it, to the state `survivor` of the newest layer.
    pub(super) fn path(&self, survivor: StateIdx) -> Vec<NodePlace> {
        let mut path = Vec::new();
        let mut place = (self.layers.len() - 1, survivor);
        while place != (0, self.root) {
            path.push(place);
            let Some(source) = self.source(place) else { break };
            place = source;
        }
        path.reverse();
        path
    }

    /// The step that leads to a node, and what its action costs.
    pub(super) fn step(&self, model: &Model, body: &Body, place: NodePlace) -> (Move, f64) {
        let (index, state) = place;
        let source = self.layers[index].node(state).source;
        #[expect(clippy::cast_possible_truncation, reason = "observations are counted in u32")]
        let n_before = self.n_before + index as u32;
        let kind = if source.is_within() {
            MoveKind::Extra
        } else if n_before == 1 {
            MoveKind::Start
        } else if source.state() == state {
            MoveKind::Skip
        } else {
            MoveKind::Match
        };
        let acts = matches!(kind, MoveKind::Extra | MoveKind::Match);
        let way = acts.then(|| cheapest_way(model, body, source.state(), state)).flatten();
        let step = Move { kind, action: way.map(|(action, _)| action), observation: n_before - 1, state };
        (step, way.map_or(0.0, |(_, cost)| cost))
    }
}

/// The cheapest action from one state to another, the first among equals, and what it costs.
fn cheapest_way(model: &Model, body: &Body, from: StateIdx, to: StateIdx) -> Option<(ActionIdx, f64)> {
    let space = model.whole();
    let ways = body.ways(&space, from).filter(|(transition, _)| transition.to == to);
    let ways = ways.map(|(transition, cost)| (transition.action, cost));
    ways.min_by(|(_, cost), (_, other)| cost.total_cmp(other))
}
