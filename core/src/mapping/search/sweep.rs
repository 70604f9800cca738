//! The cheapest mapping, from what it costs to go on from every node.
//!
//! The layers are gone through from the last to the first ([`backward`]), each from the one after it alone, and of each node it is
//! kept how it is left, in two bytes. The mapping is then read off from the start. Where all layers together would take too
//! much memory, they are divided into *sections*: of all but the first, only what its first layer costs is kept, and it is gone through
//! again when the mapping has come there.

mod backward;

use super::{Found, Move, MoveKind};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::{Budget, Problem};
use crate::model::{Graph, Model, StateIdx, Transition};
use backward::{GoOn, GoOnLink, NoLinks, NoteLinks, Ways, Workspace};

/// What a sweep came to.
#[derive(Debug)]
pub(in crate::mapping) enum Swept {
    /// The cheapest mapping.
    Done(Found),
    /// The interrupt said to finish.
    CutShort {
        /// The earliest layer that was done.
        known: KnownLayer,
        n_expanded: u64,
        n_generated: u64,
    },
    /// It would take more memory than the budget allows, or states have too many ways out.
    TooLarge,
}

/// What it costs to be at each state at an observation and to go on from there.
#[derive(Debug)]
pub(in crate::mapping) struct KnownLayer {
    pub(in crate::mapping) observation: usize,
    /// By state.
    pub(in crate::mapping) costs: Vec<f64>,
}

/// Finds the cheapest mapping of a problem in a model whose states are all known. Each node counts as one expansion.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn sweep(
    problem: &Problem<'_>,
    budget: Budget,
    interrupt: &mut dyn Interrupt,
) -> Result<Swept, Cancelled> {
    /// How many ways are looked at between two looks at the interrupt: tens of microseconds.
    const POLL_EVERY: u64 = 1 << 14;
    let Some(section_len) = section_len(problem, budget) else { return Ok(Swept::TooLarge) };
    in_sections(problem, section_len, Meter::new(interrupt, POLL_EVERY))
}

/// The same, in sections of so many layers.
fn in_sections(problem: &Problem<'_>, section_len: usize, mut meter: Meter<'_>) -> Result<Swept, Cancelled> {
    let model = problem.model;
    let n_states = model.graph().n_states();
    let ways = match Ways::new(problem, &mut meter) {
        Ok(Some(ways)) => ways,
        Ok(None) => return Ok(Swept::TooLarge),
        Err(Signal::Cancel) => return Err(Cancelled),
        Err(_) => {
            // Nothing is less.
            let known = KnownLayer { observation: problem.last(), costs: vec![0.0; n_states] };
            return Ok(Swept::CutShort { known, n_expanded: 0, n_generated: 0 });
        }
    };
    let mut sweep = Sweep {
        problem,
        ways: &ways,
        observation: problem.last(),
        distances: vec![0.0; n_states],
        here: vec![0.0; n_states],
        next: vec![0.0; n_states],
        end_links: Vec::new(),
        n_stepped: 0,
        workspace: Workspace::default(),
        meter,
    };
    let done = sweep.run(section_len);
    // Those of later sections are gone through twice.
    let n_layers = sweep.n_stepped.min(problem.last()) as u64 + 1;
    let n_expanded = n_states as u64 * n_layers;
    let n_generated = (n_states as u64 + 2 * model.graph().n_transitions() as u64) * n_layers;
    match done {
        Ok(path) => Ok(Swept::Done(Found {
            paths: vec![path],
            is_complete: true,
            stopped_by: None,
            least_f: f64::INFINITY,
            n_expanded,
            n_generated,
        })),
        Err(CutShort { signal: Signal::Cancel, .. }) => Err(Cancelled),
        Err(CutShort { known, .. }) => Ok(Swept::CutShort { known, n_expanded, n_generated }),
    }
}

/// How much memory a sweep takes at most, in bytes: if all layers are one section.
pub(in crate::mapping) fn most_bytes(model: &Model, n_observations: usize) -> usize {
    let n_states = model.graph().n_states();
    let links = n_observations.saturating_mul(n_states).saturating_mul(size_of::<GoOnLink>());
    links.saturating_add(basis_bytes(model.graph())).saturating_add(n_states * size_of::<f64>())
}

