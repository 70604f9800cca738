//! Larger problems, layer by layer, in bands of `f`.
//!
//! As in a search of [small problems](super::layered), the layers are gone through from the first to the last, and there is no open list to
//! keep in order: an expansion takes two thirds of the time that it takes [`best_first`](super::best_first). But states are numbered as the search
//! comes to them, as there are too many for each node to have a place; and where beams miss the optimum by much, a last pass over all that is
//! below the limit would expand several times as many nodes as it must. So
//!
//! 1. *beams* ([`BEAM_WIDTHS`]) come to a mapping, whose cost is the limit from then on;
//! 2. in passes, all nodes are expanded whose `f` is below a *bound*, which grows from pass to pass ([`GROWTH`]). What is above it waits. The
//!    first pass whose bound is not below the optimum finds it, and as much as its bound is above that, it expands more nodes than
//!    A* does.
//!
//! What was expanded is not expanded again, unless it is come to more cheaply, which only actions that do not advance can lead to.
//!
//! Ways to a node are compared before they pay its distance, and none goes on from the last observation. So it is for problems in which
//! all moves pay the same part of a distance, and ending is free.

mod layer;
mod passed;
mod tables;

use super::layered::note;
use super::{End, Found, Move, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::Heuristic as _;
use crate::mapping::heuristic::projected::{Estimate, Projected};
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{Model, Space, StateIdx};
use layer::{Layer, Node, Stage};
use passed::{Passed, PassedIdx, PassedWay};

/// How many nodes of each layer the beams expand, one beam after the other.
const BEAM_WIDTHS: [usize; 2] = [1, 8];

const WIDEST_BEAM: usize = BEAM_WIDTHS[BEAM_WIDTHS.len() - 1];

/// How many times as much as the one before it a pass may cost. The nodes below a bound are about its fourth power.
const GROWTH: f64 = 1.06;

/// A pass goes at least so many parts of the limit farther than the one before, so that there are not many.
const LEAST_PART: f64 = 64.0;

/// Most layers. In each, there is a place for every state that the search comes to in any, and most states are in few layers of a long
/// demonstration.
const MAX_LAYERS: usize = 256;

/// Most expansions between two looks at the memory,
const LOOK_EVERY: u64 = 16;

/// and most ways followed. Each finds up to two nodes.
const N_WAYS: u64 = 1 << 10;

/// Buffers of a search, kept to be used again by searches of the same model.
#[derive(Debug, Default)]
pub(in crate::mapping) struct BandedBuffers {
    passed: Passed,
    layers: Vec<Layer>,
}

impl BandedBuffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        self.passed.kept_bytes()
            + self.layers.iter().map(|layer| size_of::<Layer>() + layer.kept_bytes()).sum::<usize>()
    }
}

/// About how much memory a search of `model` takes at most, in bytes, besides tables, if it finds every node at so many observations.
pub(in crate::mapping) fn most_bytes(model: &Model, n_observations: usize) -> usize {
    let (n_states, n_nodes) = (model.graph().n_states(), model.graph().n_states().saturating_mul(n_observations));
    let passed = Passed::bytes_for(n_states, model.graph().n_transitions(), model.schema().len(), n_observations);
    n_nodes.saturating_mul(Layer::PLACE_BYTES).saturating_add(passed)
}

/// Whether a problem can be searched so, with these estimates.
pub(in crate::mapping) fn is_for(problem: &Problem<'_>, projected: &Projected<'_>) -> bool {
    let is_small =
        problem.demonstration.len() <= MAX_LAYERS && projected.changing_columns().len() <= tables::MAX_COLUMNS;
    problem.recurrence().pays_alike() && problem.end.is_none() && projected.are_all_in_columns() && is_small
}

/// Finds the cheapest mapping, as far as `budget` allows, among those of at most `most`, of which there must be one, of a problem that this
/// [is for](is_for).
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search<S: Space>(
    problem: &Problem<'_>,
    space: &mut S,
    projected: &Projected<'_>,
    budget: Budget,
    most: f64,
    buffers: &mut BandedBuffers,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let BandedBuffers { passed, layers } = buffers;
    let n_observations = problem.demonstration.len();
    passed.prepare(space, problem, projected);
    layers.iter_mut().for_each(Layer::clear);
    if layers.len() < n_observations {
        layers.resize_with(n_observations, Layer::default);
    }
    let mut search = Search {
        problem,
        space,
        projected,
        budget,
        passed,
        layers,
        limit: most.next_up(),
        first: 0,
        least_f: 0.0,
        left_out_f: f64::INFINITY,
        cheapest: None,
        n_expanded: 0,
        n_generated: 0,
        unspent_until: 0,
        look_every: (N_WAYS / (problem.model.actions().len() as u64).max(1)).clamp(1, LOOK_EVERY),
        last: problem.last(),
        rounding: rounding_of_sums(n_observations),
        meter: Meter::new(interrupt, POLL_EVERY),
    };
    let end = search.run()?;
    Ok(search.found(end))
}

