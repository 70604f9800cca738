//! `/v1/policies`.

use axum::Extension;
use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::LOCATION;
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode};
use axum::response::Response;
use serde::Serialize;
use utoipa::{IntoParams, ToSchema};

use super::answer::{json, json_text};
use super::body::{NoForm, read_json};
use super::idempotency::Key;
use super::paging::{List, Paging, after_sequence, name_in, one_of};
use super::path::PathId;
use super::problem::{BodyProblems, DeletionProblems, Problem};
use super::request_id::RequestId;
use super::requests::{BatchRequest, PolicyRequest};
use super::{SharedContext, answer};
use crate::service::{Caller, PolicyFilter, ServiceError};
use etude_core::mapping::{Policy, PolicySummary, Status};

/// Follow a demonstration: the policy whose effects come closest to it, stored unless the request says otherwise.
#[utoipa::path(
    post, path = "/v1/policies", tag = "policies",
    params(("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters, such as a UUID: the same key with the same body gives the same answer for a day, however often it is sent. Requests that fail are not remembered, nor those with `store` false")),
    request_body = PolicyRequest,
    responses(
        (status = 200, description = "The policy, of which nothing is kept as `store` is false: it has no `id`, and is not refined", body = Policy),
        (status = 201, description = "The policy", body = Policy,
            headers(("location" = String, description = "Where it can be read again"))),
        BodyProblems,
        (status = 404, description = "`unknown-model`, `unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`; `idempotency-key-reused`: the key came with another body before", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn make_policy(
    State(context): State<SharedContext>,
    caller: Caller,
    Key(key): Key,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_json(request, &context).await?;
    let made = match key {
        // Boxed, as the router moves what it awaits several times.
        None => Box::pin(context.etude.make_policy(body, caller)).await?,
        Some(key) => Box::pin(context.etude.make_policy_once(&key, body, caller)).await?,
    };
    let status = if made.id.is_some() { StatusCode::CREATED } else { StatusCode::OK };
    let mut response = answer::counted(json_text(status, made.policy), made.held);
    let location = made.id.map(|id| HeaderValue::try_from(format!("/v1/policies/{id}")));
    if let Some(Ok(location)) = location {
        response.headers_mut().insert(LOCATION, location);
    }
    Ok(response)
}

/// Follow many demonstrations with one body: a policy or a problem for each of them, in the order of the items.
///
/// Options beside `items` hold for every item that has none of its own; weights are merged attribute by attribute. What is wrong
/// with an item is told in its place, with pointers into the batch, and does not keep the others from their policies; what is
/// wrong with the batch itself fails the whole. The policies are those that single requests give, and they are stored together:
/// all of them are durable when the batch is answered, and none is if it is not. With `store` false, none is kept, and none has an `id`.
#[utoipa::path(
    post, path = "/v1/policies:batch", tag = "policies",
    request_body = BatchRequest,
    responses(
        (status = 200, description = "For each item its policy, or what is wrong with it", body = BatchAnswer),
        BodyProblems,
        (status = 404, description = "`unknown-model`, `unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn make_policies(
    State(context): State<SharedContext>,
    caller: Caller,
    Extension(id): Extension<RequestId>,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_json(request, &context).await?;
    let made = context.etude.make_policies(body, caller).await?;
    let (before, after) = (r#"{"items":["#, "]}");
    let n_bytes: usize = made.items.iter().flatten().map(|made| made.policy.len() + 1).sum();
    let mut text = String::with_capacity(before.len() + n_bytes + after.len());
    let mut separator = before;
    for item in made.items {
        text.push_str(separator);
        match item {
            Ok(policy) => text.push_str(&policy.policy),
            Err(error) => {
                let problem = ItemProblem { problem: Problem::from(error).of_request(&id) };
                text.push_str(&serde_json::to_string(&problem).map_err(ServiceError::Write)?);
            }
        }
        separator = ",";
    }
    text.push_str(after);
    Ok(answer::counted(json_text(StatusCode::OK, text), made.held))
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
pub(super) async fn get_policy(State(context): State<SharedContext>, PathId(id): PathId) -> Result<Response, Problem> {
    let (policy, held) = context.etude.policy(&id).await?;
    Ok(answer::counted(json_text(StatusCode::OK, policy), held))
}

/// Delete a policy. A policy that it refines, or that refines it, stays and forgets it, as its session does.
#[utoipa::path(
    delete, path = "/v1/policies/{policy}", tag = "policies",
    params(("policy" = String, Path, description = "Its id")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 404, description = "`unknown-policy`", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "`in-use`: a trial has it", body = Problem, content_type = "application/problem+json"),
        DeletionProblems,
    ),
)]
pub(super) async fn delete_policy(
    State(context): State<SharedContext>,
    PathId(id): PathId,
    _: NoForm,
) -> Result<StatusCode, Problem> {
    context.etude.delete_policy(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Which policies are wanted: those that have all that is given.
#[derive(Clone, Debug, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct WhichPolicies {
    /// Only those of the model with this name.
    model: Option<String>,
    /// Only those with weights of the learner with this name.
    learner: Option<String>,
    /// Only those with this status: `optimal`, `bounded` or `local`.
    #[param(value_type = Option<String>)]
    status: Option<Status>,
}

/// [`WhichPolicies`] and [`Paging`] of the same query.
pub(super) struct PoliciesQuery(WhichPolicies, Paging);

impl<S: Send + Sync> FromRequestParts<S> for PoliciesQuery {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let mut which = WhichPolicies { model: None, learner: None, status: None };
        let paging = Paging::read(parts, "limit, after, model, learner, status", |name, value| match name {
            "model" => Some(name_in(value).map(|name| which.model = Some(name))),
            "learner" => Some(name_in(value).map(|name| which.learner = Some(name))),
            "status" => Some(one_of(value, Status::ALL, Status::name).map(|status| which.status = Some(status))),
            _ => None,
        })?;
        Ok(Self(which, paging))
    }
}

/// Policies without their steps, oldest first.
#[utoipa::path(
    get, path = "/v1/policies", tag = "policies",
    params(WhichPolicies, Paging),
    responses(
        (status = 200, description = "A page of policies", body = List<PolicySummary>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_policies(
    State(context): State<SharedContext>,
    PoliciesQuery(WhichPolicies { model, learner, status }, paging): PoliciesQuery,
) -> Result<Response, Problem> {
    let filter = PolicyFilter { model, learner, status };
    let page = context.etude.policies(&filter, after_sequence(&paging)?, paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, |policy| policy)))
}

/// What became of a batch.
#[derive(ToSchema)]
#[expect(dead_code, reason = "what describes the answer, which is put together from texts")]
pub(super) struct BatchAnswer {
    /// For each item of the batch, in the same order.
    items: Vec<BatchItem>,
}

/// What became of an item.
#[derive(Serialize, ToSchema)]
#[serde(untagged)]
#[expect(dead_code, clippy::large_enum_variant, reason = "as above")]
enum BatchItem {
    /// Its policy, stored.
    Policy(Policy),
    /// What is wrong with it.
    Problem(ItemProblem),
}

/// What is wrong with an item.
#[derive(Serialize, ToSchema)]
struct ItemProblem {
    /// As a single request is answered; pointers lead into the batch.
    problem: Problem,
}
