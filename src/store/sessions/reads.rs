//! What was stored of sessions, read again.

use sqlx::Connection;

use crate::store::observations::{ServiceTime, Times};
use crate::store::{Store, StoreError, corrupt};

impl Store {
    /// How many bytes the observations of a session from `seq` on are, as [`Self::observations`] gives them.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn observations_bytes(&self, session_id: &str, seq: u32) -> Result<u64, StoreError> {
        let arrived = self.settle().await?;
        let query = sqlx::query_scalar(
            "SELECT IFNULL(SUM(octet_length(states)), 0) FROM observations WHERE session_id = $1 AND seq + n_states > $2",
        );
        let stored: i64 = query.bind(session_id).bind(seq).fetch_one(&mut *self.reader().await?).await?;
        let new = arrived.get(session_id).map_or(0, |new| new.states.len());
        Ok(stored.unsigned_abs() + new as u64)
    }

    /// The observations of a session, in order, from the row on that has the observation `seq`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn observations(&self, session_id: &str, seq: u32) -> Result<StoredObservations, StoreError> {
        let mut arrived = self.settle().await?;
        let query = sqlx::query_as(
            "SELECT seq, n_states, states, times FROM observations WHERE session_id = $1 AND seq + n_states > $2 ORDER BY seq",
        );
        let rows: Vec<(u32, u32, String, Option<String>)> =
            query.bind(session_id).bind(seq).fetch_all(&mut *self.reader().await?).await?;
        let mut stored = StoredObservations { first: seq, ..StoredObservations::default() };
        let mut n_stored = None;
        for (seq, n_states, states, times) in rows {
            if n_stored.is_none() {
                stored.first = seq;
            }
            n_stored = Some(seq + n_states);
            stored.texts.push(states);
            let times = times.map_or(Ok(Times::new()), |times| serde_json::from_str(&times));
            stored.times.extend(times.map_err(corrupt("observations", "times"))?);
        }
        // What was settled since it was read is stored already.
        let new = arrived.remove(session_id).filter(|new| n_stored.is_none_or(|n_stored| new.seq == n_stored));
        if let Some(new) = new.filter(|new| new.n_states > 0 && new.seq + new.n_states > seq) {
            if n_stored.is_none() {
                stored.first = new.seq;
            }
            stored.texts.push(new.states);
            stored.times.extend(new.times);
        }
        Ok(stored)
    }

    /// How many bytes the stored steps of a session are, as [`Self::steps`] gives them.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn steps_bytes(&self, session_id: &str) -> Result<u64, StoreError> {
        self.settle().await?;
        let query = sqlx::query_scalar("SELECT IFNULL(SUM(octet_length(steps)), 0) FROM steps WHERE session_id = $1");
        let stored: i64 = query.bind(session_id).fetch_one(&mut *self.reader().await?).await?;
        Ok(stored.unsigned_abs())
    }

    /// The steps of a session that are stored, in order, as they were added, and what its mapping goes on from after them; `None` if none
    /// are. Where nothing can be written now, those that have arrived last may be left out: they follow from the others.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn steps(&self, session_id: &str) -> Result<Option<StoredSteps>, StoreError> {
        self.settle().await?;
        let mut reader = self.reader().await?;
        // What is settled in between is not seen.
        let mut transaction = reader.begin().await?;
        let query = sqlx::query_scalar("SELECT root FROM roots WHERE session_id = $1").bind(session_id);
        let Some(root) = query.fetch_optional(&mut *transaction).await? else { return Ok(None) };
        let query = sqlx::query_scalar("SELECT steps FROM steps WHERE session_id = $1 ORDER BY first_step");
        let steps = query.bind(session_id).fetch_all(&mut *transaction).await?;
        Ok(Some(StoredSteps { steps, root }))
    }
}

/// Steps of a session, as they are stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredSteps {
    /// The steps, in short, as they were added.
    pub steps: Vec<Vec<u8>>,
    /// What the mapping goes on from after them.
    pub root: Vec<u8>,
}

/// Observations of a session, as they are stored.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoredObservations {
    /// JSON: arrays of states, one after the other.
    pub texts: Vec<String>,
    /// The index of the first state.
    pub first: u32,
    /// From which observation on they came when, as far as that is kept.
    pub times: Vec<(u32, ServiceTime)>,
}
