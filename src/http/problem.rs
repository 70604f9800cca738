//! Errors as clients see them (RFC 9457), and the only mapping of errors to status codes.

use std::error::Error;
use std::io;

use axum::http::header::{ACCEPT_ENCODING, CONTENT_TYPE, RETRY_AFTER, SEC_WEBSOCKET_VERSION, UPGRADE};
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::{IntoResponses, ToSchema};

use super::encoding::{BodyError, Encoding};
use super::request_id::RequestId;
use crate::memory::NoRoom;
use crate::service::{self, Kind, Outage, OutageKind, PoolError, ServiceError};
use etude_core::document::{Fault, Faults, ParseError};

/// What kind of problem it is: its `type`, title and status.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ProblemKind {
    MalformedJson,
    IncompleteBody,
    BrokenEncoding,
    BadHost,
    ForeignOrigin,
    UnknownHost,
    NotFound,
    UnknownModel,
    UnknownPolicy,
    UnknownLearner,
    UnknownSession,
    UnknownTrial,
    UnknownVersion,
    MethodNotAllowed,
    SlowBody,
    Conflict,
    PreconditionFailed,
    InUse,
    KeyReused,
    AlreadyRewarded,
    TrialFailed,
    TooLarge,
    BatchFull,
    UnsupportedMediaType,
    UnsupportedEncoding,
    CompressedStream,
    UpgradeRequired,
    Invalid,
    Internal,
    Busy,
    NotReady,
    Stopping,
    StorageFull,
}

impl ProblemKind {
    /// Slug, title and status.
    fn describe(self) -> (&'static str, &'static str, StatusCode) {
        match self {
            Self::MalformedJson => ("malformed-json", "The body is not JSON", StatusCode::BAD_REQUEST),
            Self::IncompleteBody => ("incomplete-body", "The body ended early", StatusCode::BAD_REQUEST),
            Self::BrokenEncoding => ("broken-encoding", "The body cannot be decompressed", StatusCode::BAD_REQUEST),
            Self::BadHost => ("bad-host", "The host is missing or unclear", StatusCode::BAD_REQUEST),
            Self::ForeignOrigin => ("foreign-origin", "The web page may not do this", StatusCode::FORBIDDEN),
            Self::UnknownHost => ("unknown-host", "This is not that host", StatusCode::MISDIRECTED_REQUEST),
            Self::NotFound => ("not-found", "There is nothing here", StatusCode::NOT_FOUND),
            Self::UnknownModel => ("unknown-model", "There is no such model", StatusCode::NOT_FOUND),
            Self::UnknownPolicy => ("unknown-policy", "There is no such policy", StatusCode::NOT_FOUND),
            Self::UnknownLearner => ("unknown-learner", "There is no such learner", StatusCode::NOT_FOUND),
            Self::UnknownSession => ("unknown-session", "There is no such session", StatusCode::NOT_FOUND),
            Self::UnknownTrial => ("unknown-trial", "There is no such trial", StatusCode::NOT_FOUND),
            Self::UnknownVersion => ("unknown-version", "There is no such version", StatusCode::NOT_FOUND),
            Self::MethodNotAllowed => {
                ("method-not-allowed", "The method is not supported here", StatusCode::METHOD_NOT_ALLOWED)
            }
            Self::SlowBody => ("slow-body", "The body took too long", StatusCode::REQUEST_TIMEOUT),
            Self::Conflict => ("conflict", "The name is taken", StatusCode::CONFLICT),
            Self::PreconditionFailed => {
                ("precondition-failed", "It is not what was expected", StatusCode::PRECONDITION_FAILED)
            }
            Self::KeyReused => {
                ("idempotency-key-reused", "The key is another request's", StatusCode::UNPROCESSABLE_ENTITY)
            }
            Self::InUse => ("in-use", "Something else needs it", StatusCode::CONFLICT),
            Self::AlreadyRewarded => ("already-rewarded", "The trial has a reward", StatusCode::CONFLICT),
            Self::TrialFailed => ("trial-failed", "The trial has failed", StatusCode::CONFLICT),
            Self::BatchFull => ("batch-full", "The answer is full", StatusCode::PAYLOAD_TOO_LARGE),
            Self::TooLarge => ("too-large", "The body is too large", StatusCode::PAYLOAD_TOO_LARGE),
            Self::UnsupportedMediaType => {
                ("unsupported-media-type", "The type of the body is not supported", StatusCode::UNSUPPORTED_MEDIA_TYPE)
            }
            Self::UnsupportedEncoding => {
                ("unsupported-encoding", "The body's compression is not supported", StatusCode::UNSUPPORTED_MEDIA_TYPE)
            }
            Self::CompressedStream => {
                ("unsupported-encoding", "A stream is not compressed", StatusCode::UNSUPPORTED_MEDIA_TYPE)
            }
            Self::UpgradeRequired => ("upgrade-required", "This is a websocket", StatusCode::UPGRADE_REQUIRED),
            Self::Invalid => ("invalid", "The request has faults", StatusCode::UNPROCESSABLE_ENTITY),
            Self::Internal => ("internal", "Something went wrong here", StatusCode::INTERNAL_SERVER_ERROR),
            Self::Busy => ("busy", "Too many requests are waiting", StatusCode::SERVICE_UNAVAILABLE),
            Self::NotReady => ("not-ready", "The database cannot be used now", StatusCode::SERVICE_UNAVAILABLE),
            Self::Stopping => ("stopping", "The service is shutting down", StatusCode::SERVICE_UNAVAILABLE),
            Self::StorageFull => ("storage-full", "No room is left for the database", StatusCode::INSUFFICIENT_STORAGE),
        }
    }
}

