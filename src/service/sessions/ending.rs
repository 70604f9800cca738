//! The end of a session: the steps that are left, and the policy of the whole.

use std::sync::Arc;

use etude_core::attribute::Weights;
use etude_core::mapping::{
    Conditions, Cost, Mapper, Mapping, OnlineMapping, Policy, PolicyEnd, Problem, Stamp, Status, Warning, WrittenPolicy,
};
use etude_core::model::Model;

use super::SessionError;
use super::committed::CommittedSteps;
use super::reading::read_stored;
use crate::clock::Clock;
use crate::memory::{Memory, NoRoom};
use crate::service::ServiceError;
use crate::service::refined::RefinedRequest;
use crate::service::requests::{DEMONSTRATION, STATES};
use crate::service::search::{PolicyText, as_micros, report};
use crate::store::NewRefinement;

/// The end of a session.
#[derive(Debug)]
pub struct Ended {
    /// The steps committed by the end.
    pub steps: CommittedSteps,
    /// The policy of the whole, stored. Its memory is held with the steps.
    pub policy: SessionPolicy,
}

/// What a session tells of its policy.
#[derive(Clone, Debug)]
pub struct SessionPolicy {
    /// Under which it is stored; `None` once it was deleted.
    pub id: Option<String>,
    /// What was proven of it.
    pub status: Status,
    /// What it costs.
    pub cost: Cost,
    /// How it ends.
    pub end: PolicyEnd,
    /// What was observed and can hardly be meant. Places are those in all states of the session.
    pub warnings: Vec<Warning>,
    /// Its actions, in order.
    pub actions: Vec<Arc<str>>,
}

impl SessionPolicy {
    /// The policy of `mapping`, which must be of `model`.
    pub(super) fn of(id: Option<String>, model: &Model, mapping: &Mapping, warnings: Vec<Warning>) -> Self {
        let actions = mapping.moves.iter().filter_map(|step| step.action);
        let actions = actions.map(|action| model.action_name(action)).collect();
        Self { id, status: mapping.status, cost: mapping.cost, end: mapping.end.clone(), warnings, actions }
    }

    /// Most bytes that it takes if it has so many steps.
    pub(super) fn most_bytes(n_steps: usize) -> usize {
        n_steps.saturating_mul(size_of::<Arc<str>>())
    }
}

/// Most bytes that so many steps take as they are written to be stored.
pub(super) fn written_bytes(n_steps: usize, model: &Model) -> usize {
    n_steps.saturating_mul(Policy::step_bytes(model))
}

/// Takes what the end of a session of `n_committed` steps needs: for the steps that are left, for what it tells of its policy, and for
/// that as it is written.
pub(super) fn take_for_end(
    online: &OnlineMapping,
    n_committed: usize,
    model: &Model,
    memory: &Memory,
) -> Result<CommittedSteps, NoRoom> {
    let (n_rest, mut steps) = (online.n_rest(), CommittedSteps::default());
    let n_steps = n_committed + n_rest;
    steps.take_for(n_rest, model, memory)?;
    steps.take_more(SessionPolicy::most_bytes(n_steps) + written_bytes(n_steps, model), memory)?;
    Ok(steps)
}

pub(super) type Concluded = (CommittedSteps, SessionPolicy, PolicyText, Option<NewRefinement>);

/// Commits the rest to `steps`, and writes the policy of the whole session, which has this id and these observations.
pub(super) fn conclude(
    online: OnlineMapping,
    mut steps: CommittedSteps,
    (mapper, clock): (&Mapper, &Clock),
    (id, n_observations, texts): (&str, u32, &[String]),
    (weights, conditions): (Weights, Conditions),
    stamp: Stamp,
) -> Result<Concluded, SessionError> {
    let started = clock.instant();
    let (rest, mapping) = online.end().ok_or(SessionError::Empty)?;
    steps.extend(rest);
    Policy::check_steps(mapper.model(), &mapping)?;
    let (demonstration, observation_weights) = read_stored(mapper, texts, (id, n_observations))?;
    let conditions = conditions.with_observation_weights(&observation_weights, demonstration.len());
    let problem = Problem::new(mapper.model(), demonstration, weights, conditions);
    let warnings = problem.warnings(&DEMONSTRATION);
    let stamp = Stamp { elapsed_us: as_micros(clock.elapsed(started)), warnings, ..stamp };
    report(&stamp, &mapping);
    let policy = SessionPolicy::of(stamp.id.clone(), mapper.model(), &mapping, problem.warnings(&STATES));
    let written = WrittenPolicy::new(&stamp, &problem, &mapping).map_err(ServiceError::from)?;
    let refinement = (mapping.status == Status::Local)
        .then(|| RefinedRequest::of(&stamp.model, &problem, mapping.cost).waiting(&stamp, Some(id)));
    let refinement = refinement.transpose()?;
    let row = PolicyText::of(stamp, mapping.status, written)?;
    Ok((steps, policy, row, refinement))
}
