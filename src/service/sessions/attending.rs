//! Sessions that nobody drives and in which steps wait for so long at most: the service decides when they are due.
//!
//! ```text
//! Session, dropped --id, due--> queue by time --due--> taken up as by a client, decided, left again if more is to come
//! the store, at the start ---------^      ^--- later, where there was no memory or no disk
//! ```
//!
//! Nothing comes for a session that nobody drives, so that nothing depends on how late the service is. Whoever resumes a session takes it
//! over, whatever is under way.

use std::collections::BTreeSet;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use super::left::{Due, RETRY_AFTER};
use super::{Etude, Session, SessionError};
use crate::client::Client;
use crate::service::{PoolError, ServiceError};

/// So many are taken up at the same time; the others wait. Each takes the memory of its mapping.
const MAX_AT_ONCE: usize = 64;

/// A session whose next step is due sooner is kept until then.
const KEPT_FOR: Duration = Duration::from_secs(1);

impl Etude {
    /// Decides steps that are due in sessions that nobody drives, until `stopping` is cancelled.
    pub async fn attend_until(self: Arc<Self>, stopping: CancellationToken) {
        let receiver = self.left.receiver.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(mut left) = receiver else { return };
        let mut waiting = BTreeSet::new();
        let mut attended = JoinSet::new();
        loop {
            match self.store.timed_sessions().await {
                Ok(ids) => {
                    let now = self.clock.instant();
                    waiting.extend(ids.into_iter().map(|id| (now, id)));
                    break;
                }
                Err(error) => {
                    tracing::warn!(error = &error as &dyn std::error::Error, "open sessions could not be looked for");
                }
            }
            tokio::select! {
                () = tokio::time::sleep(RETRY_AFTER) => {}
                () = stopping.cancelled() => return,
            }
        }
        loop {
            let next = waiting.first().map(|(due, _): &Due| *due).filter(|_| attended.len() < MAX_AT_ONCE);
            let is_due = async {
                match next {
                    Some(due) => self.clock.sleep_until(due).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = stopping.cancelled() => return,
                // It is here too, so that it does not end.
                Some(due) = left.recv() => drop(waiting.insert(due)),
                Some(later) = attended.join_next() => waiting.extend(later.ok().flatten()),
                () = is_due => {
                    if let Some((_, id)) = waiting.pop_first() {
                        let etude = Arc::clone(&self);
                        attended.spawn(async move { etude.attend(id).await });
                    }
                }
            }
        }
    }

    /// Decides what is due in the session `id`, unless somebody drives it, who does that. Gives when it is to be tried again, if it failed.
    async fn attend(&self, id: String) -> Option<Due> {
        let error = self.try_attend(&id).await.err()?;
        let is_passing = matches!(
            error,
            SessionError::Service(
                ServiceError::Pool(PoolError::Busy)
                    | ServiceError::NoRoom(_)
                    | ServiceError::Shortage(_)
                    | ServiceError::Compiling { .. }
                    | ServiceError::Unavailable(_)
            )
        );
        if is_passing {
            tracing::debug!(session = id, error = &error as &dyn std::error::Error, "what is due waits");
            return Some((self.clock.instant() + RETRY_AFTER, id));
        }
        if !matches!(error, SessionError::TakenOver | SessionError::NotOpen) {
            tracing::warn!(session = id, error = &error as &dyn std::error::Error, "what is due cannot be decided");
        }
        None
    }

    async fn try_attend(&self, id: &str) -> Result<(), SessionError> {
        let Some(mut session) = self.take_up_unattended(id, Client::LOCAL).await? else { return Ok(()) };
        let taken_over = session.taken_over().clone();
        let decided = tokio::select! {
            biased;
            () = taken_over.cancelled() => Err(SessionError::TakenOver),
            decided = self.decide_all(&mut session) => decided,
        };
        if decided.is_err() {
            // Whoever has taken it over leaves it again; what failed is tried later.
            session.stay();
        }
        decided
    }

    /// Decides whatever is due, until there is nothing for some time.
    async fn decide_all(&self, session: &mut Session) -> Result<(), SessionError> {
        while let Some(due) = session.due().filter(|due| *due < self.clock.instant() + KEPT_FOR) {
            self.clock.sleep_until(due).await;
            let steps = session.decide(self).await?;
            tracing::debug!(session = session.id(), n_steps = steps.len(), "decided by time");
        }
        Ok(())
    }
}
