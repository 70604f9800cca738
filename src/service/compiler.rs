//! Models made ready to be searched: read from the store, compiled once, however many ask for them.
//!
//! ```text
//! whoever asks first: a place in the pool -> a task: store -> memory -> pool -> cache
//!                                                |
//! whoever asks meanwhile, without a place -------+ waits for it, until its deadline
//! ```
//!
//! A compilation that was begun is finished even if nobody waits for it any more, so that the next request finds the model. A requester that
//! goes away leaves no state behind.

mod experienced;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::future::OptionFuture;
use rustc_hash::FxHashMap;
use sha2::{Digest, Sha256};
use tokio::sync::watch;
use tokio_util::task::TaskTracker;
use tracing::Instrument;

use super::cache::MapperCache;
use super::definitions::{DefinitionReader, ModelText, check_hash, corrupt_definition, unknown};
use super::hash::hex;
use super::limited::LimitedTime;
use super::pool::Admission;
use super::told::Experiences;
use super::{Etude, PipeWriter, PoolError, SearchPool, ServiceError, Settings, pipe};
use crate::client::Client;
use crate::clock::Clock;
use crate::memory::{Held, Memory, NoRoom};
use crate::store::{ModelKey, ModelSize, ModelSummary, Store, StoredDefinition};
use etude_core::document::Faults;
use etude_core::interrupt::{Interrupt, Interrupted};
use etude_core::mapping::Mapper;
use etude_core::model::{CompileError, Definition, Format, Limits, Model, ReadError};

/// Makes models ready, and keeps as many as fit.
#[derive(Clone, Debug)]
pub(super) struct Compiler {
    store: Arc<Store>,
    pool: SearchPool,
    clock: Clock,
    pub(super) cache: Arc<MapperCache>,
    memory: Memory,
    max_time: Duration,
    tasks: TaskTracker,
    /// What models of experience were told.
    pub(super) experiences: Experiences,
    /// What is being made ready.
    coming: Arc<Mutex<FxHashMap<Asked, Coming>>>,
}

/// What is being made ready.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Asked {
    /// The model with this key.
    Exactly(ModelKey),
    /// The model of experience of this name, as it is now: it had this key when it was asked for.
    Current(String, ModelKey),
}

/// Completes with the model and its hash, or with why there is none.
type Coming = watch::Receiver<Option<Result<(String, Arc<Mapper>), Arc<ServiceError>>>>;

/// A model is being made ready until this is dropped.
struct Begun {
    compiler: Compiler,
    asked: Asked,
}

impl Drop for Begun {
    fn drop(&mut self) {
        self.compiler.coming().remove(&self.asked);
    }
}

impl Asked {
    fn key(&self) -> &ModelKey {
        let (Self::Exactly(key) | Self::Current(_, key)) = self;
        key
    }
}

impl Compiler {
    pub(super) fn new(store: Arc<Store>, pool: SearchPool, settings: &Settings, tasks: TaskTracker) -> Self {
        Self {
            experiences: Experiences::new(Arc::clone(&store), pool.clone(), settings.memory.clone(), tasks.clone()),
            store,
            pool,
            clock: settings.clock.clone(),
            cache: Arc::new(MapperCache::new(settings.model_cache_bytes)),
            memory: settings.memory.clone(),
            max_time: settings.time_limits.compile,
            tasks,
            coming: Arc::default(),
        }
    }

    fn coming(&self) -> MutexGuard<'_, FxHashMap<Asked, Coming>> {
        self.coming.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the memory for a compilation that needs about `n_bytes`. If there is too little, large models that nobody searches now are
    /// evicted, which takes time.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if there is not so much.
    pub(super) fn take(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        /// Where values differ from state to state, compiling takes up to three times the estimate from the counts. At most half of the
        /// memory that is free beyond the estimate is taken, as others search meanwhile; what was not needed is given back.
        const MOST_OF_COUNTED: u64 = 3;
        let beyond = self.memory.free_for_large().saturating_sub(n_bytes) / 2;
        let n_bytes = n_bytes + beyond.min((MOST_OF_COUNTED - 1) * n_bytes);
        self.memory.try_take(n_bytes).or_else(|_| {
            drop(self.cache.make_room(n_bytes.saturating_sub(self.memory.free_for_large())));
            self.experiences.make_room();
            self.memory.try_take(n_bytes)
        })
    }

