//! Policies: searched, stored, read.

use std::io;
use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};
use serde_json::Value;
use serde_json::value::RawValue;
use uuid::Uuid;

use super::learners::Ready;
use super::outline::Outline;
use super::{Admission, Caller, Etude, ServiceError};
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::store::{NewPolicy, NewRefinement, Page, PolicySummaryRow, StoreError, pack_steps};
use etude_core::attribute::Weights;
use etude_core::document::{self, Faults, Path, Place};
use etude_core::interrupt::{Cancelled, Interrupt, time_until_finish};
use etude_core::mapping::{Demonstration, Mapper, Mapping, Policy, Problem, Request, Stamp, Status, WrittenPolicy};
use etude_core::model::Model;

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
    /// For the policy, and as much again while it is written into an answer, if it is much.
    pub held: Option<Held>,
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
        let Searched { policy, row, refinement, held } = searched;
        let is_refined = refinement.is_some();
        self.store.add_policies(vec![row.at(caller.now)], refinement.into_iter().collect()).await?;
        if is_refined {
            self.refiner.wake();
        }
        Ok(MadePolicy { id, policy, held })
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
            let document = (&document, &DEMONSTRATION);
            let searched = follow(mapper, request, document, stamp, &self.memory, Extent::Quick, interrupt)?;
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

    /// The policy with this id (JSON), and the memory that it takes, if that is much.
    ///
    /// # Errors
    ///
    /// If there is none, or no memory for it.
    pub async fn policy(&self, id: &str) -> Result<(String, Option<Held>), ServiceError> {
        let unknown = || ServiceError::Unknown { kind: "policy", name: id.to_owned(), pointer: None };
        self.store.policy_within(id, &self.memory).await?.ok_or_else(unknown)
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

/// Bodies up to this size take little once they are parsed, whatever is in them: some 300 KiB.
const MAX_UNCOUNTED_BODY_BYTES: usize = 4096;

/// Parses a body, by its `place` in the pool if it is large: without waiting for searches, as how long it may wait is written in it. What
/// it takes is held as well, unless that is little.
pub(super) async fn parse(
    body: impl AsRef<[u8]> + Send + 'static,
    place: &Admission,
    memory: &Memory,
) -> Result<(Value, Option<Held>), ServiceError> {
    let n_bytes = body.as_ref().len();
    let is_counted = n_bytes > MAX_UNCOUNTED_BODY_BYTES;
    let held = is_counted.then(|| memory.try_take(document::parsed_bytes(body.as_ref()) as u64)).transpose()?;
    let parse = move || document::parse(body.as_ref());
    let document = if n_bytes <= MAX_INLINE_BYTES { parse()? } else { place.run_reading(n_bytes, parse).await?? };
    Ok((document, held))
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

/// Most observations of a request that is quick, whose answer has a state for each of them. They take as little memory.
pub(super) fn max_quick_observations(model: &Model) -> usize {
    MAX_INLINE_BYTES / model.state_bytes().max(Demonstration::bytes_of(model.schema(), 1)).max(1)
}

/// Takes what `n_observations` need once they are read, if that is much and they may be so many.
pub(super) fn take_for_demonstration(
    model: &Model,
    n_observations: usize,
    memory: &Memory,
) -> Result<Option<Held>, NoRoom> {
    let mut held = None;
    if n_observations <= Policy::max_observations(model).min(Demonstration::MAX_OBSERVATIONS) {
        memory.hold(&mut held, Demonstration::bytes_of(model.schema(), n_observations))?;
    }
    Ok(held)
}

/// How much of a search there is to be counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extent {
    /// Nothing but a large policy, as [`is_quick`].
    Quick,
    /// Anything.
    Any,
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
    let steps = pack_steps(&steps)?;
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
    let n_observations = document["demonstration"].as_array().map_or(0, Vec::len);
    let _demonstration_held = match take_for_demonstration(mapper.model(), n_observations, memory) {
        Ok(held) => held,
        Err(no_room) => return Ok(Err(no_room.into())),
    };
    match read_request(mapper.model(), document, fields, faults, base) {
        Ok(request) => follow(mapper, request, (document, &DEMONSTRATION), stamp, memory, Extent::Any, interrupt),
        Err(faults) => Ok(Err(faults.into())),
    }
}

/// Searches with what it needs of `memory`, and writes the policy, unless that is too large. The request was read from the document, its demonstration from the place there that a fault would name.
pub(super) fn follow(
    mapper: &Arc<Mapper>,
    mut request: Request<'_>,
    (document, place): (&Value, &Path<'_>),
    stamp: Stamp,
    memory: &Memory,
    extent: Extent,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Searched, ServiceError>, Cancelled> {
    /// As it will be answered, and as it will be stored.
    const N_COPIES: usize = 2;
    let started = Instant::now();
    let is_counted = extent == Extent::Any;
    let searching = is_counted.then(|| take_for_search(mapper, &mut request, memory));
    let mapping = request.solve(mapper, interrupt)?;
    drop(searching);
    let stamp = Stamp { lookahead: request.lookahead.map(NonZeroU32::get), elapsed_us: as_micros(started), ..stamp };
    report(&stamp, &mapping);
    if let Err(error) = Policy::check_steps(mapper.model(), &mapping) {
        let mut faults = Faults::default();
        faults.note_at(place, error.to_string());
        return Ok(Err(faults.into()));
    }
    let n_bytes = N_COPIES * Policy::steps_bytes(mapper.model(), &mapping);
    let mut held = None;
    if let Err(no_room) = memory.hold(&mut held, n_bytes) {
        return Ok(Err(no_room.into()));
    }
    if is_counted && memory.free_for_large() < memory.room() / 4 {
        mapper.release();
    }
    let refinement = (mapping.status == Status::Local).then(|| {
        let mut text = CountedText { text: Vec::new(), memory, held: &mut held, n_others: n_bytes, refused: None };
        let written = serde_json::to_writer(&mut text, &RefinedRequest { document, request: &request });
        let text = text.end(written)?;
        Ok::<_, ServiceError>(NewRefinement {
            policy_id: stamp.id.clone().unwrap_or_default(),
            model_hash: stamp.model_hash.clone(),
            session_id: None,
            request: text,
        })
    });
    let written = refinement.transpose().and_then(|refinement| {
        let (policy, row) = write_policy(stamp, &request.problem, &mapping)?;
        // What was estimated may have been too little.
        let n_bytes = N_COPIES * policy.len() + refinement.as_ref().map_or(0, |refinement| refinement.request.len());
        memory.hold(&mut held, n_bytes)?;
        Ok(Searched { policy, row, refinement, held })
    });
    Ok(written)
}

/// The request for the policy that refines the one of `request`, which was read from `document`.
struct RefinedRequest<'r> {
    document: &'r Value,
    request: &'r Request<'r>,
}

impl Serialize for RefinedRequest<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        /// The optimum does not depend on how it is searched for, and nobody waits for it. The weights are those that were used, wherever
        /// they came from.
        const LEFT_OUT: [&str; 6] = ["learner", "lookahead", "heuristic", "max_expansions", "deadline_ms", "weights"];
        let mut members = serializer.serialize_map(None)?;
        let sent = self.document.as_object().into_iter().flatten();
        for (name, value) in sent.filter(|(name, _)| !LEFT_OUT.contains(&name.as_str())) {
            members.serialize_entry(name, value)?;
        }
        members.serialize_entry("weights", &self.request.problem.named_weights())?;
        members.end()
    }
}

