//! `/v1/models/{model}/report`.

use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::Response;

use super::SharedContext;
use super::answer::json_text;
use super::body::read_json;
use super::path::PathName;
use super::problem::{BodyProblems, Problem};
use super::requests::ReportRequest;
use crate::service::Caller;
use etude_core::inspection::Report;

/// What inspection finds in a model, and what of a demonstration its body can never meet.
///
/// Nothing is stored. What was not found within `deadline_ms` is left out, and named in `unknown`.
#[utoipa::path(
    post, path = "/v1/models/{model}/report", tag = "models",
    params(("model" = String, Path, description = "Its name")),
    request_body = ReportRequest,
    responses(
        (status = 200, description = "The report", body = Report),
        BodyProblems,
        (status = 404, description = "`unknown-model`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn make_report(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    caller: Caller,
    request: Request,
) -> Result<Response, Problem> {
    let body = read_json(request, &context).await?;
    Ok(json_text(StatusCode::OK, context.etude.report(&name, Some(body), caller).await?))
}

/// What inspection finds in a model: what its body comes to, what it cannot undo, and how far a stream should look ahead.
#[utoipa::path(
    get, path = "/v1/models/{model}/report", tag = "models",
    params(("model" = String, Path, description = "Its name")),
    responses(
        (status = 200, description = "The report, without a demonstration", body = Report),
        (status = 404, description = "`unknown-model`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`: not a name; or nothing was experienced yet", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_report(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    caller: Caller,
) -> Result<Response, Problem> {
    Ok(json_text(StatusCode::OK, context.etude.report(&name, None, caller).await?))
}
