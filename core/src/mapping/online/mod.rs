//! The mapping while the demonstration is still running: observations in, one by one, committed steps out.
//!
//! From the last committed node, the *root*, cheapest ways lead through the observations that have come since. What is committed is final:
//!
//! - a step that the cheapest ways to all states share is *proven*: whatever is still to come, the cheapest mapping that begins with the
//!   steps committed before it goes on with this one, or with one of equal cost;
//! - with a lookahead of H, once the observation H past the root's has come, the cheapest way to it decides: it is
//!   committed up to its first move that advances. So it is where the caller says that the time for a step is up
//!   ([`OnlineMapping::decide`]), whatever has come by then. With several start states, the start is a move that advances, from before the
//!   first observation;
//! - at the end, the cheapest way to it, what ending costs included.
//!
//! How the ways are found is [`Ahead`]'s:
//!
//! | ahead | is | is chosen |
//! |---|---|---|
//! | [`layers`] | the cheapest ways to all states, extended with each observation, and found anew after a decision: it is known which steps are proven | without a lookahead, and where a window has [few nodes](ahead::keeps_layers) |
//! | [`windows`] | a search from the root for each decision, which looks at a small part of the nodes; only a single start and the end are proven | else, and always if the model is searched lazily |
//!
//! All that is still to be committed follows from the root and the observations from its own on, so a mapping can go on from there
//! after a restart ([`OnlineMapping::resume`]), with the same steps to the bit.
//!
//! **Ties.** In layers, the way found first is kept: a skip, then matches, from the lower state first, then extras, from the cheaper state
//! first; of actions between the same two states the cheapest, the first among equals; among survivors the lower state is the cheapest.
//! A window is searched as any problem is, with its ties.

mod ahead;
mod committed;
mod decided;
mod layers;
mod root;
mod windows;

use std::num::NonZeroU32;
use std::sync::{Arc, OnceLock};

use super::{Budget, Conditions, Mapper, Mapping, Move, Problem, Status};
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt, Uninterrupted};
use crate::model::{Model, States};
use ahead::{Ahead, keeps_layers};
use committed::Committed;
pub use committed::{CommittedMove, CommittedStep, Shortage, Stopped};
pub(in crate::mapping) use decided::Halt;
use decided::{Decided, Rest};
pub(in crate::mapping) use layers::SharedWaysIn;
pub(crate) use layers::longest_lookahead;
pub use root::{PassedStates, Root};

/// A mapping in the making.
#[derive(Debug)]
pub struct OnlineMapping {
    model: Arc<Model>,
    conditions: Conditions,
    lookahead: Option<NonZeroU32>,
    budget: Budget,
    n_observed: u32,
    committed: Committed,
    was_forced: bool,
    ahead: Ahead,
    /// The cheapest way to the end, once it was asked for.
    rest: OnceLock<Rest>,
}

impl OnlineMapping {
    /// A mapping of a demonstration of which nothing has come yet. `lookahead` is how many observations past the current one a decision may
    /// wait for, `None` for all.
    ///
    /// # Panics
    ///
    /// If the model is searched lazily and there is no lookahead, for which the ways to all states are needed.
    #[must_use]
    pub fn new(mapper: &Arc<Mapper>, weights: Weights, conditions: Conditions, lookahead: Option<NonZeroU32>) -> Self {
        let keeps_layers = keeps_layers(mapper.model(), lookahead);
        Self::looking_ahead(mapper, weights, conditions, lookahead, keeps_layers)
    }

    /// The same, which searches for ways when it needs them, however small the model is, and so proves nothing between a single start and the end.
    #[must_use]
    pub fn searching(mapper: &Arc<Mapper>, weights: Weights, conditions: Conditions, lookahead: NonZeroU32) -> Self {
        Self::looking_ahead(mapper, weights, conditions, Some(lookahead), false)
    }

    fn looking_ahead(
        mapper: &Arc<Mapper>,
        weights: Weights,
        conditions: Conditions,
        lookahead: Option<NonZeroU32>,
        keeps_layers: bool,
    ) -> Self {
        Self {
            model: mapper.shared_model(),
            lookahead,
            budget: Budget { max_bytes: usize::MAX, ..Budget::DEFAULT },
            n_observed: 0,
            committed: Committed::new(mapper.model()),
            was_forced: false,
            ahead: Ahead::new(mapper, weights, &conditions, keeps_layers),
            conditions,
            rest: OnceLock::new(),
        }
    }

    /// The same, in about `max_bytes` at most: an observation that would take more is not taken. The search of a window counts, beyond
    /// [`Mapper::WINDOW_BYTES`].
    #[must_use]
    pub fn within(mut self, max_bytes: usize) -> Self {
        self.limit(max_bytes);
        self
    }

    /// From now on, [within](Self::within) `max_bytes`.
    pub fn limit(&mut self, max_bytes: usize) {
        self.budget = Budget { max_bytes, ..Budget::DEFAULT };
    }

