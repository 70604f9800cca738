//! The periodic learner.
//!
//! ```text
//! rewards (durable, in order) --every --learn-every: all pending of a learner--> one version --> weights (durable)
//! ```

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::{Etude, ServiceError};

impl Etude {
    /// Folds pending rewards into the weights of their learners, `every` so often, until `stopping` is cancelled.
    ///
    /// # Panics
    ///
    /// If `every` is zero.
    pub async fn learn_periodically(self: Arc<Self>, every: Duration, stopping: CancellationToken) {
        let mut ticks = tokio::time::interval(every);
        // A fold that took long is no reason for the next ones to come at once.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = ticks.tick() => {}
                () = stopping.cancelled() => return,
            }
            match self.learn_all(self.clock.now()).await {
                // The writer has told of it, once.
                Ok(()) | Err(ServiceError::Unavailable(_)) => {}
                Err(error) => tracing::error!(error = &error as &dyn std::error::Error, "learning failed"),
            }
        }
    }

    /// Folds the pending rewards of every learner.
    async fn learn_all(&self, now: Timestamp) -> Result<(), ServiceError> {
        for name in self.store.learners_behind().await? {
            match self.learn(&name, now).await {
                // Deleted since.
                Ok(_) | Err(ServiceError::Unknown { .. }) => {}
                // The others would fare no better.
                Err(error @ ServiceError::Unavailable(_)) => return Err(error),
                // What is wrong with one learner is no concern of the others. What is pending stays pending, and is tried again.
                Err(error) => {
                    tracing::error!(
                        error = &error as &dyn std::error::Error,
                        learner = name.as_str(),
                        "learning failed"
                    );
                }
            }
        }
        Ok(())
    }
}
