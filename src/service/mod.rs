//! The application: what the service does, whatever it is asked through.
//!
//! ```text
//! http, cli --> Etude --> SearchPool  (reading of large bodies, compiling, searching: bounded, cancellable, off the async threads)
//!                 |-----> MapperCache (models that are ready to be searched)
//!                 +-----> Store       (what is durable)
//! ```
//!
//! Everything that is spawned is tracked, and ends with [`Etude::close`].

mod batch;
mod cache;
mod caller;
mod compiler;
mod definitions;
mod hash;
mod learner_task;
mod learners;
mod models;
mod name;
mod opening;
mod owners;
mod pipe;
mod policies;
mod pool;
mod refined;
mod refiner;
mod requests;
mod search;
mod sessions;
mod trials;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use jiff::{Timestamp, Unit};

pub use batch::{MAX_BATCH_ITEMS, MadePolicies};
pub use caller::{Caller, Client};
pub use definitions::{DefinitionReader, ModelText, OpenText};
pub use hash::hash_of;
pub use learners::{Difference, LearnedWeight, LearnerAnswer, Replay, WeightsAnswer};
pub use models::{ModelAnswer, ModelDefinition, Registered};
pub use name::{InvalidName, Kind, Name};
pub(crate) use pipe::{PipeWriter, pipe};
pub use policies::MadePolicy;
pub(crate) use pool::Places;
pub use pool::{Admission, PoolError, PoolSettings, SearchPool};
pub use sessions::{
    CommittedSteps, Ended, Observation, Received, Resumed, RewardState, Session, SessionError, SessionPolicy,
};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
pub use trials::TrialAnswer;

use crate::clock::{Clock, Ids};
use crate::memory::{Memory, NoRoom};
pub(crate) use crate::store::PIECE_BYTES;
use crate::store::Store;
pub use crate::store::{AcceptedReward, ModelSummary, Page, SessionRecord, StoreError, TrialStatus, Unavailable};
use cache::ModelNames;
use compiler::Compiler;
use etude_core::document::{Faults, ParseError, Quoted};
use etude_core::mapping::WriteError;
use etude_core::model::Limits;
use models::Uploads;
use owners::Owners;
use refiner::Refiner;

/// How the service is set up.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Where the database is; created if missing.
    pub database: PathBuf,
    /// What a model may at most be.
    pub limits: Limits,
    /// Most bytes of models kept ready to be searched.
    pub model_cache_bytes: u64,
    /// How long a session may be idle before it expires.
    pub session_idle_timeout: Duration,
    /// Threads and queue of the searches.
    pub pool: PoolSettings,
    /// What everything large takes its memory from.
    pub memory: Memory,
    /// How long things may take.
    pub time_limits: TimeLimits,
    /// What time it is.
    pub clock: Clock,
    /// Where ids come from.
    pub ids: Ids,
}

#[cfg(test)]
impl Settings {
    /// One thread, a small cache, and much memory.
    fn of_test(directory: &std::path::Path) -> Self {
        Self {
            database: directory.join("etude.db"),
            limits: Limits::DEFAULT,
            memory: Memory::with_room(1 << 30),
            model_cache_bytes: 1 << 20,
            session_idle_timeout: Duration::MAX,
            time_limits: TimeLimits::DEFAULT,
            clock: Clock::system(),
            ids: Ids::random(),
            pool: PoolSettings { n_threads: 1, max_waiting: 1, max_long: 1 },
        }
    }
}

/// How long searches and compilations may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeLimits {
    /// A search whose request does not say, counted from the request's arrival.
    pub default_deadline: Duration,
    /// A search whose request says.
    pub max_deadline: Duration,
    /// Compiling a model, counted while it is compiled.
    pub compile: Duration,
}

impl TimeLimits {
    /// Ten seconds, ten minutes, and half a minute: a model of a million states takes some three seconds.
    pub const DEFAULT: Self = Self {
        default_deadline: Duration::from_secs(10),
        max_deadline: Duration::from_mins(10),
        compile: Duration::from_secs(30),
    };
}

