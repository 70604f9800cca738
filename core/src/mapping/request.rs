//! Requests for a policy: what one comes to for a model, and how it is solved.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use super::online::Halt;
use super::{
    Budget, Demonstration, Mapper, Mapping, OnlineMapping, Options, Policy, Problem, RequestKind, Settings, StoppedBy,
};
use crate::attribute::Weights;
use crate::document::{Faults, Object, Place};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::Model;

/// A request for a policy, checked against its model.
#[derive(Debug)]
pub struct Request<'m> {
    /// What is to be solved.
    pub problem: Problem<'m>,
    /// How.
    pub settings: Settings,
    /// How many observations past the current one a decision may wait for; `None` for all.
    pub lookahead: Option<NonZeroU32>,
    /// How long it may take, counted from when the request arrived.
    pub deadline: Option<Duration>,
}

impl<'m> Request<'m> {
    /// Every field of a request for a policy.
    pub const FIELDS: &'static [&'static str] = RequestKind::Policy.fields();

    /// Reads a request against the model that it names. The names themselves (`model`, `learner`) are the caller's.
    pub fn read(model: &'m Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let demonstration = Self::read_demonstration(model, object, faults);
        Self::of(demonstration, model, object, &Options::default(), |_| Some(model.schema().weights()), faults)
    }

    /// Reads the demonstration of a request; if it says how to `observe`, what is observed of it. What is wrong with that itself, the
    /// options tell.
    pub fn read_demonstration(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Demonstration> {
        let place = object.required("demonstration", faults)?;
        #[cfg(feature = "rules")]
        if let Some(observe) = object.optional("observe") {
            let perception = super::Perception::read(&observe, &mut Faults::default())?;
            let observed = perception.observe_all(&place, &observe.path, faults)?;
            return Self::read_observed(model, &Place { value: &observed, path: place.path }, faults);
        }
        Self::read_observed(model, &place, faults)
    }

    fn read_observed(model: &Model, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Demonstration> {
        // Before it is read: small observations make as large steps as others.
        let n_observations = place.value.as_array().map_or(0, Vec::len);
        let is_answerable = n_observations > Demonstration::MAX_OBSERVATIONS
            || Policy::check_size(model, n_observations, place, faults);
        is_answerable.then(|| Demonstration::read(model.schema(), place, faults)).flatten()
    }

    /// The request to follow `demonstration` with the options of `object`, and those of `shared` for what it does not say. `None` for a
    /// demonstration with faults, which are noted. `weights` are those from which the request starts; they are asked for last, so that
    /// it is known whether faults were noted.
    pub fn of(
        demonstration: Option<Demonstration>,
        model: &'m Model,
        object: &Object<'_, '_>,
        shared: &Options,
        weights: impl FnOnce(&mut Faults) -> Option<Weights>,
        faults: &mut Faults,
    ) -> Option<Self> {
        let options = Options::read(object, model, shared, faults);
        Options::check_model(model, object, faults);
        let n_observations = demonstration.as_ref().map_or(0, Demonstration::len);
        if let Some(options) = &options {
            options.check_lookahead(model, n_observations, Budget::DEFAULT.max_bytes, object, faults);
        }
        if demonstration.is_some() {
            shared.check_observation_weights(n_observations, object, faults);
        }
        let weights = weights(faults)?;
        let options = options?;
        let (settings, lookahead, deadline) = (options.settings(), options.lookahead, options.deadline());
        let problem = Problem::new(model, demonstration?, options.weights_over(weights), options.conditions());
        Some(Self { problem, settings, lookahead, deadline })
    }

    /// The mapping that is asked for, of `mapper`'s model: with a lookahead, the one that a stream of the demonstration gives.
    /// Where the budget runs out or `interrupt` says to finish before the demonstration has ended, the rest is followed greedily.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    ///
    /// # Panics
    ///
    /// If the request is of another model.
    pub fn solve(&self, mapper: &Arc<Mapper>, interrupt: &mut dyn Interrupt) -> Result<Mapping, Cancelled> {
        let problem = &self.problem;
        if self.lookahead.is_none() {
            return mapper.map(problem, self.settings, interrupt);
        }
        let (weights, conditions) = (problem.weights.clone(), problem.conditions.clone());
        let online = OnlineMapping::new(mapper, weights, conditions, self.lookahead);
        let mut online = online.spending(self.settings.budget);
        for observation in problem.demonstration.iter() {
            let taken = match interrupt.poll() {
                Signal::Continue => online.take(observation, None, interrupt),
                Signal::Finish => Err(Halt::OutOf(StoppedBy::Deadline)),
                Signal::Cancel => Err(Halt::Cancelled),
            };
            match taken {
                Ok(_) => {}
                Err(Halt::Cancelled) => return Err(Cancelled),
                Err(Halt::OutOf(stopped_by)) => {
                    let (n_expanded, n_generated) = online.n_looked_at();
                    let (moves, states) = online.into_moves();
                    let mapping = mapper.complete(problem, moves, states.as_ref(), stopped_by, interrupt)?;
                    return Ok(Mapping { n_expanded, n_generated, ..mapping });
                }
            }
        }
        online.find_rest(interrupt)?;
        let (_, mapping) = online.end().expect("a demonstration is never empty");
        Ok(mapping)
    }

    /// About how much memory [`Self::solve`] takes at most, in bytes: the budget, or less if the problem is small. With this as its
    /// budget, it gives what it gives with the one in its settings.
    ///
    /// # Panics
    ///
    /// If the request is of another model than `mapper`.
    #[must_use]
    pub fn search_bytes(&self, mapper: &Mapper) -> usize {
        let Self { problem, settings, lookahead, .. } = self;
        match lookahead {
            None => mapper.search_bytes(problem, *settings),
            Some(_) => OnlineMapping::most_bytes(mapper, problem, *lookahead).min(settings.budget.max_bytes),
        }
    }
}
