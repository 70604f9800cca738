//! The tables of sessions and their observations.

use std::collections::{BTreeMap, HashSet};
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;
use sqlx::sqlite::SqliteRow;
use sqlx::{Row, SqliteConnection};

use super::alive::Alive;
use super::page::{Rest, Rows};
use super::policies::NewPolicy;
use super::refinements::NewRefinement;
use super::trials::{self, NewTrial};
use super::writer::{Line, Write, Written};
use super::{Page, Store, StoreError, arrivals, as_integer, corrupt, count, policies, refinements, timestamp};
use etude_core::attribute::ByAttribute;

/// How far a session has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SessionStatus {
    /// It takes observations.
    Open,
    /// Its demonstration has ended, and its policy is stored.
    Done,
    /// It was idle for too long.
    Expired,
}

impl SessionStatus {
    /// The status, as in JSON and SQL.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Done => "done",
            Self::Expired => "expired",
        }
    }

    fn named(name: &str) -> Option<Self> {
        [Self::Open, Self::Done, Self::Expired].into_iter().find(|status| status.name() == name)
    }
}

/// A session, without its observations.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionRow {
    /// The order in which it was opened.
    pub sequence: i64,
    /// Its id.
    pub id: String,
    /// Name of its model.
    pub model: String,
    /// Hash of its model's content.
    pub model_hash: String,
    /// The weights of its distance.
    pub weights: ByAttribute<f64>,
    /// How many observations past the current one a decision may wait for; `None` for all.
    pub lookahead: Option<u32>,
    /// Index of the start state, if the request named one.
    pub start: Option<u32>,
    /// The learner whose weights are used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The trial that is explored, if any.
    pub trial_id: Option<String>,
    /// How far it has come.
    pub status: SessionStatus,
    /// How many observations are stored.
    pub n_observations: u32,
    /// Its policy, if it is done.
    pub policy_id: Option<String>,
    /// When it was opened.
    pub created_at: Timestamp,
    /// When something last came.
    pub active_at: Timestamp,
}

/// A session to be opened.
#[derive(Clone, Debug)]
pub struct NewSession {
    /// Its id, unique.
    pub id: String,
    /// Name of its model.
    pub model: String,
    /// Hash of its model's content.
    pub model_hash: String,
    /// The weights of its distance.
    pub weights: ByAttribute<f64>,
    /// How many observations past the current one a decision may wait for; `None` for all.
    pub lookahead: Option<u32>,
    /// Index of the start state, if the request named one.
    pub start: Option<u32>,
    /// The learner whose weights are used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The trial that is explored, if any.
    pub trial: Option<NewTrial>,
    /// When it is opened.
    pub created_at: Timestamp,
}

/// Observations to be added to a session.
#[derive(Clone, Debug)]
pub struct NewObservations {
    /// The session.
    pub session_id: String,
    /// Index of the first of them.
    pub seq: u32,
    /// How many there are.
    pub n_states: u32,
    /// JSON: an array of states.
    pub states: String,
    /// When they came.
    pub at: Timestamp,
}

/// The end of a session.
#[derive(Clone, Debug)]
pub struct SessionEnd {
    /// The session.
    pub session_id: String,
    /// Its policy.
    pub policy: NewPolicy,
    /// What is to be done about its policy, if that is local.
    pub refinement: Option<NewRefinement>,
}

/// A session that has just expired.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExpiredSession {
    /// Its id.
    pub id: String,
    /// When something last came for it, not counting time without service.
    pub active_at: Timestamp,
    /// How many observations it had.
    pub n_observations: u32,
}

/// Most sessions that expire in one transaction, so that nobody waits long for it.
pub const MAX_EXPIRED_AT_ONCE: usize = 256;

