//! Reading bodies and writing JSON.

use std::io::{self, BufRead, Read};
use std::time::{Duration, Instant};

use axum::body::{Body, BodyDataStream, Bytes, HttpBody};
use axum::extract::Request;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, EXPECT};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::{Stream, StreamExt, TryStreamExt};
use serde::Serialize;

use super::Context;
use super::encoding::{BodyError, DecodedLimit, Encoding};
use super::problem::{Problem, ProblemKind};
use crate::document::Quoted;
use crate::model::Format;
use crate::service::{ModelText, OpenText, PipeWriter, ServiceError, pipe};

/// How long a client may take to send its body.
const BODY_TIMEOUT: Duration = Duration::from_mins(1);

/// How much of a body that is too large is read and thrown away, as a multiple of the limit. Most clients only look at the
/// answer once they have sent everything; past this, they find the connection closed.
const MAX_DISCARDED_LIMITS: usize = 64;

/// Slowest that the body of a large model may come, beyond [`BODY_TIMEOUT`]: it keeps others from sending theirs.
const MIN_BYTES_PER_S: u64 = 64 * 1024;

/// Of the body of a model, how much is waited for before reading begins: one that is not larger is at hand then.
const AT_HAND_BYTES: usize = 1 << 20;

/// Largest body of a reward or of a reason.
const MAX_SMALL_BODY_BYTES: usize = 16 * 1024;

/// Reads the JSON body of a request, which has its limit as it is sent and once it is decompressed.
pub(super) async fn read_json(request: Request, context: &Context) -> Result<Bytes, Problem> {
    let limit = SentLimit { n_bytes: context.max_body_bytes, setting: "ETUDE_MAX_BODY_BYTES" };
    read_json_within(limit, request, context).await
}

/// Reads the JSON body of a request that has only little to say.
pub(super) async fn read_small_json(request: Request, context: &Context) -> Result<Bytes, Problem> {
    if context.max_body_bytes < MAX_SMALL_BODY_BYTES {
        return read_json(request, context).await;
    }
    let limit = SentLimit { n_bytes: MAX_SMALL_BODY_BYTES, setting: "for this path, whatever the settings" };
    read_json_within(limit, request, context).await
}

async fn read_json_within(limit: SentLimit, request: Request, context: &Context) -> Result<Bytes, Problem> {
    let is_json = format_of(request.headers()) == Some(Format::Json);
    let encoding = Encoding::declared(request.headers());
    let read = async {
        let body = open(request, limit).await?;
        let (bytes, _) = collect(body, limit, usize::MAX).await?;
        if is_json {
            Ok((bytes, encoding.map_err(|encoding| unsupported_encoding(&encoding))?))
        } else {
            let detail = "send JSON with the header `content-type: application/json`";
            Err(Problem::new(ProblemKind::UnsupportedMediaType, detail))
        }
    };
    let (bytes, encoding) = tokio::time::timeout(BODY_TIMEOUT, read).await.map_err(|_| slow())??;
    if encoding == Encoding::Identity {
        return Ok(bytes);
    }
    // Off the threads that serve others; bounded by the limit.
    let decode = move || -> io::Result<Vec<u8>> {
        let limit = DecodedLimit { n_bytes: limit.n_bytes as u64, setting: limit.setting };
        let mut decoded = Vec::new();
        encoding.decode(io::Cursor::new(bytes), limit)?.read_to_end(&mut decoded)?;
        Ok(decoded)
    };
    let decoded = context.tasks.spawn_blocking(decode).await.map_err(io::Error::other).flatten();
    decoded.map(Bytes::from).map_err(|error| unreadable(&error))
}

/// Most bytes of a body as it is sent, and what the setting is called.
#[derive(Clone, Copy, Debug)]
pub(super) struct SentLimit {
    pub(super) n_bytes: usize,
    pub(super) setting: &'static str,
}

/// The body of a model.
pub(super) struct SentModel {
    pub(super) text: ModelText,
    pub(super) format: Format,
    /// What is still to come of it.
    pub(super) pump: Option<Pump>,
}

