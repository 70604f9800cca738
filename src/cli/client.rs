//! A client of a running service.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::CliError;

/// A client of the service at a base URL.
#[derive(Clone, Debug)]
pub(super) struct Client {
    base: String,
    http: reqwest::Client,
}

impl Client {
    pub(super) fn new(base: &str) -> Result<Self, CliError> {
        let base = base.trim_end_matches('/').to_owned();
        Ok(Self { base, http: client()? })
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
    let http = |source| CliError::Http { url: url.to_owned(), source };
    let answer = request.send().await.map_err(http)?;
    let status = answer.status();
    if status.is_success() {
        return answer.json().await.map_err(http);
    }
    let body = answer.text().await.map_err(http)?;
    Err(CliError::Answer { url: url.to_owned(), status: status.as_u16(), body })
}