impl Store {
    /// Opens a session, and its trial if it explores. Says whether the trial's learner was there.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn open_session(&self, session: NewSession) -> Result<bool, StoreError> {
        self.done(Write::OpenSession(Box::new(session))).await
    }

    /// Adds observations to an open session, durably. Says whether it was open and they came next.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_observations(&self, observations: NewObservations) -> Result<bool, StoreError> {
        self.done(Write::AddObservations(observations)).await
    }

    /// Notes that something came for a session at `at`. Says whether it is open.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn touch_session(&self, id: &str, at: Timestamp) -> Result<bool, StoreError> {
        self.done(Write::TouchSession { id: id.to_owned(), at }).await
    }

    /// As [`Self::touch_session`], once all that was sent before is written, by whoever sent it and whatever its size.
    ///
    /// # Errors
    ///
    /// Likewise.
    pub async fn touch_session_behind_all(&self, id: &str, at: Timestamp) -> Result<bool, StoreError> {
        let touch = |line| self.writer.write_in(line, Write::TouchSession { id: id.to_owned(), at });
        let (small, large) = tokio::join!(touch(Line::Small), touch(Line::Large));
        Ok([small?, large?].iter().all(|written| matches!(written, Written::Done(true))))
    }

    /// Ends a session: stores its policy and links them. Says whether it was open.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing was stored.
    pub async fn end_session(&self, end: SessionEnd) -> Result<bool, StoreError> {
        self.done(Write::EndSession(Box::new(end))).await
    }

    /// Ends open sessions that were last active longer than `idle` before `now`, and forgets their observations:
    /// [`MAX_EXPIRED_AT_ONCE`] of them, if there are more. Time without service does not count, of which this is a sign, as
    /// [`Self::note_alive`] is.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn expire_sessions(
        &self,
        now: Timestamp,
        idle: Duration,
        every: Duration,
    ) -> Result<Vec<ExpiredSession>, StoreError> {
        let before = now.checked_sub(idle).unwrap_or(Timestamp::MIN);
        match self.writer.write(Write::ExpireSessions { before, alive: Alive { now, every } }).await? {
            Written::ExpireSessions(expired) => Ok(expired),
            _ => Err(StoreError::Closed),
        }
    }

    async fn done(&self, write: Write) -> Result<bool, StoreError> {
        match self.writer.write(write).await? {
            Written::Done(was_done) => Ok(was_done),
            _ => Err(StoreError::Closed),
        }
    }

    /// Brings observations that have arrived to their table, whoever's they are. Where nothing can be written, gives them, by session.
    async fn settle(&self) -> Result<BTreeMap<String, NewObservations>, StoreError> {
        let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM arrivals)");
        if !query.fetch_one(&mut *self.reader().await?).await? {
            return Ok(BTreeMap::new());
        }
        match self.writer.write(Write::Settle).await {
            Err(StoreError::Unavailable(_)) => arrivals::read(&mut *self.reader().await?).await,
            settled => settled.map(|_| BTreeMap::new()),
        }
    }

    /// The session with this id.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn session(&self, id: &str) -> Result<Option<SessionRow>, StoreError> {
        let arrived = self.settle().await?;
        let query = sqlx::query("SELECT * FROM sessions WHERE id = $1").bind(id);
        let row = query.fetch_optional(&mut *self.reader().await?).await?;
        let session = row.as_ref().map(read_session).transpose().map_err(|error| error.of_row("sessions", id))?;
        Ok(session.map(|session| session.with(&arrived)))
    }

    /// At most `limit` sessions in the order in which they were opened, from the first after the sequence number `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn sessions(&self, after: i64, limit: u32) -> Result<Page<SessionRow>, StoreError> {
        let arrived = self.settle().await?;
        let query = sqlx::query("SELECT * FROM sessions WHERE sequence > $1 ORDER BY sequence LIMIT $2");
        let mut reader = self.reader().await?;
        let rows = query.bind(after).bind(i64::from(limit) + 1).fetch(&mut *reader);
        let rows_of = Rows { table: "sessions", key: "sequence", name: "id", long: &["weights"], read: read_session };
        let mut page = rows_of.page(rows, limit, Rest::IsNone).await?;
        page.items = page.items.into_iter().map(|session| session.with(&arrived)).collect();
        Ok(page)
    }

    /// How many bytes the observations of a session are, as [`Self::observations`] gives them.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn observations_bytes(&self, session_id: &str) -> Result<u64, StoreError> {
        let arrived = self.settle().await?;
        let query =
            sqlx::query_scalar("SELECT IFNULL(SUM(octet_length(states)), 0) FROM observations WHERE session_id = $1");
        let stored: i64 = query.bind(session_id).fetch_one(&mut *self.reader().await?).await?;
        let new = arrived.get(session_id).map_or(0, |new| new.states.len());
        Ok(stored.unsigned_abs() + new as u64)
    }

    /// The observations of a session, in order: JSON arrays of states.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn observations(&self, session_id: &str) -> Result<Vec<String>, StoreError> {
        let mut arrived = self.settle().await?;
        let query =
            sqlx::query_as("SELECT seq + n_states, states FROM observations WHERE session_id = $1 ORDER BY seq");
        let stored: Vec<(i64, String)> = query.bind(session_id).fetch_all(&mut *self.reader().await?).await?;
        let n_stored = stored.last().map_or(0, |(end, _)| *end);
        // What was settled since it was read is stored already.
        let new = arrived.remove(session_id).filter(|new| i64::from(new.seq) == n_stored);
        Ok(stored.into_iter().map(|(_, states)| states).chain(new.map(|new| new.states)).collect())
    }
}

impl SessionRow {
    /// With what has arrived for it, and is not settled yet.
    fn with(mut self, arrived: &BTreeMap<String, NewObservations>) -> Self {
        // What was settled since it was read is in the row already.
        if let Some(new) = arrived.get(&self.id).filter(|new| new.seq == self.n_observations) {
            self.n_observations += new.n_states;
            self.active_at = self.active_at.max(new.at);
        }
        self
    }
}

