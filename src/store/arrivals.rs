//! Observations on their way into their table.
//!
//! An observation is acknowledged once it is on disk; in which table it stands there matters only to who reads it. The
//! tables keep the observations of each session together, so that a hundred sessions lie on a hundred pages, all of which a
//! commit would have to write. So a commit adds one row to `arrivals`, with all that came in its group, and now and then
//! everything there moves on at once: the pages of a session are written once for many of its observations.
//!
//! ```text
//! group --accept--> arrivals (one row a commit: durable) --settle, now and then or before a read--> sessions, observations
//! ```
//!
//! How many observations a session has, and what is in `arrivals`, is known from memory meanwhile. That holds as long as nobody else
//! writes to the database, of which SQLite tells: then everything is read and settled, and what was known is forgotten.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fmt::Write;

use serde::Deserialize;
use serde_json::value::RawValue;
use sqlx::{Row, SqliteConnection};

use super::observations::{self, Arrived, NewObservations, OpenSession, Owner, ServiceTime, SessionRefusal};
use super::statements::Statements;
use super::{StoreError, corrupt};

/// Once `arrivals` has more bytes than this, they are settled with the next commit. A larger table would save little, and settling it would
/// take longer.
const MAX_BYTES: usize = 1 << 20;

/// What the writer knows of open sessions and of the table `arrivals`.
#[derive(Debug, Default)]
pub(super) struct Arrivals {
    /// Open sessions, by id: who owns them and how many observations they have, those in `arrivals` included. Every open session with
    /// observations in `arrivals` is among them.
    open: HashMap<String, OpenSession>,
    /// What is in the table, by session.
    arrived: BTreeMap<String, Arrived>,
    /// Size of the table.
    n_bytes: usize,
    /// SQLite's number that changes when others write (`data_version`). `None` if nothing is known, neither of sessions nor of the table.
    data_version: Option<i64>,
}

/// Observations that come next in their sessions.
#[derive(Debug)]
pub(super) struct Accepted {
    /// For each of the group, whether it is accepted.
    pub(super) answers: Vec<Result<(), SessionRefusal>>,
    /// The row with the accepted ones; `None` if there are none.
    row: Option<String>,
    /// Their steps, if there are any.
    steps: Option<Vec<u8>>,
}

impl Accepted {
    fn n_bytes(&self) -> usize {
        self.row.as_ref().map_or(0, String::len) + self.steps.as_ref().map_or(0, Vec::len)
    }
}

impl Arrivals {
    /// Whether it is known what the database holds.
    pub(super) fn is_known(&self) -> bool {
        self.data_version.is_some()
    }

    /// SQLite's number that changes when others write, if anything is known.
    pub(super) fn data_version(&self) -> Option<i64> {
        self.data_version
    }

    /// Whether it is time to settle.
    pub(super) fn is_full(&self) -> bool {
        self.n_bytes >= MAX_BYTES
    }

    /// Whether something is known to be there.
    pub(super) fn is_empty(&self) -> bool {
        self.n_bytes == 0
    }

    /// Forgets everything: after a failure, or when others have written, the content of the database is unknown.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Forgets everything if others have written since; within a transaction that writes.
    pub(super) async fn check(&mut self, statements: &mut Statements<'_>) -> Result<(), StoreError> {
        if self.is_known() && self.data_version != Some(data_version(statements).await?) {
            self.forget();
        }
        Ok(())
    }

