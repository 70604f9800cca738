//! Repairs the paths of survivors that have lost theirs, where these are few.
//!
//! The costs in the window may refer to an older root. Every path from the present root continues a path from the older one, so an old cost is
//! a lower bound. A node is *sound* if its path comes from the present root: its source is sound, and its cost follows from its source's. All
//! others are *lost*. Two passes give every survivor a sound path again:
//!
//! - backwards from the newest layer, the nodes are collected for which a new path is *wanted*. Sound predecessors of a wanted node give an
//!   upper bound of its cost; a lost predecessor is wanted too if its lower bound promises less;
//! - forwards, wanted nodes get their paths from sound ones, layer by layer, by Dijkstra's algorithm within a layer.
//!
//! Lost nodes that were not wanted keep their lower bounds for the next repair.

use std::collections::BinaryHeap;

use super::layer::{Source, Sweep};
use super::window::{NodePlace, Window, cheapest_way};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::mapping::MoveKind;
use crate::mapping::conditions::Body;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::model::{Graph, Model, Rows, StateIdx};

/// The ways of a body into states, by the state that is led to: where each comes from, and what its action costs.
#[derive(Debug)]
pub(super) struct Predecessors(Rows<(StateIdx, f64)>);

impl Predecessors {
    pub(super) fn new(model: &Model, body: &Body) -> Self {
        let space = model.whole();
        let ways = (0..model.states().len())
            .flat_map(|from| body.ways(&space, from).map(move |(transition, cost)| (transition.to, (from, cost))));
        Self(Rows::of_entries(model.graph().n_states(), ways))
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.0.size_bytes()
    }

    /// The same, before they are made.
    pub(super) fn bytes_for(graph: &Graph) -> usize {
        graph.n_states() * size_of::<u32>() + graph.n_transitions() * size_of::<(StateIdx, f64)>()
    }

    fn of(&self, state: StateIdx) -> &[(StateIdx, f64)] {
        self.0.of(state as usize)
    }
}

/// Which survivors have a way again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Repaired {
    All,
    /// None, as too many had lost theirs.
    TooMany,
}

/// How much memory a repair takes for a node of the window, in bytes: its standing, and some are wanted.
pub(super) const NODE_BYTES: usize = size_of::<Standing>() + size_of::<StateIdx>();

/// What is known of a node's way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Standing {
    Unknown,
    /// It leads from the root, and costs what the node says.
    Sound,
    /// It does not; what the node says is a lower bound.
    Lost,
    /// So, and a new one is wanted.
    Wanted,
}

/// A repair of a window whose layers are kept whole.
pub(super) struct Repair<'r> {
    window: &'r mut Window,
    model: &'r Model,
    predecessors: &'r Predecessors,
    body: &'r Body,
    recurrence: Recurrence,
    open: &'r mut BinaryHeap<CheapestFirst>,
    n_states: usize,
    /// Shape `[n_layers, n_states]`.
    standings: Vec<Standing>,
    /// By layer.
    wanted: Vec<Vec<StateIdx>>,
    /// Nodes in hand of [`Self::is_sound`], kept for its memory.
    chain: Vec<NodePlace>,
}

impl<'r> Repair<'r> {
    pub(super) fn new(
        window: &'r mut Window,
        model: &'r Model,
        predecessors: &'r Predecessors,
        sweep: &'r mut Sweep,
    ) -> Self {
        let Sweep { body, recurrence, open, .. } = sweep;
        let (n_layers, n_states) = (window.layers.len(), model.graph().n_states());
        Self {
            window,
            model,
            predecessors,
            body,
            recurrence: *recurrence,
            open,
            n_states,
            standings: vec![Standing::Unknown; n_layers * n_states],
            wanted: vec![Vec::new(); n_layers],
            chain: Vec::new(),
        }
    }

    /// Gives every survivor a way, unless more than `most` have lost theirs.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so. It is not asked to finish.
    pub(super) fn run(mut self, most: usize, interrupt: &mut dyn Interrupt) -> Result<Repaired, Cancelled> {
        let newest = self.wanted.len() - 1;
        let reached = std::mem::take(&mut self.window.reached);
        for state in reached.iter().copied() {
            if self.window.layers[newest].costs[state as usize].is_finite() && !self.is_sound((newest, state)) {
                self.want((newest, state));
            }
        }
        self.window.reached = reached;
        if self.wanted[newest].len() > most {
            return Ok(Repaired::TooMany);
        }
        for index in (0..=newest).rev() {
            if interrupt.poll() == Signal::Cancel {
                return Err(Cancelled);
            }
            self.look_back(index);
        }
        for index in 0..=newest {
            if interrupt.poll() == Signal::Cancel {
                return Err(Cancelled);
            }
            self.find(index);
        }
        self.window.recount();
        self.window.shrink();
        Ok(Repaired::All)
    }

    fn at(&self, (index, state): NodePlace) -> usize {
        index * self.n_states + state as usize
    }

    /// Wants a new way to a lost node.
    fn want(&mut self, place: NodePlace) {
        let at = self.at(place);
        self.standings[at] = Standing::Wanted;
        self.wanted[place.0].push(place.1);
    }

    fn cost(&self, (index, state): NodePlace) -> f64 {
        self.window.layers[index].costs[state as usize]
    }

    fn distance(&self, (index, state): NodePlace) -> f64 {
        self.window.layers[index].observed.distance(self.model, state)
    }

