//! Which connection drives which session: one at a time, the newest.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use tokio::sync::OwnedMutexGuard;
use tokio_util::sync::CancellationToken;

/// Which connection drives which session.
#[derive(Debug, Default)]
pub(super) struct Owners {
    owners: Arc<Mutex<HashMap<String, Owner>>>,
}

#[derive(Debug)]
struct Owner {
    /// Held while a session is driven.
    driving: Arc<tokio::sync::Mutex<()>>,
    /// Cancelled when the newest owner is to give way.
    taken_over: CancellationToken,
    /// How many owners there were, to tell the newest.
    generation: u64,
}

/// The right to drive a session, until it is dropped.
#[derive(Debug)]
pub(super) struct Ownership {
    id: String,
    generation: u64,
    /// Cancelled when another connection takes the session over.
    pub(super) taken_over: CancellationToken,
    owners: Arc<Mutex<HashMap<String, Owner>>>,
    _driving: OwnedMutexGuard<()>,
}

impl Owners {
    /// Waits until whoever drives the session has given way.
    pub(super) async fn take(&self, id: &str) -> Ownership {
        let taken_over = CancellationToken::new();
        let (driving, generation) = {
            let mut owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
            let owner = owners.entry(id.to_owned()).or_insert_with(|| Owner {
                driving: Arc::default(),
                taken_over: CancellationToken::new(),
                generation: 0,
            });
            owner.taken_over.cancel();
            owner.taken_over = taken_over.clone();
            owner.generation += 1;
            (Arc::clone(&owner.driving), owner.generation)
        };
        let driving = driving.lock_owned().await;
        Ownership { id: id.to_owned(), generation, taken_over, owners: Arc::clone(&self.owners), _driving: driving }
    }
}

impl Drop for Ownership {
    fn drop(&mut self) {
        let mut owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
        if owners.get(&self.id).is_some_and(|owner| owner.generation == self.generation) {
            owners.remove(&self.id);
        }
    }
}
