//! Requests as they come: read against the model that they name, and explained where something is wrong.
//!
//! ```text
//! text --> SentRequest: members, what is observed still text --> Names --> model --> Request --> search
//!   |                                 | anything wrong                        |
//!   +----> document ------------------+---------------------------------------+--> all faults
//! ```
//!
//! Both ways go through [`Options::read`] and [`Request::of`]; only the demonstration has two readers, as it is most of a request. What is
//! explained is never searched for.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::de::IgnoredAny;
use serde_json::Value;
use tokio_util::bytes::Bytes;

use super::learners::LearnerState;
use super::search::{MAX_INLINE_BYTES, max_quick_observations, take_for_demonstration};
use super::{Admission, Caller, Etude, PoolError, ServiceError};
use crate::memory::{Held, Memory};
use etude_core::attribute::Weights;
use etude_core::document::{self, Faults, Members, Object, Path, Place};
use etude_core::interrupt::{Interrupt, time_until_finish};
use etude_core::mapping::{
    Demonstration, Mapper, Options, Perception, Policy, Request, RequestKind, Stamp, WellFormed,
};
use etude_core::model::Model;

/// Where a request has its demonstration.
pub(super) const DEMONSTRATION: Path<'static> = Path::Member(&Path::Root, "demonstration");

/// Where a frame has the states that were observed.
pub(super) const STATES: Path<'static> = Path::Member(&Path::Root, "states");

/// Text up to this size takes little once it is parsed, whatever is in it: some 300 KiB.
const MAX_UNCOUNTED_TEXT_BYTES: usize = 4096;

/// A request whose members were told apart.
#[derive(Debug)]
pub(super) struct SentRequest {
    /// An object: all but what is observed.
    pub(super) rest: Value,
    /// What is observed: the text of a demonstration, or of the items of a batch.
    observed: Bytes,
    /// For the rest, if it is much.
    _held: Option<Held>,
}

impl SentRequest {
    /// Takes a request apart. Nothing if it is none, which [`Etude::explain`] tells more about.
    pub(super) fn read(kind: RequestKind, body: &Bytes, memory: &Memory) -> Result<Option<Self>, ServiceError> {
        let members = std::str::from_utf8(body).ok().and_then(|text| Members::split(text, kind.fields()));
        let Some(mut members) = members else { return Ok(None) };
        let Some(observed) = kind.observed().and_then(|name| members.take(name)) else { return Ok(None) };
        // The items of a batch have it each.
        let observe = Some("observe").filter(|name| kind != RequestKind::Batch && kind.fields().contains(name));
        let observe = observe.and_then(|name| members.take(name)).filter(|text| *text != "null");
        let is_counted = members.n_bytes() > MAX_UNCOUNTED_TEXT_BYTES;
        let held = is_counted.then(|| memory.try_take(members.parsed_bytes() as u64)).transpose()?;
        let observed = match observe {
            None => body.slice_ref(observed.as_bytes()),
            Some(observe) => {
                let parsed = document::parsed_bytes(observed.as_bytes()) as u64;
                // While it is read, it is there twice.
                let _held = memory.try_take(2 * parsed)?;
                let Some(text) = perceived(observe, observed) else { return Ok(None) };
                text.into()
            }
        };
        let Some(rest) = members.parse() else { return Ok(None) };
        Ok(Some(Self { rest, observed, _held: held }))
    }

    /// The text of what is observed.
    pub(super) fn observed(&self) -> &str {
        // It was told apart as text.
        std::str::from_utf8(&self.observed).unwrap_or_default()
    }

    /// The demonstration, if it is well-formed and has at most so many observations.
    pub(super) fn demonstration(&self, model: &Model, max_len: usize) -> Option<Demonstration> {
        let well_formed = WellFormed::in_text(model.schema(), self.observed.len());
        WellFormed { max_len, ..well_formed }.read(self.observed()).ok()
    }

    /// The demonstration, if it is well-formed and its policy is not too large, and the memory that it takes, if it is much.
    pub(super) fn counted_demonstration(
        &self,
        model: &Model,
        memory: &Memory,
    ) -> Result<Option<(Demonstration, Option<Held>)>, ServiceError> {
        let max_len = Policy::max_observations(model).min(Demonstration::MAX_OBSERVATIONS);
        let mut held = None;
        memory.reserve(&mut held, most_demonstration_bytes(model, self.observed()))?;
        let Some(demonstration) = self.demonstration(model, max_len) else { return Ok(None) };
        if let Some(held) = &mut held {
            held.shrink_to(Demonstration::bytes_of(model.schema(), demonstration.len()) as u64);
        }
        Ok(Some((demonstration, held)))
    }

