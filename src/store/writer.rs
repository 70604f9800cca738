//! The one writer, which groups commits.
//!
//! A commit costs a sync of the disk, whatever it holds. So the writer takes everything that waits, up to a limit, applies it in one
//! transaction, and answers all of it after the commit. Before it takes it, it lets everybody go on who is ready to and may bring it
//! more: so groups grow with the load, and nobody waits for a clock. What is small waits in a line of its own, and a group has all of
//! it, but of what is large only about as much as a disk writes in no time: so nobody waits behind what others have sent. Observations, which are most of it, only arrive with a commit,
//! and are settled in their table later (`arrivals`). A group of nothing but observations, or nothing but policies, takes a single
//! statement, as each costs the driver a change of threads.
//!
//! After an error nothing is known of the connection: a transaction may be open or not, whatever the driver has counted. So it is closed,
//! and whoever writes next opens another. Nothing is acknowledged that is not in the file which has the database's name then.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rustc_hash::FxHashSet;
use sqlx::{Connection, SqliteConnection};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use jiff::Timestamp;

use super::alive::{self, Alive};
use super::arrivals::Arrivals;
use super::database::{Database, Readers};
use super::models::DeleteModel;
use super::{
    ExpiredSession, FailTrial, NewDefinition, NewLearner, NewModel, NewObservations, NewPolicy, NewRefinement,
    NewReward, NewSession, NewTrial, PutLearner, PutModel, PutReward, RefinementEnd, SessionEnd, StoreError,
    Unavailable, WeightsRow, definitions, learners, models, policies, refinements, sessions, trials,
};

/// Most small writes in a transaction. Beyond this a group gains nothing, and its waiters wait longer.
const MAX_GROUP: usize = 256;

/// Writes of more bytes are large. A group of small ones comes to 1 MiB at most.
const MAX_SMALL_BYTES: usize = 4 << 10;

/// A group that has so much of large writes takes no more of them. One piece of a definition comes to about twice as much.
const MAX_LARGE_BYTES: usize = 512 << 10;

/// Most writes that wait in a line. Beyond this, writers wait to get in line, which slows their clients down.
const MAX_WAITING: usize = 1024;

/// How long they wait for that.
const LINE_TIMEOUT: Duration = Duration::from_secs(5);

/// What is written to the log between two checkpoints, roughly: as much as SQLite itself lets be written.
const CHECKPOINT_BYTES: usize = 4 << 20;

/// What a commit writes whatever it holds, roughly: four pages.
const COMMIT_BYTES: usize = 16 << 10;

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
    /// One more attempt at a refinement.
    BeginRefinement(String),
    /// Takes that back.
    ReturnRefinement(String),
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
    /// Some of those last active before a time, after a sign of life.
    ExpireSessions {
        before: Timestamp,
        alive: Alive,
    },
    Alive(Alive),
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

    /// How much there is to be written, roughly.
    fn n_bytes(&self) -> usize {
        let of_refinement = |refinement: &Option<NewRefinement>| refinement.as_ref().map_or(0, NewRefinement::n_bytes);
        let of_trial =
            |trial: &NewTrial| trial.policy.as_ref().map_or(0, NewPolicy::n_bytes) + of_refinement(&trial.refinement);
        match self {
            Self::PutModel(model) => match &model.definition {
                NewDefinition::Text(text) => text.len(),
                // It may have as many labels, which are stored once more.
                NewDefinition::Pieces(_) => MAX_LARGE_BYTES,
            },
            Self::AddPiece { piece, .. } => piece.len(),
            Self::AddPolicies(added, to_refine) => {
                let n_bytes: usize = added.iter().map(NewPolicy::n_bytes).sum();
                n_bytes + to_refine.iter().map(NewRefinement::n_bytes).sum::<usize>()
            }
            Self::EndRefinement(end) => end.refined.as_ref().map_or(0, NewPolicy::n_bytes),
            Self::OpenSession(session) => session.trial.as_ref().map_or(0, of_trial),
            Self::AddObservations(new) => new.states.len(),
            Self::EndSession(end) => end.policy.n_bytes() + of_refinement(&end.refinement),
            Self::PutLearner(learner) => learner.definition.len(),
            Self::AddTrial(trial) => of_trial(trial),
            // Of several pieces. It comes behind those that were sent before.
            Self::SweepDefinition(_) => MAX_LARGE_BYTES,
            Self::DeleteModel(_)
            | Self::BeginDefinition
            | Self::BeginRefinement(_)
            | Self::ReturnRefinement(_)
            | Self::TouchSession { .. }
            | Self::Settle
            | Self::ExpireSessions { .. }
            | Self::Alive(_)
            | Self::DeleteLearner(_)
            | Self::AddWeights { .. }
            | Self::FailTrial { .. }
            | Self::PutReward(_) => 0,
        }
    }

    fn line(&self) -> Line {
        if self.n_bytes() > MAX_SMALL_BYTES { Line::Large } else { Line::Small }
    }
}

