//! What an inspection finds, as it is answered.

use serde::{Deserialize, Serialize};

use super::reached::{MAX_EXAMPLES, MAX_EXPLORED};
use super::{Extent, Parts, Reached};
use crate::attribute::{ByAttribute, KindName, Scalar};
use crate::mapping::Warning;
use crate::model::{Model, StateIdx};

/// What an inspection finds in a model, and what of a demonstration its body can never meet.
///
/// The body comes to the states that it can reach from its start states by actions none of whose outcomes is unsafe. What takes a
/// sample or could not be found is said where it stands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = ModelReport))]
pub struct Report {
    /// Name of the model.
    #[cfg_attr(feature = "openapi", schema(example = "corridor"))]
    pub model: String,
    /// SHA-256 of the model's content.
    pub model_hash: String,
    /// The weights by which states are compared.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, f64>))]
    pub weights: ByAttribute<f64>,
    /// How much of everything the model has, whether the body comes to it or not.
    pub counts: ReportCounts,
    /// What the body comes to. `null` if that is not known.
    pub reach: Option<ReachReport>,
    /// The parts in which the body can go to and fro. `null` if they are not known.
    pub parts: Option<PartsReport>,
    /// The attributes, in order.
    pub attributes: Vec<AttributeReport>,
    /// The actions that the body has, in order.
    pub actions: Vec<ActionReport>,
    /// How many actions it takes to undo one. `null` if there was no time for it.
    pub undo: Option<UndoReport>,
    /// How many observations a stream should look ahead: one more than the most actions that it takes to undo one, at most 100,000. With fewer, a
    /// body that has to go a long way round does not see that it is worth it. What can never be undone may need more. `null`: see `unknown`.
    pub lookahead: Option<u64>,
    /// What of the demonstration the body can never meet; `null` without one.
    pub demonstration: Option<DemonstrationReport>,
    /// What was not found, and why.
    pub unknown: Vec<Unknown>,
}

/// How much of everything a model has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReportCounts {
    /// Attributes.
    pub attributes: u64,
    /// Actions.
    pub actions: u64,
    /// States; `null` if the model is searched lazily.
    pub states: Option<u64>,
    /// Transitions; `null` if the states are.
    pub transitions: Option<u64>,
    /// Pairs of a state and an action that have several outcomes.
    pub stochastic: u64,
    /// States that must never be entered.
    #[serde(rename = "unsafe")]
    pub n_unsafe: u64,
}

/// What a body comes to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ReachReport {
    /// How many start states there are.
    pub starts: u64,
    /// To how many states the body comes, start states among them.
    pub states: u64,
    /// How many transitions there are between these, without those that lead to where they begin or that the body cannot or must not make.
    pub transitions: u64,
    /// The states to which it never comes, without unsafe ones.
    pub unreachable: StatesReport,
    /// The states, of those to which it comes, that no action leaves.
    pub dead_ends: StatesReport,
}

/// Some states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StatesReport {
    /// How many there are.
    pub states: u64,
    /// The first five of them.
    pub examples: Vec<StateExample>,
}

/// A state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct StateExample {
    /// Its index in the model; `null` if that is searched lazily.
    pub state_index: Option<u32>,
    /// Its values.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, Scalar>))]
    pub state: ByAttribute<Scalar>,
}

/// Parts: sets of states, as large as can be, between any two of which the body can go to and fro (strongly connected components).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PartsReport {
    /// How many parts there are. 1: the body can undo whatever it does.
    pub parts: u64,
    /// How many of them no action leaves.
    #[serde(rename = "final")]
    pub n_final: u64,
    /// The ten largest, the largest first.
    pub largest: Vec<Part>,
}

/// A part in which the body can go to and fro.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = ModelPart))]
pub struct Part {
    /// How many states it has.
    pub states: u64,
    /// How many of them are start states.
    pub starts: u64,
    /// Whether no action leaves it.
    #[serde(rename = "final")]
    pub is_final: bool,
    /// One of its states.
    pub example: StateExample,
}

