//! How the tables of sessions and their observations are written.

use std::collections::HashSet;

use jiff::Timestamp;
use serde_json::{Value, json};
use sqlx::sqlite::SqliteRow;
use sqlx::{FromRow, Row, SqliteConnection};

use super::{ExpiredSession, MAX_EXPIRED_AT_ONCE, NewSession, SessionEnd, SessionStatus, Taken, read_session};
use crate::store::alive::{self, Down, NoteAlive};
use crate::store::observations::{NewObservations, Owner, SessionRefusal};
use crate::store::policies::{NewPolicy, NewRefinement};
use crate::store::statements::Statements;
use crate::store::trials::{self, Opened};
use crate::store::writer::{Verb, Writing};
use crate::store::{NewTrial, StoreError, as_integer, corrupt, count, policies, refinements, timestamp};

/// Brings observations that have arrived to their table.
#[derive(Debug)]
pub(in crate::store) struct SettleObservations;

/// Makes the caller the owner of a session.
#[derive(Debug)]
pub(super) struct TakeSession {
    pub(super) id: String,
    pub(super) at: Timestamp,
}

/// Notes that something came for a session.
#[derive(Debug)]
pub(super) struct TouchSession {
    pub(super) id: String,
    pub(super) owner: Owner,
    pub(super) at: Timestamp,
}

/// Expires some of the sessions that were last active before a time, after a sign of life.
#[derive(Debug)]
pub(super) struct ExpireSessions {
    pub(super) before: Timestamp,
    pub(super) alive: NoteAlive,
}

impl Verb for SettleObservations {
    type Answer = ();

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, _: &mut Writing<'_, '_>) -> Result<(), StoreError> {
        // Was done before.
        Ok(())
    }
}

impl Verb for TakeSession {
    type Answer = Taken;

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Taken, StoreError> {
        let Self { id, at } = self;
        let in_row = |error: StoreError| error.of_row("sessions", id);
        let taken = writing.statements.add(
            "UPDATE sessions SET owner = owner + 1, active_at_ms = MAX(active_at_ms, ?)
             WHERE id = ? AND status = 'open' RETURNING *",
        );
        taken.bind(at.as_millisecond()).bind(id);
        let taken = writing.statements.fetch().await?;
        if let Some(row) = taken {
            let session = read_session(&row).map_err(in_row)?;
            writing.arrivals.taken(id, session.owner, session.n_observations);
            return Ok(Taken::Open(session));
        }
        let query = sqlx::query("SELECT * FROM sessions WHERE id = $1").bind(id);
        let row = query.fetch_optional(writing.connection().await?).await?;
        row.map_or(Ok(Taken::Unknown), |row| Ok(Taken::Ended(read_session(&row).map_err(in_row)?)))
    }
}

impl Verb for TouchSession {
    type Answer = Result<(), SessionRefusal>;

    /// Observations that came before but are not settled yet do not undo it.
    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Result<(), SessionRefusal>, StoreError> {
        let Self { id, owner, at } = self;
        let updated = writing.statements.add(
            "UPDATE sessions SET active_at_ms = MAX(active_at_ms, ?) WHERE id = ? AND status = 'open' AND owner = ?
             RETURNING id",
        );
        updated.bind(at.as_millisecond()).bind(id).bind(owner.0);
        if writing.statements.fetch().await?.is_some() {
            return Ok(Ok(()));
        }
        refusal(writing.connection().await?, id).await.map(Err)
    }
}

impl Verb for ExpireSessions {
    type Answer = (Down, Vec<ExpiredSession>);

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<(Down, Vec<ExpiredSession>), StoreError> {
        let down = alive::note(writing, self.alive).await?;
        writing.arrivals.expired();
        Ok((down, expire(writing.connection().await?, self.before).await?))
    }
}

/// Why nothing was done: the session is not open, or the caller is not its owner.
pub(in crate::store) async fn refusal(
    connection: &mut SqliteConnection,
    id: &str,
) -> Result<SessionRefusal, StoreError> {
    let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM sessions WHERE id = $1 AND status = 'open')");
    let is_open = query.bind(id).fetch_one(connection).await?;
    Ok(if is_open { SessionRefusal::Superseded } else { SessionRefusal::NotOpen })
}

impl SessionEnd {
    /// How many bytes there are to be written, roughly.
    pub(in crate::store) fn n_bytes(&self) -> usize {
        let Self { last, policy, refinement, .. } = self;
        let n_last = last.as_ref().map_or(0, NewObservations::n_bytes);
        n_last + policy.n_bytes() + refinement.as_ref().map_or(0, NewRefinement::n_bytes)
    }
}