/// Where a write waits. Writes of a line are done in the order in which they came, and nothing is said about those of two.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Line {
    /// All of it goes into the next group.
    Small,
    /// A part of it goes into the next group. As whoever writes waits for its answer, all of them have their turns.
    Large,
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
    ExpireSessions(Vec<ExpiredSession>),
}

#[derive(Debug)]
struct Job {
    write: Write,
    answer: oneshot::Sender<Result<Written, StoreError>>,
}

/// The way to the writer.
#[derive(Clone, Debug)]
pub(super) struct Writer {
    small: mpsc::Sender<Job>,
    large: mpsc::Sender<Job>,
    closing: CancellationToken,
    models_generation: Arc<AtomicU64>,
}

impl Writer {
    /// Starts the writer in `tasks`, with its way to the database if there is one yet, and ways to read beside it. It ends when it is
    /// closed or dropped, and everything waiting has been written.
    pub(super) fn start(
        database: Database,
        connection: Option<SqliteConnection>,
        readers: Arc<Readers>,
        tasks: &TaskTracker,
    ) -> Self {
        let (writer, lines) = Self::with_lines();
        let open = Open {
            database,
            connection,
            readers,
            tasks: tasks.clone(),
            n_logged_bytes: 0,
            checkpoint: None,
            known: Known::default(),
            was_interrupted: true,
            trouble: None,
            models_generation: Arc::clone(&writer.models_generation),
        };
        tasks.spawn(open.run(lines));
        writer
    }

    /// The way to no writer.
    pub(super) fn none() -> Self {
        let (writer, _) = Self::with_lines();
        writer.close();
        writer
    }

    /// The way to whoever takes what is in the lines.
    fn with_lines() -> (Self, Lines) {
        let (small, small_jobs) = mpsc::channel(MAX_WAITING);
        let (large, large_jobs) = mpsc::channel(MAX_WAITING);
        let closing = CancellationToken::new();
        let lines = Lines {
            small: small_jobs,
            large: large_jobs,
            closing: closing.clone(),
            has_small_ended: false,
            has_large_ended: false,
        };
        (Self { small, large, closing, models_generation: Arc::default() }, lines)
    }

    /// Counts up whenever a model was registered or deleted, before whoever did so is told.
    pub(super) fn models_generation(&self) -> u64 {
        self.models_generation.load(Ordering::Acquire)
    }

    /// Takes no more writes, and ends once everything waiting has been written.
    pub(super) fn close(&self) {
        self.closing.cancel();
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
        let line = write.line();
        self.write_in(line, write).await
    }

    /// As [`Self::write`], in this line.
    ///
    /// # Errors
    ///
    /// Likewise.
    pub(super) async fn write_in(&self, line: Line, write: Write) -> Result<Written, StoreError> {
        let line = match line {
            Line::Small => &self.small,
            Line::Large => &self.large,
        };
        let (answer, answered) = oneshot::channel();
        match line.try_send(Job { write, answer }) {
            Ok(()) => {}
            Err(TrySendError::Closed(_)) => return Err(StoreError::Closed),
            Err(TrySendError::Full(job)) => match tokio::time::timeout(LINE_TIMEOUT, line.send(job)).await {
                Ok(sent) => sent.map_err(|_| StoreError::Closed)?,
                Err(_) => return Err(Unavailable::Slow.into()),
            },
        }
        answered.await.map_err(|_| StoreError::Closed)?
    }
}

/// What waits for the writer.
#[derive(Debug)]
struct Lines {
    small: mpsc::Receiver<Job>,
    large: mpsc::Receiver<Job>,
    closing: CancellationToken,
    has_small_ended: bool,
    has_large_ended: bool,
}

