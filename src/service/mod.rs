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
mod error;
mod experience;
mod hash;
mod idempotency;
mod learner_task;
mod learners;
mod limited;
mod models;
mod name;
mod opening;
mod owners;
mod pipe;
mod policies;
mod pool;
mod refined;
mod refiner;
mod reports;
mod requests;
mod search;
mod sessions;
mod told;
mod trials;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use jiff::{Timestamp, Unit};

pub use batch::{MAX_BATCH_ITEMS, MadePolicies};
pub use caller::Caller;
pub use definitions::{DefinitionReader, ModelForm, ModelText, OpenText};
pub use error::{Outage, OutageKind, ServiceError};
pub use experience::{BatchText, ExperienceAnswer};
pub use hash::{hash_of, hash_of_definition};
pub use idempotency::{IdempotencyKey, InvalidIdempotencyKey};
pub use learners::{Difference, LearnedWeight, LearnerAnswer, Replay, WeightsAnswer};
pub use models::{ModelAnswer, ModelDefinition, Registered};
pub use name::{InvalidName, Kind, Name};
pub(crate) use opening::read_lookahead_ms;
pub(crate) use pipe::{PipeWriter, pipe};
pub use policies::MadePolicy;
pub(crate) use pool::Places;
pub use pool::{Admission, PoolError, PoolSettings, SearchPool};
use sessions::Left;
pub(crate) use sessions::Waits;
pub use sessions::{
    Coming, CommittedSteps, Ended, Observation, Received, ReceivedFrame, Resumed, RewardState, Session, SessionError,
    SessionPolicy, ShortStep,
};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
pub use trials::TrialAnswer;

use crate::clock::{Clock, Ids};
use crate::memory::Memory;
pub(crate) use crate::store::PIECE_BYTES;
use crate::store::Store;
pub use crate::store::{
    AcceptedReward, ModelSummary, Page, PolicyFilter, Replaces, Revision, SessionFilter, SessionRecord, SessionStatus,
    TrialStatus,
};
use cache::ModelNames;
use compiler::Compiler;
use etude_core::model::Limits;
use idempotency::Turns;
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
    /// Sessions that nobody drives and in which steps are due.
    left: Left,
    turns: Turns,
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
    pub async fn open(
        settings: &Settings,
        tasks: &TaskTracker,
        abort: CancellationToken,
    ) -> Result<Self, ServiceError> {
        Ok(Self::with(Store::open_alone(&settings.database, tasks).await?, settings, tasks, abort))
    }

    /// Opens the database to read it, whoever works with it.
    ///
    /// # Errors
    ///
    /// If the database cannot be opened, or has the schema of an earlier version.
    pub async fn open_to_read(settings: &Settings, tasks: &TaskTracker) -> Result<Self, ServiceError> {
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
            left: Left::default(),
            turns: Turns::default(),
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
    pub async fn check(&self) -> Result<(), ServiceError> {
        Ok(self.store.check(&self.clock, self.alive_every()).await?)
    }

    /// Begins to serve at `now`: time since the service was last alive does not count for open sessions, and what a killed service has
    /// left behind is removed. Where nothing can be written, that is done once it can be.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn begin(&self, now: Timestamp) -> Result<(), ServiceError> {
        match self.note_alive(now).await {
            Ok(()) => Ok(self.store.sweep_left_behind().await?),
            Err(ServiceError::Unavailable(_)) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Notes that the service is alive at `now`.
    ///
    /// # Errors
    ///
    /// If it cannot be written.
    pub async fn note_alive(&self, now: Timestamp) -> Result<(), ServiceError> {
        Ok(self.store.note_alive(now, self.alive_every()).await?)
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
