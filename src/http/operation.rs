//! What operators and their machines ask for.

use std::sync::LazyLock;

use axum::Router;
use axum::extract::State;
use axum::http::header::CONTENT_TYPE;
use axum::response::{IntoResponse, Redirect};
use utoipa_swagger_ui::{Config, SwaggerUi};

use super::SharedContext;
use super::problem::{Problem, ProblemKind};
use crate::service::ServiceError;

/// Whether the process is alive.
#[utoipa::path(
    get, path = "/livez", tag = "operation",
    responses((status = 200, description = "It is", body = String, content_type = "text/plain")),
)]
pub(super) async fn livez() -> &'static str {
    "alive\n"
}

/// Whether requests should be sent here: something could be written to the database within the last second, and no shutdown has begun.
#[utoipa::path(
    get, path = "/readyz", tag = "operation",
    responses(
        (status = 200, description = "They should", body = String, content_type = "text/plain"),
        (status = 503, description = "`not-ready`: nothing can be written to the database, which is locked, read-only, gone, failing or too slow; `stopping`", body = Problem, content_type = "application/problem+json"),
        (status = 507, description = "`storage-full`: nothing can be written to the database, as its disk is full; what is there can be read", body = Problem, content_type = "application/problem+json"),
    ),
)]
pub(super) async fn readyz(State(context): State<SharedContext>) -> Result<&'static str, Problem> {
    if context.stopping.is_cancelled() {
        return Err(Problem::new(ProblemKind::Stopping, "the service is shutting down"));
    }
    context.etude.check().await.map_err(|error| {
        tracing::warn!(error = &error as &dyn std::error::Error, "not ready");
        match error {
            ServiceError::Unavailable(_) => error.into(),
            _ => Problem::new(ProblemKind::NotReady, "the database does not answer, or nothing can be written to it"),
        }
    })?;
    Ok("ready\n")
}

/// Measurements, in the text format of Prometheus.
#[utoipa::path(
    get, path = "/metrics", tag = "operation",
    responses((status = 200, description = "The measurements", body = String, content_type = "text/plain")),
)]
pub(super) async fn metrics(State(context): State<SharedContext>) -> impl IntoResponse {
    #[expect(clippy::cast_precision_loss, reason = "there are few jobs, and less memory than would matter")]
    {
        metrics::gauge!("etude_search_jobs").set(context.etude.pool().n_jobs() as f64);
        let memory = context.etude.memory();
        metrics::gauge!("etude_memory_held_bytes").set(memory.room().saturating_sub(memory.free()) as f64);
    }
    ([(CONTENT_TYPE, "text/plain; version=0.0.4")], context.metrics.render())
}

/// This description.
#[utoipa::path(
    get, path = "/openapi.yaml", tag = "operation",
    responses((status = 200, description = "OpenAPI 3.1", body = String, content_type = "application/yaml")),
)]
pub(super) async fn openapi_yaml() -> impl IntoResponse {
    static YAML: LazyLock<String> = LazyLock::new(super::openapi);
    ([(CONTENT_TYPE, "application/yaml")], YAML.as_str())
}

/// Whoever looks at the service with a browser is led to the page that describes it.
pub(super) async fn front() -> Redirect {
    Redirect::temporary("/docs/")
}

/// The description as a page to read and to try things in, from files that are part of the program.
pub(super) fn docs() -> Router<SharedContext> {
    // The validator would send the description to a service outside.
    let config = Config::from("/openapi.yaml").validator_url("none").try_it_out_enabled(true);
    SwaggerUi::new("/docs").config(config).into()
}
