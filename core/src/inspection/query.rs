//! What an inspection is asked.

use std::time::Duration;

use crate::attribute::Weights;
use crate::document::{Faults, Object};
use crate::mapping::{Conditions, Demonstration, Options, Request, RequestKind};
use crate::model::Model;

/// What an inspection is asked.
#[derive(Clone, Debug)]
pub struct Query {
    /// The weights by which states are compared: what weighs nothing does not count.
    pub weights: Weights,
    /// The start states, the actions that the body lacks, and the weights of observations; what else they say has no effect.
    pub conditions: Conditions,
    /// A demonstration that the body would follow.
    pub demonstration: Option<Demonstration>,
    /// How long it may take, counted from when the request arrived.
    pub deadline: Option<Duration>,
}

impl Query {
    /// Every field of a request for a report.
    pub const FIELDS: &'static [&'static str] = RequestKind::Report.fields();

    /// What a request asks that says nothing: of the body of `model`, with its weights.
    #[must_use]
    pub fn of(model: &Model) -> Self {
        let (weights, conditions) = (model.schema().weights(), Conditions::default());
        Self { weights, conditions, demonstration: None, deadline: None }
    }

    /// Reads a request for a report.
    pub fn read(model: &Model, object: &Object<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let n_before = faults.count();
        let options = Options::read(object, model, &Options::default(), faults);
        let has_seen = object.optional("demonstration").is_some();
        let demonstration = has_seen.then(|| Request::read_demonstration(model, object, faults)).flatten();
        if let Some(seen) = &demonstration {
            Options::default().check_observation_weights(seen.len(), object, faults);
        }
        let options = options.filter(|_| faults.count() == n_before)?;
        let weights = options.weights_over(model.schema().weights());
        Some(Self { weights, conditions: options.conditions(), demonstration, deadline: options.deadline() })
    }
}
