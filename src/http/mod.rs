//! The HTTP contract: routes, bodies, and the only place with status codes.
//!
//! ```text
//! connection -> observe (request id, log, metrics, panics) -> route -> handler -> Etude
//!                    ^                                                    |
//!                    +---- Problem (RFC 9457), rendered with its id <-----+
//! ```
//!
//! The OpenAPI description is generated from the handlers of this module; [`openapi`] gives it without a running service.

mod body;
mod caller;
mod connections;
mod encoding;
mod learners;
mod models;
mod observe;
mod operation;
mod paging;
mod path;
mod policies;
mod problem;
mod stream;
mod trials;

use std::sync::Arc;

use axum::Router;
use axum::middleware;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use utoipa::OpenApi;
use utoipa::openapi::{Content, Ref, ResponseBuilder};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::service::Etude;
use crate::stream::Limits;
pub use connections::serve;
use problem::{Problem, ProblemKind};

/// What handlers work with.
pub struct Context {
    /// The application.
    pub etude: Arc<Etude>,
    /// Cancelled when the service starts to shut down: no longer ready.
    pub stopping: CancellationToken,
    /// Largest body that is read, in bytes.
    pub max_body_bytes: usize,
    /// Largest model that is read, in bytes as it is sent. If it is left out, as for other bodies.
    pub max_model_bytes: Option<usize>,
    /// Largest model that is read, in bytes once it is decompressed.
    pub max_model_text_bytes: u64,
    /// Renders what was measured.
    pub metrics: PrometheusHandle,
    /// What a stream may use.
    pub stream_limits: Limits,
    /// One for each stream that may run.
    pub stream_places: Arc<Semaphore>,
    /// The streams that run.
    pub streams: TaskTracker,
    /// Whatever else runs.
    pub tasks: TaskTracker,
}

/// The context, which handlers are given each their own of: one count, not one for each part.
type SharedContext = Arc<Context>;

impl Context {
    /// A place for one more stream, until it is dropped.
    fn admit_stream(&self) -> Result<OwnedSemaphorePermit, Problem> {
        if self.stopping.is_cancelled() {
            return Err(Problem::new(ProblemKind::Stopping, "the service is shutting down"));
        }
        let place = Arc::clone(&self.stream_places).try_acquire_owned();
        place.map_err(|_| Problem::new(ProblemKind::Busy, "as many streams run as may"))
    }
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "etude",
        description = "A service by which an agent learns a task by watching it done: it finds the policy, in the agent's own \
                       actions, whose effects follow a demonstration most closely.\n\nEvery error is a problem document \
                       (RFC 9457) whose `type` is listed under its status; for 422 it lists all faults of the body, each \
                       with its JSON pointer. Every body but that of a stream may be compressed (`Content-Encoding: gzip` or `zstd`). Every answer carries an `x-request-id`, taken from the request if that has \
                       one.\n\nLists are read in pages: `limit` items, then `after` the `next` of the page before.",
    ),
    tags(
        (name = "models", description = "What a body can do in its world"),
        (name = "policies", description = "Demonstration in, policy out"),
        (name = "streams", description = "Policy steps while the demonstration is still running"),
        (name = "learners", description = "Which attributes matter, learned from rewards"),
        (name = "trials", description = "Weights drawn from a learner, the policy that they gave, and the reward that it earned"),
        (name = "operation", description = "Health and measurements"),
    ),
    components(schemas(Problem)),
)]
struct Description;

fn routes() -> OpenApiRouter<SharedContext> {
    let mut description = Description::openapi();
    // Taken from Cargo.toml, which names none.
    description.info.license = None;
    let protocol = include_str!("../stream/protocol.md");
    description.info.description = description.info.description.map(|text| format!("{text}\n\n{protocol}"));
    OpenApiRouter::with_openapi(description)
        .routes(routes!(models::put_model, models::get_model, models::delete_model))
        .routes(routes!(models::list_models))
        .routes(routes!(policies::make_policy, policies::list_policies))
        .routes(routes!(policies::get_policy))
        .routes(routes!(policies::make_policies))
        .routes(routes!(stream::websocket, stream::ndjson))
        .routes(routes!(stream::list_sessions))
        .routes(routes!(stream::get_session))
        .routes(routes!(learners::put_learner, learners::get_learner, learners::delete_learner))
        .routes(routes!(learners::list_learners))
        .routes(routes!(learners::get_weights))
        .routes(routes!(learners::list_weights))
        .routes(routes!(learners::learn))
        .routes(routes!(trials::make_trial, trials::list_trials))
        .routes(routes!(trials::get_trial))
        .routes(routes!(trials::put_reward))
        .routes(routes!(trials::fail_trial))
        .routes(routes!(operation::livez))
        .routes(routes!(operation::readyz))
        .routes(routes!(operation::metrics))
        .routes(routes!(operation::openapi_yaml))
}

/// The OpenAPI 3.1 description of the service, as YAML.
///
/// # Panics
///
/// Never: every description can be written as YAML.
#[must_use]
pub fn openapi() -> String {
    let mut description = routes().into_openapi();
    // Not the handlers' to name, as any of them may meet a defect or a failing disk.
    let internal = ResponseBuilder::new()
        .description("`internal`: what went wrong was logged under the request's id")
        .content("application/problem+json", Content::new(Some(Ref::from_schema_name("Problem"))))
        .build();
    // Nor this one, which any write may meet.
    let full = ResponseBuilder::new()
        .description("`storage-full`: no room is left for the database; what is there can be read")
        .content("application/problem+json", Content::new(Some(Ref::from_schema_name("Problem"))))
        .build();
    let paths = description.paths.paths.iter_mut().filter(|(path, _)| path.starts_with("/v1/"));
    for (_, path) in paths {
        for operation in [&mut path.get, &mut path.put, &mut path.post, &mut path.delete].into_iter().flatten() {
            operation.responses.responses.insert("500".to_owned(), internal.clone().into());
        }
        for operation in [&mut path.put, &mut path.post, &mut path.delete].into_iter().flatten() {
            operation.responses.responses.insert("507".to_owned(), full.clone().into());
        }
    }
    description.to_yaml().expect("every description can be written as YAML")
}

/// The whole service as a router.
pub fn router(context: Context) -> Router {
    let (router, _) = routes().split_for_parts();
    router
        .merge(operation::docs())
        .fallback(|| async { Problem::new(ProblemKind::NotFound, "there is nothing at this path") })
        .method_not_allowed_fallback(|| async {
            Problem::new(
                ProblemKind::MethodNotAllowed,
                "this path does not support this method; `Allow` lists those it does",
            )
        })
        .layer(middleware::from_fn(observe::observe))
        .with_state(Arc::new(context))
}
