//! `/v1/learners/{learner}/trials` and `/v1/trials`.

use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::LOCATION;
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode};
use axum::response::Response;
use jiff::Timestamp;
use serde::Serialize;
use serde_json::value::RawValue;
use utoipa::{IntoParams, ToSchema};

use super::answer::json;
use super::body::{NoForm, read_json, read_small_json};
use super::idempotency::Key;
use super::paging::{List, Paging, one_of};
use super::path::{PathId, PathName};
use super::problem::{BodyProblems, DeletionProblems, Problem};
use super::requests::TrialRequest;
use super::{SharedContext, answer};
use crate::service::TrialStatus;
use crate::service::{Caller, TrialAnswer};
use etude_core::mapping::Policy;

/// A trial: weights drawn from a learner, the policy that they gave, and the reward that it earned.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Trial)]
pub(super) struct TrialBody {
    /// Under which it is stored.
    id: String,
    /// The learner.
    #[schema(example = "gold")]
    learner: String,
    /// Counted from 1 per learner. With the learner's seed, what the draw is keyed by.
    #[schema(example = 41)]
    number: u64,
    /// What has become of it: `active` until it has a reward, `rewarded` then, `learned` once that is folded into the
    /// weights; `failed`; `expired` when its lease is over (a late reward is still accepted).
    #[schema(value_type = TrialStatusName, example = "active")]
    status: &'static str,
    /// The weights as drawn, by attribute of the learner.
    #[schema(value_type = BTreeMap<String, f64>)]
    weights: Box<RawValue>,
    /// The version of the learner's weights that they were drawn from.
    #[schema(example = 12)]
    weights_version: u64,
    /// What it earned.
    reward: Option<f64>,
    /// Counted from 1 per learner, in the order in which rewards were accepted.
    reward_order: Option<u64>,
    /// The version of the learner's weights that folded the reward in.
    learned_version: Option<u64>,
    /// Why it failed, in the client's words.
    reason: Option<String>,
    /// When it expires.
    #[schema(value_type = String, format = DateTime)]
    lease_expires_at: Timestamp,
    /// The policy to be executed.
    policy_id: String,
    /// The policy in full; not in lists, nor when a reward is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Policy, required = false)]
    policy: Option<Box<RawValue>>,
}

impl TrialBody {
    fn of(answer: TrialAnswer) -> Self {
        let TrialAnswer { trial, weights, status, policy, held: _ } = answer;
        Self {
            id: trial.id,
            learner: trial.learner,
            number: trial.number,
            status: status.name(),
            weights,
            weights_version: trial.weights_version,
            reward: trial.reward.map(|accepted| accepted.reward),
            reward_order: trial.reward.map(|accepted| accepted.reward_order),
            learned_version: trial.learned_version,
            reason: trial.failed.and_then(|failure| failure.reason),
            lease_expires_at: trial.lease_expires_at,
            policy_id: trial.policy_id,
            policy,
        }
    }
}

/// What has become of a trial.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = TrialStatus)]
#[expect(dead_code, reason = "what describes the names")]
enum TrialStatusName {
    Active,
    Rewarded,
    Learned,
    Failed,
    Expired,
}

/// What a trial earned.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Reward)]
pub(super) struct RewardBody {
    /// Finite.
    #[schema(example = 974)]
    reward: f64,
}

/// Why a trial failed.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Failure)]
pub(super) struct FailureBody {
    /// In the client's words; up to 1000 characters.
    #[schema(example = "the battery is empty")]
    reason: Option<String>,
}

