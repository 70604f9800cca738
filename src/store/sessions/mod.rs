//! The tables of sessions and their observations.

mod reads;
mod verbs;

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, Row};

use super::alive::NoteAlive;
use super::arrivals;
use super::observations::{Arrived, NewObservations, Owner, SessionRefusal};
use super::page::{self, Rest, Rows};
use super::policies::{NewPolicy, NewRefinement};
use super::trials::{NewTrial, Opened};
use super::{Page, Store, StoreError, corrupt, timestamp};
use etude_core::attribute::ByAttribute;
use etude_core::mapping::Conditions;
pub use reads::{StoredObservations, StoredSteps};
use verbs::{ExpireSessions, TakeSession, TouchSession};
pub(super) use verbs::{SettleObservations, end_all, open_all, refusal};

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

    /// Every status.
    pub const ALL: [Self; 3] = [Self::Open, Self::Done, Self::Expired];

    fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|status| status.name() == name)
    }
}

/// Which sessions are listed: those that have all that is given.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SessionFilter {
    /// Name of their model.
    pub model: Option<String>,
    /// How far they have come.
    pub status: Option<SessionStatus>,
}

impl SessionFilter {
    /// The columns that are to have a value.
    fn columns(&self) -> Vec<(&'static str, &str)> {
        let columns = [("model", self.model.as_deref()), ("status", self.status.map(SessionStatus::name))];
        columns.into_iter().filter_map(|(column, value)| Some((column, value?))).collect()
    }
}

/// What there is to resume.
#[derive(Clone, Debug, PartialEq)]
pub enum Taken {
    /// The session is open, and its row names the new owner.
    Open(SessionRecord),
    /// It is done or has expired, and has no owner any more.
    Ended(SessionRecord),
    /// There is none.
    Unknown,
}

/// A session, without its observations.
#[derive(Clone, Debug, PartialEq)]
pub struct SessionRecord {
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
    /// How long a step may wait after its observation came, in milliseconds; `None`: as long as the lookahead lets it.
    pub lookahead_ms: Option<u64>,
    /// How observations follow from states in another vocabulary (JSON); `None`: they are the states.
    pub observe: Option<String>,
    /// What it may start from, what counts, and what the body lacks.
    pub conditions: Conditions,
    /// The learner whose weights are used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The trial that is explored, if any.
    pub trial_id: Option<String>,
    /// How far it has come.
    pub status: SessionStatus,
    /// Who opened it or has resumed it last.
    pub owner: Owner,
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
    /// How long a step may wait after its observation came, in milliseconds; `None`: as long as the lookahead lets it.
    pub lookahead_ms: Option<u64>,
    /// How observations follow from states in another vocabulary (JSON); `None`: they are the states.
    pub observe: Option<String>,
    /// What it may start from, what counts, and what the body lacks.
    pub conditions: Conditions,
    /// The learner whose weights are used, if any.
    pub learner: Option<String>,
    /// The version of the learner's weights.
    pub weights_version: Option<u64>,
    /// The trial that is explored, if any.
    pub trial: Option<NewTrial>,
    /// When it is opened.
    pub created_at: Timestamp,
}

impl NewSession {
    /// How many bytes there are to be written, roughly, beside a row of usual size.
    pub(super) fn n_bytes(&self) -> usize {
        self.trial.as_ref().map_or(0, NewTrial::n_bytes)
    }
}

#[cfg(test)]
impl NewSession {
    /// A session of the model "m" that neither learns nor explores.
    pub(super) fn plain(id: &str, created_at: Timestamp) -> Self {
        Self {
            id: id.to_owned(),
            model: "m".to_owned(),
            model_hash: "0".to_owned(),
            weights: [("x".into(), 1.0)].into_iter().collect(),
            lookahead: None,
            lookahead_ms: None,
            observe: None,
            conditions: Conditions::default(),
            learner: None,
            weights_version: None,
            trial: None,
            created_at,
        }
    }
}

/// The end of a session.
#[derive(Clone, Debug)]
pub struct SessionEnd {
    /// The session.
    pub session_id: String,
    /// Who ends it.
    pub owner: Owner,
    /// Its last observations, if they are not stored yet.
    pub last: Option<NewObservations>,
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
    /// Opens a session, and its trial if it explores. Its owner is [`Owner::FIRST`].
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn open_session(&self, session: NewSession) -> Result<Opened, StoreError> {
        let trial = session.trial.as_ref().map(|trial| (trial.learner, trial.number));
        let opened = self.writer.open_session(session).await?;
        if let (Opened::NumberTaken, Some((learner, _))) = (opened, trial) {
            self.trial_numbers.forget(learner);
        }
        Ok(opened)
    }

