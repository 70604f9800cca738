//! Sessions: streams of observations in, committed steps out, durable.
//!
//! Of a session only what it was opened with and its observations are stored. Whoever resumes it gets the same steps
//! again, because they follow from those. A session belongs to one connection at a time; resuming takes it over.

mod committed;
mod ending;
mod error;
mod reading;
mod session;

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;
use tokio_util::sync::CancellationToken;

pub use committed::CommittedSteps;
pub use ending::{Ended, SessionPolicy};
pub use error::SessionError;
use reading::read_again;
use session::Source;
pub use session::{Observation, Received, RewardState, Session};

use super::opening::{self, SessionOptions};
use super::owners::Ownership;
use super::requests::Named;
use super::trials::MAX_DRAWS;
use super::{Caller, Etude, Kind, PoolError, ServiceError};
use crate::memory::{Held, Memory};
use crate::store::{
    Deletion, MAX_EXPIRED_AT_ONCE, NewSession, Opened, Owner, Page, SessionFilter, SessionRecord, SessionStatus, Taken,
};
use etude_core::attribute::{ByAttribute, Schema, Weights};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Interrupt, time_until_finish};
use etude_core::mapping::{Budget, Demonstration, OnlineMapping, RequestKind, Warning, Watch};
use etude_core::model::Model;

/// A session that was resumed.
#[derive(Debug)]
pub struct Resumed {
    /// The session.
    pub session: Session,
    /// Every step that was committed so far.
    pub steps: CommittedSteps,
    /// Its policy, if it has ended. Its memory is held with the steps.
    pub policy: Option<SessionPolicy>,
}

impl Etude {
    /// Opens a session as `request` says: an object with the fields of [`RequestKind::Session`].
    ///
    /// # Errors
    ///
    /// If the request has faults or names what is unknown, or the service cannot do it now.
    pub async fn open_session(&self, request: &Value, caller: Caller) -> Result<Session, SessionError> {
        let now = caller.now;
        let place = self.pool.admit_when_needed(caller.client);
        let mut faults = Faults::default();
        let object = Place::root(request).object(RequestKind::Session.fields(), &mut faults);
        let read = object.as_ref().and_then(|object| opening::read_names(object, &mut faults));
        let general = object.as_ref().and_then(|object| opening::read_general(object, &mut faults));
        // With the help of the model, more faults may be found; so those found without it wait.
        let Some((names, explores)) = read else { return Err(faults.into()) };
        let deadline = self.deadline(&names, caller.arrived);
        let Named { learner, model_hash, mapper } = self.find(&names, faults.clone(), &place, deadline).await?;
        drop(place);
        // As much as a search may take.
        let max_bytes = usize::try_from(self.memory.room() / 2).unwrap_or(usize::MAX).min(Budget::DEFAULT.max_bytes);
        let read = object
            .as_ref()
            .and_then(|object| opening::read(&mapper, learner.as_ref(), general, object, max_bytes, &mut faults));
        let SessionOptions { mut weights, conditions, lookahead } = faults.check(read)?;
        let model = names.model;

        let id = self.ids.next().to_string();
        let ownership = self.owners.take(&id).await?;
        let mut session = NewSession {
            id: id.clone(),
            model: model.clone(),
            model_hash: model_hash.clone(),
            weights: mapper.model().schema().by_attribute(weights.as_slice().iter().copied()),
            lookahead: lookahead.map(NonZeroU32::get),
            conditions: conditions.clone(),
            learner: learner.as_ref().map(|ready| ready.name.clone()),
            weights_version: learner.as_ref().map(|ready| ready.weights.version),
            trial: None,
            created_at: now,
        };
        let mut opened = Opened::NumberTaken;
        let mut trial_id = None;
        // Anew where another server has taken the trial's number meanwhile.
        for _ in 0..MAX_DRAWS {
            if let (true, Some(ready)) = (explores, &learner) {
                let draw = self.draw(ready, mapper.model().schema(), now).await?;
                weights = draw.weights;
                session.weights = mapper.model().schema().by_attribute(weights.as_slice().iter().copied());
                trial_id = Some(draw.trial.id.clone());
                session.trial = Some(draw.trial);
            }
            opened = self.store.open_session(session.clone()).await?;
            if opened != Opened::NumberTaken {
                break;
            }
        }
        let NewSession { learner, weights_version, .. } = session;
        let source = Source { learner, weights_version, trial_id };
        match opened {
            Opened::Yes => {}
            Opened::NoLearner => {
                let name = source.learner.unwrap_or_default();
                return Err(ServiceError::Unknown { kind: Kind::Learner, name, pointer: Some("/learner") }.into());
            }
            Opened::NumberTaken | Opened::KeyTaken => return Err(PoolError::Busy.into()),
        }
        let online = OnlineMapping::new(&mapper, weights.clone(), conditions.clone(), lookahead);
        let online = Some(online);
        Ok(Session {
            id,
            model,
            model_hash,
            mapper,
            lookahead,
            conditions,
            source,
            n_received: 0,
            n_steps: 0,
            watch: Watch::new(&weights),
            weights,
            online,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
            owner: Owner::FIRST,
            ownership,
        })
    }