    /// Compiles `definition`, for which `held` was taken, and takes what the model needs from then on.
    ///
    /// # Errors
    ///
    /// If the service ends, it takes too long, or there is no memory for it.
    pub(super) fn compile(
        &self,
        definition: Definition,
        mut held: Held,
        limits: Limits,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapper, ServiceError> {
        /// The memory that was taken is only an estimate.
        const SLACK_BYTES: u64 = 16 << 20;
        let max_bytes = usize::try_from(held.n_bytes() + SLACK_BYTES).unwrap_or(usize::MAX);
        let mut limited = LimitedTime::new(interrupt, self.max_time, self.clock.clone());
        let model = Model::compile(&definition, limits, &mut limited)?;
        drop(definition);
        let mapper = Mapper::within(model, max_bytes, &mut limited)?;
        let n_bytes = mapper.size_bytes() as u64;
        held.shrink_to(n_bytes);
        held.grow_to(n_bytes)?;
        Ok(mapper.keeping(held))
    }

    /// Runs what is to come to its end, even if its caller goes away.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> Result<T, PoolError> {
        self.tasks.spawn(task).await.map_err(|_| PoolError::Panicked)
    }

    /// Begins to make the model with this name ready, by its `place` in the pool, if it has one; or joins whoever has.
    ///
    /// # Errors
    ///
    /// [`PoolError::Busy`] if there is no place for it.
    fn begin(&self, name: &str, asked: &Asked, place: Option<&Admission>) -> Result<Coming, ServiceError> {
        let mut coming = self.coming();
        if let Some(begun) = coming.get(asked) {
            return Ok(begun.clone());
        }
        if let Some(mapper) = self.cache.get(asked.key()) {
            return Ok(watch::channel(Some(Ok((asked.key().hash.clone(), mapper)))).1);
        }
        // It waits for its turn even if its first requester leaves.
        let place = place.map(|place| place.clone().waiting_until(None));
        if let Some(place) = &place {
            place.take()?;
        }
        let (sender, receiver) = watch::channel(None);
        coming.insert(asked.clone(), receiver.clone());
        let (name, begun) = (name.to_owned(), Begun { compiler: self.clone(), asked: asked.clone() });
        let making = async move {
            let Begun { compiler, asked } = &begun;
            let made = Box::pin(compiler.make_ready(name, asked, place)).await;
            // From here on, it is found in the cache.
            drop(begun);
            sender.send_replace(Some(made.map_err(Arc::new)));
        };
        self.tasks.spawn(making.instrument(tracing::Span::current()));
        Ok(receiver)
    }