    /// Takes those of `group` that come next in open sessions, from their owners.
    pub(super) async fn accept(
        &mut self,
        statements: &mut Statements<'_>,
        group: &[&NewObservations],
    ) -> Result<Accepted, StoreError> {
        let ids = group.iter().map(|new| &new.session_id);
        let unknown: HashSet<_> = ids.filter(|id| !self.open.contains_key(*id)).collect();
        if !unknown.is_empty() {
            let ids = serde_json::to_string(&unknown).map_err(corrupt("sessions", "id"))?;
            self.open.extend(observations::find_open(statements.connection().await?, &ids).await?);
        }
        let mut row = String::new();
        let mut answers = Vec::with_capacity(group.len());
        let mut steps = Vec::new();
        for new in group {
            let answer = self.accept_one(new);
            answers.push(answer);
            if answer.is_err() {
                continue;
            }
            let NewObservations { session_id, seq, n_states, states, at, service_time, steps: committed, .. } = new;
            let id = serde_json::to_string(session_id).map_err(corrupt("sessions", "id"))?;
            let separator = if row.is_empty() { '[' } else { ',' };
            let written = write!(row, "{separator}[{id},{seq},{n_states},{states},{}", at.as_millisecond());
            let written = written.and_then(|()| match service_time {
                Some(ServiceTime(ms)) => write!(row, ",{ms}]"),
                None => write!(row, "]"),
            });
            written.expect("a string takes all that is written to it");
            steps.extend(committed.as_ref().map(|committed| (session_id, committed)));
        }
        if !row.is_empty() {
            row.push(']');
        }
        let steps = (!steps.is_empty()).then(|| postcard::to_allocvec(&steps));
        let steps = steps.transpose().map_err(corrupt("arrivals", "steps"))?;
        Ok(Accepted { answers, row: Some(row).filter(|row| !row.is_empty()), steps })
    }

    fn accept_one(&mut self, new: &NewObservations) -> Result<(), SessionRefusal> {
        let session = self.open.get_mut(&new.session_id).ok_or(SessionRefusal::NotOpen)?;
        if session.owner != new.owner {
            return Err(SessionRefusal::Superseded);
        }
        if session.n_observations != new.seq {
            return Err(SessionRefusal::NotNext);
        }
        session.n_observations += new.n_states;
        Ok(())
    }

    /// Adds the row with the accepted observations of `group` by one statement without a transaction; durable when this returns. Says whether it was
    /// added; it was not if others have written meanwhile.
    pub(super) async fn add_at_once(
        &mut self,
        connection: &mut SqliteConnection,
        group: &[&NewObservations],
        accepted: &Accepted,
    ) -> Result<bool, StoreError> {
        let Some(row) = &accepted.row else { return Ok(true) };
        // The driver changes threads for each statement, and again for BEGIN and COMMIT.
        let added = sqlx::query(
            "INSERT INTO arrivals (observations, steps)
             SELECT $1, $3 WHERE (SELECT data_version FROM pragma_data_version) = $2",
        )
        .bind(row)
        .bind(self.data_version)
        .bind(&accepted.steps)
        .execute(connection)
        .await?;
        let is_added = added.rows_affected() == 1;
        if is_added {
            self.note(group, accepted);
        }
        Ok(is_added)
    }

    /// Adds what was accepted of `group`, within a transaction: to where it belongs, with everything before it, if it `are_read` or it is time;
    /// else as a row.
    pub(super) async fn add(
        &mut self,
        statements: &mut Statements<'_>,
        group: &[&NewObservations],
        accepted: &Accepted,
        are_read: bool,
    ) -> Result<(), StoreError> {
        self.note(group, accepted);
        if are_read || self.is_full() {
            return self.settle(statements).await;
        }
        if let Some(row) = &accepted.row {
            statements.add("INSERT INTO arrivals (observations, steps) VALUES (?, ?)").bind(row).bind(&accepted.steps);
        }
        Ok(())
    }

    /// Notes what was added of `group`.
    fn note(&mut self, group: &[&NewObservations], accepted: &Accepted) {
        self.n_bytes += accepted.n_bytes();
        for (new, _) in group.iter().zip(&accepted.answers).filter(|(_, answer)| answer.is_ok()) {
            if !self.arrived.contains_key(&new.session_id) {
                self.arrived.insert(new.session_id.clone(), Arrived::from(new.session_id.clone(), new.seq));
            }
            if let Some(arrived) = self.arrived.get_mut(&new.session_id) {
                arrived.append(new.n_states, &new.states, new.at, new.service_time);
                arrived.steps.extend(new.steps.clone());
            }
        }
    }

