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
//!
//! This file is longer than 400 lines because its tests stand with it.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::refined::RefinedRequest;
use super::requests::most_demonstration_bytes;
use super::search::{PolicyText, as_micros, report, take_for_search};
use super::{Etude, Kind, PoolError, ServiceError};
use crate::clock::Clock;
use crate::memory::Memory;
use crate::store::{Attempt, MAX_ATTEMPTS, NewRefinement, RefinementEnd, StoreError};
use etude_core::attribute::Weights;
use etude_core::interrupt::{Cancelled, Interrupt, Signal};
use etude_core::mapping::{Demonstration, Mapper, Policy, Problem, Request, Settings, Stamp, Status, WrittenPolicy};
use etude_core::model::{Model, Origin, StateIdx};

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
        let mut begun = None;
        let mut pause = FIRST_PAUSE;
        loop {
            let outcome = tokio::select! {
                outcome = self.refine_next(&mut after, &mut begun) => outcome,
                () = stopping.cancelled() => {
                    // Being stopped is no fault of what was being refined.
                    if let Some(policy_id) = begun {
                        self.return_refinement(&policy_id).await;
                    }
                    return;
                }
            };
            match outcome {
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
    /// none. Nothing if none waits. Meanwhile `begun` is the policy that an attempt is counted for.
    async fn refine_next(&self, after: &mut i64, begun: &mut Option<String>) -> Result<Option<Outcome>, StoreError> {
        let next = match self.store.next_refinement(*after).await? {
            None => self.store.next_refinement(0).await?,
            next => next,
        };
        let Some((sequence, refinement)) = next else { return Ok(None) };
        *after = sequence;
        let policy_id = refinement.policy_id.clone();
        *begun = Some(policy_id.clone());
        let may_begin = self.store.begin_refinement(&policy_id).await;
        if !matches!(may_begin, Ok(Attempt::Begun)) {
            *begun = None;
        }
        if may_begin? == Attempt::GivenUp {
            tracing::error!(
                policy_id,
                "not refined: the process has ended each of the {MAX_ATTEMPTS} times that it was tried"
            );
            return Ok(Some(Outcome::Ended));
        }
        let refined = self.refine(refinement).await;
        *begun = None;
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
        let (hash, mapper) = self.mapper(&refined.model, "/model", None, None).await?;
        if hash != model_hash {
            // Another one is there under its name.
            let name = refined.model.into_owned();
            return Err(ServiceError::Unknown { kind: Kind::Model, name, pointer: None });
        }
        let (texts, held) = match (&session_id, refined.demonstration) {
            (Some(session), _) => {
                let n_observations = self.session(session).await?.n_observations;
                self.stored_observations(session, n_observations, mapper.model()).await?
            }
            (None, Some(text)) => {
                let mut held = None;
                let n_bytes = request.len() + text.get().len() + most_demonstration_bytes(mapper.model(), text.get());
                self.memory.hold(&mut held, n_bytes)?;
                (vec![text.get().to_owned()], held)
            }
            (None, None) => (Vec::new(), None),
        };
        let RefinedRequest { model, weights, start, cost, .. } = refined;
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
            let demonstration = Demonstration::read_again(schema, &texts, 0);
            let problem = match (demonstration, weights.collect::<Option<Vec<f64>>>()) {
                (Err(error), _) => return Ok(Err(corrupt(error.to_string()))),
                (Ok(Some(demonstration)), Some(weights)) if has_state(mapper.model(), start) => {
                    let start = Some(Origin::State(start));
                    Problem::new(mapper.model(), demonstration, Weights::of(weights), start)
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

/// Whether a model, which was registered anew perhaps, has this state.
fn has_state(model: &Model, state: StateIdx) -> bool {
    !model.is_lazy() && state < model.states().len()
}

/// Whether what has failed may go through later: nothing is wrong with the refinement itself.
fn is_passing(error: &ServiceError) -> bool {
    match error {
        ServiceError::Pool(error) => *error != PoolError::Panicked,
        ServiceError::NoRoom(_) => true,
        ServiceError::Store(error) => !matches!(error, StoreError::Corrupt { .. }),
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
    let stamp = Stamp { elapsed_us: as_micros(clock.elapsed(started)), ..stamp };
    report(&stamp, &mapping);
    if mapping.status != Status::Optimal || Policy::check_steps(mapper.model(), &mapping).is_err() {
        return Ok(Ok(None));
    }
    let written = WrittenPolicy::new(&stamp, &request.problem, &mapping).map_err(ServiceError::from);
    Ok(written.and_then(|written| PolicyText::of(stamp, written)).map(Some))
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use serde_json::{Value, json};
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::service::{Caller, Client, ModelText, Name};
    use crate::store::NewPolicy;
    use etude_core::model::Format;

    const NOW: Timestamp = Timestamp::UNIX_EPOCH;

    fn caller() -> Caller {
        Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: NOW }
    }

    async fn etude(directory: &std::path::Path) -> Etude {
        let settings = crate::service::Settings::of_test(directory);
        let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
        let world = ModelText::Whole(br#"{"dynamics": {"kind": "wumpus", "width": 4, "height": 4}}"#.to_vec());
        etude.put_model(&Name::new("world").unwrap(), world, Format::Json, caller()).await.unwrap();
        etude
    }

    /// A request that a search with a lookahead follows badly.
    fn request() -> Value {
        json!({"model": "world", "demonstration": [{"x": 0}, {"x": 3}, {"x": 0, "y": 3}], "lookahead": 1})
    }

    async fn made(etude: &Etude, request: &Value) -> String {
        etude.make_policy(request.to_string().into_bytes(), caller()).await.unwrap().id
    }

    async fn read(etude: &Etude, id: &str) -> Value {
        serde_json::from_str(&etude.policy(id).await.unwrap().0).unwrap()
    }

    #[tokio::test]
    async fn what_can_never_be_refined_is_dropped_and_does_not_hold_up_the_others() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path()).await;
        let (hash, _) = etude.mapper("world", "/model", None, None).await.unwrap();
        for (id, policy, request) in [
            ("unreadable", "{}", json!({"model": "world", "weights": {}, "start": 0, "cost": 1}).to_string()),
            ("garbled", "{}", "{".to_owned()),
            ("gone", "{}", "{}".to_owned()),
        ] {
            let policy =
                NewPolicy { id: id.to_owned(), summary: policy.to_owned(), steps: Vec::new(), created_at: NOW };
            let refinement =
                NewRefinement { policy_id: id.to_owned(), model_hash: hash.clone(), session_id: None, request };
            etude.store.add_policies(vec![policy], vec![refinement]).await.unwrap();
        }
        let good = made(&etude, &request()).await;
        let mut after = 0;
        while let Some(outcome) = etude.refine_next(&mut after, &mut None).await.unwrap() {
            assert_eq!(outcome, Outcome::Ended);
        }
        assert!(etude.policy("unreadable").await.is_err(), "it stays what it is");
        let refined_by = read(&etude, &good).await["refined_by"].as_str().unwrap().to_owned();
        assert_eq!(read(&etude, &refined_by).await["status"], "optimal");
    }

    #[tokio::test]
    async fn who_waits_for_a_thread_comes_before_a_refinement_which_is_taken_up_again() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path()).await;
        let id = made(&etude, &request()).await;
        let mut after = 0;
        let mut running = Box::pin(etude.pool.run_patiently(Client::LOCAL, |interrupt| {
            while interrupt.poll() != Signal::Cancel {
                std::thread::yield_now();
            }
            Ok(())
        }));
        assert!(futures_util::poll!(&mut running).is_pending());
        for _ in 0..=MAX_ATTEMPTS {
            assert_eq!(etude.refine_next(&mut after, &mut None).await.unwrap(), Some(Outcome::Later));
            assert_eq!(etude.store.n_attempts(&id).await, Some(0), "it does not count");
        }
        drop(running);
        while etude.refine_next(&mut after, &mut None).await.unwrap() == Some(Outcome::Later) {
            tokio::task::yield_now().await;
        }
        assert!(read(&etude, &id).await["refined_by"].is_string());
    }

    #[tokio::test]
    async fn a_refinement_that_ends_the_process_is_given_up_after_three_attempts() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path()).await;
        let id = made(&etude, &request()).await;
        for n in 1..=MAX_ATTEMPTS {
            // As if the process had ended then.
            assert_eq!(etude.store.begin_refinement(&id).await.unwrap(), Attempt::Begun);
            assert_eq!(etude.store.n_attempts(&id).await, Some(n));
        }
        let mut after = 0;
        assert_eq!(etude.refine_next(&mut after, &mut None).await.unwrap(), Some(Outcome::Ended));
        assert_eq!(etude.refine_next(&mut after, &mut None).await.unwrap(), None);
        assert_eq!(read(&etude, &id).await["refined_by"], Value::Null, "it stays what it is");
    }

    #[tokio::test]
    async fn an_attempt_that_is_stopped_does_not_count() {
        let directory = tempfile::tempdir().unwrap();
        let etude = Arc::new(etude(directory.path()).await);
        // So large that it takes far longer to be searched than to be stopped.
        let world = ModelText::Whole(br#"{"dynamics": {"kind": "wumpus", "width": 100, "height": 100}}"#.to_vec());
        etude.put_model(&Name::new("large").unwrap(), world, Format::Json, caller()).await.unwrap();
        let mut request = request();
        request["model"] = "large".into();
        let id = made(&etude, &request).await;
        let stopping = CancellationToken::new();
        let mut refining = Box::pin(Arc::clone(&etude).refine_until(stopping.clone()));
        while etude.store.n_attempts(&id).await != Some(1) {
            assert!(futures_util::poll!(&mut refining).is_pending());
        }
        stopping.cancel();
        refining.await;
        assert_eq!(etude.store.n_attempts(&id).await, Some(0));
    }

    #[tokio::test]
    async fn the_refined_policy_is_the_optimum_however_the_first_one_was_to_be_searched_for() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path()).await;
        let mut request = request();
        (request["heuristic"], request["max_expansions"]) = ("paper".into(), 0.into());
        let id = made(&etude, &request).await;
        let mut after = 0;
        assert_eq!(etude.refine_next(&mut after, &mut None).await.unwrap(), Some(Outcome::Ended));
        let refined_by = read(&etude, &id).await["refined_by"].as_str().unwrap().to_owned();
        assert_eq!(read(&etude, &refined_by).await["status"], "optimal");

        // What is better, but not proven to be the best, is not it.
        let (_, mapper) = etude.mapper("world", "/model", None, None).await.unwrap();
        let schema = mapper.model().schema();
        let text = request["demonstration"].to_string();
        let demonstration = Demonstration::read_again(schema, &[text], 3).unwrap().unwrap();
        let problem = Problem::new(mapper.model(), demonstration, schema.weights(), None);
        let refined =
            optimum(&mapper, problem, 1e9, Stamp::default(), (&etude.memory, &etude.clock), &mut || Signal::Finish);
        assert!(refined.unwrap().unwrap().is_none());
    }
}
