//! A* for consistent estimates, with an incumbent.
//!
//! 1. A *probe* goes through the observations from the first to the last, and expands the most promising node of each. It comes
//!    to a mapping, the first *incumbent*: from then on, what cannot cost less is not kept.
//! 2. The nodes that are left are expanded in the order of `f = g + h`. Whatever comes to the last observation more cheaply
//!    is the new incumbent. When no node is left whose `f` is below the incumbent's cost, that is the optimum.
//! 3. Should that take long, wider probes look for better incumbents in between: they keep the memory small, and a search
//!    that runs out of budget has something to show.
//!
//! So the nodes are expanded whose `f` is below the optimum, as A* must (Dechter & Pearl 1985), and those of the probes; but
//! none of the many whose `f` equals it. As incumbents bound `f`, the open list needs no heap: costs are
//! divided into [`Buckets`]. The order within a bucket is not that of `f`, so a node may be expanded before the cheapest way to it is
//! known; it is then expanded again.
//!
//! This file is longer than 400 lines because probes and the search share the expansion, its budget and what is found.

mod starts;

use std::collections::BinaryHeap;
use std::ops::Range;

use super::buckets::Buckets;
use super::nodes::{Arrival, BlockIdx, NO_NODE, NodeId, Nodes, Position, Reached};
use super::seen::{Estimates, Seen, SeenIdx, SeenWay};
use super::{End, Found, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Interrupted, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::abstraction::{Abstracted, KnownCosts};
use crate::mapping::heuristic::projected::Projected;
use crate::mapping::heuristic::{Guide, Raising};
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{Model, Space};

/// How many times as wide each probe is as the one before.
const PROBE_WIDENING: u64 = 8;

/// A probe may take this part of the work that was done before it.
const PROBE_SHARE: u64 = 16;

/// How a search ends that the interrupt said to finish.
const OUT_OF_TIME: End = End::CutShort(StoppedBy::Deadline);

/// How a search ends whose estimates could not be raised.
fn cut_short(interrupted: Interrupted) -> Result<End, Cancelled> {
    match interrupted {
        Interrupted::OutOfTime => Ok(OUT_OF_TIME),
        Interrupted::Cancelled(cancelled) => Err(cancelled),
    }
}

/// Buffers of a search, kept to be used again.
#[derive(Debug, Default)]
pub(in crate::mapping) struct SearchBuffers {
    seen: Seen,
    nodes: Nodes,
    open: Open,
    /// Of an abstraction.
    costs: KnownCosts,
}

/// The nodes that are to be expanded next.
#[derive(Debug, Default)]
struct Open {
    buckets: Buckets,
    /// Of the observation that a probe is at.
    probed: BinaryHeap<CheapestFirst>,
    /// Of the observation after it, found by the probe.
    ahead: Vec<CheapestFirst>,
}

/// About how much memory a search of `model` takes at most, in bytes, if it finds every node at so many observations.
pub(in crate::mapping) fn most_bytes(model: &Model, n_observations: usize) -> usize {
    /// How often a node is open, at different costs.
    const N_TIMES_OPEN: usize = 4;
    let (n_states, n_nodes) = (model.graph().n_states(), model.graph().n_states().saturating_mul(n_observations));
    let nodes = n_states.saturating_mul(Nodes::bytes_for(n_observations));
    let seen = Seen::bytes_for(n_states, model.graph().n_transitions(), model.schema().len());
    nodes.saturating_add(n_nodes.saturating_mul(N_TIMES_OPEN * Buckets::ENTRY_BYTES)).saturating_add(seen)
}

impl SearchBuffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        self.seen.kept_bytes() + self.nodes.kept_bytes() + self.open.kept_bytes() + self.costs.kept_bytes()
    }
}

impl Open {
    /// How much memory is kept for them, in bytes.
    fn kept_bytes(&self) -> usize {
        self.buckets.kept_bytes() + (self.probed.capacity() + self.ahead.capacity()) * size_of::<CheapestFirst>()
    }
}

