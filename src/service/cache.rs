//! Models that are ready to be searched, as many as fit.

use std::cmp::Reverse;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use quick_cache::sync::{Cache, DefaultLifecycle};
use quick_cache::{DefaultHashBuilder, OptionsBuilder, Weighter};

use super::pool::Admission;
use super::{Etude, ServiceError};
use crate::memory::SMALL_BYTES;
use crate::store::ModelKey;
use etude_core::mapping::Mapper;

/// Compiled models by the hash of their content, the least useful evicted.
///
/// A model that is larger than the whole cache is kept all the same until the next such one comes: compiling it takes longer than
/// most searches, and these need it in memory anyway. It takes up to a tenth of a second to free one, which is left to the threads that put
/// others in their place.
#[derive(Debug)]
pub(super) struct MapperCache {
    cache: Cache<ModelKey, Kept, SizeBytes>,
    /// How often something was asked for.
    n_asked: AtomicU64,
    oversized: Mutex<Option<(ModelKey, Arc<Mapper>)>>,
}

/// A model in the cache.
#[derive(Clone, Debug)]
struct Kept {
    mapper: Arc<Mapper>,
    /// What it took when it was put in. Long searches add to it, but the cache counts on a weight that stays the same.
    size_bytes: u64,
    /// How often something had been asked for when this was asked for last.
    used: Arc<AtomicU64>,
}

#[derive(Clone, Debug)]
struct SizeBytes;

impl Weighter<ModelKey, Kept> for SizeBytes {
    fn weight(&self, _: &ModelKey, kept: &Kept) -> u64 {
        kept.size_bytes
    }
}

impl MapperCache {
    /// About how many models are expected; only a size to start with.
    const EXPECTED_ITEMS: usize = 64;

    pub(super) fn new(max_bytes: u64) -> Self {
        let mut options = OptionsBuilder::new();
        // Of several shards, each would have a part of the capacity, and large models would fit into none.
        options.estimated_items_capacity(Self::EXPECTED_ITEMS).weight_capacity(max_bytes).shards(1);
        let options = options.build().expect("the sizes are given");
        let cache = Cache::with_options(options, SizeBytes, DefaultHashBuilder::default(), DefaultLifecycle::default());
        Self { cache, n_asked: AtomicU64::new(0), oversized: Mutex::default() }
    }

    /// Evicts large models that nobody searches now until `n_bytes` are given back; none if all of them together have less. Those go first that
    /// have taken the most for the longest: what is searched all the time would only be compiled again. Returns them, so that the caller frees
    /// them where nobody waits. Small models stay, as many requests would have to compile them again.
    #[must_use]
    pub(super) fn make_room(&self, n_bytes: u64) -> Vec<Arc<Mapper>> {
        let mut oversized = self.oversized.lock().unwrap_or_else(PoisonError::into_inner);
        let idle_oversized = oversized.as_ref().filter(|(_, mapper)| Arc::strong_count(mapper) == 1);
        let oversized_bytes = idle_oversized.map_or(0, |(_, mapper)| mapper.size_bytes() as u64);
        // One reference is the cache's, one is the iterator's.
        let idle =
            self.cache.iter().filter(|(_, kept)| kept.size_bytes > SMALL_BYTES && Arc::strong_count(&kept.mapper) == 2);
        let now = self.n_asked.load(Ordering::Relaxed);
        let wasted = |kept: &Kept| {
            u128::from(kept.size_bytes) * u128::from(1 + now - kept.used.load(Ordering::Relaxed).min(now))
        };
        let mut idle: Vec<_> = idle.map(|(key, kept)| (wasted(&kept), key, kept.size_bytes)).collect();
        if oversized_bytes + idle.iter().map(|(_, _, size_bytes)| size_bytes).sum::<u64>() < n_bytes {
            return Vec::new();
        }
        idle.sort_unstable_by_key(|(wasted, ..)| Reverse(*wasted));
        let mut gone = Vec::new();
        if oversized_bytes > 0 {
            gone.extend(oversized.take().map(|(_, mapper)| mapper));
        }
        let mut n_left = n_bytes.saturating_sub(oversized_bytes);
        for (_, key, size_bytes) in idle {
            if n_left == 0 {
                break;
            }
            gone.extend(self.cache.remove(&key).map(|(_, kept)| kept.mapper));
            n_left = n_left.saturating_sub(size_bytes);
        }
        gone
    }

