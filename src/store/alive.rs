//! When the service was last known to be alive.
//!
//! Sessions expire once nothing has come for them for too long. Time in which nothing could come, because the service was stopped,
//! suspended, or could not write, does not count: whoever notes that it is alive finds when that was done last, and moves the open
//! sessions on by what was between. The service's own time, in which steps wait for observations, is that of the day less all of it.

use std::time::Duration;

use jiff::Timestamp;

use super::writer::{Verb, Writing};
use super::{StoreError, as_integer};

/// Notes a sign of life.
#[derive(Clone, Copy, Debug)]
pub(super) struct NoteAlive {
    /// When.
    pub(super) now: Timestamp,
    /// How often signs of life come at least. If twice this time passes without any, the service was not alive meanwhile.
    pub(super) every: Duration,
}

/// For how long the service was not alive, in all since its database was made, in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Down(pub(super) i64);

impl Verb for NoteAlive {
    type Answer = Down;

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Down, StoreError> {
        note(writing, *self).await
    }
}

/// Notes a sign of life, once everything has arrived in its table. The first one since the service was started, or since something
/// could not be written, ends a time without service in any case.
pub(super) async fn note(
    writing: &mut Writing<'_, '_>,
    NoteAlive { now, every }: NoteAlive,
) -> Result<Down, StoreError> {
    writing.effects.has_noted_life = true;
    let was_interrupted = writing.was_interrupted;
    let connection = writing.connection().await?;
    let now_ms = now.as_millisecond();
    // What came for a session is a sign of life too.
    let query = sqlx::query_scalar(
        "SELECT MAX(at_ms) FROM
             (SELECT last_alive_ms AS at_ms FROM service
              UNION ALL SELECT MAX(active_at_ms) FROM sessions INDEXED BY sessions_by_activity WHERE status = 'open')",
    );
    let last_ms: Option<i64> = query.fetch_one(&mut *connection).await?;
    let gap_ms = last_ms.map_or(0, |last_ms| now_ms.saturating_sub(last_ms));
    let usual_ms = as_integer(u64::try_from(every.as_millis()).unwrap_or(u64::MAX)).saturating_mul(2);
    let was_down = gap_ms > 0 && (was_interrupted || gap_ms > usual_ms);
    if was_down {
        let moved = sqlx::query(
            "UPDATE sessions SET active_at_ms = MIN(active_at_ms + $1, $2) WHERE status = 'open' AND active_at_ms < $2",
        );
        let n_moved = moved.bind(gap_ms).bind(now_ms).execute(&mut *connection).await?.rows_affected();
        if n_moved > 0 {
            tracing::info!(gap_ms, n_sessions = n_moved, "time without service does not count for open sessions");
        }
    }
    let noted = sqlx::query_scalar("UPDATE service SET last_alive_ms = $1, down_ms = down_ms + $2 RETURNING down_ms");
    let noted = noted.bind(now_ms).bind(if was_down { gap_ms } else { 0 });
    Ok(Down(noted.fetch_one(connection).await?))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::store::{ExpiredSession, NewObservations, NewSession, Opened, Owner, Store, StoredObservations};

    const IDLE: Duration = Duration::from_hours(1);
    const EVERY: Duration = Duration::from_mins(6);

    fn at(minute: i64) -> Timestamp {
        Timestamp::from_second(1_000_000 + 60 * minute).unwrap()
    }

    /// A service that begins at this minute.
    async fn begin(directory: &Path, minute: i64) -> (Store, TaskTracker) {
        let tasks = TaskTracker::new();
        let store = Store::open(&directory.join("etude.db"), &tasks).await.unwrap();
        store.note_alive(at(minute), EVERY).await.unwrap();
        (store, tasks)
    }

    async fn end((store, tasks): (Store, TaskTracker)) {
        store.close().await;
        tasks.close();
        tasks.wait().await;
    }

    async fn open(store: &Store, id: &str, minute: i64) {
        let session = NewSession::plain(id, at(minute));
        assert_eq!(store.open_session(session).await.unwrap(), Opened::Yes);
    }

    async fn observe(store: &Store, id: &str, minute: i64) {
        let states = "[1,2,3]".to_owned();
        let new = NewObservations {
            session_id: id.to_owned(),
            owner: Owner::FIRST,
            seq: 0,
            n_states: 3,
            states,
            at: at(minute),
            service_time: None,
            steps: None,
        };
        assert_eq!(store.append_observations(new).await.unwrap(), Ok(()));
    }

    /// The sessions that expire at this minute.
    async fn expired(store: &Store, minute: i64) -> Vec<ExpiredSession> {
        store.expire_sessions(at(minute), IDLE, EVERY).await.unwrap()
    }

    async fn last_minute(store: &Store, id: &str) -> i64 {
        let session = store.session(id).await.unwrap().unwrap();
        (session.active_at.as_second() - 1_000_000) / 60
    }

    #[tokio::test]
    async fn time_in_which_the_service_is_down_does_not_count_for_sessions() {
        let directory = tempfile::tempdir().unwrap();
        let service = begin(directory.path(), 0).await;
        open(&service.0, "idle", 0).await;
        open(&service.0, "observed", 0).await;
        // It only arrives, and is not settled yet.
        observe(&service.0, "observed", 30).await;
        service.0.note_alive(at(40), EVERY).await.unwrap();
        end(service).await;
        // Idle for 40 minutes and for 10 when the service went down, for a day.
        let day = 24 * 60;
        let (store, tasks) = begin(directory.path(), 40 + day).await;
        assert_eq!((last_minute(&store, "idle").await, last_minute(&store, "observed").await), (day, 30 + day));
        assert_eq!(expired(&store, day + 45).await, []);
        let gone = ExpiredSession { id: "idle".to_owned(), active_at: at(day), n_observations: 0 };
        // Signs of life have come in between.
        for minute in (50..60).step_by(5) {
            assert_eq!(expired(&store, day + minute).await, []);
        }
        assert_eq!(expired(&store, day + 61).await, [gone]);
        for minute in (65..90).step_by(5) {
            assert_eq!(expired(&store, day + minute).await, []);
        }
        let gone = ExpiredSession { id: "observed".to_owned(), active_at: at(day + 30), n_observations: 3 };
        assert_eq!(expired(&store, day + 91).await, [gone]);
        assert_eq!(store.observations("observed", 0).await.unwrap(), StoredObservations::default());
        end((store, tasks)).await;
    }

    #[tokio::test]
    async fn time_in_which_the_service_is_suspended_or_was_killed_does_not_count_either() {
        let directory = tempfile::tempdir().unwrap();
        let (store, tasks) = begin(directory.path(), 0).await;
        open(&store, "a", 0).await;
        observe(&store, "a", 10).await;
        // Nothing for hours, though signs of life come every six minutes.
        assert_eq!(expired(&store, 500).await, []);
        assert_eq!(last_minute(&store, "a").await, 500);
        // Killed: the last sign of life is that something came for a session.
        open(&store, "b", 505).await;
        drop(store);
        tasks.close();
        tasks.wait().await;
        let (store, tasks) = begin(directory.path(), 1000).await;
        assert_eq!((last_minute(&store, "a").await, last_minute(&store, "b").await), (995, 1000));
        assert_eq!(expired(&store, 1005).await, []);
        end((store, tasks)).await;
    }
}
