//! `/v1/stream` and `/v1/sessions`: the stream protocol over websockets and NDJSON.

use std::convert::Infallible;
use std::pin::Pin;
use std::time::Duration;

use axum::body::{Body, BodyDataStream, Bytes};
use axum::extract::ws::{CloseFrame, Message, WebSocket, WebSocketUpgrade, rejection::WebSocketUpgradeRejection};
use axum::extract::{Request, State};
use axum::http::header::{CONTENT_TYPE, EXPECT};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{Peekable, SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use jiff::Timestamp;
use serde::Serialize;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_tungstenite::tungstenite;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;
use utoipa::ToSchema;

use super::SharedContext;
use super::body::{is_ndjson, json, refuse};
use super::connections::IsStream;
use super::encoding::Encoding;
use super::paging::{List, Paging, after_sequence};
use super::path::PathId;
use super::problem::{Problem, ProblemKind};
use crate::attribute::ByAttribute;
use crate::service::{Caller, Client};
use crate::store::{SessionRow, SessionWeights};
use crate::stream::{self, Closed, Incoming, Outgoing, PROTOCOL};

/// Frames that wait to be answered, and answers that wait to be read: enough to keep both ends busy.
const MAX_WAITING: usize = 64;

/// How much of a message over the limit is still taken in, as a multiple of the limit, so that it can be answered.
const MAX_OVERSIZE: usize = 4;

/// How much is read from a socket at once. Held by every stream, most of which wait for a small frame; a larger one is
/// read in several goes.
const READ_BUFFER_BYTES: usize = 8192;

/// How long a closing handshake may take.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Stream a demonstration over a websocket.
///
/// The subprotocol is `etude.v1+json`; see the description of the protocol in this document's introduction.
#[utoipa::path(
    get, path = "/v1/stream", tag = "streams",
    responses(
        (status = 101, description = "The websocket is open; the server speaks first"),
        (status = 426, description = "`upgrade-required`: not a websocket request", body = Problem, content_type = "application/problem+json"),
        (status = 503, description = "`busy`, `stopping`: see `Retry-After`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn websocket(
    State(context): State<SharedContext>,
    Caller { client, .. }: Caller,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Result<Response, Problem> {
    let upgrade = upgrade.map_err(|rejection| Problem::new(ProblemKind::UpgradeRequired, rejection.body_text()))?;
    let place = context.admit_stream()?;
    let limit = context.stream_limits.frame_bytes;
    let upgrade = upgrade
        .protocols([PROTOCOL])
        .max_message_size(limit * MAX_OVERSIZE)
        .max_frame_size(limit * MAX_OVERSIZE)
        // A limit would be one on the size of `done`. There is no need for it: once more waits there than is written at once,
        // the next frame is not taken from the queue until that has gone.
        .max_write_buffer_size(usize::MAX)
        .read_buffer_size(READ_BUFFER_BYTES);
    let span = tracing::Span::current();
    Ok(upgrade.on_upgrade(move |socket| {
        let streams = context.streams.clone();
        streams.track_future(serve_websocket(context, client, socket, place).instrument(span))
    }))
}

async fn serve_websocket(context: SharedContext, client: Client, socket: WebSocket, place: OwnedSemaphorePermit) {
    let (sink, source) = socket.split();
    let (came, mut incoming) = mpsc::channel(MAX_WAITING);
    let (outgoing, goes) = mpsc::channel(MAX_WAITING);
    // Gone: nobody is there any more. Ended: nothing more will come.
    let (gone, ended) = (CancellationToken::new(), CancellationToken::new());
    let speaking = async {
        let closed = tokio::select! {
            closed = stream::run(&context.etude, client, context.stream_limits, &mut incoming, &outgoing, &context.stopping) => closed,
            // A search that still runs ends with this.
            () = gone.cancelled() => Closed::ByClient,
        };
        incoming.close();
        // What is left to be written may take this long. Where the queue was full until now, this is the goodbye that a
        // slow reader gets; if there was one already, nobody takes another.
        let goodbye = tokio::time::timeout(CLOSE_TIMEOUT, outgoing.send(Outgoing::Close(closed)));
        if let Ok(Ok(())) = goodbye.await {
            drop(outgoing);
            tokio::time::sleep(CLOSE_TIMEOUT).await;
        }
    };
    let talking = async {
        tokio::select! {
            // In the order in which a frame passes, so that it passes in one go.
            biased;
            () = speaking => {}
            () = write_websocket(sink, goes) => {}
        }
        // The client's half of the closing handshake, for which a shutdown does not wait.
        tokio::select! {
            () = ended.cancelled() => {}
            () = context.stopping.cancelled() => {}
            () = tokio::time::sleep(CLOSE_TIMEOUT) => {}
        }
    };
    let listening = async {
        read_websocket(source, came, &gone).await;
        ended.cancel();
        std::future::pending::<()>().await;
    };
    tokio::select! {
        biased;
        () = listening => {}
        () = talking => {}
    }
    drop(place);
}

/// Passes on what comes, until nobody wants it; then reads on for the client's goodbye. Pings are answered by reading.
async fn read_websocket(mut source: SplitStream<WebSocket>, came: mpsc::Sender<Incoming>, gone: &CancellationToken) {
    loop {
        let incoming = match source.next().await {
            Some(Ok(Message::Text(text))) => Incoming::Frame(text.as_bytes().to_vec()),
            Some(Ok(Message::Binary(_))) => Incoming::Binary,
            Some(Ok(Message::Ping(_) | Message::Pong(_))) => continue,
            Some(Err(error)) => match error.into_inner().downcast_ref::<tungstenite::Error>() {
                Some(tungstenite::Error::Capacity(_)) => Incoming::TooLarge,
                Some(tungstenite::Error::Utf8(_)) => Incoming::NotText,
                _ => return gone.cancel(),
            },
            Some(Ok(Message::Close(_))) | None => return gone.cancel(),
        };
        let is_last = matches!(incoming, Incoming::TooLarge | Incoming::NotText);
        // Nobody wants it once the connection is closing.
        let _ = came.send(incoming).await;
        if is_last {
            return;
        }
    }
}

async fn write_websocket(mut sink: SplitSink<WebSocket, Message>, mut goes: mpsc::Receiver<Outgoing>) {
    let closed = write_frames(&mut sink, &mut goes).await;
    if let Some(closed) = closed {
        let (code, reason) = closed.code();
        let close = Message::Close(Some(CloseFrame { code, reason: reason.into() }));
        // A client that does not read does not hear this either.
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, sink.send(close)).await;
    }
}

/// Writes what goes to the client, until nothing more will. Gives how to close, if there is still something to be closed.
async fn write_frames(sink: &mut SplitSink<WebSocket, Message>, goes: &mut mpsc::Receiver<Outgoing>) -> Option<Closed> {
    while let Some(first) = goes.recv().await {
        // What waits together is written together: a write, and a wakeup of the client, cost more than a frame.
        let mut next = Some(first);
        while let Some(outgoing) = next {
            match outgoing {
                Outgoing::Frame(text) => {
                    if let Err(error) = sink.feed(Message::Text(text.into())).await {
                        tracing::debug!(error = &error as &dyn std::error::Error, "a frame could not be written");
                        // Where the client is gone, it does not hear this; a frame must not vanish without a word.
                        return Some(Closed::Failed);
                    }
                }
                Outgoing::Close(closed) => return Some(closed),
            }
            next = goes.try_recv().ok();
        }
        sink.flush().await.ok()?;
    }
    None
}

/// Stream a demonstration as NDJSON, both ways at the same time.
///
/// The same frames as over the websocket, one per line. The answer begins at once and ends when the session is done or
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
    let place = context.admit_stream()?;
    let (came, mut incoming) = mpsc::channel(MAX_WAITING);
    let (outgoing, goes) = mpsc::channel(MAX_WAITING);
    let (lines, answer) = mpsc::channel::<Result<Bytes, Infallible>>(1);
    let frame_bytes = context.stream_limits.frame_bytes;
    let body = begin_reading(request).await;
    let streams = context.streams.clone();
    let serving = async move {
        let speaking = async {
            tokio::select! {
                _ = stream::run(&context.etude, client, context.stream_limits, &mut incoming, &outgoing, &context.stopping) => {}
                // The client does not read any more: it is gone.
                () = lines.closed() => {}
            }
            drop(outgoing);
            tokio::time::sleep(CLOSE_TIMEOUT).await;
        };
        let listening = async {
            read_lines(body, frame_bytes, came).await;
            std::future::pending::<()>().await;
        };
        tokio::select! {
            () = write_lines(&lines, goes) => {}
            () = speaking => {}
            () = listening => {}
        }
        drop(place);
    };
    // The answer is read while the request is still being sent, so this runs beside it.
    streams.spawn(serving.instrument(tracing::Span::current()));
    let mut response = Body::from_stream(tokio_stream::wrappers::ReceiverStream::new(answer)).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/x-ndjson"));
    response.extensions_mut().insert(IsStream);
    Ok(response)
}

/// The body of a request. A client that waits to be told to send it (`Expect: 100-continue`, as `curl` does for a second) is told
/// so when the body is first asked for, which must be before the answer begins.
async fn begin_reading(request: Request) -> Peekable<BodyDataStream> {
    let waits = request.headers().contains_key(EXPECT);
    let mut body = request.into_body().into_data_stream().peekable();
    if waits {
        let _asked = futures_util::poll!(Pin::new(&mut body).peek());
        tokio::task::yield_now().await;
    }
    body
}

/// Passes on lines as frames. Ends with the body, or with a line over the limit.
async fn read_lines(mut body: Peekable<BodyDataStream>, frame_bytes: usize, came: mpsc::Sender<Incoming>) {
    let mut line = Vec::new();
    while let Some(Ok(chunk)) = body.next().await {
        for part in chunk.split_inclusive(|byte| *byte == b'\n') {
            line.extend_from_slice(part);
            if line.len() > frame_bytes + 1 {
                let _ = came.send(Incoming::TooLarge).await;
                return;
            }
            if line.ends_with(b"\n") && !pass_on(&mut line, &came).await {
                return;
            }
        }
    }
    pass_on(&mut line, &came).await;
}

/// Passes on a line, unless it is blank. Says whether anybody listens.
async fn pass_on(line: &mut Vec<u8>, came: &mpsc::Sender<Incoming>) -> bool {
    let line = std::mem::take(line);
    if line.trim_ascii().is_empty() {
        return true;
    }
    came.send(Incoming::Frame(line)).await.is_ok()
}

async fn write_lines(lines: &mpsc::Sender<Result<Bytes, Infallible>>, mut goes: mpsc::Receiver<Outgoing>) {
    while let Some(outgoing) = goes.recv().await {
        match outgoing {
            Outgoing::Frame(mut text) => {
                text.push('\n');
                if lines.send(Ok(text.into())).await.is_err() {
                    return;
                }
            }
            Outgoing::Close(_) => return,
        }
    }
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
    /// The learner whose weights are used, if any.
    learner: Option<String>,
    /// The version of the learner's weights.
    weights_version: Option<u64>,
    /// The trial that it explores, if any.
    trial_id: Option<String>,
    /// `open`, `done` or `expired`.
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

impl From<SessionRow> for SessionBody {
    fn from(row: SessionRow) -> Self {
        Self {
            id: row.id,
            model: row.model,
            model_hash: row.model_hash,
            weights: match row.weights {
                SessionWeights::Named(weights) => Some(weights),
                SessionWeights::InOrder(_) => None,
            },
            lookahead: row.lookahead,
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

/// Sessions, oldest first.
#[utoipa::path(
    get, path = "/v1/sessions", tag = "streams",
    params(Paging),
    responses(
        (status = 200, description = "A page of sessions", body = List<SessionBody>),
        (status = 422, description = "`invalid`", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn list_sessions(State(context): State<SharedContext>, paging: Paging) -> Result<Response, Problem> {
    let page = context.etude.sessions(after_sequence(&paging)?, paging.limit).await?;
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