    /// What of the observed text is `part`.
    pub(super) fn observed_part(&self, part: &str) -> Bytes {
        self.observed.slice_ref(part.as_bytes())
    }

    /// The request, with this demonstration, if nothing is wrong with it.
    pub(super) fn request<'m>(
        &self,
        kind: RequestKind,
        demonstration: Demonstration,
        model: &'m Model,
        weights: impl FnOnce(&mut Faults) -> Option<Weights>,
    ) -> Option<Request<'m>> {
        let mut faults = Faults::default();
        let object = Place::root(&self.rest).object(kind.fields(), &mut faults)?;
        let request = Request::of(Some(demonstration), model, &object, &Options::default(), weights, &mut faults);
        request.filter(|_| faults.is_empty())
    }
}

/// What is observed of a demonstration, by the expressions in the text `observe`, as text. Nothing if something is wrong with either.
fn perceived(observe: &str, demonstration: &str) -> Option<String> {
    let (observe, demonstration) =
        (document::parse(observe.as_bytes()).ok()?, document::parse(demonstration.as_bytes()).ok()?);
    let mut faults = Faults::default();
    let perception = Perception::read(&Place::root(&observe), &mut faults)?;
    let observed = perception.observe_all(&Place::root(&demonstration), &Path::Root, &mut faults)?;
    Some(observed.to_string())
}

/// Most bytes that the demonstrations in `text` take while they are read. Each observation begins with a bracket.
pub(super) fn most_demonstration_bytes(model: &Model, text: &str) -> usize {
    /// A list that grows is copied to where it has room.
    const COPIES: usize = 2;
    const LEAST_OBSERVATION: usize = "{},".len();
    let most = Policy::max_observations(model);
    let bytes_of = |n: usize| COPIES * Demonstration::bytes_of(model.schema(), n.min(most));
    let n_bytes = bytes_of(text.len() / LEAST_OBSERVATION);
    if n_bytes as u64 <= crate::memory::UNCOUNTED_BYTES {
        return n_bytes;
    }
    bytes_of(text.bytes().filter(|byte| matches!(byte, b'{' | b'[')).count())
}

/// What is read of a request before its model is there.
#[derive(Debug)]
pub(super) struct Names {
    pub(super) model: String,
    pub(super) learner: Option<String>,
    pub(super) deadline: Option<Duration>,
    /// Whether policies are stored.
    pub(super) is_stored: bool,
    /// What is wrong with the request that is the service's alone to know. It is told once the model is found.
    pub(super) own_faults: Faults,
}

/// What a request names.
pub(super) struct Named {
    pub(super) learner: Option<LearnerState>,
    pub(super) model_hash: String,
    pub(super) mapper: Arc<Mapper>,
}

impl Names {
    /// `stamp`, with what the policies of this request have in common: if they are not stored, that they have no id.
    pub(super) fn stamp(&self, stamp: Stamp, named: &Named) -> Stamp {
        let stamp = Stamp { id: stamp.id.filter(|_| self.is_stored), ..stamp };
        let stamp = Stamp { model: self.model.clone(), model_hash: named.model_hash.clone(), ..stamp };
        match &named.learner {
            None => stamp,
            Some(LearnerState { name, weights, .. }) => {
                Stamp { learner: Some(name.clone()), weights_version: Some(weights.version), ..stamp }
            }
        }
    }
}

impl Etude {
    /// Takes a request apart, by its `place` in the pool if it is large. Nothing if it is none.
    pub(super) async fn read_sent(
        &self,
        kind: RequestKind,
        body: &Bytes,
        place: &Admission,
    ) -> Result<Option<SentRequest>, ServiceError> {
        if body.len() <= MAX_INLINE_BYTES {
            return SentRequest::read(kind, body, &self.memory);
        }
        let (n_bytes, body, memory) = (body.len(), body.clone(), self.memory.clone());
        place.run_reading(n_bytes, move || SentRequest::read(kind, &body, &memory)).await?
    }

