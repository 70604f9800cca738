//! How a layer is made from the one before.

use std::collections::BinaryHeap;
use std::sync::Arc;

use super::layer::{Layer, Link, Node, Nodes, Number, Packed};
use super::ways_in::WaysIn;
use crate::mapping::distances::ObservedDistances;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Conditions, MoveKind};
use crate::model::{Model, StateIdx};

/// Makes layers, each from the one that it made before.
#[derive(Debug)]
pub(super) struct Sweep {
    pub(super) ways_in: Arc<WaysIn>,
    pub(super) recurrence: Recurrence,
    /// The costs of the cheapest ways to every state in the newest layer; infinite where there is none. Shape `[n_states]`.
    pub(super) costs: Vec<f64>,
    /// Those in the layer before.
    before: Vec<f64>,
    /// Distances to the observation in hand. Shape `[n_states]`.
    distances: Vec<f64>,
    /// Where the nodes of the newest layer come from: the state, and whether it is [within](WITHIN) the same layer. Shape `[n_states]`.
    sources: Vec<u32>,
    open: BinaryHeap<CheapestFirst>,
    /// The states to which extras led in the newest layer, mostly so that each comes after the one that it comes from.
    by_extras: Vec<StateIdx>,
    /// The states to which extras led after that was gone through, in the order in which they are to be gone through.
    late: Vec<StateIdx>,
    /// Whether a state is among these. Shape `[n_states]`.
    are_late: Vec<bool>,
    /// The states of nodes of the layer before the newest that nothing hangs on.
    pub(super) childless: Vec<StateIdx>,
}

/// The bit of a source that is in the same layer: memory ends before there are 2^31 states.
const WITHIN: u32 = 1 << 31;

impl Sweep {
    pub(super) fn new(conditions: &Conditions) -> Self {
        Self {
            ways_in: Arc::default(),
            recurrence: conditions.recurrence(),
            costs: Vec::new(),
            before: Vec::new(),
            distances: Vec::new(),
            sources: Vec::new(),
            open: BinaryHeap::new(),
            by_extras: Vec::new(),
            late: Vec::new(),
            are_late: Vec::new(),
            childless: Vec::new(),
        }
    }

    /// Whether [`Self::make_ready`] was called.
    pub(super) fn is_ready(&self) -> bool {
        !self.costs.is_empty()
    }

    /// Makes what all layers are made with, by these ways into each of the states: before the first layer.
    pub(super) fn make_ready(&mut self, ways_in: Arc<WaysIn>, n_states: usize) {
        self.ways_in = ways_in;
        self.costs = vec![f64::INFINITY; n_states];
        self.before = vec![f64::INFINITY; n_states];
        self.distances = vec![0.0; n_states];
        self.sources = vec![0; n_states];
        self.are_late = vec![false; n_states];
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.ways_in.size_bytes()
            + self.costs.len() * STATE_BYTES
            + self.open.capacity() * size_of::<CheapestFirst>()
            + [&self.childless, &self.by_extras, &self.late].map(Vec::capacity).iter().sum::<usize>()
                * size_of::<StateIdx>()
    }

    /// The first layer, of these states and what each costs: extras lead on from there (Dijkstra's algorithm). `nodes` are absent. The states
    /// that no way leads to are taken out of `reached`.
    pub(super) fn begin(
        &mut self,
        model: &Model,
        first: impl IntoIterator<Item = (StateIdx, f64)>,
        link: Link,
        reached: &mut Vec<StateIdx>,
        observed: ObservedDistances,
        mut nodes: Nodes,
    ) -> Layer {
        self.costs.fill(f64::INFINITY);
        self.before.fill(f64::INFINITY);
        self.by_extras.clear();
        for state in &*reached {
            self.distances[*state as usize] = observed.distance(model, *state);
        }
        for (state, cost) in first {
            self.costs[state as usize] = cost;
            self.sources[state as usize] = 0;
            nodes.set(state, Node { link, n_children: 0 });
            self.open.push(CheapestFirst { cost, id: state });
        }
        self.follow_extras(model, false, |_, _| true);
        reached.retain(|state| self.costs[*state as usize].is_finite());
        let mut layer = Layer::new(observed, nodes, reached.len());
        self.link_extras(|to, link| layer.nodes.set(to, Node { link, n_children: 0 }));
        for state in self.by_extras.iter().copied() {
            layer.add_child(self.sources[state as usize] & !WITHIN);
        }
        layer
    }

