//! A client of the service whose requests and answers are held against the contract.

use reqwest::header::{CONTENT_ENCODING, CONTENT_TYPE, HeaderMap};
use reqwest::{Body, Method, RequestBuilder, Response};
use serde::Serialize;

use crate::harness::contract::{Answered, CONTRACT, MAX_CHECKED_BYTES, Sent};

/// A client whose requests and answers are held against the contract.
#[derive(Clone)]
pub(crate) struct Client(reqwest::Client);

/// One of its requests.
pub(crate) struct Request(reqwest::Client, RequestBuilder);

impl Client {
    /// A client with the default settings.
    pub(crate) fn new() -> Self {
        Self::of(reqwest::Client::builder().no_proxy().build().unwrap())
    }

    /// A client that sends with `client`.
    pub(crate) fn of(client: reqwest::Client) -> Self {
        Self(client)
    }

    pub(crate) fn request(&self, method: Method, url: impl reqwest::IntoUrl) -> Request {
        Request(self.0.clone(), self.0.request(method, url))
    }

    pub(crate) fn get(&self, url: impl reqwest::IntoUrl) -> Request {
        self.request(Method::GET, url)
    }

    pub(crate) fn put(&self, url: impl reqwest::IntoUrl) -> Request {
        self.request(Method::PUT, url)
    }

    pub(crate) fn post(&self, url: impl reqwest::IntoUrl) -> Request {
        self.request(Method::POST, url)
    }
}

impl Request {
    pub(crate) fn header(self, name: impl reqwest::header::IntoHeaderName, value: impl AsRef<str>) -> Self {
        let mut headers = HeaderMap::new();
        headers.insert(name, value.as_ref().parse().unwrap());
        // One of the same name stays.
        Self(self.0, headers.iter().fold(self.1, |request, (name, value)| request.header(name, value)))
    }

    pub(crate) fn json(self, body: &impl Serialize) -> Self {
        Self(self.0, self.1.json(body))
    }

    pub(crate) fn body(self, body: impl Into<Body>) -> Self {
        Self(self.0, self.1.body(body))
    }

    /// Sends the request. The answer has been read if it is JSON.
    pub(crate) async fn send(self) -> Result<Response, reqwest::Error> {
        let Self(client, request) = self;
        let request = request.build()?;
        let text =
            |headers: &HeaderMap, name| headers.get(name).and_then(|value| value.to_str().ok()).map(str::to_owned);
        let is_plain = !request.headers().contains_key(CONTENT_ENCODING);
        let sent = Sent {
            method: request.method().clone(),
            url: request.url().clone(),
            content_type: text(request.headers(), CONTENT_TYPE),
            body: request.body().and_then(Body::as_bytes).filter(|_| is_plain).map(ToOwned::to_owned),
        };
        let response = client.execute(request).await?;
        let content_type = text(response.headers(), CONTENT_TYPE);
        let status = response.status();
        let is_json = content_type.as_ref().is_some_and(|content_type| content_type.contains("json"));
        let is_small = response.content_length().is_some_and(|n_bytes| n_bytes <= MAX_CHECKED_BYTES as u64);
        let mut answered = Answered { status: status.as_u16(), content_type: content_type.as_deref(), body: None };
        if !is_json || !is_small {
            CONTRACT.check(&sent, &answered);
            return Ok(response);
        }
        let mut read = axum::http::Response::builder().status(status);
        read.headers_mut().into_iter().for_each(|headers| headers.clone_from(response.headers()));
        let body = response.bytes().await?;
        answered.body = Some(&body);
        CONTRACT.check(&sent, &answered);
        Ok(read.body(body.clone()).unwrap().into())
    }
}
