//! Who is let in: by the host that a request asks for, and by the web page that it comes from.
//!
//! Whoever reaches the service may use it. But a browser that reaches it may be led by any page that its user visits: the page names
//! the service by a host of its own (DNS rebinding), or sends requests to it without being able to read the answers. So the host
//! must be one that the service is known by, and a page must be its own or allowed.

use std::net::{IpAddr, Ipv6Addr};
use std::time::Duration;

use axum::http::header::{ETAG, HOST, LOCATION, ORIGIN, RETRY_AFTER};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, Uri};
use tower_http::cors::{AllowHeaders, CorsLayer};

use super::problem::{Problem, ProblemKind};
use super::request_id::REQUEST_ID;
use etude_core::document::Quoted;

/// How long browsers may cache the answer to a preflight.
const PREFLIGHT_MAX_AGE: Duration = Duration::from_hours(1);

/// Which hosts and origins are allowed, besides the service's own.
#[derive(Clone, Debug, Default)]
pub struct Access {
    /// Names in lower case, or `*`.
    hosts: Vec<String>,
    any_host: bool,
    origins: Vec<HeaderValue>,
}

impl Access {
    /// Allows IP addresses, `localhost` and the names below it, the names of the machine, `hosts`, which are names in lower case or `*`
    /// for all, and `origins`, as browsers write them.
    #[must_use]
    pub fn new(hosts: &[String], origins: &[HeaderValue]) -> Self {
        let any_host = hosts.iter().any(|host| host == "*");
        let hosts = hosts.iter().cloned().chain(machine_names()).collect();
        Self { hosts, any_host, origins: origins.to_vec() }
    }

    /// Whether a request is let in. Allocates nothing if it is.
    pub(super) fn check(&self, method: &Method, target: &Uri, headers: &HeaderMap) -> Result<(), Problem> {
        let mut named = headers.get_all(HOST).iter();
        let (Some(host), None) = (named.next(), named.next()) else {
            return Err(Problem::new(ProblemKind::BadHost, "the request must have one `Host` header"));
        };
        let mut host = self.known(host.as_bytes())?;
        // Of both, the target's counts (RFC 9112, section 3.2.2).
        if let Some(authority) = target.authority() {
            host = self.known(authority.as_str().as_bytes())?;
        }
        let mut from = headers.get_all(ORIGIN).iter();
        match (from.next(), from.next()) {
            (None, _) => check_without_origin(method, headers),
            (Some(origin), None) if is_own(origin, host) || self.origins.contains(origin) => Ok(()),
            (Some(origin), _) => Err(foreign(&format!("of {}", Quoted(&String::from_utf8_lossy(origin.as_bytes()))))),
        }
    }

    /// The host, if the service is known by it.
    fn known<'a>(&self, text: &'a [u8]) -> Result<Host<'a>, Problem> {
        let read = std::str::from_utf8(text).ok().and_then(Host::read);
        let host = read.ok_or_else(|| Problem::new(ProblemKind::BadHost, "the host is no name, nor an IP address"))?;
        let is_known = self.any_host
            || host.is_address
            || is_local(host.name)
            || self.hosts.iter().any(|known| known.eq_ignore_ascii_case(host.name));
        if is_known {
            return Ok(host);
        }
        let detail = format!(
            "this service is not known as {}; if it is meant to be reached by this name, allow it with ETUDE_ALLOW_HOST (--allow-host)",
            Quoted(host.name)
        );
        Err(Problem::new(ProblemKind::UnknownHost, detail))
    }

    /// What lets pages of the allowed origins read answers; `None` if there are none.
    pub(super) fn cors(&self) -> Option<CorsLayer> {
        (!self.origins.is_empty()).then(|| {
            CorsLayer::new()
                .allow_origin(self.origins.clone())
                .allow_methods([Method::GET, Method::PUT, Method::POST, Method::DELETE])
                .allow_headers(AllowHeaders::mirror_request())
                .allow_private_network(true)
                .expose_headers([ETAG, LOCATION, RETRY_AFTER, REQUEST_ID])
                .max_age(PREFLIGHT_MAX_AGE)
        })
    }
}