    /// Moves everything to where it belongs, within a transaction.
    pub(super) async fn settle(&mut self, statements: &mut Statements<'_>) -> Result<(), StoreError> {
        let arrived = if self.is_known() {
            std::mem::take(&mut self.arrived)
        } else {
            read(statements.connection().await?).await?
        };
        if !arrived.is_empty() {
            let settled: Vec<&Arrived> = arrived.values().collect();
            let was_next = observations::add(statements, &settled).await?;
            for (new, _) in settled.iter().zip(was_next).filter(|(_, was_next)| !was_next) {
                refused(&new.session_id, new.seq);
            }
            statements.add("DELETE FROM arrivals");
        }
        self.n_bytes = 0;
        if self.data_version.is_none() {
            self.data_version = Some(data_version(statements).await?);
        }
        Ok(())
    }

    /// A session was opened.
    pub(super) fn opened(&mut self, session_id: &str) {
        self.taken(session_id, Owner::FIRST, 0);
    }

    /// A session has a new owner, once everything was settled.
    pub(super) fn taken(&mut self, session_id: &str, owner: Owner, n_observations: u32) {
        if self.is_known() {
            self.open.insert(session_id.to_owned(), OpenSession { owner, n_observations });
        }
    }

    /// A session was ended. What it has in the table is settled with the rest.
    pub(super) fn ended(&mut self, session_id: &str) {
        self.open.remove(session_id);
    }

    /// Some sessions have expired, once everything was settled.
    pub(super) fn expired(&mut self) {
        self.open.clear();
    }
}

/// What has arrived and is not settled, by session.
pub(super) async fn read(reader: &mut SqliteConnection) -> Result<BTreeMap<String, Arrived>, StoreError> {
    together(&sqlx::query_as(ROWS).fetch_all(reader).await?)
}

/// Changes when another connection has written.
async fn data_version(statements: &mut Statements<'_>) -> Result<i64, StoreError> {
    statements.add("SELECT data_version FROM pragma_data_version");
    Ok(statements.fetch().await?.ok_or(sqlx::Error::RowNotFound)?.try_get(0)?)
}

/// An item of a row of `arrivals`.
#[derive(Deserialize)]
struct Arrival<'r>(String, u32, u32, #[serde(borrow)] &'r RawValue, i64, #[serde(default)] Option<ServiceTime>);

/// A row of `arrivals`.
type ArrivalsRow = (String, Option<Vec<u8>>);

const ROWS: &str = "SELECT observations, steps FROM arrivals ORDER BY sequence";

/// Reads rows, and puts what belongs to the same session together, in order.
fn together(rows: &[ArrivalsRow]) -> Result<BTreeMap<String, Arrived>, StoreError> {
    const TABLE: &str = "arrivals";
    let mut by_session = BTreeMap::<String, Arrived>::new();
    for (row, steps) in rows {
        let arrivals: Vec<Arrival<'_>> = serde_json::from_str(row).map_err(corrupt(TABLE, "observations"))?;
        for Arrival(session_id, seq, n_states, states, at_ms, service_time) in arrivals {
            let at = super::timestamp(TABLE, "observations", at_ms)?;
            let arrived =
                by_session.entry(session_id).or_insert_with_key(|session_id| Arrived::from(session_id.clone(), seq));
            if arrived.seq + arrived.n_states == seq {
                arrived.append(n_states, states.get(), at, service_time);
            } else {
                refused(&arrived.session_id, seq);
            }
        }
        let steps = steps.as_deref().map_or(Ok(Vec::new()), postcard::from_bytes);
        for (session_id, committed) in steps.map_err(corrupt(TABLE, "steps"))? {
            let session_id: String = session_id;
            if let Some(new) = by_session.get_mut(&session_id) {
                new.steps.push(committed);
            }
        }
    }
    Ok(by_session)
}

/// Accepted observations always come next in their session, unless somebody else has changed the tables.
fn refused(session_id: &str, seq: u32) {
    tracing::error!(session = session_id, seq, "stored observations do not follow on those of their session");
}

#[cfg(test)]
mod tests;
