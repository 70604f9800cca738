//! Sessions: streams of observations in, committed steps out, durable.
//!
//! Of a session only what it was opened with and its observations are stored. Whoever resumes it gets the same steps
//! again, because they follow from those. A session belongs to one connection at a time; resuming takes it over.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Instant;

use jiff::Timestamp;
use serde_json::Value;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::opening::{Names, Opening};
use super::owners::{Ownership, TakenOver};
use super::policies::{Named, PolicyText, as_micros, report, write_policy};
use super::{Etude, PoolError, ServiceError};
use crate::attribute::{ByAttribute, Schema, Weights};
use crate::document::{self, Faults, Place};
use crate::interrupt::{Interrupt, Uninterrupted};
use crate::mapping::{
    CommittedStep, Demonstration, Mapper, OnlineMapping, Policy, Problem, Stamp, Status, TooManySteps,
};
use crate::model::Origin;
use crate::store::{
    AcceptedReward, NewObservations, NewRefinement, NewSession, Page, SessionEnd, SessionRow, SessionStatus,
    SessionWeights, StoreError, TrialRow,
};

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

/// Work up to this many states and transitions times layers is done where it arrives, which takes less than a millisecond; more
/// in the pool.
const MAX_INLINE_WORK: usize = 1 << 14;

/// An open session, and the right to drive it.
#[derive(Debug)]
pub struct Session {
    id: String,
    model: String,
    model_hash: String,
    mapper: Arc<Mapper>,
    weights: Weights,
    lookahead: Option<NonZeroU32>,
    start: Option<u32>,
    source: Source,
    n_received: u32,
    n_steps: usize,
    /// `None` once the session has ended.
    online: Option<OnlineMapping>,
    ownership: Ownership,
}

/// Where a session's weights come from.
#[derive(Clone, Debug)]
struct Source {
    learner: Option<String>,
    weights_version: Option<u64>,
    trial_id: Option<String>,
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

/// What became of observations that were received, besides being durable.
#[derive(Debug)]
pub enum Received {
    /// They were mapped at the same time, and commit these steps.
    Mapped(Vec<CommittedStep>),
    /// They take longer to be mapped: see [`Session::advance`].
    Waiting(Vec<Observation>),
}

/// The end of a session.
#[derive(Debug)]
pub struct Ended {
    /// The steps committed by the end.
    pub steps: Vec<CommittedStep>,
    /// The policy of the whole, stored.
    pub policy: Policy,
}

/// What has become of the reward of a session.
#[derive(Clone, Debug, PartialEq)]
pub enum RewardState {
    /// It is still to come.
    Awaited,
    /// It is on disk.
    Accepted {
        /// The trial that earned it.
        trial: String,
        /// The reward.
        reward: AcceptedReward,
    },
    /// None will come: the session does not explore, its trial has failed, or its learner was deleted.
    Never,
}

impl Etude {
    /// Opens a session as `request` says: an object with the fields [`Session::OPEN_FIELDS`]. Where as much waits to be searched
    /// as may, it is refused; once it is open, it waits for its turn.
    ///
    /// # Errors
    ///
    /// If the request has faults or names what is unknown, or the service cannot do it now.
    pub async fn open_session(&self, request: &Value, now: Timestamp) -> Result<Session, SessionError> {
        let place = self.pool.admit()?;
        let mut faults = Faults::default();
        let object = Place::root(request).object(&Session::OPEN_FIELDS, &mut faults);
        let names = object.as_ref().and_then(|object| Names::read(object, &mut faults));
        // With the help of the model, more faults may be found; so those found without it wait.
        let Some(Names { envelope, explores, lookahead }) = names else { return Err(faults.into()) };
        let Named { learner, model_hash, mapper } = self.find(&envelope, faults.clone(), &place).await?;
        drop(place);
        let opening =
            object.as_ref().and_then(|object| Opening::read(&mapper, learner.as_ref(), lookahead, object, &mut faults));
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
            ownership,
        })
    }

    /// Takes over the session `id`, from whatever connection drives it, and makes its steps again.
    ///
    /// # Errors
    ///
    /// If there is none, it has expired, its model is gone, or it is taken over meanwhile.
    pub async fn resume_session(&self, id: &str, now: Timestamp) -> Result<Resumed, SessionError> {
        // Looked up first, so that nobody is bothered for what does not exist.
        self.session(id).await?;
        let ownership = self.owners.take(id).await?;
        let taken_over = ownership.taken_over.clone();
        tokio::select! {
            biased;
            () = taken_over.cancelled() => Err(SessionError::TakenOver),
            resumed = self.resume_owned(id, ownership, now) => resumed,
        }
    }

    async fn resume_owned(&self, id: &str, ownership: Ownership, now: Timestamp) -> Result<Resumed, SessionError> {
        // Behind whatever is still to be written for the owner before. It may be done already.
        let _is_open = self.store.touch_session(id, now).await?;
        let row = self.session(id).await?;
        if row.status == SessionStatus::Expired {
            return Err(SessionError::NotOpen);
        }
        let (hash, mapper) = self.mapper(&row.model, "/model", None).await?;
        // Registered anew, the same world may have become too large to be known in full.
        if hash != row.model_hash || mapper.model().is_lazy() {
            let name = format!("{} with hash {}", row.model, row.model_hash);
            return Err(ServiceError::Unknown { kind: "model", name, pointer: None }.into());
        }
        let weights = read_weights(row.weights, mapper.model().schema())?;
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
            ownership,
        };
        let texts = self.store.observations(id).await?;
        let observations = read_stored(&session.mapper, &texts)?;
        let mut steps = session.advance(self, observations).await?;
        let policy = match row.policy_id {
            None => None,
            Some(policy_id) => {
                // Whoever ended it may have been gone before there was something to refine.
                self.refiner.wake();
                let rest = session.online.take().and_then(OnlineMapping::end);
                steps.extend(rest.map(|(rest, _)| rest).unwrap_or_default());
                session.n_steps = steps.len();
                let policy = self.policy(&policy_id).await?;
                let corrupt = |error: serde_json::Error| StoreError::Corrupt {
                    table: "policies",
                    column: "policy",
                    source: error.into(),
                };
                Some(serde_json::from_str(&policy).map_err(corrupt)?)
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
        /// Sessions live at most this fraction of their time too long.
        const CHECKS_PER_TIMEOUT: u32 = 10;
        let mut ticks = tokio::time::interval((self.session_idle_timeout / CHECKS_PER_TIMEOUT).max(MIN_CHECK_INTERVAL));
        loop {
            tokio::select! {
                _ = ticks.tick() => {}
                () = stopping.cancelled() => return,
            }
            let before = Timestamp::now().checked_sub(self.session_idle_timeout).unwrap_or(Timestamp::MIN);
            if let Err(error) = self.store.expire_sessions(before).await {
                tracing::warn!(error = &error as &dyn std::error::Error, "idle sessions could not be expired");
            }
        }
    }
}

