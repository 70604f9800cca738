//! Trials: drawn, mapped, rewarded.

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::value::RawValue;
use tokio_util::bytes::Bytes;

use super::idempotency::{IdempotencyKey, Repeat};
use super::learners::{LearnerState, unknown};
use super::requests::check_request;
use super::search::{Searched, write};
use super::{Caller, Etude, Kind, Name, PoolError, ServiceError, as_stored};
use crate::memory::Held;
use crate::store::{
    Deletion, FailureAnswer, KeyTaken, Links, Needed, NewRequestKey, NewReward, NewTrial, Opened, Page, RewardAnswer,
    TrialRecord, TrialStatus,
};
use etude_core::attribute::{Schema, Weights};
use etude_core::document::{Faults, Object, Path, Place, Range};
use etude_core::learning::Learner;
use etude_core::mapping::{RequestKind, Stamp};
use etude_core::model::Model;

/// So often a trial is drawn whose number others take each time.
pub(super) const MAX_DRAWS: u32 = 8;

/// Why a trial was drawn in vain.
enum NotStored {
    NumberTaken,
    KeyTaken,
}

/// Longest reason for a failure, in characters.
const MAX_REASON_CHARS: usize = 1000;

/// A trial, and what has become of it.
#[derive(Debug)]
pub struct TrialAnswer {
    /// The trial, but for its weights.
    pub trial: TrialRecord,
    /// Its weights by attribute of the learner: JSON.
    pub weights: Box<RawValue>,
    /// What has become of it.
    pub status: TrialStatus,
    /// Its policy: JSON. Not in lists.
    pub policy: Option<Box<RawValue>>,
    /// For the policy, and as much again while it is written into an answer, if it is much.
    pub held: Option<Held>,
}

impl TrialAnswer {
    /// The answer without the policy.
    fn of(mut trial: TrialRecord, now: Timestamp) -> Result<Self, ServiceError> {
        let weights = RawValue::from_string(std::mem::take(&mut trial.weights));
        let weights = weights.map_err(|error| ServiceError::unreadable("trials", "weights", &trial.id, error))?;
        Ok(Self { status: trial.status(now), trial, weights, policy: None, held: None })
    }
}

impl Etude {
    /// Draws a trial from the learner called `name`, for the demonstration and model in `body` (JSON), and stores it with
    /// the policy that it gives.
    ///
    /// # Errors
    ///
    /// If the body is no request for a trial, something that is named is not there, the model lacks an attribute of the
    /// learner, or the service cannot do it now.
    pub async fn make_trial(
        &self,
        name: &Name,
        body: impl Into<Bytes>,
        caller: Caller,
    ) -> Result<TrialAnswer, ServiceError> {
        self.make_keyed_trial(name, None, body.into(), caller).await?.map_err(|KeyTaken| PoolError::Busy.into())
    }

    /// As [`Self::make_trial`], once: the same body with the same key again gives the same trial for a day, as it was drawn.
    ///
    /// # Errors
    ///
    /// Likewise, and [`ServiceError::KeyReused`] if another body came with the key.
    pub async fn make_trial_once(
        &self,
        name: &Name,
        key: &IdempotencyKey,
        body: impl Into<Bytes>,
        caller: Caller,
    ) -> Result<TrialAnswer, ServiceError> {
        let body = body.into();
        let scope = format!("trials of {}", self.learner_row(name).await?.sequence);
        let id = match self.repeat(scope, key, &body, caller).await? {
            Repeat::First(first) => match self.make_keyed_trial(name, Some(&first.key), body, caller).await? {
                Ok(made) => return Ok(made),
                Err(KeyTaken) => self.made_meanwhile(&first.key).await?,
            },
            Repeat::Answered(id) => id,
        };
        let trial = self.store.trial(&id).await?.ok_or_else(|| unknown_trial(&id))?;
        let drawn = TrialRecord { failed: None, reward: None, learned_version: None, ..trial };
        let answer = self.with_policy(drawn, Links::AsMade, caller.now).await?;
        Ok(TrialAnswer { status: TrialStatus::Active, ..answer })
    }

