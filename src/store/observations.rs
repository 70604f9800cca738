//! Observations of sessions: who may add them, and how they come to their table.

use std::collections::HashSet;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sqlx::SqliteConnection;

use super::StoreError;
use super::statements::Statements;

/// Who drives a session: whoever opened it, or has resumed it since. Only the newest one may add to it or end it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Owner(pub(super) u32);

impl Owner {
    /// Whoever opens a session.
    pub const FIRST: Self = Self(1);
}

/// Why nothing was done to a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SessionRefusal {
    /// There is none that is open.
    #[error("the session is not open")]
    NotOpen,
    /// Another one has resumed it since.
    #[error("the session has a newer owner")]
    Superseded,
    /// The observations do not come next.
    #[error("the observations do not come next")]
    NotNext,
}

/// Observations to be added to a session.
#[derive(Clone, Debug)]
pub struct NewObservations {
    /// The session.
    pub session_id: String,
    /// Who adds them.
    pub owner: Owner,
    /// Index of the first of them.
    pub seq: u32,
    /// How many there are.
    pub n_states: u32,
    /// JSON: an array of states.
    pub states: String,
    /// When they came.
    pub at: Timestamp,
    /// The same in the service's own time, where it is to be kept for each of them.
    pub service_time: Option<ServiceTime>,
    /// Steps that were committed before, and are not stored yet.
    pub steps: Option<NewSteps>,
}

impl NewObservations {
    /// No observations, but steps of a session that has `n_observations`: they do not count as activity.
    #[must_use]
    pub fn none(session_id: String, owner: Owner, n_observations: u32, steps: NewSteps) -> Self {
        let (states, at) = ("[]".to_owned(), Timestamp::UNIX_EPOCH);
        Self { session_id, owner, seq: n_observations, n_states: 0, states, at, service_time: None, steps: Some(steps) }
    }

    /// How many bytes there are to be written, roughly.
    pub(super) fn n_bytes(&self) -> usize {
        self.states.len() + self.steps.as_ref().map_or(0, NewSteps::n_bytes)
    }
}

/// A time of the service's own: milliseconds since 1970, without those in which the service was not alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ServiceTime(pub(super) i64);

impl ServiceTime {
    /// How much later than `earlier` it is; nothing if it is not.
    #[must_use]
    pub fn since(self, earlier: Self) -> Duration {
        Duration::from_millis(u64::try_from(self.0.saturating_sub(earlier.0)).unwrap_or(0))
    }
}

/// Steps that a session has committed, one after the other, and what its mapping goes on from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NewSteps {
    /// The number of the first of them.
    pub first: u32,
    /// The steps, in short.
    pub steps: Vec<u8>,
    /// What the mapping goes on from after them.
    pub root: Vec<u8>,
}

impl NewSteps {
    fn n_bytes(&self) -> usize {
        self.steps.len() + self.root.len()
    }
}

/// Observations of a session that have arrived.
#[derive(Debug)]
pub(super) struct Arrived {
    pub(super) session_id: String,
    pub(super) seq: u32,
    pub(super) n_states: u32,
    /// JSON: an array of states.
    pub(super) states: String,
    pub(super) at: Timestamp,
    /// When those came whose times are kept.
    pub(super) times: Times,
    pub(super) steps: Vec<NewSteps>,
}

impl Arrived {
    /// Nothing yet, from `seq` on.
    pub(super) fn from(session_id: String, seq: u32) -> Self {
        let (n_states, states, at) = (0, "[]".to_owned(), Timestamp::UNIX_EPOCH);
        Self { session_id, seq, n_states, states, at, times: Times::new(), steps: Vec::new() }
    }

    /// Appends the observations that come next: `states`, an array.
    pub(super) fn append(&mut self, n_states: u32, states: &str, at: Timestamp, service_time: Option<ServiceTime>) {
        self.times.extend(service_time.map(|time| (self.seq + self.n_states, time)));
        if n_states > 0 {
            self.states.pop();
            if self.n_states > 0 {
                self.states.push(',');
            }
            self.states.push_str(&states[1..]);
        }
        self.n_states += n_states;
        self.at = self.at.max(at);
    }
}

/// From which observation on they came when.
pub(super) type Times = Vec<(u32, ServiceTime)>;

/// What is known of an open session.
#[derive(Clone, Copy, Debug)]
pub(super) struct OpenSession {
    pub(super) owner: Owner,
    pub(super) n_observations: u32,
}

