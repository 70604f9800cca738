//! The cheapest way through the observations ahead, searched for best first each time that a step must be decided.
//!
//! A window is a problem of its own: it starts in the root, or in one of the start states, and ends wherever is cheapest at the newest
//! observation; what ending costs counts only when the demonstration has ended. So it costs what a search of so few observations costs,
//! whatever the model and whatever came before, and models are searched that do not list their states. What is proven is a start that is the
//! only one, and what the last window decides, of which the end is known: whether others would go on alike however the demonstration does is not
//! asked, as that would take the ways to all states.

use std::num::NonZeroU32;
use std::slice;
use std::sync::Arc;

use super::decided::{Decided, Halt, Rest, RootNode, Work};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::mapping::distances::Terms;
use crate::mapping::mapper::FirstMoves;
use crate::mapping::problem::{Parts, Starts};
use crate::mapping::{Budget, Conditions, Demonstration, Mapper, Move, MoveKind, Problem, Settings, StoppedBy};
use crate::model::{Origin, OriginRow};

/// The observations ahead.
#[derive(Debug)]
pub(super) struct Windows {
    mapper: Arc<Mapper>,
    /// Those of the whole, without weights of observations.
    conditions: Conditions,
    weights: Weights,
    /// The problem of the window from the root's observation to the newest, with free ends; `None` if nothing was observed. From one window to the
    /// next, nearly all of it stays.
    parts: Option<Parts>,
    /// Whether its terms are kept, and not computed anew for each window.
    keeps_terms: bool,
    /// The number of its first observation.
    first: u32,
    /// The last committed state; `None` before the start.
    root: Option<Origin>,
    pub(super) work: Work,
}

/// Most terms of an observation that are kept: 1 KB. Where there are more, to search the window takes longer than to compute them.
const MAX_KEPT_TERMS: usize = 1 << 7;

impl Windows {
    /// Nothing was observed yet.
    pub(super) fn new(mapper: Arc<Mapper>, weights: Weights, conditions: &Conditions) -> Self {
        let conditions = Conditions { observation_weights: Vec::new(), collapse: None, ..conditions.clone() };
        let keeps_terms = Terms::n_each(mapper.model().states(), &weights) <= MAX_KEPT_TERMS;
        let work = Work::default();
        Self { mapper, conditions, weights, parts: None, keeps_terms, first: 0, root: None, work }
    }

    /// Goes on from `root`, when nothing was observed yet.
    pub(super) fn go_to(&mut self, root: RootNode, work: Work) {
        self.first = root.observation;
        self.root = Some(root.row.map_or(Origin::State(root.state), Origin::Row));
        self.work = work;
    }

    /// Keeps an observation.
    pub(super) fn observe(&mut self, observation: &[Option<Value>], observation_weight: f64) {
        let model = self.mapper.model();
        if let Some(parts) = &mut self.parts {
            parts.demonstration.push(observation);
        } else {
            let root = self.root.as_ref().map(slice::from_ref);
            self.parts = Demonstration::of([observation.to_vec()]).map(|demonstration| Parts {
                demonstration,
                weights: self.weights.clone(),
                conditions: Conditions { starts: None, end_weight: 0.0, ..self.conditions.clone() },
                starts: Starts::of(model, root.or(self.conditions.starts.as_deref())),
                terms: Terms::none(model.states(), &self.weights),
                body: self.conditions.body(model),
            });
        }
        if let Some(parts) = &mut self.parts {
            parts.conditions.observation_weights.push(observation_weight);
            if self.keeps_terms {
                parts.terms.push(model, observation, observation_weight);
            }
        }
    }

    /// The start, if there is a single one, when the first observation has come: whatever else does, a mapping begins there.
    pub(super) fn sole_start(&mut self) -> Option<Decided> {
        if self.root.is_some() || self.n_observations() != 1 {
            return None;
        }
        let first = self.first;
        let start = self.lend(|_, problem| {
            let mut starts = problem.starts.iter(problem.model);
            let (state, row) = starts.next().filter(|_| starts.next().is_none())?;
            Some(Decided {
                step: Move { kind: MoveKind::Start, action: None, observation: first, state },
                action_cost: 0.0,
                terms: problem.distances.terms(0, row).collect(),
                row: problem.model.is_lazy().then(|| OriginRow(row.to_vec())),
            })
        })??;
        self.pass(&start);
        Some(start)
    }

