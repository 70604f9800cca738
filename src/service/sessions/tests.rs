use serde_json::json;
use tokio_util::task::TaskTracker;

use super::*;
use crate::client::Client;
use crate::clock::{Clock, Ids};
use crate::memory::Memory;
use crate::service::{ModelText, Name, PoolSettings, Settings, TimeLimits};
use etude_core::model::{Format, Limits};

const NOW: Timestamp = Timestamp::UNIX_EPOCH;

fn caller() -> Caller {
    Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: NOW }
}

async fn open(directory: &std::path::Path, time_limits: TimeLimits, tasks: &TaskTracker) -> Etude {
    let settings = Settings {
        database: directory.join("etude.db"),
        limits: Limits::DEFAULT,
        memory: Memory::with_room(256 << 20),
        model_cache_bytes: 1 << 20,
        session_idle_timeout: Duration::MAX,
        time_limits,
        clock: Clock::system(),
        ids: Ids::random(),
        pool: PoolSettings { n_threads: 1, max_waiting: 1, max_long: 1 },
    };
    Etude::open(&settings, tasks, CancellationToken::new()).await.unwrap()
}

/// Receives the states from `seq` on.
pub(super) async fn receive(
    etude: &Etude,
    session: &mut Session,
    seq: u32,
    states: &Value,
    now: Timestamp,
) -> Received {
    let mut coming = Coming::default();
    session.take_in(&mut coming, seq, &Place::root(states), None).unwrap();
    session.receive(etude, coming, now).await.unwrap().pop().unwrap().mapped.unwrap()
}

/// A service with a model of 256 attributes, and a session that has observed nothing of them 1200 times.
async fn observed(directory: &std::path::Path, tasks: &TaskTracker) -> (Etude, Session) {
    let attribute = |n: usize| json!({"name": format!("{n}"), "kind": "number"});
    let wide = json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    });
    let etude = open(directory, TimeLimits::DEFAULT, tasks).await;
    let text = ModelText::Whole(wide.to_string().into_bytes());
    etude.put_model(&Name::new("wide").unwrap(), text, Format::Json, caller()).await.unwrap();
    let mut session = etude.open_session(&json!({"type": "open", "model": "wide"}), caller()).await.unwrap();
    let states = json!(vec![json!({}); 300]);
    for n in 0..4 {
        if let Received::Waiting(waiting) = receive(&etude, &mut session, 300 * n, &states, NOW).await {
            session.advance(&etude, waiting).await.unwrap();
        }
    }
    (etude, session)
}

fn is_no_room<T>(result: &Result<T, SessionError>) -> bool {
    matches!(result, Err(SessionError::Service(ServiceError::NoRoom(_))))
}

#[tokio::test]
async fn a_session_is_resumed_and_ended_only_if_there_is_memory_for_all_of_it() {
    let directory = tempfile::tempdir().unwrap();
    let (etude, mut session) = observed(directory.path(), &TaskTracker::new()).await;
    let id = session.id().to_owned();
    // What is small has room.
    let others = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
    assert!(is_no_room(&session.end(&etude, 1200, NOW).await));
    assert!(!session.has_ended());
    drop(session);
    let before = etude.memory.free();
    assert!(is_no_room(&etude.resume_session(&id, caller()).await));
    assert_eq!(etude.memory.free(), before);
    drop(others);

    let before = etude.memory.free();
    let mut resumed = etude.resume_session(&id, caller()).await.unwrap();
    let n_resumed = resumed.kept.len() + resumed.steps.len();
    assert!(n_resumed > 1000 && before - etude.memory.free() > 4 << 20, "{}", etude.memory.free());
    let ended = resumed.session.end(&etude, 1200, NOW).await.unwrap();
    assert_eq!(n_resumed + ended.steps.len(), 1200);
    let ended_status = ended.policy.status;
    drop((resumed, ended));
    assert_eq!(etude.memory.free(), before);

    let again = etude.resume_session(&id, caller()).await.unwrap();
    assert_eq!((again.kept.len() + again.steps.len(), again.policy.as_ref().unwrap().status), (1200, ended_status));
    assert!(before - etude.memory.free() > 4 << 20);
    drop(again);
    assert_eq!(etude.memory.free(), before);
    let others = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
    assert!(is_no_room(&etude.resume_session(&id, caller()).await));
    drop(others);
}

#[tokio::test]
async fn who_resumes_a_session_does_not_wait_for_ever_for_its_model() {
    let directory = tempfile::tempdir().unwrap();
    let tasks = TaskTracker::new();
    let (etude, session) = observed(directory.path(), &tasks).await;
    let id = session.id().to_owned();
    drop(session);
    etude.close().await;
    drop(etude);
    tasks.close();
    tasks.wait().await;
    let time_limits = TimeLimits { default_deadline: Duration::ZERO, ..TimeLimits::DEFAULT };
    let etude = open(directory.path(), time_limits, &TaskTracker::new()).await;
    let resumed = etude.resume_session(&id, caller()).await;
    assert!(matches!(resumed, Err(SessionError::Service(ServiceError::Compiling { .. }))), "{resumed:?}");
}

#[tokio::test]
async fn a_short_text_of_many_wide_observations_is_left_to_who_checks_their_size() {
    let directory = tempfile::tempdir().unwrap();
    let tasks = TaskTracker::new();
    let (etude, session) = observed(directory.path(), &tasks).await;
    let is_taken = |n: usize| {
        let mut coming = Coming::default();
        session.take_in_next(&mut coming, 1200, &format!("[{}]", vec!["{}"; n].join(",")))
    };
    // Each takes 7 KB.
    assert!(is_taken(1) && is_taken(9));
    assert!(!is_taken(10) && !is_taken(5000));
    etude.close().await;
}
