//! `/v1/models`.

use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::{Request, State};
use axum::http::header::IF_NONE_MATCH;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use futures_util::future::{self, OptionFuture};
use futures_util::stream::{self, Stream};
use jiff::Timestamp;
use serde::Serialize;
use serde_json::value::RawValue;
use utoipa::ToSchema;

use super::SharedContext;
use super::answer;
use super::answer::{json, json_stream};
use super::body::{NoForm, SentLimit, SentModel, read_model};
use super::encoding::DecodedLimit;
use super::paging::{List, Paging};
use super::path::PathName;
use super::problem::{BodyProblems, NoBodyProblems, Problem};
use super::tags::{has_tag, replaces, with_tag};
use crate::service::{Caller, DefinitionReader, Etude, ModelDefinition, Registered, ServiceError};
use crate::service::{ModelSummary, PIECE_BYTES, Revision};
use etude_core::attribute::AttributeDocument;
use etude_core::model::{ActionDocument, DefinitionDocument};

/// A registered model.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ModelSummary)]
struct ModelBody {
    /// The name it is registered under.
    #[schema(example = "figure-4")]
    name: String,
    /// SHA-256 of its content in canonical form: equal for equal content, however that was written. Of a model of experience, one over that
    /// and all that it was told.
    hash: String,
    /// The attributes of a state, in order, defaults filled in.
    attributes: Vec<AttributeDocument>,
    /// The actions of the body, in order, defaults filled in.
    actions: Vec<ActionDocument>,
    /// How much there is of everything.
    counts: Counts,
    /// When it was registered.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
}

/// How much of everything a model has.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ModelCounts)]
pub(super) struct Counts {
    /// Attributes.
    attributes: usize,
    /// Actions.
    actions: usize,
    /// States; where they follow from rules, those that the body can reach; where they are experienced, those that were. `null` if there are more of these than the limit: such a world is
    /// searched lazily, each search finds and numbers the states that it comes to.
    states: Option<u64>,
    /// Transitions; `null` if the states are.
    transitions: Option<u64>,
    /// Pairs of a state and an action that have several outcomes, each with its probability. Where there are any, the model can be registered and
    /// read, and is not searched yet: what would search it is refused.
    #[serde(rename = "stochastic")]
    n_stochastic: u64,
    /// States that must never be entered.
    #[serde(rename = "unsafe")]
    n_unsafe: u64,
}

impl Counts {
    /// Those of a revision of a model of experience.
    pub(super) fn of_revision(attributes: usize, actions: usize, revision: Revision) -> Self {
        let Revision { size, n_stochastic, n_unsafe } = revision;
        let (states, transitions) = (Some(size.n_states), Some(size.n_transitions));
        Self { attributes, actions, states, transitions, n_stochastic, n_unsafe }
    }
}

impl From<ModelSummary> for ModelBody {
    fn from(summary: ModelSummary) -> Self {
        Self {
            name: summary.name,
            hash: summary.hash,
            counts: Counts {
                attributes: summary.attributes.len(),
                actions: summary.actions.len(),
                states: summary.size.map(|size| size.n_states),
                transitions: summary.size.map(|size| size.n_transitions),
                n_stochastic: summary.n_stochastic,
                n_unsafe: summary.n_unsafe,
            },
            attributes: summary.attributes,
            actions: summary.actions,
            created_at: summary.created_at,
        }
    }
}

/// A registered model, with what it was registered as.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Model)]
struct WholeModelBody {
    #[serde(flatten)]
    summary: ModelBody,
    /// What it was registered as, in canonical form. Registering this elsewhere gives the same hash, unless it was told some experience.
    #[schema(value_type = DefinitionDocument)]
    definition: Box<RawValue>,
}

