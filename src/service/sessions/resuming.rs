//! How a session is taken up again: at the last step that was written, from where what was observed since is mapped.

use std::num::{NonZeroU32, NonZeroU64};
use std::sync::Arc;

use super::committed::CommittedSteps;
use super::ending::SessionPolicy;
use super::kept::{Kept, ShortStep, Unwritten};
use super::left::RETRY_AFTER;
use super::reading::{ReadAgain, StoredSession, read_again};
use super::received::{Observation, ReceivedText};
use super::session::{Session, Source};
use super::waits::Waits;
use super::{SessionError, unknown};
use crate::client::Client;
use crate::memory::{Held, Memory};
use crate::service::owners::Ownership;
use crate::service::{Caller, Etude, Kind, ServiceError};
use crate::store::{SessionRecord, SessionStatus, StoredObservations, Taken};
use etude_core::attribute::{ByAttribute, Schema, Weights};
use etude_core::document::{self, Faults, Place};
use etude_core::interrupt::{Interrupt, time_until_finish};
use etude_core::mapping::{Demonstration, OnlineMapping, Perception, Warning, Watch};
use etude_core::model::Model;

/// A session that was resumed.
#[derive(Debug)]
pub struct Resumed {
    /// The session.
    pub session: Session,
    /// The steps that were committed, from the first to the last that was written. Their memory is held with the others.
    pub kept: Vec<ShortStep>,
    /// The steps after these, found again.
    pub steps: CommittedSteps,
    /// Its policy, if it has ended. Its memory is held with the steps.
    pub policy: Option<SessionPolicy>,
}