    /// The same, with this budget.
    pub(super) fn spending(self, budget: Budget) -> Self {
        Self { budget, ..self }
    }

    /// How many observations have come.
    #[must_use]
    pub fn n_observed(&self) -> u32 {
        self.n_observed
    }

    /// How many steps were committed.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.committed.moves.len()
    }

    /// How many nodes of observations from the last committed one on are kept, if any are. Looks at each of these observations.
    #[must_use]
    pub fn n_nodes(&self) -> usize {
        self.ahead.n_nodes()
    }

    /// Approximate size in memory, in bytes, without the model, between observations. Does not look at each of these.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        size_of::<Self>() + self.ahead.size_bytes() + self.committed.size_bytes()
    }

    /// About how much memory a mapping of `problem`'s demonstration takes at most, in bytes, also while it takes an observation: if all
    /// ways to all states are alike, as when nothing tells them apart.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model than `mapper`.
    #[must_use]
    pub fn most_bytes(mapper: &Mapper, problem: &Problem<'_>, lookahead: Option<NonZeroU32>) -> usize {
        let (model, n_observations) = (mapper.model(), problem.demonstration.len());
        let moves = n_observations.saturating_mul(MOVES_PER_OBSERVATION * (size_of::<Move>() + size_of::<f64>()));
        let ahead = match lookahead.filter(|_| !keeps_layers(model, lookahead)) {
            Some(lookahead) => windows::most_bytes(mapper, problem, lookahead),
            None => layers::most_bytes(model, lookahead, n_observations),
        };
        ahead.saturating_add(moves + BASE_BYTES)
    }

    /// Nodes and transitions that were looked at.
    pub(super) fn n_looked_at(&self) -> (u64, u64) {
        let work = self.ahead.work();
        (work.n_expanded, work.n_generated)
    }

    /// The committed steps, and their states, if the model is searched lazily.
    pub(super) fn into_moves(self) -> (Vec<Move>, Option<States>) {
        (self.committed.moves, self.committed.passed.map(|passed| passed.states))
    }

    /// Takes the next observation, shape `[n_attributes]`, and gives the steps that it commits. `observation_weight` is
    /// finite and at least 0; `None`: as the conditions say.
    ///
    /// # Errors
    ///
    /// [`Stopped::Cancelled`] if `interrupt` said so, or said to finish. [`Stopped::Memory`] if the mapping would come to take
    /// more than it [may](Self::within). The mapping is then of no more use.
    pub fn observe(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: Option<f64>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Stopped> {
        Ok(self.take(observation, observation_weight, interrupt)?)
    }

    /// As [`Self::observe`], which tells what ran out.
    pub(super) fn take(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: Option<f64>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Halt> {
        let mut steps = self.take_in(observation, observation_weight, interrupt)?;
        while self.must_decide() {
            self.commit_cheapest(&mut steps, interrupt)?;
        }
        Ok(steps)
    }

    /// The first half of [`Self::observe`]: takes the next observation, and commits what all ways share. What its lookahead decides is still to
    /// be [decided](Self::decide_next).
    ///
    /// # Errors
    ///
    /// As [`Self::observe`]. There are none where ways are [searched for](Self::searches).
    pub fn receive(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: Option<f64>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Stopped> {
        Ok(self.take_in(observation, observation_weight, interrupt)?)
    }

    /// The other half of [`Self::observe`], one decision at a time: commits the steps of the next one that a lookahead asks for; `None` if there is
    /// none.
    ///
    /// # Errors
    ///
    /// As [`Self::observe`]; but where ways are [searched for](Self::searches), the mapping is as before, and may be asked again.
    pub fn decide_next(&mut self, interrupt: &mut dyn Interrupt) -> Result<Option<Vec<CommittedStep>>, Stopped> {
        self.must_decide().then(|| self.decide(interrupt)).transpose()
    }

    /// What does not fit, if the ways to all states are kept and those through another observation do not.
    #[must_use]
    pub fn shortage(&self) -> Option<Shortage> {
        let Ahead::Layers(layers) = &self.ahead else { return None };
        let shortage = layers.shortage(self.size_bytes(), self.budget.max_bytes);
        Some(shortage).filter(|shortage| shortage.taken_bytes.saturating_add(shortage.layer_bytes) > shortage.max_bytes)
    }

    /// Whether ways are searched for when a decision is due. Then observations cost nothing, and each decision a search.
    #[must_use]
    pub fn searches(&self) -> bool {
        matches!(self.ahead, Ahead::Windows(_))
    }

    fn take_in(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: Option<f64>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Vec<CommittedStep>, Halt> {
        let of_conditions = || self.conditions.observation_weight(self.n_observed as usize);
        let observation_weight = observation_weight.unwrap_or_else(of_conditions);
        let budget = self.budget_left();
        self.ahead.observe(observation, observation_weight, budget, interrupt)?;
        self.rest.take();
        self.n_observed += 1;
        let mut steps = Vec::new();
        self.commit_shared(&mut steps);
        Ok(steps)
    }

    /// Commits the cheapest way to the newest observation, up to and including its first move that advances from the root's, for a step
    /// whose time is up; and whatever all ways that are left are known to share then. The start counts as a move that advances from before
    /// the first observation. Commits nothing if no observation has come after the root's. What is decided so is forced: the status is local.
    ///
    /// # Errors
    ///
    /// As [`Self::decide_next`].
    pub fn decide(&mut self, interrupt: &mut dyn Interrupt) -> Result<Vec<CommittedStep>, Stopped> {
        let mut steps = Vec::new();
        if self.n_passed() < self.n_observed {
            self.rest.take();
            self.commit_cheapest(&mut steps, interrupt)?;
        }
        Ok(steps)
    }

    /// How many steps would be committed if the demonstration ended now.
    #[must_use]
    pub fn n_rest(&self) -> usize {
        let rest = self.rest(&mut Uninterrupted).ok().flatten();
        rest.map_or(0, |rest| rest.steps.len())
    }

    /// Finds the rest of the cheapest mapping, before it is [ended](Self::end), unless that was done since the last observation.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so. If it says to finish, the best way is followed that was found.
    pub fn find_rest(&self, interrupt: &mut dyn Interrupt) -> Result<(), Cancelled> {
        self.rest(interrupt).map(drop)
    }

    fn rest(&self, interrupt: &mut dyn Interrupt) -> Result<Option<&Rest>, Cancelled> {
        if self.rest.get().is_none() {
            let Some(rest) = self.ahead.rest(self.budget_left(), interrupt)? else { return Ok(None) };
            return Ok(Some(self.rest.get_or_init(|| rest)));
        }
        Ok(self.rest.get())
    }

    /// Ends the demonstration, and commits the rest of the cheapest mapping. `None` if nothing was observed.
    #[must_use]
    pub fn end(mut self) -> Option<(Vec<CommittedStep>, Mapping)> {
        self.find_rest(&mut Uninterrupted).ok()?;
        let Rest { steps, end_cost, end, stopped_by, lower_bound, work } = self.rest.take()?;
        let is_proven = stopped_by.is_none();
        let steps = steps.into_iter().map(|decided| self.commit(&decided, is_proven)).collect();
        let cost = self.committed.writer.cost_with_end(end_cost);
        let (status, lower_bound) = match (self.was_forced, is_proven) {
            (true, _) => (Status::Local, None),
            (false, true) => (Status::Optimal, Some(cost.total)),
            (false, false) => (Status::Bounded, Some(lower_bound)),
        };
        let mut looked_at = self.ahead.work();
        looked_at += work;
        let Committed { moves, action_costs, passed, .. } = self.committed;
        let mapping = Mapping {
            moves,
            action_costs,
            cost,
            end,
            status,
            lower_bound,
            stopped_by,
            n_expanded: looked_at.n_expanded,
            n_generated: looked_at.n_generated,
            states: passed.map(|passed| passed.states),
        };
        Some((steps, mapping))
    }

    /// What is left to spend on what is ahead.
    fn budget_left(&self) -> Budget {
        self.budget.beside(size_of::<Self>() + self.committed.size_bytes())
    }

    /// How many observations are passed: up to the root's.
    fn n_passed(&self) -> u32 {
        self.committed.moves.last().map_or(0, |step| step.observation + 1)
    }

    /// Whether the lookahead past the root is used up.
    fn must_decide(&self) -> bool {
        self.lookahead.is_some_and(|lookahead| self.n_passed().saturating_add(lookahead.get()) <= self.n_observed)
    }

    /// Commits every step that all ways are known to share.
    fn commit_shared(&mut self, steps: &mut Vec<CommittedStep>) {
        while let Some(decided) = self.ahead.shared() {
            steps.push(self.commit(&decided, true));
        }
    }

    /// Commits the cheapest way to the newest observation, up to its first move that advances, and what all ways share that are left.
    fn commit_cheapest(&mut self, steps: &mut Vec<CommittedStep>, interrupt: &mut dyn Interrupt) -> Result<(), Halt> {
        let budget = self.budget_left();
        let decided = self.ahead.decide(budget, interrupt)?;
        self.was_forced = true;
        for decided in decided {
            steps.push(self.commit(&decided, false));
        }
        self.commit_shared(steps);
        Ok(())
    }

    fn commit(&mut self, decided: &Decided, is_proven: bool) -> CommittedStep {
        let step = self.committed.add(&self.model, self.conditions.recurrence(), decided);
        CommittedStep { step, is_proven, after: self.n_observed }
    }
}

/// What there is however small the model.
const BASE_BYTES: usize = 1 << 12;

/// About how many steps an observation has at most, with the room for more: bodies that need more are rare.
const MOVES_PER_OBSERVATION: usize = 8;
