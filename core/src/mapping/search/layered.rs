//! Small problems, layer by layer.
//!
//! A node leads to others of its observation and of the next. So layers can be expanded one after the other, and need no order within:
//!
//! 1. *Beams* of growing width ([`BEAM_WIDTHS`]) go through the layers and expand, of each, no more than the open nodes that promise
//!    most. They come to a mapping, whose cost is the limit from then on; where estimates are good, no open node is left below it.
//! 2. At last, all nodes are expanded that may be on a cheaper mapping.
//!
//! What one pass has expanded the next ones do not expand again, unless they come to it more cheaply (Vadlamudi, Gaurav, Aine &
//! Chakrabarti 2012, "Anytime Column Search"). These are the nodes that A* expands, and some more, as the limit is a little
//! above the optimum in the last pass. But there is no open list to keep in order, and nodes are found without an index: an
//! expansion takes less than half of the time that it takes [`best_first`](super::best_first): figure 4 takes that 1.8 times as long. In larger problems beams miss the
//! optimum by more, and there are too many nodes for each to have a place.
//!
//! Ways to a node are compared before they pay its distance, and none goes on from the last observation. So it is for problems in which
//! all moves pay the same part of a distance, and ending is free.

mod joined;
mod nodes;
mod ways_out;

use super::{End, Found, MoveKind, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Interrupted, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::projected::{Estimate, LayerTables, TableRoom};
use crate::mapping::heuristic::projection::Projections;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{Model, StateIdx};
use joined::JoinedTables;
use nodes::{LastStep, Layer, LayeredNodes, Node};
use ways_out::{WayOut, WaysOut};

/// How many nodes of each layer the beams expand, one beam after the other.
const BEAM_WIDTHS: [usize; 2] = [1, 8];

const WIDEST_BEAM: usize = BEAM_WIDTHS[BEAM_WIDTHS.len() - 1];

/// Buffers of a search, kept to be used again by searches of the same model.
#[derive(Debug, Default)]
pub(in crate::mapping) struct LayeredBuffers {
    /// The estimates, which are solved before a search.
    pub(in crate::mapping) estimates: LayerTables,
    tables: JoinedTables,
    ways_out: WaysOut,
    nodes: LayeredNodes,
}

impl LayeredBuffers {
    /// Solves the estimates for `problem`, in which ending must be free. Says whether all have tables, in time.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(in crate::mapping) fn solve(
        &mut self,
        projections: &Projections,
        problem: &Problem<'_>,
        room: TableRoom,
        interrupt: &mut dyn Interrupt,
    ) -> Result<bool, Cancelled> {
        match self.estimates.solve(projections, problem, room, &mut Meter::new(interrupt, POLL_EVERY)) {
            Ok(are_solved) => Ok(are_solved),
            Err(Interrupted::OutOfTime) => Ok(false),
            Err(Interrupted::Cancelled(cancelled)) => Err(cancelled),
        }
    }

    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        let Self { estimates, tables, ways_out, nodes } = self;
        estimates.kept_bytes()
            + tables.kept_bytes()
            + ways_out.ways.capacity() * size_of::<WayOut>()
            + ways_out.ends.capacity() * STATE_BYTES
            + nodes.kept_bytes()
    }
}

/// About how much memory a node takes, in bytes: with its place among those that are open, with the room for more of these, and with its part
/// of the sums of estimates.
const NODE_BYTES: usize = 53;
const _: () = assert!(size_of::<f64>() + size_of::<Node>() + 2 * size_of::<StateIdx>() <= NODE_BYTES);

/// How much memory a state takes, in bytes: where its ways end, its classes, and as many distinct ones.
const STATE_BYTES: usize = 64;
const _: () = assert!(size_of::<usize>() + size_of::<[u32; 2]>() <= STATE_BYTES);

/// How much memory a search takes of `n_nodes` of `model`, in bytes.
pub(in crate::mapping) fn bytes_for(model: &Model, n_nodes: usize) -> usize {
    let ways = model.graph().n_transitions() * size_of::<WayOut>();
    n_nodes.saturating_mul(NODE_BYTES).saturating_add(ways + model.graph().n_states() * STATE_BYTES)
}

/// Most transitions of a model: their copies take 6 MB.
const MAX_WAYS: usize = 1 << 18;