/// Finds the cheapest mapping, as far as `budget` allows, among those of at most `most`, of which there must be one. `ALIKE` says whether
/// moves of all kinds [pay the same part](Recurrence::pays_alike) of a distance in this problem.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search<S: Space, const ALIKE: bool>(
    problem: &Problem<'_>,
    space: &mut S,
    guide: Guide<'_, '_>,
    budget: Budget,
    most: f64,
    buffers: &mut SearchBuffers,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let Guide { projected, raising } = guide;
    let SearchBuffers { seen, nodes, open, costs } = buffers;
    seen.prepare(space, &problem.body, projected);
    nodes.clear(problem.demonstration.len(), problem.recurrence());
    open.buckets.clear();
    let mut search = Search::<S, ALIKE> {
        problem,
        space,
        projected,
        abstracted: None,
        budget,
        seen,
        nodes,
        limit: most.next_up(),
        first: NO_NODE,
        least_f: 0.0,
        left_out_f: f64::INFINITY,
        incumbent: None,
        n_expanded: 0,
        n_generated: 0,
        unspent_until: 0,
        #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
        last: problem.last() as u32,
        recurrence: problem.recurrence(),
        rounding: rounding_of_sums(problem.demonstration.len()),
        meter: Meter::new(interrupt, POLL_EVERY),
    };
    let others = search.start();
    let mut end = search.probe(1, open)?;
    if end == End::Done {
        end = search.start_in(&others)?;
    }
    if end == End::Done {
        end = search.expand_best_first(raising, open, costs)?;
    }
    if let Some(abstracted) = search.abstracted.take() {
        *costs = abstracted.into_costs();
    }
    Ok(search.found(end))
}

/// `ALIKE`: see [`Nodes`].
struct Search<'s, 'p, S, const ALIKE: bool> {
    problem: &'s Problem<'s>,
    space: &'s mut S,
    projected: &'s Projected<'p>,
    /// What raises the estimates, once the search has taken long.
    abstracted: Option<Abstracted<'p>>,
    budget: Budget,
    seen: &'s mut Seen,
    nodes: &'s mut Nodes,
    /// Mappings of this cost or more are of no interest.
    limit: f64,
    /// The most promising start.
    first: NodeId,
    /// No node's `f` is less.
    least_f: f64,
    /// No `f` of a start that is not yet among the nodes is less.
    left_out_f: f64,
    /// The end of the cheapest mapping that was found.
    incumbent: Option<NodeId>,
    n_expanded: u64,
    n_generated: u64,
    /// The budget lasts at least until so many nodes are expanded.
    unspent_until: u64,
    /// The last observation.
    last: u32,
    recurrence: Recurrence,
    /// Relative tolerance: mappings that are cheaper by less are not searched for.
    rounding: f64,
    meter: Meter<'s>,
}

