//! In which order things are written, and what becomes of those who wait.

use std::fs;
use std::path::Path;

use futures_util::future::join_all;
use futures_util::{FutureExt, poll};
use jiff::Timestamp;
use tokio::task::unconstrained;

use super::lines::MAX_WAITING;
use super::*;
use crate::store::database::{Locking, N_READERS};
use crate::store::policies::NewPolicy;
use crate::store::sessions::SettleObservations;
use crate::store::{NewObservations, NewSession, NewTrial, Opened, Owner, SessionEnd, SessionStatus, Store, Taken};

fn policy(id: &str, n_bytes: usize) -> AddPolicies {
    let steps = vec![0; n_bytes];
    let policies = vec![NewPolicy { steps, ..NewPolicy::plain(id, "{}", Timestamp::UNIX_EPOCH) }];
    AddPolicies { policies, refinements: Vec::new() }
}

async fn open(directory: &Path) -> Store {
    Store::open(&directory.join("etude.db"), &TaskTracker::new()).await.unwrap()
}

/// Sizes of what is in the next group.
async fn group(lines: &mut Lines) -> Vec<usize> {
    let mut group = Vec::new();
    lines.take(&mut group).await;
    group.iter().map(|job| job.n_bytes() >> 10).collect()
}

#[tokio::test]
async fn what_is_small_goes_first_and_of_what_is_large_each_has_its_turn() {
    let (writer, mut lines) = Writer::with_lines();
    let send = |n_kib: usize| Box::pin(writer.add_policies(policy("p", n_kib << 10)));
    let mut sent: Vec<_> = [700, 800, 100, 200, 300, 5, 900, 1, 2].map(send).into();
    for sent in &mut sent {
        assert!(poll!(sent).is_pending());
    }
    assert_eq!(group(&mut lines).await, [1, 2, 700]);
    let mut later = send(3);
    assert!(poll!(&mut later).is_pending());
    assert_eq!(group(&mut lines).await, [3, 800]);
    assert_eq!(group(&mut lines).await, [100, 200, 300]);
    writer.close();
    assert_eq!(group(&mut lines).await, [5, 900], "what waits is still written");
    assert!(!lines.take(&mut Vec::new()).await);
    assert!(matches!(writer.add_policies(policy("p", 0)).await, Err(StoreError::Closed)));
}

#[tokio::test]
async fn lines_end_with_those_who_might_bring_something() {
    let (writer, mut lines) = Writer::with_lines();
    let mut group = Vec::new();
    let mut taken = Box::pin(lines.take(&mut group));
    assert!(poll!(&mut taken).is_pending());
    drop(writer);
    assert!(!taken.await);
}

#[tokio::test(start_paused = true)]
async fn who_does_not_get_in_line_for_long_is_told_so() {
    let (writer, mut lines) = Writer::with_lines();
    let waiting = (0..MAX_WAITING).map(|_| writer.write(SettleObservations));
    let mut waiting = Box::pin(join_all(waiting));
    assert!(poll!(&mut waiting).is_pending());
    let one_more = writer.write(SettleObservations).await;
    assert!(matches!(one_more, Err(StoreError::Unavailable(Unavailable::Slow))), "{one_more:?}");
    assert!(poll!(&mut waiting).is_pending());
    assert_eq!(lines.drain().count(), MAX_WAITING, "it is not written later");
}

#[tokio::test]
async fn who_has_waited_behind_a_locked_database_does_not_wait_as_long_once_more() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("etude.db");
    let mut database = Database::new(&path, Locking::None).unwrap();
    let mut connection = database.connect().await.unwrap();
    sqlx::query("PRAGMA busy_timeout = 1").execute(&mut connection).await.unwrap();
    let mut other = Database::new(&path, Locking::None).unwrap().connect().await.unwrap();
    let held = other.begin_with("BEGIN IMMEDIATE").await.unwrap();
    let readers = database.readers().unwrap();
    let writer = Writer::start(database, Some(connection), readers, &TaskTracker::new());
    let sizes = [0; MAX_GROUP + 1].into_iter().chain([1 << 20; 2]);
    let mut sent: Vec<_> = sizes.map(|n_bytes| Box::pin(writer.add_policies(policy("p", n_bytes)))).collect();
    for sent in &mut sent {
        assert!(poll!(sent).is_pending());
    }
    let is_locked =
        |written: Result<(), StoreError>| matches!(written, Err(StoreError::Unavailable(Unavailable::Locked)));
    assert!(is_locked(sent.remove(0).await));
    assert!(sent.into_iter().all(|sent| unconstrained(sent).now_or_never().is_some_and(is_locked)));
    held.rollback().await.unwrap();
    writer.add_policies(policy("p", 0)).await.unwrap();
}

