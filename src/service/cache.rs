//! Models that are ready to be searched, as many as fit.

use std::sync::Arc;

use quick_cache::Weighter;
use quick_cache::sync::Cache;

use super::pool::Admission;
use super::{Etude, ServiceError};
use crate::mapping::Mapper;

/// Compiled models by the hash of their content, the least useful evicted. Concurrent requests for a model that is not
/// there compile it once.
#[derive(Debug)]
pub(super) struct MapperCache {
    cache: Cache<String, Arc<Mapper>, SizeBytes>,
}

#[derive(Clone, Debug)]
struct SizeBytes;

impl Weighter<String, Arc<Mapper>> for SizeBytes {
    fn weight(&self, _: &String, mapper: &Arc<Mapper>) -> u64 {
        mapper.size_bytes() as u64 + 1
    }
}

impl MapperCache {
    /// About how many models are expected; only a size to start with.
    const EXPECTED_ITEMS: usize = 64;

    pub(super) fn new(max_bytes: u64) -> Self {
        Self { cache: Cache::with_weighter(Self::EXPECTED_ITEMS, max_bytes, SizeBytes) }
    }

    /// Puts in a model that has just been compiled.
    pub(super) fn insert(&self, hash: String, mapper: Arc<Mapper>) {
        self.cache.insert(hash, mapper);
    }

    /// The model with this hash, if it is there.
    pub(super) fn get(&self, hash: &str) -> Option<Arc<Mapper>> {
        self.cache.get(hash)
    }

    /// The model with this hash; `compile` makes it if it is not there.
    pub(super) async fn get_or_compile<E>(
        &self,
        hash: &str,
        compile: impl Future<Output = Result<Arc<Mapper>, E>>,
    ) -> Result<Arc<Mapper>, E> {
        self.cache.get_or_insert_async(hash, compile).await
    }
}

/// Hashes of models by name, each with the generation of the table of models that it was read from: known for as long as no
/// model is registered or deleted.
#[derive(Debug)]
pub(super) struct ModelNames {
    hashes: Cache<String, (u64, Arc<str>)>,
}

impl ModelNames {
    /// Most names that are kept.
    const MAX_NAMES: usize = 1024;

    pub(super) fn new() -> Self {
        Self { hashes: Cache::new(Self::MAX_NAMES) }
    }
}

impl Etude {
    /// As [`Self::mapper`], without a look at the database if no model was registered or deleted since the last one. The
    /// database is this process's alone, as far as models go.
    pub(super) async fn known_mapper(
        &self,
        name: &str,
        pointer: &'static str,
        place: &Admission,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        // Before anything is read: what changes meanwhile makes what was read outdated.
        let generation = self.store.models_generation();
        if let Some((known, hash)) = self.model_names.hashes.get(name)
            && known == generation
            && let Some(mapper) = self.mappers.get(&hash)
        {
            return Ok((hash.to_string(), mapper));
        }
        let (hash, mapper) = self.mapper(name, pointer, Some(place)).await?;
        self.model_names.hashes.insert(name.to_owned(), (generation, hash.as_str().into()));
        Ok((hash, mapper))
    }
}