    /// The first steps of the cheapest way to the newest observation.
    pub(super) fn decide(&mut self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Vec<Decided>, Halt> {
        match interrupt.poll() {
            Signal::Continue => {}
            Signal::Finish => return Err(Halt::OutOf(StoppedBy::Deadline)),
            Signal::Cancel => return Err(Halt::Cancelled),
        }
        let budget = self.budget_left(budget);
        let (first, has_root) = (self.first, self.root.is_some());
        let advances = |step: &Move| if has_root { step.observation > 0 } else { step.kind == MoveKind::Start };
        let n_first = |moves: &[Move]| moves.iter().position(advances).map_or(moves.len(), |at| at + 1);
        let found = self.lend(|mapper, problem| -> Result<_, Halt> {
            let way = mapper.first_moves(problem, n_first, budget, interrupt)?;
            let steps: Vec<_> = way.steps(problem, first, usize::from(has_root)).collect();
            Ok((steps, Work { n_expanded: way.n_expanded, n_generated: way.n_generated }))
        });
        let Some((steps, work)) = found.transpose()? else { return Ok(Vec::new()) };
        if let Some(last) = steps.last() {
            self.pass(last);
        }
        self.work += work;
        Ok(steps)
    }

    /// Does `work` with the problem of the window; `None` if nothing was observed.
    fn lend<T>(&mut self, work: impl FnOnce(&Mapper, &Problem<'_>) -> T) -> Option<T> {
        let mut parts = self.parts.take()?;
        let model = self.mapper.model();
        if !self.keeps_terms {
            let (schema, states) = (model.schema(), model.states());
            parts.terms = Terms::of(schema, states, &parts.demonstration, &parts.weights, &parts.conditions);
        }
        let problem = Problem::of_parts(model, parts);
        let done = work(&self.mapper, &problem);
        self.parts = Some(problem.into_parts());
        Some(done)
    }

    /// Goes on from the node to which this step leads.
    fn pass(&mut self, step: &Decided) {
        let root = step.origin();
        let n_passed = (step.step.observation - self.first) as usize;
        self.first = step.step.observation;
        if let Some(parts) = &mut self.parts {
            parts.starts.go_to(&root);
            parts.demonstration.drop_first(n_passed);
            parts.conditions.observation_weights.drain(..n_passed);
            if self.keeps_terms {
                parts.terms.drop_first(n_passed);
            }
        }
        self.root = Some(root);
    }

    fn n_observations(&self) -> usize {
        self.parts.as_ref().map_or(0, |parts| parts.demonstration.len())
    }

    /// The cheapest way to the end.
    pub(super) fn rest(&self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Option<Rest>, Cancelled> {
        let Some(parts) = &self.parts else { return Ok(None) };
        let conditions = Conditions {
            starts: self.root.as_ref().map(|root| vec![root.clone()]).or_else(|| self.conditions.starts.clone()),
            end_weight: self.conditions.end_weight,
            ..parts.conditions.clone()
        };
        let problem = Problem::new(self.mapper.model(), parts.demonstration.clone(), self.weights.clone(), conditions);
        let mapping = self.mapper.map_window(&problem, self.budget_left(budget), interrupt)?;
        let (end_cost, stopped_by) = (mapping.cost.end, mapping.stopped_by);
        let (lower_bound, end) = (mapping.lower_bound.unwrap_or(0.0), mapping.end.clone());
        let way = FirstMoves::from(mapping);
        let work = Work { n_expanded: way.n_expanded, n_generated: way.n_generated };
        let steps = way.steps(&problem, self.first, usize::from(self.root.is_some())).collect();
        Ok(Some(Rest { steps, end_cost, end, stopped_by, lower_bound, work }))
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let n_attributes = self.weights.as_slice().len();
        let each = size_of::<f64>() + n_attributes * size_of::<Option<Value>>();
        let of_parts = |parts: &Parts| {
            parts.conditions.observation_weights.capacity() * each
                + if self.keeps_terms { parts.terms.size_bytes() } else { 0 }
        };
        size_of::<Self>() + self.parts.as_ref().map_or(0, of_parts)
    }

    /// What a search may spend.
    fn budget_left(&self, budget: Budget) -> Budget {
        let max_expansions = budget.max_expansions.saturating_sub(self.work.n_expanded);
        Budget { max_expansions, ..budget.beside(self.size_bytes()) }
    }
}

impl FirstMoves {
    /// Its steps in a window that begins with the observation `first`, without the first `n_committed`.
    fn steps(&self, problem: &Problem<'_>, first: u32, n_committed: usize) -> impl Iterator<Item = Decided> {
        let steps = self.moves.iter().zip(&self.action_costs).skip(n_committed);
        let states = self.states.as_ref();
        steps.map(move |(step, action_cost)| {
            let row = states.unwrap_or_else(|| problem.model.states()).row(step.state);
            Decided {
                step: Move { observation: first + step.observation, ..*step },
                action_cost: *action_cost,
                terms: problem.distances.terms(step.observation as usize, row).collect(),
                row: states.map(|_| OriginRow(row.to_vec())),
            }
        })
    }
}

/// About how much memory windows of `problem`'s demonstration take at most, in bytes, also while one is searched.
pub(super) fn most_bytes(mapper: &Mapper, problem: &Problem<'_>, lookahead: NonZeroU32) -> usize {
    let n_observations = usize::try_from(lookahead.get()).unwrap_or(usize::MAX).saturating_add(1);
    let window = problem.demonstration.iter().take(n_observations).map(<[_]>::to_vec);
    let Some(window) = Demonstration::of(window) else { return 0 };
    let term_bytes = Terms::n_each(problem.model.states(), &problem.weights).min(MAX_KEPT_TERMS) * size_of::<f64>();
    let observed_bytes = 2 * (window.size_bytes() + n_observations.saturating_mul(term_bytes));
    let conditions = Conditions { collapse: None, ..problem.conditions.clone() };
    let window = Problem::new(problem.model, window, problem.weights.clone(), conditions);
    mapper.search_bytes(&window, Settings::default()).saturating_add(observed_bytes)
}
