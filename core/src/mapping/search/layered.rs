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
mod ways_out;

use super::{End, Found, Move, MoveKind, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::projected::{Estimate, Projected};
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{Model, StateIdx};
use joined::JoinedTables;
use ways_out::{WayOut, WaysOut};

/// How many nodes of each layer the beams expand, one beam after the other.
const BEAM_WIDTHS: [usize; 2] = [1, 8];

const WIDEST_BEAM: usize = BEAM_WIDTHS[BEAM_WIDTHS.len() - 1];

/// Buffers of a search, kept to be used again by searches of the same model.
#[derive(Debug, Default)]
pub(in crate::mapping) struct LayeredBuffers {
    ways_out: WaysOut,
    tables: JoinedTables,
    nodes: LayeredNodes,
}

/// All nodes, observation by observation. Shapes `[n_observations, n_states]`.
#[derive(Debug, Default)]
struct LayeredNodes {
    n_states: usize,
    /// Of the cheapest way that was found, before the distance is paid; infinite if none was.
    costs: Vec<f64>,
    /// How that way ends; means nothing if there is none.
    links: Vec<LastStep>,
    /// Whether a way was found since the node was last expanded.
    are_open: Vec<bool>,
    /// The states of these nodes, by observation.
    open: Vec<Vec<StateIdx>>,
}

/// How the way to a node ends: with an action, numbered as the way out of a state that it goes, or without one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct LastStep(u32);

impl LastStep {
    const START: Self = Self(u32::MAX);
    const SKIP: Self = Self(u32::MAX - 1);

    /// With an action that advances.
    #[inline]
    fn matched(way: usize) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_WAYS")]
        let way = way as u32;
        Self(way << 1)
    }

    /// With an action that does not.
    #[inline]
    fn extra(way: usize) -> Self {
        Self(Self::matched(way).0 | 1)
    }

    #[inline]
    fn kind(self) -> MoveKind {
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

impl LayeredBuffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        let Self { ways_out, tables, nodes } = self;
        ways_out.ways.capacity() * size_of::<WayOut>()
            + ways_out.ends.capacity() * STATE_BYTES
            + tables.kept_bytes()
            + nodes.costs.capacity() * NODE_BYTES
    }
}

/// How much memory a node takes, in bytes: with its place among those that are open, and with the room for more of these.
const NODE_BYTES: usize = size_of::<f64>() + size_of::<LastStep>() + size_of::<bool>() + 2 * size_of::<StateIdx>();

/// How much memory a state takes, in bytes: where its ways end, its classes, and as many distinct ones.
const STATE_BYTES: usize = size_of::<usize>() + size_of::<[u32; 2]>() + 2 * size_of::<Vec<u32>>();