/// What a sweep takes besides its sections: the graph, distances, two layers and one to be told if it is cut short, and as much in
/// buffers.
fn basis_bytes(graph: &Graph) -> usize {
    Ways::bytes_for(graph) + 8 * graph.n_states() * size_of::<f64>()
}

/// How many layers a section has, as many as there is room for; `None` if there is not even for the shortest.
fn section_len(problem: &Problem<'_>, budget: Budget) -> Option<usize> {
    let (n_observations, graph) = (problem.demonstration.len(), problem.model.graph());
    let n_states = graph.n_states();
    let room = budget.max_bytes.checked_sub(basis_bytes(graph))? / n_states.max(1);
    // The more sections, the shorter they are, but the more layers are kept from which they begin.
    let mut divisions = (1..=n_observations.isqrt() + 1).map(|n| (n, n_observations.div_ceil(n)));
    let fits = |(n_sections, len): &(usize, usize)| n_sections * size_of::<f64>() + len * size_of::<GoOnLink>() <= room;
    divisions.find(fits).map(|(_, len)| len)
}

struct Sweep<'s, 'i> {
    problem: &'s Problem<'s>,
    ways: &'s Ways,
    /// The observation of the layer that was done last.
    observation: usize,
    /// By state, the distance at `observation`.
    distances: Vec<f64>,
    /// By state, the cost-to-go from `observation`.
    here: Vec<f64>,
    /// By state, the distance at the next observation plus the cost-to-go from there.
    next: Vec<f64>,
    /// By state, how it is left at the last observation, where a skip is the end; empty if ending is free.
    end_links: Vec<GoOnLink>,
    /// Layers done, counting those that were done twice.
    n_stepped: usize,
    workspace: Workspace,
    meter: Meter<'i>,
}

/// Why a sweep has no mapping.
struct CutShort {
    signal: Signal,
    known: KnownLayer,
}

/// Tells the earliest layer that was done, if that was in an earlier section.
fn with_earliest(earliest: &mut Option<KnownLayer>) -> impl FnOnce(CutShort) -> CutShort {
    |cut_short| CutShort { known: earliest.take().unwrap_or(cut_short.known), ..cut_short }
}

impl Sweep<'_, '_> {
    /// Gives the cheapest mapping.
    fn run(&mut self, section_len: usize) -> Result<Vec<Move>, CutShort> {
        let (n_states, last) = (self.here.len(), self.problem.last());
        // What going on costs from the first layers of the sections but the first two, the last one's first.
        let mut kept: Vec<Vec<f64>> = Vec::new();
        self.begin_at(last, None)?;
        while self.observation > section_len {
            self.step_back(&mut NoLinks)?;
            if self.observation > section_len && self.observation.is_multiple_of(section_len) {
                kept.push(self.here.clone());
            }
        }
        let mut moves = Vec::new();
        let mut first = 0;
        let mut earliest = None;
        // Of a section's layers, the last one's first. They are made one by one: together they take long to be written for the first time.
        let mut links: Vec<Vec<GoOnLink>> = Vec::new();
        loop {
            let end = self.observation;
            links.clear();
            while self.observation > first {
                let mut of_layer = vec![GoOnLink::SKIP; n_states];
                let stepped = self.step_back(of_layer.as_mut_slice());
                stepped.map_err(with_earliest(&mut earliest))?;
                links.push(of_layer);
            }
            if first == 0 {
                moves.push(self.start());
            }
            self.follow(&links, end, &mut moves);
            if end == last {
                self.linger(&mut moves);
                return Ok(moves);
            }
            if first == 0 {
                let costs = (0..self.problem.model.states().len()).map(|state| self.whole_cost(state));
                earliest = Some(KnownLayer { observation: 0, costs: costs.collect() });
            }
            first = end;
            self.begin_at((first + section_len).min(last), kept.pop()).map_err(with_earliest(&mut earliest))?;
        }
    }

