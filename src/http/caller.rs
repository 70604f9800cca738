//! Who sent a request.

use std::convert::Infallible;

use super::SharedContext;
use crate::client::Client;
use crate::service::Caller;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;

/// The client is known by its connection, which notes it with each request.
impl FromRequestParts<SharedContext> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, context: &SharedContext) -> Result<Self, Infallible> {
        let client = parts.extensions.get::<Client>().copied().unwrap_or(Client::LOCAL);
        let clock = context.etude.clock();
        Ok(Self { client, arrived: clock.instant(), now: clock.now() })
    }
}
