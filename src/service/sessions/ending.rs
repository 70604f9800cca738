//! The end of a session: the steps that are left, and the policy of the whole.

use std::num::NonZeroU32;
use std::sync::Arc;

use etude_core::attribute::Weights;
use etude_core::interrupt::Interrupt;
use etude_core::mapping::{
    Conditions, Cost, Mapper, Mapping, OnlineMapping, Policy, PolicyEnd, Problem, Stamp, Status, Warning, WrittenPolicy,
};
use etude_core::model::Model;
use jiff::Timestamp;

use super::SessionError;
use super::committed::CommittedSteps;
use super::reading::read_stored;
use super::session::Session;
use crate::clock::Clock;
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::service::refined::RefinedRequest;
use crate::service::requests::{DEMONSTRATION, STATES};
use crate::service::search::{PolicyText, as_micros, report, take_beyond_small};
use crate::service::{Etude, ServiceError};
use crate::store::{NewObservations, NewRefinement, SessionEnd, StoredObservations};

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

/// What was received, as it is stored, and the memory that it takes.
type Texts = (Vec<String>, Option<Held>);

impl Session {
    /// Ends the demonstration, which must have `seq` observations, and stores its policy.
    ///
    /// # Errors
    ///
    /// If observations are missing, or the service ends. After [`SessionError::TooManySteps`] the session is to be dropped.
    pub async fn end(&mut self, etude: &Etude, seq: u32, now: Timestamp) -> Result<Ended, SessionError> {
        if self.has_ended() {
            return Err(SessionError::Ended);
        }
        if seq != self.n_received {
            return Err(SessionError::Gap { expected: self.n_received });
        }
        if seq == 0 {
            return Err(SessionError::Empty);
        }
        let texts = if let Some(texts) = self.texts_if_known(etude)? {
            texts
        } else {
            let stored = etude.stored_observations(&self.id, 0, self.n_received, self.mapper.model());
            let (StoredObservations { texts, .. }, held) = stored.await?;
            (texts, held)
        };
        let is_inline = self.ends_inline(&etude.clock);
        let concluded = self.conclude_all(etude, texts, is_inline).await?;
        self.store_end(etude, concluded, None, now).await
    }

    /// All that was received, as it is stored, if that is known without reading it.
    pub(super) fn texts_if_known(&self, etude: &Etude) -> Result<Option<Texts>, SessionError> {
        let Some(text) = self.text.whole() else { return Ok(None) };
        let held = etude.hold_observations(text.len(), self.n_sent as usize, self.mapper.model())?;
        Ok(Some((vec![text.to_owned()], held)))
    }

    /// Commits the rest, and writes the policy of all that was received, which is given as it is stored.
    pub(super) async fn conclude_all(
        &mut self,
        etude: &Etude,
        (texts, texts_held): Texts,
        is_inline: bool,
    ) -> Result<Concluded, SessionError> {
        let online = self.online.take().ok_or(SessionError::NotOpen)?;
        let (mapper, wanted) = (Arc::clone(&self.mapper), (self.weights.clone(), self.conditions.clone()));
        let (id, n_observations, n_committed) = (self.id.clone(), self.n_sent, self.n_steps);
        let (memory, clock) = (etude.memory.clone(), etude.clock.clone());
        let policy_id = match &self.source.trial_id {
            Some(trial) => etude.store.trial(trial).await?.map(|trial| trial.policy_id),
            None => None,
        };
        let stamp = Stamp {
            id: Some(policy_id.unwrap_or_else(|| etude.ids.next().to_string())),
            model: self.model.clone(),
            model_hash: self.model_hash.clone(),
            learner: self.source.learner.clone(),
            weights_version: self.source.weights_version,
            lookahead: self.lookahead.map(NonZeroU32::get),
            ..Stamp::default()
        };
        let held_bytes = self.held.n_bytes();
        let job = move |interrupt: &mut dyn Interrupt| {
            let spare = take_beyond_small(u64::MAX, &memory);
            let most_bytes = held_bytes + SMALL_BYTES + spare.as_ref().map_or(0, Held::n_bytes);
            let online = online.within(usize::try_from(most_bytes).unwrap_or(usize::MAX));
            online.find_rest(interrupt)?;
            drop(spare);
            let steps = take_for_end(&online, n_committed, mapper.model(), &memory);
            let concluded = steps.map_err(|no_room| ServiceError::from(no_room).into()).and_then(|steps| {
                conclude(online, steps, (&mapper, &clock), (&id, n_observations, &texts), wanted, stamp)
            });
            drop(texts_held);
            Ok(concluded)
        };
        if is_inline { etude.pool.run_here(None, job)? } else { etude.pool.run_in_turn(self.client, job).await? }
    }

    /// Stores the policy of the whole, and its `last` observations where they are not stored yet.
    pub(super) async fn store_end(
        &mut self,
        etude: &Etude,
        (mut steps, policy, row, refinement): Concluded,
        last: Option<NewObservations>,
        now: Timestamp,
    ) -> Result<Ended, SessionError> {
        let is_refined = refinement.is_some();
        let (session_id, policy_row) = (self.id.clone(), row.at(now));
        let end = SessionEnd { session_id, owner: self.owner, last, policy: policy_row, refinement };
        etude.store.end_session(end).await??;
        self.stay();
        if is_refined {
            etude.refiner.wake();
        }
        self.n_steps += steps.len();
        steps.give_back(written_bytes(self.n_steps, self.mapper.model()));
        Ok(Ended { steps, policy })
    }
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