impl<'p, S: Space, const ALIKE: bool> Search<'_, 'p, S, ALIKE> {
    /// Expands the most promising nodes of each observation, `width` of them. What is reached from them by actions that do not
    /// advance counts among those of the observation.
    fn probe(&mut self, width: u64, Open { buckets, probed, ahead }: &mut Open) -> Result<End, Cancelled> {
        // With the room for more, as they come.
        let left = self.budget.beside(self.size_bytes(buckets)).beside(self.space.found_bytes());
        let max_known = left.max_bytes / (2 * size_of::<(CheapestFirst, Option<u32>)>());
        // Of each observation, the last of those that are open, and where the one before it is.
        let n_layers = self.problem.last() + usize::from(self.problem.end.is_some());
        let mut last_of: Vec<Option<u32>> = vec![None; n_layers];
        let mut known = Vec::new();
        for Reached { id, f, .. } in self.nodes.open::<ALIKE>().filter(|node| node.f < self.limit) {
            match self.meter.spend(1) {
                Signal::Continue => {}
                Signal::Finish => return Ok(OUT_OF_TIME),
                Signal::Cancel => return Err(Cancelled),
            }
            if let Some(last) = last_of.get_mut(self.nodes.step(id).observation as usize) {
                #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
                let before = last.replace(known.len() as u32);
                if known.len() >= max_known {
                    // There is no memory for a probe.
                    return Ok(End::Done);
                }
                known.push((CheapestFirst { cost: f, id }, before));
            }
        }
        ahead.clear();
        for (observation, mut last) in (0..).zip(last_of) {
            probed.clear();
            probed.extend(ahead.drain(..));
            while let Some((node, before)) = last.map(|at| known[at as usize]) {
                probed.push(node);
                last = before;
            }
            let mut n_left = width;
            while let Some(CheapestFirst { id, .. }) = probed.pop() {
                let Reached { g, f, .. } = self.nodes.get::<ALIKE>(id);
                if self.nodes.is_closed(id) || f >= self.limit {
                    continue;
                }
                if n_left == 0 {
                    break;
                }
                n_left -= 1;
                let step = self.nodes.step(id);
                let ways = match self.spend(step.state, buckets)? {
                    Ok(ways) => ways,
                    Err(stopped_by) => return Ok(End::CutShort(stopped_by)),
                };
                self.expand(id, g, step, ways, |Reached { id, f, .. }, at| {
                    let found = CheapestFirst { cost: f, id };
                    if at == observation {
                        probed.push(found);
                    } else {
                        ahead.push(found);
                    }
                });
            }
        }
        Ok(End::Done)
    }

    /// Expands the nodes that may lead to a cheaper mapping than the incumbent, the most promising first.
    fn expand_best_first(
        &mut self,
        raising: Option<Raising<'_, 'p>>,
        open: &mut Open,
        costs: &mut KnownCosts,
    ) -> Result<End, Cancelled> {
        let mut raising = raising;
        let n_layers = self.problem.last() as u64;
        let probe_at = |width: u64| width.saturating_mul(n_layers).saturating_mul(PROBE_SHARE);
        let mut probe_width = PROBE_WIDENING;
        let next_look = |raising: &Option<Raising<'_, '_>>, probe_width| {
            let at_once = raising.as_ref().filter(|raising| raising.least_excess == 0.0);
            probe_at(probe_width).min(at_once.map_or(u64::MAX, |raising| raising.after))
        };
        let mut look_at = next_look(&raising, probe_width);
        let Some(mut bucketed_limit) = self.fill_buckets(&mut open.buckets)? else { return Ok(OUT_OF_TIME) };
        while let Some(Reached { id, mut g, f }) = open.buckets.pop() {
            // Of a node that was put in more than once, the cheapest way comes out first.
            if self.nodes.is_closed(id) || f >= self.limit {
                continue;
            }
            let step = self.nodes.step(id);
            if self.abstracted.is_some() {
                match self.raise(id, f, step) {
                    // What was put in before the node was raised comes out before what was put in then, which may be a cheaper way to it.
                    Ok(raised) if raised.f <= f => g = raised.g,
                    Ok(raised) => {
                        open.buckets.push(raised);
                        continue;
                    }
                    Err(interrupted) => return cut_short(interrupted),
                }
            }
            let ways = match self.spend(step.state, &mut open.buckets)? {
                Ok(ways) => ways,
                Err(stopped_by) => return Ok(End::CutShort(stopped_by)),
            };
            self.expand(id, g, step, ways, |found, _| open.buckets.push(found));
            if self.n_expanded < look_at && self.limit >= bucketed_limit / 4.0 {
                continue;
            }
            let is_probe_due = self.n_expanded >= probe_at(probe_width);
            if is_probe_due {
                probe_width *= PROBE_WIDENING;
                let end = self.probe(probe_width / PROBE_WIDENING, open)?;
                if end != End::Done {
                    return Ok(end);
                }
            }
            let is_excess = |excess: f64| excess == 0.0 || (is_probe_due && self.limit >= excess * f);
            let is_raising_due =
                |raising: &mut Raising<'_, '_>| self.n_expanded >= raising.after && is_excess(raising.least_excess);
            if let Some(Raising { abstract_in, .. }) = raising.take_if(is_raising_due) {
                let max_bytes = self.budget.beside(self.size_bytes(&open.buckets)).max_bytes / 2;
                match abstract_in(max_bytes, costs, &mut self.meter) {
                    Ok(abstracted) => self.abstracted = abstracted,
                    Err(interrupted) => return cut_short(interrupted),
                }
            }
            look_at = next_look(&raising, probe_width);
            // What a probe found is not in the buckets, and those for a much higher limit are too wide.
            if is_probe_due || self.limit < bucketed_limit / 4.0 {
                let Some(limit) = self.fill_buckets(&mut open.buckets)? else { return Ok(OUT_OF_TIME) };
                bucketed_limit = limit;
            }
        }
        Ok(End::Done)
    }

    /// Raises the estimate of a node that is about to be expanded as far as the abstraction tells. Gives the node as it is then.
    fn raise(&mut self, id: NodeId, f: f64, step: Position) -> Result<Reached, Interrupted> {
        let Self { nodes, seen, projected, abstracted, space, meter, .. } = self;
        if let Some(abstracted) = abstracted.as_mut().filter(|_| !nodes.is_raised(id)) {
            let (state, observation) = (seen.state(step.state), step.observation as usize);
            let is_exact = abstracted.settle(state, observation, f, meter)?;
            let mut estimate = Estimates { seen, projected, space: &**space }.of(step.state, step.observation);
            estimate.cost_to_go += abstracted.rise(state, observation);
            nodes.raise(id, estimate, is_exact);
        }
        Ok(nodes.get::<ALIKE>(id))
    }

    /// Puts all open nodes into the buckets, and gives the limit that these are for; `None` if there is no time for it.
    fn fill_buckets(&mut self, buckets: &mut Buckets) -> Result<Option<f64>, Cancelled> {
        buckets.reset(self.least_f.min(self.limit), self.limit);
        for node in self.nodes.open::<ALIKE>().filter(|node| node.f < self.limit) {
            match self.meter.spend(1) {
                Signal::Continue => buckets.push(node),
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        Ok(Some(self.limit))
    }

    /// The nodes that are to be expanded.
    fn open(&self) -> impl Iterator<Item = Reached> {
        self.nodes.open::<ALIKE>().filter(|node| node.f < self.limit)
    }

    /// Counts the expansion of a node of `state` that is about to be done, and gives where the ways out are; what ran out, if it may not
    /// be.
    #[expect(clippy::inline_always, reason = "it is done for every expansion")]
    #[inline(always)]
    fn spend(&mut self, state: SeenIdx, buckets: &mut Buckets) -> Result<Result<Range<usize>, StoppedBy>, Cancelled> {
        let ways = self.seen.explored(state).unwrap_or_else(|| self.seen.explore(state, self.space, self.projected));
        match self.meter.spend(1 + 2 * ways.len() as u64) {
            Signal::Cancel => Err(Cancelled),
            Signal::Finish => Ok(Err(StoppedBy::Deadline)),
            Signal::Continue if self.n_expanded < self.unspent_until => Ok(Ok(ways)),
            Signal::Continue => Ok(self.check_budget(buckets).map(|()| ways)),
        }
    }

    /// Looks whether there are expansions left, and memory; gives what there is not.
    #[cold]
    fn check_budget(&mut self, buckets: &mut Buckets) -> Result<(), StoppedBy> {
        /// Most expansions between two looks at the memory.
        const LOOK_EVERY: u64 = 16;
        /// Most ways followed between two looks. Each finds up to one node, and up to two where blocks begin.
        const N_WAYS: u64 = 1 << 10;
        /// Beyond this part of the memory, what grows takes at once what may be left for it: to grow bit by bit, it would be copied.
        const SMALL: usize = 16;
        let n_bytes = self.size_bytes(buckets);
        let found_bytes = self.space.found_bytes();
        if n_bytes + found_bytes > self.budget.max_bytes / SMALL {
            #[expect(clippy::cast_precision_loss, reason = "about")]
            let growth = self.budget.max_bytes as f64 / (n_bytes + found_bytes) as f64;
            self.nodes.make_room(growth);
            self.seen.make_room(growth);
            buckets.make_room(growth);
            self.space.make_room(growth);
        }
        let n_actions = self.problem.model.actions().len() as u64;
        let look_every = (N_WAYS / n_actions.max(1)).clamp(1, LOOK_EVERY);
        self.unspent_until = (self.n_expanded + look_every).min(self.budget.max_expansions);
        if self.n_expanded >= self.budget.max_expansions {
            Err(StoppedBy::MaxExpansions)
        } else if self.budget.is_full(n_bytes, self.space) {
            Err(StoppedBy::Memory)
        } else {
            Ok(())
        }
    }

    /// How much memory this takes, in bytes, without the states that were found.
    fn size_bytes(&self, buckets: &Buckets) -> usize {
        let nodes = self.nodes.size_bytes(self.seen.n_states());
        let abstracted = self.abstracted.as_ref().map_or(0, Abstracted::size_bytes);
        nodes + self.seen.size_bytes() + buckets.size_bytes() + abstracted
    }

    /// Follows the moves out of a node. Calls `found` with each node that is to be expanded to which that gives a cheaper way.
    #[inline]
    fn expand(&mut self, id: NodeId, g: f64, step: Position, ways: Range<usize>, mut found: impl FnMut(Reached, u32)) {
        let Position { state, observation: here, kind } = step;
        let next = here + 1;
        let may_skip = self.recurrence.may_follow(kind, MoveKind::Skip);
        let may_linger = !ALIKE || kind != MoveKind::Skip;
        self.nodes.close(id);
        if here == self.last {
            return self.expand_at_last(id, g, step, ways, found);
        }
        if may_skip {
            let is_near = Nodes::are_together(next);
            let mut block = if is_near { Nodes::block_of(id) } else { self.nodes.find(state, next) };
            if self.nodes.may_take(block, next, g) {
                let kind = MoveKind::Skip;
                let skip = Arrival { kind, observation: next, state, cost: g, parent: id, action: NO_ACTION };
                if let Some(node) = self.take(&mut block, skip) {
                    found(node, next);
                }
            }
        }
        self.n_expanded += 1;
        self.n_generated += u64::from(may_skip) + (1 + u64::from(may_linger)) * ways.len() as u64;
        for way in ways {
            let SeenWay { cost, to: state, action } = self.seen.way(way);
            let cost = g + cost;
            let mut block = self.nodes.find(state, next);
            if self.nodes.may_take(block, next, cost) {
                let kind = MoveKind::Match;
                let arrival = Arrival { kind, observation: next, state, cost, parent: id, action };
                if let Some(node) = self.take(&mut block, arrival) {
                    found(node, next);
                }
            }
            if !may_linger {
                continue;
            }
            if !Nodes::are_together(next) {
                block = self.nodes.find(state, here);
            }
            if self.nodes.may_take(block, here, cost) {
                let kind = MoveKind::Extra;
                let arrival = Arrival { kind, observation: here, state, cost, parent: id, action };
                if let Some(node) = self.take(&mut block, arrival) {
                    found(node, here);
                }
            }
        }
    }

    /// As [`Self::expand`], of a node of the last observation: where ending costs something, extra actions may save some of it.
    #[cold]
    fn expand_at_last(
        &mut self,
        id: NodeId,
        g: f64,
        Position { observation, kind, .. }: Position,
        ways: Range<usize>,
        mut found: impl FnMut(Reached, u32),
    ) {
        self.n_expanded += 1;
        if !self.recurrence.may_follow(kind, MoveKind::Extra) {
            return;
        }
        self.n_generated += ways.len() as u64;
        for way in ways {
            let SeenWay { cost, to: state, action } = self.seen.way(way);
            let cost = g + cost;
            let mut block = self.nodes.find(state, observation);
            if self.nodes.may_take(block, observation, cost) {
                let arrival = Arrival { kind: MoveKind::Extra, observation, state, cost, parent: id, action };
                if let Some(node) = self.take(&mut block, arrival) {
                    found(node, observation);
                }
            }
        }
    }

    /// Takes a cheaper way to a node, if mappings that go on from there are of interest. Gives the node if it is to be expanded: at the
    /// last observation, only where ending costs something, which extra actions may save.
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    fn take(&mut self, block: &mut BlockIdx, arrival: Arrival) -> Option<Reached> {
        let observation = arrival.observation;
        let Self { nodes, seen, projected, space, .. } = self;
        let estimates = Estimates { seen, projected, space: &**space };
        let node = nodes.take::<ALIKE>(block, arrival, &estimates, self.limit)?;
        if observation == self.last && !self.end_at(node.id, node.g, arrival.state) {
            return None;
        }
        Some(node)
    }

    /// Takes note of a mapping that ends here, if it is cheaper. Says whether the node is to be expanded.
    #[cold]
    fn end_at(&mut self, id: NodeId, g: f64, state: SeenIdx) -> bool {
        let cost = g + self.problem.end_cost(self.space.row(self.seen.state(state)));
        if cost < self.limit {
            self.limit = cost * (1.0 - self.rounding);
            self.incumbent = Some(id);
        }
        self.problem.end.is_some()
    }

    fn found(self, end: End) -> Found {
        let nodes = &*self.nodes;
        let first = self.first;
        let is_complete = end == End::Done;
        let open = || self.open().map(|node| node.f).fold(self.limit.min(self.left_out_f), f64::min);
        let least_f = if is_complete { f64::INFINITY } else { open() };
        let path = |id| nodes.path(id, self.seen);
        let paths = if let Some(incumbent) = self.incumbent {
            vec![path(incumbent)]
        } else {
            // The farthest nodes, and among those the most promising: where it is best to go on greedily.
            let observation = |node: &Reached| nodes.step(node.id).observation;
            let farthest = self
                .open()
                .max_by(|node, other| observation(node).cmp(&observation(other)).then(other.f.total_cmp(&node.f)));
            farthest.map(|node| node.id).into_iter().chain([first]).map(path).collect()
        };
        let (n_expanded, n_generated) = (self.n_expanded, self.n_generated);
        Found { paths, is_complete, stopped_by: end.stopped_by(), least_f, n_expanded, n_generated }
    }
}