/// Why the service could not do as asked.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The body is not JSON.
    #[error(transparent)]
    Parse(#[from] ParseError),
    /// The body is JSON, but not what was asked for.
    #[error("{0}")]
    Faults(#[from] Faults),
    /// What must be kept of the body while it is read is too large.
    #[error("{0}")]
    TooLarge(String),
    /// The body could not be read to its end.
    #[error("the body could not be read")]
    Body(#[source] std::io::Error),
    /// There is nothing of this kind with this name or id.
    #[error("there is no {} {}", kind.name(), Quoted(name))]
    Unknown {
        /// What was looked for.
        kind: Kind,
        /// By which name or id.
        name: String,
        /// Where the request's body names it, if it does.
        pointer: Option<&'static str>,
    },
    /// The name is taken by something else.
    #[error("{kind} {name:?} exists with other content (hash {existing_hash}); delete it first or use another name")]
    Conflict {
        /// What it is the name of.
        kind: &'static str,
        /// The name.
        name: String,
        /// The hash of what is there.
        existing_hash: String,
    },
    /// Something else needs what was to be deleted.
    #[error("{} {} cannot be deleted: {because}", kind.name(), Quoted(id))]
    InUse {
        /// What it is.
        kind: Kind,
        /// Its id.
        id: String,
        /// What needs it.
        because: &'static str,
    },
    /// The learner never had this version of its weights.
    #[error("the weights of learner {name:?} have no version {version}")]
    UnknownVersion {
        /// The learner.
        name: String,
        /// What was asked for.
        version: u64,
    },
    /// The trial has a reward, and that is not changed.
    #[error("trial {trial} has earned {existing} already")]
    AlreadyRewarded {
        /// The trial.
        trial: String,
        /// What it has earned.
        existing: f64,
    },
    /// The trial has failed, and takes neither a reward nor another reason.
    #[error("trial {trial} has failed")]
    TrialFailed {
        /// The trial.
        trial: String,
    },
    /// The searches cannot keep up, or the service is shutting down.
    #[error(transparent)]
    Pool(#[from] PoolError),
    /// The answer to a batch has no room for this item.
    #[error("the answer to this batch is full; send this item again with the next one")]
    BatchFull,
    /// There is no memory for it now, or there never is.
    #[error(transparent)]
    NoRoom(#[from] NoRoom),
    /// The deadline is over, and the model is still being compiled.
    #[error("model {name:?} is still being compiled; try again shortly")]
    Compiling {
        /// The model.
        name: String,
    },
    /// The store failed.
    #[error(transparent)]
    Store(StoreError),
    /// What the store holds cannot be read as what was stored.
    #[error("table {table} holds an invalid {column} in the row of {row:?}")]
    Unreadable {
        /// Where.
        table: &'static str,
        /// In which column.
        column: &'static str,
        /// In which row, by its name or id.
        row: String,
        /// What is wrong with it.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// What was made could not be written as JSON: a defect.
    #[error("an answer could not be written")]
    Write(#[source] serde_json::Error),
    /// A policy could not be written: a defect.
    #[error("a policy could not be written")]
    WritePolicy(#[from] WriteError),
}

impl ServiceError {
    /// A row, known by its name or id, whose content cannot be read.
    fn unreadable(
        table: &'static str,
        column: &'static str,
        row: impl Into<String>,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        Self::Unreadable { table, column, row: row.into(), source: source.into() }
    }
}

impl From<StoreError> for ServiceError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::NoRoom(no_room) => Self::NoRoom(no_room),
            error => Self::Store(error),
        }
    }
}

/// The application.
#[derive(Debug)]
pub struct Etude {
    store: Arc<Store>,
    clock: Clock,
    ids: Ids,
    memory: Memory,
    pool: SearchPool,
    compiler: Compiler,
    model_names: ModelNames,
    refiner: Refiner,
    owners: Owners,
    time_limits: TimeLimits,
    session_idle_timeout: Duration,
    n_search_threads: usize,
    limits: Limits,
    uploads: Uploads,
    /// Held while rewards are folded.
    learning: tokio::sync::Mutex<()>,
}

impl Etude {
    /// Opens the database for this process alone, and gets ready. Whatever runs in the background runs in `tasks`; searches end when
    /// `abort` is cancelled.
    ///
    /// # Errors
    ///
    /// If the database cannot be opened.
    pub async fn open(settings: &Settings, tasks: &TaskTracker, abort: CancellationToken) -> Result<Self, StoreError> {
        Ok(Self::with(Store::open_alone(&settings.database, tasks).await?, settings, tasks, abort))
    }

    /// Opens the database to read it, whoever works with it.
    ///
    /// # Errors
    ///
    /// If the database cannot be opened, or has the schema of an earlier version.
    pub async fn open_to_read(settings: &Settings, tasks: &TaskTracker) -> Result<Self, StoreError> {
        let store = Store::open_to_read(&settings.database, tasks).await?;
        Ok(Self::with(store, settings, tasks, CancellationToken::new()))
    }

    fn with(store: Store, settings: &Settings, tasks: &TaskTracker, abort: CancellationToken) -> Self {
        let store = Arc::new(store);
        let pool = SearchPool::new(settings.pool, settings.clock.clone(), tasks.clone(), abort);
        Self {
            compiler: Compiler::new(Arc::clone(&store), pool.clone(), settings, tasks.clone()),
            store,
            clock: settings.clock.clone(),
            ids: settings.ids.clone(),
            memory: settings.memory.clone(),
            pool,
            time_limits: settings.time_limits,
            model_names: ModelNames::new(),
            refiner: Refiner::default(),
            owners: Owners::default(),
            session_idle_timeout: settings.session_idle_timeout,
            n_search_threads: settings.pool.n_threads.max(1),
            limits: settings.limits,
            uploads: Uploads::default(),
            learning: tokio::sync::Mutex::new(()),
        }
    }

    /// Whether the service can do its work: whether something can be written.
    ///
    /// # Errors
    ///
    /// If not.
    pub async fn check(&self) -> Result<(), StoreError> {
        self.store.check(&self.clock, self.alive_every()).await
    }

    /// Begins to serve at `now`: time since the service was last alive does not count for open sessions, and what a killed service has
    /// left behind is removed. Where nothing can be written, that is done once it can be.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn begin(&self, now: Timestamp) -> Result<(), StoreError> {
        match self.note_alive(now).await {
            Ok(()) => self.store.sweep_left_behind().await,
            Err(StoreError::Unavailable(_)) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Notes that the service is alive at `now`.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub async fn note_alive(&self, now: Timestamp) -> Result<(), StoreError> {
        self.store.note_alive(now, self.alive_every()).await
    }

    /// Closes the store. Whoever still asks for something gets an error.
    pub async fn close(&self) {
        self.store.close().await;
    }

    /// What time it is.
    #[must_use]
    pub fn clock(&self) -> &Clock {
        &self.clock
    }

    /// Where ids come from.
    #[must_use]
    pub fn ids(&self) -> &Ids {
        &self.ids
    }

    /// The budget of memory.
    #[must_use]
    pub fn memory(&self) -> &Memory {
        &self.memory
    }

    /// The pool that searches run on.
    #[must_use]
    pub fn pool(&self) -> &SearchPool {
        &self.pool
    }
}

/// How long to wait before trying again when the queue is full.
pub const RETRY_AFTER: Duration = Duration::from_secs(1);

/// A time as exact as it is stored.
fn as_stored(time: Timestamp) -> Timestamp {
    time.round(Unit::Millisecond).unwrap_or(time)
}
