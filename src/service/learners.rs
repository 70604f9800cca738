//! The registry of learners, their weights, and how they learn.

use jiff::Timestamp;

use super::hash::hash_of;
use super::{Etude, Kind, Name, Registered, ServiceError, as_stored};
use crate::store::{Deletion, Fold, LearnerRecord, NewLearner, Page, Registration, WeightsRecord};
use etude_core::document;
use etude_core::learning::{Distribution, Learner, LearnerDocument};

/// A learner as it was registered.
#[derive(Clone, Debug)]
pub struct LearnerAnswer {
    /// The name it is registered under.
    pub name: String,
    /// SHA-256 of its canonical text.
    pub hash: String,
    /// Its definition in canonical form.
    pub definition: LearnerDocument,
    /// When it was registered.
    pub created_at: Timestamp,
}

/// A version of a learner's weights.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightsAnswer {
    /// The learner.
    pub learner: String,
    /// Counted from 0: what the learner started from.
    pub version: u64,
    /// How many rewards are folded in.
    pub n_trials: u64,
    /// The distribution: one weight per attribute.
    pub weights: Vec<LearnedWeight>,
    /// The reward that is expected of a trial.
    pub expected_reward: Option<f64>,
    /// When it was made.
    pub updated_at: Timestamp,
}

/// What is known of the weight of an attribute.
#[derive(Clone, Debug, PartialEq)]
pub struct LearnedWeight {
    /// The attribute.
    pub attribute: String,
    /// Its mean.
    pub mean: f64,
    /// Its standard deviation.
    pub sd: f64,
}

/// What replaying the log of a learner showed.
#[derive(Clone, Debug, PartialEq)]
pub struct Replay {
    /// How many rewards were folded in.
    pub n_rewards: u64,
    /// How many versions were compared.
    pub n_versions: u64,
    /// The first version that has other bits than the replay gives, if there is one.
    pub first_difference: Option<Difference>,
}

/// A version that has other bits than the replay gives.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Which one.
    pub version: u64,
    /// What is stored.
    pub stored: Distribution,
    /// What the replay gives.
    pub replayed: Distribution,
}

/// A learner with the last version of its weights.
#[derive(Clone, Debug)]
pub(super) struct LearnerState {
    pub(super) sequence: i64,
    pub(super) name: String,
    pub(super) learner: Learner,
    pub(super) weights: WeightsRecord,
}

impl Etude {
    /// Registers the learner in `body` (JSON) under `name`.
    ///
    /// # Errors
    ///
    /// If the body is no learner, or the name is taken by another one.
    pub async fn put_learner(
        &self,
        name: &Name,
        body: &[u8],
        now: Timestamp,
    ) -> Result<(Registered, LearnerAnswer), ServiceError> {
        let learner = Learner::read(&document::parse(body)?)?;
        let definition = learner.document().text();
        let new = NewLearner {
            name: name.to_string(),
            hash: hash_of(&definition),
            definition,
            initial: learner.initial().clone(),
            created_at: as_stored(now),
        };
        let (registered, row) = match self.store.register_learner(new).await? {
            Registration::Created(row) => (Registered::New, row),
            Registration::Unchanged(row) => (Registered::Already, row),
            Registration::Conflict { existing_hash } => {
                return Err(ServiceError::Conflict { kind: "learner", name: name.to_string(), existing_hash });
            }
        };
        Ok((registered, answer(row)?))
    }