    /// Makes the caller the owner of a session, if that is open, and counts as activity of the session at `at`. Nothing is accepted from
    /// earlier owners from then on.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn take_session(&self, id: &str, at: Timestamp) -> Result<Taken, StoreError> {
        self.writer.write(TakeSession { id: id.to_owned(), at }).await
    }

    /// Appends observations to an open session, durably.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn append_observations(
        &self,
        observations: NewObservations,
    ) -> Result<Result<(), SessionRefusal>, StoreError> {
        self.writer.append(observations).await
    }

    /// Notes that something came for an open session at `at`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn touch_session(
        &self,
        id: &str,
        owner: Owner,
        at: Timestamp,
    ) -> Result<Result<(), SessionRefusal>, StoreError> {
        self.writer.write(TouchSession { id: id.to_owned(), owner, at }).await
    }

    /// Ends an open session: stores its last observations and its policy, and links them.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing was stored.
    pub async fn end_session(&self, end: SessionEnd) -> Result<Result<(), SessionRefusal>, StoreError> {
        self.writer.end_session(end).await
    }

    /// Ends open sessions that were last active longer than `idle` before `now`, and forgets their observations:
    /// at most [`MAX_EXPIRED_AT_ONCE`] of them. Time without service does not count. This is a sign of life, as [`Self::note_alive`] is.
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
        let (down, expired) = self.writer.write(ExpireSessions { before, alive: NoteAlive { now, every } }).await?;
        self.note_down(down);
        Ok(expired)
    }

    /// Moves the observations of all sessions from `arrivals` to their table. If nothing can be written, returns them by session instead.
    async fn settle(&self) -> Result<BTreeMap<String, Arrived>, StoreError> {
        let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM arrivals)");
        if !query.fetch_one(&mut *self.reader().await?).await? {
            return Ok(BTreeMap::new());
        }
        match self.writer.write(SettleObservations).await {
            Err(StoreError::Unavailable(_)) => arrivals::read(&mut *self.reader().await?).await,
            settled => settled.map(|()| BTreeMap::new()),
        }
    }

    /// The session with this id.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn session(&self, id: &str) -> Result<Option<SessionRecord>, StoreError> {
        let arrived = self.settle().await?;
        let query = sqlx::query("SELECT * FROM sessions WHERE id = $1").bind(id);
        let row = query.fetch_optional(&mut *self.reader().await?).await?;
        let session = row.as_ref().map(read_session).transpose().map_err(|error| error.of_row("sessions", id))?;
        Ok(session.map(|session| session.with(&arrived)))
    }

    /// At most `limit` of the sessions that are wanted, in the order in which they were opened, from the first after the sequence number
    /// `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn sessions(
        &self,
        filter: &SessionFilter,
        after: i64,
        limit: u32,
    ) -> Result<Page<SessionRecord>, StoreError> {
        let arrived = self.settle().await?;
        let columns = filter.columns();
        let mut query = sqlx::query(AssertSqlSafe(page::listing("*", "sessions", &columns)));
        query = query.bind(after).bind(i64::from(limit) + 1);
        for (_, value) in &columns {
            query = query.bind(*value);
        }
        let mut reader = self.reader().await?;
        let rows = query.fetch(&mut *reader);
        let rows_of = Rows { table: "sessions", key: "sequence", name: "id", long: &["weights"], read: read_session };
        let mut page = rows_of.page(rows, limit, Rest::IsNone).await?;
        page.items = page.items.into_iter().map(|session| session.with(&arrived)).collect();
        Ok(page)
    }

    /// The ids of open sessions in which steps wait for so long at most, in the order in which they were opened.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn timed_sessions(&self) -> Result<Vec<String>, StoreError> {
        let query = sqlx::query_scalar(
            "SELECT id FROM sessions INDEXED BY sessions_by_time
             WHERE status = 'open' AND lookahead_ms IS NOT NULL ORDER BY sequence",
        );
        Ok(query.fetch_all(&mut *self.reader().await?).await?)
    }
}

impl SessionRecord {
    /// With what has arrived for it, and is not settled yet.
    fn with(mut self, arrived: &BTreeMap<String, Arrived>) -> Self {
        // What was settled since it was read is in the row already.
        if let Some(new) = arrived.get(&self.id).filter(|new| new.seq == self.n_observations) {
            self.n_observations += new.n_states;
            self.active_at = self.active_at.max(new.at);
        }
        self
    }
}

fn read_session(row: &SqliteRow) -> Result<SessionRecord, StoreError> {
    const TABLE: &str = "sessions";
    let count = |column: &'static str| -> Result<Option<u32>, StoreError> {
        let count: Option<i64> = row.try_get(column)?;
        count.map(u32::try_from).transpose().map_err(corrupt(TABLE, column))
    };
    let milliseconds: Option<i64> = row.try_get("lookahead_ms")?;
    let status: &str = row.try_get("status")?;
    Ok(SessionRecord {
        sequence: row.try_get("sequence")?,
        id: row.try_get("id")?,
        model: row.try_get("model")?,
        model_hash: row.try_get("model_hash")?,
        weights: serde_json::from_str(row.try_get("weights")?).map_err(corrupt(TABLE, "weights"))?,
        lookahead: count("lookahead")?,
        lookahead_ms: milliseconds.map(u64::try_from).transpose().map_err(corrupt(TABLE, "lookahead_ms"))?,
        observe: row.try_get("observe")?,
        conditions: serde_json::from_str(row.try_get("conditions")?).map_err(corrupt(TABLE, "conditions"))?,
        learner: row.try_get("learner")?,
        weights_version: count("weights_version")?.map(u64::from),
        trial_id: row.try_get("trial_id")?,
        status: SessionStatus::named(status).ok_or_else(|| corrupt(TABLE, "status")(status.to_owned()))?,
        owner: Owner(count("owner")?.unwrap_or(0)),
        n_observations: count("n_observations")?.unwrap_or(0),
        policy_id: row.try_get("policy_id")?,
        created_at: timestamp(TABLE, "created_at_ms", row.try_get("created_at_ms")?)?,
        active_at: timestamp(TABLE, "active_at_ms", row.try_get("active_at_ms")?)?,
    })
}