    /// Makes the model with this name ready, and puts it into the cache.
    async fn make_ready(
        &self,
        name: String,
        asked: &Asked,
        place: Option<Admission>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        let unknown = || unknown(&name, None);
        let key = asked.key();
        // If the model was deleted and registered anew in between, its hash differs, and the next request finds the new one.
        let row = self.store.model(&name).await?.ok_or_else(unknown)?;
        if row.experience.is_some() {
            return self.make_experienced_ready(&name, asked, place).await;
        }
        if row.summary.hash != key.hash {
            return Err(unknown());
        }
        let n_attributes = row.summary.attributes.len();
        let needed = |size: ModelSize| Model::compiled_bytes(size.n_states, size.n_transitions, n_attributes as u64);
        let n_bytes = row.summary.size.map_or(0, needed);
        // Off the async threads, as freeing evicted models may take long.
        let compiler = self.clone();
        let taking = self.tasks.spawn_blocking(move || compiler.take(n_bytes));
        let held = taking.await.map_err(|_| PoolError::Panicked)??;
        let (text, feed) = match row.definition {
            StoredDefinition::Text(text) => (ModelText::Whole(text.into_bytes()), None),
            StoredDefinition::Pieces(id) => {
                let (to_reader, reader) = pipe();
                let pieces = DefinitionReader::new(&row.summary, id);
                (ModelText::Packed(Box::new(|| Ok(Box::new(reader)))), Some(feed(&self.store, pieces, to_reader)))
            }
        };
        // Whether it is lazy was decided when it was registered, whatever the limit is now.
        let limits = if key.is_lazy { Limits { max_states: 0, ..Limits::NONE } } else { Limits::NONE };
        let compiler = self.clone();
        let ModelSummary { name: model, hash: expected, .. } = row.summary;
        let job = move |interrupt: &mut dyn Interrupt| {
            // The hash of pieces is checked as they are read.
            if let ModelText::Whole(text) = &text
                && let Err(error) = check_hash(&model, &hex(Sha256::digest(text)), &expected)
            {
                return Ok(Err(error));
            }
            let definition = text.read(&Format::Json.into(), Limits::NONE, interrupt);
            Ok(match definition {
                Ok(definition) => compiler.compile(definition, held, limits, interrupt),
                // A definition that was accepted has no faults, unless the row is damaged.
                Err(ReadError::Cancelled(_)) => Err(PoolError::Stopped.into()),
                Err(error) => Err(corrupt_definition(&model, error.into())),
            })
        };
        let compile = async {
            match &place {
                Some(place) => place.run(None, job).await,
                None => self.pool.run_in_turn(Client::LOCAL, job).await,
            }
        };
        let (mapper, fed) = tokio::join!(compile, OptionFuture::from(feed));
        match fed {
            // It was deleted meanwhile.
            Some(Err(ServiceError::Removed)) => return Err(unknown()),
            Some(Err(error)) => return Err(error),
            Some(Ok(())) | None => {}
        }
        let mapper = Arc::new(mapper??);
        self.put(key.clone(), &mapper).await;
        Ok((key.hash.clone(), mapper))
    }

    /// Puts a model that has just been compiled into the cache.
    pub(super) async fn put(&self, key: ModelKey, mapper: &Arc<Mapper>) {
        let (cache, mapper) = (Arc::clone(&self.cache), Arc::clone(mapper));
        // Off the async threads, as freeing evicted models may take long. It does not fail.
        let _ = self.tasks.spawn_blocking(move || cache.insert(&key, &mapper)).await;
    }
}

/// The error of a compilation, for one of those who waited for it.
fn shared(error: &ServiceError, name: &str, pointer: &'static str) -> ServiceError {
    match error {
        ServiceError::Unknown { .. } => unknown(name, Some(pointer)),
        ServiceError::Faults(faults) => faults.clone().into(),
        ServiceError::NothingExperienced { .. } => Faults::one(pointer, error.to_string()).into(),
        ServiceError::Pool(error) => (*error).into(),
        ServiceError::NoRoom(error) => (*error).into(),
        ServiceError::Unavailable(outage) => ServiceError::Unavailable(outage.clone()),
        ServiceError::Closed => ServiceError::Closed,
        ServiceError::Storage(error) => ServiceError::Storage(Arc::clone(error)),
        ServiceError::Unreadable { source, .. } => corrupt_definition(name, source.to_string().into()),
        // Compiling fails in no other way.
        error => corrupt_definition(name, error.to_string().into()),
    }
}