/// Looking for idle sessions more often than this would only keep the disk busy.
const MIN_CHECK_INTERVAL: std::time::Duration = std::time::Duration::from_millis(50);

impl Session {
    /// Every field of a request to open a session.
    pub const OPEN_FIELDS: [&'static str; 7] = ["type", "model", "learner", "explore", "weights", "lookahead", "start"];

    /// Its id.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The trial that it explores, if any.
    #[must_use]
    pub fn trial_id(&self) -> Option<&str> {
        self.source.trial_id.as_deref()
    }

    /// Whether its demonstration has ended.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.online.is_none()
    }

    /// The weights of the distance.
    #[must_use]
    pub fn weights(&self) -> ByAttribute<f64> {
        self.mapper.model().schema().by_attribute(self.weights.as_slice().iter().copied())
    }

    /// How many observations are durable.
    #[must_use]
    pub fn n_received(&self) -> u32 {
        self.n_received
    }

    /// How many steps were committed.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.n_steps
    }

    /// Cancelled when another connection takes the session over.
    #[must_use]
    pub fn taken_over(&self) -> &CancellationToken {
        &self.ownership.taken_over
    }

    /// What has become of its reward.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn reward(&self, etude: &Etude) -> Result<RewardState, SessionError> {
        let Some(trial) = &self.source.trial_id else { return Ok(RewardState::Never) };
        Ok(match etude.store.trial(trial).await? {
            Some(TrialRow { reward: Some(reward), id, .. }) => RewardState::Accepted { trial: id, reward },
            Some(TrialRow { failed: None, .. }) => RewardState::Awaited,
            Some(_) | None => RewardState::Never,
        })
    }

    /// Takes the states from `seq` on, of which those received before are ignored: they are durable when this returns. What
    /// takes less time than the disk is mapped while that writes.
    ///
    /// # Errors
    ///
    /// If something is wrong with them; then none was taken. After [`SessionError::NotOpen`] and
    /// [`SessionError::Service`] the session is to be dropped.
    pub async fn receive(
        &mut self,
        etude: &Etude,
        seq: u32,
        states: &Place<'_, '_>,
        now: Timestamp,
    ) -> Result<Received, SessionError> {
        if self.has_ended() {
            return Err(SessionError::Ended);
        }
        if seq > self.n_received {
            return Err(SessionError::Gap { expected: self.n_received });
        }
        let mut faults = Faults::default();
        let Some(items) = states.array(&mut faults) else { return Err(faults.into()) };
        let n_known = (self.n_received - seq) as usize;
        let new = items.get(n_known..).unwrap_or_default();
        if new.is_empty() {
            if !etude.store.touch_session(&self.id, now).await? {
                return Err(SessionError::NotOpen);
            }
            return Ok(Received::Mapped(Vec::new()));
        }
        if self.n_received as usize + new.len() > Demonstration::MAX_OBSERVATIONS {
            return Err(SessionError::TooMany);
        }
        let n_observations = self.n_received as usize + new.len();
        if !Policy::check_size(self.mapper.model(), n_observations, states, &mut faults) {
            return Err(faults.into());
        }
        let schema = self.mapper.model().schema();
        let read = new.iter().enumerate().map(|(n, state)| {
            let place = states.item(n_known + n, state);
            schema.read_observation(&place, &mut faults)
        });
        let observations: Vec<_> = read.collect();
        let observations = faults.check(observations.into_iter().collect::<Option<Vec<_>>>())?;
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_OBSERVATIONS")]
        let n_states = new.len() as u32;
        let adding = etude.store.add_observations(NewObservations {
            session_id: self.id.clone(),
            seq: self.n_received,
            n_states,
            states: serde_json::to_string(new).map_err(ServiceError::Write)?,
            at: now,
        });
        let mapping = async {
            if self.is_inline(observations.len()) {
                self.advance(etude, observations).await.map(Received::Mapped)
            } else {
                Ok(Received::Waiting(observations))
            }
        };
        // In this order: the disk is at work before the mapping begins.
        let (added, mapped) = tokio::join!(biased; adding, mapping);
        if !added? {
            return Err(SessionError::NotOpen);
        }
        self.n_received += n_states;
        mapped
    }

    /// Whether so many observations are mapped where they arrive.
    fn is_inline(&self, n_observations: usize) -> bool {
        let graph = self.mapper.model().graph();
        is_inline(graph.n_states() + graph.n_transitions(), self.lookahead, n_observations)
    }

    /// Maps observations that were received, and gives the steps that they commit.
    ///
    /// # Errors
    ///
    /// If the service ends; the session is then to be resumed.
    pub async fn advance(
        &mut self,
        etude: &Etude,
        observations: Vec<Observation>,
    ) -> Result<Vec<CommittedStep>, SessionError> {
        let mut online = self.online.take().ok_or(SessionError::NotOpen)?;
        let is_inline = self.is_inline(observations.len());
        let job = move |interrupt: &mut dyn Interrupt| {
            let mut steps = Vec::new();
            for observation in &observations {
                steps.extend(online.observe(observation, interrupt)?);
            }
            Ok((online, steps))
        };
        let (online, steps) = if is_inline {
            job(&mut Uninterrupted).map_err(|_| PoolError::Stopped)?
        } else {
            etude.pool.run_patiently(job).await?
        };
        self.online = Some(online);
        self.n_steps += steps.len();
        Ok(steps)
    }

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
        let texts = etude.store.observations(&self.id).await?;
        let online = self.online.take().ok_or(SessionError::NotOpen)?;
        let (mapper, weights, start) = (Arc::clone(&self.mapper), self.weights.clone(), self.start);
        let policy_id = match &self.source.trial_id {
            Some(trial) => etude.store.trial(trial).await?.map(|trial| trial.policy_id),
            None => None,
        };
        let stamp = Stamp {
            id: Some(policy_id.unwrap_or_else(|| Uuid::now_v7().to_string())),
            model: self.model.clone(),
            model_hash: self.model_hash.clone(),
            learner: self.source.learner.clone(),
            weights_version: self.source.weights_version,
            lookahead: self.lookahead.map(NonZeroU32::get),
            ..Stamp::default()
        };
        let job = move |_: &mut dyn Interrupt| Ok(conclude(online, &mapper, &texts, weights, start, stamp));
        let (steps, policy, row, refinement) = etude.pool.run_patiently(job).await??;
        let is_refined = refinement.is_some();
        let end = SessionEnd { session_id: self.id.clone(), policy: row.at(now), refinement };
        if !etude.store.end_session(end).await? {
            return Err(SessionError::NotOpen);
        }
        if is_refined {
            etude.refiner.wake();
        }
        self.n_steps += steps.len();
        Ok(Ended { steps, policy })
    }
}

