//! An open session: observations in, committed steps out.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Instant;

use tokio_util::sync::CancellationToken;

use super::SessionError;
use super::kept::Unwritten;
use super::left::Leaving;
use super::received::ReceivedText;
use super::waits::Waits;
use crate::client::Client;
use crate::memory::Held;
use crate::service::Etude;
use crate::service::owners::Ownership;
use crate::store::{AcceptedReward, Owner, TrialRecord};
use etude_core::attribute::{ByAttribute, Weights};
use etude_core::mapping::{Conditions, Mapper, OnlineMapping, Perception, Watch};

/// An open session, and the right to drive it.
#[derive(Debug)]
pub struct Session {
    pub(super) id: String,
    pub(super) model: String,
    pub(super) model_hash: String,
    pub(super) mapper: Arc<Mapper>,
    pub(super) weights: Weights,
    pub(super) lookahead: Option<NonZeroU32>,
    /// How observations follow from states in another vocabulary; `None`: they are the states.
    pub(super) perception: Option<Arc<Perception>>,
    pub(super) conditions: Conditions,
    pub(super) source: Source,
    pub(super) n_received: u32,
    /// The same, with those that are being written.
    pub(super) n_sent: u32,
    pub(super) n_steps: usize,
    /// How many observations the committed steps have met.
    pub(super) n_met: u32,
    /// How long steps wait, where that is limited.
    pub(super) waits: Option<Waits>,
    pub(super) unwritten: Unwritten,
    /// Whether its last decisions took longer than what is done where observations arrive.
    pub(super) is_slow: bool,
    /// Whether what it received last took so long to be mapped that the disk is to begin before.
    pub(super) takes_some_time: bool,
    /// `None` once the session has ended.
    pub(super) online: Option<OnlineMapping>,
    /// What was observed and can hardly be meant.
    pub(super) watch: Watch,
    /// What was received, as it is stored.
    pub(super) text: ReceivedText,
    /// What the mapping and the text take.
    pub(super) held: Held,
    /// Who drives it.
    pub(super) client: Client,
    /// Which owner this is. The store accepts nothing from one that was superseded.
    pub(super) owner: Owner,
    /// Tells of newer owners in this process, and keeps them from coming in between.
    pub(super) ownership: Ownership,
    /// After the ownership, so that who is told can have it.
    pub(super) leaving: Leaving,
}

/// Where a session's weights come from.
#[derive(Clone, Debug)]
pub(super) struct Source {
    pub(super) learner: Option<String>,
    pub(super) weights_version: Option<u64>,
    pub(super) trial_id: Option<String>,
}

/// What has become of the reward of a session.
#[derive(Clone, Debug, PartialEq)]
pub enum RewardState {
    /// It is still to come.
    Awaited,
    /// It is on disk.
    Accepted {
        /// The trial that earned it.
        trial: String,
        /// The reward.
        reward: AcceptedReward,
    },
    /// None will come: the session does not explore, its trial has failed, or its learner was deleted.
    Never,
}

/// Where steps wait for so long at most, somebody must decide when nobody drives the session any more.
impl Drop for Session {
    fn drop(&mut self) {
        if let Some(waits) = &self.waits {
            self.leaving.until(waits.next(self.n_met, self.n_sent));
        }
    }
}

impl Session {
    /// Its id.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// The trial that it explores, if any.
    #[must_use]
    pub fn trial_id(&self) -> Option<&str> {
        self.source.trial_id.as_deref()
    }

    /// Whether its demonstration has ended.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.online.is_none()
    }

    /// The weights of the distance.
    #[must_use]
    pub fn weights(&self) -> ByAttribute<f64> {
        self.mapper.model().schema().by_attribute(self.weights.as_slice().iter().copied())
    }

    /// Nobody needs to decide what is due once this is dropped.
    pub(super) fn stay(&mut self) {
        self.waits = None;
    }

    /// How many observations are durable.
    #[must_use]
    pub fn n_received(&self) -> u32 {
        self.n_received
    }

    /// How many steps were committed.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.n_steps
    }

    /// What it is mapped by.
    #[must_use]
    pub fn mapper(&self) -> Arc<Mapper> {
        Arc::clone(&self.mapper)
    }

    /// When the next step is to be [decided](Self::decide), if it waits for so long at most.
    #[must_use]
    pub fn due(&self) -> Option<Instant> {
        let waits = self.waits.as_ref().filter(|_| !self.has_ended())?;
        waits.next(self.n_met, self.n_received)
    }

    /// Cancelled when another connection takes the session over.
    #[must_use]
    pub fn taken_over(&self) -> &CancellationToken {
        &self.ownership.taken_over
    }

    /// What has become of its reward.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn reward(&self, etude: &Etude) -> Result<RewardState, SessionError> {
        let Some(trial) = &self.source.trial_id else { return Ok(RewardState::Never) };
        Ok(match etude.store.trial(trial).await? {
            Some(TrialRecord { reward: Some(reward), id, .. }) => RewardState::Accepted { trial: id, reward },
            Some(TrialRecord { failed: None, .. }) => RewardState::Awaited,
            Some(_) | None => RewardState::Never,
        })
    }
}
