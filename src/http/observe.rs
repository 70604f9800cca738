//! What happens around every request: its id, its log line, its measurements, its problem document.

use std::any::Any;
use std::cell::RefCell;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{MatchedPath, Request, State};
use axum::http::header::ALLOW;
use axum::http::{HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use futures_util::FutureExt;
use metrics::{Counter, Histogram, SharedString};
use rustc_hash::FxHashMap;
use tracing::{Instrument, Span};

use super::SharedContext;
use super::access::is_for_cors;
use super::answer;
use super::body::refuse;
use super::problem::{Problem, ProblemKind};
use super::request_id::{REQUEST_ID, RequestId, request_id};
use crate::clock::Clock;

/// Gives the request an id, lets it in or not, logs and measures it, turns panics into problems and problems into documents.
pub(super) async fn observe(State(context): State<SharedContext>, mut request: Request, next: Next) -> Response {
    let id = request_id(request.headers(), context.etude.ids());
    request.extensions_mut().insert(RequestId(Arc::clone(&id)));
    let route: Arc<str> = request.extensions().get::<MatchedPath>().map_or("(none)", MatchedPath::as_str).into();
    let is_probe = matches!(&*route, "/livez" | "/readyz" | "/metrics");
    let method = request.method().clone();
    let span = tracing::info_span!("request", request_id = %id, %method, path = request.uri().path());
    let clock = context.etude.clock().clone();
    let mut unanswered = Unanswered { span: span.clone(), started: clock.instant(), clock, is_answered: false };

    let let_in = context.access.check(&method, request.uri(), request.headers());
    let answering = async {
        match let_in {
            Ok(()) => next.run(request).await,
            Err(problem) => refuse(request, &context, problem).into_response(),
        }
    };
    let answered = AssertUnwindSafe(answering.instrument(span.clone())).catch_unwind().await;
    let mut response = answered.unwrap_or_else(|panic| {
        span.in_scope(|| tracing::error!(panic = panic_message(panic.as_ref()), "a handler panicked"));
        Problem::new(ProblemKind::Internal, "an internal error was logged under this request id").into_response()
    });
    let problem = response.extensions_mut().remove::<Problem>().or_else(|| {
        // Of the page that describes the service, whose files are another's to serve.
        let is_bare = response.status() == StatusCode::NOT_FOUND;
        is_bare.then(|| Problem::new(ProblemKind::NotFound, "there is nothing at this path"))
    });
    if let Some(problem) = problem {
        let headers = std::mem::take(response.headers_mut());
        response = problem.render(&id);
        // What the router added, such as `Allow`; the body's own headers are the document's.
        for (name, value) in headers.iter().filter(|(name, _)| *name == ALLOW || is_for_cors(name)) {
            response.headers_mut().append(name, value.clone());
        }
    }
    // Operators are to see what is going on when there is no room, too.
    if !is_probe && let Err(error) = answer::count(&mut response, context.etude.memory()) {
        response = Problem::new(ProblemKind::Busy, error.to_string()).render(&id);
    }
    if let Ok(id) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(REQUEST_ID, id);
    }

    unanswered.is_answered = true;
    let elapsed = unanswered.clock.elapsed(unanswered.started);
    let status = response.status().as_u16();
    measure(method_label(&method), &route, response.status(), elapsed);
    let elapsed_us = u64::try_from(elapsed.as_micros()).unwrap_or(u64::MAX);
    span.in_scope(|| {
        // Asked every few seconds by machines, these would drown the rest.
        if is_probe && response.status().is_success() {
            tracing::debug!(status, elapsed_us, "answered");
        } else {
            tracing::info!(status, elapsed_us, "answered");
        }
    });
    response
}

/// Where requests of a kind are counted, by their route.
type Measured = FxHashMap<Arc<str>, (Counter, Histogram)>;

/// Counts a request, and how long it took.
fn measure(method: &'static str, route: &Arc<str>, status: StatusCode, elapsed: Duration) {
    thread_local! {
        /// By method and status, where this thread has counted requests before: to find that by its labels costs a lock.
        static KNOWN: RefCell<FxHashMap<(&'static str, StatusCode), Measured>> = RefCell::default();
    }
    let measured = || {
        let labels = [
            ("method", SharedString::const_str(method)),
            ("route", SharedString::from_shared(Arc::clone(route))),
            ("status", SharedString::from_shared(status.as_str().into())),
        ];
        let requests = metrics::counter!("etude_http_requests_total", &labels);
        (requests, metrics::histogram!("etude_http_request_duration_seconds", &labels))
    };
    KNOWN.with_borrow_mut(|known| {
        let (requests, durations) =
            known.entry((method, status)).or_default().entry(Arc::clone(route)).or_insert_with(measured);
        requests.increment(1);
        durations.record(elapsed.as_secs_f64());
    });
}

/// The method, if it is a standard one: labels are kept for as long as the service runs, so that clients must not make them up.
fn method_label(method: &Method) -> &'static str {
    const KNOWN: [&str; 9] = ["GET", "HEAD", "POST", "PUT", "DELETE", "CONNECT", "OPTIONS", "TRACE", "PATCH"];
    KNOWN.into_iter().find(|known| *known == method.as_str()).unwrap_or("other")
}

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("(no message)")
}

/// Logs, when it is dropped, that the client went away before its answer.
struct Unanswered {
    span: Span,
    clock: Clock,
    started: Instant,
    is_answered: bool,
}

impl Drop for Unanswered {
    fn drop(&mut self) {
        if !self.is_answered {
            let elapsed_us = u64::try_from(self.clock.elapsed(self.started).as_micros()).unwrap_or(u64::MAX);
            self.span.in_scope(|| tracing::info!(elapsed_us, "the client went away"));
            metrics::counter!("etude_http_requests_abandoned_total").increment(1);
        }
    }
}