/// Text that is written, for which memory is taken as it grows.
struct CountedText<'m> {
    text: Vec<u8>,
    memory: &'m Memory,
    held: &'m mut Option<Held>,
    /// What is held for something else.
    n_others: usize,
    refused: Option<NoRoom>,
}

impl CountedText<'_> {
    /// The text, if it was `written`.
    fn end(self, written: serde_json::Result<()>) -> Result<String, ServiceError> {
        if let Some(no_room) = self.refused {
            return Err(no_room.into());
        }
        let text = written.and_then(|()| String::from_utf8(self.text).map_err(serde::ser::Error::custom));
        text.map_err(ServiceError::Write)
    }
}

impl io::Write for CountedText<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        /// As it is copied to where it has room, twice as much.
        const COPIES: usize = 3;
        let n_bytes = self.text.len() + bytes.len();
        if n_bytes > self.text.capacity()
            && let Err(no_room) = self.memory.hold(self.held, self.n_others + COPIES * n_bytes)
        {
            self.refused = Some(no_room);
            return Err(io::ErrorKind::OutOfMemory.into());
        }
        self.text.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Takes the memory that a search may need beyond [`SMALL_BYTES`], which every search has: no more of them are under way than there is
/// memory for that beside the budget. Lets the search use no more. Of what is left it takes a quarter at most, so that others find something
/// too.
pub(super) fn take_for_search(mapper: &Mapper, request: &mut Request<'_>, memory: &Memory) -> Option<Held> {
    let wanted = request.search_bytes(mapper) as u64;
    let held = take_beyond_small(wanted, memory);
    let n_bytes = SMALL_BYTES + held.as_ref().map_or(0, Held::n_bytes);
    request.settings.budget.max_bytes = usize::try_from(n_bytes).unwrap_or(usize::MAX);
    held
}