    /// Puts in a model that has just been compiled. Frees what makes room for it.
    pub(super) fn insert(&self, key: &ModelKey, mapper: &Arc<Mapper>) {
        let (size_bytes, used) =
            (mapper.size_bytes() as u64 + 1, Arc::new(self.n_asked.load(Ordering::Relaxed).into()));
        self.cache.insert(key.clone(), Kept { mapper: Arc::clone(mapper), size_bytes, used });
        self.keep_if_oversized(key, mapper);
    }

    /// Takes out the model with this key, if it is there.
    pub(super) fn remove(&self, key: &ModelKey) -> Option<Arc<Mapper>> {
        let mut oversized = self.oversized.lock().unwrap_or_else(PoisonError::into_inner);
        let removed = oversized.take_if(|(kept, _)| kept == key).map(|(_, mapper)| mapper);
        drop(oversized);
        self.cache.remove(key).map(|(_, kept)| kept.mapper).or(removed)
    }

    /// The model with this key, if it is there.
    pub(super) fn get(&self, key: &ModelKey) -> Option<Arc<Mapper>> {
        let n_asked = self.n_asked.fetch_add(1, Ordering::Relaxed) + 1;
        let Some(kept) = self.cache.get(key) else { return self.oversized(key) };
        kept.used.store(n_asked, Ordering::Relaxed);
        Some(kept.mapper)
    }

    fn oversized(&self, key: &ModelKey) -> Option<Arc<Mapper>> {
        let oversized = self.oversized.lock().unwrap_or_else(PoisonError::into_inner);
        oversized.as_ref().filter(|(kept, _)| kept == key).map(|(_, mapper)| Arc::clone(mapper))
    }

