//! Policies: what the imitator executes, and why.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::cost::{Cost, CostSum};
use super::{Demonstration, Mapping, Move, MoveKind, PolicyEnd, Status, StoppedBy, Warning};
use crate::attribute::{ByAttribute, Scalar};
use crate::document::{Faults, Place};
use crate::model::{Model, States};

/// What produced a policy, as far as its problem and mapping do not tell.
#[derive(Clone, Debug, Default)]
pub struct Stamp {
    /// Under which the policy is stored.
    pub id: Option<String>,
    /// Name of the model.
    pub model: String,
    /// Hash of the model's content.
    pub model_hash: String,
    /// How many observations past the current one a decision could wait for; `None`: all.
    pub lookahead: Option<u32>,
    /// The policy that this one refines, if any.
    pub refines: Option<String>,
    /// The learner whose weights were used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// Wall-clock time of the search, in microseconds.
    pub elapsed_us: u64,
    /// What the request says and can hardly mean.
    pub warnings: Vec<Warning>,
}

/// What the imitator executes: the mapping's steps and costs, stamped with what produced it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Policy {
    /// Under which it is stored; left out of answers if it is not, and `null` in files.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(default = json!(null), example = "01938d3e-5c7a-7cc0-9f6e-1f2a3b4c5d6e"))]
    pub id: Option<String>,
    /// Name of the model.
    #[cfg_attr(feature = "openapi", schema(example = "figure-4"))]
    pub model: String,
    /// SHA-256 of the model's content.
    pub model_hash: String,
    /// The learner whose weights were used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The weights of the distance.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, f64>))]
    pub weights: ByAttribute<f64>,
    /// How many observations past the current one a decision could wait for; `null`: all.
    pub lookahead: Option<u32>,
    /// What was proven.
    pub status: Status,
    /// What the mapping costs.
    pub cost: Cost,
    /// No mapping costs less. `null` if nothing is known.
    pub lower_bound: Option<f64>,
    /// How it ends: whether it succeeded.
    pub end: PolicyEnd,
    /// What the request says and can hardly mean, each kind once for an attribute; they change nothing.
    pub warnings: Vec<Warning>,
    /// The actions to execute, in order.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>, example = json!(["turn_left", "forward"])))]
    pub actions: Vec<Arc<str>>,
    /// Every step, the first being the start.
    pub steps: Vec<Step>,
    /// How much of the demonstration was met exactly.
    pub coverage: Coverage,
    /// What the search took.
    pub search: SearchReport,
    /// The policy, decided by a finite lookahead, of which this is the global optimum.
    pub refines: Option<String>,
    /// The global optimum, found in the background, of what a finite lookahead decided here.
    pub refined_by: Option<String>,
}

/// A policy without its steps, as in lists.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct PolicySummary<'p> {
    /// Under which it is stored; left out if it is not.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub id: Option<&'p str>,
    /// Name of the model.
    pub model: &'p str,
    /// SHA-256 of the model's content.
    pub model_hash: &'p str,
    /// The learner whose weights were used, if any.
    pub learner: Option<&'p str>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The weights of the distance.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, f64>))]
    pub weights: &'p ByAttribute<f64>,
    /// How many observations past the current one a decision could wait for; `null`: all.
    pub lookahead: Option<u32>,
    /// What was proven.
    pub status: Status,
    /// What the mapping costs.
    pub cost: Cost,
    /// No mapping costs less. `null` if nothing is known.
    pub lower_bound: Option<f64>,
    /// How it ends: whether it succeeded.
    pub end: &'p PolicyEnd,
    /// What the request says and can hardly mean.
    pub warnings: &'p [Warning],
    /// How much of the demonstration was met exactly.
    pub coverage: Coverage,
    /// What the search took.
    pub search: SearchReport,
    /// The policy, decided by a finite lookahead, of which this is the global optimum.
    pub refines: Option<&'p str>,
    /// The global optimum, found in the background, of what a finite lookahead decided here.
    pub refined_by: Option<&'p str>,
}

