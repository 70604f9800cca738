//! What was observed in a session, read again from the store.

use super::SessionError;
use super::session::Observation;
use crate::service::ServiceError;
use crate::service::requests::STATES;
use etude_core::attribute::Weights;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Warning, Watch};

/// What a session was told, read again.
pub(super) struct ReadAgain {
    pub(super) observations: Vec<Observation>,
    /// With all there was to warn of told.
    pub(super) watch: Watch,
    /// Of the policy, if it is done.
    pub(super) warnings: Vec<Warning>,
}

/// Reads all of a session again: what was observed, and what there is to warn of.
pub(super) fn read_again(
    mapper: &Mapper,
    texts: &[String],
    of_session: (&str, u32),
    is_done: bool,
    weights: Weights,
    conditions: Conditions,
) -> Result<ReadAgain, SessionError> {
    let model = mapper.model();
    let (demonstration, observation_weights) = read_stored(mapper, texts, of_session)?;
    let mut watch = Watch::new(&weights);
    for (index, observation) in demonstration.iter().enumerate() {
        watch.observe(model, index, observation);
    }
    watch.news(model, 0, &STATES);
    let told = |index: usize| observation_weights.get(index).copied().flatten();
    let observed = demonstration.iter().enumerate();
    let observations =
        observed.map(|(index, values)| Observation { values: values.to_vec(), weight: told(index) }).collect();
    let warnings = if is_done {
        let conditions = conditions.with_observation_weights(&observation_weights, demonstration.len());
        Problem::new(model, demonstration, weights, conditions).warnings(&STATES)
    } else {
        Vec::new()
    };
    Ok(ReadAgain { observations, watch, warnings })
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
