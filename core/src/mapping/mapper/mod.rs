//! A model prepared for mapping.

mod buffers;
mod by_default;
mod online;
mod search_bytes;

use std::any::Any;
use std::iter::repeat_n;
use std::sync::Arc;

use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};

use super::completion::{Allowance, Extras, complete};
use super::cost::{Cost, ROUNDING, SLACK, action_costs, cost_of};
use super::heuristic::abstraction::Abstractions;
use super::heuristic::paper::Paper;
use super::heuristic::projected::{LayerTables, Projected, TableRoom};
use super::heuristic::projection::Projections;
use super::heuristic::{Guide, Heuristic, HeuristicName};
use super::online::SharedWaysIn;
use super::search::{Found, Move, astar, layered};
use super::{Budget, PolicyEnd, Problem, StoppedBy};
use crate::interrupt::{Cancelled, Interrupt, Interrupted, Uninterrupted};
use crate::model::{Model, Space, StateIdx, States};
use buffers::{BufferPool, Buffers};
use by_default::Patience;
pub(in crate::mapping) use online::FirstMoves;

/// How a mapping is searched for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settings {
    /// What guides the search.
    pub heuristic: HeuristicName,
    /// What it may spend.
    pub budget: Budget,
    /// The cost of a mapping that is known already: nothing that costs more is looked at. If it is below the optimum, the mapping
    /// is bounded by it, unless all nodes had to be looked at. Has no effect with the paper's heuristic.
    pub upper_bound: Option<f64>,
}

/// What was proven of a mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// No mapping costs less.
    Optimal,
    /// No mapping costs less than `lower_bound`: a budget ran out, or the heuristic proves nothing.
    Bounded,
    /// Nothing: a finite lookahead decided.
    Local,
}

impl Status {
    /// Every status.
    pub const ALL: [Self; 3] = [Self::Optimal, Self::Bounded, Self::Local];

    /// The status, as in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Optimal => "optimal",
            Self::Bounded => "bounded",
            Self::Local => "local",
        }
    }
}

/// The best sequence of imitator states and actions that was found for a demonstration, with its alignment.
#[derive(Clone, Debug, PartialEq)]
pub struct Mapping {
    /// The steps, from [`Start`](super::MoveKind::Start) to the last observation.
    pub moves: Vec<Move>,
    /// What the action of each of them costs; 0 without one.
    pub action_costs: Vec<f64>,
    /// What they cost.
    pub cost: Cost,
    /// How they end.
    pub end: PolicyEnd,
    /// What was proven.
    pub status: Status,
    /// No mapping costs less. Equal to `cost.total` if optimal; `None` if local.
    pub lower_bound: Option<f64>,
    /// What the search ran out of, if that is why it is not optimal, or why the end of what a lookahead decided was followed greedily.
    pub stopped_by: Option<StoppedBy>,
    /// Nodes expanded; without what is looked at to make estimates.
    pub n_expanded: u64,
    /// Successors looked at.
    pub n_generated: u64,
    /// The states of the moves, in the order in which they are first passed, if the model is searched lazily; else they are those
    /// of the model.
    pub states: Option<States>,
}

/// A model, and what is computed once per model to search it.
#[derive(Debug)]
pub struct Mapper {
    model: Arc<Model>,
    projections: Projections,
    abstractions: Abstractions,
    buffers: BufferPool,
    patience: Patience,
    ways_in: SharedWaysIn,
    /// See [`Self::keeping`].
    #[expect(dead_code, reason = "it is kept to be dropped")]
    kept: Option<Box<dyn Any + Send + Sync>>,
}