    /// Takes over the session `id`, from whatever connection drives it, and makes its steps again.
    ///
    /// # Errors
    ///
    /// If there is none, it has expired, its model is gone, or it is taken over meanwhile.
    pub async fn resume_session(&self, id: &str, caller: Caller) -> Result<Resumed, SessionError> {
        // Looked up first, so that nobody is bothered for what does not exist.
        self.session(id).await?;
        let ownership = self.owners.take(id).await?;
        let taken_over = ownership.taken_over.clone();
        tokio::select! {
            biased;
            () = taken_over.cancelled() => Err(SessionError::TakenOver),
            resumed = self.resume_owned(id, ownership, caller) => resumed,
        }
    }

    async fn resume_owned(&self, id: &str, ownership: Ownership, caller: Caller) -> Result<Resumed, SessionError> {
        // What is still to be written for the owner before is refused from now on.
        let row = match self.store.take_session(id, caller.now).await? {
            Taken::Open(row) => row,
            Taken::Ended(row) if row.status == SessionStatus::Done => row,
            Taken::Ended(_) => return Err(SessionError::NotOpen),
            Taken::Unknown => return Err(unknown(id).into()),
        };
        // Nobody says how long it may take.
        let deadline = caller.arrived.checked_add(time_until_finish(self.time_limits.default_deadline));
        let place = self.pool.admit_when_needed(caller.client).waiting_until(deadline);
        let (hash, mapper) = self.mapper(&row.model, "/model", Some(&place), deadline).await?;
        drop(place);
        // Registered anew, the same world may have become too large to be known in full.
        if hash != row.model_hash || mapper.model().is_lazy() {
            let name = format!("{} with hash {}", row.model, row.model_hash);
            return Err(ServiceError::Unknown { kind: Kind::Model, name, pointer: None }.into());
        }
        let weights = weights_in_order(&row.weights, mapper.model().schema(), id)?;
        let lookahead = row.lookahead.and_then(NonZeroU32::new);
        let mut session = Session {
            id: row.id,
            model: row.model,
            model_hash: row.model_hash,
            weights: weights.clone(),
            lookahead,
            conditions: row.conditions.clone(),
            source: Source { learner: row.learner, weights_version: row.weights_version, trial_id: row.trial_id },
            n_received: row.n_observations,
            n_steps: 0,
            watch: Watch::new(&weights),
            online: Some(OnlineMapping::new(&mapper, weights, row.conditions, lookahead)),
            mapper,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
            owner: row.owner,
            ownership,
        };
        let (mut steps, mut warnings) = (CommittedSteps::default(), Vec::new());
        let is_done = row.status == SessionStatus::Done;
        if session.n_received > 0 {
            let (texts, _held) =
                self.stored_observations(&session.id, session.n_received, session.mapper.model()).await?;
            let reading = {
                let (mapper, id, n_received) = (Arc::clone(&session.mapper), session.id.clone(), session.n_received);
                let (weights, conditions) = (session.weights.clone(), session.conditions.clone());
                move || read_again(&mapper, &texts, (&id, n_received), is_done, weights, conditions)
            };
            let n_values = session.n_received as usize * session.mapper.model().schema().len();
            let again = if n_values <= MAX_INLINE_VALUES {
                reading()?
            } else {
                // About what a value takes.
                self.pool.read_in_turn(caller.client, 8 * n_values, reading).await??
            };
            session.watch = again.watch;
            warnings = again.warnings;
            steps = session.advance(self, again.observations).await?;
        }
        let policy = match (row.status, session.online.take()) {
            (SessionStatus::Done, Some(online)) => {
                // Whoever ended it may have been gone before there was something to refine.
                self.refiner.wake();
                let (mapper, memory) = (Arc::clone(&session.mapper), self.memory.clone());
                let end = move |_: &mut dyn Interrupt| {
                    Ok(end_again(online, steps, (row.policy_id, warnings), mapper.model(), &memory))
                };
                let (ended, policy) = self.pool.run_in_turn(caller.client, end).await??;
                steps = ended;
                session.n_steps = steps.len();
                Some(policy)
            }
            (_, online) => {
                session.online = online;
                None
            }
        };
        Ok(Resumed { session, steps, policy })
    }

    /// The observations of a session as they are stored, and the memory that these, what is read of them, and what is written of
    /// them take, if it is much: taken before they are read.
    pub(super) async fn stored_observations(
        &self,
        session: &str,
        n_observations: u32,
        model: &Model,
    ) -> Result<(Vec<String>, Option<Held>), ServiceError> {
        /// In a row, and as they are given.
        const COPIES: usize = 2;
        let n_bytes = usize::try_from(self.store.observations_bytes(session).await?).unwrap_or(usize::MAX);
        let (schema, n_observations) = (model.schema(), n_observations as usize);
        // All together, and one by one.
        let read_bytes =
            2 * Demonstration::bytes_of(schema, n_observations) + n_observations * size_of::<Observation>();
        let mut held = None;
        self.memory.reserve(&mut held, COPIES.saturating_mul(n_bytes) + read_bytes)?;
        Ok((self.store.observations(session).await?, held))
    }