impl Lines {
    /// Waits until there is something for a group, and takes it. Says whether there was any: not once everything was taken and nobody
    /// may bring more.
    async fn take(&mut self, group: &mut Vec<Job>) -> bool {
        let mut n_large_bytes = 0;
        while group.is_empty() {
            if self.has_small_ended && self.has_large_ended {
                return false;
            }
            tokio::select! {
                biased;
                () = self.closing.cancelled(), if !(self.small.is_closed() && self.large.is_closed()) => {
                    // What waits is still received.
                    self.small.close();
                    self.large.close();
                }
                n_jobs = self.small.recv_many(group, MAX_GROUP), if !self.has_small_ended => {
                    self.has_small_ended = n_jobs == 0;
                }
                job = self.large.recv(), if !self.has_large_ended => match job {
                    Some(job) => {
                        n_large_bytes += job.write.n_bytes();
                        group.push(job);
                    }
                    None => self.has_large_ended = true,
                },
            }
        }
        while n_large_bytes < MAX_LARGE_BYTES
            && group.len() < 2 * MAX_GROUP
            && let Ok(job) = self.large.try_recv()
        {
            n_large_bytes += job.write.n_bytes();
            group.push(job);
        }
        true
    }

    /// Takes what waits now, and nothing that comes meanwhile.
    fn drain(&mut self) -> impl Iterator<Item = Job> {
        let (n_small, n_large) = (self.small.len(), self.large.len());
        let small = (0..n_small).map_while(|_| self.small.try_recv().ok());
        small.chain((0..n_large).map_while(|_| self.large.try_recv().ok()))
    }
}

/// What the writer knows of the database without looking, as long as what it writes succeeds.
#[derive(Debug, Default)]
struct Known {
    arrivals: Arrivals,
    /// Learners that are marked as having rewards to fold.
    pending: FxHashSet<i64>,
}

/// The writer at work.
struct Open {
    database: Database,
    /// `None` after an error, until something is to be written.
    connection: Option<SqliteConnection>,
    readers: Arc<Readers>,
    tasks: TaskTracker,
    /// Roughly, since the last checkpoint was begun.
    n_logged_bytes: usize,
    /// The last checkpoint.
    checkpoint: Option<JoinHandle<()>>,
    known: Known,
    /// Whether no sign of life was written since the start, or since the database was unavailable.
    was_interrupted: bool,
    /// Why nothing could be written the last time, if that was so.
    trouble: Option<Unavailable>,
    models_generation: Arc<AtomicU64>,
}

impl Open {
    async fn run(mut self, mut lines: Lines) {
        let mut group = Vec::with_capacity(MAX_GROUP);
        loop {
            // Whoever is ready to go on may have something for this group too.
            tokio::task::yield_now().await;
            if !lines.take(&mut group).await {
                break;
            }
            match self.commit(&group).await {
                Ok(written) => {
                    for (job, written) in group.drain(..).zip(written) {
                        // Whoever waited may be gone.
                        let _ = job.answer.send(Ok(written));
                    }
                }
                Err(StoreError::Unavailable(unavailable)) => {
                    // Each on its own would fare no better.
                    for job in group.drain(..) {
                        let _ = job.answer.send(Err(unavailable.into()));
                    }
                    // What has waited meanwhile has waited as long for the lock.
                    if unavailable == Unavailable::Locked {
                        for job in lines.drain() {
                            let _ = job.answer.send(Err(unavailable.into()));
                        }
                    }
                }
                Err(_) if group.len() > 1 => {
                    // One write must not spoil the others: each gets a transaction and an error of its own.
                    for job in group.drain(..) {
                        let written = self.commit(std::slice::from_ref(&job)).await;
                        let written = written.and_then(|mut written| written.pop().ok_or(StoreError::Closed));
                        let _ = job.answer.send(written);
                    }
                }
                Err(error) => {
                    if let Some(job) = group.pop() {
                        let _ = job.answer.send(Err(error));
                    }
                }
            }
        }
        self.close().await;
    }

