//! Sessions: streams of observations in, committed steps out, durable.
//!
//! Of a session only what it was opened with and its observations are stored. Whoever resumes it gets the same steps
//! again, because they follow from those. A session belongs to one connection at a time; resuming takes it over.

mod session;

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use session::Source;
pub use session::{Ended, Observation, Received, RewardState, Session};

use super::opening::{Names, Opening};
use super::owners::{Ownership, TakenOver};
use super::policies::Named;
use super::{Caller, Etude, PoolError, ServiceError};
use crate::attribute::{Schema, Weights};
use crate::document::{self, Faults, Place};
use crate::mapping::{Budget, CommittedStep, Demonstration, Mapper, OnlineMapping, Policy, TooManySteps};
use crate::store::{MAX_EXPIRED_AT_ONCE, NewSession, Page, SessionRow, SessionStatus, SessionWeights, StoreError};

/// Why a session could not do as told.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// Observations are missing in between.
    #[error("expected seq {expected}")]
    Gap {
        /// The observation that comes next.
        expected: u32,
    },
    /// There would be more observations than a session may have.
    #[error("a session has at most {} observations", Demonstration::MAX_OBSERVATIONS)]
    TooMany,
    /// There is no demonstration to end.
    #[error("nothing was observed yet")]
    Empty,
    /// The demonstration has ended already.
    #[error("the demonstration has ended")]
    Ended,
    /// The demonstration has ended, but its policy cannot be stored. What was observed stays.
    #[error("the demonstration cannot be ended: {0}")]
    TooManySteps(#[from] TooManySteps),
    /// Something is wrong with the frame.
    #[error("{0}")]
    Faults(#[from] Faults),
    /// The session has expired, or was ended or taken over by another connection.
    #[error("the session is not open any more")]
    NotOpen,
    /// Another connection has taken the session over.
    #[error("the session was resumed on another connection")]
    TakenOver,
    /// Whatever else can go wrong.
    #[error(transparent)]
    Service(ServiceError),
}

impl From<ServiceError> for SessionError {
    fn from(error: ServiceError) -> Self {
        match error {
            ServiceError::Faults(faults) => Self::Faults(faults),
            error => Self::Service(error),
        }
    }
}

impl From<TakenOver> for SessionError {
    fn from(TakenOver: TakenOver) -> Self {
        Self::TakenOver
    }
}

impl From<StoreError> for SessionError {
    fn from(error: StoreError) -> Self {
        ServiceError::from(error).into()
    }
}

impl From<PoolError> for SessionError {
    fn from(error: PoolError) -> Self {
        ServiceError::from(error).into()
    }
}

/// A session that was resumed.
#[derive(Debug)]
pub struct Resumed {
    /// The session.
    pub session: Session,
    /// Every step that was committed so far.
    pub steps: Vec<CommittedStep>,
    /// Its policy, if it has ended.
    pub policy: Option<Policy>,
}

impl Etude {
    /// Opens a session as `request` says: an object with the fields [`Session::OPEN_FIELDS`].
    ///
    /// # Errors
    ///
    /// If the request has faults or names what is unknown, or the service cannot do it now.
    pub async fn open_session(&self, request: &Value, caller: Caller) -> Result<Session, SessionError> {
        let now = caller.now;
        let place = self.pool.admit_when_needed(caller.client);
        let mut faults = Faults::default();
        let object = Place::root(request).object(&Session::OPEN_FIELDS, &mut faults);
        let names = object.as_ref().and_then(|object| Names::read(object, &mut faults));
        // With the help of the model, more faults may be found; so those found without it wait.
        let Some(Names { envelope, explores, lookahead }) = names else { return Err(faults.into()) };
        let deadline = self.deadline(&envelope, caller.arrived);
        let Named { learner, model_hash, mapper } = self.find(&envelope, faults.clone(), &place, deadline).await?;
        drop(place);
        // As much as a search may take.
        let max_bytes = usize::try_from(self.memory.room() / 2).unwrap_or(usize::MAX).min(Budget::DEFAULT.max_bytes);
        let opening = object
            .as_ref()
            .and_then(|object| Opening::read(&mapper, learner.as_ref(), lookahead, object, max_bytes, &mut faults));
        let Opening { mut weights, start } = faults.check(opening)?;
        let model = envelope.model;

        let mut trial = None;
        if let (true, Some(ready)) = (explores, &learner) {
            let draw = self.draw(ready, mapper.model().schema(), now).await?;
            weights = draw.weights;
            trial = Some(draw.trial);
        }
        let id = Uuid::now_v7().to_string();
        let ownership = self.owners.take(&id).await?;
        let source = Source {
            learner: learner.as_ref().map(|ready| ready.name.clone()),
            weights_version: learner.as_ref().map(|ready| ready.weights.version),
            trial_id: trial.as_ref().map(|trial| trial.id.clone()),
        };
        let opened = self
            .store
            .open_session(NewSession {
                id: id.clone(),
                model: model.clone(),
                model_hash: model_hash.clone(),
                weights: mapper.model().schema().by_attribute(weights.as_slice().iter().copied()),
                lookahead: lookahead.map(NonZeroU32::get),
                start,
                learner: source.learner.clone(),
                weights_version: source.weights_version,
                trial,
                created_at: now,
            })
            .await?;
        if !opened {
            // Deleted in between.
            let name = source.learner.unwrap_or_default();
            return Err(ServiceError::Unknown { kind: "learner", name, pointer: Some("/learner") }.into());
        }
        let online = OnlineMapping::new(&mapper, weights.clone(), start, lookahead);
        let online = Some(online);
        Ok(Session {
            id,
            model,
            model_hash,
            mapper,
            weights,
            lookahead,
            start,
            source,
            n_received: 0,
            n_steps: 0,
            online,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
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
        // Behind whatever is still to be written for the owner before. It may be done already.
        let _is_open = self.store.touch_session_behind_all(id, caller.now).await?;
        let row = self.session(id).await?;
        if row.status == SessionStatus::Expired {
            return Err(SessionError::NotOpen);
        }
        let (hash, mapper) = self.mapper(&row.model, "/model", None, None).await?;
        // Registered anew, the same world may have become too large to be known in full.
        if hash != row.model_hash || mapper.model().is_lazy() {
            let name = format!("{} with hash {}", row.model, row.model_hash);
            return Err(ServiceError::Unknown { kind: "model", name, pointer: None }.into());
        }
        let weights = read_weights(row.weights, mapper.model().schema(), id)?;
        let lookahead = row.lookahead.and_then(NonZeroU32::new);
        let mut session = Session {
            id: row.id,
            model: row.model,
            model_hash: row.model_hash,
            weights: weights.clone(),
            lookahead,
            start: row.start,
            source: Source { learner: row.learner, weights_version: row.weights_version, trial_id: row.trial_id },
            n_received: row.n_observations,
            n_steps: 0,
            online: Some(OnlineMapping::new(&mapper, weights, row.start, lookahead)),
            mapper,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
            ownership,
        };
        let texts = self.store.observations(id).await?;
        let observations = read_stored(&session.mapper, &texts, id)?;
        let mut steps = session.advance(self, observations).await?;
        let policy = match row.policy_id {
            None => None,
            Some(policy_id) => {
                // Whoever ended it may have been gone before there was something to refine.
                self.refiner.wake();
                let rest = session.online.take().and_then(OnlineMapping::end);
                steps.extend(rest.map(|(rest, _)| rest).unwrap_or_default());
                session.n_steps = steps.len();
                let (policy, _held) = self.policy(&policy_id).await?;
                let read = serde_json::from_str(&policy);
                Some(read.map_err(|error| StoreError::corrupt("policies", "policy", policy_id, error))?)
            }
        };
        Ok(Resumed { session, steps, policy })
    }

    /// The session with this id.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn session(&self, id: &str) -> Result<SessionRow, ServiceError> {
        let unknown = || ServiceError::Unknown { kind: "session", name: id.to_owned(), pointer: None };
        self.store.session(id).await?.ok_or_else(unknown)
    }

    /// At most `limit` sessions in the order in which they were opened, from the first after the sequence number `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn sessions(&self, after: i64, limit: u32) -> Result<Page<SessionRow>, ServiceError> {
        Ok(self.store.sessions(after, limit).await?)
    }

    /// Expires open sessions that have been idle for too long, now and then, until `stopping` is cancelled.
    pub async fn expire_until(self: Arc<Self>, stopping: CancellationToken) {
        let mut ticks = tokio::time::interval(self.alive_every());
        loop {
            tokio::select! {
                _ = ticks.tick() => {}
                () = stopping.cancelled() => return,
            }
            if let Err(error) = self.expire_sessions(Timestamp::now()).await {
                tracing::warn!(error = &error as &dyn std::error::Error, "idle sessions could not be expired");
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

/// Reads weights that were stored.
fn read_weights(weights: SessionWeights, schema: &Schema, id: &str) -> Result<Weights, SessionError> {
    let missing =
        |name: &str| StoreError::corrupt("sessions", "weights", id, format!("the weight of {name:?} is missing"));
    let weights: Result<Vec<f64>, _> = match weights {
        SessionWeights::InOrder(weights) => Ok(weights),
        SessionWeights::Named(weights) => {
            let names = schema.attributes().iter().map(|attribute| &attribute.name);
            names.map(|name| weights.get(name).copied().ok_or_else(|| missing(name))).collect()
        }
    };
    Ok(Weights::of(weights?))
}

/// Reads observations that were stored, which were read without faults before.
fn read_stored(mapper: &Mapper, texts: &[String], id: &str) -> Result<Vec<Observation>, SessionError> {
    let corrupt =
        |source: Box<dyn std::error::Error + Send + Sync>| StoreError::corrupt("observations", "states", id, source);
    let mut observations = Vec::new();
    for text in texts {
        let document = document::parse(text.as_bytes()).map_err(|error| corrupt(error.into()))?;
        let mut faults = Faults::default();
        let root = Place::root(&document);
        for (n, state) in root.array(&mut faults).unwrap_or_default().iter().enumerate() {
            observations.extend(mapper.model().schema().read_observation(&root.item(n, state), &mut faults));
        }
        faults.check(Some(())).map_err(|faults| corrupt(faults.into()))?;
    }
    Ok(observations)
}
