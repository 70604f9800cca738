//! Policies: searched, stored, read.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;
use serde_json::value::RawValue;
use uuid::Uuid;

use super::learners::Ready;
use super::outline::Outline;
use super::{Admission, Caller, Etude, ServiceError};
use crate::attribute::Weights;
use crate::document::{self, Faults, Path, Place};
use crate::interrupt::{Cancelled, Interrupt, time_until_finish};
use crate::mapping::{Mapper, Mapping, Policy, Problem, Request, Stamp, Status, WrittenPolicy};
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::model::Model;
use crate::store::{NewPolicy, NewRefinement, Page, PolicySummaryRow, StoreError};

/// Bodies up to this size are parsed where they arrive, which takes less than a millisecond; larger ones in the pool. Likewise
/// for the states of an answer.
pub(super) const MAX_INLINE_BYTES: usize = 64 * 1024;

/// A policy that was just made and stored.
#[derive(Debug)]
pub struct MadePolicy {
    /// Its id.
    pub id: String,
    /// The policy: JSON.
    pub policy: String,
}

impl Etude {
    /// Makes a policy for the request in `body` (JSON), and stores it.
    ///
    /// # Errors
    ///
    /// If the body is no request, names no model, or the service cannot do it now.
    pub async fn make_policy(
        &self,
        body: impl AsRef<[u8]> + Send + 'static,
        caller: Caller,
    ) -> Result<MadePolicy, ServiceError> {
        let id = Uuid::now_v7().to_string();
        let quick = if body.as_ref().len() <= MAX_INLINE_BYTES {
            self.search_quickly(body.as_ref(), &id, caller.arrived).await?
        } else {
            None
        };
        let searched = match quick {
            Some(searched) => {
                // The next request can be read to where this one stands, while the disk writes.
                drop(body);
                searched
            }
            None => self.search_at_length(body, &id, caller).await?,
        };
        let Searched { policy, row, refinement, held: _held } = searched;
        let is_refined = refinement.is_some();
        self.store.add_policies(vec![row.at(caller.now)], refinement.into_iter().collect()).await?;
        if is_refined {
            self.refiner.wake();
        }
        Ok(MadePolicy { id, policy })
    }

    /// Searches for the policy of a request that is well-formed in all its parts, and for which [`is_quick`]. Nothing for others, of
    /// which it takes a closer look to tell what is wrong.
    async fn search_quickly(&self, body: &[u8], id: &str, arrived: Instant) -> Result<Option<Searched>, ServiceError> {
        let at_hand = |model: &str| self.mapper_at_hand(model).map(|(_, mapper)| mapper);
        let Some(outline) = Outline::read(body, &at_hand) else { return Ok(None) };
        let (Some(envelope), faults) = self.read_envelope(&outline.document, &Request::FIELDS, "demonstration") else {
            return Ok(None);
        };
        let is_faultless = faults.is_empty() && envelope.over_limits.is_empty();
        let Some((model_hash, mapper)) = self.mapper_at_hand(&envelope.model).filter(|_| is_faultless) else {
            return Ok(None);
        };
        let learner = match &envelope.learner {
            None => None,
            Some(learner) => match self.ready(learner, None).await {
                Ok(ready) => Some(ready),
                Err(_) => return Ok(None),
            },
        };
        let named = Named { learner, model_hash, mapper };
        let deadline = self.deadline(&envelope, arrived);
        let model = named.mapper.model();
        let read = outline.of(&named.mapper);
        let read = read.filter(|(document, demonstration)| is_quick(model, document, demonstration.len()));
        let Some((document, demonstration)) = read else { return Ok(None) };
        let stamp = envelope.stamp(id, &named);
        let Named { learner, mapper, .. } = &named;
        let job = |interrupt: &mut dyn Interrupt| {
            let mut faults = Faults::default();
            let object = Place::root(&document).object(&Request::FIELDS, &mut faults);
            let request = object.and_then(|object| {
                let base = |faults: &mut Faults| base_weights(model, learner.as_ref(), faults);
                Request::read_beside(Some(demonstration), model, &object, base, &mut faults)
            });
            let Ok(request) = faults.check(request) else { return Ok(Ok(None)) };
            let searched = follow(mapper, request, (&document, &DEMONSTRATION), stamp, None, interrupt)?;
            Ok(searched.map(Some))
        };
        self.pool.run_here(deadline, job)?
    }