/// An attribute, and what states have of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct AttributeReport {
    /// Its name.
    pub name: String,
    /// How its values are compared.
    pub kind: KindName,
    /// Its weight.
    pub weight: f64,
    /// Whether it is never observed nor compared.
    pub hidden: bool,
    /// How many different values the states have to which the body comes; if these are not known, that states may have.
    pub distinct: u64,
    /// From where to where its values go; `null` if they are no numbers.
    pub span: Option<Span>,
    /// Its values; `null` if they are numbers, or more than 32.
    pub values: Option<Vec<Scalar>>,
    /// How many of the transitions change it; 0: it stays what it is at the start. `null` if it may change and it is not known how often.
    pub changed_by: Option<u64>,
}

/// From one number to another.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = NumberSpan))]
pub struct Span {
    /// The least.
    pub least: f64,
    /// The greatest.
    pub greatest: f64,
}

/// An action, and what it does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct ActionReport {
    /// Its name.
    pub name: String,
    /// What it costs.
    pub cost: f64,
    /// In how many of the states to which the body comes it has an effect; 0: it never applies. `null` if it may and that is not known.
    pub applies_in: Option<u64>,
    /// The most actions that it takes to undo it, as far as that was looked for; `null` if it was never seen to be undone.
    pub undone_in: Option<u64>,
    /// How many of its transitions, as far as they were looked at, nothing undoes. `null` if there was no time for it.
    pub never_undone: Option<u64>,
}

/// How many actions it takes to undo one: after a transition from one state to another, the fewest by which the body comes to a state with the
/// values of the first, in all attributes that weigh something. If actions have several outcomes, those that are wanted are what counts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UndoReport {
    /// Whether all transitions were looked at, and what was found of each is certain. If not, those from an even sample of the states were, or of a model
    /// that is searched lazily, from states close to the start; and more actions may be needed elsewhere.
    pub exact: bool,
    /// How many transitions there are, as far as they are known.
    pub transitions: u64,
    /// How many of them were looked at.
    pub examined: u64,
    /// How many of these can never be undone.
    pub never: u64,
    /// How many of these were not seen to be undone within what may be looked at for each.
    pub not_found: u64,
    /// How many actions undo the others; `null` if there are none.
    pub steps: Option<Steps>,
}

/// How many actions undo one, by how many of those that can be undone.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = UndoSteps))]
pub struct Steps {
    /// So many undo half of them, or fewer.
    pub median: u64,
    /// So many undo 99 of 100, or fewer.
    pub p99: u64,
    /// So many undo all of them, or fewer.
    pub greatest: u64,
}

/// What of a demonstration a body can never meet, wherever it goes, and what that costs at least.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct DemonstrationReport {
    /// How many observations there are.
    pub observations: u64,
    /// How many of them are met by some state to which the body comes, in all attributes that weigh something. `null` if that is not known.
    pub met: Option<u64>,
    /// The first twenty of those that none meets, counted from 0. `null` likewise.
    pub unmet: Option<Vec<u64>>,
    /// No mapping has less distance: the sum, over all observations, of the distance to the closest state. `null` likewise.
    pub distance: Option<f64>,
    /// The same, each attribute by itself, in order.
    pub attributes: Vec<UnmetReport>,
    /// What can hardly be meant, as in policies.
    pub warnings: Vec<Warning>,
}

/// What of an attribute a body can never meet.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UnmetReport {
    /// Its name.
    pub name: String,
    /// How many observations tell it.
    pub observed: u64,
    /// How many of these have a value that no state has to which the body comes; if these are not known, that no state may have.
    pub unmet: u64,
    /// How many such values there are.
    pub distinct: u64,
    /// The first twenty of them.
    pub values: Vec<UnmetValue>,
    /// What the attribute adds at least to the distance of any mapping.
    pub distance: f64,
}

/// A value that was observed, and that no state has.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct UnmetValue {
    /// What was observed.
    #[cfg_attr(feature = "openapi", schema(value_type = Scalar))]
    pub value: Scalar,
    /// The closest that a state has.
    #[cfg_attr(feature = "openapi", schema(value_type = Scalar))]
    pub closest: Scalar,
    /// In how many observations.
    pub observations: u64,
    /// The first of these, counted from 0.
    pub first: u64,
}

