//! Lists in pages.

use axum::extract::{FromRequestParts, Query};
use axum::http::request::Parts;
use serde::Serialize;
use utoipa::{IntoParams, ToSchema};

use super::problem::Problem;
use crate::service::{Name, Page};
use etude_core::document::{Faults, Path};

/// Which part of a list is wanted.
#[derive(Clone, Debug, PartialEq, Eq, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct Paging {
    /// Most items: 1 to 1000. A page of large ones has fewer.
    #[param(minimum = 1, maximum = 1000, default = 100, required = false)]
    pub(super) limit: u32,
    /// The `next` of the page before; left out for the first page.
    pub(super) after: Option<String>,
}

impl Paging {
    const MAX_LIMIT: u32 = 1000;
    const DEFAULT_LIMIT: u32 = 100;
}

impl<S: Send + Sync> FromRequestParts<S> for Paging {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Self::read(parts, "limit, after", |_, _| None)
    }
}

impl Paging {
    /// Reads a query that also has parameters that `other` knows; those that it does not know, it answers with `None`, faulty
    /// ones with what is wrong. `known` lists all names.
    pub(super) fn read(
        parts: &Parts,
        known: &str,
        mut other: impl FnMut(&str, &str) -> Option<Result<(), String>>,
    ) -> Result<Self, Problem> {
        let mut faults = Faults::default();
        let mut note = |name: &str, detail: String| faults.note_at(&Path::Member(&Path::Root, name), detail);
        let mut paging = Self { limit: Self::DEFAULT_LIMIT, after: None };
        let query = Query::<Vec<(String, String)>>::try_from_uri(&parts.uri);
        for (name, value) in query.map(|Query(query)| query).unwrap_or_default() {
            match name.as_str() {
                "limit" => match value.parse() {
                    Ok(limit) if (1..=Self::MAX_LIMIT).contains(&limit) => paging.limit = limit,
                    _ => {
                        let expected = format!("expected a whole number from 1 to {}", Self::MAX_LIMIT);
                        note("limit", format!("{expected}, found {value:?}"));
                    }
                },
                "after" => paging.after = Some(value),
                _ => match other(&name, &value) {
                    Some(Ok(())) => {}
                    Some(Err(detail)) => note(&name, detail),
                    None => note(&name, format!("unknown query parameter; known here: {known}")),
                },
            }
        }
        if faults.is_empty() { Ok(paging) } else { Err(faults.into()) }
    }

    /// The `after` of a list that is paged by numbers.
    pub(super) fn after_number(&self) -> Result<Option<u64>, Problem> {
        let parse = |after: &String| after.parse().map_err(|_| Faults::one("/after", "expected the `next` of a page"));
        Ok(self.after.as_ref().map(parse).transpose()?)
    }
}

/// A name that a list is filtered by.
pub(super) fn name_in(value: &str) -> Result<String, String> {
    Name::new(value).map(|name| name.to_string()).map_err(|error| format!("{error}, found {value:?}"))
}

/// That of `all` which is called `value`.
pub(super) fn one_of<T: Copy, const N: usize>(
    value: &str,
    all: [T; N],
    name: fn(T) -> &'static str,
) -> Result<T, String> {
    let found = all.into_iter().find(|one| name(*one) == value);
    found.ok_or_else(|| format!("expected one of {}, found {value:?}", all.map(name).join(", ")))
}

/// Where a page begins in a list that is ordered by sequence numbers.
pub(super) fn after_sequence(paging: &Paging) -> Result<i64, Problem> {
    match &paging.after {
        Some(after) => after.parse().map_err(|_| Faults::one("/after", "expected the `next` of a page").into()),
        None => Ok(0),
    }
}

/// A part of a list.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub(super) struct List<T> {
    /// The items, in order.
    items: Vec<T>,
    /// What to give as `after` for the next page; `null` on the last page.
    next: Option<String>,
    /// Names or ids of what belongs here but cannot be read, as what is stored of it is damaged. Left out if there is none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    unreadable: Vec<String>,
}

impl<T> List<T> {
    pub(super) fn of<U>(page: Page<U>, item: impl FnMut(U) -> T) -> Self {
        let Page { items, unreadable, next } = page.map(item);
        Self { items, next, unreadable }
    }
}