    /// Searches for the policy of any request, and tells what is wrong with it.
    async fn search_at_length(
        &self,
        body: impl AsRef<[u8]> + Send + 'static,
        id: &str,
        caller: Caller,
    ) -> Result<Searched, ServiceError> {
        let place = self.pool.admit_when_needed(caller.client);
        let is_small = body.as_ref().len() <= MAX_INLINE_BYTES;
        let (document, held) = parse(body, &place, &self.memory).await?;
        let (envelope, faults) = self.read_envelope(&document, &Request::FIELDS, "demonstration");
        // With the help of the model, more faults may be found; so those found without it wait.
        let Some(envelope) = envelope else { return Err(faults.into()) };
        let deadline = self.deadline(&envelope, caller.arrived);
        let place = place.with_patience(deadline);
        let named = self.find(&envelope, faults, &place, deadline).await?;
        let stamp = envelope.stamp(id, &named);
        let Named { learner, mapper, .. } = named;
        let memory = self.memory.clone();
        let n_observations = document["demonstration"].as_array().map_or(0, Vec::len);
        let is_quick = is_small && is_quick(mapper.model(), &document, n_observations);
        let job = move |interrupt: &mut dyn Interrupt| {
            let _held = held;
            let base = |faults: &mut Faults| base_weights(mapper.model(), learner.as_ref(), faults);
            search(&mapper, (&document, &Request::FIELDS, envelope.over_limits), base, stamp, &memory, interrupt)
        };
        if is_quick { self.pool.run_here(deadline, job)? } else { place.run(deadline, job).await? }
    }

    /// Reads the envelope of a request, whose deadline must be within the limit.
    pub(super) fn read_envelope(&self, document: &Value, fields: &[&str], about: &str) -> (Option<Envelope>, Faults) {
        let (mut envelope, faults) = Envelope::read(document, fields, about);
        let max_deadline = self.time_limits.max_deadline;
        if let Some(envelope) = &mut envelope
            && envelope.deadline.is_some_and(|deadline| deadline > max_deadline)
        {
            let most = max_deadline.as_millis();
            let detail = format!("expected at most {most} ms, the limit of this service (ETUDE_MAX_DEADLINE)");
            envelope.over_limits = Faults::one("/deadline_ms", detail);
        }
        (envelope, faults)
    }

    /// When the search for a request that came at `arrived` is to finish.
    pub(super) fn deadline(&self, envelope: &Envelope, arrived: Instant) -> Option<Instant> {
        let deadline = envelope.deadline.unwrap_or(self.time_limits.default_deadline);
        arrived.checked_add(time_until_finish(deadline))
    }

    /// Finds what the request names. `faults` are those found so far; what is unknown is one more, if there are any others.
    pub(super) async fn find(
        &self,
        envelope: &Envelope,
        mut faults: Faults,
        place: &Admission,
        deadline: Option<Instant>,
    ) -> Result<Named, ServiceError> {
        let learner = match &envelope.learner {
            Some(learner) => self.ready(learner, Some("/learner")).await.map(Some),
            None => Ok(None),
        };
        let mapper = self.known_mapper(&envelope.model, "/model", place, deadline).await;
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

    /// The policy with this id: JSON.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn policy(&self, id: &str) -> Result<String, ServiceError> {
        let unknown = || ServiceError::Unknown { kind: "policy", name: id.to_owned(), pointer: None };
        self.store.policy(id).await?.ok_or_else(unknown)
    }

