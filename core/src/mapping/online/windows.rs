//! The cheapest way through the observations ahead, searched for best first each time that a step must be decided.
//!
//! A window is a problem of its own: it starts in the root, or in one of the start states, and ends wherever is cheapest at the newest
//! observation; what ending costs counts only when the demonstration has ended. So it costs what a search of so few observations costs,
//! whatever the model and whatever came before, and models are searched that do not list their states. What is proven is a start that is the
//! only one, and what the last window decides, of which the end is known: whether others would go on alike however the demonstration does is not
//! asked, as that would take the ways to all states.

use std::num::NonZeroU32;
use std::sync::Arc;

use super::decided::{Decided, Halt, Rest, RootNode, Work};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::mapping::{
    Budget, Conditions, Demonstration, Mapper, Mapping, Move, MoveKind, Problem, Settings, Status, StoppedBy,
};
use crate::model::{Origin, OriginRow};

/// The observations ahead.
#[derive(Debug)]
pub(super) struct Windows {
    mapper: Arc<Mapper>,
    weights: Weights,
    /// Those of the whole, without weights of observations.
    conditions: Conditions,
    /// From the root's on; `None` if nothing was observed.
    observations: Option<Demonstration>,
    /// Their weights. Shape `[n_observations]`.
    observation_weights: Vec<f64>,
    /// The number of the first of them.
    first: u32,
    /// The last committed state; `None` before the start.
    root: Option<Origin>,
    pub(super) work: Work,
}

impl Windows {
    /// Nothing was observed yet.
    pub(super) fn new(mapper: Arc<Mapper>, weights: Weights, conditions: &Conditions) -> Self {
        let conditions = Conditions { observation_weights: Vec::new(), collapse: None, ..conditions.clone() };
        let (observation_weights, work) = (Vec::new(), Work::default());
        Self { mapper, weights, conditions, observations: None, observation_weights, first: 0, root: None, work }
    }

    /// Goes on from `root`, when nothing was observed yet.
    pub(super) fn go_to(&mut self, root: RootNode, work: Work) {
        self.first = root.observation;
        self.root = Some(root.row.map_or(Origin::State(root.state), Origin::Row));
        self.work = work;
    }

    /// Keeps an observation.
    pub(super) fn observe(&mut self, observation: &[Option<Value>], observation_weight: f64) {
        match &mut self.observations {
            Some(observations) => observations.push(observation),
            none => *none = Demonstration::of([observation.to_vec()]),
        }
        self.observation_weights.push(observation_weight);
    }

    /// The start, if there is a single one, when the first observation has come: whatever else does, a mapping begins there.
    pub(super) fn sole_start(&mut self) -> Option<Decided> {
        if self.root.is_some() || self.observation_weights.len() != 1 {
            return None;
        }
        let start = {
            let problem = self.problem_of(&self.mapper, self.observations.clone()?, false);
            let mut starts = problem.starts.iter(problem.model);
            let (state, row) = starts.next().filter(|_| starts.next().is_none())?;
            Decided {
                step: Move { kind: MoveKind::Start, action: None, observation: self.first, state },
                action_cost: 0.0,
                terms: problem.distances.terms(0, row).collect(),
                row: problem.model.is_lazy().then(|| OriginRow(row.to_vec())),
            }
        };
        self.root = Some(start.origin());
        Some(start)
    }

