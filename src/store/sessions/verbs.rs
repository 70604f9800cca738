//! How the tables of sessions and their observations are written.

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::{ExpiredSession, MAX_EXPIRED_AT_ONCE, NewSession, SessionEnd, Taken, read_session};
use crate::store::alive::{self, Down, NoteAlive};
use crate::store::insertion::insert_rows;
use crate::store::observations::{Owner, SessionRefusal};
use crate::store::policies::{NewPolicy, NewRefinement};
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

    async fn apply(&self, _: &mut Writing<'_>) -> Result<(), StoreError> {
        // Was done before.
        Ok(())
    }
}

impl Verb for TakeSession {
    type Answer = Taken;

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Taken, StoreError> {
        let Self { id, at } = self;
        let in_row = |error: StoreError| error.of_row("sessions", id);
        let taken = sqlx::query(
            "UPDATE sessions SET owner = owner + 1, active_at_ms = MAX(active_at_ms, $2)
             WHERE id = $1 AND status = 'open' RETURNING *",
        );
        let taken = taken.bind(id).bind(at.as_millisecond()).fetch_optional(&mut *writing.connection).await?;
        if let Some(row) = taken {
            let session = read_session(&row).map_err(in_row)?;
            writing.arrivals.taken(id, session.owner, session.n_observations);
            return Ok(Taken::Open(session));
        }
        let query = sqlx::query("SELECT * FROM sessions WHERE id = $1").bind(id);
        let row = query.fetch_optional(&mut *writing.connection).await?;
        row.map_or(Ok(Taken::Unknown), |row| Ok(Taken::Ended(read_session(&row).map_err(in_row)?)))
    }
}

impl Verb for TouchSession {
    type Answer = Result<(), SessionRefusal>;

    /// Observations that came before but are not settled yet do not undo it.
    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Result<(), SessionRefusal>, StoreError> {
        let Self { id, owner, at } = self;
        let updated = sqlx::query(
            "UPDATE sessions SET active_at_ms = MAX(active_at_ms, $3) WHERE id = $1 AND status = 'open' AND owner = $2",
        );
        let updated =
            updated.bind(id).bind(owner.0).bind(at.as_millisecond()).execute(&mut *writing.connection).await?;
        if updated.rows_affected() > 0 { Ok(Ok(())) } else { refusal(writing.connection, id).await.map(Err) }
    }
}

impl Verb for SessionEnd {
    type Answer = Result<(), SessionRefusal>;

    const READS_OBSERVATIONS: bool = true;

    fn n_bytes(&self) -> usize {
        self.policy.n_bytes() + self.refinement.as_ref().map_or(0, NewRefinement::n_bytes)
    }

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<Result<(), SessionRefusal>, StoreError> {
        let NewPolicy { id: policy_id, created_at, .. } = &self.policy;
        let updated = sqlx::query(
            "UPDATE sessions SET status = 'done', policy_id = $3, active_at_ms = $4
             WHERE id = $1 AND status = 'open' AND owner = $2",
        );
        let updated =
            updated.bind(&self.session_id).bind(self.owner.0).bind(policy_id).bind(created_at.as_millisecond());
        if updated.execute(&mut *writing.connection).await?.rows_affected() == 0 {
            return refusal(writing.connection, &self.session_id).await.map(Err);
        }
        writing.arrivals.ended(&self.session_id);
        policies::add(writing.connection, &self.policy).await?;
        if let Some(refinement) = &self.refinement {
            refinements::add(writing.connection, refinement).await?;
        }
        Ok(Ok(()))
    }
}

impl Verb for ExpireSessions {
    type Answer = (Down, Vec<ExpiredSession>);

    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_>) -> Result<(Down, Vec<ExpiredSession>), StoreError> {
        let down = alive::note(writing, self.alive).await?;
        writing.arrivals.expired();
        Ok((down, expire(writing.connection, self.before).await?))
    }
}

/// Why nothing was done: the session is not open, or the caller is not its owner.
async fn refusal(connection: &mut SqliteConnection, id: &str) -> Result<SessionRefusal, StoreError> {
    let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM sessions WHERE id = $1 AND status = 'open')");
    let is_open = query.bind(id).fetch_one(connection).await?;
    Ok(if is_open { SessionRefusal::Superseded } else { SessionRefusal::NotOpen })
}

/// Opens sessions, and the trials of those that explore. Takes one statement for all that do not: whoever opens many at once is not to keep others
/// from being written.
pub(in crate::store) async fn open_all(
    connection: &mut SqliteConnection,
    sessions: &[&NewSession],
) -> Result<Vec<Opened>, StoreError> {
    let explored: Vec<&NewTrial> = sessions.iter().filter_map(|session| session.trial.as_ref()).collect();
    let mut explored = trials::open_all(connection, &explored).await?.into_iter();
    let opened =
        sessions.iter().map(|session| session.trial.as_ref().and_then(|_| explored.next()).unwrap_or(Opened::Yes));
    let opened: Vec<Opened> = opened.collect();
    let new: Vec<&NewSession> = sessions
        .iter()
        .zip(&opened)
        .filter(|(_, opened)| **opened == Opened::Yes)
        .map(|(session, _)| *session)
        .collect();
    insert(connection, &new).await?;
    Ok(opened)
}

async fn insert(connection: &mut SqliteConnection, sessions: &[&NewSession]) -> Result<(), StoreError> {
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
    insert_rows(connection, into, &rows, |mut row, (session, (weights, conditions))| {
        let created_at_ms = session.created_at.as_millisecond();
        row.push_bind(&session.id).push_bind(&session.model).push_bind(&session.model_hash).push_bind(weights);
        row.push_bind(session.lookahead).push_bind(conditions).push_bind(&session.learner);
        row.push_bind(session.weights_version.map(as_integer));
        row.push_bind(session.trial.as_ref().map(|trial| &trial.id));
        row.push("'open'").push_bind(Owner::FIRST.0).push("0").push_bind(created_at_ms).push_bind(created_at_ms);
        row.push_bind(session.lookahead_ms.map(as_integer)).push_bind(&session.observe);
    })
    .await
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
