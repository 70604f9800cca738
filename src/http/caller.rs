//! Who sent a request.

use std::convert::Infallible;
use std::time::Instant;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use jiff::Timestamp;

use crate::service::{Caller, Client};

/// The client is known by its connection, which notes it with each request.
impl<S: Send + Sync> FromRequestParts<S> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        let client = parts.extensions.get::<Client>().copied().unwrap_or(Client::LOCAL);
        Ok(Self { client, arrived: Instant::now(), now: Timestamp::now() })
    }
}