/// How much memory a search takes of `n_nodes` of `model`, in bytes.
pub(in crate::mapping) fn bytes_for(model: &Model, n_nodes: usize) -> usize {
    let ways = model.graph().n_transitions() * size_of::<WayOut>();
    // There are no more than two distinct classes of each state, and an entry of these for each observation.
    let nodes = n_nodes.saturating_mul(NODE_BYTES + 2 * size_of::<Estimate>());
    nodes.saturating_add(ways + model.graph().n_states() * STATE_BYTES)
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

/// Finds the cheapest mapping, if `interrupt` allows, among those of at most `most`, of which there must be one. All that
/// `projected` estimates must be in its columns.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search(
    problem: &Problem<'_>,
    projected: &Projected<'_>,
    budget: Budget,
    most: f64,
    buffers: &mut LayeredBuffers,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let LayeredBuffers { ways_out, tables, nodes } = buffers;
    ways_out.prepare(problem.model, &problem.body);
    tables.prepare(problem, projected);
    nodes.prepare(problem);
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
            let Estimate { distance, cost_to_go } = tables.estimate(tables.at(0), *state);
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
        let entries = self.tables.at(observation);
        let costs = &self.nodes.costs[observation * self.nodes.n_states..];
        let mut least = [f64::INFINITY; WIDEST_BEAM];
        let least = &mut least[..width];
        for &state in &self.nodes.open[observation] {
            let Estimate { distance, cost_to_go } = self.tables.estimate(entries, state);
            note(least, costs[state as usize] + distance + cost_to_go);
        }
        self.limit.min(least[width - 1].next_up())
    }

    /// Expands the open nodes of a layer that may be on a mapping of less than `limit`, and those to which they lead by actions that do
    /// not advance, but not many more than `width`.
    fn expand(&mut self, observation: usize, limit: f64, width: usize) -> Result<End, Cancelled> {
        let entries = self.tables.at(observation);
        let LayeredNodes { n_states, costs, links, are_open, open } = &mut *self.nodes;
        let n_states = *n_states;
        let of_both = observation * n_states..(observation + 2) * n_states;
        let (costs, next_costs) = costs[of_both.clone()].split_at_mut(n_states);
        let (links, next_links) = links[of_both.clone()].split_at_mut(n_states);
        let (are_open, are_next_open) = are_open[of_both].split_at_mut(n_states);
        let Ok([open, next_open]) = open.get_disjoint_mut([observation, observation + 1]) else {
            return Ok(End::Done);
        };
        let mut n_left = width.saturating_add(width / 2);
        let mut n_kept = 0;
        let mut at = 0;
        while let Some(&state) = open.get(at) {
            at += 1;
            let estimate = self.tables.estimate(entries, state);
            let kind = links[state as usize].kind();
            // No kind pays another part.
            let before = costs[state as usize] + estimate.distance;
            let f = before + estimate.cost_to_go;
            if f >= limit || n_left == 0 {
                // It stays open for a wider beam, if it is of interest then.
                let is_kept = f < self.limit;
                are_open[state as usize] = is_kept;
                open[n_kept] = state;
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
            are_open[state as usize] = false;
            let recurrence = Recurrence::default();
            let may_skip = recurrence.may_follow(kind, MoveKind::Skip);
            let may_linger = recurrence.may_follow(kind, MoveKind::Extra);
            self.n_expanded += 1;
            self.n_generated += u64::from(may_skip) + (1 + u64::from(may_linger)) * ways.len() as u64;
            let mut advance = |to: StateIdx, cost: f64, link: LastStep| {
                let known = &mut next_costs[to as usize];
                if cost < *known {
                    *known = cost;
                    next_links[to as usize] = link;
                    if !std::mem::replace(&mut are_next_open[to as usize], true) {
                        next_open.push(to);
                    }
                }
            };
            if may_skip {
                advance(state, before, LastStep::SKIP);
            }
            for (number, &WayOut { cost, to, .. }) in (first_way..).zip(ways) {
                let cost = before + cost;
                advance(to, cost, LastStep::matched(number));
                if may_linger && cost < costs[to as usize] {
                    costs[to as usize] = cost;
                    links[to as usize] = LastStep::extra(number);
                    if !std::mem::replace(&mut are_open[to as usize], true) {
                        open.push(to);
                    }
                }
            }
        }
        open.truncate(n_kept);
        Ok(End::Done)
    }

    /// What mappings cost at least, of those that were not found: they lead through open nodes.
    fn least_f(&self) -> f64 {
        let LayeredNodes { n_states, costs, are_open, open, .. } = &*self.nodes;
        let fs = (0..=self.last).flat_map(|observation| {
            let entries = self.tables.at(observation);
            let open = open[observation].iter().map(move |state| (*state, observation * n_states + *state as usize));
            // A list that was not gone through to the end may name some that are not open any more.
            open.filter(|(_, at)| are_open[*at]).map(move |(state, at)| {
                let Estimate { distance, cost_to_go } = self.tables.estimate(entries, state);
                costs[at] + distance + cost_to_go
            })
        });
        fs.fold(self.limit, f64::min)
    }

    /// Looks for a cheaper mapping among the nodes of the last layer that were reached.
    fn end(&mut self) {
        let entries = self.tables.at(self.last);
        let LayeredNodes { n_states, costs, are_open, open, .. } = &mut *self.nodes;
        for state in open[self.last].drain(..) {
            let at = self.last * *n_states + state as usize;
            are_open[at] = false;
            let cost = costs[at] + self.tables.estimate(entries, state).distance;
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

impl LayeredNodes {
    /// Forgets all nodes but the start states'.
    fn prepare(&mut self, problem: &Problem<'_>) {
        let n_observations = problem.demonstration.len();
        self.n_states = problem.model.graph().n_states();
        let n_nodes = n_observations * self.n_states;
        self.costs.clear();
        self.costs.resize(n_nodes, f64::INFINITY);
        self.are_open.clear();
        self.are_open.resize(n_nodes, false);
        self.links.resize(n_nodes.max(self.links.len()), LastStep::START);
        self.open.iter_mut().for_each(Vec::clear);
        self.open.resize_with(n_observations.max(self.open.len()), Vec::new);

        for start in problem.starts.states() {
            self.costs[*start as usize] = 0.0;
            self.links[*start as usize] = LastStep::START;
            self.are_open[*start as usize] = true;
            self.open[0].push(*start);
        }
    }

    /// The way of `ways_out` from the start to a node.
    fn path(&self, ways_out: &WaysOut, mut observation: usize, mut state: StateIdx) -> Vec<Move> {
        let mut moves = Vec::with_capacity(2 * observation + 1);
        loop {
            let link = self.links[observation * self.n_states + state as usize];
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
