//! Refinement: policies that a finite lookahead decided are followed, in the background, by the global optimum.
//!
//! What waits is in the store, so that a restart forgets nothing. One policy is refined at a time, where there is a thread to spare:
//!
//! ```text
//! next --search--> optimal: stored, linked
//!  ^         |---> budget spent, model gone, cannot be read: given up, logged
//!  +--pause--+---> somebody needs the thread, database locked: later, after the others; every pause is longer than the last
//! ```
//!
//! Each attempt is counted before it begins, durably, and one that ends is taken back or the last: so what ends the process is given up
//! after some times. A search that made way begins anew. So while all threads are needed all the time, policies stay what they are.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::refined::RefinedRequest;
use super::requests::{DEMONSTRATION, most_demonstration_bytes};
use super::search::{PolicyText, as_micros, report, take_for_search};
use super::{Etude, Kind, PoolError, ServiceError};
use crate::clock::Clock;
use crate::memory::Memory;
use crate::store::{Attempt, MAX_ATTEMPTS, NewRefinement, RefinementEnd, StoreError, StoredObservations};
use etude_core::attribute::Weights;
use etude_core::interrupt::{Cancelled, Interrupt, Signal};
use etude_core::mapping::{Demonstration, Mapper, Policy, Problem, Request, Settings, Stamp, Status, WrittenPolicy};

/// The first pause after a refinement that did not come to its end.
const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// The longest one.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

/// The way to wake the refiner.
#[derive(Debug, Default)]
pub(super) struct Refiner {
    work: Notify,
}

impl Refiner {
    /// Says that there is something to refine.
    pub(super) fn wake(&self) {
        self.work.notify_one();
    }
}

/// What became of a refinement.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    /// It is over, one way or the other.
    Ended,
    /// It is to be taken up again.
    Later,
}

impl Etude {
    /// Refines whatever waits to be refined, until `stopping` is cancelled.
    pub async fn refine_until(self: Arc<Self>, stopping: CancellationToken) {
        let mut after = 0;
        let mut pause = FIRST_PAUSE;
        while !stopping.is_cancelled() {
            match self.refine_next(&mut after, &stopping).await {
                Ok(Some(Outcome::Ended)) => {
                    pause = FIRST_PAUSE;
                    continue;
                }
                Ok(None) => {
                    tokio::select! {
                        () = self.refiner.work.notified() => continue,
                        () = stopping.cancelled() => return,
                    }
                }
                Ok(Some(Outcome::Later)) => {}
                Err(error) => {
                    tracing::warn!(error = &error as &dyn std::error::Error, "no policy could be refined");
                }
            }
            tokio::select! {
                () = tokio::time::sleep(pause) => pause = (2 * pause).min(LONGEST_PAUSE),
                () = stopping.cancelled() => return,
            }
        }
    }

    /// Refines the policy that has waited longest of those after the sequence number `after`, which becomes its; of all, if there is
    /// none. Nothing if none waits. Only the search ends when `stopping` is cancelled, so that what is counted of attempts stays true.
    async fn refine_next(&self, after: &mut i64, stopping: &CancellationToken) -> Result<Option<Outcome>, StoreError> {
        let next = match self.store.next_refinement(*after).await? {
            None => self.store.next_refinement(0).await?,
            next => next,
        };
        let Some((sequence, refinement)) = next else { return Ok(None) };
        *after = sequence;
        let policy_id = refinement.policy_id.clone();
        match self.store.begin_refinement(&policy_id).await? {
            Attempt::Begun => {}
            Attempt::Gone => return Ok(Some(Outcome::Ended)),
            Attempt::GivenUp => {
                tracing::error!(
                    policy_id,
                    "not refined: the process has ended each of the {MAX_ATTEMPTS} times that it was tried"
                );
                return Ok(Some(Outcome::Ended));
            }
        }
        let refined = tokio::select! {
            refined = self.refine(refinement) => refined,
            () = stopping.cancelled() => {
                // Being stopped is no fault of what was being refined.
                self.return_refinement(&policy_id).await;
                return Ok(Some(Outcome::Later));
            }
        };
        let refined = match refined {
            Ok(Some(refined)) => Some(refined),
            Ok(None) => {
                tracing::info!(policy_id, "not refined: the search has spent its budget");
                None
            }
            Err(ServiceError::Pool(PoolError::Busy)) => {
                tracing::debug!(policy_id, "not refined yet: no thread to spare");
                self.return_refinement(&policy_id).await;
                return Ok(Some(Outcome::Later));
            }
            Err(error) if is_passing(&error) => {
                tracing::warn!(error = &error as &dyn std::error::Error, policy_id, "not refined yet");
                self.return_refinement(&policy_id).await;
                return Ok(Some(Outcome::Later));
            }
            // Without its model, the policy stays what it is.
            Err(error @ ServiceError::Unknown { .. }) => {
                tracing::info!(error = &error as &dyn std::error::Error, policy_id, "not refined");
                None
            }
            Err(error) => {
                tracing::error!(error = &error as &dyn std::error::Error, policy_id, "cannot be refined");
                None
            }
        };
        let refined = refined.map(|refined| refined.at(self.clock.now()));
        let end = RefinementEnd { policy_id: policy_id.clone(), refined };
        if let Err(error) = self.store.end_refinement(end).await {
            self.return_refinement(&policy_id).await;
            return Err(error);
        }
        Ok(Some(Outcome::Ended))
    }