/// Of `wanted` bytes, takes those beyond [`SMALL_BYTES`], or a quarter of what is left if that is less.
pub(super) fn take_beyond_small(wanted: u64, memory: &Memory) -> Option<Held> {
    let n_bytes = wanted.saturating_sub(SMALL_BYTES).min(memory.free_for_large() / 4);
    // Nothing if others have just taken it.
    memory.try_take_as_large(n_bytes).ok()
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

#[cfg(test)]
mod tests {
    use serde_json::json;
    use tokio_util::sync::CancellationToken;
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::service::{Client, ModelText, Name, PoolSettings, Settings};
    use etude_core::interrupt::Uninterrupted;
    use etude_core::model::{Definition, Format, Limits};

    fn caller() -> Caller {
        Caller { client: Client::LOCAL, arrived: Instant::now(), now: Timestamp::UNIX_EPOCH }
    }

    /// A service that has `model`, called `m`.
    async fn etude(directory: &std::path::Path, model: &Value) -> Etude {
        let settings = Settings::of_test(directory);
        let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
        let text = ModelText::Whole(model.to_string().into_bytes());
        etude.put_model(&Name::new("m").unwrap(), text, Format::Json, caller()).await.unwrap();
        etude
    }

    /// A line of so many states, to whose end leads a policy of as many steps.
    fn line(n_states: usize) -> Value {
        let states: Vec<_> = (0..n_states).map(|state| json!([u8::from(state + 1 == n_states)])).collect();
        let transitions: Vec<_> = (1..n_states).map(|state| json!([state - 1, "on", state])).collect();
        json!({
            "attributes": [{"name": "end", "kind": "number", "weight": 1e9}], "actions": [{"name": "on", "cost": 0.3}],
            "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions},
        })
    }

    #[tokio::test]
    async fn a_policy_that_cannot_be_answered_is_not_stored() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path(), &line(1000)).await;
        let body = json!({"model": "m", "demonstration": [{}, {"end": 1}]}).to_string();
        let large = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
        let small: Vec<_> = std::iter::from_fn(|| etude.memory.try_take(SMALL_BYTES).ok()).collect();
        let refused = etude.make_policy(body.clone().into_bytes(), caller()).await;
        assert!(matches!(refused, Err(ServiceError::NoRoom(_))), "{refused:?}");
        assert_eq!(etude.policies(0, 10).await.unwrap().items.len(), 0);
        drop((large, small));
        let free = etude.memory.free();
        let made = etude.make_policy(body.into_bytes(), caller()).await.unwrap();
        assert!(made.policy.len() > 64 << 10 && free - etude.memory.free() >= made.policy.len() as u64);
        drop(made);
        assert_eq!(etude.memory.free(), free);
    }

    #[tokio::test]
    async fn a_small_body_that_becomes_much_is_counted() {
        let pool = crate::service::SearchPool::new(
            PoolSettings { n_threads: 1, max_waiting: 1, max_long: 1 },
            crate::clock::Clock::system(),
            TaskTracker::new(),
            CancellationToken::new(),
        );
        let (place, memory) = (pool.admit_when_needed(Client::LOCAL), Memory::with_room(1 << 30));
        let (_, held) = parse(
            vec![b' '; MAX_UNCOUNTED_BODY_BYTES - 4].into_iter().chain(*b"null").collect::<Vec<_>>(),
            &place,
            &memory,
        )
        .await
        .unwrap();
        assert!(held.is_none());
        let body = format!("[{}]", vec![r#"{"":0}"#; 5000].join(","));
        let (_, held) = parse(body.clone(), &place, &memory).await.unwrap();
        assert!(body.len() < MAX_INLINE_BYTES && held.unwrap().n_bytes() > 5000 * 600);
        assert!(parse(body, &place, &Memory::with_room(1 << 20)).await.is_err());
    }

    #[test]
    fn what_is_to_be_refined_is_counted() {
        let model = json!({
            "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
            "actions": [{"name": "on"}, {"name": "back"}],
            "dynamics": {
                "kind": "table", "states": (0..9).map(|x| json!([x, "open"])).collect::<Vec<_>>(),
                "transitions": (1..9).flat_map(|x| [json!([x - 1, "on", x]), json!([x, "back", x - 1])]).collect::<Vec<_>>(),
            },
        });
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap());
        let document = json!({
            "model": "m", "demonstration": (0..100).map(|n| json!({"x": n % 4 * 2, "door": "x".repeat(1000)})).collect::<Vec<_>>(), "lookahead": 1, "deadline_ms": 1000,
        });
        let search = |memory: &Memory| {
            let (fields, stamp) = ((&document, &Request::FIELDS[..], Faults::default()), Stamp::default());
            let base = |_: &mut Faults| Some(mapper.model().schema().weights());
            search(&mapper, fields, base, stamp, memory, &mut Uninterrupted).unwrap()
        };
        let searched = search(&Memory::with_room(1 << 30)).unwrap();
        let request = searched.refinement.unwrap().request;
        assert!(searched.policy.len() < 64 << 10 && searched.held.unwrap().n_bytes() > 100_000);
        let written: Value = serde_json::from_str(&request).unwrap();
        let expected =
            json!({"model": "m", "demonstration": document["demonstration"], "weights": {"x": 1.0, "door": 1.0}});
        assert_eq!(written, expected);
    }
}
