//! What waits to be refined, as it is stored.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use super::ServiceError;
use crate::store::NewRefinement;
use etude_core::attribute::ByAttribute;
use etude_core::mapping::{Conditions, Cost, Problem, Stamp};
use etude_core::model::Model;

/// What is to be refined: the problem that a finite lookahead has decided. As it waits in the store, JSON.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct RefinedRequest<'t> {
    #[serde(borrow)]
    pub(super) model: Cow<'t, str>,
    pub(super) weights: ByAttribute<f64>,
    #[serde(default, skip_serializing_if = "Conditions::are_default")]
    pub(super) conditions: Conditions,
    /// What the policy costs.
    pub(super) cost: f64,
    /// What was observed, unless a session has it.
    #[serde(borrow, default, skip_serializing_if = "Option::is_none")]
    pub(super) demonstration: Option<&'t RawValue>,
}

impl<'t> RefinedRequest<'t> {
    /// The one that refines a policy of `problem`, which costs so much.
    pub(super) fn of(model: &'t str, problem: &Problem<'_>, cost: Cost) -> Self {
        Self {
            model: model.into(),
            weights: problem.named_weights(),
            conditions: problem.conditions().clone(),
            cost: cost.total,
            demonstration: None,
        }
    }

    /// With what was observed as it was sent: JSON.
    pub(super) fn observing_text(self, demonstration: &'t str) -> Result<Self, ServiceError> {
        let demonstration = serde_json::from_str(demonstration).map_err(ServiceError::Write)?;
        Ok(Self { demonstration: Some(demonstration), ..self })
    }

    /// Most bytes that it takes to be written with this demonstration.
    pub(super) fn most_bytes(model: &Model, demonstration: &str) -> usize {
        /// The names of its members, that of the model, and an attribute's weight.
        const OTHERS_BYTES: usize = 1024;
        let names = model.schema().attributes().iter().map(|attribute| 2 * attribute.name.len() + 32);
        demonstration.len() + OTHERS_BYTES + names.sum::<usize>()
    }

    /// The refinement as it waits, of a policy with this stamp, and of this session if that has what was observed.
    pub(super) fn waiting(&self, stamp: &Stamp, session_id: Option<&str>) -> Result<NewRefinement, ServiceError> {
        const OTHERS_BYTES: usize = 1024;
        let n_bytes = OTHERS_BYTES + self.demonstration.map_or(0, |text| text.get().len());
        let mut text = Vec::with_capacity(n_bytes);
        serde_json::to_writer(&mut text, self).map_err(ServiceError::Write)?;
        let request = String::from_utf8(text).map_err(|error| ServiceError::Write(serde::ser::Error::custom(error)))?;
        let (policy_id, model_hash) = (stamp.id.clone().unwrap_or_default(), stamp.model_hash.clone());
        Ok(NewRefinement { policy_id, model_hash, session_id: session_id.map(str::to_owned), request })
    }
}
