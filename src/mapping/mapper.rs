//! A model prepared for mapping.

use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Problem;
use super::completion::{Allowance, Extras, complete};
use super::cost::{Cost, cost_of};
use super::heuristic::paper::Paper;
use super::heuristic::projected::Projected;
use super::heuristic::projection::Projections;
use super::heuristic::{Blind, Grouping, Heuristic, HeuristicName};
use super::search::best_first::{self, Buffers};
use super::search::{Found, Move, astar};
use crate::interrupt::{Cancelled, Interrupt, Uninterrupted};
use crate::model::{Model, StateIdx};

/// What a search may spend. Its time is bounded by its caller's [`Interrupt`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Most nodes expanded.
    pub max_expansions: u64,
    /// Most nodes kept in memory, about 64 bytes each.
    pub max_nodes: usize,
}

impl Budget {
    /// Any number of expansions, within 16 million nodes: about 1 GB.
    pub const DEFAULT: Self = Self { max_expansions: u64::MAX, max_nodes: 16_000_000 };
}

impl Default for Budget {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// How a mapping is searched for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settings {
    /// What guides the search.
    pub heuristic: HeuristicName,
    /// What it may spend.
    pub budget: Budget,
    /// The cost of a mapping that is known already: nothing that costs more is looked at. Has no effect with the paper's
    /// heuristic.
    pub upper_bound: Option<f64>,
    /// When the default heuristic projects attributes together.
    pub grouping: Grouping,
}

/// What was proven of a mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
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
    /// What they cost.
    pub cost: Cost,
    /// What was proven.
    pub status: Status,
    /// No mapping costs less. Equal to `cost.total` if optimal; `None` if local.
    pub lower_bound: Option<f64>,
    /// Nodes expanded.
    pub n_expanded: u64,
    /// Successors looked at.
    pub n_generated: u64,
}

/// A model, and what is computed once per model to search it.
#[derive(Debug)]
pub struct Mapper {
    model: Model,
    projections: Projections,
    /// Of searches that have ended, for those that come: at most as many as ran at the same time.
    buffers: Mutex<Vec<Buffers>>,
}

impl Mapper {
    /// Prepares `model`. Takes time and memory proportional to its states and transitions times attributes.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so. It is not asked to finish.
    pub fn new(model: Model, interrupt: &mut dyn Interrupt) -> Result<Self, Cancelled> {
        let projections = Projections::new(&model, interrupt)?;
        Ok(Self { model, projections, buffers: Mutex::default() })
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Approximate size in memory, in bytes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.model.size_bytes() + self.projections.size_bytes()
    }

    /// A lower bound of the cost from each node, an observation and a state, of `problem` to the end: what guides the
    /// search by default. Consistent; 0 at the last observation. For other searches, and to look at.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model; the function, if the observation or the state is not of the problem.
    pub fn lower_bounds<'p>(&'p self, problem: &'p Problem<'p>) -> impl Fn(u32, StateIdx) -> f64 + 'p {
        self.check(problem);
        let projected = Projected::solve(&self.projections, problem, &mut Uninterrupted).ok().flatten();
        let projected = projected.expect("nothing interrupts");
        move |observation, state| projected.cost_to_go(observation as usize, state)
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
        self.check(problem);
        let Settings { budget, upper_bound, .. } = settings;
        // Sums in another order may be a little larger; a little room costs nothing.
        let most_f = upper_bound.map_or(f64::INFINITY, |bound| bound * (1.0 + SLACK));
        match settings.heuristic {
            HeuristicName::Default => {
                let projected = Projected::solve(&self.projections, problem, settings.grouping, interrupt)?;
                if let Some(mut projected) = projected {
                    return self.best_first(problem, &mut projected, budget, most_f, interrupt);
                }
                // No time for the estimate, so none for a search either.
                let budget = Budget { max_expansions: 0, ..budget };
                self.best_first(problem, &mut Projected::blind(problem), budget, most_f, interrupt)
            }
            HeuristicName::None => {
                let found = astar::search(problem, &Blind, budget, most_f, interrupt)?;
                conclude(problem, &Blind, found, interrupt)
            }
            HeuristicName::Paper => {
                let found = astar::search(problem, &Paper::new(problem), budget, f64::INFINITY, interrupt)?;
                // The paper's estimate proves nothing; the projections bound the optimum all the same.
                let first = problem.distances.distance(0, problem.start);
                match Projected::solve(&self.projections, problem, settings.grouping, interrupt)? {
                    Some(projected) => {
                        let least_f = first + projected.cost_to_go(0, problem.start);
                        conclude(problem, &projected, Found { least_f, ..found }, interrupt)
                    }
                    None => conclude(problem, &Blind, Found { least_f: first, ..found }, interrupt),
                }
            }
        }
    }

    fn check(&self, problem: &Problem<'_>) {
        assert!(std::ptr::eq(problem.model, &raw const self.model), "the problem must be of this mapper's model");
    }

    fn best_first(
        &self,
        problem: &Problem<'_>,
        projected: &mut Projected<'_>,
        budget: Budget,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let kept = self.buffers.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut buffers = kept.unwrap_or_default();
        let found = best_first::search(problem, projected, budget, most_f, &mut buffers, interrupt)?;
        if buffers.are_small() {
            self.buffers.lock().unwrap_or_else(PoisonError::into_inner).push(buffers);
        }
        conclude(problem, projected, found, interrupt)
    }
}

/// How much more than an upper bound a mapping may cost, relatively: more than sums of 100,000 terms differ by rounding.
const SLACK: f64 = 1e-9;

/// Sums in different orders may differ by rounding; what is closer than this, relatively, is the same.
const ROUNDING: f64 = 1e-12;

/// Completes what was found, guided by `heuristic`, and says what is proven if no mapping costs less than its `least_f`.
fn conclude<H: Heuristic>(
    problem: &Problem<'_>,
    heuristic: &H,
    found: Found,
    interrupt: &mut dyn Interrupt,
) -> Result<Mapping, Cancelled> {
    let Found { paths, is_complete, least_f: lower_bound, n_expanded, n_generated } = found;
    let mut allowance = Allowance::new(interrupt);
    let ways: &[Extras] = if is_complete { &[Extras::Avoided] } else { &[Extras::Allowed, Extras::Avoided] };
    let mut costed = Vec::new();
    for path in paths {
        for extras in ways {
            let moves = complete(problem, heuristic, *extras, path.clone(), &mut allowance)?;
            costed.push((cost_of(problem, &moves), moves));
        }
    }
    let best = costed.into_iter().min_by(|(cost, _), (other, _)| cost.total.total_cmp(&other.total));
    let (cost, moves) = best.expect("a search gives at least one path");
    let is_optimal = cost.total * (1.0 - ROUNDING) <= lower_bound;
    Ok(Mapping {
        moves,
        cost,
        status: if is_optimal { Status::Optimal } else { Status::Bounded },
        lower_bound: Some(if is_optimal { cost.total } else { lower_bound }),
        n_expanded,
        n_generated,
    })
}