    /// At most `limit` policies without their steps (JSON), in the order in which they were stored, from the first after
    /// the sequence number `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn policies(&self, after: i64, limit: u32) -> Result<Page<Box<RawValue>>, ServiceError> {
        let page = self.store.policies(after, limit).await?;
        let read = |row: PolicySummaryRow| {
            RawValue::from_string(row.summary)
                .map_err(|error| StoreError::corrupt("policies", "summary", row.id, error))
        };
        Ok(page.try_map(|row| &row.id, read)?)
    }
}

/// Parses a body, by its `place` in the pool if it is large: without waiting for searches, as how long it may wait is written in it. What
/// a large one takes is held as well.
pub(super) async fn parse(
    body: impl AsRef<[u8]> + Send + 'static,
    place: &Admission,
    memory: &Memory,
) -> Result<(Value, Option<Held>), ServiceError> {
    if body.as_ref().len() <= MAX_INLINE_BYTES {
        return Ok((document::parse(body.as_ref())?, None));
    }
    let held = memory.try_take(document::parsed_bytes(body.as_ref()) as u64)?;
    let document = place.run_reading(body.as_ref().len(), move || document::parse(body.as_ref())).await??;
    Ok((document, Some(held)))
}

/// What must be known of a request before its model is at hand.
pub(super) struct Envelope {
    pub(super) model: String,
    pub(super) learner: Option<String>,
    pub(super) deadline: Option<Duration>,
    /// What is wrong with the request that only the service's settings tell.
    pub(super) over_limits: Faults,
}

/// What a request names.
pub(super) struct Named {
    pub(super) learner: Option<Ready>,
    pub(super) model_hash: String,
    pub(super) mapper: Arc<Mapper>,
}

impl Envelope {
    /// Reads what can be read without the model of a request that may have these `fields` and must have what it is about, and
    /// gives the names if they could be read. Faults may have been found either way.
    pub(super) fn read(document: &Value, fields: &[&str], about: &str) -> (Option<Self>, Faults) {
        let mut faults = Faults::default();
        let root = Place::root(document);
        let Some(object) = root.object(fields, &mut faults) else { return (None, faults) };
        let model = object.required("model", &mut faults).and_then(|place| place.string(&mut faults));
        let learner = object.optional("learner").filter(|_| fields.contains(&"learner"));
        let learner = learner.map(|place| place.string(&mut faults));
        object.required(about, &mut faults);
        let options = Request::read_options(&object, &mut faults);
        let names = model.zip(learner.map_or(Some(None), |learner| learner.map(Some)));
        let envelope = names.map(|(model, learner)| Self {
            model: model.to_owned(),
            learner: learner.map(str::to_owned),
            deadline: options.and_then(|options| options.deadline),
            over_limits: Faults::default(),
        });
        (envelope, faults)
    }

    /// What the policy `id` is stamped with.
    fn stamp(&self, id: &str, named: &Named) -> Stamp {
        Stamp {
            id: Some(id.to_owned()),
            model: self.model.clone(),
            model_hash: named.model_hash.clone(),
            learner: named.learner.as_ref().map(|ready| ready.name.clone()),
            weights_version: named.learner.as_ref().map(|ready| ready.weights.version),
            ..Stamp::default()
        }
    }
}

/// Largest search that runs where its request arrived: observations times states and transitions. One that looks at all of this
/// takes a millisecond, and most look at a tenth.
const MAX_INLINE_WORK: usize = 16_384;

/// Whether a request with a small body is answered sooner than another thread would have taken it over. Of what may be in a
/// request, a finite lookahead and the paper's heuristic can take far longer than the size of the problem tells; of a world that is
/// searched lazily, nobody knows the size.
pub(super) fn is_quick(model: &Model, document: &Value, n_observations: usize) -> bool {
    let size = model.graph().n_states() + model.graph().n_transitions();
    !model.is_lazy()
        && document["lookahead"].is_null()
        && document["heuristic"] != "paper"
        && n_observations.saturating_mul(size) <= MAX_INLINE_WORK
        && n_observations <= max_quick_observations(model)
}

