//! `/v1/learners`.

use axum::extract::{FromRequestParts, Query, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::SharedContext;
use super::answer::json;
use super::body::{NoForm, read_json};
use super::paging::{List, Paging};
use super::path::PathName;
use super::problem::{BodyProblems, NoBodyProblems, Problem};
use super::tags::{has_tag, with_tag};
use crate::service::{LearnerAnswer, Registered, WeightsAnswer};
use etude_core::document::{Faults, Path};
use etude_core::learning::LearnerDocument;

/// A registered learner.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Learner)]
pub(super) struct LearnerBody {
    /// The name it is registered under.
    #[schema(example = "gold")]
    name: String,
    /// SHA-256 of its definition in canonical form: equal for equal content, however that was written.
    hash: String,
    /// What it was registered as, defaults filled in.
    #[serde(flatten)]
    definition: LearnerDocument,
    /// When it was registered.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
}

impl From<LearnerAnswer> for LearnerBody {
    fn from(answer: LearnerAnswer) -> Self {
        let LearnerAnswer { name, hash, definition, created_at } = answer;
        Self { name, hash, definition, created_at }
    }
}

/// A version of a learner's weights: a normal distribution per attribute.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
#[schema(as = Weights)]
pub(super) struct WeightsBody {
    /// The learner.
    #[schema(example = "gold")]
    learner: String,
    /// Counted from 0: what the learner started from.
    #[schema(example = 12)]
    version: u64,
    /// How many trials it has learned from.
    #[schema(example = 40)]
    trials: u64,
    /// The reward that is expected of a trial; `null` until a reward or the definition says.
    #[schema(example = 874.2)]
    expected_reward: Option<f64>,
    /// One per attribute, in the order of the definition.
    weights: Vec<WeightBody>,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    updated_at: Timestamp,
}

/// What is known of the weight of an attribute.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
#[schema(as = Weight)]
pub(super) struct WeightBody {
    /// The attribute.
    #[schema(example = "x")]
    attribute: String,
    /// Its mean.
    #[schema(example = 0.4)]
    mean: f64,
    /// Its standard deviation.
    #[schema(example = 0.7)]
    sd: f64,
}

impl From<WeightsAnswer> for WeightsBody {
    fn from(answer: WeightsAnswer) -> Self {
        let weights = answer.weights.into_iter();
        Self {
            learner: answer.learner,
            version: answer.version,
            trials: answer.n_trials,
            expected_reward: answer.expected_reward,
            weights: weights
                .map(|weight| WeightBody { attribute: weight.attribute, mean: weight.mean, sd: weight.sd })
                .collect(),
            updated_at: answer.updated_at,
        }
    }
}

/// Register a learner under a name.
#[utoipa::path(
    put, path = "/v1/learners/{learner}", tag = "learners",
    params(("learner" = String, Path, description = "Its name: 1 to 64 of `a-z A-Z 0-9 . _ -`, other than `.` and `..`")),
    request_body = LearnerDocument,
    responses(
        (status = 201, description = "It is new; its weights have version 0", body = LearnerBody),
        (status = 200, description = "The same content was there already, under this name", body = LearnerBody),
        BodyProblems,
        (status = 409, description = "`conflict`: other content is there under this name", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn put_learner(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_json(request, &context).await?;
    let (registered, answer) = context.etude.put_learner(&name, &body, context.etude.clock().now()).await?;
    let status = match registered {
        Registered::New => StatusCode::CREATED,
        Registered::Instead | Registered::Already => StatusCode::OK,
    };
    Ok(json(status, &LearnerBody::from(answer)))
}

/// A learner, as it was registered.
#[utoipa::path(
    get, path = "/v1/learners/{learner}", tag = "learners",
    params(("learner" = String, Path, description = "Its name")),
    responses(
        (status = 200, description = "The learner", body = LearnerBody),
        (status = 404, description = "`unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`: not a name", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_learner(
    State(context): State<SharedContext>,
    PathName(name): PathName,
) -> Result<Response, Problem> {
    Ok(json(StatusCode::OK, &LearnerBody::from(context.etude.learner(&name).await?)))
}

/// Learners, in the order of their names.
#[utoipa::path(
    get, path = "/v1/learners", tag = "learners",
    params(Paging),
    responses(
        (status = 200, description = "A page of learners", body = List<LearnerBody>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_learners(State(context): State<SharedContext>, paging: Paging) -> Result<Response, Problem> {
    let page = context.etude.learners(paging.after.as_deref(), paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, LearnerBody::from)))
}

/// Delete a learner with its weights and trials. Policies made with it stay.
#[utoipa::path(
    delete, path = "/v1/learners/{learner}", tag = "deletion",
    params(("learner" = String, Path, description = "Its name")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 404, description = "`unknown-learner`", body = Problem, content_type = "application/problem+json"),
        NoBodyProblems,
    ),
)]
pub(super) async fn delete_learner(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    _: NoForm,
) -> Result<StatusCode, Problem> {
    context.etude.delete_learner(&name).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Which version of the weights is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct WhichWeights {
    /// A version; the last one if left out.
    version: Option<u64>,
}

impl<S: Send + Sync> FromRequestParts<S> for WhichWeights {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let mut faults = Faults::default();
        let mut note = |name: &str, detail: String| faults.note_at(&Path::Member(&Path::Root, name), detail);
        let mut which = Self { version: None };
        let query = Query::<Vec<(String, String)>>::try_from_uri(&parts.uri);
        for (name, value) in query.map(|Query(query)| query).unwrap_or_default() {
            match (name.as_str(), value.parse()) {
                ("version", Ok(version)) => which.version = Some(version),
                ("version", Err(_)) => note("version", format!("expected a whole number, found {value:?}")),
                _ => note(&name, "unknown query parameter; known here: version".to_owned()),
            }
        }
        if faults.is_empty() { Ok(which) } else { Err(faults.into()) }
    }
}

/// The weights of a learner. Their `ETag` is the version in quotes: of a learner that was deleted and registered anew, it begins with 0
/// again, so that tags from before the deletion are to be forgotten.
#[utoipa::path(
    get, path = "/v1/learners/{learner}/weights", tag = "learners",
    params(
        ("learner" = String, Path, description = "Its name"),
        WhichWeights,
        ("if-none-match" = Option<String>, Header, description = "Versions that the client has, as in `ETag`"),
    ),
    responses(
        (status = 200, description = "The weights", body = WeightsBody,
            headers(("etag" = String, description = "The version in quotes"))),
        (status = 304, description = "The client has this version"),
        (status = 404, description = "`unknown-learner`, `unknown-version`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_weights(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    which: WhichWeights,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let answer = context.etude.weights(&name, which.version).await?;
    let tag = format!("\"{}\"", answer.version);
    if has_tag(&headers, &tag) {
        return Ok(with_tag(StatusCode::NOT_MODIFIED.into_response(), &tag));
    }
    Ok(with_tag(json(StatusCode::OK, &WeightsBody::from(answer)), &tag))
}

/// Versions of the weights of a learner, oldest first.
#[utoipa::path(
    get, path = "/v1/learners/{learner}/weights/history", tag = "learners",
    params(("learner" = String, Path, description = "Its name"), Paging),
    responses(
        (status = 200, description = "A page of versions", body = List<WeightsBody>),
        (status = 404, description = "`unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_weights(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    paging: Paging,
) -> Result<Response, Problem> {
    let page = context.etude.weights_history(&name, paging.after_number()?, paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, WeightsBody::from)))
}

/// Fold pending rewards into the weights now, instead of at the next period.
#[utoipa::path(
    post, path = "/v1/learners/{learner}/learn", tag = "learners",
    params(("learner" = String, Path, description = "Its name")),
    responses(
        (status = 200, description = "The weights, with every reward that was accepted before", body = WeightsBody,
            headers(("etag" = String, description = "The version in quotes"))),
        (status = 404, description = "`unknown-learner`", body = Problem, content_type = "application/problem+json"),
        NoBodyProblems,
    ),
)]
pub(super) async fn learn(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    _: NoForm,
) -> Result<Response, Problem> {
    let answer = context.etude.learn(name.as_str(), context.etude.clock().now()).await?;
    let tag = format!("\"{}\"", answer.version);
    Ok(with_tag(json(StatusCode::OK, &WeightsBody::from(answer)), &tag))
}