/// Reads the body of a model: JSON or NDJSON, compressed or not. A large one is read as it comes.
pub(super) async fn read_model(request: Request, sent: SentLimit, decoded: DecodedLimit) -> Result<SentModel, Problem> {
    let format = format_of(request.headers());
    let encoding = Encoding::declared(request.headers());
    let first = async {
        let body = open(request, sent).await?;
        collect(body, sent, AT_HAND_BYTES).await
    };
    let (bytes, rest) = tokio::time::timeout(BODY_TIMEOUT, first).await.map_err(|_| slow())??;
    let declared = match (format, encoding) {
        (Some(format), Ok(encoding)) => Ok((format, encoding)),
        (None, _) => {
            let detail = "send JSON with the header `content-type: application/json`, or `application/x-ndjson`";
            Err(Problem::new(ProblemKind::UnsupportedMediaType, detail))
        }
        (_, Err(encoding)) => Err(unsupported_encoding(&encoding)),
    };
    let (format, encoding) = match declared {
        Ok(declared) => declared,
        Err(problem) => {
            if let Some(rest) = rest {
                discard(Body::from_stream(rest), sent.n_bytes).await;
            }
            return Err(problem);
        }
    };
    let open = |body: Box<dyn BufRead + Send>| -> OpenText { Box::new(move || encoding.decode(body, decoded)) };
    let (text, pump) = match rest {
        None if encoding == Encoding::Identity => (ModelText::Whole(bytes.into()), None),
        None => (ModelText::Packed(open(Box::new(io::Cursor::new(bytes)))), None),
        Some(rest) => {
            let (to_reader, reader) = pipe();
            let pump = Pump { first: bytes, rest, limit: sent, to_reader };
            (ModelText::Arriving(open(Box::new(reader))), Some(pump))
        }
    };
    Ok(SentModel { text, format, pump })
}

/// Carries the rest of a body to its reader.
pub(super) struct Pump {
    first: Bytes,
    rest: BodyDataStream,
    limit: SentLimit,
    to_reader: PipeWriter<Bytes>,
}

impl Pump {
    /// Ends when all was read, or the reader wants no more and the rest was thrown away.
    pub(super) async fn run(self) {
        let Self { first, mut rest, limit, to_reader } = self;
        let mut n_sent = first.len();
        let mut waited = Duration::ZERO;
        let mut wants_more = to_reader.send(Ok(first)).await;
        while wants_more {
            let allowed = BODY_TIMEOUT + Duration::from_secs(n_sent as u64 / MIN_BYTES_PER_S);
            // Only the client's time counts, not the reader's.
            let asked = Instant::now();
            let next = tokio::time::timeout(allowed.saturating_sub(waited), rest.next()).await;
            waited += asked.elapsed();
            let chunk = match next {
                Ok(None) => return to_reader.end().await,
                Ok(Some(Ok(chunk))) if n_sent + chunk.len() <= limit.n_bytes => Ok(chunk),
                Ok(Some(Ok(_))) => Err(BodyError::TooLarge(too_large_detail(limit))),
                Ok(Some(Err(_))) => Err(BodyError::Incomplete),
                Err(_) => Err(BodyError::Slow(format!("the body came slower than {MIN_BYTES_PER_S} bytes/s"))),
            };
            n_sent += chunk.as_ref().map_or(0, Bytes::len);
            wants_more = chunk.is_ok() & to_reader.send(chunk.map_err(io::Error::from)).await;
        }
        drop(to_reader);
        discard(Body::from_stream(rest), limit.n_bytes).await;
    }
}

/// The problem of a body that could not be read to its end.
pub(super) fn unreadable(error: &io::Error) -> Problem {
    let kind = match error.get_ref().and_then(|inner| inner.downcast_ref::<BodyError>()) {
        Some(BodyError::Incomplete) => ProblemKind::IncompleteBody,
        Some(BodyError::TooLarge(_)) => ProblemKind::TooLarge,
        Some(BodyError::Slow(_)) => ProblemKind::SlowBody,
        None => ProblemKind::BrokenEncoding,
    };
    Problem::new(kind, error.to_string())
}

fn unsupported_encoding(encoding: &str) -> Problem {
    let detail = format!("the body is encoded as {}; send it as it is, or as gzip or zstd", Quoted(encoding));
    Problem::new(ProblemKind::UnsupportedEncoding, detail)
}

fn slow() -> Problem {
    Problem::new(ProblemKind::SlowBody, format!("the body took over {} s", BODY_TIMEOUT.as_secs()))
}