/// Draw weights from a learner, and map a demonstration with them.
#[utoipa::path(
    post, path = "/v1/learners/{learner}/trials", tag = "trials",
    params(
        ("learner" = String, Path, description = "The learner's name"),
        ("idempotency-key" = Option<String>, Header, description = "1 to 255 visible ASCII characters, such as a UUID: the same key with the same body gives the same answer for a day, however often it is sent. Requests that fail are not remembered"),
    ),
    request_body = TrialRequest,
    responses(
        (status = 201, description = "The trial, with its policy", body = TrialBody,
            headers(("location" = String, description = "Where it can be read again"))),
        BodyProblems,
        (status = 404, description = "`unknown-learner`, `unknown-model`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`; also if the model lacks an attribute of the learner; `idempotency-key-reused`: the key came with another body before", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn make_trial(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    caller: Caller,
    Key(key): Key,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_json(request, &context).await?;
    let mut made = match key {
        None => context.etude.make_trial(&name, body, caller).await?,
        Some(key) => Box::pin(context.etude.make_trial_once(&name, &key, body, caller)).await?,
    };
    let held = made.held.take();
    let made = TrialBody::of(made);
    let location = HeaderValue::from_str(&format!("/v1/trials/{}", made.id));
    let mut response = answer::counted(json(StatusCode::CREATED, &made), held);
    if let Ok(location) = location {
        response.headers_mut().insert(LOCATION, location);
    }
    Ok(response)
}

/// Which trials are wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct WhichTrials {
    /// Only those with this status: `active`, `rewarded`, `learned`, `failed` or `expired`.
    #[param(value_type = Option<TrialStatusName>)]
    status: Option<TrialStatus>,
}

/// [`WhichTrials`] and [`Paging`] of the same query.
pub(super) struct TrialsQuery(WhichTrials, Paging);

impl<S: Send + Sync> FromRequestParts<S> for TrialsQuery {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let mut which = WhichTrials { status: None };
        let paging = Paging::read(parts, "limit, after, status", |name, value| match name {
            "status" => {
                Some(one_of(value, TrialStatus::ALL, TrialStatus::name).map(|status| which.status = Some(status)))
            }
            _ => None,
        })?;
        Ok(Self(which, paging))
    }
}

/// Trials of a learner without their policies, in the order of their numbers.
#[utoipa::path(
    get, path = "/v1/learners/{learner}/trials", tag = "trials",
    params(("learner" = String, Path, description = "The learner's name"), WhichTrials, Paging),
    responses(
        (status = 200, description = "A page of trials", body = List<TrialBody>),
        (status = 404, description = "`unknown-learner`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_trials(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    TrialsQuery(which, paging): TrialsQuery,
) -> Result<Response, Problem> {
    let after = paging.after_number()?.unwrap_or(0);
    let page = context.etude.trials(&name, which.status, context.etude.clock().now(), after, paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, TrialBody::of)))
}

/// A trial, with its policy.
#[utoipa::path(
    get, path = "/v1/trials/{trial}", tag = "trials",
    params(("trial" = String, Path, description = "Its id")),
    responses(
        (status = 200, description = "The trial", body = TrialBody),
        (status = 404, description = "`unknown-trial`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_trial(State(context): State<SharedContext>, PathId(id): PathId) -> Result<Response, Problem> {
    let mut trial = context.etude.trial(&id, context.etude.clock().now()).await?;
    let held = trial.held.take();
    Ok(answer::counted(json(StatusCode::OK, &TrialBody::of(trial)), held))
}

/// Delete a trial. Its policy stays, and its number is not given to another one.
#[utoipa::path(
    delete, path = "/v1/trials/{trial}", tag = "trials",
    params(("trial" = String, Path, description = "Its id")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 404, description = "`unknown-trial`", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "`in-use`: it has a reward, which its learner learns from", body = Problem, content_type = "application/problem+json"),
        DeletionProblems,
    ),
)]
pub(super) async fn delete_trial(
    State(context): State<SharedContext>,
    PathId(id): PathId,
    _: NoForm,
) -> Result<StatusCode, Problem> {
    context.etude.delete_trial(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Give a trial its reward; durable before it is answered. Counts once, however often it is sent.
#[utoipa::path(
    put, path = "/v1/trials/{trial}/reward", tag = "trials",
    params(("trial" = String, Path, description = "Its id")),
    request_body = RewardBody,
    responses(
        (status = 200, description = "The reward is the trial's, now or already", body = TrialBody),
        BodyProblems,
        (status = 404, description = "`unknown-trial`: also if its learner was deleted", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "`already-rewarded`: it has another reward; `trial-failed`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`: among others, not finite", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn put_reward(
    State(context): State<SharedContext>,
    PathId(id): PathId,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_small_json(request, &context).await?;
    let trial = context.etude.reward_trial(&id, &body, context.etude.clock().now()).await?;
    Ok(json(StatusCode::OK, &TrialBody::of(trial)))
}

/// End a trial without a reward.
#[utoipa::path(
    post, path = "/v1/trials/{trial}/fail", tag = "trials",
    params(("trial" = String, Path, description = "Its id")),
    request_body = FailureBody,
    responses(
        (status = 200, description = "The trial has failed, now or already for this reason", body = TrialBody),
        BodyProblems,
        (status = 404, description = "`unknown-trial`: also if its learner was deleted", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "`already-rewarded`; `trial-failed`: for another reason", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn fail_trial(
    State(context): State<SharedContext>,
    PathId(id): PathId,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_small_json(request, &context).await?;
    let trial = context.etude.fail_trial(&id, &body, context.etude.clock().now()).await?;
    Ok(json(StatusCode::OK, &TrialBody::of(trial)))
}