    /// The layer after the `newest`, whose children it counts: skips and matches from there, and extras wherever they lead to a state
    /// more cheaply. There are no ways but to `reached`; at other states, `nodes` are absent.
    ///
    /// If an extra pays the whole distance, one from a state is worth a look only where the state costs less than it did in the layer before:
    /// from there, the same action would have matched.
    pub(super) fn follow(
        &mut self,
        model: &Model,
        newest: &mut Layer,
        reached: &[StateIdx],
        observed: ObservedDistances,
        mut nodes: Nodes,
    ) -> Layer {
        match (&mut newest.nodes, &mut nodes) {
            (Nodes::Narrow(before), Nodes::Narrow(nodes)) => self.link(model, before, reached, &observed, nodes),
            (Nodes::Wide(before), Nodes::Wide(nodes)) => self.link(model, before, reached, &observed, nodes),
            _ => unreachable!("the newest layer has all nodes, and all layers have as wide ones"),
        }
        Layer::new(observed, nodes, reached.len())
    }

    fn link<N: Number>(
        &mut self,
        model: &Model,
        nodes_before: &mut [Packed<N>],
        reached: &[StateIdx],
        observed: &ObservedDistances,
        nodes: &mut [Packed<N>],
    ) {
        std::mem::swap(&mut self.costs, &mut self.before);
        let recurrence = self.recurrence;
        let mut most = 0.0;
        for state in reached.iter().copied() {
            let at = state as usize;
            let (mut cost, mut source, mut link) = (self.before[at], state, Link::SKIP);
            for (number, (from, way_cost)) in self.ways_in.of(state).enumerate() {
                let by_way = self.before[from as usize] + way_cost;
                if by_way < cost {
                    (cost, source, link) = (by_way, from, Link::matched(number));
                }
            }
            let distance = observed.distance(model, state);
            let cost = recurrence.arrive(MoveKind::Match, cost, distance);
            most = f64::max(most, cost);
            self.distances[at] = distance;
            self.costs[at] = cost;
            self.sources[at] = source;
            nodes[at] = Node { link, n_children: 0 }.into();
        }
        let ways_in = Arc::clone(&self.ways_in);
        let before = std::mem::take(&mut self.before);
        let is_lower = |state: StateIdx, cost: f64| !recurrence.pays_alike() || cost < before[state as usize];
        // Each extra makes a way dearer, so that the cheapest of several sources is not a matter of the order in which they are looked at.
        let has_order = most + ways_in.least_cost > most;
        if has_order {
            // They lead mostly where they led in the layer before. What this leaves out, is found afterwards.
            let by_extras = std::mem::take(&mut self.by_extras);
            for state in by_extras.iter().copied() {
                self.come_by_extra(&ways_in, state);
            }
            self.by_extras = by_extras;
        }
        for state in reached.iter().copied() {
            let cost = self.costs[state as usize];
            if has_order && !recurrence.pays_alike() {
                if self.come_by_extra(&ways_in, state) {
                    self.open.push(CheapestFirst { cost: self.costs[state as usize], id: state });
                }
            } else if is_lower(state, cost) {
                if has_order {
                    self.extras(model, &ways_in, state, has_order, is_lower);
                } else {
                    self.open.push(CheapestFirst { cost, id: state });
                }
            }
        }
        self.follow_extras(model, has_order, is_lower);
        self.before = before;
        self.link_extras(|to, link| nodes[to as usize] = Node { link, n_children: 0 }.into());
        for state in reached {
            let source = self.sources[*state as usize];
            let among = if source & WITHIN == 0 { &mut *nodes_before } else { &mut *nodes };
            among[(source & !WITHIN) as usize].add_child();
        }
        self.childless.clear();
        let childless = reached.iter().filter(|state| nodes_before[**state as usize].node().n_children == 0);
        self.childless.extend(childless);
    }