    /// Draws a trial, and stores it with the key of its request, if that has one. Where another server has taken its number meanwhile, it
    /// is drawn anew.
    async fn make_keyed_trial(
        &self,
        name: &Name,
        key: Option<&NewRequestKey>,
        body: Bytes,
        caller: Caller,
    ) -> Result<Result<TrialAnswer, KeyTaken>, ServiceError> {
        for _ in 0..MAX_DRAWS {
            match self.try_trial(name, key, body.clone(), caller).await? {
                Err(NotStored::NumberTaken) => {}
                Err(NotStored::KeyTaken) => return Ok(Err(KeyTaken)),
                Ok(made) => return Ok(Ok(made)),
            }
        }
        Err(PoolError::Busy.into())
    }

    async fn try_trial(
        &self,
        name: &Name,
        key: Option<&NewRequestKey>,
        body: Bytes,
        caller: Caller,
    ) -> Result<Result<TrialAnswer, NotStored>, ServiceError> {
        let LearnerState { sequence, name, learner, weights } = self.learner_state(name.as_str(), None).await?;
        let numbers = self.store.trial_numbers(sequence).await?;
        let id = self.ids.next().to_string();
        let (policy_id, weights_version) = (self.ids.next().to_string(), weights.version);
        let stamp = Stamp {
            id: Some(policy_id.clone()),
            learner: Some(name.clone()),
            weights_version: Some(weights_version),
            ..Stamp::default()
        };
        let (lease_s, learner) = (learner.lease_s(), Arc::new(learner));
        let draw = {
            let learner = Arc::clone(&learner);
            move |model: &Model, _: Option<&LearnerState>, faults: &mut Faults| {
                check_attributes(&learner, model, faults);
                // A request with faults takes no number: the next trial is the same as if it had not been made.
                if !faults.is_empty() {
                    return None;
                }
                let number = numbers.take();
                let drawn = learner.draw(&weights.distribution, number);
                let all = learner.weights_for(model.schema(), &drawn).ok()?;
                // Where what was drawn stands among all, of which the request may have pinned some.
                let positions = learner.attributes().iter().filter_map(|name| model.schema().position(name)).collect();
                Some((all, (number, positions)))
            }
        };
        let searched = self.search(RequestKind::Trial, &body, stamp, caller, draw).await?;
        let Some((searched, (number, positions))) = searched else {
            let learner = Arc::clone(&learner);
            let check = move |object: &Object<'_, '_>, model: &Model, _: Option<&LearnerState>, faults: &mut Faults| {
                let weights = |faults: &mut Faults| {
                    check_attributes(&learner, model, faults);
                    None
                };
                check_request(object, model, weights, faults);
            };
            return Err(Box::pin(self.explain(RequestKind::Trial, body, caller, check)).await);
        };
        drop(body);
        let Searched { policy, row, refinement, held, weights } = searched;
        let positions: Vec<usize> = positions;
        let weights = positions.into_iter().map(|position| weights.as_slice()[position]);
        let weights = write(&learner.by_attribute(weights))?;

        let now = as_stored(caller.now);
        let lease_expires_at = now.checked_add(Duration::from_secs(lease_s)).unwrap_or(Timestamp::MAX);
        let new = NewTrial {
            id: id.clone(),
            learner: sequence,
            number,
            weights: weights.clone(),
            weights_version,
            policy_id: policy_id.clone(),
            policy: row.map(|row| row.at(now)),
            refinement,
            key: key.cloned(),
            created_at: now,
            lease_expires_at,
        };
        let is_refined = new.refinement.is_some();
        match self.store.open_trial(new).await? {
            Opened::Yes => {}
            Opened::NoLearner => return Err(unknown(&name, None)),
            Opened::NumberTaken => return Ok(Err(NotStored::NumberTaken)),
            Opened::KeyTaken => return Ok(Err(NotStored::KeyTaken)),
        }
        if is_refined {
            self.refiner.wake();
        }
        metrics::counter!("etude_trials_total").increment(1);
        let trial = TrialRecord {
            sequence: 0,
            id,
            learner: name,
            number,
            weights,
            weights_version,
            policy_id,
            lease_expires_at,
            failed: None,
            reward: None,
            learned_version: None,
        };
        let policy = Some(read_policy(policy, &trial.policy_id)?);
        Ok(Ok(TrialAnswer { status: TrialStatus::Active, policy, held, ..TrialAnswer::of(trial, now)? }))
    }

