//! `/v1/stream` and `/v1/sessions`: the stream protocol over websockets and NDJSON.

mod frames;
mod metered;
mod ndjson;
mod pause;
mod websocket;

use std::ops::ControlFlow;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::CONTENT_TYPE;
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use hyper_util::rt::TokioIo;
use jiff::Timestamp;
use serde::Serialize;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tracing::Instrument;
use utoipa::{IntoParams, ToSchema};

pub(super) use self::frames::ClientFrameDocument;
use super::SharedContext;
use super::answer::json;
use super::body::{NoForm, is_ndjson, refuse};
use super::connections::IsStream;
use super::encoding::Encoding;
use super::paging::{List, Paging, after_sequence, name_in, one_of};
use super::path::PathId;
use super::problem::{DeletionProblems, Problem, ProblemKind};
use crate::service::{Caller, SessionFilter, SessionRecord, SessionStatus};
use crate::stream::{Gone, Incoming, PROTOCOL, Room, SMALL_FRAME_BYTES, Sender};
use etude_core::attribute::ByAttribute;

/// How long a closing handshake may take.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Stream a demonstration over a websocket.
///
/// The subprotocol is `etude.v1+json`. Each text message of the client is a `ClientFrame`, each of the server a `ServerFrame`. A page cannot
/// try this as a request; `POST /v1/stream` takes the same frames.
#[utoipa::path(
    get, path = "/v1/stream", tag = "stream protocol",
    responses(
        (status = 101, description = "The websocket is open; the server speaks first"),
        (status = 426, description = "`upgrade-required`: not a websocket request", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn websocket(
    State(context): State<SharedContext>,
    Caller { client, .. }: Caller,
    mut request: Request,
) -> Result<Response, Problem> {
    // The socket is ours, to be read with care. What is left is the handshake, which needs one to speak of.
    let upgraded = hyper::upgrade::on(&mut request);
    let (mut parts, _) = request.into_parts();
    parts.extensions.insert(hyper::upgrade::on(axum::http::Request::new(())));
    let upgrade = WebSocketUpgrade::from_request_parts(&mut parts, &()).await;
    let upgrade = upgrade.map_err(|rejection| Problem::new(ProblemKind::UpgradeRequired, rejection.body_text()))?;
    let room = context.admit_stream(client)?;
    let (streams, rounds, span) = (context.streams.clone(), context.rounds.clone(), tracing::Span::current());
    let serving = async move {
        // It fails where the connection has ended.
        if let Ok(socket) = upgraded.await {
            let (limits, socket) = (context.stream_limits, TokioIo::new(socket));
            Box::pin(websocket::serve(&context.etude, client, limits, socket, &room, &context.stopping)).await;
        }
        drop(room);
    };
    streams.spawn(rounds.run(client, serving.instrument(span)));
    // The one that it has leads nowhere.
    Ok(upgrade.protocols([PROTOCOL]).on_upgrade(async |_| ()))
}

/// The way in for frames: a queue, and the memory that they take.
struct Inlet<'s> {
    came: Sender<Incoming>,
    room: &'s Room,
}

impl Inlet<'_> {
    /// Passes on a frame once there is room and memory for it. Breaks if nothing that comes after it will be wanted.
    async fn pass_on(&self, text: Bytes) -> ControlFlow<()> {
        // It is not handled, and takes no memory for that, before there is room for it.
        let Ok(reserved) = self.came.reserve(text.len()).await else { return ControlFlow::Break(()) };
        let memory = self.room.take_to_handle(text.len()).await;
        if text.len() > SMALL_FRAME_BYTES {
            self.room.has_read();
        }
        let (incoming, is_last) = match memory {
            Ok(memory) => (Incoming::Frame { text, memory }, false),
            Err(_) => (Incoming::Crowded, true),
        };
        if reserved.send(incoming).is_err() || is_last { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }

    async fn tell(&self, incoming: Incoming) -> ControlFlow<()> {
        let is_last = !matches!(incoming, Incoming::Frame { .. } | Incoming::Binary);
        match self.came.send(incoming).await {
            Ok(()) if !is_last => ControlFlow::Continue(()),
            Ok(()) | Err(Gone) => ControlFlow::Break(()),
        }
    }
}

/// Stream a demonstration as NDJSON, both ways at the same time.
///
/// The same frames as over the websocket, one per line: each line that is sent is a `ClientFrame`, each that is answered a `ServerFrame`, as
/// told under "stream protocol". The answer begins at once and ends when the session is done or
/// an error ends it; a session that is not done can be resumed. The frames are not compressed.
#[utoipa::path(
    post, path = "/v1/stream", tag = "streams",
    request_body(content = String, content_type = "application/x-ndjson", description = "Client frames, one per line"),
    responses(
        (status = 200, description = "Server frames, one per line", body = String, content_type = "application/x-ndjson"),
        (status = 415, description = "`unsupported-encoding`, `unsupported-media-type`: not NDJSON", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn ndjson(
    State(context): State<SharedContext>,
    Caller { client, .. }: Caller,
    request: Request,
) -> Result<Response, Problem> {
    // A decoder gives what it has when it likes, and each would keep a window of megabytes for as long as its stream runs.
    if Encoding::declared(request.headers()) != Ok(Encoding::Identity) {
        let detail = "the frames of a stream are sent as they are, without `Content-Encoding`";
        return Err(Problem::new(ProblemKind::CompressedStream, detail));
    }
    if !is_ndjson(request.headers()) {
        let detail = "send frames, one per line, with the header `content-type: application/x-ndjson`";
        return Err(refuse(request, &context, Problem::new(ProblemKind::UnsupportedMediaType, detail)));
    }
    let room = context.admit_stream(client)?;
    let body = ndjson::begin_reading(request).await;
    let (lines, answer) = mpsc::channel(1);
    let (streams, rounds, span) = (context.streams.clone(), context.rounds.clone(), tracing::Span::current());
    let serving = async move {
        let limits = context.stream_limits;
        ndjson::serve(&context.etude, client, limits, body, lines, &room, &context.stopping).await;
        drop(room);
    };
    // The answer is read while the request is still being sent, so this runs beside it.
    streams.spawn(rounds.run(client, serving.instrument(span)));
    let mut response = Body::from_stream(ReceiverStream::new(answer)).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/x-ndjson"));
    response.extensions_mut().insert(IsStream);
    Ok(response)
}

/// A stream, running or done.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Session)]
struct SessionBody {
    /// Its id.
    id: String,
    /// Name of its model.
    model: String,
    /// Hash of its model's content.
    model_hash: String,
    /// The weights of the distance; `null` for a session that was opened before they were stored by attribute.
    #[schema(value_type = Option<BTreeMap<String, f64>>)]
    weights: Option<ByAttribute<f64>>,
    /// How many observations past the current one a decision may wait for; `null`: all.
    lookahead: Option<u32>,
    /// For how many milliseconds a step may wait; `null`: as long as `lookahead` lets it.
    lookahead_ms: Option<u64>,
    /// The learner whose weights are used, if any.
    learner: Option<String>,
    /// The version of the learner's weights.
    weights_version: Option<u64>,
    /// The trial that it explores, if any.
    trial_id: Option<String>,
    /// What has become of it.
    #[schema(value_type = SessionStatusName)]
    status: &'static str,
    /// How many observations are durable.
    observations: u32,
    /// Its policy, once it is done.
    policy_id: Option<String>,
    /// When it was opened.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// When something last came.
    #[schema(value_type = String, format = DateTime)]
    active_at: Timestamp,
}

/// What has become of a session.
#[derive(Serialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(as = SessionStatus)]
#[expect(dead_code, reason = "what describes the names")]
enum SessionStatusName {
    Open,
    Done,
    Expired,
}

impl From<SessionRecord> for SessionBody {
    fn from(row: SessionRecord) -> Self {
        Self {
            id: row.id,
            model: row.model,
            model_hash: row.model_hash,
            weights: Some(row.weights),
            lookahead: row.lookahead,
            lookahead_ms: row.lookahead_ms,
            learner: row.learner,
            weights_version: row.weights_version,
            trial_id: row.trial_id,
            status: row.status.name(),
            observations: row.n_observations,
            policy_id: row.policy_id,
            created_at: row.created_at,
            active_at: row.active_at,
        }
    }
}

/// Which sessions are wanted: those that have all that is given.
#[derive(Clone, Debug, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct WhichSessions {
    /// Only those of the model with this name.
    model: Option<String>,
    /// Only those with this status: `open`, `done` or `expired`.
    #[param(value_type = Option<String>)]
    status: Option<SessionStatus>,
}

/// [`WhichSessions`] and [`Paging`] of the same query.
pub(super) struct SessionsQuery(WhichSessions, Paging);

impl<S: Send + Sync> FromRequestParts<S> for SessionsQuery {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let mut which = WhichSessions { model: None, status: None };
        let paging = Paging::read(parts, "limit, after, model, status", |name, value| match name {
            "model" => Some(name_in(value).map(|name| which.model = Some(name))),
            "status" => {
                Some(one_of(value, SessionStatus::ALL, SessionStatus::name).map(|status| which.status = Some(status)))
            }
            _ => None,
        })?;
        Ok(Self(which, paging))
    }
}

/// Sessions, oldest first.
#[utoipa::path(
    get, path = "/v1/sessions", tag = "streams",
    params(WhichSessions, Paging),
    responses(
        (status = 200, description = "A page of sessions", body = List<SessionBody>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_sessions(
    State(context): State<SharedContext>,
    SessionsQuery(WhichSessions { model, status }, paging): SessionsQuery,
) -> Result<Response, Problem> {
    let filter = SessionFilter { model, status };
    let page = context.etude.sessions(&filter, after_sequence(&paging)?, paging.limit).await?;
    Ok(json(StatusCode::OK, &List::of(page, SessionBody::from)))
}

/// A session.
#[utoipa::path(
    get, path = "/v1/sessions/{session}", tag = "streams",
    params(("session" = String, Path, description = "Its id")),
    responses(
        (status = 200, description = "The session", body = SessionBody),
        (status = 404, description = "`unknown-session`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn get_session(State(context): State<SharedContext>, PathId(id): PathId) -> Result<Response, Problem> {
    Ok(json(StatusCode::OK, &SessionBody::from(context.etude.session(&id).await?)))
}

/// Delete a session with its observations, running or not. Its policy and its trial stay.
///
/// A connection that drives it is closed with 1008 (`taken-over`).
#[utoipa::path(
    delete, path = "/v1/sessions/{session}", tag = "streams",
    params(("session" = String, Path, description = "Its id")),
    responses(
        (status = 204, description = "It is deleted"),
        (status = 404, description = "`unknown-session`", body = Problem, content_type = "application/problem+json"),
        DeletionProblems,
    ),
)]
pub(super) async fn delete_session(
    State(context): State<SharedContext>,
    PathId(id): PathId,
    _: NoForm,
) -> Result<StatusCode, Problem> {
    context.etude.delete_session(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

#[cfg(test)]
mod tests;