impl Etude {
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
        let mut leaving = self.left.leaving(id);
        if row.lookahead_ms.is_some() {
            leaving.until(Some(self.clock.instant() + RETRY_AFTER));
        }
        let resumed = self.take_up(row, ownership, caller).await?;
        leaving.until(None);
        Ok(resumed)
    }

    /// Takes up the session `id` if it is open and nobody drives it. This is no sign of life of its client.
    pub(super) async fn take_up_unattended(&self, id: &str, client: Client) -> Result<Option<Session>, SessionError> {
        let Some(ownership) = self.owners.try_take(id) else { return Ok(None) };
        let Some(row) = self.store.session(id).await?.filter(|row| row.status == SessionStatus::Open) else {
            return Ok(None);
        };
        let taken_over = ownership.taken_over.clone();
        let caller = Caller { client, arrived: self.clock.instant(), now: self.clock.now() };
        tokio::select! {
            biased;
            () = taken_over.cancelled() => Ok(None),
            resumed = self.take_up(row, ownership, caller) => resumed.map(|resumed| Some(resumed.session)),
        }
    }

    /// Takes up a session at the last step that was written, and maps what was observed since.
    async fn take_up(&self, row: SessionRecord, ownership: Ownership, caller: Caller) -> Result<Resumed, SessionError> {
        // Nobody says how long it may take.
        let deadline = caller.arrived.checked_add(time_until_finish(self.time_limits.default_deadline));
        let place = self.pool.admit_when_needed(caller.client).waiting_until(deadline);
        let wanted = (row.model.as_str(), row.model_hash.as_str());
        let mapper = self.mapper_with_hash(wanted, "/model", Some(&place), deadline).await?;
        drop(place);
        let name = format!("{} with hash {}", row.model, row.model_hash);
        let gone = move || SessionError::from(ServiceError::Unknown { kind: Kind::Model, name, pointer: None });
        let Some(mapper) = mapper else { return Err(gone()) };
        // Registered anew, the same world may have become too large to be known in full.
        let can_be_followed = row.lookahead.is_some() || !mapper.model().is_lazy();
        if !can_be_followed || !row.conditions.fit(mapper.model()) {
            return Err(gone());
        }
        let weights = weights_in_order(&row.weights, mapper.model().schema(), &row.id)?;
        let lookahead = row.lookahead.and_then(NonZeroU32::new);
        let waits = Waits::of(row.lookahead_ms.and_then(NonZeroU64::new)).filter(|_| row.status == SessionStatus::Open);
        let id = row.id.clone();
        let mut session = Session {
            leaving: self.left.leaving(&row.id),
            id: id.clone(),
            model: row.model,
            model_hash: row.model_hash,
            weights: weights.clone(),
            lookahead,
            perception: row.observe.as_deref().map(|text| read_perception(text, &id)).transpose()?,
            conditions: row.conditions.clone(),
            source: Source { learner: row.learner, weights_version: row.weights_version, trial_id: row.trial_id },
            n_received: row.n_observations,
            n_sent: row.n_observations,
            n_steps: 0,
            n_met: 0,
            waits: None,
            unwritten: Unwritten::default(),
            watch: Watch::new(&weights),
            is_slow: false,
            takes_some_time: false,
            text: ReceivedText::default(),
            online: None,
            mapper,
            held: self.memory.try_take(0).map_err(ServiceError::from)?,
            client: caller.client,
            owner: row.owner,
            ownership,
        };
        let is_done = row.status == SessionStatus::Done;
        let mut steps = CommittedSteps::default();
        let kept = self.kept_steps(&session.id, &mut steps).await?;
        if kept.as_ref().is_some_and(|kept| !kept.fit(session.mapper.model())) {
            return Err(gone());
        }
        let online = session.begin(kept.as_ref())?;
        let first = online.n_observed();
        session.reserve(online.size_bytes() as u64)?;
        session.online = Some(online);
        let n_watched = kept.as_ref().map_or(0, |kept| kept.n_watched);
        let kept = kept.map(|kept| {
            session.watch = kept.watch;
            kept.steps
        });
        let (mut warnings, mut times) = (Vec::new(), Vec::new());
        if session.n_received > 0 {
            let again = self.read_session(&session, (first, n_watched), is_done).await?;
            session.watch = again.watch;
            (warnings, times) = (again.warnings, again.times);
            steps = session.advance(self, again.observations.into()).await?.with(steps);
        }
        let policy = match (row.status, session.online.take()) {
            (SessionStatus::Done, Some(online)) => {
                // Whoever ended it may have been gone before there was something to refine.
                self.refiner.wake();
                let (mapper, memory) = (Arc::clone(&session.mapper), self.memory.clone());
                let end = move |_: &mut dyn Interrupt| {
                    Ok(end_again(online, steps, (row.policy_id, warnings), mapper.model(), &memory))
                };
                let n_kept = kept.as_ref().map_or(0, Vec::len);
                let (ended, policy) = self.pool.run_in_turn(caller.client, end).await??;
                steps = ended;
                session.n_steps = n_kept + steps.len();
                Some(policy)
            }
            (_, online) => {
                session.online = online;
                None
            }
        };
        // Not before: who could not take it up is not the one who leaves it.
        session.waits = waits.map(|mut waits| {
            let (service_time, now) = (self.store.service_time(caller.now), self.clock.instant());
            for (first, at) in times {
                waits.came(first, service_time.since(at), now);
            }
            waits.met(session.n_met);
            waits
        });
        Ok(Resumed { session, kept: kept.unwrap_or_default(), steps, policy })
    }

    /// Reads what was observed in a session, all of it if it is done, else from the observation `first` on or from the first that is not among
    /// the `n_watched`.
    async fn read_session(
        &self,
        session: &Session,
        (first, n_watched): (u32, u32),
        is_done: bool,
    ) -> Result<ReadAgain, SessionError> {
        let from = if is_done { 0 } else { first.min(n_watched) };
        let (id, model) = (&session.id, session.mapper.model());
        let (stored, _held) = self.stored_observations(id, from, session.n_received, model).await?;
        let n_values = (session.n_received - stored.first) as usize * model.schema().len();
        let (n_observations, watch) = (session.n_received, session.watch.clone());
        let of_session = StoredSession { id: id.clone(), stored, n_observations, first, n_watched, watch };
        let (mapper, weights) = (Arc::clone(&session.mapper), session.weights.clone());
        let conditions = is_done.then(|| session.conditions.clone());
        let reading = move || read_again(&mapper, of_session, weights, conditions);
        if n_values <= MAX_INLINE_VALUES {
            return reading();
        }
        // About what a value takes.
        self.pool.read_in_turn(session.client, 8 * n_values, reading).await?
    }

    /// The steps of a session that were written, whose memory is held with `steps`, and what it goes on from; `None` if none were.
    async fn kept_steps(&self, session: &str, steps: &mut CommittedSteps) -> Result<Option<Kept>, SessionError> {
        let n_bytes = self.store.steps_bytes(session).await?;
        let most_bytes = Kept::most_bytes(n_bytes);
        let reading = usize::try_from(n_bytes).unwrap_or(usize::MAX);
        steps.take_more(most_bytes.saturating_add(reading), &self.memory).map_err(ServiceError::from)?;
        let stored = self.store.steps(session).await?;
        let kept = stored.map(|stored| Kept::read(&stored, session)).transpose()?;
        steps.give_back(most_bytes + reading - kept.as_ref().map_or(0, Kept::n_bytes));
        Ok(kept)
    }

    /// The observations of a session as they are stored, from the row on that has the observation `from`, and the memory that these, what is
    /// read of them, and what is written of them take, if it is much: taken before they are read.
    pub(in crate::service) async fn stored_observations(
        &self,
        session: &str,
        from: u32,
        n_observations: u32,
        model: &Model,
    ) -> Result<(StoredObservations, Option<Held>), ServiceError> {
        let n_bytes = usize::try_from(self.store.observations_bytes(session, from).await?).unwrap_or(usize::MAX);
        let held = self.hold_observations(n_bytes, n_observations.saturating_sub(from) as usize, model)?;
        Ok((self.store.observations(session, from).await?, held))
    }

    /// The memory that so many observations take, of a text of so many bytes, if it is much.
    pub(super) fn hold_observations(
        &self,
        n_bytes: usize,
        n_observations: usize,
        model: &Model,
    ) -> Result<Option<Held>, ServiceError> {
        /// In a row, and as they are given.
        const COPIES: usize = 2;
        // All together, and one by one.
        let read_bytes =
            2 * Demonstration::bytes_of(model.schema(), n_observations) + n_observations * size_of::<Observation>();
        let mut held = None;
        self.memory.reserve(&mut held, COPIES.saturating_mul(n_bytes) + read_bytes)?;
        Ok(held)
    }
}

/// The weights of the session `id`, as they are stored, in the order of the model's attributes.
fn weights_in_order(weights: &ByAttribute<f64>, schema: &Schema, id: &str) -> Result<Weights, SessionError> {
    let missing =
        |name: &str| ServiceError::unreadable("sessions", "weights", id, format!("the weight of {name:?} is missing"));
    let names = schema.attributes().iter().map(|attribute| &attribute.name);
    let weights = names.map(|name| weights.get(name).copied().ok_or_else(|| missing(name)));
    Ok(Weights::of(weights.collect::<Result<Vec<_>, _>>()?))
}

/// How the session `id` observes, as it is stored.
fn read_perception(text: &str, id: &str) -> Result<Arc<Perception>, SessionError> {
    let read = || {
        let document = document::parse(text.as_bytes()).ok()?;
        Perception::read(&Place::root(&document), &mut Faults::default())
    };
    let unreadable = || ServiceError::unreadable("sessions", "observe", id, "these are no expressions".to_owned());
    Ok(Arc::new(read().ok_or_else(unreadable)?))
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