/// Most observations of a request that is quick, whose answer has a state for each of them.
pub(super) fn max_quick_observations(model: &Model) -> usize {
    MAX_INLINE_BYTES / model.state_bytes().max(1)
}

/// Where a request's demonstration is.
const DEMONSTRATION: Path<'static> = Path::Member(&Path::Root, "demonstration");

/// What a search gave.
pub(super) struct Searched {
    /// The policy: JSON.
    pub(super) policy: String,
    pub(super) row: PolicyText,
    /// What is to be done about the policy, if it is local.
    pub(super) refinement: Option<NewRefinement>,
    /// For all of this, if it is much.
    pub(super) held: Option<Held>,
}

/// A policy as it will be stored.
pub(super) struct PolicyText {
    id: String,
    summary: String,
    steps: Vec<u8>,
}

impl PolicyText {
    pub(super) fn at(self, created_at: Timestamp) -> NewPolicy {
        let Self { id, summary, steps } = self;
        NewPolicy { id, summary, steps, created_at }
    }
}

/// Writes the policy of `mapping`, which has an id: as it will be answered, and as it will be stored.
pub(super) fn write_policy(
    stamp: Stamp,
    problem: &Problem<'_>,
    mapping: &Mapping,
) -> Result<(String, PolicyText), ServiceError> {
    let written = WrittenPolicy::new(&stamp, problem, mapping)?;
    let WrittenPolicy { answer, summary, steps } = written;
    Ok((answer, PolicyText { id: stamp.id.unwrap_or_default(), summary, steps }))
}