struct Search<'s, S> {
    problem: &'s Problem<'s>,
    space: &'s mut S,
    projected: &'s Projected<'s>,
    budget: Budget,
    passed: &'s mut Passed,
    layers: &'s mut Vec<Layer>,
    /// Mappings of this cost or more are of no interest.
    limit: f64,
    /// The most promising start.
    first: PassedIdx,
    /// No node's `f` is less.
    least_f: f64,
    /// No `f` of a start that is not yet among the nodes is less.
    left_out_f: f64,
    /// The last state of the cheapest mapping that was found.
    cheapest: Option<PassedIdx>,
    n_expanded: u64,
    n_generated: u64,
    /// The budget lasts at least until so many nodes are expanded.
    unspent_until: u64,
    /// Expansions between two looks at the memory.
    look_every: u64,
    /// The last observation.
    last: usize,
    /// Relative tolerance: mappings that are cheaper by less are not searched for.
    rounding: f64,
    meter: Meter<'s>,
}

impl<S: Space> Search<'_, S> {
    fn run(&mut self) -> Result<End, Cancelled> {
        self.start();
        for width in BEAM_WIDTHS {
            for observation in 0..self.last {
                let limit = self.limit_of_beam(observation, width);
                let end = self.expand(observation, limit, width + width / 2)?;
                if end != End::Done {
                    return Ok(end);
                }
            }
            self.end();
        }
        let end = self.start_in_others()?;
        if end != End::Done {
            return Ok(end);
        }
        let mut bound = self.least_f;
        loop {
            let least_growth = if self.limit < f64::INFINITY { self.limit / LEAST_PART } else { 0.0 };
            let grown = (bound * GROWTH).max(bound + least_growth);
            bound = if grown > bound { grown.min(self.limit) } else { self.limit };
            for observation in 0..self.last {
                let end = self.expand(observation, bound.min(self.limit), usize::MAX)?;
                if end != End::Done {
                    return Ok(end);
                }
            }
            self.end();
            if bound >= self.limit {
                return Ok(End::Done);
            }
        }
    }

    /// Takes the most promising start, whatever it costs.
    fn start(&mut self) {
        let starts = self.problem.starts.states();
        let f: Vec<f64> = starts.iter().map(|state| self.start_f(*state)).collect();
        // The first among equals.
        let best = (0..starts.len()).min_by(|n, other| f[*n].total_cmp(&f[*other])).unwrap_or(0);
        let others = f.iter().enumerate().filter(|(n, _)| *n != best).map(|(_, f)| *f);
        self.left_out_f = others.fold(f64::INFINITY, f64::min);
        self.least_f = f[best];
        self.first = self.take_start(starts[best]);
        if f[best] >= self.limit {
            // It is what is left to complete if nothing is of interest.
            self.layers[0].open.clear();
        }
        self.end();
    }

    /// Takes the starts but for the most promising one, as far as they are of interest.
    fn start_in_others(&mut self) -> Result<End, Cancelled> {
        let starts = self.problem.starts.states();
        if starts.len() > 1 {
            for (n, state) in starts.iter().enumerate() {
                match self.meter.spend(1) {
                    Signal::Continue => {}
                    Signal::Finish => {
                        let left = starts[n..].iter().map(|state| self.start_f(*state));
                        self.left_out_f = left.fold(f64::INFINITY, f64::min);
                        return Ok(End::CutShort(StoppedBy::Deadline));
                    }
                    Signal::Cancel => return Err(Cancelled),
                }
                if self.start_f(*state) < self.limit {
                    self.take_start(*state);
                }
            }
            self.end();
        }
        self.left_out_f = f64::INFINITY;
        Ok(End::Done)
    }

    /// What a mapping that begins in a state costs at least.
    fn start_f(&self, state: StateIdx) -> f64 {
        let row = self.space.row(state);
        self.problem.distances.distance(0, row) + self.projected.cost_to_go(0, row)
    }

    fn take_start(&mut self, state: StateIdx) -> PassedIdx {
        let state = self.passed.number_of(state, self.space, self.projected);
        self.layers[0].make_places(self.passed.len());
        self.layers[0].reach(state, 0.0, state, MoveKind::Start, NO_ACTION);
        state
    }

    /// What mappings must cost less than for no more than `width` of the open nodes of a layer to be expanded, equals aside.
    fn limit_of_beam(&self, observation: usize, width: usize) -> f64 {
        let layer = &self.layers[observation];
        let mut least = [f64::INFINITY; WIDEST_BEAM];
        let least = &mut least[..width];
        for &state in &layer.open {
            let Estimate { distance, cost_to_go } = self.passed.estimate(state, observation);
            note(least, layer.nodes[state as usize].cost + distance + cost_to_go);
        }
        self.limit.min(least[width - 1].next_up())
    }

    /// Expands the open nodes of a layer that may be on a mapping of less than `bound`, and those to which they lead by actions that do
    /// not advance, but no more than `most`. The others stay open, or wait if `most` is all.
    fn expand(&mut self, observation: usize, bound: f64, most: usize) -> Result<End, Cancelled> {
        let Self { space, projected, budget, passed, layers, last, meter, .. } = self;
        let recurrence = Recurrence::default();
        let limit = self.limit;
        let n_layers = *last + 1;
        let Ok([here, next]) = layers.get_disjoint_mut([observation, observation + 1]) else { return Ok(End::Done) };
        here.make_places(passed.len());
        next.make_places(passed.len());
        here.open_waiting(bound, limit);
        let (mut n_left, mut n_kept, mut at) = (most, 0, 0);
        while let Some(&state) = here.open.get(at) {
            at += 1;
            let node = &mut here.nodes[state as usize];
            let Estimate { distance, cost_to_go } = passed.estimate(state, observation);
            // No kind pays another part.
            let g = node.cost + distance;
            let f = g + cost_to_go;
            if f >= bound || n_left == 0 {
                if f >= limit {
                    node.stage = Stage::Closed;
                } else if most == usize::MAX {
                    here.wait(state, f);
                } else {
                    here.open[n_kept] = state;
                    n_kept += 1;
                }
                continue;
            }
            let kind = node.kind;
            let ways = if let Some(ways) = passed.explored(state) {
                ways
            } else {
                let ways = passed.explore(state, *space, projected);
                here.make_places(passed.len());
                next.make_places(passed.len());
                ways
            };
            match meter.spend(1 + 2 * ways.len() as u64) {
                Signal::Continue => {}
                Signal::Finish => return Ok(End::CutShort(StoppedBy::Deadline)),
                Signal::Cancel => return Err(Cancelled),
            }
            if self.n_expanded >= self.unspent_until {
                let n_bytes = passed.size_bytes() + passed.len() * n_layers * Layer::PLACE_BYTES;
                if self.n_expanded >= budget.max_expansions {
                    return Ok(End::CutShort(StoppedBy::MaxExpansions));
                }
                if budget.is_full(n_bytes, *space) {
                    return Ok(End::CutShort(StoppedBy::Memory));
                }
                self.unspent_until = (self.n_expanded + self.look_every).min(budget.max_expansions);
            }
            n_left -= 1;
            here.nodes[state as usize].stage = Stage::Closed;
            let may_skip = recurrence.may_follow(kind, MoveKind::Skip);
            let may_linger = recurrence.may_follow(kind, MoveKind::Extra);
            self.n_expanded += 1;
            self.n_generated += u64::from(may_skip) + (1 + u64::from(may_linger)) * ways.len() as u64;
            if may_skip {
                next.reach(state, g, state, MoveKind::Skip, NO_ACTION);
            }
            for &PassedWay { cost, to, action } in passed.ways(ways) {
                let cost = g + cost;
                next.reach(to, cost, state, MoveKind::Match, action);
                if may_linger {
                    here.reach(to, cost, state, MoveKind::Extra, action);
                }
            }
        }
        here.open.truncate(n_kept);
        Ok(End::Done)
    }

    /// Looks for a cheaper mapping among the nodes of the last layer that were reached.
    fn end(&mut self) {
        let Layer { nodes, open, .. } = &mut self.layers[self.last];
        for state in open.drain(..) {
            let node = &mut nodes[state as usize];
            node.stage = Stage::Closed;
            let cost = node.cost + self.passed.estimate(state, self.last).distance;
            if cost < self.limit {
                self.limit = cost * (1.0 - self.rounding);
                self.cheapest = Some(state);
            }
        }
    }

    fn found(self, end: End) -> Found {
        let is_complete = end == End::Done;
        let least_f =
            if is_complete { f64::INFINITY } else { self.open_f().fold(self.limit.min(self.left_out_f), f64::min) };
        let path = match self.cheapest {
            Some(state) => self.path(self.last, state),
            None => self.path(0, self.first),
        };
        let (n_expanded, n_generated) = (self.n_expanded, self.n_generated);
        Found { paths: vec![path], is_complete, stopped_by: end.stopped_by(), least_f, n_expanded, n_generated }
    }

    /// What mappings through nodes cost at least that were not expanded.
    fn open_f(&self) -> impl Iterator<Item = f64> {
        self.layers[..=self.last].iter().enumerate().flat_map(move |(observation, layer)| {
            let nodes = layer.found.iter().map(|state| (*state, &layer.nodes[*state as usize]));
            let left = nodes.filter(|(_, node)| node.stage != Stage::Closed);
            left.map(move |(state, node)| {
                let Estimate { distance, cost_to_go } = self.passed.estimate(state, observation);
                node.cost + distance + cost_to_go
            })
        })
    }

    /// The way from the start to a node.
    fn path(&self, mut observation: usize, mut state: PassedIdx) -> Vec<Move> {
        let mut moves = Vec::with_capacity(2 * observation + 1);
        loop {
            let Node { parent, action, kind, .. } = self.layers[observation].nodes[state as usize];
            let action = (action != NO_ACTION).then_some(action);
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            moves.push(Move { kind, action, observation: observation as u32, state: self.passed.state(state) });
            match kind {
                MoveKind::Start => break,
                MoveKind::Extra => {}
                MoveKind::Match | MoveKind::Skip => observation -= 1,
            }
            state = parent;
        }
        moves.reverse();
        moves
    }
}