/// Sends the pieces of a definition to their reader.
async fn feed(store: &Store, mut pieces: DefinitionReader, to_reader: PipeWriter<Vec<u8>>) -> Result<(), ServiceError> {
    while let Some(piece) = pieces.next_in(store).await? {
        if !to_reader.send(Ok(piece)).await {
            return Ok(());
        }
    }
    to_reader.end().await;
    Ok(())
}

impl From<CompileError> for ServiceError {
    fn from(error: CompileError) -> Self {
        match error {
            CompileError::Faults(faults) => faults.into(),
            CompileError::Cancelled(cancelled) => Interrupted::from(cancelled).into(),
            CompileError::OutOfTime => Interrupted::OutOfTime.into(),
        }
    }
}

impl From<Interrupted> for ServiceError {
    fn from(interrupted: Interrupted) -> Self {
        match interrupted {
            Interrupted::Cancelled(_) => PoolError::Stopped.into(),
            Interrupted::OutOfTime => {
                let detail = "compiling the model takes longer than this service allows (ETUDE_MAX_COMPILE_TIME)";
                Faults::one("/dynamics", detail).into()
            }
        }
    }
}

impl Etude {
    /// The model called `name`, ready to be searched, and its hash. `pointer` is where a request names it; what must be
    /// compiled is compiled by its `place` in the pool, if it has one, and waited for until `deadline`.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Unknown`] if there is none, [`ServiceError::Compiling`] if it takes until after `deadline`, or if it cannot be
    /// compiled now.
    pub(super) async fn mapper(
        &self,
        name: &str,
        pointer: &'static str,
        place: Option<&Admission>,
        deadline: Option<Instant>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        let head = self.store.model_head(name).await?.ok_or_else(|| unknown(name, Some(pointer)))?;
        let asked = match head.experience {
            Some(_) => Asked::Current(name.to_owned(), head.key),
            None => Asked::Exactly(head.key),
        };
        self.made_ready(name, &asked, pointer, place, deadline).await
    }

    /// The model called `name` as it was when it had this hash. `None` if another one is there, or if it is one of experience that never had it.
    ///
    /// # Errors
    ///
    /// As [`Self::mapper`].
    pub(super) async fn mapper_with_hash(
        &self,
        (name, hash): (&str, &str),
        pointer: &'static str,
        place: Option<&Admission>,
        deadline: Option<Instant>,
    ) -> Result<Option<Arc<Mapper>>, ServiceError> {
        let head = self.store.model_head(name).await?.ok_or_else(|| unknown(name, Some(pointer)))?;
        let asked = match head.experience {
            Some(id) if self.store.revision(id, hash).await?.is_some() => {
                Asked::Exactly(ModelKey { hash: hash.to_owned(), ..head.key })
            }
            None if head.key.hash == hash => Asked::Exactly(head.key),
            Some(_) | None => return Ok(None),
        };
        let (_, mapper) = self.made_ready(name, &asked, pointer, place, deadline).await?;
        Ok(Some(mapper))
    }

    async fn made_ready(
        &self,
        name: &str,
        asked: &Asked,
        pointer: &'static str,
        place: Option<&Admission>,
        deadline: Option<Instant>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        if let Some(mapper) = self.compiler.cache.get(asked.key()) {
            return Ok((asked.key().hash.clone(), mapper));
        }
        let mut coming = self.compiler.begin(name, asked, place)?;
        let ready = coming.wait_for(Option::is_some);
        let ready = match deadline {
            None => ready.await,
            Some(deadline) => match tokio::time::timeout_at(deadline.into(), ready).await {
                Ok(ready) => ready,
                Err(_) => return Err(ServiceError::Compiling { name: name.to_owned() }),
            },
        };
        match ready.ok().as_deref() {
            Some(Some(Ok((hash, mapper)))) => Ok((hash.clone(), Arc::clone(mapper))),
            Some(Some(Err(error))) => Err(shared(error, name, pointer)),
            Some(None) | None => Err(PoolError::Panicked.into()),
        }
    }
}

#[cfg(test)]
mod tests;