#[tokio::test]
async fn what_an_owner_still_has_in_line_is_refused_once_another_has_resumed_the_session() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let session = NewSession::plain("s", Timestamp::UNIX_EPOCH);
    assert_eq!(store.open_session(session).await.unwrap(), Opened::Yes);
    let mut others: Vec<_> = ["a", "b", "c"].map(|id| Box::pin(store.writer.add_policies(policy(id, 1 << 20)))).into();
    for other in &mut others {
        assert!(poll!(other).is_pending());
    }
    let states = format!("[{}1]", " ".repeat(2 * MAX_SMALL_BYTES));
    let at = Timestamp::UNIX_EPOCH;
    let new = |owner| {
        let states = states.clone();
        NewObservations {
            session_id: "s".to_owned(),
            owner,
            seq: 0,
            n_states: 1,
            states,
            at,
            service_time: None,
            steps: None,
        }
    };
    let mut late = Box::pin(store.append_observations(new(Owner::FIRST)));
    assert!(poll!(&mut late).is_pending(), "it is behind what is large");
    let Taken::Open(taken) = store.take_session("s", at).await.unwrap() else { panic!("it is open") };
    assert_eq!(taken.n_observations, 0);
    assert_eq!(late.await.unwrap(), Err(SessionRefusal::Superseded));
    assert_eq!(store.touch_session("s", Owner::FIRST, at).await.unwrap(), Err(SessionRefusal::Superseded));
    assert_eq!(store.append_observations(new(taken.owner)).await.unwrap(), Ok(()));
    assert_eq!(store.append_observations(new(Owner::FIRST)).await.unwrap(), Err(SessionRefusal::Superseded));
    assert_eq!(store.session("s").await.unwrap().unwrap().n_observations, 1);
}

/// Those of a group are opened by one statement; one that cannot be is refused alone.
#[tokio::test]
async fn sessions_that_are_opened_together_are_as_if_they_had_come_one_after_the_other() {
    const MANY: usize = 40;
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let session = |id: &str| NewSession::plain(id, Timestamp::UNIX_EPOCH);
    assert_eq!(store.open_session(session("17")).await.unwrap(), Opened::Yes);
    let exploring = NewSession { trial: Some(NewTrial::plain(7, 1)), ..session("explores") };
    let all = (0..MANY).map(|n| session(&n.to_string())).chain([exploring]);
    let opened = join_all(all.map(|session| store.open_session(session))).await;
    for (n, opened) in opened.into_iter().enumerate() {
        match n {
            17 => assert!(opened.is_err(), "there is one with its id"),
            MANY => assert_eq!(opened.unwrap(), Opened::NoLearner),
            _ => assert_eq!(opened.unwrap(), Opened::Yes),
        }
    }
    assert_eq!(store.session("explores").await.unwrap(), None);
    for n in 0..MANY {
        let new = NewObservations {
            session_id: n.to_string(),
            owner: Owner::FIRST,
            seq: 0,
            n_states: 1,
            states: "[1]".to_owned(),
            at: Timestamp::UNIX_EPOCH,
            service_time: None,
            steps: None,
        };
        assert_eq!(store.append_observations(new).await.unwrap(), Ok(()), "{n}");
        let row = store.session(&n.to_string()).await.unwrap().unwrap();
        assert_eq!((row.model.as_str(), row.n_observations, row.lookahead), ("m", 1, None));
    }
}

/// Those of a group are ended together, with their last observations; one that cannot be is refused alone.
#[tokio::test]
async fn sessions_that_are_ended_together_are_as_if_each_had_ended_alone() {
    const MANY: usize = 40;
    const UNKNOWN: usize = 3;
    const TAKEN: usize = 17;
    const NOT_NEXT: usize = 23;
    let at = Timestamp::UNIX_EPOCH;
    let end = |n: usize| SessionEnd {
        session_id: n.to_string(),
        owner: Owner::FIRST,
        last: (n % 2 == 1).then(|| NewObservations {
            session_id: n.to_string(),
            owner: Owner::FIRST,
            seq: u32::from(n == NOT_NEXT),
            n_states: 2,
            states: "[1, 2]".to_owned(),
            at,
            service_time: None,
            steps: None,
        }),
        policy: policy(&format!("of {n}"), 0).policies.remove(0),
        refinement: None,
    };
    for are_refused in [false, true] {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path()).await;
        for n in (0..MANY).filter(|n| !are_refused || *n != UNKNOWN) {
            assert_eq!(store.open_session(NewSession::plain(&n.to_string(), at)).await.unwrap(), Opened::Yes);
        }
        if are_refused {
            assert!(matches!(store.take_session(&TAKEN.to_string(), at).await.unwrap(), Taken::Open(_)));
        }
        let wanted = (0..MANY).filter(|n| are_refused || *n != NOT_NEXT);
        let ended = join_all(wanted.clone().map(|n| store.end_session(end(n)))).await;
        // As after a kill: what has arrived is known from the disk alone.
        let store = open(directory.path()).await;
        for (n, ended) in wanted.zip(ended) {
            let expected = match n {
                UNKNOWN if are_refused => Err(SessionRefusal::NotOpen),
                TAKEN if are_refused => Err(SessionRefusal::Superseded),
                NOT_NEXT => Err(SessionRefusal::NotNext),
                _ => Ok(()),
            };
            assert_eq!(ended.unwrap(), expected, "{n}");
            let row = store.session(&n.to_string()).await.unwrap();
            let query =
                sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM policies WHERE id = $1)").bind(format!("of {n}"));
            let has_policy: bool = query.fetch_one(&mut *store.reader().await.unwrap()).await.unwrap();
            assert_eq!(has_policy, expected.is_ok(), "{n}");
            let Some(row) = row else { continue };
            let n_observations = if has_policy && n % 2 == 1 { 2 } else { 0 };
            assert_eq!((row.status == SessionStatus::Done, row.n_observations), (has_policy, n_observations), "{n}");
        }
    }
}

