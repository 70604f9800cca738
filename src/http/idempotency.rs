//! Requests that a client may repeat.

use axum::extract::FromRequestParts;
use axum::http::request::Parts;

use super::problem::Problem;
use crate::service::IdempotencyKey;
use etude_core::document::Faults;

/// The header with which a client makes sure that a request is done once.
const IDEMPOTENCY_KEY: &str = "idempotency-key";

/// The key of a request, if it has one.
pub(super) struct Key(pub(super) Option<IdempotencyKey>);

impl<S: Send + Sync> FromRequestParts<S> for Key {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        let mut keys = parts.headers.get_all(IDEMPOTENCY_KEY).iter();
        let key = match (keys.next(), keys.next()) {
            (None, _) => return Ok(Self(None)),
            (Some(key), None) => IdempotencyKey::new(key.as_bytes()).map_err(|invalid| invalid.to_string()),
            (Some(_), Some(_)) => Err("expected one key".to_owned()),
        };
        let invalid = |detail| Faults::one("", format!("{detail} in the header `Idempotency-Key`"));
        Ok(Self(Some(key.map_err(invalid)?)))
    }
}