fn read_session(row: &SqliteRow) -> Result<SessionRow, StoreError> {
    const TABLE: &str = "sessions";
    let count = |column: &'static str| -> Result<Option<u32>, StoreError> {
        let count: Option<i64> = row.try_get(column)?;
        count.map(u32::try_from).transpose().map_err(corrupt(TABLE, column))
    };
    let status: &str = row.try_get("status")?;
    Ok(SessionRow {
        sequence: row.try_get("sequence")?,
        id: row.try_get("id")?,
        model: row.try_get("model")?,
        model_hash: row.try_get("model_hash")?,
        weights: serde_json::from_str(row.try_get("weights")?).map_err(corrupt(TABLE, "weights"))?,
        lookahead: count("lookahead")?,
        start: count("start")?,
        learner: row.try_get("learner")?,
        weights_version: count("weights_version")?.map(u64::from),
        trial_id: row.try_get("trial_id")?,
        status: SessionStatus::named(status).ok_or_else(|| corrupt(TABLE, "status")(status.to_owned()))?,
        n_observations: count("n_observations")?.unwrap_or(0),
        policy_id: row.try_get("policy_id")?,
        created_at: timestamp(TABLE, "created_at_ms", row.try_get("created_at_ms")?)?,
        active_at: timestamp(TABLE, "active_at_ms", row.try_get("active_at_ms")?)?,
    })
}

pub(super) async fn open(connection: &mut SqliteConnection, session: &NewSession) -> Result<bool, StoreError> {
    if let Some(trial) = &session.trial
        && !trials::add(connection, trial).await?
    {
        return Ok(false);
    }
    let created_at_ms = session.created_at.as_millisecond();
    sqlx::query(
        "INSERT INTO sessions
             (id, model, model_hash, weights, lookahead, start, learner, weights_version, trial_id,
              status, owner, n_observations, created_at_ms, active_at_ms)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, 'open', 1, 0, $10, $10)",
    )
    .bind(&session.id)
    .bind(&session.model)
    .bind(&session.model_hash)
    .bind(serde_json::to_string(&session.weights).map_err(corrupt("sessions", "weights"))?)
    .bind(session.lookahead)
    .bind(session.start)
    .bind(&session.learner)
    .bind(session.weights_version.map(as_integer))
    .bind(session.trial.as_ref().map(|trial| &trial.id))
    .bind(created_at_ms)
    .execute(connection)
    .await?;
    Ok(true)
}

/// The open ones among the sessions with these ids (JSON: an array), with how many observations their table has of each.
pub(super) async fn count_open(connection: &mut SqliteConnection, ids: &str) -> Result<Vec<(String, u32)>, StoreError> {
    let query = sqlx::query_as(
        "SELECT id, n_observations FROM sessions WHERE status = 'open' AND id IN (SELECT value FROM json_each($1))",
    );
    Ok(query.bind(ids).fetch_all(connection).await?)
}

/// Adds to the tables of several sessions, each of them once. Gives for each whether it was open and this was what came next. Two
/// statements, however many there are: each one costs the driver a change of threads.
pub(super) async fn add(
    connection: &mut SqliteConnection,
    group: &[&NewObservations],
) -> Result<Vec<bool>, StoreError> {
    let rows = group
        .iter()
        .map(|new| serde_json::json!([new.session_id, new.seq, new.n_states, new.states, new.at.as_millisecond()]));
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
        let rows = rows.map(|(new, _)| serde_json::json!([new.session_id, new.seq, new.n_states, new.states]));
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

/// Observations that came before but are not settled yet do not undo this.
pub(super) async fn touch(connection: &mut SqliteConnection, id: &str, at: Timestamp) -> Result<bool, StoreError> {
    let query =
        sqlx::query("UPDATE sessions SET active_at_ms = MAX(active_at_ms, $2) WHERE id = $1 AND status = 'open'");
    let updated = query.bind(id).bind(at.as_millisecond()).execute(connection).await?;
    Ok(updated.rows_affected() > 0)
}

pub(super) async fn end(connection: &mut SqliteConnection, end: &SessionEnd) -> Result<bool, StoreError> {
    let updated = sqlx::query(
        "UPDATE sessions SET status = 'done', policy_id = $2, active_at_ms = $3 WHERE id = $1 AND status = 'open'",
    )
    .bind(&end.session_id)
    .bind(&end.policy.id)
    .bind(end.policy.created_at.as_millisecond())
    .execute(&mut *connection)
    .await?;
    if updated.rows_affected() == 0 {
        return Ok(false);
    }
    policies::add(connection, &end.policy).await?;
    if let Some(refinement) = &end.refinement {
        refinements::add(connection, refinement).await?;
    }
    Ok(true)
}

pub(super) async fn expire(
    connection: &mut SqliteConnection,
    before: Timestamp,
) -> Result<Vec<ExpiredSession>, StoreError> {
    let query = sqlx::query(
        "SELECT id, active_at_ms, n_observations FROM sessions WHERE status = 'open' AND active_at_ms < $1
         ORDER BY active_at_ms LIMIT $2",
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
    sqlx::query("DELETE FROM observations WHERE session_id IN (SELECT value FROM json_each($1))")
        .bind(&ids)
        .execute(&mut *connection)
        .await?;
    sqlx::query("UPDATE sessions SET status = 'expired' WHERE id IN (SELECT value FROM json_each($1))")
        .bind(&ids)
        .execute(connection)
        .await?;
    Ok(expired)
}
