//! The ways to the survivors: layers from the root's to the newest, of which only what survivors hang on is alive.

use std::collections::VecDeque;

use super::layer::{Layer, Link, Nodes, Spare};
use super::ways_in::WaysIn;
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
    pub(super) fn layer_bytes(&self, n_states: usize, ways_in: &WaysIn) -> usize {
        let nodes = if self.spare.is_empty() { n_states * Nodes::bytes_each(ways_in.most) } else { 0 };
        size_of::<Layer>() + nodes
    }

    /// Nodes to be filled, of which those out of reach are absent.
    pub(super) fn nodes(&mut self, n_states: usize, n_reached: usize, ways_in: &WaysIn) -> Nodes {
        self.spare.pop().map_or_else(|| Nodes::absent(n_states, ways_in), |spare| spare.cleared(n_reached))
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

    fn recycle(&mut self, spare: Option<Spare>) {
        /// A layer comes, another goes; more are used where all are swept anew.
        const MAX_SPARE: usize = 2;
        if self.spare.len() < MAX_SPARE {
            self.spare.extend(spare);
        }
    }

    /// The source of a node; `None` of the root.
    pub(super) fn source(&self, ways_in: &WaysIn, (index, state): NodePlace) -> Option<NodePlace> {
        let link = self.layers[index].node(state).link;
        self.place_of(link, ways_in, (index, state))
    }

    /// Where a node comes from that hangs on by `link`.
    fn place_of(&self, link: Link, ways_in: &WaysIn, (index, state): NodePlace) -> Option<NodePlace> {
        if link == Link::NONE {
            None
        } else if link.is_within() {
            Some((index, link.from(ways_in, state)))
        } else if self.n_before == 0 && index == 1 {
            Some((0, self.root))
        } else {
            Some((index.checked_sub(1)?, link.from(ways_in, state)))
        }
    }

    /// Adds a layer, of whose nodes nothing is counted yet.
    pub(super) fn add(&mut self, layer: Layer) {
        self.layer_bytes += layer.size_bytes();
        self.layers.push_back(layer);
    }

    /// The newest layer.
    pub(super) fn newest(&mut self) -> &mut Layer {
        self.layers.back_mut().expect("the first observation's layer begins a tree")
    }

    /// Adds the first layer, whose nodes hang on each other or on what is before the starts.
    pub(super) fn begin(&mut self, layer: Layer, ways_in: &WaysIn) {
        self.add(layer);
        if self.layers.len() > 1 {
            for state in self.reached.iter().copied() {
                let source = self.source(ways_in, (1, state));
                if let Some((0, root)) = source {
                    self.layers[0].add_child(root);
                }
            }
        }
    }

    /// Adds a layer, whose nodes hang on those of the layer before or on each other. Of these, the `childless` are what nothing hangs on; with
    /// them dies what had no other child, and so on up, but not the root.
    pub(super) fn push(&mut self, layer: Layer, childless: &mut Vec<StateIdx>, ways_in: &WaysIn) {
        let newest = self.layers.len();
        self.add(layer);
        self.lighten(newest - 1, |layer| layer.observed.drop_tables());
        let mut earlier = Vec::new();
        for index in (0..newest).rev() {
            let mut pair = self.layers.range_mut(index.saturating_sub(1)..=index);
            let Some(layer) = pair.next_back() else { break };
            let mut before = pair.next();
            let is_first = self.n_before == 0 && index == 1;
            while let Some(state) = childless.pop() {
                if (index, state) == (0, self.root) {
                    continue;
                }
                let link = layer.kill(state);
                let from = if is_first && !link.is_within() { self.root } else { link.from(ways_in, state) };
                if link.is_within() {
                    if layer.remove_child(from) == 0 {
                        childless.push(from);
                    }
                } else if before.as_mut().is_some_and(|before| before.remove_child(from) == 0) {
                    earlier.push(from);
                }
            }
            let spare = self.lighten(index, Layer::thin);
            self.recycle(spare);
            if earlier.is_empty() {
                break;
            }
            std::mem::swap(childless, &mut earlier);
        }
    }

    /// Has the layer at `index` keep less.
    fn lighten<T>(&mut self, index: usize, lighten: impl FnOnce(&mut Layer) -> T) -> T {
        let layer = &mut self.layers[index];
        self.layer_bytes -= layer.size_bytes();
        let freed = lighten(layer);
        self.layer_bytes += layer.size_bytes();
        freed
    }

    /// The only child of the root, if the root has just one, and is not in the newest layer itself.
    pub(super) fn only_child(&self, model: &Model, ways_in: &WaysIn) -> Option<NodePlace> {
        let root = self.root;
        if self.layers.len() == 1 || self.layers[0].node(root).n_children != 1 {
            return None;
        }
        let is_child = |(index, state): NodePlace| {
            self.layers[index].node(state).is_alive() && self.source(ways_in, (index, state)) == Some((0, root))
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
            let root = self.root;
            self.layers[0].kill(root);
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
        self.layers[0].set_root(state);
    }

    /// The places of the way from the root, without it, to the state `survivor` of the newest layer.
    pub(super) fn path(&self, ways_in: &WaysIn, survivor: StateIdx) -> Vec<NodePlace> {
        let mut path = Vec::new();
        let mut place = (self.layers.len() - 1, survivor);
        while place != (0, self.root) {
            path.push(place);
            let Some(source) = self.source(ways_in, place) else { break };
            place = source;
        }
        path.reverse();
        path
    }

    /// The step that leads to a node, and what its action costs.
    pub(super) fn step(&self, model: &Model, ways_in: &WaysIn, place: NodePlace) -> (Move, f64) {
        let (index, state) = place;
        let link = self.layers[index].node(state).link;
        #[expect(clippy::cast_possible_truncation, reason = "observations are counted in u32")]
        let n_before = self.n_before + index as u32;
        let kind = if link.is_within() {
            MoveKind::Extra
        } else if n_before == 1 {
            MoveKind::Start
        } else if link == Link::SKIP {
            MoveKind::Skip
        } else {
            MoveKind::Match
        };
        let way = link.way().and_then(|_| cheapest_way(model, &ways_in.body, link.from(ways_in, state), state));
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