/// A step of a policy. Executing it means keyed by `(observation, state)`, never by the state alone: a state may be passed
/// again later.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Step {
    /// Counted from 0.
    pub step: u32,
    /// The observation that the step belongs to, counted from 0.
    pub observation: u32,
    /// How it advances.
    #[serde(rename = "move")]
    pub kind: MoveKind,
    /// The action taken, if any.
    #[cfg_attr(feature = "openapi", schema(value_type = Option<String>))]
    pub action: Option<Arc<str>>,
    /// The imitator's state after the step.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, Scalar>))]
    pub state: ByAttribute<Scalar>,
    /// The index of that state in the model; in this policy, if the model is searched lazily.
    pub state_index: u32,
    /// Cost of the action.
    pub action_cost: f64,
    /// The weighted distance between the observation and the state, as far as the step pays it: times the observation's weight, and times
    /// `extra_weight` if the step is extra.
    pub distance: f64,
    /// The distance's terms by attribute; those that are 0 are left out.
    #[cfg_attr(feature = "openapi", schema(value_type = BTreeMap<String, f64>))]
    pub distance_by_attribute: ByAttribute<f64>,
    /// Cost of the steps up to and including this one, without that of the end.
    pub cost: f64,
}

/// How much of a demonstration was met exactly.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Coverage {
    /// How many observations there were.
    pub observed: u32,
    /// How many of them some step meets at distance 0.
    pub exact: u32,
}

/// What a search took.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct SearchReport {
    /// Nodes expanded; without what is looked at to make estimates.
    pub expanded: u64,
    /// Successors looked at.
    pub generated: u64,
    /// Wall-clock time, in microseconds.
    pub elapsed_us: u64,
    /// What ran out, if that is why the policy is not optimal, or why the end of what a lookahead decided was followed greedily. Left out
    /// otherwise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub stopped_by: Option<StoppedBy>,
}

/// Most bytes of a policy that its states take: 64 MB, 640 for each of the most observations that there can be. The whole is
/// in memory many times over while it is answered and stored (190 MB of states were seen to take 3 GB), and the
/// database takes no value over 1 GB.
const MAX_STATES_BYTES: usize = 64 << 20;

/// About how many bytes of a step are not its state's.
const STEP_BYTES: usize = 200;

/// Most bytes of a policy's steps: as many as the largest demonstration gives that acts once for each observation, 83 MB.
const MAX_STEPS_BYTES: usize = MAX_STATES_BYTES + Demonstration::MAX_OBSERVATIONS * STEP_BYTES;

/// A mapping has more steps than a policy may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the policy would have {n_steps} steps, which take about {} MB, and {} MB is the most: as the body needs many actions for \
     an observation, split the demonstration",
    n_bytes >> 20,
    MAX_STEPS_BYTES >> 20
)]
pub struct TooManySteps {
    /// How many there are.
    pub n_steps: usize,
    /// About how many bytes of JSON they are.
    pub n_bytes: usize,
}

impl Policy {
    /// Checks how large the policy of `mapping`, which must be of `model`, would be: what is known of it only when it was found.
    /// An observation may take as many actions as there are states, where they lead through what it does not tell apart.
    ///
    /// # Errors
    ///
    /// [`TooManySteps`] if it would be too large to be written and stored.
    pub fn check_steps(model: &Model, mapping: &Mapping) -> Result<(), TooManySteps> {
        let (n_steps, n_bytes) = (mapping.moves.len(), Self::steps_bytes(model, mapping));
        if n_bytes > MAX_STEPS_BYTES { Err(TooManySteps { n_steps, n_bytes }) } else { Ok(()) }
    }

    /// About how many bytes of JSON the steps of the policy of `mapping` are, which must be of `model`.
    #[must_use]
    pub fn steps_bytes(model: &Model, mapping: &Mapping) -> usize {
        mapping.moves.len().saturating_mul(Self::step_bytes(model))
    }