/// Reads the request against its model, given its fields and the faults that were found before, with weights from `base` where it names none, searches, and writes the policy.
pub(super) fn search(
    mapper: &Arc<Mapper>,
    (document, fields, faults): (&Value, &[&str], Faults),
    base: impl FnOnce(&mut Faults) -> Option<Weights>,
    stamp: Stamp,
    memory: &Memory,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Searched, ServiceError>, Cancelled> {
    match read_request(mapper.model(), document, fields, faults, base) {
        Ok(request) => follow(mapper, request, (document, &DEMONSTRATION), stamp, Some(memory), interrupt),
        Err(faults) => Ok(Err(faults.into())),
    }
}

/// Searches with what it needs of `memory` (nothing is counted for a search that is quick), and writes the policy, unless that is too
/// large. The request was read from the document, its demonstration from the place there that a fault would name.
pub(super) fn follow(
    mapper: &Arc<Mapper>,
    mut request: Request<'_>,
    (document, place): (&Value, &Path<'_>),
    stamp: Stamp,
    memory: Option<&Memory>,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Searched, ServiceError>, Cancelled> {
    let started = Instant::now();
    let searching = match memory.map(|memory| take_for_search(mapper, &mut request, memory)).transpose() {
        Ok(held) => held,
        Err(no_room) => return Ok(Err(no_room.into())),
    };
    let mapping = request.solve(mapper, interrupt)?;
    drop(searching);
    let stamp = Stamp { lookahead: request.lookahead.map(NonZeroU32::get), elapsed_us: as_micros(started), ..stamp };
    report(&stamp, &mapping);
    if let Err(error) = Policy::check_steps(mapper.model(), &mapping) {
        let mut faults = Faults::default();
        faults.note_at(place, error.to_string());
        return Ok(Err(faults.into()));
    }
    // As it will be answered, and as it will be stored.
    let n_bytes = 2 * Policy::steps_bytes(mapper.model(), &mapping);
    let held =
        match memory.filter(|_| n_bytes > MAX_INLINE_BYTES).map(|memory| memory.try_take(n_bytes as u64)).transpose() {
            Ok(held) => held,
            Err(no_room) => return Ok(Err(no_room.into())),
        };
    if memory.is_some_and(|memory| memory.free_for_large() < memory.room() / 4) {
        mapper.release();
    }
    let refinement = (mapping.status == Status::Local).then(|| {
        let mut request_for_refined = document.clone();
        // The weights that are used, wherever they came from.
        request_for_refined["weights"] = serde_json::json!(request.problem.named_weights());
        // The optimum does not depend on how it is searched for, and nobody waits for it.
        for name in ["learner", "lookahead", "heuristic", "max_expansions", "deadline_ms"] {
            request_for_refined[name] = Value::Null;
        }
        NewRefinement {
            policy_id: stamp.id.clone().unwrap_or_default(),
            model_hash: stamp.model_hash.clone(),
            request: request_for_refined.to_string(),
        }
    });
    let written = write_policy(stamp, &request.problem, &mapping);
    Ok(written.map(|(policy, row)| Searched { policy, row, refinement, held }))
}

/// Takes the memory that a search may need, and lets the search use no more than that: a quarter of what is left at most, so that others
/// find something too.
///
/// # Errors
///
/// [`NoRoom`] if hardly anything is left.
pub(super) fn take_for_search(mapper: &Mapper, request: &mut Request<'_>, memory: &Memory) -> Result<Held, NoRoom> {
    let wanted = request.search_bytes(mapper) as u64;
    // With less than what is small, a search would hardly begin. No more of them run than that leaves room for other small requests.
    let held = memory.try_take(wanted.min((memory.free_for_large() / 4).max(SMALL_BYTES)))?;
    request.settings.budget.max_bytes = usize::try_from(held.n_bytes()).unwrap_or(usize::MAX);
    Ok(held)
}

/// The weights from which a request starts: the means of its learner, or the model's own.
pub(super) fn base_weights(model: &Model, learner: Option<&Ready>, faults: &mut Faults) -> Option<Weights> {
    let schema = model.schema();
    let Some(Ready { learner, weights, .. }) = learner else { return Some(schema.weights()) };
    let learned = learner.weights_for(schema, &weights.distribution.mean);
    learned.map_err(|missing| faults.note_at(&Path::Member(&Path::Root, "learner"), missing.to_string())).ok()
}

/// Reads a request that may have these `fields` against its model, with weights from `base` where it names none.
fn read_request<'m>(
    model: &'m Model,
    document: &Value,
    fields: &[&str],
    mut faults: Faults,
    base: impl FnOnce(&mut Faults) -> Option<Weights>,
) -> Result<Request<'m>, Faults> {
    let root = Place::root(document);
    let object = root.object(fields, &mut faults);
    let request = object.and_then(|object| Request::read_over(model, &object, base, &mut faults));
    faults.check(request)
}

/// Reads a request that names all weights.
pub(super) fn read_weighted_request<'m>(model: &'m Model, document: &Value) -> Result<Request<'m>, Faults> {
    read_request(model, document, &Request::FIELDS, Faults::default(), |_| Some(model.schema().weights()))
}

/// Measures and logs what a search gave: in detail, as the policy says as much, and each request has a line of its own.
pub(super) fn report(stamp: &Stamp, mapping: &Mapping) {
    metrics::counter!("etude_searches_total", "status" => mapping.status.name()).increment(1);
    #[expect(clippy::cast_precision_loss, reason = "searches take less than centuries")]
    metrics::histogram!("etude_search_duration_seconds").record(stamp.elapsed_us as f64 / 1e6);
    tracing::debug!(
        model = stamp.model,
        status = mapping.status.name(),
        cost = mapping.cost.total,
        expanded = mapping.n_expanded,
        elapsed_us = stamp.elapsed_us,
        "searched"
    );
}

pub(super) fn as_micros(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_micros()).unwrap_or(u64::MAX)
}

pub(super) fn write(document: &impl Serialize) -> Result<String, ServiceError> {
    serde_json::to_string(document).map_err(ServiceError::Write)
}