    /// The session with this id.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn session(&self, id: &str) -> Result<SessionRecord, ServiceError> {
        self.store.session(id).await?.ok_or_else(|| unknown(id))
    }

    /// Deletes the session with this id with its observations, and dismisses whoever drives it. Its policy and its trial stay; a policy that
    /// waits to be refined does not any more.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn delete_session(&self, id: &str) -> Result<(), ServiceError> {
        match self.store.delete_session(id).await? {
            Deletion::Deleted => {
                self.owners.dismiss(id);
                Ok(())
            }
            Deletion::Unknown => Err(unknown(id)),
        }
    }

    /// At most `limit` of the sessions that are wanted, in the order in which they were opened, from the first after the sequence number
    /// `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn sessions(
        &self,
        filter: &SessionFilter,
        after: i64,
        limit: u32,
    ) -> Result<Page<SessionRecord>, ServiceError> {
        Ok(self.store.sessions(filter, after, limit).await?)
    }

    /// Expires open sessions that have been idle for too long, and removes keys of requests that are too old, now and then, until `stopping`
    /// is cancelled.
    pub async fn expire_until(self: Arc<Self>, stopping: CancellationToken) {
        let mut ticks = tokio::time::interval(self.alive_every());
        loop {
            tokio::select! {
                _ = ticks.tick() => {}
                () = stopping.cancelled() => return,
            }
            if let Err(error) = self.expire_sessions(self.clock.now()).await {
                tracing::warn!(error = &error as &dyn std::error::Error, "idle sessions could not be expired");
            }
            if let Err(error) = self.store.remove_outdated_keys(self.clock.now()).await {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "outdated keys of requests could not be removed"
                );
            }
        }
    }

    /// Expires the open sessions that have been idle for too long by `now`, and logs which.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn expire_sessions(&self, now: Timestamp) -> Result<(), ServiceError> {
        /// Most that have a line of the log each; of further ones, it has the number.
        const MAX_LOGGED: usize = 100;
        let mut n_expired = 0;
        loop {
            let expired = self.store.expire_sessions(now, self.session_idle_timeout, self.alive_every()).await?;
            for session in expired.iter().take(MAX_LOGGED.saturating_sub(n_expired)) {
                tracing::info!(
                    session = session.id,
                    idle_s = now.duration_since(session.active_at).as_secs(),
                    n_observations = session.n_observations,
                    "a session has expired; its observations are deleted"
                );
            }
            n_expired += expired.len();
            if expired.len() < MAX_EXPIRED_AT_ONCE {
                break;
            }
        }
        if n_expired > MAX_LOGGED {
            tracing::info!(n_sessions = n_expired, "more sessions have expired than are logged one by one");
        }
        Ok(())
    }

    /// How often the service looks for idle sessions, and notes that it is alive: sessions live at most this much too long.
    pub(super) fn alive_every(&self) -> Duration {
        const CHECKS_PER_TIMEOUT: u32 = 10;
        (self.session_idle_timeout / CHECKS_PER_TIMEOUT).max(MIN_CHECK_INTERVAL)
    }
}

/// Looking for idle sessions more often than this would only keep the disk busy.
const MIN_CHECK_INTERVAL: Duration = Duration::from_millis(50);

fn unknown(id: &str) -> ServiceError {
    ServiceError::Unknown { kind: Kind::Session, name: id.to_owned(), pointer: None }
}

/// The weights of the session `id`, as they are stored, in the order of the model's attributes.
fn weights_in_order(weights: &ByAttribute<f64>, schema: &Schema, id: &str) -> Result<Weights, SessionError> {
    let missing =
        |name: &str| ServiceError::unreadable("sessions", "weights", id, format!("the weight of {name:?} is missing"));
    let names = schema.attributes().iter().map(|attribute| &attribute.name);
    let weights = names.map(|name| weights.get(name).copied().ok_or_else(|| missing(name)));
    Ok(Weights::of(weights.collect::<Result<Vec<_>, _>>()?))
}

/// Observations of up to so many values are read where they are needed, which takes less than a millisecond.
const MAX_INLINE_VALUES: usize = 8192;

/// Commits the rest of a session that has ended to `steps`, and tells of its policy, which has this id.
fn end_again(
    online: OnlineMapping,
    mut steps: CommittedSteps,
    (policy_id, warnings): (Option<String>, Vec<Warning>),
    model: &Model,
    memory: &Memory,
) -> Result<(CommittedSteps, SessionPolicy), SessionError> {
    let n_rest = online.n_rest();
    let taken = steps.take_for(n_rest, model, memory);
    taken
        .and_then(|()| steps.take_more(SessionPolicy::most_bytes(steps.len() + n_rest), memory))
        .map_err(ServiceError::from)?;
    let (rest, mapping) = online.end().ok_or(SessionError::Empty)?;
    steps.extend(rest);
    Ok((steps, SessionPolicy::of(policy_id, model, &mapping, warnings)))
}

#[cfg(test)]
mod tests;
