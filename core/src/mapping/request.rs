//! Requests: what a client may say, and what it comes to for a model.
//!
//! [`Options`] is the one description of what requests of all kinds may say: its fields are documented as clients see them (OpenAPI is
//! derived from it), [`Options::read`] reads each of them and notes what is wrong with it, and [`RequestKind::fields`] says which request
//! may have which. A new option needs a line in each.

use std::collections::BTreeMap;
use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{
    Budget, Demonstration, HeuristicName, Mapper, Mapping, Move, MoveKind, OnlineMapping, Policy, Problem, Settings,
    Stopped, StoppedBy, longest_lookahead,
};
use crate::attribute::{Scalar, Weights};
use crate::document::{Faults, Object, Path, Place};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::{Model, Origin, StateIdx};

/// What is requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RequestKind {
    /// A policy.
    Policy,
    /// Policies for many demonstrations.
    Batch,
    /// One of them.
    Item,
    /// A trial of a learner.
    Trial,
    /// A session, which observations are streamed to.
    Session,
}

impl RequestKind {
    /// The names of the fields that a request may have, in the order in which they are listed where one is unknown.
    #[must_use]
    pub const fn fields(self) -> &'static [&'static str] {
        match self {
            Self::Policy => &[
                "model",
                "demonstration",
                "weights",
                "learner",
                "lookahead",
                "start",
                "heuristic",
                "max_expansions",
                "deadline_ms",
                "store",
            ],
            Self::Batch => &[
                "model",
                "items",
                "weights",
                "learner",
                "lookahead",
                "start",
                "heuristic",
                "max_expansions",
                "deadline_ms",
                "store",
            ],
            Self::Item => &["demonstration", "weights", "lookahead", "start", "heuristic", "max_expansions"],
            Self::Trial => &["model", "demonstration", "start", "lookahead"],
            Self::Session => &["type", "model", "learner", "explore", "weights", "lookahead", "start"],
        }
    }

    /// The field with what is to be followed, if the request has it.
    #[must_use]
    pub const fn observed(self) -> Option<&'static str> {
        match self {
            Self::Policy | Self::Item | Self::Trial => Some("demonstration"),
            Self::Batch => Some("items"),
            Self::Session => None,
        }
    }
}

/// What a request says besides what is to be followed.
#[derive(Clone, Debug, Default, PartialEq)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Options {
    /// Weights by attribute name, each at least 0; attributes not named keep the model's. No attribute adds more than 1e150 to
    /// a distance, however large its weight.
    // By the attributes' positions.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<BTreeMap<String, f64>>))]
    pub weights: Vec<(usize, f64)>,
    /// Where the imitator starts; the model's start if left out.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<StartReference>))]
    pub start: Option<Origin>,
    /// How many observations past the current one a decision may wait for; `null`: all. With a number, the policy is what a
    /// stream with this lookahead gives, and the global optimum is found in the background (`refined_by`). It may reach so far that
    /// the observations it spans times the model's states are 134 million. Not for a world that is searched lazily.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<u32>, minimum = 1, maximum = 100_000))]
    pub lookahead: Option<NonZeroU32>,
    /// What guides the search.
    pub heuristic: Option<HeuristicName>,
    /// Most nodes to expand; then the best mapping found so far is answered, with `status` `bounded`. With a lookahead, each
    /// observation expands every state once, and again where its layer is made anew; then the rest is followed greedily.
    pub max_expansions: Option<u64>,
    /// Most milliseconds to search, waiting included; then as above. At most a day.
    #[cfg_attr(feature = "openapi", schema(maximum = 86_400_000))]
    pub deadline_ms: Option<u64>,
}

impl Options {
    /// Longest deadline: a day.
    const MAX_DEADLINE_MS: u64 = 86_400_000;

    /// Reads the options among the members of `object`. Those that it does not have are those of `base`.
    pub fn read(object: &Object<'_, '_>, model: &Model, base: &Self, faults: &mut Faults) -> Option<Self> {
        let of_model = base.read_of_model(object, model, faults);
        let general = Self::read_general(object, base, faults);
        let Self { weights, start, .. } = of_model?;
        Some(Self { weights, start, ..general? })
    }

