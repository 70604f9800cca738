//! Observations of sessions: who may add them, and how they come to their table.

use std::collections::HashSet;

use jiff::Timestamp;
use serde_json::{Value, json};
use sqlx::SqliteConnection;

use super::StoreError;

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
}

/// What is known of an open session.
#[derive(Clone, Copy, Debug)]
pub(super) struct OpenSession {
    pub(super) owner: Owner,
    pub(super) n_observations: u32,
}

/// The open ones among the sessions with these ids (JSON: an array), with how many observations their table has of each.
pub(super) async fn find_open(
    connection: &mut SqliteConnection,
    ids: &str,
) -> Result<Vec<(String, OpenSession)>, StoreError> {
    let query = sqlx::query_as::<_, (String, u32, u32)>(
        "SELECT id, owner, n_observations FROM sessions
         WHERE status = 'open' AND id IN (SELECT value FROM json_each($1))",
    );
    let open = query.bind(ids).fetch_all(connection).await?.into_iter();
    Ok(open.map(|(id, owner, n_observations)| (id, OpenSession { owner: Owner(owner), n_observations })).collect())
}

/// Adds to the tables of several sessions, each of them once. Gives for each whether it was open and this was what came next. Two
/// statements, however many there are: each one costs the driver a change of threads.
pub(super) async fn add(connection: &mut SqliteConnection, group: &[&Arrived]) -> Result<Vec<bool>, StoreError> {
    let rows =
        group.iter().map(|new| json!([new.session_id, new.seq, new.n_states, new.states, new.at.as_millisecond()]));
    let rows = Value::Array(rows.collect()).to_string();
    // Only what comes next, and only once, whatever is retried or raced.
    let updated = sqlx::query_scalar::<_, String>(
        "UPDATE sessions
         SET n_observations = n_observations + (new.value ->> 2), active_at_ms = MAX(active_at_ms, new.value ->> 4)
         FROM json_each($1) AS new
         WHERE sessions.id = new.value ->> 0 AND status = 'open' AND n_observations = new.value ->> 1
         RETURNING sessions.id",
    )
    .bind(&rows)
    .fetch_all(&mut *connection)
    .await?;
    let updated: HashSet<String> = updated.into_iter().collect();
    let is_updated: Vec<bool> = group.iter().map(|new| updated.contains(&new.session_id)).collect();
    if updated.is_empty() {
        return Ok(is_updated);
    }
    let rows = if updated.len() == group.len() {
        rows
    } else {
        let rows = group.iter().zip(&is_updated).filter(|(_, is_updated)| **is_updated);
        let rows = rows.map(|(new, _)| json!([new.session_id, new.seq, new.n_states, new.states]));
        Value::Array(rows.collect()).to_string()
    };
    sqlx::query(
        "INSERT INTO observations (session_id, seq, n_states, states)
         SELECT value ->> 0, value ->> 1, value ->> 2, value ->> 3 FROM json_each($1)",
    )
    .bind(rows)
    .execute(connection)
    .await?;
    Ok(is_updated)
}
