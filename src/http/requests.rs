//! What OpenAPI says of requests: their own members here, and the options that [`Options`] describes.

use std::borrow::Cow;

use serde::Serialize;
use utoipa::openapi::RefOr;
use utoipa::openapi::schema::{Object, Schema};
use utoipa::{PartialSchema, ToSchema};

use etude_core::mapping::{ObservationDocument, Options, RequestKind};

/// A request for a policy, as it is written in JSON.
#[derive(Serialize, ToSchema)]
struct PolicyMembers {
    /// Name of the imitator's model.
    #[schema(example = "figure-4")]
    model: String,
    /// The observed states, in order: 1 to 100,000, or fewer if the policy's states would take more than 64 MB. Attributes
    /// may be missing or null: not observed.
    demonstration: Vec<ObservationDocument>,
    /// Name of a learner whose mean weights are used, for attributes that `weights` does not name.
    #[serde(skip_serializing_if = "Option::is_none")]
    learner: Option<String>,
    /// Whether the policy is stored; `true` if left out. One that is not has no `id`, and is not refined.
    #[serde(skip_serializing_if = "Option::is_none")]
    store: Option<bool>,
}

/// A request for policies, as it is written in JSON. Its options are those of items without their own.
#[derive(Serialize, ToSchema)]
struct BatchMembers {
    /// Name of the imitator's model.
    #[schema(example = "figure-4")]
    model: String,
    /// What is to be followed. With more observations together than a single policy may have, the batch is refused.
    #[schema(min_items = 1, max_items = 10_000)]
    items: Vec<BatchItemRequest>,
    /// Name of a learner whose mean weights are used, for attributes that no `weights` name.
    #[serde(skip_serializing_if = "Option::is_none")]
    learner: Option<String>,
    /// Most milliseconds for the whole batch, waiting included; items that are not done by then get the best mapping found,
    /// with `status` `bounded`, or `local` if they have a lookahead. At most a day.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(maximum = 86_400_000)]
    deadline_ms: Option<u64>,
    /// Whether the policies are stored; `true` if left out. Those that are not have no `id`, and are not refined.
    #[serde(skip_serializing_if = "Option::is_none")]
    store: Option<bool>,
}

/// An item of a batch: a demonstration, with options of its own where it needs them; attributes that its weights do not name keep the
/// batch's.
#[derive(Serialize, ToSchema)]
struct ItemMembers {
    /// The observed states, as in a single request.
    demonstration: Vec<ObservationDocument>,
}

/// A request for a trial.
#[derive(Serialize, ToSchema)]
struct TrialMembers {
    /// Name of the imitator's model. It must have the attributes of the learner.
    #[schema(example = "figure-6")]
    model: String,
    /// The observed states, in order: 1 to 100,000. Attributes may be missing or null: not observed.
    demonstration: Vec<ObservationDocument>,
}

/// Opens a session, of which the demonstration follows.
#[derive(Serialize, ToSchema)]
struct OpenMembers {
    /// Name of the imitator's model.
    #[schema(example = "corridor")]
    model: String,
    /// Name of a learner whose mean weights are used, for attributes that `weights` does not name.
    #[serde(skip_serializing_if = "Option::is_none")]
    learner: Option<String>,
    /// Whether a trial is drawn from the learner.
    #[serde(default)]
    explore: bool,
    /// How many observations past the current one a decision may wait for, 1 to 100,000: 8 if left out; `null`: only steps that are proven
    /// are committed before the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1, maximum = 100_000)]
    lookahead: Option<u32>,
    /// For how many milliseconds a step may wait, at least 1; `null`, or left out: as long as `lookahead` lets it. A step that advances from
    /// an observation is committed at the latest so long after the next one came, also while nobody is connected; what has come by then
    /// decides. Time in which the service is down does not count. With a `lookahead`, the earlier of both.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1)]
    lookahead_ms: Option<u64>,
}

/// A request for a report.
#[derive(Serialize, ToSchema)]
struct ReportMembers {
    /// The observed states, as in a request for a policy.
    demonstration: Vec<ObservationDocument>,
    /// The weight of each observation, at least 0 (`null`: 1), as many as there are observations; all 1 if left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    observation_weights: Option<Vec<Option<f64>>>,
    /// Most milliseconds, waiting included; what was not found by then is left out. At most a day.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(maximum = 86_400_000)]
    deadline_ms: Option<u64>,
}

/// Describes a request: its own members, and the options that it may have.
macro_rules! describe {
    ($(#[$doc:meta])* $request:ident, $members:ty, $kind:expr) => {
        $(#[$doc])*
        #[derive(Serialize)]
        pub(in crate::http) struct $request($members);

        impl PartialSchema for $request {
            fn schema() -> RefOr<Schema> {
                with_options(<$members>::schema(), $kind)
            }
        }

        impl ToSchema for $request {
            fn name() -> Cow<'static, str> {
                stringify!($request).into()
            }

            fn schemas(schemas: &mut Vec<(String, RefOr<Schema>)>) {
                <$members>::schemas(schemas);
                Options::schemas(schemas);
            }
        }
    };
}

describe!(
    /// A request for a policy.
    PolicyRequest, PolicyMembers, RequestKind::Policy
);
describe!(
    /// A request for many policies.
    BatchRequest, BatchMembers, RequestKind::Batch
);
describe!(
    /// One of them.
    BatchItemRequest, ItemMembers, RequestKind::Item
);
describe!(
    /// A request for a trial.
    TrialRequest, TrialMembers, RequestKind::Trial
);
describe!(
    /// A request for a session.
    OpenFrame, OpenMembers, RequestKind::Session
);

describe!(
    /// A request for a report.
    ReportRequest, ReportMembers, RequestKind::Report
);

/// The description of a request with these members and its options.
fn with_options(members: RefOr<Schema>, kind: RequestKind) -> RefOr<Schema> {
    let mut request = object(members);
    let options = object(Options::schema()).properties;
    let own = options.into_iter().filter(|(name, _)| kind.fields().contains(&name.as_str()));
    for (name, option) in own {
        request.properties.entry(name).or_insert(option);
    }
    RefOr::T(Schema::Object(request))
}

/// The description of an object.
fn object(schema: RefOr<Schema>) -> Object {
    match schema {
        RefOr::T(Schema::Object(object)) => object,
        _ => Object::default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_has_the_fields_that_are_described_and_no_others() {
        for (request, kind) in [
            (PolicyRequest::schema(), RequestKind::Policy),
            (BatchRequest::schema(), RequestKind::Batch),
            (BatchItemRequest::schema(), RequestKind::Item),
            (TrialRequest::schema(), RequestKind::Trial),
            (OpenFrame::schema(), RequestKind::Session),
            (ReportRequest::schema(), RequestKind::Report),
        ] {
            let mut described: Vec<_> = object(request).properties.into_keys().collect();
            // What every frame has is described with them all.
            let mut read: Vec<_> = kind.fields().iter().copied().filter(|name| *name != "type").collect();
            described.sort_unstable();
            read.sort_unstable();
            assert_eq!(described, read, "{kind:?}");
        }
        for option in object(Options::schema()).properties.keys() {
            assert!(RequestKind::Policy.fields().contains(&option.as_str()), "no request has {option}");
        }
    }
}
