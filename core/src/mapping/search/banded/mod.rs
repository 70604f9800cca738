//! Larger problems, layer by layer, in bands of `f`.
//!
//! As in a search of [small problems](super::layered), the layers are gone through from the first to the last, and there is no open list to
//! keep in order: an expansion takes half of the time that it takes [`best_first`](super::best_first). But states are numbered as the search
//! comes to them, as there are too many for each node to have a place; and where beams miss the optimum by much, a last pass over all that is
//! below the limit would expand several times as many nodes as it must. So
//!
//! 1. *beams* ([`BEAM_WIDTHS`]) come to a mapping, whose cost is the limit from then on;
//! 2. what lies between the least `f` and the limit is divided into [bands](Bands), and pass by pass, all nodes of the next band are
//!    expanded. Those of higher bands wait. The pass of the band that the optimum is in finds it, and expands all nodes of this band: that
//!    many more than A* does.
//!
//! What was expanded is not expanded again, unless it is come to more cheaply, which only actions that do not advance can lead to.
//!
//! Ways to a node are compared before they pay its distance, and none goes on from the last observation. So it is for problems in which
//! all moves pay the same part of a distance, and ending is free.

mod bands;
mod expansions;
mod layer;
mod passed;
mod tables;

use super::{End, Found, Move, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::cost::rounding_of_sums;
use crate::mapping::heuristic::Heuristic as _;
use crate::mapping::heuristic::projected::{Estimate, Projected};
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{Model, Space, StateIdx};
use bands::Bands;
use expansions::Chosen;
use layer::{Layer, Link, Stage};
use passed::{Passed, PassedIdx};

/// How many nodes of each layer the beams expand, one beam after the other.
const BEAM_WIDTHS: [usize; 2] = [1, 8];

/// Most bands between the least `f` and the limit that the beams leave. In short demonstrations, there are as many as observations, as a pass
/// may take as long as what it saves.
const MOST_BANDS: usize = 64;

/// Most layers. In each, there is a place for every state that the search comes to in any, and most states are in few layers of a long
/// demonstration.
const MAX_LAYERS: usize = 256;

/// Most expansions between two looks at the memory,
const LOOK_EVERY: usize = 16;

/// and most ways followed. Each finds up to two nodes.
const N_WAYS: usize = 1 << 10;

/// Buffers of a search, kept to be used again by searches of the same model.
#[derive(Debug, Default)]
pub(in crate::mapping) struct BandedBuffers {
    passed: Passed,
    layers: Vec<Layer>,
    chosen: Vec<Chosen>,
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
    let BandedBuffers { passed, layers, chosen } = buffers;
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
        chosen,
        limit: most.next_up(),
        bands: Bands::between(0.0, 0.0, 1),
        first: 0,
        least_f: 0.0,
        left_out_f: f64::INFINITY,
        cheapest: None,
        n_expanded: 0,
        n_generated: 0,
        n_metered: 0,
        look_every: (N_WAYS / problem.model.actions().len().max(1)).clamp(1, LOOK_EVERY),
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
    /// Nodes of a layer that are expanded together.
    chosen: &'s mut Vec<Chosen>,
    /// Mappings of this cost or more are of no interest.
    limit: f64,
    bands: Bands,
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
    /// How many of both the meter knows of.
    n_metered: u64,
    /// Most expansions between two looks at the budget.
    look_every: usize,
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
                let end = self.expand_best(observation, width)?;
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
        self.bands = Bands::between(self.least_f, self.limit, MOST_BANDS.min(self.last));
        let n_bands = self.bands.of(self.limit, 0) + 1;
        self.layers[..=self.last].iter_mut().for_each(|layer| layer.make_bands(n_bands));
        let mut band = 0;
        while band <= self.bands.of(self.limit, 0) {
            for observation in 0..self.last {
                let end = self.expand(observation, band)?;
                if end != End::Done {
                    return Ok(end);
                }
            }
            self.end();
            band += 1;
        }
        Ok(End::Done)
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
            self.layers[0].close_fresh(|_, _| {});
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
        let layer = &mut self.layers[0];
        let mut reaching = layer.reaching(self.passed.len(), 1);
        reaching.reach(state, 0.0, Link::new(state, NO_ACTION, MoveKind::Start));
        layer.n_fresh = reaching.n_fresh;
        state
    }

    /// Looks for a cheaper mapping among the nodes of the last layer that were reached.
    fn end(&mut self) {
        let Self { passed, layers, limit, last, rounding, cheapest, .. } = self;
        layers[*last].close_fresh(|state, cost| {
            let cost = cost + passed.estimate(state, *last).distance;
            if cost < *limit {
                *limit = cost * (1.0 - *rounding);
                *cheapest = Some(state);
            }
        });
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
            let nodes = layer.found().map(|state| (state, &layer.nodes[state as usize]));
            let left = nodes.filter(|(_, node)| !node.link.is_at(Stage::Closed));
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
            let link = self.layers[observation].nodes[state as usize].link;
            let (action, kind) = (link.action(), link.kind());
            let action = (action != NO_ACTION).then_some(action);
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            moves.push(Move { kind, action, observation: observation as u32, state: self.passed.state(state) });
            match kind {
                MoveKind::Start => break,
                MoveKind::Extra => {}
                MoveKind::Match | MoveKind::Skip => observation -= 1,
            }
            state = link.parent();
        }
        moves.reverse();
        moves
    }
}
