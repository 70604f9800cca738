//! Tags of what is answered, and conditions on them (RFC 9110, section 13).

use axum::http::header::{AsHeaderName, ETAG, IF_MATCH, IF_NONE_MATCH};
use axum::http::{HeaderMap, HeaderValue};
use axum::response::Response;

use crate::service::Replaces;

/// Whether the client has what `tag` stands for (`If-None-Match`).
pub(super) fn has_tag(headers: &HeaderMap, tag: &str) -> bool {
    tags(headers, IF_NONE_MATCH).any(|given| given == "*" || given.strip_prefix("W/").unwrap_or(given) == tag)
}

/// What a client wants to replace (`If-Match`), by its hash, in quotes or not.
pub(super) fn replaces(headers: &HeaderMap) -> Replaces {
    if !headers.contains_key(IF_MATCH) {
        return Replaces::Nothing;
    }
    if tags(headers, IF_MATCH).any(|given| given == "*") {
        return Replaces::Any;
    }
    let hash = |tag: &str| tag.strip_prefix('"').and_then(|tag| tag.strip_suffix('"')).unwrap_or(tag).to_owned();
    Replaces::OneOf(tags(headers, IF_MATCH).map(hash).collect())
}

pub(super) fn with_tag(mut response: Response, tag: &str) -> Response {
    if let Ok(tag) = HeaderValue::from_str(tag) {
        response.headers_mut().insert(ETAG, tag);
    }
    response
}

/// The tags that a header lists.
fn tags(headers: &HeaderMap, name: impl AsHeaderName) -> impl Iterator<Item = &str> {
    let lists = headers.get_all(name).iter().filter_map(|list| list.to_str().ok());
    lists.flat_map(|list| list.split(',')).map(str::trim)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_to_be_replaced_is_one_of_the_tags_and_no_weak_one() {
        let replaces = |values: &[&'static str]| {
            let mut headers = HeaderMap::new();
            for value in values {
                headers.append(IF_MATCH, HeaderValue::from_static(value));
            }
            replaces(&headers)
        };
        assert_eq!(replaces(&[]), Replaces::Nothing);
        assert_eq!(replaces(&["*"]), Replaces::Any);
        let several = replaces(&["\"a\", b", "W/\"c\""]);
        assert!(["a", "b"].iter().all(|hash| several.admits(hash)) && !several.admits("c"));
        assert!(!replaces(&[""]).admits("a"));
    }
}
