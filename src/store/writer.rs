//! The one writer, which groups commits.
//!
//! A commit costs a sync of the disk, whatever it holds. So the writer takes everything that waits, up to a limit, applies it in one
//! transaction, and answers all of it after the commit. Before it takes it, it lets everybody go on who is ready to and may bring it
//! more: so groups grow with the load, and nobody waits for a clock. Observations, which are most of it, only arrive with a commit,
//! and are settled in their table later (`arrivals`). A group of nothing but observations, or nothing but policies, takes a single
//! statement, as each costs the driver a change of threads.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use sqlx::{Connection, SqliteConnection};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use jiff::Timestamp;

use super::arrivals::Arrivals;
use super::models::DeleteModel;
use super::{
    FailTrial, NewLearner, NewModel, NewObservations, NewPolicy, NewRefinement, NewReward, NewSession, NewTrial,
    PutLearner, PutModel, PutReward, RefinementEnd, SessionEnd, StoreError, WeightsRow, definitions, learners, models,
    policies, refinements, sessions, trials,
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
    BeginDefinition,
    AddPiece {
        definition_id: i64,
        seq: i64,
        piece: Vec<u8>,
    },
    SweepDefinition(i64),
    AddPolicies(Vec<NewPolicy>, Vec<NewRefinement>),
    EndRefinement(Box<RefinementEnd>),
    OpenSession(Box<NewSession>),
    AddObservations(NewObservations),
    /// Something came for this session at this time.
    TouchSession {
        id: String,
        at: Timestamp,
    },
    EndSession(Box<SessionEnd>),
    /// Brings observations that have arrived to their table.
    Settle,
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

impl Write {
    /// The policies that are all there is to it.
    fn as_policies(&self) -> Option<&[NewPolicy]> {
        match self {
            Self::AddPolicies(added, to_refine) if to_refine.is_empty() => Some(added),
            _ => None,
        }
    }
}

/// What became of a [`Write`].
#[derive(Debug)]
pub(super) enum Written {
    PutModel(PutModel),
    DeleteModel(DeleteModel),
    /// Its id.
    BeginDefinition(i64),
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
#[derive(Clone, Debug)]
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
        tasks.spawn(running);
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

    /// Whether writes are taken: not once it has ended, for whatever reason.
    pub(super) fn is_running(&self) -> bool {
        !self.queue.is_closed()
    }

    /// Completes when no more writes are taken.
    pub(super) async fn closed(&self) {
        self.closing.cancelled().await;
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
    let mut arrivals = Arrivals::default();
    loop {
        // Whoever is ready to go on may have something for this group too.
        tokio::task::yield_now().await;
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
        let committed = commit(&mut connection, &mut arrivals, &group).await;
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
                    let written = commit(&mut connection, &mut arrivals, std::slice::from_ref(&job)).await;
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
    if !arrivals.is_empty()
        && let Err(error) = settle(&mut connection, &mut arrivals).await
    {
        // They are durable where they are.
        tracing::warn!(error = &error as &dyn std::error::Error, "observations were left for the next start to settle");
    }
    // Checkpoints the log, so that what is left behind is a single file.
    if let Err(error) = connection.close().await {
        tracing::warn!(error = &error as &dyn std::error::Error, "the database was not closed cleanly");
    }
}

/// Applies `group`; what was known is forgotten if it cannot be.
async fn commit(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &[Job],
) -> Result<Vec<Written>, StoreError> {
    let observations = group.iter().map(|job| match &job.write {
        Write::AddObservations(new) => Some(new),
        _ => None,
    });
    let at_once = match observations.collect::<Option<Vec<_>>>() {
        None => add_policies(connection, group).await,
        Some(news) if arrivals.is_known() && !arrivals.is_full() => add_observations(connection, arrivals, &news).await,
        Some(_) => Ok(None),
    };
    let committed = match at_once {
        Ok(Some(written)) => Ok(written),
        Ok(None) => transact(connection, arrivals, group).await,
        Err(error) => Err(error),
    };
    if committed.is_err() {
        arrivals.forget();
    }
    committed
}

/// Adds observations in one statement. Gives nothing, and has done nothing, if one of them does not come next as far as is
/// known, or others have written meanwhile: that takes a closer look.
async fn add_observations(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    news: &[&NewObservations],
) -> Result<Option<Vec<Written>>, StoreError> {
    let accepted = arrivals.accept(connection, news).await?;
    if accepted.is_next.contains(&false) || !arrivals.add_at_once(connection, &accepted).await? {
        arrivals.forget();
        return Ok(None);
    }
    Ok(Some(accepted.is_next.into_iter().map(Written::Done).collect()))
}

/// Adds policies in one statement, if there is nothing else in the group and they fit; else it gives nothing, and has done nothing.
async fn add_policies(connection: &mut SqliteConnection, group: &[Job]) -> Result<Option<Vec<Written>>, StoreError> {
    let added = group.iter().map(|job| job.write.as_policies());
    let Some(added) = added.collect::<Option<Vec<_>>>() else { return Ok(None) };
    let added: Vec<_> = added.into_iter().flatten().collect();
    let was_added = policies::add_at_once(connection, &added).await?;
    Ok(was_added.then(|| group.iter().map(|_| Written::Done(true)).collect()))
}

/// Applies `group` in one transaction: observations and policies first, rewards last, each all together. Nobody was answered yet, so that
/// any order is one in which they may have come.
async fn transact(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &[Job],
) -> Result<Vec<Written>, StoreError> {
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    let observations = group.iter().filter_map(|job| match &job.write {
        Write::AddObservations(new) => Some(new),
        _ => None,
    });
    let observations: Vec<_> = observations.collect();
    let is_read = |job: &Job| matches!(job.write, Write::EndSession(_) | Write::ExpireSessions(_) | Write::Settle);
    let are_read = group.iter().any(is_read);
    let mut are_next = Vec::new();
    // Whoever has nothing to do with observations does not wait for them.
    if are_read || !observations.is_empty() {
        arrivals.check(&mut transaction).await?;
        if !arrivals.is_known() {
            arrivals.settle(&mut transaction).await?;
        }
        let accepted = arrivals.accept(&mut transaction, &observations).await?;
        arrivals.add(&mut transaction, &accepted).await?;
        if are_read || arrivals.is_full() {
            arrivals.settle(&mut transaction).await?;
        }
        are_next = accepted.is_next;
    }

    let mut are_next = are_next.into_iter();
    let mut written = Vec::with_capacity(group.len());
    let mut rewards = Vec::new();
    let added_policies = group.iter().filter_map(|job| job.write.as_policies());
    policies::add_all(&mut transaction, &added_policies.flatten().collect::<Vec<_>>()).await?;
    for job in group {
        written.push(match &job.write {
            Write::AddObservations(_) => are_next.next().map(Written::Done),
            Write::PutReward(reward) => {
                rewards.push(reward);
                None
            }
            Write::AddPolicies(_, to_refine) if to_refine.is_empty() => Some(Written::Done(true)),
            write => Some(apply(&mut transaction, arrivals, write).await?),
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

/// Brings what has arrived to its table.
async fn settle(connection: &mut SqliteConnection, arrivals: &mut Arrivals) -> Result<(), StoreError> {
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    arrivals.settle(&mut transaction).await?;
    Ok(transaction.commit().await?)
}

/// Applies a single write, which is neither of observations nor of a reward.
async fn apply(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    write: &Write,
) -> Result<Written, StoreError> {
    Ok(match write {
        Write::PutModel(model) => Written::PutModel(models::put(connection, model).await?),
        Write::DeleteModel(name) => Written::DeleteModel(models::delete(connection, name).await?),
        Write::BeginDefinition => Written::BeginDefinition(definitions::begin(connection).await?),
        Write::AddPiece { definition_id, seq, piece } => {
            definitions::add_piece(connection, *definition_id, *seq, piece).await?;
            Written::Done(true)
        }
        Write::SweepDefinition(id) => Written::Done(definitions::sweep_some(connection, *id).await?),
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
        Write::OpenSession(session) => {
            let was_opened = sessions::open(connection, session).await?;
            if was_opened {
                arrivals.opened(&session.id);
            }
            Written::Done(was_opened)
        }
        Write::TouchSession { id, at } => Written::Done(sessions::touch(connection, id, *at).await?),
        Write::EndSession(end) => {
            arrivals.ended(&end.session_id);
            Written::Done(sessions::end(connection, end).await?)
        }
        Write::ExpireSessions(before) => {
            arrivals.expired();
            sessions::expire(connection, *before).await?;
            Written::Done(true)
        }
        // Was done before.
        Write::Settle => Written::Done(true),
        Write::PutLearner(learner) => Written::PutLearner(learners::put(connection, learner).await?),
        Write::DeleteLearner(name) => Written::DeleteLearner(learners::delete(connection, name).await?),
        Write::AddWeights { learner, weights } => {
            Written::AddWeights(learners::add_weights(connection, *learner, weights).await?)
        }
        Write::AddTrial(trial) => Written::AddTrial(trials::add(connection, trial).await?),
        Write::FailTrial { id, reason } => {
            Written::FailTrial(Box::new(trials::fail(connection, id, reason.as_deref()).await?))
        }
        Write::AddObservations(_) | Write::PutReward(_) => unreachable!("applied together with their like"),
    })
}