/// Ends sessions, and adds their policies. Gives for each whether it was open, and the caller its owner; what is inserted waits in `statements`.
/// Does nothing if others have written since the `data_version` that is given.
pub(in crate::store) async fn end_all(
    statements: &mut Statements<'_>,
    ends: &[&SessionEnd],
    data_version: Option<i64>,
) -> Result<Vec<bool>, StoreError> {
    // The sign before `status` is explained where observations are counted.
    let ended = statements.add(
        "UPDATE sessions SET status = 'done', policy_id = new.value ->> 2, active_at_ms = new.value ->> 3
         FROM json_each(?) AS new
         WHERE sessions.id = new.value ->> 0 AND +status = 'open' AND owner = new.value ->> 1
             AND IFNULL((SELECT data_version FROM pragma_data_version) = ?, TRUE)
         RETURNING sessions.id, sessions.owner",
    );
    let row = |end: &&SessionEnd| {
        let NewPolicy { id, created_at, .. } = &end.policy;
        json!([end.session_id, end.owner.0, id, created_at.as_millisecond()])
    };
    ended.bind(Value::Array(ends.iter().map(row).collect()).to_string()).bind(data_version);
    let ended = statements.fetch_all().await?;
    let ended = ended.iter().map(<(String, u32)>::from_row).collect::<Result<HashSet<_>, _>>()?;
    let has_ended = |end: &SessionEnd| ended.contains(&(end.session_id.clone(), end.owner.0));
    let have_ended: Vec<bool> = ends.iter().map(|end| has_ended(end)).collect();
    let ended: Vec<&SessionEnd> = ends.iter().copied().filter(|end| has_ended(end)).collect();
    let policies: Vec<&NewPolicy> = ended.iter().map(|end| &end.policy).collect();
    policies::add_all(statements, &policies).await?;
    for refinement in ended.iter().filter_map(|end| end.refinement.as_ref()) {
        refinements::add(statements, refinement);
    }
    Ok(have_ended)
}

/// Opens sessions, and the trials of those that explore. Takes one statement for all that do not: whoever opens many at once is not to keep others
/// from being written.
pub(in crate::store) async fn open_all(
    statements: &mut Statements<'_>,
    sessions: &[&NewSession],
) -> Result<Vec<Opened>, StoreError> {
    let explored: Vec<&NewTrial> = sessions.iter().filter_map(|session| session.trial.as_ref()).collect();
    let mut explored = trials::open_all(statements, &explored).await?.into_iter();
    let opened =
        sessions.iter().map(|session| session.trial.as_ref().and_then(|_| explored.next()).unwrap_or(Opened::Yes));
    let opened: Vec<Opened> = opened.collect();
    let new: Vec<&NewSession> = sessions
        .iter()
        .zip(&opened)
        .filter(|(_, opened)| **opened == Opened::Yes)
        .map(|(session, _)| *session)
        .collect();
    insert(statements, &new)?;
    Ok(opened)
}

fn insert(statements: &mut Statements<'_>, sessions: &[&NewSession]) -> Result<(), StoreError> {
    let in_json = |session: &&NewSession| {
        let weights = serde_json::to_string(&session.weights).map_err(corrupt("sessions", "weights"))?;
        let conditions = serde_json::to_string(&session.conditions).map_err(corrupt("sessions", "conditions"))?;
        Ok((weights, conditions))
    };
    let in_json = sessions.iter().map(in_json).collect::<Result<Vec<_>, StoreError>>()?;
    let rows: Vec<_> = sessions.iter().zip(in_json).collect();
    let into = "INSERT INTO sessions
        (id, model, model_hash, weights, lookahead, conditions, learner, weights_version, trial_id,
         status, owner, n_observations, created_at_ms, active_at_ms, lookahead_ms, observe) ";
    statements.insert_rows(into, &rows, |values, (session, (weights, conditions))| {
        let created_at_ms = session.created_at.as_millisecond();
        values.bind(&session.id).bind(&session.model).bind(&session.model_hash).bind(weights).bind(session.lookahead);
        values.bind(conditions).bind(&session.learner).bind(session.weights_version.map(as_integer));
        values.bind(session.trial.as_ref().map(|trial| &trial.id)).bind(SessionStatus::Open.name());
        values.bind(Owner::FIRST.0).bind(0).bind(created_at_ms).bind(created_at_ms);
        values.bind(session.lookahead_ms.map(as_integer)).bind(&session.observe);
    });
    Ok(())
}

async fn expire(connection: &mut SqliteConnection, before: Timestamp) -> Result<Vec<ExpiredSession>, StoreError> {
    let query = sqlx::query(
        "SELECT id, active_at_ms, n_observations FROM sessions INDEXED BY sessions_by_activity
         WHERE status = 'open' AND active_at_ms < $1 ORDER BY active_at_ms LIMIT $2",
    );
    let query = query.bind(before.as_millisecond()).bind(as_integer(MAX_EXPIRED_AT_ONCE as u64));
    let read = |row: &SqliteRow| {
        Ok(ExpiredSession {
            id: row.try_get("id")?,
            active_at: timestamp("sessions", "active_at_ms", row.try_get("active_at_ms")?)?,
            n_observations: u32::try_from(count(row, "sessions", "n_observations")?).unwrap_or(u32::MAX),
        })
    };
    let rows = query.fetch_all(&mut *connection).await?;
    let expired = rows.iter().map(read).collect::<Result<Vec<_>, StoreError>>()?;
    if expired.is_empty() {
        return Ok(expired);
    }
    let ids: Vec<&str> = expired.iter().map(|session| session.id.as_str()).collect();
    let ids = serde_json::to_string(&ids).map_err(corrupt("sessions", "id"))?;
    for query in [
        "DELETE FROM observations WHERE session_id IN (SELECT value FROM json_each($1))",
        "DELETE FROM steps WHERE session_id IN (SELECT value FROM json_each($1))",
        "DELETE FROM roots WHERE session_id IN (SELECT value FROM json_each($1))",
    ] {
        sqlx::query(query).bind(&ids).execute(&mut *connection).await?;
    }
    sqlx::query("UPDATE sessions SET status = 'expired' WHERE id IN (SELECT value FROM json_each($1))")
        .bind(&ids)
        .execute(connection)
        .await?;
    Ok(expired)
}