/// Whether so many observations are mapped where they arrive, in a model of `size` states and transitions.
fn is_inline(size: usize, lookahead: Option<NonZeroU32>, n_observations: usize) -> bool {
    let n_layers = n_observations.saturating_mul(lookahead.map_or(1, |lookahead| lookahead.get() as usize));
    n_layers.saturating_mul(size) <= MAX_INLINE_WORK
}

/// An observation as it was read. Shape `[n_attributes]`; `None` where an attribute was not observed.
pub type Observation = Vec<Option<crate::attribute::Value>>;

type Concluded = (Vec<CommittedStep>, Policy, PolicyText, Option<NewRefinement>);

/// Commits the rest, and writes the policy of the whole.
fn conclude(
    online: OnlineMapping,
    mapper: &Mapper,
    texts: &[String],
    weights: Weights,
    start: Option<u32>,
    stamp: Stamp,
) -> Result<Concluded, SessionError> {
    let started = Instant::now();
    let (steps, mapping) = online.end().ok_or(SessionError::Empty)?;
    Policy::check_steps(mapper.model(), &mapping)?;
    let demonstration = Demonstration::of(read_stored(mapper, texts)?).ok_or(SessionError::Empty)?;
    let problem = Problem::new(mapper.model(), demonstration, weights, start.map(Origin::State));
    let stamp = Stamp { elapsed_us: as_micros(started), ..stamp };
    report(&stamp, &mapping);
    let policy = Policy::new(stamp.clone(), &problem, &mapping);
    let (_, row) = write_policy(stamp, &problem, &mapping)?;
    let refinement = (policy.status == Status::Local).then(|| {
        let parsed = texts.iter().map(|text| serde_json::from_str::<Vec<Value>>(text).unwrap_or_default());
        let demonstration: Vec<Value> = parsed.flatten().collect();
        let request = serde_json::json!({
            "model": policy.model,
            "weights": policy.weights,
            "start": problem.start(),
            "demonstration": demonstration,
        });
        let request = request.to_string();
        NewRefinement {
            policy_id: policy.id.clone().unwrap_or_default(),
            model_hash: policy.model_hash.clone(),
            request,
        }
    });
    Ok((steps, policy, row, refinement))
}

