//! A* for consistent estimates, with an incumbent.
//!
//! 1. A *probe* goes through the observations from the first to the last, and expands the most promising node of each. It comes
//!    to a mapping, the first *incumbent*: from then on, what cannot cost less is not kept.
//! 2. The nodes that are left are expanded in the order of `f = g + h`. Whatever comes to the last observation more cheaply
//!    is the new incumbent. When no node is left whose `f` is below the incumbent's cost, that is the optimum.
//! 3. Should that take long, wider probes look for better incumbents in between: they keep the memory small, and a search
//!    that runs out of budget has something to show.
//! 4. Should it take very long, attributes are projected together ([`Projected::deepen`]). All nodes get their better estimates;
//!    the ways to them that were found stay as they are.
//!
//! So the nodes are expanded whose `f` is below the optimum, as A* must (Dechter & Pearl 1985), and those of the probes; but
//! none of the many whose `f` equals it. As incumbents bound `f`, the open list needs no heap: costs are
//! divided into [`Buckets`]. The order within a bucket is not that of `f`, so a node may be expanded before the cheapest way to it is
//! known; it is then expanded again.

use std::collections::BinaryHeap;

use super::buckets::Buckets;
use super::nodes::{Arrival, NO_NODE, Node, NodeId, Nodes};
use super::{Found, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::projected::{Deepened, Projected};
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::{Budget, Problem};
use crate::model::{Space, Transition};

/// How many times as wide each probe is as the one before.
const PROBE_WIDENING: u64 = 8;

/// A probe may take this part of the work that was done before it.
const PROBE_SHARE: u64 = 16;

/// Buffers of a search, kept to be used again.
#[derive(Debug, Default)]
pub(in crate::mapping) struct Buffers {
    nodes: Nodes,
    open: Buckets,
    probed: BinaryHeap<CheapestFirst>,
}

impl Buffers {
    /// Whether they are small enough to be kept: 12 MB of nodes.
    pub(in crate::mapping) fn are_small(&self) -> bool {
        self.nodes.capacity() <= 1 << 18
    }
}

/// Finds the cheapest mapping, as far as `budget` allows, among those of at most `most`, of which there must be one.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search<S: Space>(
    problem: &Problem<'_>,
    space: &mut S,
    projected: &mut Projected<'_>,
    budget: Budget,
    most: f64,
    buffers: &mut Buffers,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    buffers.nodes.clear(problem.demonstration.len().saturating_mul(space.n_states().unwrap_or(usize::MAX)));
    let start = Arrival {
        kind: MoveKind::Start,
        observation: 0,
        state: problem.start,
        cost: 0.0,
        parent: NO_NODE,
        action: NO_ACTION,
    };
    // The start is kept whatever it costs: it is what is left to complete if there is no budget at all.
    let first = buffers.nodes.offer(start, space, &projected.at(0), f64::INFINITY).unwrap_or(NO_NODE);
    let mut search = Search {
        problem,
        space,
        projected,
        budget,
        buffers,
        limit: most.next_up(),
        incumbent: (problem.last() == 0).then_some(first),
        n_expanded: 0,
        n_generated: 0,
        #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
        last: problem.last() as u32,
        rounding: rounding_of_sums(problem.demonstration.len()),
        meter: Meter::new(interrupt, POLL_EVERY),
    };
    let mut end = End::Done;
    if search.incumbent.is_none() {
        end = search.probe(1)?;
        if end == End::Done {
            end = search.expand_best_first()?;
        }
    }
    Ok(search.found(first, end))
}

/// How a part of a search ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// All is done that was to be done.
    Done,
    /// The budget was used up, or the interrupt said to finish.
    CutShort,
}

struct Search<'s, 'p, S> {
    problem: &'s Problem<'s>,
    space: &'s mut S,
    projected: &'s mut Projected<'p>,
    budget: Budget,
    buffers: &'s mut Buffers,
    /// Mappings of this cost or more are of no interest.
    limit: f64,
    /// The end of the cheapest mapping that was found.
    incumbent: Option<NodeId>,
    n_expanded: u64,
    n_generated: u64,
    /// The last observation.
    last: u32,
    /// What is less than this cheaper, as a part of the cost, is not looked for.
    rounding: f64,
    meter: Meter<'s>,
}