    /// Applies `group`. If it cannot be, what was known is forgotten, and the connection with it.
    async fn commit(&mut self, group: &[Job]) -> Result<Vec<Written>, StoreError> {
        let committed = self.try_commit(group).await;
        if group.iter().any(|job| matches!(job.write, Write::PutModel(_) | Write::DeleteModel(_))) {
            self.models_generation.fetch_add(1, Ordering::AcqRel);
        }
        match committed {
            Ok(written) => {
                self.n_logged_bytes += COMMIT_BYTES + group.iter().map(|job| job.write.n_bytes()).sum::<usize>();
                if self.n_logged_bytes >= CHECKPOINT_BYTES {
                    self.checkpoint();
                }
                if self.trouble.take().is_some() {
                    tracing::info!("the database takes writes again");
                }
                Ok(written)
            }
            Err(error) => Err(self.failed(error).await),
        }
    }

    async fn try_commit(&mut self, group: &[Job]) -> Result<Vec<Written>, StoreError> {
        let connection = match &mut self.connection {
            Some(connection) => connection,
            none => none.insert(self.database.connect().await?),
        };
        let gives_life = |job: &Job| matches!(job.write, Write::Alive(_) | Write::ExpireSessions { .. });
        let gives_life = group.iter().any(gives_life);
        let written = write_group(connection, &mut self.known, group, self.was_interrupted).await?;
        self.database.check_written()?;
        self.was_interrupted &= !gives_life;
        Ok(written)
    }

    /// Has the log copied to the database's file, beside the writing.
    fn checkpoint(&mut self) {
        if self.checkpoint.as_ref().is_none_or(JoinHandle::is_finished) {
            self.n_logged_bytes = 0;
            let readers = Arc::clone(&self.readers);
            self.checkpoint = Some(self.tasks.spawn(async move {
                if let Err(error) = readers.checkpoint().await {
                    // A commit does it, once the log is long; and where nothing can be written, writers are told so.
                    tracing::debug!(error = &error as &dyn std::error::Error, "the log was not copied");
                }
            }));
        }
    }

    async fn failed(&mut self, error: StoreError) -> StoreError {
        self.known = Known::default();
        if let Some(connection) = self.connection.take() {
            self.database.disconnect(connection).await;
        }
        let error = self.database.diagnose(error).await;
        if let StoreError::Unavailable(unavailable) = error {
            self.was_interrupted = true;
            if self.trouble.replace(unavailable) != Some(unavailable) {
                tracing::error!(error = &unavailable as &dyn std::error::Error, "nothing can be written for now");
            }
        }
        error
    }

    async fn close(mut self) {
        let Some(mut connection) = self.connection.take() else { return };
        if !self.known.arrivals.is_empty()
            && let Err(error) = settle(&mut connection, &mut self.known.arrivals).await
        {
            // They are durable where they are.
            tracing::warn!(
                error = &error as &dyn std::error::Error,
                "observations were left for the next start to settle"
            );
        }
        // Checkpoints the log, so that what is left behind is a single file.
        if let Err(error) = connection.close().await {
            tracing::warn!(error = &error as &dyn std::error::Error, "the database was not closed cleanly");
        }
    }
}