/// Reads weights that were stored.
fn read_weights(weights: SessionWeights, schema: &Schema) -> Result<Weights, SessionError> {
    let missing = |name: &str| StoreError::Corrupt {
        table: "sessions",
        column: "weights",
        source: format!("the weight of {name:?} is missing").into(),
    };
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
fn read_stored(mapper: &Mapper, texts: &[String]) -> Result<Vec<Observation>, SessionError> {
    let corrupt = |source: Box<dyn std::error::Error + Send + Sync>| StoreError::Corrupt {
        table: "observations",
        column: "states",
        source,
    };
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::model::{Definition, Limits, Model};

    #[test]
    fn what_is_mapped_where_it_arrives_is_measured_by_transitions_too() {
        let size = |definition: &Value| {
            let definition = Definition::read(definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
            let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
            model.graph().n_states() + model.graph().n_transitions()
        };
        let lookahead = NonZeroU32::new(8);
        let cave = size(&json!({"dynamics": {"kind": "wumpus", "width": 7, "height": 4, "gold": [[5, 0]]}}));
        assert!(is_inline(cave, lookahead, 1) && !is_inline(cave, lookahead, 1000), "{cave}");
        // Few states, between any two of which an action leads.
        let n_states = 100;
        let action = |n: usize| json!({"name": format!("to {n}")});
        let transitions = (0..n_states).flat_map(|from| (0..n_states).map(move |to| json!([from, to, to])));
        let complete = json!({
            "attributes": [{"name": "x", "kind": "number"}], "actions": (0..n_states).map(action).collect::<Vec<_>>(),
            "dynamics": {
                "kind": "table", "states": (0..n_states).map(|x| json!([x])).collect::<Vec<_>>(),
                "transitions": transitions.collect::<Vec<_>>(),
            },
        });
        assert!(!is_inline(size(&complete), lookahead, 1));
    }
}
