use jiff::Timestamp;
use serde_json::{Value, json};
use tokio_util::task::TaskTracker;

use super::*;
use crate::client::Client;
use crate::service::{Caller, ModelText, Name};
use crate::store::{NewPolicy, PolicyFilter};
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
    etude.make_policy(request.to_string().into_bytes(), caller()).await.unwrap().id.unwrap()
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
        let policy = NewPolicy::plain(id, policy, NOW);
        let refinement =
            NewRefinement { policy_id: id.to_owned(), model_hash: hash.clone(), session_id: None, request };
        etude.store.add_policies(vec![policy], vec![refinement]).await.unwrap();
    }
    let good = made(&etude, &request()).await;
    let mut after = 0;
    while let Some(outcome) = etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap() {
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
    let mut running = Box::pin(etude.pool.run_in_turn(Client::LOCAL, |interrupt| {
        while interrupt.poll() != Signal::Cancel {
            std::thread::yield_now();
        }
        Ok(())
    }));
    assert!(futures_util::poll!(&mut running).is_pending());
    for _ in 0..=MAX_ATTEMPTS {
        assert_eq!(etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap(), Some(Outcome::Later));
        assert_eq!(etude.store.n_attempts(&id).await, Some(0), "it does not count");
    }
    drop(running);
    while etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap() == Some(Outcome::Later) {
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
    assert_eq!(etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap(), Some(Outcome::Ended));
    assert_eq!(etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap(), None);
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
    assert_eq!(etude.refine_next(&mut after, &CancellationToken::new()).await.unwrap(), Some(Outcome::Ended));
    let refined_by = read(&etude, &id).await["refined_by"].as_str().unwrap().to_owned();
    assert_eq!(read(&etude, &refined_by).await["status"], "optimal");

    // What is better, but not proven to be the best, is not it.
    let (_, mapper) = etude.mapper("world", "/model", None, None).await.unwrap();
    let schema = mapper.model().schema();
    let text = request["demonstration"].to_string();
    let (demonstration, _) = Demonstration::read_stored(schema, &[text], 3).unwrap().unwrap();
    let problem =
        Problem::new(mapper.model(), demonstration, schema.weights(), etude_core::mapping::Conditions::default());
    let refined =
        optimum(&mapper, problem, 1e9, Stamp::default(), (&etude.memory, &etude.clock), &mut || Signal::Finish);
    assert!(refined.unwrap().unwrap().is_none());
}

#[tokio::test]
async fn a_policy_that_is_deleted_while_it_waits_or_is_refined_leaves_nothing_to_refine() {
    let directory = tempfile::tempdir().unwrap();
    let etude = etude(directory.path()).await;
    let waiting = made(&etude, &request()).await;
    etude.delete_policy(&waiting).await.unwrap();
    assert_eq!(etude.refine_next(&mut 0, &CancellationToken::new()).await.unwrap(), None);
    // It is gone between the look at it and its attempt,
    let early = made(&etude, &request()).await;
    let (_, refinement) = etude.store.next_refinement(0).await.unwrap().unwrap();
    etude.delete_policy(&early).await.unwrap();
    assert_eq!(etude.store.begin_refinement(&early).await.unwrap(), Attempt::Gone);
    // and while it is searched for.
    let refined = etude.refine(refinement).await.unwrap().map(|refined| refined.at(NOW));
    assert!(refined.is_some());
    etude.store.end_refinement(RefinementEnd { policy_id: early, refined }).await.unwrap();
    assert_eq!(etude.policies(&PolicyFilter::default(), 0, 10).await.unwrap().items.len(), 0);
    // Others are refined as before.
    let next = made(&etude, &request()).await;
    assert_eq!(etude.refine_next(&mut 0, &CancellationToken::new()).await.unwrap(), Some(Outcome::Ended));
    assert!(read(&etude, &next).await["refined_by"].is_string());
}
