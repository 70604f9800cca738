//! Telling models of experience what was experienced.
//!
//! ```text
//! batch --> turn of its model --> read, counted in memory --> store: the batch, and the model's new hash, at once --> answered
//!                                       ^                       |
//!   tally and batches of the store -----+<-- failed, or replaced meanwhile
//! ```
//!
//! A batch is one row, whatever came before it. It becomes part of a model that can be searched only when somebody searches that.

use std::sync::Arc;

use serde_json::Value;
use tokio_util::bytes::Bytes;
use tracing::Instrument;

use super::hash::hash_of;
use super::requests::parse;
use super::search::MAX_INLINE_BYTES;
use super::told::{Experiences, Told};
use super::{Admission, Caller, Etude, Name, PoolError, SearchPool, ServiceError};
use crate::memory::{Held, Memory};
use crate::store::{AcceptedBatch, Revision, Store};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Cancelled, Interrupt, Interrupted};
use etude_core::model::{Batch, Limits, ReadError, Tally};

/// What became of a batch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExperienceAnswer {
    /// The name of the model.
    pub model: String,
    /// As the client calls it.
    pub batch: String,
    /// The hash of the model with it and all that came before it.
    pub hash: String,
    /// How many attributes that model has.
    pub n_attributes: usize,
    /// How many actions.
    pub n_actions: usize,
    /// How much there is of everything else.
    pub revision: Revision,
}

/// A batch, as it is sent.
#[derive(Clone, Debug)]
pub enum BatchText {
    /// JSON, with its name.
    Json(Bytes),
    /// JSON lines (NDJSON), a transition each.
    Lines {
        /// As the client calls it.
        batch: String,
        /// The lines.
        text: Bytes,
    },
}

/// A batch that is to be read against its model.
#[derive(Clone)]
enum Sent {
    Document(Arc<Value>),
    Lines { batch: Arc<str>, text: Bytes },
}

/// A batch on its way into a model.
struct Adding {
    model: String,
    sent: Sent,
    /// For the document, if it is much.
    _held: Option<Held>,
    /// Of its text.
    n_bytes: usize,
    pool: SearchPool,
    place: Admission,
    limits: Limits,
}

impl Etude {
    /// Tells the model called `name` a batch: it counts once, and is durable before this returns, however often it is
    /// told. Requests from then on use the new revision of the model; policies keep the hash of the one that they were made with, and
    /// sessions go on with theirs.
    ///
    /// # Errors
    ///
    /// [`ServiceError::BatchTaken`] if the model was told another batch of this name; if there is no such model, it is not one of
    /// experience, the text is no batch, or the service cannot do it now.
    pub async fn add_experience(
        &self,
        name: &Name,
        text: BatchText,
        caller: Caller,
    ) -> Result<ExperienceAnswer, ServiceError> {
        let place = self.pool.admit_when_needed(caller.client);
        let (n_bytes, sent, held) = match text {
            BatchText::Json(body) => {
                let n_bytes = body.len();
                let (document, held) = parse(body, &place, &self.memory).await?;
                (n_bytes, Sent::Document(Arc::new(document)), held)
            }
            BatchText::Lines { batch, text } => (text.len(), Sent::Lines { batch: batch.into(), text }, None),
        };
        let (model, pool, limits) = (name.to_string(), self.pool.clone(), self.limits);
        let adding = Adding { model, sent, _held: held, n_bytes, pool, place, limits };
        let (compiler, store, memory) = (self.compiler.clone(), Arc::clone(&self.store), self.memory.clone());
        // Once begun, it is done, even if the client does not wait for it: what is in memory would have to be counted anew.
        let adding = async move {
            let (answer, outdated) = add(&compiler.experiences, &store, &memory, adding).await?;
            if let Some(outdated) = outdated {
                compiler.forget(outdated).await;
            }
            Ok(answer)
        };
        self.compiler.run(adding.instrument(tracing::Span::current())).await?
    }
}