    /// Begins anew at an observation, from which going on costs so much; nothing from the last one.
    fn begin_at(&mut self, observation: usize, costs: Option<Vec<f64>>) -> Result<(), CutShort> {
        self.observation = observation;
        match costs {
            Some(costs) => self.here = costs,
            None => self.here.fill(0.0),
        }
        let Self { problem, ways, distances, here, end_links, workspace, meter, .. } = self;
        let states = problem.model.states();
        let mut begun = problem.distances.of_states(observation, states, distances, meter);
        if let Some(end) = problem.end.as_ref().filter(|_| observation == problem.last()) {
            (0..).zip(&mut *here).for_each(|(state, here)| *here = end.cost(states.row(state)));
            end_links.clear();
            end_links.resize(here.len(), GoOnLink::SKIP);
            let links = end_links.as_mut_slice();
            begun = begun.and_then(|()| ways.linger(distances, here, links, workspace, meter));
        }
        begun.map_err(|signal| {
            // Nothing is less.
            distances.fill(0.0);
            CutShort { signal, known: KnownLayer { observation, costs: std::mem::take(distances) } }
        })
    }

    /// Goes back by an observation.
    fn step_back<L: NoteLinks + ?Sized>(&mut self, links: &mut L) -> Result<(), CutShort> {
        let Self { problem, ways, observation, distances, here, next, n_stepped, workspace, meter, .. } = self;
        let recurrence = problem.recurrence();
        for ((next, distance), here) in next.iter_mut().zip(&*distances).zip(&*here) {
            *next = recurrence.go_on(MoveKind::Match, *distance, *here);
        }
        *observation -= 1;
        let looked_up = problem.distances.of_states(*observation, problem.model.states(), distances, meter);
        let stepped = looked_up.and_then(|()| ways.step_back(next, distances, here, links, workspace, meter));
        stepped.map_err(|signal| {
            let known = KnownLayer { observation: *observation + 1, costs: std::mem::take(next) };
            CutShort { signal, known }
        })?;
        *n_stepped += 1;
        Ok(())
    }

    /// What a mapping costs that starts in a state, if the first layer was done last.
    fn whole_cost(&self, state: StateIdx) -> f64 {
        let (distance, here) = (self.distances[state as usize], self.here[state as usize]);
        self.problem.recurrence().go_on(MoveKind::Start, distance, here)
    }

    /// The start of the cheapest mapping, the first among equals.
    fn start(&self) -> Move {
        let states = self.problem.starts.states().iter().copied();
        let cheapest = states.min_by(|state, other| self.whole_cost(*state).total_cmp(&self.whole_cost(*other)));
        Move { kind: MoveKind::Start, action: None, observation: 0, state: cheapest.unwrap_or_default() }
    }

    /// Goes on with `moves` by the extra actions that are worth their cost at the last observation.
    fn linger(&self, moves: &mut Vec<Move>) {
        while let Some(last) = moves.last().copied()
            && let Some(GoOn::Extra(way)) = self.end_links.get(last.state as usize).map(|link| link.go_on())
        {
            self.push_extra(last, way, moves);
        }
    }

    /// Adds the extra action by this way out of where `last`, the last of `moves`, leads.
    fn push_extra(&self, last: Move, way: usize, moves: &mut Vec<Move>) {
        let Transition { action, to } = self.problem.model.graph().successors(last.state)[way];
        let mut kind = MoveKind::Extra;
        if !self.problem.recurrence().may_follow(last.kind, kind) {
            // The action instead of the skip leads here too, for no more.
            moves.pop();
            kind = MoveKind::Match;
        }
        moves.push(Move { kind, action: Some(action), observation: last.observation, state: to });
    }

    /// Goes on with `moves` to the observation `end`, as `links` say: those of the layer before it, then of the one before that.
    fn follow(&self, links: &[Vec<GoOnLink>], end: usize, moves: &mut Vec<Move>) {
        while let Some(last) = moves.last().copied()
            && let Some(before_end) = (end - last.observation as usize).checked_sub(1)
        {
            let observation = last.observation + 1;
            match links[before_end][last.state as usize].go_on() {
                GoOn::Skip => {
                    moves.push(Move { kind: MoveKind::Skip, action: None, observation, state: last.state });
                }
                GoOn::Match(way) => {
                    let Transition { action, to } = self.problem.model.graph().successors(last.state)[way];
                    moves.push(Move { kind: MoveKind::Match, action: Some(action), observation, state: to });
                }
                GoOn::Extra(way) => self.push_extra(last, way, moves),
            }
        }
    }
}

#[cfg(test)]
mod tests;