/// Another process stands for another server: what this one knows in memory must not count.
#[tokio::test]
async fn an_owner_that_another_process_has_superseded_adds_and_ends_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let stores = [open(directory.path()).await, open(directory.path()).await];
    let session = NewSession::plain("s", Timestamp::UNIX_EPOCH);
    assert_eq!(stores[0].open_session(session).await.unwrap(), Opened::Yes);
    let at = Timestamp::UNIX_EPOCH;
    let new = |owner, seq| {
        let states = "[1]".to_owned();
        NewObservations {
            session_id: "s".to_owned(),
            owner,
            seq,
            n_states: 1,
            states,
            at,
            service_time: None,
            steps: None,
        }
    };
    assert_eq!(stores[0].append_observations(new(Owner::FIRST, 0)).await.unwrap(), Ok(()));
    let Taken::Open(taken) = stores[1].take_session("s", at).await.unwrap() else { panic!("it is open") };
    assert_eq!(taken.n_observations, 1);
    assert_eq!(stores[0].append_observations(new(Owner::FIRST, 1)).await.unwrap(), Err(SessionRefusal::Superseded));
    let policy = policy("p", 0).policies.remove(0);
    let end = |owner| {
        let (session_id, policy) = ("s".to_owned(), policy.clone());
        SessionEnd { session_id, owner, last: None, policy, refinement: None }
    };
    assert_eq!(stores[0].end_session(end(Owner::FIRST)).await.unwrap(), Err(SessionRefusal::Superseded));
    assert_eq!(stores[1].append_observations(new(taken.owner, 1)).await.unwrap(), Ok(()));
    assert_eq!(stores[1].end_session(end(taken.owner)).await.unwrap(), Ok(()));
    assert_eq!(stores[0].append_observations(new(taken.owner, 2)).await.unwrap(), Err(SessionRefusal::NotOpen));
}

#[tokio::test]
async fn a_commit_leaves_it_to_others_to_copy_the_log() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let n_bytes = || fs::metadata(directory.path().join("etude.db")).unwrap().len();
    // As long as nobody else can.
    let mut taken = Vec::new();
    for _ in 0..N_READERS {
        taken.push(store.reader().await.unwrap());
    }
    store.writer.add_policies(policy("a", CHECKPOINT_BYTES)).await.unwrap();
    store.writer.add_policies(policy("b", 0)).await.unwrap();
    assert!(n_bytes() < CHECKPOINT_BYTES as u64);
    taken.clear();
    while n_bytes() < CHECKPOINT_BYTES as u64 {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn the_log_begins_anew_once_it_was_copied() {
    const N_ROUNDS: u64 = 16;
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let n_bytes = |name: &str| fs::metadata(directory.path().join(name)).unwrap().len();
    for round in 1..=N_ROUNDS {
        store.writer.add_policies(policy(&format!("{round}"), CHECKPOINT_BYTES)).await.unwrap();
        let mut n = 0;
        while n_bytes("etude.db") < round * CHECKPOINT_BYTES as u64 || n < 20 {
            store.writer.add_policies(policy(&format!("{round}, {n}"), 0)).await.unwrap();
            n += 1;
        }
    }
    let n_logged = n_bytes("etude.db-wal");
    assert!(n_logged < N_ROUNDS * CHECKPOINT_BYTES as u64 / 2, "{n_logged}");
}

#[tokio::test]
async fn copying_the_log_is_no_writing_by_others() {
    let directory = tempfile::tempdir().unwrap();
    let store = open(directory.path()).await;
    let version = "SELECT data_version FROM pragma_data_version";
    let mut connection = store.reader().await.unwrap();
    let before: i64 = sqlx::query_scalar(version).fetch_one(&mut *connection).await.unwrap();
    store.readers.checkpoint().await.unwrap();
    assert_eq!(sqlx::query_scalar::<_, i64>(version).fetch_one(&mut *connection).await.unwrap(), before);
}
