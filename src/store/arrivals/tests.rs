//! What is accepted, and what is read of it.

use std::time::Duration;

use jiff::Timestamp;
use proptest::prelude::*;
use tokio_util::task::TaskTracker;

use crate::store::{NewObservations, NewSession, Opened, Owner, Store};

fn session(id: &str) -> NewSession {
    NewSession { lookahead: Some(8), ..NewSession::plain(id, Timestamp::UNIX_EPOCH) }
}

fn observations(id: &str, seq: u32, states: &[u32]) -> NewObservations {
    NewObservations {
        session_id: id.to_owned(),
        owner: Owner::FIRST,
        seq,
        n_states: u32::try_from(states.len()).unwrap(),
        states: serde_json::to_string(states).unwrap(),
        at: Timestamp::UNIX_EPOCH,
        service_time: None,
        steps: None,
    }
}

async fn stored(store: &Store, id: &str) -> Vec<u32> {
    let rows = store.observations(id, 0).await.unwrap().texts;
    rows.iter().flat_map(|row| serde_json::from_str::<Vec<u32>>(row).unwrap()).collect()
}

/// Something that one of two processes does with one of two sessions.
#[derive(Clone, Copy, Debug)]
enum Action {
    /// Adds so many states at a sequence number that is off by so much.
    Add {
        n_states: u32,
        off_by: i32,
    },
    Read,
    Expire,
}

fn actions() -> impl Strategy<Value = Vec<(usize, usize, Action)>> {
    let add = (1..4_u32, prop_oneof![4 => Just(0), 1 => -2..3])
        .prop_map(|(n_states, off_by)| Action::Add { n_states, off_by });
    let action = prop_oneof![12 => add, 2 => Just(Action::Read), 1 => Just(Action::Expire)];
    proptest::collection::vec((0..2_usize, 0..2_usize, action), 1..40)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// No two services do, but a foreign hand may.
    #[test]
    fn two_processes_on_one_database_accept_what_is_next_and_lose_and_double_nothing(actions in actions()) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("etude.db");
            let tasks = TaskTracker::new();
            let stores = [Store::open(&path, &tasks).await.unwrap(), Store::open(&path, &tasks).await.unwrap()];
            let ids = ["a", "b"];
            for (store, id) in stores.iter().zip(ids) {
                store.note_alive(Timestamp::UNIX_EPOCH, Duration::MAX).await.unwrap();
                assert_eq!(store.open_session(session(id)).await.unwrap(), Opened::Yes);
            }
            let mut expected = [Vec::new(), Vec::new()];
            let mut is_open = true;
            for (store, which, action) in actions {
                let (store, id, expected) = (&stores[store], ids[which], &mut expected[which]);
                let n_expected = u32::try_from(expected.len()).unwrap();
                match action {
                    Action::Add { n_states, off_by } => {
                        let seq = n_expected.saturating_add_signed(off_by);
                        let states: Vec<u32> = (seq..seq + n_states).collect();
                        let was_next = store.append_observations(observations(id, seq, &states)).await.unwrap().is_ok();
                        prop_assert_eq!(was_next, is_open && seq == n_expected);
                        if was_next {
                            expected.extend(states);
                        }
                    }
                    Action::Read => {
                        prop_assert_eq!(&stored(store, id).await, &*expected);
                        let row = store.session(id).await.unwrap().unwrap();
                        prop_assert_eq!(row.n_observations as usize, expected.len());
                    }
                    // Few sessions expire in the middle of something, so this is the end of both or of none.
                    Action::Expire if n_expected > 20 => {
                        store.expire_sessions(Timestamp::MAX, Duration::ZERO, Duration::MAX).await.unwrap();
                        is_open = false;
                        break;
                    }
                    Action::Expire => {
                        let expired = store.expire_sessions(Timestamp::UNIX_EPOCH, Duration::ZERO, Duration::MAX);
                        assert_eq!(expired.await.unwrap(), []);
                    }
                }
            }
            // Dropped, not closed: whoever comes next finds all of it.
            drop(stores);
            tasks.close();
            let store = Store::open(&path, &TaskTracker::new()).await.unwrap();
            for (id, expected) in ids.iter().zip(&expected) {
                let expected = if is_open { expected.as_slice() } else { &[] };
                prop_assert_eq!(&stored(&store, id).await, expected);
                let seq = u32::try_from(expected.len()).unwrap();
                let was_next = store.append_observations(observations(id, seq, &[seq])).await.unwrap().is_ok();
                prop_assert_eq!(was_next, is_open);
            }
            Ok(())
        })?;
    }
}
