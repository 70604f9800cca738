//! Reading bodies and writing JSON.

use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::Request;
use axum::http::header::{CONTENT_LENGTH, CONTENT_TYPE, EXPECT};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::StreamExt;
use serde::Serialize;

use super::problem::{Problem, ProblemKind};

/// How long a client may take to send its body.
const BODY_TIMEOUT: Duration = Duration::from_mins(1);

/// How much of a body that is too large is read and thrown away, as a multiple of the limit. Most clients only look at the
/// answer once they have sent everything; past this, they find the connection closed.
const MAX_DISCARDED_LIMITS: usize = 64;

/// Reads the JSON body of a request, of at most `limit` bytes.
pub(super) async fn read_json(request: Request, limit: usize) -> Result<Bytes, Problem> {
    let is_json = is_json(request.headers());
    let announced =
        request.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    let expects_leave = request.headers().contains_key(EXPECT);
    let body = request.into_body();
    let read = async {
        if announced.is_some_and(|length| length > limit) {
            // Whoever asks for leave to send gets the answer instead.
            if !expects_leave {
                discard(body, limit).await;
            }
            return Err(too_large(limit));
        }
        let bytes = read(body, limit).await?;
        if is_json {
            Ok(bytes)
        } else {
            let detail = "send JSON with the header `content-type: application/json`";
            Err(Problem::new(ProblemKind::UnsupportedMediaType, detail))
        }
    };
    let slow = |_| Problem::new(ProblemKind::SlowBody, format!("the body took over {} s", BODY_TIMEOUT.as_secs()));
    tokio::time::timeout(BODY_TIMEOUT, read).await.map_err(slow)?
}

/// Whether the body is declared as `application/json`, or as another type that is written in JSON.
fn is_json(headers: &HeaderMap) -> bool {
    let declared = headers.get(CONTENT_TYPE).and_then(|declared| declared.to_str().ok()).unwrap_or_default();
    let essence = declared.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    let subtype = essence.strip_prefix("application/");
    subtype.is_some_and(|subtype| subtype == "json" || subtype.ends_with("+json"))
}

async fn read(body: Body, limit: usize) -> Result<Bytes, Problem> {
    let mut stream = body.into_data_stream();
    let mut bytes = Vec::new();
    while let Some(chunk) = stream.next().await {
        let chunk =
            chunk.map_err(|_| Problem::new(ProblemKind::IncompleteBody, "the connection ended within the body"))?;
        if bytes.len() + chunk.len() > limit {
            discard(Body::from_stream(stream), limit).await;
            return Err(too_large(limit));
        }
        bytes.extend_from_slice(&chunk);
    }
    Ok(bytes.into())
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

fn too_large(limit: usize) -> Problem {
    let detail = format!("the body has over {limit} bytes, the limit of this service (ETUDE_MAX_BODY_BYTES)");
    Problem::new(ProblemKind::TooLarge, detail)
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
