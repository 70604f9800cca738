//! When what was counted is stored, and how it is taken back.

use std::sync::Arc;

use super::{Experiences, Told};
use crate::store::StoredTally;

impl Experiences {
    /// Has what `told` has counted stored, if it would take long to count what came since that was done last. Nobody waits for it.
    pub(in crate::service) async fn store_tally(&self, told: Told) -> Told {
        if told.n_since_stored < told.due() {
            return told;
        }
        // Where there is no room for it, it is stored later.
        let Ok(held) = self.memory.try_take(told.tally.size_bytes() as u64) else { return told };
        let write = move || {
            let mut told = told;
            let content = postcard::to_allocvec(&told.tally.kept());
            told.n_since_stored = 0;
            (told, content)
        };
        let (told, content) = match self.tasks.spawn_blocking(write).await {
            Ok(written) => written,
            Err(panicked) => std::panic::resume_unwind(panicked.into_panic()),
        };
        // It is written to memory, which does not fail.
        let Ok(content) = content else { return told };
        let (store, experience) = (Arc::clone(&self.store), told.experience);
        let tally = StoredTally { seq: told.n_batches, hash: told.hash.clone(), content };
        self.tasks.spawn(async move {
            let _held = held;
            if let Err(error) = store.put_tally(experience, tally).await {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "what a model was told is counted again at the next start"
                );
            }
        });
        told
    }
}

impl Told {
    /// How many transitions may come before the tally is stored again: what is counted again takes a part of a second at most, or about as
    /// long as it takes to read what is stored; and all that is ever stored is a small multiple of the last.
    fn due(&self) -> usize {
        /// Some 50 ms on one core.
        const LEAST: usize = 20_000;
        LEAST.max(self.tally.n_outcomes() / 4)
    }

    /// This, once it has counted what is stored; as it is, if that cannot be read.
    pub(super) fn with(self, stored: &StoredTally) -> Self {
        let kept = postcard::from_bytes(&stored.content).ok();
        let tally = kept.and_then(|kept| self.tally.clone().with_kept(kept));
        let Some(tally) = tally else {
            tracing::warn!(seq = stored.seq, "what is stored of a tally is none of its model, and is counted again");
            return self;
        };
        let mut told = Self { hash: stored.hash.clone(), n_batches: stored.seq, tally, ..self };
        told.held.shrink_to(told.tally.size_bytes() as u64);
        told
    }
}