    /// Takes the cheapest extra to a state, if it is cheaper than what is known, or as cheap from a cheaper source. Says whether it is cheaper.
    #[inline]
    fn come_by_extra(&mut self, ways_in: &WaysIn, to: StateIdx) -> bool {
        let (known, mut source) = (self.costs[to as usize], self.sources[to as usize]);
        let (mut cost, distance) = (known, self.distances[to as usize]);
        for (from, way_cost) in ways_in.of(to) {
            let before = self.costs[from as usize] + way_cost;
            let by_way = self.recurrence.arrive(MoveKind::Extra, before, distance);
            if by_way < cost || (by_way == cost && self.is_earlier(from, source)) {
                (cost, source) = (by_way, from | WITHIN);
            }
        }
        (self.costs[to as usize], self.sources[to as usize]) = (cost, source);
        cost < known
    }

    /// Whether a state is the cheaper source than another in the same layer, the lower of equals. Matches and skips come before all.
    fn is_earlier(&self, state: StateIdx, source: u32) -> bool {
        let other = source & !WITHIN;
        let costs = [state, other].map(|state| self.costs[state as usize]);
        source & WITHIN != 0 && (costs[0], state) < (costs[1], other)
    }

    /// Takes extras from the states that are open, the cheapest first, and from those to which they lead more cheaply if that `leads_on`.
    fn follow_extras(&mut self, model: &Model, has_order: bool, leads_on: impl Fn(StateIdx, f64) -> bool + Copy) {
        let ways_in = Arc::clone(&self.ways_in);
        while let Some(CheapestFirst { cost, id: state }) = self.open.pop() {
            if cost <= self.costs[state as usize] {
                if self.sources[state as usize] & WITHIN != 0 {
                    self.late.push(state);
                }
                self.extras(model, &ways_in, state, has_order, leads_on);
            }
        }
    }

    /// Takes extras from a state.
    fn extras(
        &mut self,
        model: &Model,
        ways_in: &WaysIn,
        from: StateIdx,
        has_order: bool,
        leads_on: impl Fn(StateIdx, f64) -> bool,
    ) {
        let from_cost = self.costs[from as usize];
        for (transition, action_cost) in ways_in.body.ways(&model.whole(), from) {
            let to = transition.to as usize;
            let cost = from_cost + action_cost;
            // A distance is never negative.
            if cost > self.costs[to] {
                continue;
            }
            let cost = self.recurrence.arrive(MoveKind::Extra, cost, self.distances[to]);
            if cost < self.costs[to] {
                (self.costs[to], self.sources[to]) = (cost, from | WITHIN);
                if leads_on(transition.to, cost) {
                    self.open.push(CheapestFirst { cost, id: transition.to });
                } else {
                    self.late.push(transition.to);
                }
            } else if has_order && cost == self.costs[to] && self.is_earlier(from, self.sources[to]) {
                self.sources[to] = from | WITHIN;
            }
        }
    }

    /// Finds the links of all states to which extras led.
    fn link_extras(&mut self, mut link: impl FnMut(StateIdx, Link)) {
        self.by_extras.retain(|state| self.sources[*state as usize] & WITHIN != 0);
        // Those that are found late, come last.
        for state in &self.late {
            self.are_late[*state as usize] = true;
        }
        self.by_extras.retain(|state| !self.are_late[*state as usize]);
        for state in self.late.drain(..) {
            if std::mem::take(&mut self.are_late[state as usize]) {
                self.by_extras.push(state);
            }
        }
        for state in self.by_extras.iter().copied() {
            let from = self.sources[state as usize] & !WITHIN;
            let number = self.ways_in.sources(state).iter().position(|source| *source == from);
            link(state, Link::extra(number.expect("a way out leads in")));
        }
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

/// How much memory a state takes, in bytes, whatever the number of layers.
pub(super) const STATE_BYTES: usize = 3 * size_of::<f64>() + size_of::<u32>() + size_of::<bool>();