/// Register a model under a name.
///
/// The body may be compressed (`Content-Encoding: gzip` or `zstd`), and its members may stand in any order; a large one is read as it
/// comes. As NDJSON, the first line is the model, whose `dynamics` may lack `states` and `transitions`; each further line is an object
/// with more of one or both, such as `{"states": [[2, "east", "open"]]}`, in any number and order. A line has at most 64 MiB.
/// Faults then carry the `line`, and a `pointer` within it.
///
/// A file of another tool is imported, by its content type: `application/vnd.gymnasium+json` is the table `P` of a Gymnasium environment, as
/// `examples/gymnasium/export.py` writes it; `application/vnd.fast-downward.sas` is a SAS+ task, as Fast Downward translates it from PDDL; `application/vnd.umb`, `application/vnd.storm.drn` and
/// `application/vnd.prism+tar` (the explicit files in a tar archive) are models of verification tools. Then the query may say `without` (actions that the body lacks, by name; `*` stands for any text), `cost` (`ACTION=COST`,
/// in place of what the file says; or the name of the reward that is the cost), `rename` (`OLD=NEW`) and `unsafe` (an expression of CEL over the
/// attributes: states in which it holds must never be entered), each any number of times.
///
/// With `If-Match`, the model takes the place of the one that has this hash, at once: requests from then on use it. Policies keep the hash of
/// the model that they were made with, and sessions that run go on with it; it is gone for sessions that are resumed and policies that are to
/// be refined. Learners are of attributes, and stay.
#[utoipa::path(
    put, path = "/v1/models/{model}", tag = "models",
    params(
        ("model" = String, Path, description = "Its name: 1 to 64 of `a-z A-Z 0-9 . _ -`, other than `.` and `..`"),
        ("content-encoding" = Option<String>, Header, description = "`gzip`, `zstd` or `identity`"),
        ("without" = Option<Vec<String>>, Query, description = "Of what is imported: actions that the body lacks, by name; `*` stands for any text", style = Form, explode),
        ("cost" = Option<Vec<String>>, Query, description = "Of what is imported: `ACTION=COST`, or the name of the reward that is the cost", style = Form, explode),
        ("rename" = Option<Vec<String>>, Query, description = "Of what is imported: `OLD=NEW`", style = Form, explode),
        ("unsafe" = Option<Vec<String>>, Query, description = "Of what is imported: expressions of CEL over the model's attributes, which hold in states that must never be entered", style = Form, explode),
        ("if-match" = Option<String>, Header, description = "The hash of the model that is to be replaced, in quotes as in `ETag`; `*`: whichever there is"),
    ),
    request_body(content(
        (DefinitionDocument = "application/json"),
        (std::collections::HashMap<String, serde_json::Value> = "application/vnd.gymnasium+json"),
        (String = "application/vnd.fast-downward.sas"),
        (Vec<u8> = "application/vnd.umb"),
        (String = "application/vnd.storm.drn"),
        (Vec<u8> = "application/vnd.prism+tar"),
        (String = "application/x-ndjson", example = "{\"attributes\":[{\"name\":\"x\",\"kind\":\"number\"}],\"actions\":[{\"name\":\"on\"}],\"dynamics\":{\"kind\":\"table\",\"start\":0}}\n{\"states\":[[0],[1]]}\n{\"transitions\":[[0,\"on\",1]]}\n"),
    )),
    responses(
        (status = 201, description = "It is new", body = ModelBody, headers(("etag" = String, description = "The hash in quotes"))),
        (status = 200, description = "The same content was there already, under this name, or it took the place of what `If-Match` names", body = ModelBody,
            headers(("etag" = String, description = "The hash in quotes"))),
        BodyProblems,
        (status = 409, description = "`conflict`: other content is there under this name", body = Problem, content_type = "application/problem+json"),
        (status = 412, description = "`precondition-failed`: other content is there than `If-Match` names, or none", body = Problem, content_type = "application/problem+json"),
        (status = 415, description = "`unsupported-media-type`; `unsupported-encoding`: see `Accept-Encoding`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `not-ready`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn put_model(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    caller: Caller,
    request: Request,
) -> Result<Response, Problem> {
    let sent = match context.max_model_bytes {
        Some(n_bytes) => SentLimit { n_bytes, setting: "ETUDE_MAX_MODEL_BYTES" },
        None => SentLimit { n_bytes: context.max_body_bytes, setting: "ETUDE_MAX_BODY_BYTES" },
    };
    let decoded = DecodedLimit { n_bytes: context.max_model_text_bytes, setting: "ETUDE_MAX_MODEL_TEXT_BYTES" };
    let replaces = replaces(request.headers());
    let SentModel { text, form, pump, held } = read_model(request, sent, decoded, &context).await?;
    let put = context.etude.replace_model(&name, text, form, replaces, caller);
    let pumping = OptionFuture::from(pump.map(|pump| pump.run(&context)));
    let (put, _) = tokio::join!(put, pumping);
    drop(held);
    let (registered, summary) = put?;
    let status = match registered {
        Registered::New => StatusCode::CREATED,
        Registered::Instead | Registered::Already => StatusCode::OK,
    };
    let tag = tag_of(&summary.hash);
    Ok(with_tag(json(status, &ModelBody::from(summary)), &tag))
}

/// A model, with what it was registered as.
#[utoipa::path(
    get, path = "/v1/models/{model}", tag = "models",
    params(
        ("model" = String, Path, description = "Its name"),
        ("if-none-match" = Option<String>, Header, description = "Hashes that the client has, as in `ETag`"),
    ),
    responses(
        (status = 200, description = "The model", body = WholeModelBody, headers(("etag" = String, description = "The hash in quotes"))),
        (status = 304, description = "The client has this one"),
        (status = 404, description = "`unknown-model`", body = Problem, content_type = "application/problem+json"),
        (status = 422, description = "`invalid`: not a name", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_model(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    if headers.contains_key(IF_NONE_MATCH) {
        let tag = tag_of(&context.etude.model_hash(&name).await?);
        if has_tag(&headers, &tag) {
            return Ok(with_tag(StatusCode::NOT_MODIFIED.into_response(), &tag));
        }
    }
    // What it takes is held until the answer is written.
    let answer = context.etude.model(&name).await?;
    let tag = tag_of(&answer.summary.hash);
    let summary = answer.summary.into();
    let response = match answer.definition {
        ModelDefinition::Text(definition) => json(StatusCode::OK, &WholeModelBody { summary, definition }),
        ModelDefinition::Pieces(pieces) => json_stream(whole_model(Arc::clone(&context.etude), &summary, pieces)?),
    };
    Ok(with_tag(response, &tag))
}

/// The tag of a model with this hash.
fn tag_of(hash: &str) -> String {
    format!("\"{hash}\"")
}

/// The text of a [`WholeModelBody`] whose definition is too large to be held.
fn whole_model(
    etude: Arc<Etude>,
    summary: &ModelBody,
    pieces: DefinitionReader,
) -> Result<impl Stream<Item = Result<Bytes, ServiceError>> + use<>, ServiceError> {
    let mut head = serde_json::to_vec(summary).map_err(ServiceError::Write)?;
    head.pop();
    head.extend_from_slice(b",\"definition\":");
    let pieces = stream::try_unfold(pieces, move |mut pieces| {
        let etude = Arc::clone(&etude);
        async move {
            // A piece is kept until it is written. Where there is never room for one, it is not counted.
            let held = etude.memory().take(PIECE_BYTES as u64).await.ok();
            let piece = pieces.next(&etude).await?;
            Ok(piece.map(|piece| (answer::holding(piece.into(), held), pieces)))
        }
    });
    let of = |bytes: Vec<u8>| stream::once(future::ready(Ok(bytes.into())));
    Ok(of(head).chain(pieces).chain(of(b"}".to_vec())))
}

/// Models, in the order of their names.
#[utoipa::path(
    get, path = "/v1/models", tag = "models",
    params(Paging),
    responses(
        (status = 200, description = "A page of models", body = List<ModelBody>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_models(State(context): State<SharedContext>, paging: Paging) -> Result<Response, Problem> {
    let (page, _held) = context.etude.models(paging.after.as_deref(), paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, ModelBody::from)))
}

/// Delete a model. Policies made with it stay.
#[utoipa::path(
    delete, path = "/v1/models/{model}", tag = "deletion",
    params(("model" = String, Path, description = "Its name")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 404, description = "`unknown-model`", body = Problem, content_type = "application/problem+json"),
        NoBodyProblems,
    ),
)]
pub(super) async fn delete_model(
    State(context): State<SharedContext>,
    PathName(name): PathName,
    _: NoForm,
) -> Result<StatusCode, Problem> {
    context.etude.delete_model(&name).await?;
    Ok(StatusCode::NO_CONTENT)
}