    /// Reads what can be read of a request without its model, and gives the names if they could be read. `observed` is the member that
    /// it must have, if that was not found already. Faults may have been found either way.
    pub(super) fn read_names(
        &self,
        document: &Value,
        kind: RequestKind,
        observed: Option<&str>,
    ) -> (Option<Names>, Faults) {
        let mut faults = Faults::default();
        let root = Place::root(document);
        let Some(object) = root.object(kind.fields(), &mut faults) else { return (None, faults) };
        let model = object.required("model", &mut faults).and_then(|place| place.string(&mut faults));
        let learner = object.optional("learner").filter(|_| kind.fields().contains(&"learner"));
        let learner = learner.map(|place| place.string(&mut faults));
        if let Some(observed) = observed {
            object.required(observed, &mut faults);
        }
        let options = Options::read_general(&object, &Options::default(), &mut faults);
        let deadline = options.and_then(|options| options.deadline());
        let mut own_faults = check_deadline(deadline, self.time_limits.max_deadline);
        let store = object.optional("store").filter(|_| kind.fields().contains(&"store"));
        let is_stored = store.and_then(|place| place.boolean(&mut own_faults)).unwrap_or(true);
        let names = model.zip(learner.map_or(Some(None), |learner| learner.map(Some)));
        let names = names.map(|(model, learner)| Names {
            model: model.to_owned(),
            learner: learner.map(str::to_owned),
            deadline,
            is_stored,
            own_faults,
        });
        (names, faults)
    }

    /// When the search for a request that came at `arrived` is to finish.
    pub(super) fn deadline(&self, names: &Names, arrived: Instant) -> Option<Instant> {
        let deadline = names.deadline.unwrap_or(self.time_limits.default_deadline);
        arrived.checked_add(time_until_finish(deadline))
    }

    /// Finds what the request in `body` names, in which nothing was wrong so far. Nothing if the body is not JSON, which is told before what
    /// is unknown.
    pub(super) async fn find_for(
        &self,
        body: &Bytes,
        names: &Names,
        place: &Admission,
        deadline: Option<Instant>,
    ) -> Result<Option<Named>, ServiceError> {
        match self.find(names, Faults::default(), place, deadline).await {
            Ok(named) => Ok(Some(named)),
            Err(error) if is_json(body, place).await? => Err(error),
            Err(_) => Ok(None),
        }
    }

    /// Finds what the request names. `faults` are those found so far; what is unknown is one more, if there are any others.
    pub(super) async fn find(
        &self,
        names: &Names,
        mut faults: Faults,
        place: &Admission,
        deadline: Option<Instant>,
    ) -> Result<Named, ServiceError> {
        let learner = match &names.learner {
            Some(learner) => self.learner_state(learner, Some("/learner")).await.map(Some),
            None => Ok(None),
        };
        let mapper = self.known_mapper(&names.model, "/model", place, deadline).await;
        let errors = match (learner, mapper) {
            (Ok(learner), Ok((model_hash, mapper))) => return Ok(Named { learner, model_hash, mapper }),
            (Err(error), Ok(_)) | (Ok(_), Err(error)) if faults.is_empty() => return Err(error),
            (learner, mapper) => learner.err().into_iter().chain(mapper.err()),
        };
        for error in errors {
            let ServiceError::Unknown { pointer: Some(pointer), .. } = error else { return Err(error) };
            faults.note_at(&Path::Member(&Path::Root, pointer.trim_start_matches('/')), error.to_string());
        }
        Err(faults.into())
    }

    /// Tells all that is wrong with a request that could not be read. `check` notes what the model and the learner help to find.
    pub(super) async fn explain(
        &self,
        kind: RequestKind,
        body: Bytes,
        caller: Caller,
        check: impl FnOnce(&Object<'_, '_>, &Model, Option<&LearnerState>, &mut Faults) + Send + 'static,
    ) -> ServiceError {
        match self.faults_of(kind, body, caller, check).await {
            // Another model was given this name meanwhile, for which nothing is wrong.
            Ok(faults) if faults.is_empty() => PoolError::Busy.into(),
            Ok(faults) => faults.into(),
            Err(error) => error,
        }
    }

