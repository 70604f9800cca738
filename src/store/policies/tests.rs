use tokio_util::task::TaskTracker;

use super::*;
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Stamp};
use etude_core::model::{Definition, Limits, Model};

/// A policy of a line of so many states with long names, which goes all the way: its answer, its summary and its steps as they are
/// stored.
fn long(id: &str, n_states: usize) -> (String, String, Vec<u8>) {
    const N_ATTRIBUTES: usize = 32;
    let attribute = |n| serde_json::json!({"name": format!("{n:0>64}"), "kind": "number", "weight": 1e9});
    let states: Vec<_> = (0..n_states).map(|n| vec![u8::from(n + 1 == n_states); N_ATTRIBUTES]).collect();
    let transitions: Vec<_> = (1..n_states).map(|state| serde_json::json!([state - 1, "on", state])).collect();
    let document = serde_json::json!({
        "attributes": (0..N_ATTRIBUTES).map(attribute).collect::<Vec<_>>(),
        "actions": [{"name": "on", "cost": 0.3}],
        "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions},
    });
    let definition = Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let mapper = Mapper::new(model, &mut Uninterrupted).unwrap();
    let states = mapper.model().states();
    let last = u32::try_from(n_states - 1).unwrap();
    let end = states.domain(0)[states.row(last)[0] as usize].clone();
    let demonstration = Demonstration::of([vec![None; N_ATTRIBUTES], vec![Some(end); N_ATTRIBUTES]]).unwrap();
    let weights = mapper.model().schema().weights();
    let problem = Problem::new(mapper.model(), demonstration, weights, Conditions::default());
    let mapping = mapper.map(&problem, etude_core::mapping::Settings::default(), &mut Uninterrupted).unwrap();
    let stamp = Stamp { id: Some(id.to_owned()), ..Stamp::default() };
    let written = WrittenPolicy::new(&stamp, &problem, &mapping).unwrap();
    let answer = written.answer(None).unwrap();
    let (summary, steps) = written.into_stored();
    (answer, summary, pack_steps(&steps).unwrap())
}

#[tokio::test]
async fn a_policy_is_read_only_if_there_is_memory_for_it() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    // Stored in little, in little that becomes more than is written in passing, and in much.
    for n_states in [3, 700, 7000] {
        let id = n_states.to_string();
        let (answer, summary, steps) = long(&id, n_states);
        let created_at = Timestamp::UNIX_EPOCH;
        let is_small = summary.len() + steps.len() <= MAX_INLINE_BYTES;
        assert_eq!((is_small, answer.len() > MAX_INLINE_ANSWER_BYTES), (n_states < 7000, n_states > 3));
        let new = NewPolicy { steps, ..NewPolicy::plain(&id, &summary, created_at) };
        store.add_policies(vec![new], Vec::new()).await.unwrap();
        let memory = Memory::with_room(1 << 30);
        let (read, held) = store.policy_within(&id, Links::Now, &memory).await.unwrap().unwrap();
        assert_eq!(read, answer);
        let n_held = held.as_ref().map_or(0, Held::n_bytes);
        if n_states > 3 {
            let n_bytes = answer.len() as u64;
            assert!((n_bytes..n_bytes * 5 / 4 + 4096).contains(&n_held), "{n_held} for {n_bytes}");
            let little = Memory::with_room(n_bytes / 2);
            let refused = store.policy_within(&id, Links::Now, &little).await;
            assert!(matches!(refused, Err(StoreError::NoRoom(_))), "{n_states}: {refused:?}");
            assert_eq!(little.free(), little.room() / 4096 * 4096);
        }
        drop(held);
        assert_eq!(memory.free(), 1 << 30);
    }
    assert!(store.policy_within("none", Links::Now, &Memory::with_room(0)).await.unwrap().is_none());
}
