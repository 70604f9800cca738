//! Names and ids in paths.

use axum::extract::rejection::PathRejection;
use axum::extract::{FromRequestParts, Path};
use axum::http::request::Parts;

use super::problem::{Problem, ProblemKind};
use crate::service::Name;
use etude_core::document::Faults;

/// The name at the end of a path.
pub(super) struct PathName(pub(super) Name);

impl<S: Send + Sync> FromRequestParts<S> for PathName {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let path: Result<Path<String>, PathRejection> = Path::from_request_parts(parts, state).await;
        let invalid = |detail: String| Problem::from(Faults::one("", format!("{detail} in the path")));
        let Path(name) = path.map_err(|_| invalid("expected a name in UTF-8".to_owned()))?;
        Name::new(name).map(Self).map_err(|error| invalid(error.to_string()))
    }
}

/// The id at the end of a path.
pub(super) struct PathId(pub(super) String);

impl<S: Send + Sync> FromRequestParts<S> for PathId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let path: Result<Path<String>, PathRejection> = Path::from_request_parts(parts, state).await;
        // What is not even UTF-8 is nobody's id.
        path.map(|Path(id)| Self(id)).map_err(|_| Problem::new(ProblemKind::NotFound, "there is nothing at this path"))
    }
}