    async fn faults_of(
        &self,
        kind: RequestKind,
        body: Bytes,
        caller: Caller,
        check: impl FnOnce(&Object<'_, '_>, &Model, Option<&LearnerState>, &mut Faults) + Send + 'static,
    ) -> Result<Faults, ServiceError> {
        let place = self.pool.admit_when_needed(caller.client);
        let is_small = body.len() <= MAX_INLINE_BYTES;
        let (document, held) = parse(body, &place, &self.memory).await?;
        let (names, faults) = self.read_names(&document, kind, kind.observed());
        // With the help of the model, more faults may be found; so those found without it wait.
        let Some(names) = names else { return Ok(faults) };
        let deadline = self.deadline(&names, caller.arrived);
        let place = place.waiting_until(deadline);
        let Named { learner, mapper, .. } = self.find(&names, faults, &place, deadline).await?;
        let n_observations = n_observations(&document);
        let is_quick = is_small && n_observations <= max_quick_observations(mapper.model());
        let memory = self.memory.clone();
        let job = move |_: &mut dyn Interrupt| {
            let (_held, model) = (held, mapper.model());
            let _demonstration_held = match take_for_demonstration(model, n_observations, &memory) {
                Ok(held) => held,
                Err(no_room) => return Ok(Err(ServiceError::from(no_room))),
            };
            let mut faults = names.own_faults;
            if let Some(object) = Place::root(&document).object(kind.fields(), &mut faults) {
                check(&object, model, learner.as_ref(), &mut faults);
            }
            Ok(Ok(faults))
        };
        if is_quick { self.pool.run_here(deadline, job)? } else { place.run(deadline, job).await? }
    }
}

/// The fault of a deadline that is further away than this service allows.
pub(super) fn check_deadline(deadline: Option<Duration>, max_deadline: Duration) -> Faults {
    if deadline.is_none_or(|deadline| deadline <= max_deadline) {
        return Faults::default();
    }
    let most = max_deadline.as_millis();
    let detail = format!("expected at most {most} ms, the limit of this service (ETUDE_MAX_DEADLINE)");
    Faults::one("/deadline_ms", detail)
}

/// Notes what is wrong with a request to follow a demonstration. `weights` are those that it starts from, or notes why there are none.
pub(super) fn check_request(
    object: &Object<'_, '_>,
    model: &Model,
    weights: impl FnOnce(&mut Faults) -> Option<Weights>,
    faults: &mut Faults,
) {
    let demonstration = Request::read_demonstration(model, object, faults);
    Request::of(demonstration, model, object, &Options::default(), weights, faults);
}

/// How many observations the demonstration of a request has; none if it is not an array, which is told without its faults.
pub(super) fn n_observations(request: &Value) -> usize {
    request.get("demonstration").and_then(Value::as_array).map_or(0, Vec::len)
}

/// Parses a body, by its `place` in the pool if it is large: without waiting for searches, as how long it may wait is written in it. What
/// it takes is held as well, unless that is little.
pub(super) async fn parse(
    body: Bytes,
    place: &Admission,
    memory: &Memory,
) -> Result<(Value, Option<Held>), ServiceError> {
    let n_bytes = body.len();
    let is_counted = n_bytes > MAX_UNCOUNTED_TEXT_BYTES;
    let held = is_counted.then(|| memory.try_take(document::parsed_bytes(&body) as u64)).transpose()?;
    let parse = move || document::parse(&body);
    let document = if n_bytes <= MAX_INLINE_BYTES { parse()? } else { place.run_reading(n_bytes, parse).await?? };
    Ok((document, held))
}

/// Whether a body is JSON, by its `place` in the pool if it is large. Nothing is kept of it.
async fn is_json(body: &Bytes, place: &Admission) -> Result<bool, PoolError> {
    let read = |body: &[u8]| serde_json::from_slice::<IgnoredAny>(body).is_ok();
    if body.len() <= MAX_INLINE_BYTES {
        return Ok(read(body));
    }
    let (n_bytes, body) = (body.len(), body.clone());
    place.run_reading(n_bytes, move || read(&body)).await
}

/// The weights from which a request starts: the means of its learner, or the model's own.
pub(super) fn base_weights(model: &Model, learner: Option<&LearnerState>, faults: &mut Faults) -> Option<Weights> {
    let schema = model.schema();
    let Some(LearnerState { learner, weights, .. }) = learner else { return Some(schema.weights()) };
    let learned = learner.weights_for(schema, &weights.distribution.mean);
    learned.map_err(|missing| faults.note_at(&Path::Member(&Path::Root, "learner"), missing.to_string())).ok()
}

#[cfg(test)]
mod tests;
