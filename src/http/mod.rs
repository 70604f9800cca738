//! The HTTP contract: routes, bodies, and the only place with status codes.
//!
//! ```text
//! connection -> observe (request id, access, log, metrics, panics) -> route -> handler -> Etude
//!                    ^                                                    |
//!                    +---- Problem (RFC 9457), rendered with its id <-----+
//! ```
//!
//! The OpenAPI description is generated from the handlers of this module; [`openapi`] gives it without a running service.

mod access;
mod answer;
mod body;
mod caller;
mod collected;
mod connections;
mod description;
mod encoding;
mod examples;
mod experience;
mod form;
mod idempotency;
mod learners;
mod models;
mod observe;
mod operation;
mod paging;
mod path;
mod places;
mod policies;
mod problem;
mod reports;
mod request_id;
mod requests;
mod rounds;
mod stalled;
mod stream;
mod tags;
mod trials;

use std::sync::Arc;

use axum::Router;
use axum::middleware;
use axum::routing::get;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use utoipa::OpenApi;
use utoipa::openapi::Tag;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::client::Client;
use crate::service::Etude;
use crate::stream::frames::ServerFrame;
use crate::stream::{Limits, Room, Rooms};
pub use access::Access;
pub(crate) use access::{allowed_host, allowed_origin};
pub use connections::{ConnectionLimits, serve};
use problem::{Problem, ProblemKind};
pub use rounds::Rounds;

/// What handlers work with.
pub struct Context {
    /// The application.
    pub etude: Arc<Etude>,
    /// Who is let in.
    pub access: Access,
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
    /// Room for them.
    pub stream_rooms: Rooms,
    /// The streams that run.
    pub streams: TaskTracker,
    /// In which connections and streams are served.
    pub rounds: Rounds,
    /// Whatever else runs.
    pub tasks: TaskTracker,
}

/// The context, which handlers are given each their own of: one count, not one for each part.
type SharedContext = Arc<Context>;

impl Context {
    /// Room for one more stream of `client`.
    fn admit_stream(&self, client: Client) -> Result<Room, Problem> {
        if self.stopping.is_cancelled() {
            return Err(Problem::new(ProblemKind::Stopping, "the service is shutting down"));
        }
        self.stream_rooms.admit(client).map_err(|error| Problem::new(ProblemKind::Busy, error.to_string()))
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
        (name = "learners", description = "Which attributes matter, learned from rewards"),
        (name = "trials", description = "Weights drawn from a learner, the policy that they gave, and the reward that it earned"),
        (name = "streams", description = "Policy steps while the demonstration is still running"),
        (name = "deletion", description = "Names that are given up: after everything else, so that what is above can be tried in order"),
        (name = "operation", description = "Health and measurements"),
    ),
    components(schemas(Problem, stream::ClientFrameDocument, ServerFrame)),
)]
struct Description;

fn routes() -> OpenApiRouter<SharedContext> {
    let mut description = Description::openapi();
    // Taken from Cargo.toml, which names none.
    description.info.license = None;
    let protocol = Tag::builder().name("stream protocol").description(Some(include_str!("../stream/protocol.md")));
    description.tags.get_or_insert_default().push(protocol.build());
    OpenApiRouter::with_openapi(description)
        .routes(routes!(models::put_model, models::get_model, models::delete_model))
        .routes(routes!(experience::add_experience))
        .routes(routes!(reports::make_report, reports::get_report))
        .routes(routes!(models::list_models))
        .routes(routes!(policies::make_policy, policies::list_policies))
        .routes(routes!(policies::make_policies))
        .routes(routes!(policies::get_policy, policies::delete_policy))
        .routes(routes!(learners::put_learner, learners::get_learner, learners::delete_learner))
        .routes(routes!(learners::list_learners))
        .routes(routes!(learners::get_weights))
        .routes(routes!(learners::list_weights))
        .routes(routes!(learners::learn))
        .routes(routes!(trials::make_trial, trials::list_trials))
        .routes(routes!(trials::put_reward))
        .routes(routes!(trials::fail_trial))
        .routes(routes!(trials::get_trial, trials::delete_trial))
        .routes(routes!(stream::websocket, stream::ndjson))
        .routes(routes!(stream::list_sessions))
        .routes(routes!(stream::get_session, stream::delete_session))
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
    description::published(routes().into_openapi())
}

/// The whole service as a router.
pub fn router(context: Context) -> Router {
    let (router, _) = routes().split_for_parts();
    let context = Arc::new(context);
    let mut router = router
        .merge(operation::docs())
        .route("/", get(operation::front))
        .fallback(|| async { Problem::new(ProblemKind::NotFound, "there is nothing at this path") })
        .method_not_allowed_fallback(|| async {
            Problem::new(
                ProblemKind::MethodNotAllowed,
                "this path does not support this method; `Allow` lists those it does",
            )
        });
    if let Some(cors) = context.access.cors() {
        router = router.layer(cors);
    }
    router.layer(middleware::from_fn_with_state(Arc::clone(&context), observe::observe)).with_state(context)
}
