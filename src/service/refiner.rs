//! Refinement: policies that a finite lookahead decided are followed, in the background, by the global optimum.
//!
//! What waits is in the store, so that a restart forgets nothing. One policy is refined at a time.

use std::sync::Arc;
use std::time::{Duration, Instant};

use jiff::Timestamp;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::policies::{PolicyText, as_micros, read_weighted_request, report};
use super::{Etude, ServiceError};
use crate::document;
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::{Mapper, Policy, Settings, Stamp, Status};
use crate::store::{NewRefinement, RefinementEnd};

/// How long after a failure it is tried again.
const RETRY_EVERY: Duration = Duration::from_secs(10);

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

impl Etude {
    /// Refines whatever waits to be refined, until `stopping` is cancelled.
    pub async fn refine_until(self: Arc<Self>, stopping: CancellationToken) {
        loop {
            let waiting = tokio::select! {
                waiting = self.refine_next() => waiting,
                () = stopping.cancelled() => return,
            };
            let pause = match waiting {
                Ok(true) => continue,
                Ok(false) => Duration::MAX,
                Err(error) => {
                    tracing::warn!(error = &error as &dyn std::error::Error, "a policy could not be refined yet");
                    RETRY_EVERY
                }
            };
            tokio::select! {
                () = self.refiner.work.notified() => {}
                () = tokio::time::sleep(pause) => {}
                () = stopping.cancelled() => return,
            }
        }
    }

    /// Refines the policy that has waited longest. Says whether there was one.
    async fn refine_next(&self) -> Result<bool, ServiceError> {
        let Some(NewRefinement { policy_id, model_hash, request }) = self.store.next_refinement().await? else {
            return Ok(false);
        };
        let document = document::parse(request.as_bytes())?;
        let model = document["model"].as_str().unwrap_or_default().to_owned();
        let refined = match self.mapper(&model, "/model", None).await {
            Ok((hash, mapper)) if hash == model_hash => {
                let local = self.policy(&policy_id).await?;
                let local: Policy = serde_json::from_str(&local).map_err(ServiceError::Write)?;
                let id = Uuid::now_v7().to_string();
                let stamp =
                    Stamp { id: Some(id), model, model_hash, refines: Some(policy_id.clone()), ..Stamp::default() };
                let local_cost = local.cost.total;
                let job = move |interrupt: &mut dyn Interrupt| refine(&mapper, &document, local_cost, stamp, interrupt);
                match self.pool.run_patiently(job).await? {
                    // What cannot be read will not be read later either.
                    Err(error @ (ServiceError::Parse(_) | ServiceError::Faults(_))) => {
                        tracing::error!(error = &error as &dyn std::error::Error, policy_id, "cannot be refined");
                        None
                    }
                    refined => refined?,
                }
            }
            // Without its model, the policy stays what it is.
            Ok(_) | Err(ServiceError::Unknown { .. }) => None,
            Err(error) => return Err(error),
        };
        let refined = refined.map(|refined| refined.at(Timestamp::now()));
        self.store.end_refinement(RefinementEnd { policy_id, refined }).await?;
        Ok(true)
    }
}

/// Searches for the global optimum, knowing a mapping of cost `local_cost`. Nothing if the budget ran out before anything
/// better was found, or if what was found is too large.
fn refine(
    mapper: &Mapper,
    document: &serde_json::Value,
    local_cost: f64,
    stamp: Stamp,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Option<PolicyText>, ServiceError>, Cancelled> {
    let request = match read_weighted_request(mapper.model(), document) {
        Ok(request) => request,
        Err(faults) => return Ok(Err(faults.into())),
    };
    let started = Instant::now();
    let settings = Settings { upper_bound: Some(local_cost), ..request.settings };
    let mapping = mapper.map(&request.problem, settings, interrupt)?;
    let is_no_better = mapping.status != Status::Optimal && mapping.cost.total >= local_cost;
    if is_no_better || Policy::check_steps(mapper.model(), &mapping).is_err() {
        return Ok(Ok(None));
    }
    let stamp = Stamp { elapsed_us: as_micros(started), ..stamp };
    report(&stamp, &mapping);
    Ok(PolicyText::of(&Policy::new(stamp, &request.problem, &mapping)).map(Some))
}
