//! A client of the stream protocol, over NDJSON both ways.

use std::convert::Infallible;

use reqwest::{Body, Client, Response};
use serde_json::Value;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use crate::cli::{CliError, client as http};

/// Frames that wait to be sent. The server takes no more than it can handle, so more would only wait longer.
const MAX_WAITING: usize = 16;

/// The sending half of a stream. The request ends when it is dropped.
pub(in crate::cli) struct Frames {
    lines: mpsc::Sender<Result<String, Infallible>>,
}

impl Frames {
    /// Sends a frame, waiting for room. Says whether anybody listens still.
    pub(in crate::cli) async fn send(&self, frame: &Value) -> bool {
        self.lines.send(Ok(format!("{frame}\n"))).await.is_ok()
    }
}

/// The receiving half of a stream.
pub(in crate::cli) struct Answers {
    url: String,
    response: Response,
    buffer: Vec<u8>,
}

impl Answers {
    /// The next frame; `None` when the server has ended the stream. Nothing is lost if this is dropped while it waits.
    pub(in crate::cli) async fn receive(&mut self) -> Result<Option<String>, CliError> {
        loop {
            if let Some(end) = self.buffer.iter().position(|byte| *byte == b'\n') {
                let line: Vec<u8> = self.buffer.drain(..=end).collect();
                return Ok(Some(String::from_utf8_lossy(line.trim_ascii()).into_owned()));
            }
            let chunk = self.response.chunk().await;
            let Some(chunk) = chunk.map_err(|source| http::failed(&self.url, source))? else {
                return Ok(None);
            };
            self.buffer.extend_from_slice(&chunk);
        }
    }
}

/// Opens a stream to the service at `server`. The first answer is its `hello`.
pub(in crate::cli) async fn connect(client: &Client, server: &str) -> Result<(Frames, Answers), CliError> {
    let url = format!("{server}/v1/stream");
    let (lines, body) = mpsc::channel(MAX_WAITING);
    let request = client.post(&url).header("content-type", "application/x-ndjson");
    let sent = request.body(Body::wrap_stream(ReceiverStream::new(body))).send().await;
    let response = sent.map_err(|source| http::failed(&url, source))?;
    if !response.status().is_success() {
        return Err(http::refused(&url, response).await);
    }
    Ok((Frames { lines }, Answers { url, response, buffer: Vec::new() }))
}
