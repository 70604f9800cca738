//! The one writer, which groups commits.
//!
//! A commit costs a sync of the disk, whatever it holds. So the writer takes everything that waits, up to a limit, applies
//! it in one transaction, and answers all of it after the commit. Under load the groups grow by themselves.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use sqlx::{Connection, SqliteConnection};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use jiff::Timestamp;

use super::{
    FailTrial, NewLearner, NewModel, NewObservations, NewPolicy, NewRefinement, NewReward, NewSession, NewTrial,
    PutLearner, PutModel, PutReward, RefinementEnd, SessionEnd, StoreError, WeightsRow, learners, models, policies,
    refinements, sessions, trials,
};

/// Most writes in a transaction. Beyond this a group gains nothing, and its waiters wait longer.
const MAX_GROUP: usize = 256;

/// Most writes that wait. Beyond this, writers wait to get in line, which slows their clients down.
const MAX_WAITING: usize = 1024;

/// Something to be written.
#[derive(Debug)]
pub(super) enum Write {
    PutModel(NewModel),
    DeleteModel(String),
    AddPolicies(Vec<NewPolicy>, Vec<NewRefinement>),
    EndRefinement(Box<RefinementEnd>),
    OpenSession(Box<NewSession>),
    AddObservations(NewObservations),
    EndSession(Box<SessionEnd>),
    /// Those last active before this time.
    ExpireSessions(Timestamp),
    PutLearner(NewLearner),
    DeleteLearner(String),
    AddWeights {
        learner: i64,
        weights: WeightsRow,
    },
    AddTrial(Box<NewTrial>),
    FailTrial {
        id: String,
        reason: Option<String>,
    },
    PutReward(NewReward),
}

/// What became of a [`Write`].
#[derive(Debug)]
pub(super) enum Written {
    PutModel(PutModel),
    /// Whether there was one.
    DeleteModel(bool),
    /// Whether things were as expected, so that it was done.
    Done(bool),
    PutLearner(PutLearner),
    /// The sequence number of the deleted one, if there was one.
    DeleteLearner(Option<i64>),
    /// Whether it was the next version.
    AddWeights(bool),
    /// Whether its learner was there.
    AddTrial(bool),
    FailTrial(Box<FailTrial>),
    PutReward(Box<PutReward>),
}

#[derive(Debug)]
struct Job {
    write: Write,
    answer: oneshot::Sender<Result<Written, StoreError>>,
}

/// The way to the writer.
#[derive(Debug)]
pub(super) struct Writer {
    queue: mpsc::Sender<Job>,
    closing: CancellationToken,
    models_generation: Arc<AtomicU64>,
}

impl Writer {
    /// Starts the writer in `tasks`. It ends when it is closed or dropped, and everything waiting has been written.
    pub(super) fn start(connection: SqliteConnection, tasks: &TaskTracker) -> Self {
        let (queue, jobs) = mpsc::channel(MAX_WAITING);
        let closing = CancellationToken::new();
        let models_generation = Arc::new(AtomicU64::new(0));
        let running = run(connection, jobs, closing.clone(), Arc::clone(&models_generation));
        // A thread of its own: whatever keeps the others busy, no commit waits for it between two statements.
        let runtime = Handle::current();
        tasks.spawn_blocking(move || runtime.block_on(running));
        Self { queue, closing, models_generation }
    }

    /// Counts up whenever a model was registered or deleted, before whoever did so is told.
    pub(super) fn models_generation(&self) -> u64 {
        self.models_generation.load(Ordering::Acquire)
    }

    /// Takes no more writes, and ends once everything waiting has been written.
    pub(super) fn close(&self) {
        self.closing.cancel();
    }

    /// Writes, and returns once it is on disk. A caller that goes away does not undo its write.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing of `write` was done.
    pub(super) async fn write(&self, write: Write) -> Result<Written, StoreError> {
        let (answer, answered) = oneshot::channel();
        self.queue.send(Job { write, answer }).await.map_err(|_| StoreError::Closed)?;
        answered.await.map_err(|_| StoreError::Closed)?
    }
}

async fn run(
    mut connection: SqliteConnection,
    mut jobs: mpsc::Receiver<Job>,
    closing: CancellationToken,
    models_generation: Arc<AtomicU64>,
) {
    let mut group = Vec::with_capacity(MAX_GROUP);
    loop {
        tokio::select! {
            n_jobs = jobs.recv_many(&mut group, MAX_GROUP) => if n_jobs == 0 { break },
            () = closing.cancelled(), if !jobs.is_closed() => {
                // What waits is still received.
                jobs.close();
                continue;
            }
        }
        let is_of_models = |job: &Job| matches!(job.write, Write::PutModel(_) | Write::DeleteModel(_));
        let are_models_changed = group.iter().any(is_of_models);
        let committed = commit(&mut connection, &group).await;
        if are_models_changed {
            models_generation.fetch_add(1, Ordering::AcqRel);
        }
        match committed {
            Ok(written) => {
                for (job, written) in group.drain(..).zip(written) {
                    // Whoever waited may be gone.
                    let _ = job.answer.send(Ok(written));
                }
            }
            Err(StoreError::Locked) => {
                // Each on its own would wait as long again.
                for job in group.drain(..) {
                    let _ = job.answer.send(Err(StoreError::Locked));
                }
            }
            Err(_) if group.len() > 1 => {
                // One write must not spoil the others: each gets a transaction and an error of its own.
                for job in group.drain(..) {
                    let written = commit(&mut connection, std::slice::from_ref(&job)).await;
                    if is_of_models(&job) {
                        models_generation.fetch_add(1, Ordering::AcqRel);
                    }
                    let _ = job.answer.send(written.and_then(|mut written| written.pop().ok_or(StoreError::Closed)));
                }
            }
            Err(error) => {
                if let Some(job) = group.pop() {
                    let _ = job.answer.send(Err(error));
                }
            }
        }
    }
    // Checkpoints the log, so that what is left behind is a single file.
    if let Err(error) = connection.close().await {
        tracing::warn!(error = &error as &dyn std::error::Error, "the database was not closed cleanly");
    }
}

