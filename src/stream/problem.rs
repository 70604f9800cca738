//! What is wrong, as a frame tells it.

use serde::Serialize;
use utoipa::ToSchema;

use etude_core::document::{Fault, Faults};

/// What is wrong, as in HTTP but for what only HTTP has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub struct StreamProblem {
    /// `/problems/` and what kind of problem it is.
    #[serde(rename = "type")]
    pub kind: String,
    /// What happened.
    pub detail: String,
    /// Every fault of the frame, with its place.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    pub errors: Vec<Fault>,
}

impl StreamProblem {
    /// A problem of the kind `slug`.
    #[must_use]
    pub fn new(slug: &str, detail: impl Into<String>) -> Self {
        Self { kind: format!("/problems/{slug}"), detail: detail.into(), errors: Vec::new() }
    }

    /// A problem of the kind `slug` that consists of faults.
    #[must_use]
    pub fn of(slug: &str, faults: &Faults) -> Self {
        let detail = match faults.listed() {
            [fault] => fault.detail.clone(),
            _ => format!("{} faults", faults.count()),
        };
        Self { errors: faults.listed().to_vec(), ..Self::new(slug, detail) }
    }
}
