//! The nodes of a search layer by layer.

use super::joined::LayerEstimates;
use super::ways_out::WaysOut;
use crate::mapping::heuristic::projected::Estimate;
use crate::mapping::{Move, MoveKind, Problem};
use crate::model::StateIdx;

/// All nodes, observation by observation.
#[derive(Debug, Default)]
pub(super) struct LayeredNodes {
    pub(super) n_states: usize,
    /// Of the cheapest way to each that was found, before the distance is paid; infinite if none was. Shape `[n_observations, n_states]`.
    pub(super) costs: Vec<f64>,
    /// What else is known of them, if a way was found. Shape as above, and maybe more.
    pub(super) nodes: Vec<Node>,
    /// The states of the open nodes, by observation.
    pub(super) open: Vec<Vec<StateIdx>>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) estimate: Estimate,
    /// How the cheapest way ends.
    pub(super) link: LastStep,
    /// Whether a way was found since the node was last expanded.
    pub(super) is_open: bool,
}

impl Node {
    const UNKNOWN: Self =
        Self { estimate: Estimate { distance: 0.0, cost_to_go: 0.0 }, link: LastStep::START, is_open: false };

    /// What a mapping costs at least that leads through it, if the way to it costs so much before the distance is paid.
    #[inline]
    pub(super) fn f(&self, cost: f64) -> f64 {
        cost + self.estimate.distance + self.estimate.cost_to_go
    }
}

/// How the way to a node ends: with an action, numbered as the way out of a state that it goes, or without one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct LastStep(u32);

impl LastStep {
    pub(super) const START: Self = Self(u32::MAX);
    pub(super) const SKIP: Self = Self(u32::MAX - 1);

    /// With an action that advances.
    #[inline]
    pub(super) fn matched(way: usize) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_WAYS")]
        let way = way as u32;
        Self(way << 1)
    }

    /// With an action that does not.
    #[inline]
    pub(super) fn extra(way: usize) -> Self {
        Self(Self::matched(way).0 | 1)
    }

    #[inline]
    pub(super) fn kind(self) -> MoveKind {
        match self {
            Self::START => MoveKind::Start,
            Self::SKIP => MoveKind::Skip,
            Self(way) if way & 1 == 0 => MoveKind::Match,
            Self(_) => MoveKind::Extra,
        }
    }

    fn way(self) -> Option<usize> {
        (self.0 < Self::SKIP.0).then_some(self.0 as usize >> 1)
    }
}

/// The nodes of an observation.
pub(super) struct Layer<'s> {
    pub(super) costs: &'s mut [f64],
    pub(super) nodes: &'s mut [Node],
    pub(super) estimates: LayerEstimates<'s>,
    pub(super) open: &'s mut Vec<StateIdx>,
}

impl Layer<'_> {
    /// Takes a way to the node of a state that costs so much before the distance is paid, if it is the cheapest so far.
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    pub(super) fn reach(&mut self, state: StateIdx, cost: f64, link: LastStep) {
        let known = &mut self.costs[state as usize];
        if cost < *known {
            let is_new = std::mem::replace(known, cost) == f64::INFINITY;
            let node = &mut self.nodes[state as usize];
            node.link = link;
            if is_new {
                node.estimate = self.estimates.of(state);
            }
            if !std::mem::replace(&mut node.is_open, true) || is_new {
                self.open.push(state);
            }
        }
    }
}

impl LayeredNodes {
    /// Forgets all nodes but the start states', which are estimated so.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, estimates: LayerEstimates<'_>) {
        let n_observations = problem.demonstration.len();
        self.n_states = problem.model.graph().n_states();
        let n_nodes = n_observations * self.n_states;
        self.costs.clear();
        self.costs.resize(n_nodes, f64::INFINITY);
        self.nodes.resize(n_nodes.max(self.nodes.len()), Node::UNKNOWN);
        self.open.iter_mut().for_each(Vec::clear);
        self.open.resize_with(n_observations.max(self.open.len()), Vec::new);

        let (costs, nodes) = (&mut *self.costs, &mut *self.nodes);
        let mut layer = Layer { costs, nodes, estimates, open: &mut self.open[0] };
        for start in problem.starts.states() {
            layer.reach(*start, 0.0, LastStep::START);
        }
    }

    /// How much memory is kept, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        let open: usize = self.open.iter().map(Vec::capacity).sum();
        self.costs.capacity() * size_of::<f64>()
            + self.nodes.capacity() * size_of::<Node>()
            + open * size_of::<StateIdx>()
    }

    /// The way of `ways_out` from the start to a node.
    pub(super) fn path(&self, ways_out: &WaysOut, mut observation: usize, mut state: StateIdx) -> Vec<Move> {
        let mut moves = Vec::with_capacity(2 * observation + 1);
        loop {
            let link = self.nodes[observation * self.n_states + state as usize].link;
            let kind = link.kind();
            let way = link.way().map(|way| ways_out.ways[way]);
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            moves.push(Move { kind, action: way.map(|way| way.action), observation: observation as u32, state });
            match kind {
                MoveKind::Start => break,
                MoveKind::Extra => {}
                MoveKind::Match | MoveKind::Skip => observation -= 1,
            }
            state = way.map_or(state, |way| way.from);
        }
        moves.reverse();
        moves
    }
}