    fn keep_if_oversized(&self, key: &ModelKey, mapper: &Arc<Mapper>) {
        // The cache keeps nothing that exceeds its hot part, most of it.
        if self.cache.peek(key).is_none() && mapper.size_bytes() as u64 > self.cache.capacity() / 2 {
            let kept = (key.clone(), Arc::clone(mapper));
            // What it replaces may take long to free: not while the lock is held.
            let replaced = self.oversized.lock().unwrap_or_else(PoisonError::into_inner).replace(kept);
            drop(replaced);
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use etude_core::document::{Faults, Place};
    use etude_core::interrupt::Uninterrupted;
    use etude_core::mapping::{Request, Settings};
    use etude_core::model::{Definition, Limits, Model};

    fn mapper(side: u32) -> Arc<Mapper> {
        let model = json!({"dynamics": {"kind": "wumpus", "width": side, "height": side}});
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap())
    }

    fn key(hash: &str) -> ModelKey {
        ModelKey { hash: hash.to_owned(), is_lazy: false }
    }

    /// Whether the model had to be compiled.
    fn is_compiled(cache: &MapperCache, key: &ModelKey, mapper: &Arc<Mapper>) -> bool {
        let is_compiled = cache.get(key).is_none();
        if is_compiled {
            cache.insert(key, mapper);
        }
        is_compiled
    }

    #[test]
    fn a_model_larger_than_the_cache_is_kept_until_the_next_such_one() {
        let (small, large) = (mapper(2), mapper(9));
        let cache = MapperCache::new(2 * small.size_bytes() as u64);
        assert!(large.size_bytes() > 2 * small.size_bytes());
        cache.insert(&key("small"), &small);
        cache.insert(&key("large"), &large);
        assert!(!is_compiled(&cache, &key("large"), &large));
        assert!(!is_compiled(&cache, &key("small"), &small), "it was not driven out");
        assert!(is_compiled(&cache, &key("other"), &large));
        assert!(!is_compiled(&cache, &key("other"), &large));
        assert!(is_compiled(&cache, &key("large"), &large));
    }

    #[test]
    fn a_model_that_grows_in_long_searches_leaves_the_cache_as_it_came() {
        let (growing, other) = (mapper(9), mapper(9));
        let size_bytes = growing.size_bytes();
        let cache = MapperCache::new(size_bytes as u64 * 3 / 2);
        cache.insert(&key("growing"), &growing);
        let object = json!({"model": "m", "demonstration": [{"x": 0}, {"x": 8}]});
        let mut faults = Faults::default();
        let object = Place::root(&object).object(Request::FIELDS, &mut faults).unwrap();
        let request = Request::read(growing.model(), &object, &mut faults).unwrap();
        growing.map(&request.problem, Settings::default(), &mut Uninterrupted).unwrap();
        assert!(growing.size_bytes() > size_bytes, "what it searched with is kept");
        for name in ["other", "growing", "other", "another", "other"] {
            cache.insert(&key(name), &other);
            assert!(cache.cache.weight() <= cache.cache.capacity(), "{}", cache.cache.weight());
            assert!(!is_compiled(&cache, &key(name), &other));
        }
    }

    #[test]
    fn what_makes_room_is_not_freed_while_others_wait_for_the_cache() {
        let (large, searched) = (mapper(60), mapper(60));
        let n_bytes = large.size_bytes() as u64;
        assert!(n_bytes > SMALL_BYTES);
        let cache = MapperCache::new(10 * n_bytes);
        cache.insert(&key("searched"), &searched);
        cache.insert(&key("large"), &large);
        drop(large);
        assert_eq!(cache.make_room(2 * n_bytes).len(), 0, "it would not be enough");
        let gone = cache.make_room(n_bytes);
        assert!(gone.iter().all(|mapper| Arc::strong_count(mapper) == 1) && gone.len() == 1);
        assert!(cache.get(&key("large")).is_none() && cache.get(&key("searched")).is_some());
    }

    #[test]
    fn what_has_taken_the_most_for_the_longest_makes_room_first() {
        let (large, larger) = (60, 70);
        let n_bytes = mapper(large).size_bytes() as u64;
        let cache = MapperCache::new(20 * n_bytes);
        let keep = |name: &str, side| cache.insert(&key(name), &mapper(side));
        let goes = || {
            let gone = cache.make_room(n_bytes / 2);
            let is_there = |name: &&str| cache.cache.peek(&key(name)).is_some();
            (gone.len(), ["searched", "other", "larger"].into_iter().filter(is_there).collect::<Vec<_>>())
        };
        keep("searched", large);
        keep("other", large);
        keep("larger", larger);
        assert_eq!(goes(), (1, vec!["searched", "other"]), "as long as the others");
        keep("larger", larger);
        for _ in 0..10 {
            drop((cache.get(&key("searched")), cache.get(&key("larger"))));
        }
        assert_eq!(goes(), (1, vec!["searched", "larger"]), "longer than the others");
    }

    #[test]
    fn a_model_that_fills_most_of_the_cache_is_kept_in_it() {
        let large = mapper(9);
        let cache = MapperCache::new(large.size_bytes() as u64 * 5 / 4);
        assert!(is_compiled(&cache, &key("large"), &large));
        assert!(!is_compiled(&cache, &key("large"), &large));
        assert!(cache.oversized(&key("large")).is_none());
    }
}

/// Keys of models by name, each with the generation of the model that it was read from: known for as long as no model of this name is
/// registered, changed or deleted.
#[derive(Debug)]
pub(super) struct ModelNames {
    keys: Cache<String, (u64, ModelKey)>,
}

impl ModelNames {
    /// Most names that are kept.
    const MAX_NAMES: usize = 1024;

    pub(super) fn new() -> Self {
        Self { keys: Cache::new(Self::MAX_NAMES) }
    }
}

impl Etude {
    /// As [`Self::mapper`], without a look at the database if it has not changed since the last one.
    pub(super) async fn known_mapper(
        &self,
        name: &str,
        pointer: &'static str,
        place: &Admission,
        deadline: Option<Instant>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        // Read before anything else, so that a change meanwhile makes the entry outdated.
        let generation = self.store.model_generation(name);
        if let Some(known) = self.mapper_at_hand(name) {
            return Ok(known);
        }
        // Boxed, as only the first request for a model needs it, and the future of every request would have its size.
        let (hash, mapper) = Box::pin(self.mapper(name, pointer, Some(place), deadline)).await?;
        if let Some(generation) = generation {
            let key = ModelKey { hash: hash.clone(), is_lazy: mapper.model().is_lazy() };
            self.model_names.keys.insert(name.to_owned(), (generation, key));
        }
        Ok((hash, mapper))
    }

    /// The mapper of the model called `name`, and the hash of that, if both are known without waiting for anything.
    pub(super) fn mapper_at_hand(&self, name: &str) -> Option<(String, Arc<Mapper>)> {
        let generation = self.store.model_generation(name)?;
        let (_, key) = self.model_names.keys.get(name).filter(|(known, _)| *known == generation)?;
        let mapper = self.compiler.cache.get(&key)?;
        Some((key.hash, mapper))
    }
}
