use jiff::Timestamp;
use serde_json::{Value, json};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::super::tests::receive;
use super::*;
use crate::client::Client;
use crate::service::pool::tests::keep_all_threads;
use crate::service::{Caller, Coming, ModelText, Name, Settings};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Format, Limits, Model};

#[test]
fn what_is_mapped_where_it_arrives_is_measured_by_transitions_too() {
    let size = |definition: &Value| {
        let definition = Definition::read(definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        model.graph().n_states() + model.graph().n_transitions()
    };
    let lookahead = NonZeroU32::new(8);
    let cave = size(&json!({"dynamics": {"kind": "wumpus", "width": 7, "height": 4, "gold": [[5, 0]]}}));
    assert!(are_few_nodes(cave, lookahead, 1) && !are_few_nodes(cave, lookahead, 1000), "{cave}");
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
    assert!(!are_few_nodes(size(&complete), lookahead, 1));
}

/// A ring of states, whose values tell little of where one is, and walks that jump on it.
fn ring(n_states: usize, n_observations: usize) -> (Value, Vec<Value>) {
    let value = |n: usize| json!([n * 7919 % 97, n * 104_729 % 89]);
    let transitions = (0..n_states).flat_map(|n| {
        [json!([n, 0, (n + 1) % n_states]), json!([n, 1, n * 31 % n_states]), json!([n, 2, (n + 500) % n_states])]
    });
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "y", "kind": "number"}],
        "actions": [{"name": "on", "cost": 0.1}, {"name": "far", "cost": 3}, {"name": "leap", "cost": 2}],
        "dynamics": {
            "kind": "table", "states": (0..n_states).map(value).collect::<Vec<_>>(),
            "transitions": transitions.collect::<Vec<_>>(), "start": 0,
        },
    });
    let seen = (0..n_observations).map(|n| json!({"x": n * 11 % 97, "y": n * n % 89})).collect();
    (model, seen)
}

/// A service with the model of a ring, and a walk on it.
async fn service(directory: &std::path::Path) -> (Etude, Vec<Value>, Caller) {
    let settings = Settings::of_test(directory);
    let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
    let (model, seen) = ring(2000, 300);
    let text = ModelText::Whole(model.to_string().into_bytes());
    let caller = Caller { client: Client::LOCAL, arrived: etude.clock.instant(), now: Timestamp::UNIX_EPOCH };
    etude.put_model(&Name::new("ring").unwrap(), text, Format::Json, caller).await.unwrap();
    (etude, seen, caller)
}

/// A session that is to be searched in the pool, with what it has observed.
async fn slow(directory: &std::path::Path) -> (Etude, Session, Waiting) {
    let (etude, seen, caller) = service(directory).await;
    let open = json!({"type": "open", "model": "ring", "lookahead": 12});
    let mut session = etude.open_session(&open, caller).await.unwrap();
    session.is_slow = true;
    let received = receive(&etude, &mut session, 0, &seen.into(), caller.now).await;
    let Received::Waiting(waiting) = received else { panic!("it is slow") };
    (etude, session, waiting)
}

#[tokio::test]
async fn sessions_that_wait_for_their_turn_take_no_memory_meanwhile() {
    let directory = tempfile::tempdir().unwrap();
    let (etude, mut session, waiting) = slow(directory.path()).await;
    let kept = keep_all_threads(&etude.pool).await;
    let free = etude.memory.free();
    let mut advancing = Box::pin(session.advance(&etude, waiting));
    assert!(futures_util::poll!(&mut advancing).is_pending());
    assert_eq!(etude.memory.free(), free);
    drop(kept);
    assert!(!advancing.await.unwrap().is_empty());
}

#[tokio::test]
async fn a_session_that_finds_no_memory_in_its_turn_waits_for_it() {
    let directory = tempfile::tempdir().unwrap();
    let (etude, mut session, waiting) = slow(directory.path()).await;
    let others = etude.memory.try_take_as_large(etude.memory.free_for_large()).unwrap();
    let advance = session.begin_to_advance(waiting, 0).unwrap();
    let turned = session.advance_in_turn(&etude, advance, None).await.unwrap();
    let Turned::NoRoom(Advance { online, waiting, .. }) = turned else { panic!("there is no memory") };
    session.online = Some(online);
    let mut advancing = Box::pin(session.advance(&etude, waiting));
    assert!(futures_util::poll!(&mut advancing).is_pending());
    drop(others);
    assert!(!advancing.await.unwrap().is_empty());
}

/// What writes runs on the same thread.
#[tokio::test]
async fn a_mapping_that_takes_some_time_begins_after_the_writing() {
    let directory = tempfile::tempdir().unwrap();
    let (etude, seen, caller) = service(directory.path()).await;
    let seen = Value::from(seen);
    for takes_some_time in [false, true] {
        let open = json!({"type": "open", "model": "ring", "lookahead": 1, "start": 0});
        let mut session = etude.open_session(&open, caller).await.unwrap();
        session.takes_some_time = takes_some_time;
        let mut coming = Coming::default();
        session.take_in(&mut coming, 0, &Place::root(&seen), None).unwrap();
        let mut receiving = Box::pin(session.receive(&etude, coming, caller.now));
        assert!(futures_util::poll!(&mut receiving).is_pending());
        drop(receiving);
        assert_eq!(session.n_steps == 0, takes_some_time, "{} steps", session.n_steps);
    }
}

#[tokio::test]
async fn what_takes_long_goes_on_in_the_pool_with_the_same_steps() {
    let directory = tempfile::tempdir().unwrap();
    let (etude, seen, caller) = service(directory.path()).await;
    let open = json!({"type": "open", "model": "ring", "lookahead": 12});
    let mut session = etude.open_session(&open, caller).await.unwrap();

    let mut online =
        OnlineMapping::new(&session.mapper, session.weights.clone(), session.conditions.clone(), session.lookahead);
    assert!(online.searches());
    let mut n_cut_off = 0;
    for (frame, states) in seen.chunks(100).enumerate() {
        let seq = u32::try_from(100 * frame).unwrap();
        let states = Value::from(states);
        let received = receive(&etude, &mut session, seq, &states, caller.now).await;
        let steps = match received {
            Received::Mapped(steps) => steps,
            Received::Waiting(waiting) => {
                n_cut_off += usize::from(!waiting.steps.is_empty());
                session.advance(&etude, waiting).await.unwrap()
            }
        };
        let observe = |state: &Value| {
            let values = session.mapper.model().schema().read_observation(&Place::root(state), &mut Faults::default());
            online.observe(&values.unwrap(), None, &mut Uninterrupted).unwrap()
        };
        let expected: Vec<_> = states.as_array().unwrap().iter().flat_map(observe).collect();
        assert_eq!(*steps, expected);
        assert_eq!(session.n_steps, online.n_steps());
    }
    assert!(n_cut_off > 0, "searches of so many windows take longer than is waited for where observations arrive");
}