/// Browsers send the page's origin with every request that may change something. An opaque origin (`null`) is never allowed.
fn check_without_origin(method: &Method, headers: &HeaderMap) -> Result<(), Problem> {
    match headers.get("sec-fetch-site").map(HeaderValue::as_bytes) {
        None | Some(b"same-origin" | b"none") => Ok(()),
        Some(_) if method == Method::GET || method == Method::HEAD => Ok(()),
        Some(_) => Err(foreign("that the browser does not name")),
    }
}

/// Whether a header of an answer is for browsers that read it for another origin.
pub(super) fn is_for_cors(name: &HeaderName) -> bool {
    name == axum::http::header::VARY || name.as_str().starts_with("access-control-")
}

fn foreign(page: &str) -> Problem {
    let detail = format!(
        "the request comes from a web page {page}; if it may use this service, allow it with ETUDE_ALLOW_ORIGIN (--allow-origin)"
    );
    Problem::new(ProblemKind::ForeignOrigin, detail)
}

/// A host and its port, as requests name them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Host<'a> {
    /// Without the brackets of an IPv6 address, and without the last dot of a complete name.
    name: &'a str,
    is_address: bool,
    port: Option<u16>,
}

impl<'a> Host<'a> {
    fn read(text: &'a str) -> Option<Self> {
        let (name, is_address, rest) = if let Some(bracketed) = text.strip_prefix('[') {
            let (name, rest) = bracketed.split_once(']')?;
            (name, name.parse::<Ipv6Addr>().is_ok().then_some(true)?, rest)
        } else {
            let (name, rest) = text.split_at(text.find(':').unwrap_or(text.len()));
            let name = name.strip_suffix('.').unwrap_or(name);
            let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b".-_".contains(&byte);
            let is_address = name.parse::<IpAddr>().is_ok();
            ((!name.is_empty() && name.bytes().all(is_plain)).then_some(name)?, is_address, rest)
        };
        let port = match rest.strip_prefix(':') {
            None if rest.is_empty() => None,
            None => return None,
            Some("") => None,
            Some(port) => Some(port.bytes().all(|byte| byte.is_ascii_digit()).then(|| port.parse().ok())??),
        };
        Some(Self { name, is_address, port })
    }
}

/// Whether `name` means this machine wherever it is looked up (RFC 6761, section 6.3).
fn is_local(name: &str) -> bool {
    const LOCAL: &str = "localhost";
    let (before, last) = name.split_at(name.len().saturating_sub(LOCAL.len()));
    last.eq_ignore_ascii_case(LOCAL) && (before.is_empty() || before.ends_with('.'))
}

/// Whether the page is one of the service's own: of the host and the port that it asks for. Behind a proxy that speaks TLS, it is
/// asked for by `https`.
fn is_own(origin: &HeaderValue, asked: Host<'_>) -> bool {
    let Ok(origin) = origin.to_str() else { return false };
    let Some((scheme, host)) = origin.split_once("://") else { return false };
    let default_port = match scheme {
        "http" => 80,
        "https" => 443,
        _ => return false,
    };
    Host::read(host).is_some_and(|host| {
        let port = |host: Host<'_>| host.port.unwrap_or(default_port);
        host.name.eq_ignore_ascii_case(asked.name) && port(host) == port(asked)
    })
}

/// The names that the machine has given itself: the whole one, and its first label.
fn machine_names() -> Vec<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = name.trim().trim_end_matches('.');
    let first = name.split('.').next().unwrap_or_default();
    // Nobody asks for a value that is no name, such as `(none)`.
    [name, first].into_iter().filter(|name| !name.is_empty()).map(str::to_owned).collect()
}

/// Reads the name of a host that is to be allowed: a port is ignored, `*` allows all.
pub(crate) fn allowed_host(text: &str) -> Result<String, String> {
    let name = if text == "*" { Some(text) } else { Host::read(text).map(|host| host.name) };
    name.map(str::to_ascii_lowercase).ok_or_else(|| "expected a name such as etude.example, or *".to_owned())
}

