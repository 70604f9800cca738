//! Sessions: streams of observations in, committed steps out, durable.
//!
//! Of a session what it was opened with and its observations are stored, and what was decided by time: all else follows from those. So
//! that it need not be searched again, the steps are [kept] too, a little later. A session belongs to one connection at a time; resuming
//! takes it over. Where steps wait for so long at most, the service attends to sessions that are [left].

mod advancing;
mod attending;
mod committed;
mod ending;
mod error;
mod kept;
mod left;
mod reading;
mod received;
mod receiving;
mod resuming;
mod session;
mod waits;

use std::num::{NonZeroU32, NonZeroU64};
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;
use tokio_util::sync::CancellationToken;

pub use committed::CommittedSteps;
pub use ending::{Ended, SessionPolicy};
pub use error::SessionError;
pub use kept::ShortStep;
use kept::Unwritten;
pub(super) use left::Left;
use received::ReceivedText;
pub use received::{Coming, Observation, Received, ReceivedFrame};
pub use resuming::Resumed;
use session::Source;
pub use session::{RewardState, Session};
pub(crate) use waits::Waits;

use super::opening::{self, SessionOptions};
use super::requests::Named;
use super::trials::MAX_DRAWS;
use super::{Caller, Etude, Kind, PoolError, ServiceError};
use crate::store::{Deletion, MAX_EXPIRED_AT_ONCE, NewSession, Opened, Owner, Page, SessionFilter, SessionRecord};
use etude_core::document::{Faults, Place};
use etude_core::mapping::{Budget, OnlineMapping, RequestKind, Watch};

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
        let SessionOptions { mut weights, conditions, lookahead, perception, lookahead_ms } = faults.check(read)?;
        let model = names.model;

        let id = self.ids.next().to_string();
        let ownership = self.owners.take(&id).await?;
        let mut session = NewSession {
            id: id.clone(),
            model: model.clone(),
            model_hash: model_hash.clone(),
            weights: mapper.model().schema().by_attribute(weights.as_slice().iter().copied()),
            lookahead: lookahead.map(NonZeroU32::get),
            lookahead_ms: lookahead_ms.map(NonZeroU64::get),
            observe: perception.as_ref().map(|perception| perception.document().to_string()),
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
            leaving: self.left.leaving(&id),
            id,
            model,
            model_hash,
            mapper,
            lookahead,
            perception,
            conditions,
            source,
            n_received: 0,
            n_sent: 0,
            n_steps: 0,
            n_met: 0,
            waits: Waits::of(lookahead_ms),
            unwritten: Unwritten::default(),
            is_slow: false,
            takes_some_time: false,
            text: ReceivedText::from_start(),
            watch: Watch::new(&weights),
            weights,
            online,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
            owner: Owner::FIRST,
            ownership,
        })
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

#[cfg(test)]
mod tests;
