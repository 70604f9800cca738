//! Models made ready to be searched: read from the store, compiled once, however many ask for them.
//!
//! What was begun is finished, also if nobody waits for it any more: whoever asks again finds it.

use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::future::OptionFuture;
use sha2::{Digest, Sha256};
use tokio_util::task::TaskTracker;
use tracing::Instrument;

use super::cache::MapperCache;
use super::models::{DefinitionReader, ModelText, check_hash, corrupt_definition, unknown};
use super::pool::Admission;
use super::{Client, Etude, PipeWriter, PoolError, SearchPool, ServiceError, Settings, pipe};
use crate::document::Faults;
use crate::interrupt::{Interrupt, Interrupted, Signal};
use crate::mapping::Mapper;
use crate::memory::{Held, Memory, NoRoom};
use crate::model::{Definition, Format, Limits, Model, ReadError, hex};
use crate::store::{ModelKey, ModelSize, ModelSummary, Store, StoreError, StoredDefinition};

/// Makes models ready, and keeps as many as fit.
#[derive(Clone, Debug)]
pub(super) struct Compiler {
    store: Arc<Store>,
    pool: SearchPool,
    pub(super) cache: Arc<MapperCache>,
    memory: Memory,
    max_time: Duration,
    tasks: TaskTracker,
}

impl Compiler {
    pub(super) fn new(store: Arc<Store>, pool: SearchPool, settings: &Settings, tasks: TaskTracker) -> Self {
        Self {
            store,
            pool,
            cache: Arc::new(MapperCache::new(settings.model_cache_bytes)),
            memory: settings.memory.clone(),
            max_time: settings.time_limits.compile,
            tasks,
        }
    }

    /// Takes the memory for compiling what needs about `n_bytes`, in place of large models that nobody searches now if need be.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if there is not so much.
    pub(super) fn take(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        /// Where values differ from state to state, it takes up to three times what counts tell. If there is so much, it is taken, and
        /// given back once it is known what was needed.
        const MOST_OF_COUNTED: u64 = 3;
        let n_bytes = (MOST_OF_COUNTED * n_bytes).min(n_bytes.max(self.memory.free_for_large()));
        self.memory.try_take(n_bytes).or_else(|_| {
            self.cache.make_room(n_bytes.saturating_sub(self.memory.free_for_large()));
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
        /// What was taken is a good guess, not more.
        const SLACK_BYTES: u64 = 16 << 20;
        let max_bytes = usize::try_from(held.n_bytes() + SLACK_BYTES).unwrap_or(usize::MAX);
        let mut limited = LimitedTime::new(interrupt, self.max_time);
        let model = Model::compile(&definition, limits, &mut limited)?;
        drop(definition);
        let mapper = Mapper::within(model, max_bytes, &mut limited)?;
        let n_bytes = mapper.size_bytes() as u64;
        held.shrink_to(n_bytes);
        held.grow_to(n_bytes)?;
        Ok(mapper.keeping(held))
    }

    /// The model with this name and key, ready to be searched; compiled by its `place` in the pool, if it has one.
    async fn ready(
        self,
        name: String,
        key: ModelKey,
        place: Option<Admission>,
        pointer: &'static str,
    ) -> Result<Arc<Mapper>, ServiceError> {
        let unknown = || unknown(&name, Some(pointer));
        let compile = async {
            // Deleted and registered anew in between, it has another hash; then the next request finds that.
            let row = self.store.model(&name).await?.filter(|row| row.summary.hash == key.hash).ok_or_else(unknown)?;
            let n_attributes = row.summary.attributes.len();
            let needed =
                |size: ModelSize| Model::compiled_bytes(size.n_states, size.n_transitions, n_attributes as u64);
            let held = self.take(row.summary.size.map_or(0, needed))?;
            let (text, feed) = match row.definition {
                StoredDefinition::Text(text) => (ModelText::Whole(text.into_bytes()), None),
                StoredDefinition::Pieces(id) => {
                    let (to_reader, reader) = pipe();
                    let pieces = DefinitionReader::new(&row.summary, id);
                    (ModelText::Packed(Box::new(|| Ok(Box::new(reader)))), Some(feed(&self.store, pieces, to_reader)))
                }
            };
            // What it was found to be when it was registered, whatever the limit is now.
            let limits = if key.is_lazy { Limits { max_states: 0, ..Limits::NONE } } else { Limits::NONE };
            let compiler = self.clone();
            let ModelSummary { name: model, hash: expected, .. } = row.summary;
            let job = move |interrupt: &mut dyn Interrupt| {
                // That of pieces is checked as they come.
                if let ModelText::Whole(text) = &text
                    && let Err(error) = check_hash(&model, &hex(&Sha256::digest(text)), &expected)
                {
                    return Ok(Err(error.into()));
                }
                let definition = text.read(Format::Json, Limits::NONE, interrupt);
                Ok(match definition {
                    Ok(definition) => compiler.compile(definition, held, limits, interrupt),
                    // What was once accepted is read again without faults.
                    Err(ReadError::Cancelled(_)) => Err(PoolError::Stopped.into()),
                    Err(error) => Err(corrupt_definition(&model, error.into())),
                })
            };
            let compile = async {
                match &place {
                    Some(place) => place.run(None, job).await,
                    None => self.pool.run_patiently(Client::LOCAL, job).await,
                }
            };
            let (mapper, fed) = tokio::join!(compile, OptionFuture::from(feed));
            match fed {
                // It was deleted meanwhile.
                Some(Err(ServiceError::Store(StoreError::Removed))) => return Err(unknown()),
                Some(Err(error)) => return Err(error),
                Some(Ok(())) | None => {}
            }
            Ok(Arc::new(mapper??))
        };
        self.cache.get_or_compile(&key, compile).await
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

/// Ends what takes too long, not counting the time in which it makes way for others.
pub(super) struct LimitedTime<'i> {
    inner: &'i mut dyn Interrupt,
    left: Duration,
    last: Instant,
}

impl<'i> LimitedTime<'i> {
    pub(super) fn new(inner: &'i mut dyn Interrupt, max_time: Duration) -> Self {
        Self { inner, left: max_time, last: Instant::now() }
    }
}

impl Interrupt for LimitedTime<'_> {
    fn poll(&mut self) -> Signal {
        self.left = self.left.saturating_sub(self.last.elapsed());
        let signal = self.inner.poll();
        self.last = Instant::now();
        if signal == Signal::Continue && self.left.is_zero() { Signal::Finish } else { signal }
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
        let key = self.store.model_key(name).await?.ok_or_else(|| unknown(name, Some(pointer)))?;
        let hash = key.hash.clone();
        if let Some(mapper) = self.compiler.cache.get(&key) {
            return Ok((hash, mapper));
        }
        let compiler = self.compiler.clone();
        let tasks = compiler.tasks.clone();
        let ready = compiler.ready(name.to_owned(), key, place.cloned(), pointer);
        let ready = tasks.spawn(ready.instrument(tracing::Span::current()));
        let ready = match deadline {
            None => ready.await,
            Some(deadline) => match tokio::time::timeout_at(deadline.into(), ready).await {
                Ok(ready) => ready,
                Err(_) => return Err(ServiceError::Compiling { name: name.to_owned() }),
            },
        };
        Ok((hash, ready.map_err(|_| PoolError::Panicked)??))
    }
}