    /// About how many bytes of JSON a step is.
    pub fn step_bytes(model: &Model) -> usize {
        STEP_BYTES.saturating_add(model.state_bytes())
    }

    /// Notes at `place` that a policy of `n_observations`, each of which has a step at least, would be too large; says
    /// whether it would not.
    /// What is estimated is what a step says of the imitator's state.
    pub fn check_size(model: &Model, n_observations: usize, place: &Place<'_, '_>, faults: &mut Faults) -> bool {
        let is_within = n_observations <= Self::max_observations(model);
        if !is_within {
            let n_bytes = n_observations.saturating_mul(model.state_bytes());
            let detail = format!(
                "the states of a policy of {n_observations} observations would take about {} MB, and {} MB is the most: \
                 split the demonstration, or give the model fewer or shorter attributes",
                n_bytes >> 20,
                MAX_STATES_BYTES >> 20,
            );
            faults.note(place, detail);
        }
        is_within
    }

    /// Most observations of a policy, or of several that are answered together, that is not too large.
    pub fn max_observations(model: &Model) -> usize {
        MAX_STATES_BYTES / model.state_bytes().max(1)
    }
}

/// Writes the steps of a policy, one after the other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct StepWriter {
    sum: CostSum,
    n_steps: u32,
}

impl StepWriter {
    /// How many steps were written.
    pub(super) fn n_steps(&self) -> u32 {
        self.n_steps
    }

    /// The next step, given what its action costs and the terms of the distance that it pays; `states` are those that it is numbered in.
    pub(super) fn write(
        &mut self,
        model: &Model,
        states: &States,
        step: &Move,
        action_cost: f64,
        terms: impl Iterator<Item = (usize, f64)>,
    ) -> Step {
        let schema = model.schema();
        let mut distance = 0.0;
        let mut by_attribute = vec![None; schema.len()];
        for (position, term) in terms.filter(|(_, term)| *term > 0.0) {
            distance += term;
            by_attribute[position] = Some(term);
        }
        self.sum.add(action_cost, distance);
        self.n_steps += 1;
        Step {
            step: self.n_steps - 1,
            observation: step.observation,
            kind: step.kind,
            action: step.action.map(|action| model.action_name(action)),
            state: model.describe_one_of(states, step.state),
            state_index: step.state,
            action_cost,
            distance,
            distance_by_attribute: schema.by_some_attributes(by_attribute),
            cost: self.sum.total(),
        }
    }

    /// What the steps cost if they end here, where ending costs `end`.
    pub(super) fn cost_with_end(mut self, end: f64) -> Cost {
        self.sum.end(end);
        self.sum.cost()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::model::{Definition, Limits};

    #[test]
    fn a_policy_may_have_as_many_steps_as_fit_into_83_mb() {
        let document = serde_json::json!({
            "attributes": [{"name": "x", "kind": "number"}],
            "actions": [],
            "dynamics": {"kind": "table", "states": [[10]], "transitions": []},
        });
        let definition = Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let step = Move { kind: MoveKind::Skip, action: None, observation: 0, state: 0 };
        let check = |n_steps| {
            let mapping = Mapping {
                moves: vec![step; n_steps],
                action_costs: vec![0.0; n_steps],
                cost: Cost::default(),
                end: PolicyEnd::at(&model, &[0], &[None], &model.schema().weights()),
                status: Status::Optimal,
                lower_bound: None,
                stopped_by: None,
                n_expanded: 0,
                n_generated: 0,
                states: None,
            };
            Policy::check_steps(&model, &mapping)
        };
        // A state is {"x":10}.
        let most = ((64 << 20) + 100_000 * 200) / (200 + 8);
        assert_eq!(check(most), Ok(()));
        let error = check(most + 1).unwrap_err();
        assert_eq!((error.n_steps, error.n_bytes >> 20), (most + 1, 83));
        assert!(error.to_string().contains("418793 steps"), "{error}");
    }
}