/// A problem document (RFC 9457, `application/problem+json`).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, ToSchema)]
pub(super) struct Problem {
    /// `/problems/` and what kind of problem it is.
    #[serde(rename = "type")]
    #[schema(example = "/problems/invalid")]
    kind: String,
    /// The kind in words.
    #[schema(example = "The request has faults")]
    title: &'static str,
    /// The HTTP status.
    #[schema(example = 422)]
    status: u16,
    /// What happened this time.
    detail: String,
    /// Under which the service has logged this request.
    request_id: String,
    #[serde(skip)]
    of: ProblemKind,
    /// Every fault of the request, with its place; up to 1000 are listed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    errors: Vec<Fault>,
}

/// What a request may be told whose body is read, as the description of its path lists it.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "it only describes what a `Problem` may be")]
pub(super) enum BodyProblems {
    #[response(
        status = 400,
        description = "`malformed-json`, `incomplete-body`, `broken-encoding`",
        content_type = "application/problem+json"
    )]
    Unreadable(Problem),
    #[response(status = 408, description = "`slow-body`", content_type = "application/problem+json")]
    Slow(Problem),
    #[response(status = 413, description = "`too-large`", content_type = "application/problem+json")]
    TooLarge(Problem),
    #[response(
        status = 415,
        description = "`unsupported-media-type`, `unsupported-encoding`",
        content_type = "application/problem+json"
    )]
    Unsupported(Problem),
}

/// What a request may be told that changes what a name stands for, and takes no body.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "it only describes what a `Problem` may be")]
pub(super) enum NoBodyProblems {
    #[response(
        status = 415,
        description = "`unsupported-media-type`: it takes no body",
        content_type = "application/problem+json"
    )]
    HasBody(Problem),
    #[response(status = 422, description = "`invalid`: not a name", content_type = "application/problem+json")]
    NoName(Problem),
    #[response(
        status = 503,
        description = "`not-ready`, `stopping`: see `Retry-After`",
        content_type = "application/problem+json"
    )]
    NotReady(Problem),
}

/// The same, of what has an id, which may be any text.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "it only describes what a `Problem` may be")]
pub(super) enum DeletionProblems {
    #[response(
        status = 415,
        description = "`unsupported-media-type`: it takes no body",
        content_type = "application/problem+json"
    )]
    HasBody(Problem),
    #[response(
        status = 503,
        description = "`not-ready`, `stopping`: see `Retry-After`",
        content_type = "application/problem+json"
    )]
    NotReady(Problem),
}

impl Problem {
    pub(super) fn new(kind: ProblemKind, detail: impl Into<String>) -> Self {
        let (slug, title, status) = kind.describe();
        Self {
            kind: format!("/problems/{slug}"),
            title,
            status: status.as_u16(),
            detail: detail.into(),
            request_id: String::new(),
            of: kind,
            errors: Vec::new(),
        }
    }

    /// The problem of a request with these faults.
    pub(super) fn invalid(faults: &Faults) -> Self {
        let count = faults.count();
        let first = faults.listed().first();
        let detail = match first {
            Some(fault) if count == 1 => fault.detail.clone(),
            _ if count > faults.listed().len() => {
                format!("{count} faults, of which {} are listed", faults.listed().len())
            }
            _ => format!("{count} faults"),
        };
        Self { errors: faults.listed().to_vec(), ..Self::new(ProblemKind::Invalid, detail) }
    }

    /// The problem of a body that could not be read to its end.
    pub(super) fn unreadable(error: &io::Error) -> Self {
        match error.get_ref() {
            Some(inner) if inner.is::<NoRoom>() => Self::new(ProblemKind::Busy, inner.to_string()),
            Some(inner) => match inner.downcast_ref::<BodyError>() {
                Some(error) => error.into(),
                None => Self::new(ProblemKind::BrokenEncoding, error.to_string()),
            },
            None => Self::new(ProblemKind::BrokenEncoding, error.to_string()),
        }
    }

    /// The same, as part of the answer to a request.
    pub(super) fn of_request(self, id: &RequestId) -> Self {
        Self { request_id: id.0.to_string(), ..self }
    }

    /// The document as JSON.
    pub(super) fn text(&self) -> String {
        serde_json::to_string(self).unwrap_or_default()
    }

