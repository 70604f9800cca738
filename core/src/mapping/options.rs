//! Options: what a client may say in a request.
//!
//! [`Options`] is the one description of what requests of all kinds may say: its fields are documented as clients see them (OpenAPI is
//! derived from it), [`Options::read`] reads each of them and notes what is wrong with it, and [`RequestKind::fields`] says which request
//! may have which. A new option needs a line in each.

use std::num::NonZeroU32;
#[cfg(feature = "rules")]
use std::sync::Arc;
use std::time::Duration;

#[cfg(feature = "rules")]
use super::Perception;
use super::{Budget, Conditions, Demonstration, HeuristicName, Settings, longest_lookahead};
use crate::attribute::{Kind, Weights};
use crate::document::{Faults, Object, Path, Place, Range};
use crate::model::{ActionIdx, Model, Origin};

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
    /// A report, of a model and perhaps a demonstration.
    Report,
}

impl RequestKind {
    /// The names of the fields that a request may have, in the order in which they are listed where one is unknown.
    #[must_use]
    pub const fn fields(self) -> &'static [&'static str] {
        /// These, and those that say how a demonstration is followed.
        macro_rules! following {
            ($($own:literal),*) => {
                &[
                    $($own,)*
                    "weights",
                    "lookahead",
                    "start",
                    "observation_weights",
                    "extra_weight",
                    "end_weight",
                    "without",
                    "action_costs",
                    "unsafe_cost",
                ]
            };
        }
        match self {
            Self::Policy => {
                following!(
                    "model",
                    "demonstration",
                    "learner",
                    "heuristic",
                    "max_expansions",
                    "deadline_ms",
                    "collapse",
                    "observe",
                    "store"
                )
            }
            Self::Batch => {
                following!(
                    "model",
                    "items",
                    "learner",
                    "heuristic",
                    "max_expansions",
                    "deadline_ms",
                    "collapse",
                    "observe",
                    "store"
                )
            }
            Self::Item => following!("demonstration", "heuristic", "max_expansions", "collapse", "observe"),
            Self::Trial => {
                following!("model", "demonstration", "heuristic", "max_expansions", "deadline_ms", "observe")
            }
            Self::Session => following!("type", "model", "learner", "explore", "lookahead_ms", "observe"),
            Self::Report => {
                &["demonstration", "weights", "start", "observation_weights", "without", "deadline_ms", "observe"]
            }
        }
    }

    /// The field with what is to be followed, if the request has it.
    #[must_use]
    pub const fn observed(self) -> Option<&'static str> {
        match self {
            Self::Policy | Self::Item | Self::Trial | Self::Report => Some("demonstration"),
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
    /// Where the imitator may start: a state, or several, of which the mapping starts where that costs least. If left out, as the model
    /// says.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<super::StartReference>))]
    pub start: Option<Vec<Origin>>,
    /// How many observations past the current one a decision may wait for; `null`: all. With a number, the policy is what a
    /// stream with this lookahead gives, and the global optimum is found in the background (`refined_by`). It may reach so far that
    /// the observations it spans times the model's states are 134 million.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<u32>, minimum = 1, maximum = 100_000))]
    pub lookahead: Option<NonZeroU32>,
    /// The weight of each observation, at least 0 (`null`: 1), as many as there are observations; all 1 if left out. The distances to an
    /// observation are multiplied by its weight. No attribute adds more than 1e150 to a distance, however large the weight.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<Option<f64>>>))]
    pub observation_weights: Option<Vec<f64>>,
    /// The part of the distance that an action pays that does not meet the next observation, 0 to 1. 1 if left out: such a step pays the
    /// whole distance once more. 0 is for demonstrations whose observations are far apart (way points): only the step that meets an
    /// observation pays.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.0, maximum = 1.0))]
    pub extra_weight: Option<f64>,
    /// The weight of the end, at least 0; 0 if left out. The distance between the last state and the last observation is paid once more,
    /// multiplied by it. For tasks whose outcome matters more than the way to it.
    #[cfg_attr(feature = "openapi", schema(minimum = 0.0))]
    pub end_weight: Option<f64>,
    /// Names of actions that the body lacks, though its model has them.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<Vec<String>>))]
    pub without: Option<Vec<ActionIdx>>,
    /// By name of an action, what it costs instead of what the model says: finite, at least 0. A transition that has its own cost keeps
    /// that.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<BTreeMap<String, f64>>))]
    pub action_costs: Option<Vec<(ActionIdx, f64)>>,
    /// Leaves out what repeats itself: by attribute name, within what of the last observation kept an observation is dropped, if it is equal
    /// to it in all other attributes. The first and the last stay. The weights of dropped ones (`observation_weights`) are lost, `observation` in steps
    /// counts the original ones, a lookahead those that are kept. Each at least 0, in the attribute's units; not for categories.
    // By the attributes' positions.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<BTreeMap<String, f64>>, example = json!({"x": 0.5})))]
    pub collapse: Option<Vec<(usize, f64)>>,
    /// For a demonstrator whose states are told in another vocabulary: by name of the imitator's attributes, expressions of CEL over the
    /// attributes of the `demonstration`, or of the states of a stream, which are then the demonstrator's own. What is not named is not observed. All its numbers are
    /// doubles, and an integer in an expression is read as one beside them; what is missing or `null` is null, and what needs it is not
    /// observed. A name with a point is that of a member of a member.
    #[cfg(feature = "rules")]
    #[cfg_attr(feature = "openapi", schema(value_type = Option<BTreeMap<String, String>>, example = json!({"x": "east_m / 0.25", "door": "opening > 0.5 ? 'open' : 'shut'"})))]
    pub observe: Option<Arc<Perception>>,
    /// What an unsafe outcome of an action costs; only for stochastic models. `null`: actions with unsafe outcomes are not taken.
    pub unsafe_cost: Option<f64>,
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
        let Self { weights, start, without, action_costs, collapse, .. } = of_model?;
        Some(Self { weights, start, without, action_costs, collapse, ..general? })
    }

    /// These options, with those of `object` that depend on the model.
    pub fn read_of_model(&self, object: &Object<'_, '_>, model: &Model, faults: &mut Faults) -> Option<Self> {
        let weights = match object.optional("weights") {
            Some(place) => model.schema().read_named_weights(&place, faults),
            None => Some(Vec::new()),
        };
        let start = match object.optional("start") {
            Some(place) => model.read_starts(&place, faults).map(Some),
            None => Some(self.start.clone()),
        };
        let without = match object.optional("without") {
            Some(place) => model.read_action_names(&place, faults).map(Some),
            None => Some(self.without.clone()),
        };
        let action_costs = match object.optional("action_costs") {
            Some(place) => model.read_action_costs(&place, faults).map(Some),
            None => Some(self.action_costs.clone()),
        };
        let collapse = match object.optional("collapse") {
            Some(place) => read_collapse(&place, model, faults).map(Some),
            None => Some(self.collapse.clone()),
        };
        if let Some(place) = object.optional("unsafe_cost") {
            faults.note(
                &place,
                "only stochastic models have unsafe outcomes, and there are no policies for such models yet",
            );
            return None;
        }
        let weights = self.weights.iter().copied().chain(weights?).collect();
        let (start, without, action_costs, collapse) = (start?, without?, action_costs?, collapse?);
        Some(Self { weights, start, without, action_costs, collapse, ..self.clone() })
    }

    /// Reads the options that do not depend on the model.
    pub fn read_general(object: &Object<'_, '_>, base: &Self, faults: &mut Faults) -> Option<Self> {
        let mut options = base.clone();
        let n_before = faults.count();
        if let Some(place) = object.optional("observation_weights") {
            let weights = Self::read_observation_weights(&place, faults);
            options.observation_weights =
                weights.map(|weights| weights.into_iter().map(|weight| weight.unwrap_or(1.0)).collect());
        }
        if let Some(place) = object.optional("extra_weight") {
            options.extra_weight = place.number(Range::UpTo(1.0), faults);
        }
        if let Some(place) = object.optional("end_weight") {
            options.end_weight = place.number(Range::NonNegative, faults);
        }
        if let Some(place) = object.optional("heuristic") {
            options.heuristic = read_heuristic(&place, faults);
        }
        if let Some(place) = object.optional("lookahead") {
            options.lookahead = read_lookahead(&place, faults);
        }
        #[cfg(feature = "rules")]
        if let Some(place) = object.optional("observe") {
            options.observe = Perception::read(&place, faults).map(Arc::new);
        }
        if let Some(place) = object.optional("max_expansions") {
            options.max_expansions = place.integer(0, u64::MAX, faults);
        }
        if let Some(place) = object.optional("deadline_ms") {
            options.deadline_ms = place.integer(0, Self::MAX_DEADLINE_MS, faults);
        }
        (faults.count() == n_before).then_some(options)
    }

    /// Reads weights of observations: an array of numbers of at least 0, `null` where none is given.
    pub fn read_observation_weights(place: &Place<'_, '_>, faults: &mut Faults) -> Option<Vec<Option<f64>>> {
        let items = place.array(faults)?;
        let n_before = faults.count();
        let read = items.iter().enumerate().map(|(index, item)| {
            if item.is_null() { None } else { place.item(index, item).number(Range::NonNegative, faults) }
        });
        let weights = read.collect();
        (faults.count() == n_before).then_some(weights)
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

    /// The conditions that they make.
    #[must_use]
    pub fn conditions(&self) -> Conditions {
        Conditions {
            starts: self.start.clone(),
            observation_weights: self.observation_weights.clone().unwrap_or_default(),
            extra_weight: self.extra_weight.unwrap_or(Conditions::DEFAULT_EXTRA_WEIGHT),
            end_weight: self.end_weight.unwrap_or(Conditions::DEFAULT_END_WEIGHT),
            without: self.without.clone().unwrap_or_default(),
            action_costs: self.action_costs.clone().unwrap_or_default(),
            collapse: self.collapse.clone(),
        }
    }

    /// Notes that `object`, or else these options, which it shares, have not as many weights of observations as these.
    pub(crate) fn check_observation_weights(
        &self,
        n_observations: usize,
        object: &Object<'_, '_>,
        faults: &mut Faults,
    ) {
        let own = object.optional("observation_weights").map(|place| place.value.as_array().map(Vec::len));
        let shared = || self.observation_weights.as_ref().map(Vec::len);
        // What is no array is a fault already.
        if let Some(n_weights) = own.unwrap_or_else(shared).filter(|n_weights| *n_weights != n_observations) {
            let path = Path::Member(&object.path, "observation_weights");
            let detail = format!("expected one for each of the {n_observations} observations, found {n_weights}");
            faults.note_at(&path, detail);
        }
    }

    /// How to search.
    pub(super) fn settings(&self) -> Settings {
        let max_expansions = self.max_expansions.unwrap_or(Budget::DEFAULT.max_expansions);
        Settings {
            heuristic: self.heuristic.unwrap_or_default(),
            budget: Budget { max_expansions, ..Budget::DEFAULT },
            upper_bound: None,
        }
    }

    /// Notes that a demonstration cannot be followed without a lookahead while it is running, if `model` is searched lazily.
    pub fn check_has_lookahead(&self, model: &Model, object: &Object<'_, '_>, faults: &mut Faults) {
        if self.lookahead.is_none() && model.is_lazy() {
            let detail = "this world is searched lazily, and what is proven follows from the ways to all states: set a number, such as 8";
            faults.note_at(&Path::Member(&object.path, "lookahead"), detail);
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

/// Reads a lookahead: 1 to the most observations that there can be.
fn read_lookahead(place: &Place<'_, '_>, faults: &mut Faults) -> Option<NonZeroU32> {
    let lookahead = place.integer(1, Demonstration::MAX_OBSERVATIONS as u64, faults)?;
    u32::try_from(lookahead).ok().and_then(NonZeroU32::new)
}

/// Reads within what observations are dropped: by attribute that is no category.
fn read_collapse(place: &Place<'_, '_>, model: &Model, faults: &mut Faults) -> Option<Vec<(usize, f64)>> {
    let schema = model.schema();
    let within = schema.read_named_weights(place, faults)?;
    let of_category = within.iter().find(|(position, _)| matches!(schema.attributes()[*position].kind, Kind::Category));
    if let Some((position, _)) = of_category {
        let path = Path::Member(&place.path, &schema.attributes()[*position].name);
        faults.note_at(&path, "two values of a category are equal or not: leave it out, and they must be equal");
        return None;
    }
    Some(within)
}

fn read_heuristic(place: &Place<'_, '_>, faults: &mut Faults) -> Option<HeuristicName> {
    let named = HeuristicName::ALL.into_iter().find(|(name, _)| place.value.as_str() == Some(name));
    match named {
        Some((_, heuristic)) => Some(heuristic),
        None => place.mismatch("one of \"default\", \"paper\", \"none\"", faults),
    }
}