/// Whether `n_nodes` of `problem`, its states at so many observations, may be searched: its moves are such, there is memory for all of them
/// beside tables, and each may be expanded and expanded again.
pub(in crate::mapping) fn is_within(budget: Budget, problem: &Problem<'_>, n_nodes: usize) -> bool {
    let model = problem.model;
    let attributes = 0..model.schema().len();
    let n_values = |position| model.states().domain(position).len() as u128;
    // So that the values of a state are one number.
    let are_countable = attributes.map(n_values).try_fold(1, u128::checked_mul).is_some();
    problem.recurrence().pays_alike()
        && problem.end.is_none()
        && model.graph().n_transitions() <= MAX_WAYS
        && are_countable
        && bytes_for(model, n_nodes) <= budget.max_bytes / 2
        && 2 * n_nodes as u64 <= budget.max_expansions
}

/// Finds the cheapest mapping, if `interrupt` allows, among those of at most `most`, of which there must be one. The estimates of `buffers` must be
/// solved for `problem`.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search(
    problem: &Problem<'_>,
    budget: Budget,
    most: f64,
    buffers: &mut LayeredBuffers,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let LayeredBuffers { estimates, tables, ways_out, nodes } = buffers;
    ways_out.prepare(problem.model, &problem.body);
    tables.prepare(problem.model, estimates, problem.demonstration.len());
    nodes.prepare(problem, tables.at(0));
    let mut search = Search {
        last: problem.last(),
        ways_out,
        tables,
        nodes,
        limit: most.next_up(),
        rounding: rounding_of_sums(problem.demonstration.len()),
        cheapest: None,
        budget,
        n_expanded: 0,
        n_generated: 0,
        meter: Meter::new(interrupt, POLL_EVERY),
    };
    let mut end = End::Done;
    for width in BEAM_WIDTHS.into_iter().chain([usize::MAX]) {
        if end == End::Done {
            end = search.go_through(width)?;
        }
    }
    let is_complete = end == End::Done;
    let least_f = if is_complete { f64::INFINITY } else { search.least_f() };
    let Search { cheapest, n_expanded, n_generated, .. } = search;
    let most_promising = || {
        let f = |state: &StateIdx| {
            let Estimate { distance, cost_to_go } = nodes.nodes[*state as usize].estimate;
            distance + cost_to_go
        };
        let starts = problem.starts.states().iter().copied();
        starts.min_by(|state, other| f(state).total_cmp(&f(other))).unwrap_or_default()
    };
    let path = match cheapest {
        Some(state) => nodes.path(ways_out, problem.last(), state),
        None => nodes.path(ways_out, 0, most_promising()),
    };
    Ok(Found { paths: vec![path], is_complete, stopped_by: end.stopped_by(), least_f, n_expanded, n_generated })
}

struct Search<'s> {
    /// The last observation.
    last: usize,
    ways_out: &'s WaysOut,
    tables: &'s JoinedTables,
    nodes: &'s mut LayeredNodes,
    /// Mappings of this cost or more are of no interest.
    limit: f64,
    /// Relative tolerance: mappings that are cheaper by less are not searched for.
    rounding: f64,
    /// The last state of the cheapest mapping that was found.
    cheapest: Option<StateIdx>,
    budget: Budget,
    n_expanded: u64,
    n_generated: u64,
    meter: Meter<'s>,
}