// In these two, the sign before `status` keeps SQLite from going through all open sessions by the index of that, rather than by their ids.

const FIND_OPEN: &str = "SELECT id, owner, n_observations FROM sessions
     WHERE +status = 'open' AND id IN (SELECT value FROM json_each($1))";

/// Only what comes next, and only once, whatever is retried or raced; also to sessions that have ended meanwhile.
const COUNT_NEXT: &str = "UPDATE sessions
     SET n_observations = n_observations + (new.value ->> 2), active_at_ms = MAX(active_at_ms, new.value ->> 3)
     FROM json_each($1) AS new
     WHERE sessions.id = new.value ->> 0 AND +status <> 'expired' AND n_observations = new.value ->> 1
     RETURNING sessions.id";

/// The open ones among the sessions with these ids (JSON: an array), with how many observations their table has of each.
pub(super) async fn find_open(
    connection: &mut SqliteConnection,
    ids: &str,
) -> Result<Vec<(String, OpenSession)>, StoreError> {
    let query = sqlx::query_as::<_, (String, u32, u32)>(FIND_OPEN);
    let open = query.bind(ids).fetch_all(connection).await?.into_iter();
    Ok(open.map(|(id, owner, n_observations)| (id, OpenSession { owner: Owner(owner), n_observations })).collect())
}

/// Adds to the tables of several sessions, each of them once. Gives for each whether it was open and this was what came next. Takes
/// one execution, however many there are; what is inserted waits in `statements`.
pub(super) async fn add(statements: &mut Statements<'_>, group: &[&Arrived]) -> Result<Vec<bool>, StoreError> {
    let rows = group.iter().map(|new| json!([new.session_id, new.seq, new.n_states, new.at.as_millisecond()]));
    let updated = sqlx::query_scalar::<_, String>(COUNT_NEXT)
        .bind(Value::Array(rows.collect()).to_string())
        .fetch_all(statements.connection().await?)
        .await?;
    let updated: HashSet<String> = updated.into_iter().collect();
    let is_updated: Vec<bool> = group.iter().map(|new| updated.contains(&new.session_id)).collect();
    let added = group.iter().zip(&is_updated).filter(|(_, is_updated)| **is_updated).map(|(new, _)| *new);
    let added: Vec<&Arrived> = added.collect();
    let observed: Vec<_> = added.iter().copied().filter(|new| new.n_states > 0).collect();
    let into = "INSERT INTO observations (session_id, seq, n_states, states, times) ";
    statements.insert_rows(into, &observed, |values, new| {
        let times = (!new.times.is_empty()).then(|| json!(new.times).to_string());
        values.bind(&new.session_id).bind(new.seq).bind(new.n_states).bind(&new.states).bind(times);
    });
    let roots: Vec<_> = added.iter().filter_map(|new| Some((&new.session_id, new.steps.last()?))).collect();
    statements.insert_rows("INSERT OR REPLACE INTO roots (session_id, root) ", &roots, |values, (id, new)| {
        values.bind(*id).bind(&new.root);
    });
    let steps = added.iter().flat_map(|new| new.steps.iter().map(|steps| (&new.session_id, steps)));
    let steps: Vec<_> = steps.collect();
    statements.insert_rows("INSERT INTO steps (session_id, first_step, steps) ", &steps, |values, (id, new)| {
        values.bind(*id).bind(new.first).bind(&new.steps);
    });
    Ok(is_updated)
}

#[cfg(test)]
mod tests {
    use sqlx::sqlite::SqliteConnectOptions;
    use sqlx::{ConnectOptions, Row};
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::store::Store;

    /// However many sessions are open, those that are asked for are found by their ids.
    #[tokio::test]
    async fn what_comes_for_a_session_does_not_look_at_the_others_that_are_open() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("etude.db");
        let _store = Store::open(&path, &TaskTracker::new()).await.unwrap();
        let mut connection = SqliteConnectOptions::new().filename(&path).connect().await.unwrap();
        for statement in [FIND_OPEN, COUNT_NEXT] {
            let explain = sqlx::AssertSqlSafe(format!("EXPLAIN QUERY PLAN {statement}"));
            let plan = sqlx::query(explain).bind("[]").fetch_all(&mut connection).await.unwrap();
            let looks: Vec<String> = plan.iter().map(|row| row.get("detail")).collect();
            let by_id = "SEARCH sessions USING INDEX sqlite_autoindex_sessions_1 (id=?)";
            assert!(looks.iter().any(|look| look == by_id), "{looks:?}");
        }
    }
}