impl Mapper {
    /// Prepares `model`. Takes time and memory proportional to its states and transitions times attributes.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn new(model: Model, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        Self::within(model, usize::MAX, interrupt)
    }

    /// As [`Self::new`], in about `max_bytes` at most, those of the model included: attributes of which the projections do not fit are not
    /// projected. Searches take longer without, and find the same.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn within(model: Model, max_bytes: usize, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        let left = max_bytes.saturating_sub(model.size_bytes());
        let projections = Projections::new(&model, left, interrupt)?;
        let (abstractions, buffers, ways_in) = Default::default();
        let (model, patience) = (Arc::new(model), Patience::DEFAULT);
        Ok(Self { model, projections, abstractions, buffers, patience, ways_in, kept: None })
    }

    /// The same mapper, which keeps `token` for as long as it lives: what its memory is counted by, for whoever counts that.
    #[must_use]
    pub fn keeping(self, token: impl Any + Send + Sync) -> Self {
        Self { kept: Some(Box::new(token)), ..self }
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }

    pub(in crate::mapping) fn shared_model(&self) -> Arc<Model> {
        Arc::clone(&self.model)
    }

    pub(in crate::mapping) fn shared_ways_in(&self) -> &SharedWaysIn {
        &self.ways_in
    }

    /// Approximate size in memory, in bytes: that of the model, and of what is kept for searches, which grows with these. Of as many
    /// searches as ran at the same time, up to 16 MB each are kept.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        let made = self.projections.size_bytes() + self.abstractions.size_bytes();
        self.model.size_bytes() + made + self.buffers.size_bytes()
    }

    /// Gives back what was kept of searches. The next ones take longer, and find the same.
    pub fn release(&self) {
        self.buffers.release();
        self.abstractions.release();
    }

    /// A lower bound of the cost from each node, an observation and a state, of `problem` to the end: what guides the
    /// search by default. Consistent, for nodes that the start states lead to; 0 at the last observation if ending is free. For other
    /// searches, and to look at.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model; the function, if the observation is not of the problem, or the state has no number in the
    /// model, as all but the start of one that is searched lazily.
    pub fn lower_bounds<'p>(&'p self, problem: &'p Problem<'p>) -> impl Fn(u32, StateIdx) -> f64 + 'p {
        self.check(problem);
        let room = TableRoom::within(usize::MAX);
        let solved = self.solve(problem, room, &mut Uninterrupted);
        let projected = solved.ok().flatten();
        let projected = projected.expect("nothing interrupts");
        move |observation, state| projected.cost_to_go(observation as usize, self.model.states().row(state))
    }

    /// The cheapest mapping of `problem`, which must be of this mapper's model; the best one found if the budget runs out or
    /// `interrupt` says to finish. Deterministic but for where `interrupt` cuts it off.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model.
    pub fn map(
        &self,
        problem: &Problem<'_>,
        settings: Settings,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let choices = Choices { max_bytes: settings.budget.max_bytes, may_turn: true };
        self.map_by(choices, problem, settings, interrupt)
    }

    /// The same, where the way to search is chosen by `choices`.
    fn map_by(
        &self,
        choices: Choices,
        problem: &Problem<'_>,
        settings: Settings,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        self.check(problem);
        let Some(mut explored) = self.model.explore_from(problem.starts.rows()) else {
            return self.map_in(&mut self.model.whole(), choices, problem, settings, interrupt);
        };
        let mut mapping = self.map_in(&mut explored, choices, problem, settings, interrupt)?;
        mapping.states = Some(explored.keep(&renumber(&mut mapping.moves)));
        Ok(mapping)
    }

    fn map_in<S: Space>(
        &self,
        space: &mut S,
        choices: Choices,
        problem: &Problem<'_>,
        settings: Settings,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let Settings { budget, upper_bound, .. } = settings;
        let budget = budget.beside(way_bytes(problem));
        let settings = Settings { budget, ..settings };
        // Sums in another order may be a little larger; a little room costs nothing.
        let most_f = upper_bound.map_or(f64::INFINITY, |bound| bound * (1.0 + SLACK));
        match settings.heuristic {
            HeuristicName::Default => {
                let conclude = |found, estimates: &LayerTables, interrupt: &mut dyn Interrupt| {
                    conclude(problem, space, estimates, found, interrupt)
                };
                match self.layered(choices, problem, settings, most_f, interrupt, conclude)? {
                    Some(mapping) => Ok(mapping),
                    None => self.best_first(space, choices, problem, settings, most_f, interrupt),
                }
            }
            HeuristicName::None => {
                let blind = Projected::blind(problem);
                let found = self.search(space, problem, Guide::from(&blind), budget, most_f, interrupt)?;
                conclude(problem, space, &blind, within(most_f, found, problem), interrupt)
            }
            HeuristicName::Paper => {
                let found = astar::search(problem, space, &Paper::new(problem), budget, interrupt)?;
                // The paper's estimate proves nothing; the projections bound the optimum all the same.
                let room = TableRoom::within(budget.max_bytes);
                if let Some(projected) = self.solve(problem, room, interrupt)? {
                    let least_f = least_start(problem, &projected);
                    conclude(problem, space, &projected, Found { least_f, ..found }, interrupt)
                } else {
                    let (blind, stopped_by) =
                        (Projected::blind(problem), found.stopped_by.or(Some(StoppedBy::Deadline)));
                    let found = Found { least_f: least_start(problem, &blind), stopped_by, ..found };
                    conclude(problem, space, &blind, found, interrupt)
                }
            }
        }
    }

    /// What `conclude` makes of what a search layer by layer finds, given its estimates; `None` if the problem is too large for it, or its budget
    /// too small.
    fn layered<T>(
        &self,
        choices: Choices,
        problem: &Problem<'_>,
        Settings { budget, .. }: Settings,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
        conclude: impl FnOnce(Found, &LayerTables, &mut dyn Interrupt) -> Result<T, Cancelled>,
    ) -> Result<Option<T>, Cancelled> {
        if self.model.is_lazy() {
            return Ok(None);
        }
        let n_nodes = self.model.graph().n_states().saturating_mul(problem.demonstration.len());
        let chosen_by = Budget { max_bytes: choices.max_bytes, ..budget };
        if n_nodes > self.patience.max_layered_nodes || !layered::is_within(chosen_by, problem, n_nodes) {
            return Ok(None);
        }
        let room = TableRoom::within(choices.max_bytes);
        self.buffers.lend(budget.max_bytes, |Buffers { layered, .. }| {
            if !layered.solve(&self.projections, problem, room, interrupt)? {
                return Ok(None);
            }
            let found = layered::search(problem, budget, most_f, layered, interrupt)?;
            conclude(within(most_f, found, problem), &layered.estimates, interrupt).map(Some)
        })
    }

    /// The tables of [`Projected::solve`].
    fn solve<'p>(
        &'p self,
        problem: &'p Problem<'p>,
        room: TableRoom,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Projected<'p>>, Cancelled> {
        self.buffers.lend(room.max_bytes, |Buffers { solving, .. }| {
            Projected::solve(&self.projections, problem, room, solving, interrupt)
        })
    }

    fn check(&self, problem: &Problem<'_>) {
        assert!(std::ptr::eq(problem.model, &raw const *self.model), "the problem must be of this mapper's model");
    }
}