impl Search<'_> {
    /// Goes through the layers from the first to the last, and expands about as many nodes of each as `width` says.
    fn go_through(&mut self, width: usize) -> Result<End, Cancelled> {
        for observation in 0..self.last {
            let limit = if width <= WIDEST_BEAM { self.limit_of_beam(observation, width) } else { self.limit };
            let end = self.expand(observation, limit, width)?;
            if end != End::Done {
                return Ok(end);
            }
        }
        self.end();
        Ok(End::Done)
    }

    /// What mappings must cost less than for no more than `width` of the open nodes of a layer to be expanded, equals aside.
    fn limit_of_beam(&self, observation: usize, width: usize) -> f64 {
        let first = observation * self.nodes.n_states;
        let (costs, nodes) = (&self.nodes.costs[first..], &self.nodes.nodes[first..]);
        let mut least = [f64::INFINITY; WIDEST_BEAM];
        let least = &mut least[..width];
        for &state in &self.nodes.open[observation] {
            note(least, nodes[state as usize].f(costs[state as usize]));
        }
        self.limit.min(least[width - 1].next_up())
    }

    /// Expands the open nodes of a layer that may be on a mapping of less than `limit`, and those to which they lead by actions that do
    /// not advance, but not many more than `width`.
    fn expand(&mut self, observation: usize, limit: f64, width: usize) -> Result<End, Cancelled> {
        let estimates = self.tables.at(observation);
        let next_estimates = self.tables.at(observation + 1);
        let LayeredNodes { n_states, costs, nodes, open } = &mut *self.nodes;
        let of_both = observation * *n_states..(observation + 2) * *n_states;
        let (costs, next_costs) = costs[of_both.clone()].split_at_mut(*n_states);
        let (nodes, next_nodes) = nodes[of_both].split_at_mut(*n_states);
        let Ok([open, next_open]) = open.get_disjoint_mut([observation, observation + 1]) else {
            return Ok(End::Done);
        };
        let mut here = Layer { costs, nodes, estimates, open };
        let mut next = Layer { costs: next_costs, nodes: next_nodes, estimates: next_estimates, open: next_open };
        let mut n_left = width.saturating_add(width / 2);
        let mut n_kept = 0;
        let mut at = 0;
        while let Some(&state) = here.open.get(at) {
            at += 1;
            let node = &mut here.nodes[state as usize];
            let kind = node.link.kind();
            // No kind pays another part.
            let cost = here.costs[state as usize];
            let before = cost + node.estimate.distance;
            let f = node.f(cost);
            if f >= limit || n_left == 0 {
                // It stays open for a wider beam, if it is of interest then.
                let is_kept = f < self.limit;
                node.is_open = is_kept;
                here.open[n_kept] = state;
                n_kept += usize::from(is_kept);
                continue;
            }
            let (first_way, ways) = self.ways_out.ways(state);
            match self.meter.spend(1 + 2 * ways.len() as u64) {
                Signal::Continue if self.n_expanded < self.budget.max_expansions => {}
                Signal::Continue => return Ok(End::CutShort(StoppedBy::MaxExpansions)),
                Signal::Finish => return Ok(End::CutShort(StoppedBy::Deadline)),
                Signal::Cancel => return Err(Cancelled),
            }
            n_left -= 1;
            node.is_open = false;
            let recurrence = Recurrence::default();
            let may_skip = recurrence.may_follow(kind, MoveKind::Skip);
            let may_linger = recurrence.may_follow(kind, MoveKind::Extra);
            self.n_expanded += 1;
            self.n_generated += u64::from(may_skip) + (1 + u64::from(may_linger)) * ways.len() as u64;
            if may_skip {
                next.reach(state, before, LastStep::SKIP);
            }
            for (number, &WayOut { cost, to, .. }) in (first_way..).zip(ways) {
                let cost = before + cost;
                next.reach(to, cost, LastStep::matched(number));
                if may_linger {
                    here.reach(to, cost, LastStep::extra(number));
                }
            }
        }
        here.open.truncate(n_kept);
        Ok(End::Done)
    }

    /// What mappings cost at least, of those that were not found: they lead through open nodes.
    fn least_f(&self) -> f64 {
        let LayeredNodes { n_states, costs, nodes, open } = &*self.nodes;
        let fs = (0..=self.last).flat_map(|observation| {
            let open = open[observation].iter().map(move |state| observation * n_states + *state as usize);
            // A list that was not gone through to the end may name some that are not open any more.
            open.filter(|at| nodes[*at].is_open).map(|at| nodes[at].f(costs[at]))
        });
        fs.fold(self.limit, f64::min)
    }

    /// Looks for a cheaper mapping among the nodes of the last layer that were reached.
    fn end(&mut self) {
        let LayeredNodes { n_states, costs, nodes, open } = &mut *self.nodes;
        for state in open[self.last].drain(..) {
            let at = self.last * *n_states + state as usize;
            nodes[at].is_open = false;
            let cost = costs[at] + nodes[at].estimate.distance;
            if cost < self.limit {
                self.limit = cost * (1.0 - self.rounding);
                self.cheapest = Some(state);
            }
        }
    }
}

/// Notes `f` if it is among the least, which are sorted.
pub(super) fn note(least: &mut [f64], f: f64) {
    let Some(last) = least.last_mut().filter(|last| f < **last) else { return };
    *last = f;
    for at in (1..least.len()).rev() {
        if least[at - 1] <= least[at] {
            break;
        }
        least.swap(at - 1, at);
    }
}