/// The body, if it is not announced as too large.
async fn open(request: Request, limit: SentLimit) -> Result<BodyDataStream, Problem> {
    let announced =
        request.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    let expects_leave = request.headers().contains_key(EXPECT);
    let body = request.into_body();
    if announced.is_some_and(|length| length > limit.n_bytes) {
        // Whoever asks for leave to send gets the answer instead.
        if !expects_leave {
            discard(body, limit.n_bytes).await;
        }
        return Err(too_large(limit));
    }
    Ok(body.into_data_stream())
}

/// How the body is declared: as `application/json`, as another type that is written in JSON, or as NDJSON.
fn format_of(headers: &HeaderMap) -> Option<Format> {
    let declared = headers.get(CONTENT_TYPE).and_then(|declared| declared.to_str().ok()).unwrap_or_default();
    let essence = declared.split(';').next().unwrap_or_default().trim();
    // As most declare it.
    if essence == "application/json" {
        return Some(Format::Json);
    }
    let essence = essence.to_ascii_lowercase();
    match essence.strip_prefix("application/")? {
        "json" => Some(Format::Json),
        "x-ndjson" | "ndjson" => Some(Format::Ndjson),
        subtype => subtype.ends_with("+json").then_some(Format::Json),
    }
}

/// Reads at most `limit`, until there are over `n_wanted` bytes; what is not read yet is given back.
async fn collect(
    mut stream: BodyDataStream,
    limit: SentLimit,
    n_wanted: usize,
) -> Result<(Bytes, Option<BodyDataStream>), Problem> {
    // Most bodies come in one piece, which is not copied.
    let (mut first, mut bytes) = (Bytes::new(), Vec::new());
    while let Some(chunk) = stream.next().await {
        let chunk =
            chunk.map_err(|_| Problem::new(ProblemKind::IncompleteBody, "the connection ended within the body"))?;
        if first.len().max(bytes.len()) + chunk.len() > limit.n_bytes {
            discard(Body::from_stream(stream), limit.n_bytes).await;
            return Err(too_large(limit));
        }
        if first.is_empty() {
            first = chunk;
        } else {
            if bytes.is_empty() {
                // What was announced is within the limit.
                let n_left = usize::try_from(HttpBody::size_hint(&stream).lower()).unwrap_or(0);
                bytes.reserve_exact(first.len() + chunk.len() + n_left.min(n_wanted));
                bytes.extend_from_slice(&first);
            }
            bytes.extend_from_slice(&chunk);
        }
        if first.len().max(bytes.len()) > n_wanted {
            return Ok((whole(first, bytes), Some(stream)));
        }
    }
    Ok((whole(first, bytes), None))
}

/// All that there is in several pieces, of which the first is alone unless there are `bytes`.
fn whole(first: Bytes, bytes: Vec<u8>) -> Bytes {
    if bytes.is_empty() { first } else { bytes.into() }
}

async fn discard(body: Body, limit: usize) {
    let mut stream = body.into_data_stream();
    let mut n_left = limit.saturating_mul(MAX_DISCARDED_LIMITS);
    while let Some(Ok(chunk)) = stream.next().await {
        match n_left.checked_sub(chunk.len()) {
            Some(left) => n_left = left,
            None => return,
        }
    }
}

fn too_large(limit: SentLimit) -> Problem {
    Problem::new(ProblemKind::TooLarge, too_large_detail(limit))
}

fn too_large_detail(limit: SentLimit) -> String {
    format!("the body has over {} bytes, the limit of this service ({})", limit.n_bytes, limit.setting)
}

/// A JSON answer.
pub(super) fn json(status: StatusCode, answer: &impl Serialize) -> Response {
    match serde_json::to_string(answer) {
        Ok(text) => json_text(status, text),
        Err(error) => Problem::from(crate::service::ServiceError::Write(error)).into_response(),
    }
}

/// An answer that is JSON already.
pub(super) fn json_text(status: StatusCode, text: String) -> Response {
    let mut response = (status, text).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    response
}

/// An answer whose JSON comes in parts.
pub(super) fn json_stream(parts: impl Stream<Item = Result<Vec<u8>, ServiceError>> + Send + 'static) -> Response {
    // Too late for another answer: the connection is closed in the middle, which no client takes for the end.
    let parts = parts.inspect_err(|error| {
        tracing::error!(error = error as &dyn std::error::Error, "an answer was cut off");
    });
    let mut response = Body::from_stream(parts).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    response
}