/// Something that was not found.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = ReportUnknown))]
pub struct Unknown {
    /// JSON pointer (RFC 6901) to where it would stand in the report.
    #[cfg_attr(feature = "openapi", schema(example = "/parts"))]
    pub pointer: String,
    /// Why it is not there.
    pub detail: String,
}

impl Unknown {
    pub(super) fn out_of_time(pointer: &str) -> Self {
        Self { pointer: pointer.to_owned(), detail: "there was no time for it: give it a longer deadline".to_owned() }
    }

    /// Of a model that is searched lazily.
    pub(super) fn lazy(reached: &Reached<'_>) -> Self {
        let n_states = reached.n_states();
        let detail = format!(
            "this world is searched lazily: its body comes to {n_states} states at least, found around the {MAX_EXPLORED} that are closest to \
             the start. Values are those that states may have; undoing was looked for among the states found"
        );
        Self { pointer: "/reach".to_owned(), detail }
    }
}

impl ReportCounts {
    pub(super) fn of(model: &Model) -> Self {
        let is_listed = !model.is_lazy();
        Self {
            attributes: model.schema().len() as u64,
            actions: model.actions().len() as u64,
            states: is_listed.then(|| model.graph().n_states() as u64),
            transitions: is_listed.then(|| model.n_transitions() as u64),
            stochastic: model.n_stochastic() as u64,
            n_unsafe: model.n_unsafe() as u64,
        }
    }
}

impl StateExample {
    fn of(model: &Model, reached: &Reached<'_>, state: u32) -> Self {
        let number = reached.number(state);
        Self { state_index: number, state: model.describe_one_of(reached.states(), number.unwrap_or(state)) }
    }
}

impl ReachReport {
    pub(super) fn of(model: &Model, reached: &Reached<'_>) -> Self {
        let missed = |state: &StateIdx| StateExample { state_index: Some(*state), state: model.describe(*state) };
        let dead_ends = reached.dead_ends().take(MAX_EXAMPLES).map(|state| StateExample::of(model, reached, state));
        debug_assert_eq!(reached.extent, Extent::Whole, "else it is not known");
        Self {
            starts: reached.n_starts as u64,
            states: reached.n_states() as u64,
            transitions: reached.ways.n_items() as u64,
            unreachable: StatesReport {
                states: reached.n_unreachable,
                examples: reached.unreachable.iter().map(missed).collect(),
            },
            dead_ends: StatesReport { states: reached.dead_ends().count() as u64, examples: dead_ends.collect() },
        }
    }
}

impl PartsReport {
    pub(super) fn of(model: &Model, reached: &Reached<'_>, parts: &Parts) -> Self {
        const MAX_LISTED: usize = 10;
        let can_be_left = parts.can_be_left(reached);
        // The first state of each, and how many start states.
        let mut first = vec![u32::MAX; parts.n_nodes.len()];
        let mut n_starts = vec![0; parts.n_nodes.len()];
        for (state, part) in (0..).zip(&parts.of) {
            let part = *part as usize;
            first[part] = first[part].min(state);
            n_starts[part] += u64::from((state as usize) < reached.n_starts);
        }
        // Of equals, the one that is come to first.
        let mut order: Vec<usize> = (0..parts.n_nodes.len()).collect();
        order.sort_unstable_by_key(|part| (std::cmp::Reverse(parts.n_nodes[*part]), first[*part]));
        let largest = order.iter().take(MAX_LISTED).map(|part| Part {
            states: parts.n_nodes[*part].into(),
            starts: n_starts[*part],
            is_final: !can_be_left[*part],
            example: StateExample::of(model, reached, first[*part]),
        });
        Self {
            parts: parts.n_nodes.len() as u64,
            n_final: can_be_left.iter().filter(|can_be_left| !**can_be_left).count() as u64,
            largest: largest.collect(),
        }
    }
}
