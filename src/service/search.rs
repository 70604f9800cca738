//! Searches: what they take, what they give, and how they are measured.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::Serialize;
use serde_json::Value;

use super::ServiceError;
use super::refined::RefinedRequest;
use crate::clock::Clock;
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::store::{NewPolicy, NewRefinement, PolicyClass, pack_steps};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Path};
use etude_core::interrupt::{Cancelled, Interrupt};
use etude_core::mapping::{Demonstration, Mapper, Mapping, Policy, Request, Stamp, Status, WrittenPolicy};
use etude_core::model::Model;

/// Bodies up to this size are parsed where they arrive, which takes less than a millisecond; larger ones in the pool. Likewise
/// for the states of an answer.
pub(super) const MAX_INLINE_BYTES: usize = 64 * 1024;

/// Largest search that runs where its request arrived: observations times states and transitions. One that looks at all of this
/// takes a millisecond, and most look at a tenth.
const MAX_INLINE_WORK: usize = 16_384;

/// Whether a request with a small body, whose options these are among others, is answered sooner than another thread would have taken it over. Of what may be in a
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
        memory.reserve(&mut held, Demonstration::bytes_of(model.schema(), n_observations))?;
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

/// What a search is handed.
#[derive(Clone, Copy)]
pub(super) struct Means<'e> {
    pub(super) clock: &'e Clock,
    pub(super) memory: &'e Memory,
    pub(super) extent: Extent,
}

/// What a search gave.
pub(super) struct Searched {
    /// The policy: JSON.
    pub(super) policy: String,
    /// `None` if it is not to be stored.
    pub(super) row: Option<PolicyText>,
    /// The weights of the distance, those that the request names among them.
    pub(super) weights: Weights,
    /// What is to be done about the policy, if it is local and to be stored.
    pub(super) refinement: Option<NewRefinement>,
    /// For all of this, if it is much.
    pub(super) held: Option<Held>,
}

/// A policy as it will be stored.
pub(super) struct PolicyText {
    id: String,
    class: PolicyClass,
    summary: String,
    steps: Vec<u8>,
}

impl PolicyText {
    /// That of the policy `written`, which has the id of `stamp` and this status.
    pub(super) fn of(stamp: Stamp, status: Status, written: WrittenPolicy<'_>) -> Result<Self, ServiceError> {
        let (summary, steps) = written.into_stored();
        let Stamp { id, model, learner, .. } = stamp;
        let class = PolicyClass { model, learner, status };
        Ok(Self { id: id.unwrap_or_default(), class, summary, steps: pack_steps(&steps)? })
    }

    pub(super) fn at(self, created_at: Timestamp) -> NewPolicy {
        let Self { id, class, summary, steps } = self;
        NewPolicy { id, class, summary, steps, created_at }
    }
}

/// Follows what `request` asks for with what that needs of the memory, and writes the policy, unless that is too large. `observed` is the text
/// of the demonstration, which is at `path` in what the client sent. A policy without an id is not to be stored, nor refined.
pub(super) fn follow(
    mapper: &Arc<Mapper>,
    mut request: Request<'_>,
    (observed, path): (&str, &Path<'_>),
    stamp: Stamp,
    Means { clock, memory, extent }: Means<'_>,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Searched, ServiceError>, Cancelled> {
    /// As it will be answered, and as it will be stored.
    const N_COPIES: usize = 2;
    let started = clock.instant();
    let is_counted = extent == Extent::Any;
    let searching = is_counted.then(|| take_for_search(mapper, &mut request, memory));
    let mapping = request.solve(mapper, interrupt)?;
    drop(searching);
    let stamp = Stamp {
        lookahead: request.lookahead.map(NonZeroU32::get),
        elapsed_us: as_micros(clock.elapsed(started)),
        warnings: request.problem.warnings(path),
        ..stamp
    };
    report(&stamp, &mapping);
    if let Err(error) = Policy::check_steps(mapper.model(), &mapping) {
        let mut faults = Faults::default();
        faults.note_at(path, error.to_string());
        return Ok(Err(faults.into()));
    }
    let n_bytes = N_COPIES * Policy::steps_bytes(mapper.model(), &mapping);
    let is_refined = mapping.status == Status::Local && stamp.id.is_some();
    let n_refined_bytes = if is_refined { RefinedRequest::most_bytes(mapper.model(), observed) } else { 0 };
    let mut held = None;
    if let Err(no_room) = memory.reserve(&mut held, n_bytes + n_refined_bytes) {
        return Ok(Err(no_room.into()));
    }
    if is_counted && memory.free_for_large() < memory.room() / 4 {
        mapper.release();
    }
    let refinement = is_refined.then(|| {
        let refined = RefinedRequest::of(&stamp.model, &request.problem, mapping.cost);
        refined.observing_text(observed)?.waiting(&stamp, None)
    });
    let written = refinement.transpose().and_then(|refinement| {
        let written = WrittenPolicy::new(&stamp, &request.problem, &mapping)?;
        let policy = written.answer(None)?;
        let row = stamp.id.is_some().then(|| PolicyText::of(stamp, mapping.status, written)).transpose()?;
        // What was estimated may have been too little.
        memory.reserve(&mut held, N_COPIES * policy.len() + n_refined_bytes)?;
        let weights = request.problem.weights().clone();
        Ok(Searched { policy, row, weights, refinement, held })
    });
    Ok(written)
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

/// A duration in microseconds.
pub(super) fn as_micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

pub(super) fn write(document: &impl Serialize) -> Result<String, ServiceError> {
    serde_json::to_string(document).map_err(ServiceError::Write)
}