    /// These options, with those of `object` that depend on the model.
    pub fn read_of_model(&self, object: &Object<'_, '_>, model: &Model, faults: &mut Faults) -> Option<Self> {
        let weights = match object.optional("weights") {
            Some(place) => model.schema().read_named_weights(&place, faults),
            None => Some(Vec::new()),
        };
        let start = match object.optional("start") {
            Some(place) => model.read_start(&place, faults).map(Some),
            None => Some(self.start.clone()),
        };
        let weights = self.weights.iter().copied().chain(weights?).collect();
        Some(Self { weights, start: start?, ..*self })
    }

    /// Reads the options that do not depend on the model.
    pub fn read_general(object: &Object<'_, '_>, base: &Self, faults: &mut Faults) -> Option<Self> {
        let mut options = base.clone();
        let n_before = faults.count();
        if let Some(place) = object.optional("heuristic") {
            options.heuristic = read_heuristic(&place, faults);
        }
        if let Some(place) = object.optional("lookahead") {
            options.lookahead = read_lookahead(&place, faults);
        }
        if let Some(place) = object.optional("max_expansions") {
            options.max_expansions = place.integer(0, u64::MAX, faults);
        }
        if let Some(place) = object.optional("deadline_ms") {
            options.deadline_ms = place.integer(0, Self::MAX_DEADLINE_MS, faults);
        }
        (faults.count() == n_before).then_some(options)
    }

    /// The weights that are named, and those of `base` for the others.
    #[must_use]
    pub fn weights_over(&self, mut base: Weights) -> Weights {
        for (position, weight) in &self.weights {
            base.set(*position, *weight);
        }
        base
    }

    /// How long the search may take, counted from when the request arrived.
    #[must_use]
    pub fn deadline(&self) -> Option<Duration> {
        self.deadline_ms.map(Duration::from_millis)
    }

    /// How to search.
    fn settings(&self) -> Settings {
        let max_expansions = self.max_expansions.unwrap_or(Budget::DEFAULT.max_expansions);
        Settings {
            heuristic: self.heuristic.unwrap_or_default(),
            budget: Budget { max_expansions, ..Budget::DEFAULT },
            upper_bound: None,
        }
    }

    /// Notes a lookahead at all in a world that is searched lazily.
    pub fn check_lookahead_is_possible(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) {
        if let Some(place) = object.optional("lookahead").filter(|_| model.is_lazy()) {
            faults.note(&place, "this world is searched lazily, which needs the whole demonstration: leave this out");
        }
    }

