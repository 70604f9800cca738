//! `/v1/models/{model}/experience`.

use axum::extract::{Query, Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use serde::Serialize;
use utoipa::ToSchema;

use super::SharedContext;
use super::answer::json;
use super::body::{is_ndjson, read_json, read_lines, refuse};
use super::models::Counts;
use super::path::PathName;
use super::problem::{BodyProblems, Problem};
use crate::service::{BatchText, Caller, ExperienceAnswer};
use etude_core::document::Faults;
use etude_core::mapping::ObservationDocument;

/// What a body was seen to do.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ExperienceRequest)]
pub(super) struct ExperienceRequest {
    /// The client's name for it, 1 to 255 characters: a batch of this name counts once.
    #[schema(min_length = 1, max_length = 255, example = "monday")]
    batch: String,
    /// All of them count, or none.
    transitions: Vec<SeenTransition>,
}

/// A transition that a body was seen to make.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = SeenTransition)]
struct SeenTransition {
    /// Where it was, with the value of every attribute.
    state: ObservationDocument,
    /// What it did: the name of an action.
    #[schema(example = "forward")]
    action: String,
    /// Where it was then, with the value of every attribute.
    next: ObservationDocument,
    /// How often it was seen; 1 if left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1, maximum = 1_000_000_000)]
    count: Option<u64>,
    /// What it cost each time: 0 to 1e150; left out: what the action costs.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0, example = 1.2)]
    cost: Option<f64>,
}

/// What became of a batch.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Experience)]
struct ExperienceBody {
    /// The name of the model.
    #[schema(example = "explored")]
    model: String,
    /// The client's name for the batch.
    #[schema(example = "monday")]
    batch: String,
    /// The model's hash with this batch and all before it: SHA-256 of the hash before, followed by the batch in canonical form.
    hash: String,
    /// How much there was of everything with it.
    counts: Counts,
}

impl From<ExperienceAnswer> for ExperienceBody {
    fn from(answer: ExperienceAnswer) -> Self {
        let ExperienceAnswer { model, batch, hash, n_attributes, n_actions, revision } = answer;
        Self { model, batch, hash, counts: Counts::of_revision(n_attributes, n_actions, revision) }
    }
}

/// Tell a model what was experienced.
///
/// The model's dynamics are of the kind `experience`. A log can be sent as it is, as lines of JSON (NDJSON), a transition each; then the query
/// says what the batch is called. A batch counts once, however often it is sent, and is durable before it is answered;
/// sent again, it is answered as it was the first time. It gives the model a new hash: requests from then on use this revision, policies
/// keep the hash of the one that they were made with, and sessions go on with theirs, also once they are resumed.
#[utoipa::path(
    post, path = "/v1/models/{model}/experience", tag = "models",
    params(
        ("model" = String, Path, description = "Its name"),
        ("batch" = Option<String>, Query, description = "Of lines: the client's name for the batch, 1 to 255 characters"),
    ),
    request_body(content(
        (ExperienceRequest = "application/json"),
        (String = "application/x-ndjson", example = "{\"state\":{\"x\":0},\"action\":\"on\",\"next\":{\"x\":1}}\n{\"state\":{\"x\":1},\"action\":\"on\",\"next\":{\"x\":2},\"cost\":1.2}\n"),
    )),
    responses(
        (status = 200, description = "The batch counts, now or already", body = ExperienceBody),
        BodyProblems,
        (status = 404, description = "`unknown-model`", body = Problem, content_type = "application/problem+json"),
        (status = 409, description = "`conflict`: a batch of this name has come with other content", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`; also if the model is not one of experience", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn add_experience(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    caller: Caller,
    request: Request,
) -> Result<Response, Problem> {
    let named = named(&request);
    let is_lines = is_ndjson(request.headers());
    let text = if is_lines {
        let Some(batch) = named else {
            return Err(refuse(request, &context, Faults::one("/batch", UNNAMED).into()));
        };
        BatchText::Lines { batch, text: read_lines(request, &context).await? }
    } else {
        if named.is_some() {
            return Err(refuse(request, &context, Faults::one("/batch", NAMED_TWICE).into()));
        }
        BatchText::Json(read_json(request, &context).await?)
    };
    let answer = context.etude.add_experience(&name, text, caller).await?;
    Ok(json(StatusCode::OK, &ExperienceBody::from(answer)))
}

/// Why lines are refused that have no name.
const UNNAMED: &str = "is missing: what is sent as lines has its name in the query, `?batch=NAME`";
/// Why a name in the query is refused.
const NAMED_TWICE: &str =
    "is for what is sent as lines (`content-type: application/x-ndjson`); JSON has its name in it";

/// What the query says that the batch is called.
fn named(request: &Request) -> Option<String> {
    let query = Query::<Vec<(String, String)>>::try_from_uri(request.uri()).ok()?;
    query.0.into_iter().find_map(|(name, value)| (name == "batch").then_some(value))
}