impl<S: Space> Search<'_, '_, S> {
    /// Expands the most promising nodes of each observation, `width` of them. What is reached from them by actions that do not
    /// advance counts among those of the observation.
    fn probe(&mut self, width: u64) -> Result<End, Cancelled> {
        let mut layers = vec![Vec::new(); self.problem.last()];
        for (id, node) in self.buffers.nodes.iter().filter(|(_, node)| self.is_open(node)) {
            if let Some(layer) = layers.get_mut(node.observation as usize) {
                layer.push(id);
            }
        }
        let mut ahead = Vec::new();
        for (observation, mut layer) in layers.into_iter().enumerate() {
            layer.append(&mut ahead);
            self.buffers.probed.clear();
            for id in layer {
                let cost = self.buffers.nodes.get(id).f();
                self.buffers.probed.push(CheapestFirst { cost, id });
            }
            let mut n_left = width;
            while let Some(CheapestFirst { id, .. }) = self.buffers.probed.pop() {
                if !self.is_open(&self.buffers.nodes.get(id)) {
                    continue;
                }
                if n_left == 0 {
                    break;
                }
                n_left -= 1;
                if self.spend(id)? == End::CutShort {
                    return Ok(End::CutShort);
                }
                self.expand(id, |buffers, id| {
                    let node = buffers.nodes.get(id);
                    if node.observation as usize == observation {
                        buffers.probed.push(CheapestFirst { cost: node.f(), id });
                    } else {
                        ahead.push(id);
                    }
                });
            }
        }
        Ok(End::Done)
    }

    /// Expands the nodes that may lead to a cheaper mapping than the incumbent, the most promising first.
    fn expand_best_first(&mut self) -> Result<End, Cancelled> {
        let n_layers = self.problem.last() as u64;
        let mut probe_width = PROBE_WIDENING;
        while self.is_deepening_due() {
            if self.deepen()? == End::CutShort {
                return Ok(End::CutShort);
            }
        }
        let mut bucketed_limit = self.fill_buckets();
        while let Some(id) = self.buffers.open.pop() {
            if !self.is_open(&self.buffers.nodes.get(id)) {
                continue;
            }
            if self.spend(id)? == End::CutShort {
                return Ok(End::CutShort);
            }
            self.expand(id, |buffers, id| {
                let f = buffers.nodes.get(id).f();
                buffers.open.push(id, f);
            });
            let is_deepening_due = self.is_deepening_due();
            if is_deepening_due && self.deepen()? == End::CutShort {
                return Ok(End::CutShort);
            }
            let is_probe_due = self.n_expanded / PROBE_SHARE >= probe_width.saturating_mul(n_layers);
            if is_probe_due {
                probe_width *= PROBE_WIDENING;
                if self.probe(probe_width / PROBE_WIDENING)? == End::CutShort {
                    return Ok(End::CutShort);
                }
            }
            // What a probe found is not in the buckets, and better estimates are for others; and those for a much higher limit
            // are too wide.
            if is_deepening_due || is_probe_due || self.limit < bucketed_limit / 4.0 {
                bucketed_limit = self.fill_buckets();
            }
        }
        Ok(End::Done)
    }

    /// Whether better estimates are worth a try. They are for what is cheaper than a known mapping; until there is one, a
    /// completion may need the estimates of all nodes.
    #[inline]
    fn is_deepening_due(&self) -> bool {
        self.n_expanded >= self.projected.deepening_due() && self.incumbent.is_some()
    }

    /// Has better estimates made, if there are any, and gives them to all nodes.
    #[cold]
    fn deepen(&mut self) -> Result<End, Cancelled> {
        match self.projected.deepen(self.limit, self.n_expanded, &mut self.meter)? {
            Deepened::CutShort => return Ok(End::CutShort),
            Deepened::No => return Ok(End::Done),
            Deepened::Yes => {}
        }
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        for id in 0..self.buffers.nodes.len() as NodeId {
            let Node { observation, state, .. } = self.buffers.nodes.get(id);
            self.buffers.nodes.estimate(id, self.projected.at(observation as usize).of(self.space.row(state)));
        }
        self.probe(1)
    }