    /// What it costs to come from `origin` to `place`, with this distance.
    fn arrive(&self, origin: NodePlace, action_cost: f64, place: NodePlace, distance: f64) -> f64 {
        let kind = if origin.0 == place.0 { MoveKind::Extra } else { MoveKind::Match };
        self.recurrence.arrive(kind, self.cost(origin) + action_cost, distance)
    }

    /// Whether a node's way leads from the root and costs what it says. Every node of the way is noted as what it is.
    fn is_sound(&mut self, mut place: NodePlace) -> bool {
        let root = (0, self.window.root);
        let mut is_sound = loop {
            let at = self.at(place);
            match self.standings[at] {
                Standing::Sound => break true,
                Standing::Lost | Standing::Wanted => break false,
                Standing::Unknown if place == root => {
                    self.standings[at] = Standing::Sound;
                    break true;
                }
                // Until it has turned out otherwise.
                Standing::Unknown => self.standings[at] = Standing::Lost,
            }
            self.chain.push(place);
            match self.window.source(place) {
                Some(source) => place = source,
                None => break false,
            }
        };
        while let Some(place) = self.chain.pop() {
            is_sound = is_sound && self.is_consistent(place);
            if is_sound {
                let at = self.at(place);
                self.standings[at] = Standing::Sound;
            }
        }
        is_sound
    }

    /// Whether a node still costs what its source's cost makes of it, as those that survivors hang on do.
    fn is_consistent(&self, place: NodePlace) -> bool {
        let (index, state) = place;
        let node = self.window.layers[index].node(state);
        if node.is_alive() {
            return true;
        }
        let Some(source) = self.window.source(place) else { return false };
        let is_skip = source.0 != index && source.1 == state;
        let action_cost = if is_skip {
            0.0
        } else {
            cheapest_way(self.model, self.body, source.1, state).map_or(f64::INFINITY, |(_, cost)| cost)
        };
        #[expect(clippy::float_cmp, reason = "the same sum gives the same float")]
        let is_same = self.arrive(source, action_cost, place, self.distance(place)) == self.cost(place);
        is_same
    }

    /// Calls with each node that a step leads from to `place`, and what the step's action costs.
    fn each_origin(&mut self, (index, state): NodePlace, mut look: impl FnMut(&mut Self, NodePlace, f64)) {
        if index > 0 {
            look(self, (index - 1, state), 0.0);
        }
        let predecessors = self.predecessors;
        for (from, action_cost) in predecessors.of(state) {
            if index > 0 {
                look(self, (index - 1, *from), *action_cost);
            }
            look(self, (index, *from), *action_cost);
        }
    }

    /// Wants every node that a new way of a wanted node of this layer may lead over.
    fn look_back(&mut self, index: usize) {
        let mut next = 0;
        while let Some(state) = self.wanted[index].get(next).copied() {
            next += 1;
            let place = (index, state);
            let distance = self.distance(place);
            let mut bound = f64::INFINITY;
            self.each_origin(place, |this, origin, action_cost| {
                let cost = this.arrive(origin, action_cost, place, distance);
                if cost < bound && this.is_sound(origin) {
                    bound = cost;
                }
            });
            self.each_origin(place, |this, origin, action_cost| {
                let cost = this.arrive(origin, action_cost, place, distance);
                if cost < bound && !this.is_sound(origin) && this.standings[this.at(origin)] != Standing::Wanted {
                    this.want(origin);
                }
            });
        }
    }

    /// Gives the wanted nodes of this layer their new ways; those of earlier layers have theirs.
    fn find(&mut self, index: usize) {
        let wanted = std::mem::take(&mut self.wanted[index]);
        for state in wanted.iter().copied() {
            let distance = self.distance((index, state));
            let mut best = (f64::INFINITY, Source::NONE);
            self.each_origin((index, state), |this, origin, action_cost| {
                let cost = this.arrive(origin, action_cost, (index, state), distance);
                if cost < best.0 && this.is_sound(origin) {
                    let source = if origin.0 == index { Source::within(origin.1) } else { Source::before(origin.1) };
                    best = (cost, source);
                }
            });
            self.set((index, state), best);
        }
        while let Some(CheapestFirst { cost, id: state }) = self.open.pop() {
            if cost > self.cost((index, state)) {
                continue;
            }
            let (space, body) = (self.model.whole(), self.body);
            for (transition, action_cost) in body.ways(&space, state) {
                let to = (index, transition.to);
                if self.standings[self.at(to)] != Standing::Wanted {
                    continue;
                }
                let cost = self.recurrence.arrive(MoveKind::Extra, cost + action_cost, self.distance(to));
                if cost < self.cost(to) {
                    self.set(to, (cost, Source::within(state)));
                }
            }
        }
        for state in wanted.iter().copied() {
            let at = self.at((index, state));
            let is_found = self.cost((index, state)).is_finite();
            self.standings[at] = if is_found { Standing::Sound } else { Standing::Lost };
        }
        self.wanted[index] = wanted;
    }

    /// Gives a wanted node a way.
    fn set(&mut self, (index, state): NodePlace, (cost, source): (f64, Source)) {
        let layer = &mut self.window.layers[index];
        layer.costs[state as usize] = cost;
        layer.set_source(state, source);
        if cost.is_finite() {
            self.open.push(CheapestFirst { cost, id: state });
        }
    }
}