    /// The document, with the id of the request it answers.
    pub(super) fn render(mut self, request_id: &str) -> Response {
        request_id.clone_into(&mut self.request_id);
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let body = self.text();
        let mut response = (status, body).into_response();
        response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        let accepted = match self.of {
            ProblemKind::UnsupportedEncoding => Some(Encoding::ACCEPTED),
            ProblemKind::CompressedStream => Some("identity"),
            _ => None,
        };
        if let Some(accepted) = accepted {
            response.headers_mut().insert(ACCEPT_ENCODING, HeaderValue::from_static(accepted));
        }
        if status == StatusCode::UPGRADE_REQUIRED {
            response.headers_mut().insert(UPGRADE, HeaderValue::from_static("websocket"));
            response.headers_mut().insert(SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13"));
        }
        if status == StatusCode::SERVICE_UNAVAILABLE {
            response.headers_mut().insert(RETRY_AFTER, service::RETRY_AFTER.as_secs().into());
        }
        response
    }
}

/// The response carries the problem to [`observe`](super::observe), which knows the request's id and renders it.
impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = status.into_response();
        response.extensions_mut().insert(self);
        response
    }
}

impl From<&BodyError> for Problem {
    fn from(error: &BodyError) -> Self {
        let kind = match error {
            BodyError::Incomplete => ProblemKind::IncompleteBody,
            BodyError::TooLarge(_) => ProblemKind::TooLarge,
            BodyError::Slow(_) => ProblemKind::SlowBody,
            BodyError::NoRoom(_) => ProblemKind::Busy,
            BodyError::Broken(_) => ProblemKind::BrokenEncoding,
        };
        Self::new(kind, error.to_string())
    }
}

impl From<Faults> for Problem {
    fn from(faults: Faults) -> Self {
        Self::invalid(&faults)
    }
}

impl From<ServiceError> for Problem {
    fn from(error: ServiceError) -> Self {
        let detail = error.to_string();
        match error {
            ServiceError::Parse(ParseError::Syntax { .. }) => Self::new(ProblemKind::MalformedJson, detail),
            ServiceError::Parse(ParseError::Faults(faults)) | ServiceError::Faults(faults) => Self::invalid(&faults),
            ServiceError::NothingExperienced { .. } => Self::invalid(&Faults::one("", detail)),
            ServiceError::TooLarge(_) => Self::new(ProblemKind::TooLarge, detail),
            ServiceError::Body(error) => Self::unreadable(&error),
            ServiceError::Unknown { kind, pointer, .. } => {
                let problem = match kind {
                    Kind::Model => ProblemKind::UnknownModel,
                    Kind::Policy => ProblemKind::UnknownPolicy,
                    Kind::Learner => ProblemKind::UnknownLearner,
                    Kind::Session => ProblemKind::UnknownSession,
                    Kind::Trial => ProblemKind::UnknownTrial,
                };
                let fault =
                    pointer.map(|pointer| Fault { line: None, pointer: pointer.to_owned(), detail: detail.clone() });
                Self { errors: fault.into_iter().collect(), ..Self::new(problem, detail) }
            }
            ServiceError::BatchFull => Self::new(ProblemKind::BatchFull, detail),
            ServiceError::Conflict { .. } | ServiceError::BatchTaken { .. } => Self::new(ProblemKind::Conflict, detail),
            ServiceError::PreconditionFailed { .. } => Self::new(ProblemKind::PreconditionFailed, detail),
            ServiceError::KeyReused { .. } => Self::new(ProblemKind::KeyReused, detail),
            ServiceError::InUse { .. } => Self::new(ProblemKind::InUse, detail),
            ServiceError::UnknownVersion { .. } => Self::new(ProblemKind::UnknownVersion, detail),
            ServiceError::AlreadyRewarded { .. } => Self::new(ProblemKind::AlreadyRewarded, detail),
            ServiceError::TrialFailed { .. } => Self::new(ProblemKind::TrialFailed, detail),
            ServiceError::Pool(PoolError::Busy)
            | ServiceError::NoRoom(_)
            | ServiceError::Shortage(_)
            | ServiceError::Compiling { .. } => Self::new(ProblemKind::Busy, detail),
            ServiceError::Unavailable(Outage { kind: OutageKind::Full, .. }) => {
                Self::new(ProblemKind::StorageFull, detail)
            }
            ServiceError::Unavailable(_) | ServiceError::Lost => Self::new(ProblemKind::NotReady, detail),
            ServiceError::Closed | ServiceError::Pool(PoolError::Stopped) => Self::new(ProblemKind::Stopping, detail),
            ServiceError::Pool(PoolError::Panicked)
            | ServiceError::Storage(_)
            | ServiceError::Removed
            | ServiceError::Unreadable { .. }
            | ServiceError::Write(_)
            | ServiceError::WritePolicy(_) => {
                // The client gets nothing but its request id, under which the log has the rest.
                tracing::error!(error = &error as &dyn Error, "a request failed");
                Self::new(ProblemKind::Internal, "an internal error was logged under this request id")
            }
        }
    }
}
