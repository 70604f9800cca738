//! What a client asks for: a demonstration, and how it is to be followed.

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
use crate::document::{Faults, Object, Place};
use crate::interrupt::{Cancelled, Interrupt, Signal};
use crate::model::{Model, Origin, StateIdx};

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
    /// Longest deadline: a day.
    const MAX_DEADLINE_MS: u64 = 86_400_000;

    /// Every field of a request.
    pub const FIELDS: [&'static str; 9] = [
        "model",
        "demonstration",
        "weights",
        "learner",
        "lookahead",
        "start",
        "heuristic",
        "max_expansions",
        "deadline_ms",
    ];

    /// Reads a request against the model that it names. The names themselves (`model`, `learner`) are the caller's.
    pub fn read(model: &'m Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        Self::read_over(model, object, |_| Some(model.schema().weights()), faults)
    }

    /// Reads a request like [`Self::read`], with weights from `base` where it names none. `base` is called last, so that it
    /// knows whether faults were noted.
    pub fn read_over(
        model: &'m Model,
        object: &Object<'_, '_>,
        base: impl FnOnce(&mut Faults) -> Option<Weights>,
        faults: &mut Faults,
    ) -> Option<Self> {
        let demonstration = object.required("demonstration", faults);
        let demonstration = demonstration.and_then(|place| {
            // Before it is read: small observations make as large steps as others.
            let n_observations = place.value.as_array().map_or(0, Vec::len);
            let is_answerable = n_observations > Demonstration::MAX_OBSERVATIONS
                || Policy::check_size(model, n_observations, &place, faults);
            is_answerable.then(|| Demonstration::read(model.schema(), &place, faults)).flatten()
        });
        Self::read_beside(demonstration, model, object, base, faults)
    }

    /// Reads a request like [`Self::read_over`], whose demonstration was read before; `None` if that has faults. It must be one whose
    /// policy is not too large.
    pub fn read_beside(
        demonstration: Option<Demonstration>,
        model: &'m Model,
        object: &Object<'_, '_>,
        base: impl FnOnce(&mut Faults) -> Option<Weights>,
        faults: &mut Faults,
    ) -> Option<Self> {
        let conditions = Conditions::read(model, object, faults);
        let options = Self::read_options(object, faults);
        Self::check_lookahead(model, object, faults);
        if let (Some(Options { lookahead: Some(lookahead), .. }), Some(place)) = (options, object.optional("lookahead"))
        {
            let n_observations = demonstration.as_ref().map_or(0, Demonstration::len);
            Self::check_window(model, lookahead, n_observations, Budget::DEFAULT.max_bytes, &place, faults);
        }
        let base = base(faults)?;
        let conditions = conditions?;
        let Options { settings, lookahead, deadline } = options?;
        let problem = Problem::new(model, demonstration?, conditions.weights_over(base), conditions.start);
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
            match signal {
                Signal::Continue => {}
                Signal::Finish => {
                    let stopped_by = if is_spent { StoppedBy::MaxExpansions } else { StoppedBy::Deadline };
                    let spent = (online.n_expanded(), online.n_generated());
                    return self.complete(mapper, online.into_moves(), stopped_by, spent, interrupt);
                }
                Signal::Cancel => return Err(Cancelled),
            }
            let mut is_over = false;
            let mut until_over = || match interrupt.poll() {
                Signal::Finish => {
                    is_over = true;
                    Signal::Cancel
                }
                signal => signal,
            };
            let stopped_by = match online.observe(observation, &mut until_over) {
                Ok(_) => continue,
                Err(Stopped::Cancelled(_)) if is_over => StoppedBy::Deadline,
                Err(Stopped::Cancelled(cancelled)) => return Err(cancelled),
                Err(Stopped::Memory) => StoppedBy::Memory,
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

    /// Notes a lookahead at all in a world that is searched lazily.
    pub fn check_lookahead(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) {
        if let Some(place) = object.optional("lookahead").filter(|_| model.is_lazy()) {
            faults.note(&place, "this world is searched lazily, which needs the whole demonstration: leave this out");
        }
    }

    /// Notes at `place` a lookahead over so many observations, at most, that would take more than about `max_bytes`.
    pub fn check_window(
        model: &Model,
        lookahead: NonZeroU32,
        n_observations: usize,
        max_bytes: usize,
        place: &Place<'_, '_>,
        faults: &mut Faults,
    ) {
        let longest = longest_lookahead(model, max_bytes);
        let reach = usize::try_from(lookahead.get()).unwrap_or(usize::MAX).min(n_observations.saturating_sub(1));
        if !model.is_lazy() && reach > longest as usize {
            let n_states = model.states().len();
            let detail = format!(
                "a lookahead over {reach} observations is too far for a model of {n_states} states, where it may be {longest}: \
                 make it shorter, or leave it out"
            );
            faults.note(place, detail);
        }
    }

    /// Reads what does not depend on the model.
    pub fn read_options(object: &Object<'_, '_>, faults: &mut Faults) -> Option<Options> {
        let heuristic = match object.optional("heuristic") {
            Some(place) => read_heuristic(&place, faults),
            None => Some(HeuristicName::Default),
        };
        let lookahead = match object.optional("lookahead") {
            Some(place) => read_lookahead(&place, faults).map(Some),
            None => Some(None),
        };
        let max_expansions = match object.optional("max_expansions") {
            Some(place) => place.integer(0, u64::MAX, faults),
            None => Some(Budget::DEFAULT.max_expansions),
        };
        let deadline = match object.optional("deadline_ms") {
            Some(place) => place.integer(0, Self::MAX_DEADLINE_MS, faults).map(|ms| Some(Duration::from_millis(ms))),
            None => Some(None),
        };
        let budget = Budget { max_expansions: max_expansions?, ..Budget::DEFAULT };
        let settings = Settings { heuristic: heuristic?, budget, upper_bound: None };
        Some(Options { settings, lookahead: lookahead?, deadline: deadline? })
    }
}

/// Under which weights a demonstration is to be followed, and from where: what requests of all kinds may say.
#[derive(Debug)]
pub struct Conditions {
    /// Weights by the attributes' positions.
    named: Vec<(usize, f64)>,
    /// The start, if one is named.
    pub start: Option<Origin>,
}

impl Conditions {
    /// Reads the members `weights` and `start`.
    pub fn read(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let named = match object.optional("weights") {
            Some(place) => model.schema().read_named_weights(&place, faults),
            None => Some(Vec::new()),
        };
        let start = match object.optional("start") {
            Some(place) => model.read_start(&place, faults).map(Some),
            None => Some(None),
        };
        Some(Self { named: named?, start: start? })
    }

    /// The weights that are named, and those of `base` for the others.
    #[must_use]
    pub fn weights_over(&self, mut base: Weights) -> Weights {
        for (position, weight) in &self.named {
            base.set(*position, *weight);
        }
        base
    }
}

/// What a request says besides its problem.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Options {
    /// How to search.
    pub settings: Settings,
    /// How many observations past the current one a decision may wait for; `None` for all.
    pub lookahead: Option<NonZeroU32>,
    /// How long it may take, counted from when the request arrived.
    pub deadline: Option<Duration>,
}