    /// Puts all open nodes into the buckets, and gives the limit that these are for.
    fn fill_buckets(&mut self) -> f64 {
        let limit = self.limit;
        let Buffers { nodes, open, .. } = &mut *self.buffers;
        let is_open = |node: &Node| !node.is_closed && node.f() < limit;
        let least = nodes.iter().filter(|(_, node)| is_open(node)).map(|(_, node)| node.f()).fold(limit, f64::min);
        open.reset(least, limit);
        for (id, node) in nodes.iter().filter(|(_, node)| is_open(node)) {
            open.push(id, node.f());
        }
        limit
    }

    fn is_open(&self, node: &Node) -> bool {
        !node.is_closed && node.f() < self.limit
    }

    /// Counts the expansion of a node that is about to be done. Says whether it may be.
    #[inline]
    fn spend(&mut self, id: NodeId) -> Result<End, Cancelled> {
        let state = self.buffers.nodes.get(id).state;
        self.space.explore(state);
        let n_successors = self.space.successors(state).len();
        let is_spent =
            self.n_expanded >= self.budget.max_expansions || self.budget.is_full(self.buffers.nodes.len(), self.space);
        match self.meter.spend(1 + 2 * n_successors as u64) {
            Signal::Cancel => Err(Cancelled),
            Signal::Continue if !is_spent => Ok(End::Done),
            Signal::Continue | Signal::Finish => Ok(End::CutShort),
        }
    }

    /// Follows the moves out of a node. Calls `found` with each node, not of the last observation, to which that gives a cheaper
    /// way.
    ///
    /// A skip and an extra action, in either order, cost no less than the action as a match: it comes to the same node without the
    /// distance in between. So what was come to by the one is not left by the other.
    #[inline]
    fn expand(&mut self, id: NodeId, mut found: impl FnMut(&mut Buffers, NodeId)) {
        let Self { buffers, projected, space, limit, incumbent, last, rounding, .. } = self;
        let actions = self.problem.model.actions();
        let node = buffers.nodes.get(id);
        let (g, here, next) = (node.g(), node.observation, node.observation + 1);
        buffers.nodes.close(id);
        let (at_here, at_next) = (projected.at(here as usize), projected.at(next as usize));
        let successors = space.successors(node.state);
        let (may_skip, may_linger) = (node.kind != MoveKind::Extra, node.kind != MoveKind::Skip);
        self.n_expanded += 1;
        self.n_generated += u64::from(may_skip) + (1 + u64::from(may_linger)) * successors.len() as u64;
        let skip = [Transition { action: NO_ACTION, to: node.state }];
        let skip = &skip[..usize::from(may_skip)];
        let skips = [(MoveKind::Skip, next, &at_next)];
        let moves = [(MoveKind::Match, next, &at_next), (MoveKind::Extra, here, &at_here)];
        let moves = &moves[..=usize::from(may_linger)];
        for Transition { action, to: state } in skip.iter().chain(successors) {
            let (cost, moves) = match actions.get(usize::from(*action)) {
                Some(action) => (g + action.cost, moves),
                None => (g, &skips[..]),
            };
            for (kind, observation, estimates) in moves {
                let (action, kind, state) = (*action, *kind, *state);
                let arrival = Arrival { kind, observation: *observation, state, cost, parent: id, action };
                let Some(id) = buffers.nodes.offer(arrival, &**space, estimates, *limit) else { continue };
                if observation == last {
                    *limit = buffers.nodes.get(id).g() * (1.0 - *rounding);
                    *incumbent = Some(id);
                } else {
                    found(buffers, id);
                }
            }
        }
    }

    fn found(self, first: NodeId, end: End) -> Found {
        let nodes = &self.buffers.nodes;
        let is_complete = end == End::Done;
        let open = || nodes.iter().filter(|(_, node)| self.is_open(node));
        let least_f =
            if is_complete { f64::INFINITY } else { open().map(|(_, node)| node.f()).fold(self.limit, f64::min) };
        let ends = if let Some(incumbent) = self.incumbent {
            vec![incumbent]
        } else {
            // The farthest nodes, and among those the most promising: where it is best to go on greedily.
            let farthest = open().max_by(|(_, node), (_, other)| {
                node.observation.cmp(&other.observation).then(other.f().total_cmp(&node.f()))
            });
            farthest.map(|(id, _)| id).into_iter().chain([first]).collect()
        };
        let paths = ends.into_iter().map(|id| nodes.path(id)).collect();
        Found { paths, is_complete, least_f, n_expanded: self.n_expanded, n_generated: self.n_generated }
    }
}