    /// Notes what is wrong with the lookahead for a demonstration of so many observations, whose window may take about `max_bytes`.
    /// `object` is what the options were read from.
    pub fn check_lookahead(
        &self,
        model: &Model,
        n_observations: usize,
        max_bytes: usize,
        object: &Object<'_, '_>,
        faults: &mut Faults,
    ) {
        let path = Path::Member(&object.path, "lookahead");
        let Some(lookahead) = self.lookahead else { return };
        if model.is_lazy() {
            return;
        }
        let longest = longest_lookahead(model, max_bytes);
        let reach = usize::try_from(lookahead.get()).unwrap_or(usize::MAX).min(n_observations.saturating_sub(1));
        if reach > longest as usize {
            let n_states = model.states().len();
            let detail = format!(
                "a lookahead over {reach} observations is too far for a model of {n_states} states, where it may be {longest}: \
                 make it shorter, or leave it out"
            );
            faults.note_at(&path, detail);
        }
    }
}

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

    /// Reads the demonstration of a request.
    pub fn read_demonstration(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Demonstration> {
        let place = object.required("demonstration", faults)?;
        // Before it is read: small observations make as large steps as others.
        let n_observations = place.value.as_array().map_or(0, Vec::len);
        let is_answerable = n_observations > Demonstration::MAX_OBSERVATIONS
            || Policy::check_size(model, n_observations, &place, faults);
        is_answerable.then(|| Demonstration::read(model.schema(), &place, faults)).flatten()
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
        Options::check_lookahead_is_possible(model, object, faults);
        if let Some(options) = &options {
            let n_observations = demonstration.as_ref().map_or(0, Demonstration::len);
            options.check_lookahead(model, n_observations, Budget::DEFAULT.max_bytes, object, faults);
        }
        let weights = weights(faults)?;
        let options = options?;
        let (settings, lookahead, deadline) = (options.settings(), options.lookahead, options.deadline());
        let problem = Problem::new(model, demonstration?, options.weights_over(weights), options.start);
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
        let n_states = problem.model.graph().n_states() as u64;
        let weights = problem.weights.clone();
        let max_bytes = self.settings.budget.max_bytes;
        let mut online = OnlineMapping::new(mapper, weights, Some(problem.start), self.lookahead).within(max_bytes);
        for observation in problem.demonstration.iter() {
            let is_spent = online.n_expanded().saturating_add(n_states) > self.settings.budget.max_expansions;
            let signal = if is_spent { Signal::Finish } else { interrupt.poll() };
            let mut is_over = false;
            let mut until_over = || match interrupt.poll() {
                Signal::Finish => {
                    is_over = true;
                    Signal::Cancel
                }
                signal => signal,
            };
            let stopped_by = match signal {
                Signal::Cancel => return Err(Cancelled),
                Signal::Finish if is_spent => StoppedBy::MaxExpansions,
                Signal::Finish => StoppedBy::Deadline,
                Signal::Continue => match online.observe(observation, &mut until_over) {
                    Ok(_) => continue,
                    Err(Stopped::Cancelled(_)) if is_over => StoppedBy::Deadline,
                    Err(Stopped::Cancelled(cancelled)) => return Err(cancelled),
                    Err(Stopped::Memory) => StoppedBy::Memory,
                },
            };
            let spent = (online.n_expanded(), online.n_generated());
            return self.complete(mapper, online.into_moves(), stopped_by, spent, interrupt);
        }
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
        let n_observations = problem.demonstration.len();
        match lookahead {
            None => mapper.search_bytes(problem, *settings),
            Some(_) => {
                OnlineMapping::most_bytes(mapper.model(), *lookahead, n_observations).min(settings.budget.max_bytes)
            }
        }
    }

    /// A mapping that begins with `moves`, for which so many nodes and transitions were looked at, and goes on greedily, as `stopped_by`
    /// ran out.
    fn complete(
        &self,
        mapper: &Mapper,
        mut moves: Vec<Move>,
        stopped_by: StoppedBy,
        (n_expanded, n_generated): (u64, u64),
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        if moves.is_empty() {
            moves.push(Move { kind: MoveKind::Start, action: None, observation: 0, state: self.problem.start });
        }
        let mapping = mapper.complete(&self.problem, moves, stopped_by, interrupt)?;
        Ok(Mapping { n_expanded, n_generated, ..mapping })
    }
}

/// Reads a lookahead: 1 to the most observations that there can be.
fn read_lookahead(place: &Place<'_, '_>, faults: &mut Faults) -> Option<NonZeroU32> {
    let lookahead = place.integer(1, Demonstration::MAX_OBSERVATIONS as u64, faults)?;
    u32::try_from(lookahead).ok().and_then(NonZeroU32::new)
}

fn read_heuristic(place: &Place<'_, '_>, faults: &mut Faults) -> Option<HeuristicName> {
    let named = HeuristicName::ALL.into_iter().find(|(name, _)| place.value.as_str() == Some(name));
    match named {
        Some((_, heuristic)) => Some(heuristic),
        None => place.mismatch("one of \"default\", \"paper\", \"none\"", faults),
    }
}

/// An observed state: an object by attribute name, or an array of values in attribute order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
#[cfg_attr(feature = "openapi", schema(as = Observation))]
pub enum ObservationDocument {
    /// By attribute name; those left out were not observed.
    ByName(BTreeMap<String, ObservedDocument>),
    /// In attribute order.
    InOrder(Vec<ObservedDocument>),
}

/// An observed value; `null` was not observed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Observed))]
pub struct ObservedDocument(pub Option<Scalar>);

/// A state: its index, or attribute values that exactly one state has. In a world that is searched lazily, all attribute values but that
/// of `gold`, which may be left out; there, only the start has an index, 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(untagged)]
pub enum StartReference {
    /// The state's index.
    #[cfg_attr(feature = "openapi", schema(value_type = u32))]
    Index(StateIdx),
    /// Values by attribute name.
    Values(BTreeMap<String, Scalar>),
}