/// Reads a lookahead: 1 to the most observations that there can be.
pub fn read_lookahead(place: &Place<'_, '_>, faults: &mut Faults) -> Option<NonZeroU32> {
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

/// A request for a policy, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = PolicyRequest))]
pub struct RequestDocument {
    /// Name of the imitator's model.
    #[cfg_attr(feature = "openapi", schema(example = "figure-4"))]
    pub model: String,
    /// The observed states, in order: 1 to 100,000, or fewer if the policy's states would take more than 64 MB. Attributes
    /// may be missing or null: not observed.
    pub demonstration: Vec<ObservationDocument>,
    /// Weights by attribute name, each at least 0; attributes not named keep the model's. No attribute adds more than 1e150 to
    /// a distance, however large its weight.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<BTreeMap<String, f64>>,
    /// Name of a learner whose mean weights are used, for attributes that `weights` does not name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learner: Option<String>,
    /// How many observations past the current one a decision may wait for; `null`: all. With a number, the policy is what a
    /// stream with this lookahead gives, and the global optimum is found in the background (`refined_by`). It may reach so far that
    /// the observations it spans times the model's states are 134 million. Not for a world that is searched lazily.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 100_000))]
    pub lookahead: Option<u32>,
    /// Where the imitator starts; the model's start if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartReference>,
    /// What guides the search.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heuristic: Option<HeuristicName>,
    /// Most nodes to expand; then the best mapping found so far is answered, with `status` `bounded`. With a lookahead, each
    /// observation expands every state once, and again where its layer is made anew; then the rest is followed greedily.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_expansions: Option<u64>,
    /// Most milliseconds to search, waiting included; then as above. At most a day.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(maximum = 86_400_000))]
    pub deadline_ms: Option<u64>,
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
    Index(StateIdx),
    /// Values by attribute name.
    Values(BTreeMap<String, Scalar>),
}
