//! What names a request, in answers, problems and the log.

use std::sync::Arc;

use axum::http::{HeaderMap, HeaderName};
use uuid::Uuid;

use crate::clock::Ids;

/// The header that carries it, in both directions.
pub(super) const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

/// Longest request id that is taken from a client.
const MAX_REQUEST_ID_BYTES: usize = 64;

/// The id of the request, for handlers.
#[derive(Clone, Debug)]
pub(super) struct RequestId(pub(super) Arc<str>);

/// Takes the client's id if it is short and plain, else makes one.
pub(super) fn request_id(headers: &HeaderMap, ids: &Ids) -> Arc<str> {
    let is_plain = |id: &&str| {
        (1..=MAX_REQUEST_ID_BYTES).contains(&id.len())
            && id.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"._-".contains(&byte))
    };
    let given = headers.get(REQUEST_ID).and_then(|id| id.to_str().ok()).filter(is_plain);
    match given {
        Some(given) => given.into(),
        None => Arc::from(&*ids.next().hyphenated().encode_lower(&mut Uuid::encode_buffer())),
    }
}