/// Applies `group`: durable when this returns.
async fn write_group(
    connection: &mut SqliteConnection,
    known: &mut Known,
    group: &[Job],
    was_interrupted: bool,
) -> Result<Vec<Written>, StoreError> {
    let observations = group.iter().map(|job| match &job.write {
        Write::AddObservations(new) => Some(new),
        _ => None,
    });
    let arrivals = &mut known.arrivals;
    let at_once = match observations.collect::<Option<Vec<_>>>() {
        None => add_policies(connection, group).await?,
        Some(news) if arrivals.is_known() && !arrivals.is_full() => {
            add_observations(connection, arrivals, &news).await?
        }
        Some(_) => None,
    };
    match at_once {
        Some(written) => Ok(written),
        None => transact(connection, known, group, was_interrupted).await,
    }
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
    known: &mut Known,
    group: &[Job],
    was_interrupted: bool,
) -> Result<Vec<Written>, StoreError> {
    let Known { arrivals, pending } = known;
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
    let observations = group.iter().filter_map(|job| match &job.write {
        Write::AddObservations(new) => Some(new),
        _ => None,
    });
    let observations: Vec<_> = observations.collect();
    let is_read = |job: &Job| {
        matches!(job.write, Write::EndSession(_) | Write::ExpireSessions { .. } | Write::Alive(_) | Write::Settle)
    };
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
            Write::Alive(alive) => {
                alive::note(&mut transaction, *alive, was_interrupted).await?;
                Some(Written::Done(true))
            }
            Write::ExpireSessions { before, alive } => {
                alive::note(&mut transaction, *alive, was_interrupted).await?;
                arrivals.expired();
                Some(Written::ExpireSessions(sessions::expire(&mut transaction, *before).await?))
            }
            Write::AddWeights { learner, weights } => {
                pending.remove(learner);
                Some(Written::AddWeights(learners::add_weights(&mut transaction, *learner, weights).await?))
            }
            write => Some(apply(&mut transaction, arrivals, write).await?),
        });
    }
    if !rewards.is_empty() {
        let put = trials::reward_all(&mut transaction, &rewards, pending).await?;
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
        Write::BeginRefinement(policy_id) => Written::Done(refinements::begin(connection, policy_id).await?),
        Write::ReturnRefinement(policy_id) => {
            refinements::give_back(connection, policy_id).await?;
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
        // Was done before.
        Write::Settle => Written::Done(true),
        Write::PutLearner(learner) => Written::PutLearner(learners::put(connection, learner).await?),
        Write::DeleteLearner(name) => Written::DeleteLearner(learners::delete(connection, name).await?),
        Write::AddTrial(trial) => Written::AddTrial(trials::add(connection, trial).await?),
        Write::FailTrial { id, reason } => {
            Written::FailTrial(Box::new(trials::fail(connection, id, reason.as_deref()).await?))
        }
        Write::AddObservations(_)
        | Write::PutReward(_)
        | Write::Alive(_)
        | Write::ExpireSessions { .. }
        | Write::AddWeights { .. } => unreachable!("applied with what is known of others"),
    })
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use futures_util::future::join_all;
    use futures_util::{FutureExt, poll};
    use tokio::task::unconstrained;

    use super::*;
    use crate::store::database::{Locking, N_READERS};
    use crate::store::{NewObservations, NewSession, Store};

    fn policy(id: &str, n_bytes: usize) -> Write {
        let steps = vec![0; n_bytes];
        let (id, summary) = (id.to_owned(), "{}".to_owned());
        Write::AddPolicies(vec![NewPolicy { id, summary, steps, created_at: Timestamp::UNIX_EPOCH }], Vec::new())
    }

    async fn open(directory: &Path) -> Store {
        Store::open(&directory.join("etude.db"), &TaskTracker::new()).await.unwrap()
    }

    /// Sizes of what is in the next group.
    async fn group(lines: &mut Lines) -> Vec<usize> {
        let mut group = Vec::new();
        lines.take(&mut group).await;
        group.iter().map(|job| job.write.n_bytes() >> 10).collect()
    }

    #[tokio::test]
    async fn what_is_small_goes_first_and_of_what_is_large_each_has_its_turn() {
        let (writer, mut lines) = Writer::with_lines();
        let send = |n_kib: usize| Box::pin(writer.write(policy("p", n_kib << 10)));
        let mut sent: Vec<_> = [700, 800, 100, 200, 300, 5, 900, 1, 2].map(send).into();
        for sent in &mut sent {
            assert!(poll!(sent).is_pending());
        }
        assert_eq!(group(&mut lines).await, [1, 2, 700]);
        let mut later = send(3);
        assert!(poll!(&mut later).is_pending());
        assert_eq!(group(&mut lines).await, [3, 800]);
        assert_eq!(group(&mut lines).await, [100, 200, 300]);
        writer.close();
        assert_eq!(group(&mut lines).await, [5, 900], "what waits is still written");
        assert!(!lines.take(&mut Vec::new()).await);
        assert!(matches!(writer.write(policy("p", 0)).await, Err(StoreError::Closed)));
    }

    #[tokio::test]
    async fn lines_end_with_those_who_might_bring_something() {
        let (writer, mut lines) = Writer::with_lines();
        let mut group = Vec::new();
        let mut taken = Box::pin(lines.take(&mut group));
        assert!(poll!(&mut taken).is_pending());
        drop(writer);
        assert!(!taken.await);
    }

    #[tokio::test(start_paused = true)]
    async fn who_does_not_get_in_line_for_long_is_told_so() {
        let (writer, mut lines) = Writer::with_lines();
        let waiting = (0..MAX_WAITING).map(|_| writer.write(Write::Settle));
        let mut waiting = Box::pin(join_all(waiting));
        assert!(poll!(&mut waiting).is_pending());
        let one_more = writer.write(Write::Settle).await;
        assert!(matches!(one_more, Err(StoreError::Unavailable(Unavailable::Slow))), "{one_more:?}");
        assert!(poll!(&mut waiting).is_pending());
        assert_eq!(lines.drain().count(), MAX_WAITING, "it is not written later");
    }

    #[tokio::test]
    async fn who_has_waited_behind_a_locked_database_does_not_wait_as_long_once_more() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("etude.db");
        let mut database = Database::new(&path, Locking::None).unwrap();
        let mut connection = database.connect().await.unwrap();
        sqlx::query("PRAGMA busy_timeout = 1").execute(&mut connection).await.unwrap();
        let mut other = Database::new(&path, Locking::None).unwrap().connect().await.unwrap();
        let held = other.begin_with("BEGIN IMMEDIATE").await.unwrap();
        let readers = database.readers().unwrap();
        let writer = Writer::start(database, Some(connection), readers, &TaskTracker::new());
        let sizes = [0; MAX_GROUP + 1].into_iter().chain([1 << 20; 2]);
        let mut sent: Vec<_> = sizes.map(|n_bytes| Box::pin(writer.write(policy("p", n_bytes)))).collect();
        for sent in &mut sent {
            assert!(poll!(sent).is_pending());
        }
        let is_locked =
            |written: Result<Written, StoreError>| matches!(written, Err(StoreError::Unavailable(Unavailable::Locked)));
        assert!(is_locked(sent.remove(0).await));
        assert!(sent.into_iter().all(|sent| unconstrained(sent).now_or_never().is_some_and(is_locked)));
        held.rollback().await.unwrap();
        writer.write(policy("p", 0)).await.unwrap();
    }

    #[tokio::test]
    async fn a_session_is_resumed_behind_what_was_large_and_sent_for_the_owner_before() {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path()).await;
        let session = NewSession {
            id: "s".to_owned(),
            model: "m".to_owned(),
            model_hash: "0".to_owned(),
            weights: [("x".into(), 1.0)].into_iter().collect(),
            lookahead: None,
            start: None,
            learner: None,
            weights_version: None,
            trial: None,
            created_at: Timestamp::UNIX_EPOCH,
        };
        assert!(store.open_session(session).await.unwrap());
        let mut others: Vec<_> = ["a", "b", "c"].map(|id| Box::pin(store.writer.write(policy(id, 1 << 20)))).into();
        for other in &mut others {
            assert!(poll!(other).is_pending());
        }
        let states = format!("[{}1]", " ".repeat(2 * MAX_SMALL_BYTES));
        let at = Timestamp::UNIX_EPOCH;
        let new = NewObservations { session_id: "s".to_owned(), seq: 0, n_states: 1, states, at };
        assert!(poll!(Box::pin(store.add_observations(new))).is_pending(), "and its owner is gone");
        assert!(store.touch_session_behind_all("s", at).await.unwrap());
        assert_eq!(store.session("s").await.unwrap().unwrap().n_observations, 1);
        // So that it is not only the order in which things happen to go.
        assert!(others.into_iter().all(|other| other.now_or_never().is_some()));
    }

    #[tokio::test]
    async fn a_commit_leaves_it_to_others_to_copy_the_log() {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path()).await;
        let n_bytes = || fs::metadata(directory.path().join("etude.db")).unwrap().len();
        // As long as nobody else can.
        let mut taken = Vec::new();
        for _ in 0..N_READERS {
            taken.push(store.reader().await.unwrap());
        }
        store.writer.write(policy("a", CHECKPOINT_BYTES)).await.unwrap();
        store.writer.write(policy("b", 0)).await.unwrap();
        assert!(n_bytes() < CHECKPOINT_BYTES as u64);
        taken.clear();
        while n_bytes() < CHECKPOINT_BYTES as u64 {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn copying_the_log_is_no_writing_by_others() {
        let directory = tempfile::tempdir().unwrap();
        let store = open(directory.path()).await;
        let version = "SELECT data_version FROM pragma_data_version";
        let mut connection = store.reader().await.unwrap();
        let before: i64 = sqlx::query_scalar(version).fetch_one(&mut *connection).await.unwrap();
        store.readers.checkpoint().await.unwrap();
        assert_eq!(sqlx::query_scalar::<_, i64>(version).fetch_one(&mut *connection).await.unwrap(), before);
    }
}
