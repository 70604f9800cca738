//! A client of a running service.

use std::error::Error;
use std::io;
use std::str::FromStr;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::CliError;
use etude_core::document::Fault;

/// Where a service is: the part of its URLs before `/v1`, without a slash at the end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ServerUrl(String);

impl ServerUrl {
    pub(super) fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for ServerUrl {
    type Err = String;

    /// Reads a URL, or what stands in its place where it is typed: a host, or a host and a port.
    fn from_str(text: &str) -> Result<Self, String> {
        const EXPECTED: &str = "expected the address of a service, such as http://127.0.0.1:8080";
        let text = text.trim_end_matches('/');
        if text.starts_with("https://") {
            return Err("https is not spoken here: give the http address of the service itself, or of a tunnel to it"
                .to_owned());
        }
        let url = if text.contains("://") { text.to_owned() } else { format!("http://{text}") };
        let is_service = reqwest::Url::parse(&url).is_ok_and(|url| url.scheme() == "http" && url.has_host());
        // A number alone would be read as an IP address.
        let is_port = text.parse::<u32>().is_ok();
        if is_service && !is_port { Ok(Self(url)) } else { Err(EXPECTED.to_owned()) }
    }
}

/// A client of the service at a base URL.
#[derive(Clone, Debug)]
pub(super) struct Client {
    base: String,
    http: reqwest::Client,
}

impl Client {
    pub(super) fn new(base: &ServerUrl) -> Result<Self, CliError> {
        Ok(Self { base: base.0.clone(), http: client()? })
    }

    pub(super) async fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T, CliError> {
        let url = format!("{}{path}", self.base);
        answer(&url, self.http.get(&url)).await
    }

    pub(super) async fn put<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize) -> Result<T, CliError> {
        let url = format!("{}{path}", self.base);
        answer(&url, self.http.put(&url).json(body)).await
    }

    pub(super) async fn post<T: DeserializeOwned>(&self, path: &str, body: &Value) -> Result<T, CliError> {
        let url = format!("{}{path}", self.base);
        answer(&url, self.http.post(&url).json(body)).await
    }
}

/// A client without proxies: services are asked directly.
pub(super) fn client() -> Result<reqwest::Client, CliError> {
    reqwest::Client::builder().no_proxy().build().map_err(|source| CliError::Http { url: String::new(), source })
}

/// Sends a request and reads the answer.
pub(super) async fn answer<T: DeserializeOwned>(url: &str, request: reqwest::RequestBuilder) -> Result<T, CliError> {
    let answer = request.send().await.map_err(|source| failed(url, source))?;
    let status = answer.status();
    if status.is_success() {
        let body = answer.bytes().await.map_err(|source| failed(url, source))?;
        return serde_json::from_slice(&body).map_err(|_| CliError::NoService {
            url: url.to_owned(),
            why: "what answers there is another program".to_owned(),
        });
    }
    Err(refused(url, answer).await)
}

/// What an answer says that is no success.
pub(super) async fn refused(url: &str, answer: reqwest::Response) -> CliError {
    #[derive(Deserialize)]
    struct Problem {
        detail: String,
        #[serde(default)]
        errors: Vec<Fault>,
    }
    let status = answer.status().as_u16();
    let body = match answer.text().await {
        Ok(body) => body,
        Err(source) => return failed(url, source),
    };
    let told = match serde_json::from_str(&body) {
        Ok(Problem { detail, errors }) if errors.is_empty() => detail,
        Ok(Problem { errors, .. }) => {
            let faults = errors.iter().map(|Fault { pointer, detail, .. }| format!("\n{pointer}: {detail}"));
            faults.collect()
        }
        Err(_) => body,
    };
    CliError::Answer { url: url.to_owned(), status, told }
}

/// Why `url` could not be asked.
pub(super) fn failed(url: &str, source: reqwest::Error) -> CliError {
    if !source.is_connect() {
        return CliError::Http { url: url.to_owned(), source };
    }
    let (mut kind, mut cause) = (None, source.source());
    while let Some(error) = cause {
        kind = error.downcast_ref().map(io::Error::kind).or(kind);
        cause = error.source();
    }
    let why = match kind {
        Some(io::ErrorKind::ConnectionRefused) => "nothing listens there",
        Some(io::ErrorKind::TimedOut | io::ErrorKind::HostUnreachable | io::ErrorKind::NetworkUnreachable) => {
            "the host does not answer"
        }
        _ => "there is no such host, or it cannot be reached",
    };
    CliError::NoService { url: url.to_owned(), why: why.to_owned() }
}
