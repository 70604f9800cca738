//! Models that are ready to be searched, as many as fit.

use std::sync::Arc;

use quick_cache::Weighter;
use quick_cache::sync::Cache;

use crate::mapping::Mapper;
use crate::store::ModelKey;

/// Compiled models by the hash of their content, the least useful evicted. Concurrent requests for a model that is not
/// there compile it once.
#[derive(Debug)]
pub(super) struct MapperCache {
    cache: Cache<ModelKey, Arc<Mapper>, SizeBytes>,
}

#[derive(Clone, Debug)]
struct SizeBytes;

impl Weighter<ModelKey, Arc<Mapper>> for SizeBytes {
    fn weight(&self, _: &ModelKey, mapper: &Arc<Mapper>) -> u64 {
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
    pub(super) fn insert(&self, key: ModelKey, mapper: Arc<Mapper>) {
        self.cache.insert(key, mapper);
    }

    /// The model with this key; `compile` makes it if it is not there.
    pub(super) async fn get_or_compile<E>(
        &self,
        key: &ModelKey,
        compile: impl Future<Output = Result<Arc<Mapper>, E>>,
    ) -> Result<Arc<Mapper>, E> {
        self.cache.get_or_insert_async(key, compile).await
    }
}
