//! Which connection drives which session: one at a time, the newest.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
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
    /// Held while a session is driven; shared with all who drive it or wait for that.
    driving: Arc<tokio::sync::Mutex<()>>,
    /// Cancelled when the newest owner is to give way.
    taken_over: CancellationToken,
}

/// The right to drive a session, until it is dropped.
#[derive(Debug)]
pub(super) struct Ownership {
    id: String,
    /// Cancelled when another connection takes the session over.
    pub(super) taken_over: CancellationToken,
    owners: Arc<Mutex<HashMap<String, Owner>>>,
    /// `None` while it is waited for.
    driving: Option<OwnedMutexGuard<()>>,
}

/// Another connection has taken the session over meanwhile.
#[derive(Debug)]
pub(super) struct TakenOver;

impl Owners {
    /// Tells whoever drives the session, or waits for that, to give way: it is deleted.
    pub(super) fn dismiss(&self, id: &str) {
        let owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(owner) = owners.get(id) {
            owner.taken_over.cancel();
        }
    }

    /// The right to drive a session, if nobody drives it or waits for that.
    pub(super) fn try_take(&self, id: &str) -> Option<Ownership> {
        let mut owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
        let Entry::Vacant(vacant) = owners.entry(id.to_owned()) else { return None };
        let owner = vacant.insert(Owner { driving: Arc::default(), taken_over: CancellationToken::new() });
        let taken_over = owner.taken_over.clone();
        let driving = Arc::clone(&owner.driving).try_lock_owned().ok();
        drop(owners);
        Some(Ownership { id: id.to_owned(), taken_over, owners: Arc::clone(&self.owners), driving })
    }

    /// Waits until whoever drives the session has given way.
    ///
    /// # Errors
    ///
    /// [`TakenOver`] if a newer owner came while this one waited.
    pub(super) async fn take(&self, id: &str) -> Result<Ownership, TakenOver> {
        let taken_over = CancellationToken::new();
        let driving = {
            let mut owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
            let owner = owners
                .entry(id.to_owned())
                .or_insert_with(|| Owner { driving: Arc::default(), taken_over: CancellationToken::new() });
            owner.taken_over.cancel();
            owner.taken_over = taken_over.clone();
            Arc::clone(&owner.driving)
        };
        // A caller that stops waiting here leaves nothing behind either.
        let owners = Arc::clone(&self.owners);
        let mut ownership = Ownership { id: id.to_owned(), taken_over, owners, driving: None };
        tokio::select! {
            biased;
            () = ownership.taken_over.cancelled() => Err(TakenOver),
            driving = driving.lock_owned() => {
                ownership.driving = Some(driving);
                Ok(ownership)
            }
        }
    }
}

impl Drop for Ownership {
    fn drop(&mut self) {
        let mut owners = self.owners.lock().unwrap_or_else(PoisonError::into_inner);
        self.driving = None;
        // If only the map shares it, nobody else drives the session or waits for that; newcomers wait for this lock.
        if owners.get(&self.id).is_some_and(|owner| Arc::strong_count(&owner.driving) == 1) {
            owners.remove(&self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::poll;

    use super::*;

    fn n_kept(owners: &Owners) -> usize {
        owners.owners.lock().unwrap().len()
    }

    #[tokio::test]
    async fn who_stops_waiting_leaves_nothing_behind_and_lets_nobody_in() {
        let owners = Owners::default();
        let first = owners.take("a").await.unwrap();
        let mut second = Box::pin(owners.take("a"));
        assert!(poll!(&mut second).is_pending());
        assert!(first.taken_over.is_cancelled());
        drop(second);
        let mut third = Box::pin(owners.take("a"));
        assert!(poll!(&mut third).is_pending(), "the first still drives it");
        drop(first);
        let third = third.await.unwrap();
        assert!(!third.taken_over.is_cancelled());
        assert_eq!(n_kept(&owners), 1);
        drop(third);
        assert_eq!(n_kept(&owners), 0);
        // Also where the one who drives it is gone first.
        let first = owners.take("a").await.unwrap();
        let mut second = Box::pin(owners.take("a"));
        assert!(poll!(&mut second).is_pending());
        drop(first);
        drop(second);
        assert_eq!(n_kept(&owners), 0);
    }

    #[tokio::test]
    async fn a_session_that_somebody_drives_or_waits_for_is_not_to_be_had_without_asking() {
        let owners = Owners::default();
        let first = owners.try_take("a").unwrap();
        assert!(owners.try_take("a").is_none());
        let mut second = Box::pin(owners.take("a"));
        assert!(poll!(&mut second).is_pending());
        assert!(first.taken_over.is_cancelled(), "it gives way");
        drop(first);
        assert!(owners.try_take("a").is_none());
        drop(second.await.unwrap());
        assert_eq!(n_kept(&owners), 0);
        assert!(owners.try_take("a").is_some());
    }

    #[tokio::test]
    async fn of_those_who_wait_the_newest_is_next() {
        let owners = Owners::default();
        let first = owners.take("a").await.unwrap();
        let mut second = Box::pin(owners.take("a"));
        let mut third = Box::pin(owners.take("a"));
        assert!(poll!(&mut second).is_pending() && poll!(&mut third).is_pending());
        drop(first);
        assert!(second.await.is_err());
        assert!(third.await.is_ok());
        assert_eq!(n_kept(&owners), 0);
    }
}
