//! What searches work with, kept for those that come: to take it anew from the allocator, and to see the states of a model anew, makes
//! searches of tens of microseconds take 1.8 to 2.7 times as long, and others up to 1.5 times.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{self, ThreadId};

use crate::interrupt::Cancelled;
use crate::mapping::heuristic::projected::TableBuffers;
use crate::mapping::search::{banded, best_first, layered};

/// Buffers of a search, kept to be used again.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    pub(super) solving: TableBuffers,
    pub(super) searching: best_first::SearchBuffers,
    pub(super) banded: banded::BandedBuffers,
    pub(super) layered: layered::LayeredBuffers,
}

impl Buffers {
    /// Searches of which they are kept: as many as there are processors for, mostly.
    const MAX_KEPT: usize = 4;

    /// Most that are kept of a search.
    const MAX_KEPT_BYTES: usize = 16 << 20;

    /// And no more than this part of what it may take.
    const PART_KEPT: usize = 8;

    /// How much memory they take, in bytes.
    fn size_bytes(&self) -> usize {
        let searching = self.searching.kept_bytes() + self.banded.kept_bytes() + self.layered.kept_bytes();
        size_of::<Self>() + self.solving.kept_bytes() + searching
    }
}

/// Buffers of searches that have ended: at most as many as ran at the same time, each with the thread that used it last, whose processor
/// may still have it in its cache. They are the mapper's and not the threads' own, so that they go when the model goes.
#[derive(Debug, Default)]
pub(super) struct BufferPool(Mutex<Vec<(ThreadId, Box<Buffers>)>>);

impl BufferPool {
    fn kept(&self) -> MutexGuard<'_, Vec<(ThreadId, Box<Buffers>)>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.kept().iter().map(|(_, buffers)| buffers.size_bytes()).sum()
    }

    /// Gives them back to the allocator.
    pub(super) fn release(&self) {
        drop(std::mem::take(&mut *self.kept()));
    }

    /// Does `work`, which may take so much memory, with buffers of work that was done before, if there are any.
    pub(super) fn lend<T>(
        &self,
        max_bytes: usize,
        work: impl FnOnce(&mut Buffers) -> Result<T, Cancelled>,
    ) -> Result<T, Cancelled> {
        let thread = thread::current().id();
        let take = |kept: &mut Vec<(ThreadId, Box<Buffers>)>| {
            let own = kept.iter().position(|(user, _)| *user == thread);
            own.or(kept.len().checked_sub(1)).map(|at| kept.swap_remove(at).1)
        };
        let mut buffers = take(&mut self.kept()).unwrap_or_default();
        let done = work(&mut buffers)?;
        // What is kept is there beside what a search goes on to do.
        if buffers.size_bytes() <= Buffers::MAX_KEPT_BYTES.min(max_bytes / Buffers::PART_KEPT) {
            let mut kept = self.kept();
            if kept.len() < Buffers::MAX_KEPT {
                kept.push((thread, buffers));
            }
        }
        Ok(done)
    }
}