/// By what it is chosen how a problem is searched: of mappings of equal cost, another way may find another.
#[derive(Clone, Copy, Debug)]
struct Choices {
    /// As if a search might take so much memory, in bytes.
    max_bytes: usize,
    /// Whether a search that has used up its memory gives way to one that takes less, and one that takes long takes more if there is some.
    may_turn: bool,
}

/// What a mapping costs at least, whichever start it has.
fn least_start(problem: &Problem<'_>, heuristic: &impl Heuristic) -> f64 {
    let starts = problem.starts.iter(problem.model);
    let f = starts.map(|(_, row)| problem.distances.distance(0, row) + heuristic.cost_to_go(0, row));
    f.fold(f64::INFINITY, f64::min)
}

/// How much memory ways take that are found, and the mapping, in bytes: some copies of some steps for each observation.
fn way_bytes(problem: &Problem<'_>) -> usize {
    const N_STEPS: usize = 8;
    problem.demonstration.len() * N_STEPS * size_of::<Move>()
}

/// Numbers the states of `moves` anew, in the order in which they are first passed. Gives their former numbers, by the new ones.
fn renumber(moves: &mut [Move]) -> Vec<StateIdx> {
    let mut former = Vec::new();
    let mut numbers: FxHashMap<StateIdx, StateIdx> = FxHashMap::default();
    for step in moves {
        #[expect(clippy::cast_possible_truncation, reason = "no more than there were")]
        let next = former.len() as StateIdx;
        let number = *numbers.entry(step.state).or_insert(next);
        if number == next {
            former.push(step.state);
        }
        step.state = number;
    }
    former
}

/// What was found by a search among the mappings that cost at most `most_f`. If it came to its end without one, there is none, so
/// that is a lower bound.
fn within(most_f: f64, found: Found, problem: &Problem<'_>) -> Found {
    let is_whole = |path: &Vec<Move>| path.last().is_some_and(|end| end.observation as usize == problem.last());
    if found.is_complete && !found.paths.iter().any(is_whole) {
        Found { is_complete: false, least_f: most_f, ..found }
    } else {
        found
    }
}

/// Completes what was found, guided by `heuristic`, and says what is proven if no mapping costs less than its `least_f`.
fn conclude<S: Space, H: Heuristic>(
    problem: &Problem<'_>,
    space: &mut S,
    heuristic: &H,
    found: Found,
    interrupt: &mut dyn Interrupt,
) -> Result<Mapping, Cancelled> {
    let Found { paths, is_complete, stopped_by, least_f: lower_bound, n_expanded, n_generated } = found;
    let mut allowance = Allowance::new(interrupt);
    let ways: &[Extras] = if is_complete { &[Extras::Avoided] } else { &[Extras::Allowed, Extras::Avoided] };
    let mut best: Option<(Cost, Vec<Move>, Vec<f64>)> = None;
    for (path, extras) in paths.into_iter().flat_map(|path| repeat_n(path, ways.len()).zip(ways)) {
        let moves = complete(problem, space, heuristic, *extras, path, &mut allowance)?;
        let action_costs = action_costs(problem, space, &moves);
        let cost = cost_of(problem, space, &moves, &action_costs);
        if best.as_ref().is_none_or(|(least, ..)| cost.total < least.total) {
            best = Some((cost, moves, action_costs));
        }
    }
    let (cost, moves, action_costs) = best.expect("a search gives at least one path");
    let is_optimal = cost.total * (1.0 - ROUNDING) <= lower_bound;
    let row = moves.last().map_or(&[][..], |step| space.row(step.state));
    let last = problem.demonstration.observation(problem.last());
    let end = PolicyEnd::at(problem.model, row, last, &problem.weights);
    Ok(Mapping {
        moves,
        action_costs,
        cost,
        end,
        status: if is_optimal { Status::Optimal } else { Status::Bounded },
        lower_bound: Some(if is_optimal { cost.total } else { lower_bound }),
        stopped_by: stopped_by.filter(|_| !is_optimal),
        n_expanded,
        n_generated,
        states: None,
    })
}
