//! What was observed in a session, read again from the store.

use super::SessionError;
use super::received::Observation;
use crate::service::ServiceError;
use crate::service::requests::STATES;
use crate::store::{ServiceTime, StoredObservations};
use etude_core::attribute::Weights;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Warning, Watch};

/// What is stored of a session, as far as it is to be read again.
pub(super) struct StoredSession {
    pub(super) id: String,
    pub(super) stored: StoredObservations,
    /// How many observations it has, from the first of all.
    pub(super) n_observations: u32,
    /// The first observation that is to be mapped again.
    pub(super) first: u32,
    /// How many observations were watched by `watch` already.
    pub(super) n_watched: u32,
    pub(super) watch: Watch,
}

/// What a session was told, read again.
pub(super) struct ReadAgain {
    /// Those that are to be mapped again.
    pub(super) observations: Vec<Observation>,
    /// With all there was to warn of told.
    pub(super) watch: Watch,
    /// Of the policy, if it is done.
    pub(super) warnings: Vec<Warning>,
    /// From which observation on they came when, as far as that is kept.
    pub(super) times: Vec<(u32, ServiceTime)>,
}

/// Reads a session again: what was observed, and what there is to warn of. All observations are stored of one that is done, which is given
/// with the conditions of its policy.
pub(super) fn read_again(
    mapper: &Mapper,
    session: StoredSession,
    weights: Weights,
    conditions: Option<Conditions>,
) -> Result<ReadAgain, SessionError> {
    let StoredSession { id, stored, n_observations, first, n_watched, mut watch } = session;
    let model = mapper.model();
    let n_stored = n_observations - stored.first;
    let (demonstration, observation_weights) = read_stored(mapper, &stored.texts, (&id, n_stored))?;
    let of_session = |index: usize| index + stored.first as usize;
    for (index, observation) in demonstration.iter().enumerate().skip(n_watched.saturating_sub(stored.first) as usize) {
        watch.observe(model, of_session(index), observation);
    }
    watch.news(model, 0, &STATES);
    let told = |index: usize| observation_weights.get(index).copied().flatten();
    let observed = demonstration.iter().enumerate().skip(first.saturating_sub(stored.first) as usize);
    let observations =
        observed.map(|(index, values)| Observation { values: values.to_vec(), weight: told(index) }).collect();
    let warnings = conditions.map_or_else(Vec::new, |conditions| {
        let conditions = conditions.with_observation_weights(&observation_weights, demonstration.len());
        Problem::new(model, demonstration, weights, conditions).warnings(&STATES)
    });
    Ok(ReadAgain { observations, watch, warnings, times: stored.times })
}

/// Reads observations of the session `id` that were stored, which were read without faults before.
pub(super) fn read_stored(
    mapper: &Mapper,
    texts: &[String],
    (id, n_observations): (&str, u32),
) -> Result<(Demonstration, Vec<Option<f64>>), SessionError> {
    let read = Demonstration::read_stored(mapper.model().schema(), texts, n_observations as usize);
    let read = read.map_err(|error| ServiceError::unreadable("observations", "states", id, error))?;
    read.ok_or(SessionError::Empty)
}