    /// The learner called `name`.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn learner(&self, name: &Name) -> Result<LearnerAnswer, ServiceError> {
        answer(self.learner_row(name).await?)
    }

    /// At most `limit` learners in the order of their names, from the first after `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn learners(&self, after: Option<&str>, limit: u32) -> Result<Page<LearnerAnswer>, ServiceError> {
        let page = self.store.learners(after, limit).await?;
        Ok(page.map_readable(|row| &row.name, answer))
    }

    /// Deletes the learner called `name`, with its weights and trials. Policies made with it stay.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn delete_learner(&self, name: &Name) -> Result<(), ServiceError> {
        match self.store.delete_learner(name.as_str()).await? {
            Deletion::Deleted => Ok(()),
            Deletion::Unknown => Err(unknown(name.as_str(), None)),
        }
    }

    /// The last version of a learner's weights, or the one given.
    ///
    /// # Errors
    ///
    /// If there is no such learner, or it never had that version.
    pub async fn weights(&self, name: &Name, version: Option<u64>) -> Result<WeightsAnswer, ServiceError> {
        let LearnerState { sequence, learner, weights, .. } = self.learner_state(name.as_str(), None).await?;
        let weights = match version {
            Some(version) if version != weights.version => {
                let found = self.store.weights(sequence, version).await?;
                found.ok_or_else(|| ServiceError::UnknownVersion { name: name.to_string(), version })?
            }
            _ => weights,
        };
        Ok(weights_answer(name.as_str(), &learner, weights))
    }

    /// At most `limit` versions of a learner's weights, oldest first, from the first after `after` on.
    ///
    /// # Errors
    ///
    /// If there is no such learner.
    pub async fn weights_history(
        &self,
        name: &Name,
        after: Option<u64>,
        limit: u32,
    ) -> Result<Page<WeightsAnswer>, ServiceError> {
        let row = self.learner_row(name).await?;
        let learner = read_definition(&row)?;
        let page = self.store.weights_history(row.sequence, after, limit).await?;
        Ok(page.map(|weights| weights_answer(name.as_str(), &learner, weights)))
    }

    /// Folds the rewards of a learner that are not folded in yet into a new version of its weights, if there are any.
    ///
    /// # Errors
    ///
    /// If there is no such learner.
    pub async fn learn(&self, name: &str, now: Timestamp) -> Result<WeightsAnswer, ServiceError> {
        // One at a time: two that fold the same rewards would make the same version.
        let _learning = self.learning.lock().await;
        let LearnerState { sequence, learner, weights, .. } = self.learner_state(name, None).await?;
        let mut distribution = weights.distribution.clone();
        let mut reward_order = weights.reward_order;
        self.store
            .each_reward(sequence, reward_order, |row| {
                let drawn: Vec<f64> = row.weights.iter().map(|(_, weight)| *weight).collect();
                learner.learn(&mut distribution, &drawn, row.reward);
                reward_order = row.reward_order;
            })
            .await?;
        if reward_order == weights.reward_order {
            return Ok(weights_answer(name, &learner, weights));
        }
        let folded =
            WeightsRecord { version: weights.version + 1, reward_order, distribution, updated_at: as_stored(now) };
        if self.store.fold_rewards(sequence, folded.clone()).await? == Fold::Outdated {
            // Deleted meanwhile, or another process has learned; what that made is as good.
            let LearnerState { learner, weights, .. } = self.learner_state(name, None).await?;
            return Ok(weights_answer(name, &learner, weights));
        }
        let n_rewards = reward_order - weights.reward_order;
        metrics::counter!("etude_rewards_learned_total").increment(n_rewards);
        tracing::info!(
            learner = name,
            version = folded.version,
            n_rewards,
            expected_reward = folded.distribution.expected_reward,
            "learned"
        );
        Ok(weights_answer(name, &learner, folded))
    }

    /// Computes the distribution of a learner anew from the log of its rewards, and compares every version bit for bit.
    ///
    /// # Errors
    ///
    /// If there is no such learner.
    pub async fn replay(&self, name: &Name) -> Result<Replay, ServiceError> {
        let row = self.learner_row(name).await?;
        let learner = read_definition(&row)?;
        let mut versions = Vec::new();
        let mut after = None;
        loop {
            let page = self.store.weights_history(row.sequence, after, Self::REPLAY_PAGE).await?;
            if let Some(version) = page.unreadable.into_iter().next() {
                return Err(ServiceError::unreadable("weights", "value", version, "it cannot be read"));
            }
            versions.extend(page.items);
            match page.next {
                Some(next) => after = next.parse().ok(),
                None => break,
            }
        }
        let mut versions = versions.into_iter().peekable();
        let mut replay = Replay { n_rewards: 0, n_versions: 0, first_difference: None };
        let mut compare = |versions: &mut std::iter::Peekable<std::vec::IntoIter<WeightsRecord>>,
                           replayed: &Distribution,
                           reward_order: u64| {
            replay.n_rewards = reward_order;
            while let Some(stored) = versions.next_if(|stored| stored.reward_order <= reward_order) {
                replay.n_versions += 1;
                let is_same = stored.reward_order == reward_order && stored.distribution.has_bits_of(replayed);
                if !is_same && replay.first_difference.is_none() {
                    let (version, stored) = (stored.version, stored.distribution);
                    replay.first_difference = Some(Difference { version, stored, replayed: replayed.clone() });
                }
            }
        };
        let mut distribution = learner.initial().clone();
        compare(&mut versions, &distribution, 0);
        self.store
            .each_reward(row.sequence, 0, |row| {
                let drawn: Vec<f64> = row.weights.iter().map(|(_, weight)| *weight).collect();
                learner.learn(&mut distribution, &drawn, row.reward);
                compare(&mut versions, &distribution, row.reward_order);
            })
            .await?;
        Ok(replay)
    }

    /// Versions that are read at once for a replay.
    const REPLAY_PAGE: u32 = 1000;

    /// The learner called `name`, as a definition that starts from what it has learned. Registering it elsewhere starts
    /// another learner there, from where this one is.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub async fn learned(&self, name: &Name) -> Result<(LearnerDocument, WeightsAnswer), ServiceError> {
        let LearnerState { learner, weights, .. } = self.learner_state(name.as_str(), None).await?;
        let definition = learner.clone().starting_from(weights.distribution.clone()).document();
        Ok((definition, weights_answer(name.as_str(), &learner, weights)))
    }

    /// The learner called `name` with the last version of its weights. `pointer` is where a request names it.
    pub(super) async fn learner_state(
        &self,
        name: &str,
        pointer: Option<&'static str>,
    ) -> Result<LearnerState, ServiceError> {
        let found = self.store.learner_and_weights(name).await?;
        let (row, weights) = found.ok_or_else(|| unknown(name, pointer))?;
        let learner = read_definition(&row)?;
        Ok(LearnerState { sequence: row.sequence, name: row.name, learner, weights })
    }

    pub(super) async fn learner_row(&self, name: &Name) -> Result<LearnerRecord, ServiceError> {
        self.store.learner(name.as_str()).await?.ok_or_else(|| unknown(name.as_str(), None))
    }
}