    /// Takes back an attempt that has not come to its end. Where that cannot be noted, it counts.
    async fn return_refinement(&self, policy_id: &str) {
        if let Err(error) = self.store.return_refinement(policy_id).await {
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                policy_id,
                "an attempt counts that made way for others"
            );
        }
    }

    /// The refined policy; `None` if the budget does not suffice to find it.
    async fn refine(&self, refinement: NewRefinement) -> Result<Option<PolicyText>, ServiceError> {
        let NewRefinement { policy_id, model_hash, session_id, request } = refinement;
        let refined: RefinedRequest<'_> = serde_json::from_str(&request).map_err(ServiceError::Write)?;
        let mapper = self.mapper_with_hash((&refined.model, &model_hash), "/model", None, None).await?;
        let Some(mapper) = mapper else {
            // Another one is there under its name.
            let name = refined.model.into_owned();
            return Err(ServiceError::Unknown { kind: Kind::Model, name, pointer: None });
        };
        let (texts, held) = match (&session_id, refined.demonstration) {
            (Some(session), _) => {
                let n_observations = self.session(session).await?.n_observations;
                let stored = self.stored_observations(session, 0, n_observations, mapper.model());
                let (StoredObservations { texts, .. }, held) = stored.await?;
                (texts, held)
            }
            (None, Some(text)) => {
                let mut held = None;
                let n_bytes = request.len() + text.get().len() + most_demonstration_bytes(mapper.model(), text.get());
                self.memory.reserve(&mut held, n_bytes)?;
                (vec![text.get().to_owned()], held)
            }
            (None, None) => (Vec::new(), None),
        };
        let RefinedRequest { model, weights, conditions, cost, .. } = refined;
        let stamp = Stamp {
            id: Some(self.ids.next().to_string()),
            model: model.into_owned(),
            model_hash,
            refines: Some(policy_id.clone()),
            ..Stamp::default()
        };
        drop(request);
        let (memory, clock, limit) = (self.memory.clone(), self.clock.clone(), self.time_limits.max_deadline);
        let job = move |interrupt: &mut dyn Interrupt| {
            let _held = held;
            let corrupt = |error| ServiceError::unreadable("refinements", "request", policy_id, error);
            let schema = mapper.model().schema();
            let weights = schema.attributes().iter().map(|attribute| weights.get(&attribute.name).copied());
            let demonstration = Demonstration::read_stored(schema, &texts, 0);
            let problem = match (demonstration, weights.collect::<Option<Vec<f64>>>()) {
                (Err(error), _) => return Ok(Err(corrupt(error.to_string()))),
                // What each observation counts is among the conditions.
                (Ok(Some((demonstration, _))), Some(weights)) if conditions.fit(mapper.model()) => {
                    Problem::new(mapper.model(), demonstration, Weights::of(weights), conditions)
                }
                _ => return Ok(Err(corrupt("it does not fit its model".to_owned()))),
            };
            drop(texts);
            let began = clock.instant();
            let mut limited = || if clock.elapsed(began) < limit { interrupt.poll() } else { Signal::Finish };
            optimum(&mapper, problem, cost, stamp, (&memory, &clock), &mut limited)
        };
        self.pool.run_to_spare(job).await?
    }
}

/// Whether what has failed may go through later: nothing is wrong with the refinement itself.
fn is_passing(error: &ServiceError) -> bool {
    match error {
        ServiceError::Pool(error) => *error != PoolError::Panicked,
        ServiceError::NoRoom(_)
        | ServiceError::Unavailable(_)
        | ServiceError::Storage(_)
        | ServiceError::Closed
        | ServiceError::Lost
        | ServiceError::Removed => true,
        _ => false,
    }
}

/// Searches for the global optimum, knowing a mapping of cost `local_cost`. Nothing if the budget ran out before that was proven,
/// or if its policy is too large.
fn optimum(
    mapper: &Mapper,
    problem: Problem<'_>,
    local_cost: f64,
    stamp: Stamp,
    (memory, clock): (&Memory, &Clock),
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Option<PolicyText>, ServiceError>, Cancelled> {
    let mut request = Request { problem, settings: Settings::default(), lookahead: None, deadline: None };
    let _held = take_for_search(mapper, &mut request, memory);
    let started = clock.instant();
    let settings = Settings { upper_bound: Some(local_cost), ..request.settings };
    let mapping = mapper.map(&request.problem, settings, interrupt)?;
    let warnings = request.problem.warnings(&DEMONSTRATION);
    let stamp = Stamp { elapsed_us: as_micros(clock.elapsed(started)), warnings, ..stamp };
    report(&stamp, &mapping);
    if mapping.status != Status::Optimal || Policy::check_steps(mapper.model(), &mapping).is_err() {
        return Ok(Ok(None));
    }
    let written = WrittenPolicy::new(&stamp, &request.problem, &mapping).map_err(ServiceError::from);
    Ok(written.and_then(|written| PolicyText::of(stamp, mapping.status, written)).map(Some))
}

#[cfg(test)]
mod tests;