/// Adds a batch, and gives the hash that the model had before if that is new.
async fn add(
    experiences: &Experiences,
    store: &Store,
    memory: &Memory,
    adding: Adding,
) -> Result<(ExperienceAnswer, Option<String>), ServiceError> {
    /// Each time, the model was deleted or replaced just then.
    const MAX_TRIES: usize = 3;
    // Names that are nobody's take no room from others.
    experiences.head(&adding.model).await?;
    let mut room = experiences.lock(&adding.model).await;
    let mut reading = None;
    memory.reserve(&mut reading, COPIES * adding.n_bytes)?;
    for _ in 0..MAX_TRIES {
        let told = experiences.current(&adding.model, &mut room).await?;
        let sent = adding.sent.clone();
        let read = move |interrupt: &mut dyn Interrupt| {
            let read = read(&told.tally, &sent, interrupt)?;
            Ok((told, read))
        };
        let (told, read) = adding.run(read).await?;
        let answer = |told: &Told, batch: &str, hash: &str, revision| ExperienceAnswer {
            model: adding.model.clone(),
            batch: batch.to_owned(),
            hash: hash.to_owned(),
            n_attributes: told.tally.schema().len(),
            n_actions: told.tally.actions().len(),
            revision,
        };
        let batch = match read {
            Ok(batch) => batch,
            Err(faults) => {
                *room = Some(told);
                return Err(faults.into());
            }
        };
        if let Some(AcceptedBatch { content_hash, hash, revision }) =
            store.accepted_batch(told.experience, &batch.id).await?
        {
            let answer = answer(&told, &batch.id, &hash, revision);
            *room = Some(told);
            return if content_hash == hash_of(&batch.text) {
                Ok((answer, None))
            } else {
                Err(ServiceError::BatchTaken { model: answer.model, batch: answer.batch })
            };
        }
        let (this, model, limits) = (experiences.clone(), adding.model.clone(), adding.limits);
        let accepted = adding
            .run(move |_| {
                let mut told = told;
                let new = this.accept(&mut told, &model, &batch, limits);
                Ok((told, new, batch.id))
            })
            .await?;
        let (told, new, batch_id) = accepted;
        let new = match new {
            Ok(new) => new,
            Err(error) => {
                *room = Some(told);
                return Err(error);
            }
        };
        let (outdated, revision) = (new.hash_before.clone(), new.revision);
        // If this fails, nobody knows whether it is stored: then it is counted anew.
        if store.add_batch(new).await? {
            let answer = answer(&told, &batch_id, &told.hash, revision);
            *room = Some(experiences.store_tally(told).await);
            return Ok((answer, Some(outdated)));
        }
    }
    Err(PoolError::Busy.into())
}

/// What is read of a batch, and its text, are about so many times what was sent.
const COPIES: usize = 3;

impl Adding {
    /// Runs a job: here, if that is small.
    async fn run<T: Send + 'static>(
        &self,
        job: impl FnOnce(&mut dyn Interrupt) -> Result<T, Cancelled> + Send + 'static,
    ) -> Result<T, PoolError> {
        if self.n_bytes <= MAX_INLINE_BYTES { self.pool.run_here(None, job) } else { self.place.run(None, job).await }
    }
}

fn read(tally: &Tally, sent: &Sent, interrupt: &mut dyn Interrupt) -> Result<Result<Batch, Faults>, Cancelled> {
    let mut faults = Faults::default();
    // Nobody says how long it may take, and what is in memory can be read.
    let batch = match sent {
        Sent::Document(document) => {
            tally.read_batch(&Place::root(document), &mut faults, interrupt).map_err(|_: Interrupted| Cancelled)?
        }
        Sent::Lines { batch, text } => {
            tally.read_lines(batch, &**text, &mut faults, interrupt).map_err(|_: ReadError| Cancelled)?
        }
    };
    Ok(faults.check(batch))
}