    /// Draws a trial for a policy that is still in the making. The caller stores it.
    pub(super) async fn draw(
        &self,
        ready: &LearnerState,
        schema: &Schema,
        now: Timestamp,
    ) -> Result<Draw, ServiceError> {
        let LearnerState { sequence, learner, weights, .. } = ready;
        let numbers = self.store.trial_numbers(*sequence).await?;
        let number = numbers.take();
        let drawn = learner.draw(&weights.distribution, number);
        let missing = |missing: etude_core::learning::MissingAttributes| Faults::one("/learner", missing.to_string());
        let all = learner.weights_for(schema, &drawn).map_err(missing)?;
        let now = as_stored(now);
        let trial = NewTrial {
            id: self.ids.next().to_string(),
            learner: *sequence,
            number,
            weights: write(&learner.by_attribute(drawn))?,
            weights_version: weights.version,
            policy_id: self.ids.next().to_string(),
            policy: None,
            refinement: None,
            key: None,
            created_at: now,
            lease_expires_at: now.checked_add(Duration::from_secs(learner.lease_s())).unwrap_or(Timestamp::MAX),
        };
        metrics::counter!("etude_trials_total").increment(1);
        Ok(Draw { trial, weights: all })
    }

    /// The trial with this id, with its policy.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn trial(&self, id: &str, now: Timestamp) -> Result<TrialAnswer, ServiceError> {
        let trial = self.store.trial(id).await?.ok_or_else(|| unknown_trial(id))?;
        self.with_policy(trial, Links::Now, now).await
    }

    /// The answer with the policy, which has these links.
    async fn with_policy(&self, trial: TrialRecord, links: Links, now: Timestamp) -> Result<TrialAnswer, ServiceError> {
        let (policy, held) = self.store.policy_within(&trial.policy_id, links, &self.memory).await?.unzip();
        let policy = policy.map(|policy| read_policy(policy, &trial.policy_id)).transpose()?;
        // Once more in the answer.
        let mut held = held.flatten();
        self.memory.reserve(&mut held, 2 * policy.as_ref().map_or(0, |policy| policy.get().len()))?;
        Ok(TrialAnswer { policy, held, ..TrialAnswer::of(trial, now)? })
    }

    /// Deletes the trial with this id. Its policy stays.
    ///
    /// # Errors
    ///
    /// If there is none, or it has a reward.
    pub async fn delete_trial(&self, id: &str) -> Result<(), ServiceError> {
        match self.store.delete_trial(id).await? {
            Ok(Deletion::Deleted) => Ok(()),
            Ok(Deletion::Unknown) => Err(unknown_trial(id)),
            Err(Needed) => {
                let because = "its learner learns from its reward";
                Err(ServiceError::InUse { kind: Kind::Trial, id: id.to_owned(), because })
            }
        }
    }

    /// At most `limit` trials of a learner in the order of their numbers, from the first after the number `after`; only those
    /// with the given status, if one is.
    ///
    /// # Errors
    ///
    /// If there is no such learner.
    pub async fn trials(
        &self,
        name: &Name,
        status: Option<TrialStatus>,
        now: Timestamp,
        after: u64,
        limit: u32,
    ) -> Result<Page<TrialAnswer>, ServiceError> {
        let learner = self.learner_row(name).await?.sequence;
        let page = self.store.trials(learner, status, now, after, limit).await?;
        Ok(page.map_readable(|trial| &trial.id, |trial| TrialAnswer::of(trial, now)))
    }

    /// Accepts the reward in `body` (JSON) for a trial; durable when this returns. The same reward again changes nothing.
    ///
    /// # Errors
    ///
    /// If the body is no reward, there is no such trial, or it has another reward or has failed.
    pub async fn reward_trial(&self, id: &str, body: &[u8], now: Timestamp) -> Result<TrialAnswer, ServiceError> {
        let document = etude_core::document::parse(body)?;
        let mut faults = Faults::default();
        let object = Place::root(&document).object(&["reward"], &mut faults);
        let reward =
            object.and_then(|object| object.required("reward", &mut faults)?.number(Range::Finite, &mut faults));
        self.accept_reward(id, faults.check(reward)?, now).await
    }

    /// Accepts a reward, which must be finite, for a trial; durable when this returns. The same reward again changes nothing.
    ///
    /// # Errors
    ///
    /// If there is no such trial, or it has another reward or has failed.
    pub async fn accept_reward(&self, id: &str, reward: f64, now: Timestamp) -> Result<TrialAnswer, ServiceError> {
        let new = NewReward { trial: id.to_owned(), reward, accepted_at: now };
        let trial = match self.store.accept_reward(new).await? {
            RewardAnswer::Accepted(trial) => {
                metrics::counter!("etude_rewards_total").increment(1);
                trial
            }
            RewardAnswer::Unchanged(trial) => trial,
            RewardAnswer::Conflict { existing } => {
                return Err(ServiceError::AlreadyRewarded { trial: id.to_owned(), existing });
            }
            RewardAnswer::Failed => return Err(ServiceError::TrialFailed { trial: id.to_owned() }),
            RewardAnswer::Unknown => return Err(unknown_trial(id)),
        };
        TrialAnswer::of(trial, now)
    }

    /// Ends a trial without a reward, for the reason in `body` (JSON).
    ///
    /// # Errors
    ///
    /// If the body gives no reason, there is no such trial, or it has a reward or has failed for another reason.
    pub async fn fail_trial(&self, id: &str, body: &[u8], now: Timestamp) -> Result<TrialAnswer, ServiceError> {
        let document = etude_core::document::parse(body)?;
        let mut faults = Faults::default();
        let object = Place::root(&document).object(&["reason"], &mut faults);
        let reason = object.and_then(|object| match object.optional("reason") {
            None => Some(None),
            Some(place) => {
                let reason = place.string(&mut faults)?;
                if reason.chars().count() > MAX_REASON_CHARS {
                    return place.mismatch(&format!("at most {MAX_REASON_CHARS} characters"), &mut faults);
                }
                Some(Some(reason.to_owned()))
            }
        });
        let reason = faults.check(reason)?;
        match self.store.fail_trial(id, reason).await? {
            FailureAnswer::Failed(trial) => TrialAnswer::of(trial, now),
            FailureAnswer::Conflict { .. } => Err(ServiceError::TrialFailed { trial: id.to_owned() }),
            FailureAnswer::Rewarded { existing } => {
                Err(ServiceError::AlreadyRewarded { trial: id.to_owned(), existing })
            }
            FailureAnswer::Unknown => Err(unknown_trial(id)),
        }
    }
}

/// A trial that was drawn, and the weights of the distance that it gives.
pub(super) struct Draw {
    pub(super) trial: NewTrial,
    pub(super) weights: Weights,
}

/// Notes which attributes of the learner the model lacks.
fn check_attributes(learner: &Learner, model: &Model, faults: &mut Faults) {
    if let Err(missing) = learner.weights_for(model.schema(), &learner.initial().mean) {
        faults.note_at(&Path::Member(&Path::Root, "model"), missing.to_string());
    }
}

fn unknown_trial(id: &str) -> ServiceError {
    ServiceError::Unknown { kind: Kind::Trial, name: id.to_owned(), pointer: None }
}

fn read_policy(policy: String, id: &str) -> Result<Box<RawValue>, ServiceError> {
    let read = RawValue::from_string(policy);
    read.map_err(|error| ServiceError::unreadable("policies", "policy", id, error))
}

#[cfg(test)]
mod tests;