pub(super) fn unknown(name: &str, pointer: Option<&'static str>) -> ServiceError {
    ServiceError::Unknown { kind: Kind::Learner, name: name.to_owned(), pointer }
}

/// The text of a definition, if it is the one that was accepted.
fn checked_definition(row: &LearnerRecord) -> Result<&str, ServiceError> {
    if hash_of(&row.definition) == row.hash {
        return Ok(&row.definition);
    }
    Err(ServiceError::unreadable("learners", "definition", &row.name, "it is not what its hash is of"))
}

/// Reads a definition that was accepted before, and so has no faults unless the row is damaged.
fn read_definition(row: &LearnerRecord) -> Result<Learner, ServiceError> {
    let corrupt = |error| ServiceError::unreadable("learners", "definition", &row.name, error);
    let document = document::parse(checked_definition(row)?.as_bytes()).map_err(|error| corrupt(error.to_string()))?;
    Learner::read(&document).map_err(|faults| corrupt(faults.to_string()))
}

fn answer(row: LearnerRecord) -> Result<LearnerAnswer, ServiceError> {
    let definition = serde_json::from_str(checked_definition(&row)?);
    let definition =
        definition.map_err(|error| ServiceError::unreadable("learners", "definition", &row.name, error))?;
    Ok(LearnerAnswer { name: row.name, hash: row.hash, definition, created_at: row.created_at })
}

fn weights_answer(name: &str, learner: &Learner, row: WeightsRecord) -> WeightsAnswer {
    let Distribution { mean, sd, expected_reward } = row.distribution;
    let known = learner.attributes().iter().zip(mean.into_iter().zip(sd));
    WeightsAnswer {
        learner: name.to_owned(),
        version: row.version,
        n_trials: row.reward_order,
        weights: known
            .map(|(attribute, (mean, sd))| LearnedWeight { attribute: attribute.to_string(), mean, sd })
            .collect(),
        expected_reward,
        updated_at: row.updated_at,
    }
}