/// Reads an origin that is to be allowed, and writes it as browsers do.
pub(crate) fn allowed_origin(text: &str) -> Result<HeaderValue, String> {
    let lower = text.to_ascii_lowercase();
    let written = lower.split_once("://").filter(|(scheme, host)| !scheme.is_empty() && Host::read(host).is_some());
    let default_port = match written {
        Some(("http", _)) => ":80",
        Some(("https", _)) => ":443",
        _ => "",
    };
    let origin = written.and_then(|_| HeaderValue::from_str(lower.strip_suffix(default_port).unwrap_or(&lower)).ok());
    origin.ok_or_else(|| "expected a scheme and a host such as https://app.example, without a path".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host(text: &str) -> Option<(&str, bool, Option<u16>)> {
        Host::read(text).map(|host| (host.name, host.is_address, host.port))
    }

    #[test]
    fn a_host_is_a_name_or_an_address_with_or_without_a_port() {
        assert_eq!(host("Etude.example"), Some(("Etude.example", false, None)));
        assert_eq!(host("localhost.:8080"), Some(("localhost", false, Some(8080))));
        assert_eq!(host("127.0.0.1:80"), Some(("127.0.0.1", true, Some(80))));
        assert_eq!(host("[::1]:8080"), Some(("::1", true, Some(8080))));
        assert_eq!(host("[::1]"), Some(("::1", true, None)));
        assert_eq!(host("etude:"), Some(("etude", false, None)));
        for text in
            ["", ":80", "a b", "a@b", "a/b", "::1", "[::1", "[a]", "[::1]x", "a:b", "a:+1", "a:65536", "a,b", "*"]
        {
            assert_eq!(host(text), None, "{text}");
        }
    }

    #[test]
    fn names_below_localhost_are_local_and_those_that_end_alike_are_not() {
        for name in ["localhost", "LocalHost", "app.localhost"] {
            assert!(is_local(name), "{name}");
        }
        for name in ["evillocalhost", "localhost.evil", "host", "a", ""] {
            assert!(!is_local(name), "{name}");
        }
    }

    #[test]
    fn an_own_page_has_the_host_and_the_port_that_it_asks_for() {
        let is_own = |origin: &'static str, host: &'static str| {
            is_own(&HeaderValue::from_static(origin), Host::read(host).unwrap())
        };
        for (origin, host) in [
            ("http://localhost:8080", "localhost:8080"),
            ("http://Localhost", "localhost:80"),
            ("https://etude.example", "etude.example"),
            ("https://etude.example", "etude.example:443"),
            ("http://[::1]:8080", "[::1]:8080"),
        ] {
            assert!(is_own(origin, host), "{origin} {host}");
        }
        for (origin, host) in [
            ("null", "null"),
            ("http://localhost", "localhost:8080"),
            ("http://localhost:3000", "localhost:8080"),
            ("http://evil.example", "127.0.0.1"),
            ("file://localhost", "localhost"),
            ("http://localhost:80@evil.example", "localhost:80"),
            ("https://etude.example:80", "etude.example:443"),
        ] {
            assert!(!is_own(origin, host), "{origin} {host}");
        }
    }

    #[test]
    fn settings_are_read_as_browsers_write_them() {
        assert_eq!(allowed_host("Etude:8080"), Ok("etude".to_owned()));
        assert_eq!(allowed_host("*"), Ok("*".to_owned()));
        assert!(allowed_host("http://etude").is_err() && allowed_host("").is_err());
        assert_eq!(allowed_origin("HTTPS://App.example:443").unwrap(), "https://app.example");
        assert_eq!(allowed_origin("http://localhost:3000").unwrap(), "http://localhost:3000");
        for text in ["*", "null", "app.example", "https://app.example/", "://x", "http://"] {
            assert!(allowed_origin(text).is_err(), "{text}");
        }
    }
}
