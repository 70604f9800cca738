//! `/v1/policies`.

use std::time::Instant;

use axum::extract::{Request, State};
use axum::http::header::LOCATION;
use axum::http::{HeaderValue, StatusCode};
use axum::response::Response;
use jiff::Timestamp;

use super::Context;
use super::body::{json, json_text, read_json};
use super::paging::{List, Paging, after_sequence};
use super::path::PathId;
use super::problem::Problem;
use crate::mapping::{Policy, PolicySummary, RequestDocument};

/// Follow a demonstration: the policy whose effects come closest to it, stored.
#[utoipa::path(
    post, path = "/v1/policies", tag = "policies",
    request_body = RequestDocument,
    responses(
        (status = 201, description = "The policy", body = Policy,
            headers(("location" = String, description = "Where it can be read again"))),
        (status = 400, description = "`malformed-json`, `incomplete-body`, `broken-encoding`", body = Problem, content_type = "application/problem+json"),
        (status = 404, description = "`unknown-model`, `unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 408, description = "`slow-body`", body = Problem, content_type = "application/problem+json"),
        (status = 413, description = "`too-large`", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "`unsupported-media-type`, `unsupported-encoding`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn make_policy(State(context): State<Context>, request: Request) -> Result<Response, Problem> {
    let arrived = Instant::now();
    let body = read_json(request, context.max_body_bytes).await?;
    let made = context.etude.make_policy(body, arrived, Timestamp::now()).await?;
    let mut response = json_text(StatusCode::CREATED, made.policy);
    if let Ok(location) = HeaderValue::from_str(&format!("/v1/policies/{}", made.id)) {
        response.headers_mut().insert(LOCATION, location);
    }
    Ok(response)
}

/// A policy, as it was answered when it was made.
#[utoipa::path(
    get, path = "/v1/policies/{policy}", tag = "policies",
    params(("policy" = String, Path, description = "Its id")),
    responses(
        (status = 200, description = "The policy", body = Policy),
        (status = 404, description = "`unknown-policy`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_policy(State(context): State<Context>, PathId(id): PathId) -> Result<Response, Problem> {
    Ok(json_text(StatusCode::OK, context.etude.policy(&id).await?))
}

/// Policies without their steps, oldest first.
#[utoipa::path(
    get, path = "/v1/policies", tag = "policies",
    params(Paging),
    responses(
        (status = 200, description = "A page of policies", body = List<PolicySummary>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_policies(State(context): State<Context>, paging: Paging) -> Result<Response, Problem> {
    let page = context.etude.policies(after_sequence(&paging)?, paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, |policy| policy)))
}