    /// The first steps of the cheapest way to the newest observation.
    pub(super) fn decide(&mut self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Vec<Decided>, Halt> {
        match interrupt.poll() {
            Signal::Continue => {}
            Signal::Finish => return Err(Halt::OutOf(StoppedBy::Deadline)),
            Signal::Cancel => return Err(Halt::Cancelled),
        }
        let Some(observations) = self.observations.take() else { return Ok(Vec::new()) };
        let mapper = Arc::clone(&self.mapper);
        // Nearly all observations stay, and the problem is made once for each: they are lent to it.
        let problem = self.problem_of(&mapper, observations, false);
        let found = self.first_steps(&problem, budget, interrupt);
        self.observations = Some(problem.demonstration);
        let (steps, work) = found?;
        if let (Some(last), Some(observations)) = (steps.last(), &mut self.observations) {
            self.root = Some(last.origin());
            let n_passed = (last.step.observation - self.first) as usize;
            observations.drop_first(n_passed);
            self.observation_weights.drain(..n_passed);
            self.first = last.step.observation;
        }
        self.work += work;
        Ok(steps)
    }

    /// The first steps of the cheapest way of the window, which is `problem`, and the work of finding it.
    fn first_steps(
        &self,
        problem: &Problem<'_>,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(Vec<Decided>, Work), Halt> {
        let mapping = self.mapper.map_window(problem, self.budget_left(budget), interrupt)?;
        if mapping.status != Status::Optimal {
            return Err(Halt::OutOf(mapping.stopped_by.unwrap_or(StoppedBy::Memory)));
        }
        let mut steps: Vec<_> = self.steps(problem, &mapping).collect();
        let advances = |step: &Decided| match self.root {
            Some(_) => step.step.observation > self.first,
            None => step.step.kind == MoveKind::Start,
        };
        let n_decided = steps.iter().position(advances).map_or(steps.len(), |at| at + 1);
        steps.truncate(n_decided);
        Ok((steps, Work { n_expanded: mapping.n_expanded, n_generated: mapping.n_generated }))
    }

    /// The cheapest way to the end.
    pub(super) fn rest(&self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Option<Rest>, Cancelled> {
        let Some(observations) = self.observations.clone() else { return Ok(None) };
        let problem = self.problem_of(&self.mapper, observations, true);
        let mapping = self.mapper.map_window(&problem, self.budget_left(budget), interrupt)?;
        Ok(Some(Rest {
            steps: self.steps(&problem, &mapping).collect(),
            end_cost: mapping.cost.end,
            stopped_by: mapping.stopped_by,
            lower_bound: mapping.lower_bound.unwrap_or(0.0),
            work: Work { n_expanded: mapping.n_expanded, n_generated: mapping.n_generated },
            end: mapping.end,
        }))
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let n_attributes = self.weights.as_slice().len();
        let each = size_of::<f64>() + n_attributes * size_of::<Option<Value>>();
        size_of::<Self>() + self.observation_weights.capacity() * each
    }

    /// What a search may spend.
    fn budget_left(&self, budget: Budget) -> Budget {
        let max_expansions = budget.max_expansions.saturating_sub(self.work.n_expanded);
        Budget { max_expansions, ..budget.beside(self.size_bytes()) }
    }

    /// The way from the root to the newest of `observations` as a problem. What ending costs counts if it `ends`.
    fn problem_of<'m>(&self, mapper: &'m Mapper, observations: Demonstration, ends: bool) -> Problem<'m> {
        let conditions = Conditions {
            starts: self.root.as_ref().map(|root| vec![root.clone()]).or_else(|| self.conditions.starts.clone()),
            observation_weights: self.observation_weights.clone(),
            end_weight: if ends { self.conditions.end_weight } else { 0.0 },
            ..self.conditions.clone()
        };
        Problem::new(mapper.model(), observations, self.weights.clone(), conditions)
    }

    /// The steps of a mapping of the window that are not committed yet.
    fn steps(&self, problem: &Problem<'_>, mapping: &Mapping) -> impl Iterator<Item = Decided> {
        let n_committed = usize::from(self.root.is_some());
        let steps = mapping.moves.iter().zip(&mapping.action_costs).skip(n_committed);
        let states = mapping.states.as_ref();
        steps.map(move |(step, action_cost)| {
            let row = states.unwrap_or_else(|| problem.model.states()).row(step.state);
            Decided {
                step: Move { observation: self.first + step.observation, ..*step },
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
    let observed_bytes = 2 * window.size_bytes();
    let conditions = Conditions { collapse: None, ..problem.conditions.clone() };
    let window = Problem::new(problem.model, window, problem.weights.clone(), conditions);
    mapper.search_bytes(&window, Settings::default()).saturating_add(observed_bytes)
}