/// Applies `group` in one transaction: policies first and rewards last, all together. Nobody was answered yet, so that any order
/// is one in which they may have come.
async fn commit(connection: &mut SqliteConnection, group: &[Job]) -> Result<Vec<Written>, StoreError> {
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    let mut written = Vec::with_capacity(group.len());
    let mut rewards = Vec::new();
    let mut added = add_observations(&mut transaction, group).await?;
    let added_policies = group.iter().filter_map(|job| match &job.write {
        Write::AddPolicies(added, to_refine) if to_refine.is_empty() => Some(added),
        _ => None,
    });
    policies::add_all(&mut transaction, &added_policies.flatten().collect::<Vec<_>>()).await?;
    for (n, job) in group.iter().enumerate() {
        written.push(match &job.write {
            Write::PutReward(reward) => {
                rewards.push(reward);
                None
            }
            Write::AddPolicies(_, to_refine) if to_refine.is_empty() => Some(Written::Done(true)),
            Write::AddObservations(_) if let Some(was_next) = added.remove(&n) => Some(Written::Done(was_next)),
            write => Some(apply(&mut transaction, write).await?),
        });
    }
    if !rewards.is_empty() {
        let put = trials::reward_all(&mut transaction, &rewards).await?;
        let waiting = written.iter_mut().filter(|written| written.is_none());
        for (written, put) in waiting.zip(put) {
            *written = Some(Written::PutReward(Box::new(put)));
        }
    }
    transaction.commit().await?;
    Ok(written.into_iter().flatten().collect())
}

/// Applies a single write.
async fn apply(connection: &mut SqliteConnection, write: &Write) -> Result<Written, StoreError> {
    Ok(match write {
        Write::PutModel(model) => Written::PutModel(models::put(connection, model).await?),
        Write::DeleteModel(name) => Written::DeleteModel(models::delete(connection, name).await?),
        Write::AddPolicies(added, to_refine) => {
            policies::add_all(connection, &added.iter().collect::<Vec<_>>()).await?;
            for refinement in to_refine {
                refinements::add(connection, refinement).await?;
            }
            Written::Done(true)
        }
        Write::EndRefinement(end) => {
            refinements::end(connection, end).await?;
            Written::Done(true)
        }
        Write::OpenSession(session) => Written::Done(sessions::open(connection, session).await?),
        Write::AddObservations(observations) => {
            Written::Done(sessions::add(connection, &[observations]).await? == [true])
        }
        Write::EndSession(end) => Written::Done(sessions::end(connection, end).await?),
        Write::ExpireSessions(before) => {
            sessions::expire(connection, *before).await?;
            Written::Done(true)
        }
        Write::PutLearner(learner) => Written::PutLearner(learners::put(connection, learner).await?),
        Write::DeleteLearner(name) => Written::DeleteLearner(learners::delete(connection, name).await?),
        Write::AddWeights { learner, weights } => {
            Written::AddWeights(learners::add_weights(connection, *learner, weights).await?)
        }
        Write::AddTrial(trial) => Written::AddTrial(trials::add(connection, trial).await?),
        Write::FailTrial { id, reason } => {
            Written::FailTrial(Box::new(trials::fail(connection, id, reason.as_deref()).await?))
        }
        Write::PutReward(reward) => {
            let mut put = trials::reward_all(connection, &[reward]).await?;
            Written::PutReward(Box::new(put.pop().ok_or(StoreError::Closed)?))
        }
    })
}

/// Adds the observations of a group at once, but for those to a session that the group has already added to: a session was
/// resumed meanwhile. Gives by index in the group whether they came next. What else a group does to these
/// sessions was not waited for by their owner, so any order will do.
async fn add_observations(
    connection: &mut SqliteConnection,
    group: &[Job],
) -> Result<HashMap<usize, bool>, StoreError> {
    let mut sessions_added = HashSet::new();
    let (indices, news): (Vec<usize>, Vec<&NewObservations>) = group
        .iter()
        .enumerate()
        .filter_map(|(n, job)| match &job.write {
            Write::AddObservations(new) => sessions_added.insert(&new.session_id).then_some((n, new)),
            _ => None,
        })
        .unzip();
    if news.is_empty() {
        return Ok(HashMap::new());
    }
    Ok(indices.into_iter().zip(sessions::add(connection, &news).await?).collect())
}
