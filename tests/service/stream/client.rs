//! A client of streams over websockets.

use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use super::slow_readers::narrow;
use crate::harness::contract::CONTRACT;
use crate::harness::service::Service;
use crate::harness::waiting::within;

/// A websocket client, whose frames and those that it receives are held against the contract.
pub(crate) struct Client {
    pub(crate) socket: WebSocketStream<TcpStream>,
    /// The frames without an answer yet, by type, and what is wrong with each by its schema: such a one must be refused.
    pub(crate) unanswered: Vec<(Value, Option<String>)>,
}

impl Client {
    /// Connects, and takes the server's hello.
    pub(crate) async fn connect(service: &Service) -> Self {
        Self::connect_to(&service.address.to_string()).await
    }

    pub(crate) async fn connect_to(address: &str) -> Self {
        Self::over(TcpStream::connect(address).await.unwrap(), address).await
    }

    /// A client that soon has no room for what it does not read.
    pub(crate) async fn connect_narrowly(service: &Service) -> Self {
        Self::over(narrow(service).await, &service.address.to_string()).await
    }

    pub(crate) async fn over(stream: TcpStream, address: &str) -> Self {
        let mut request = format!("ws://{address}/v1/stream").into_client_request().unwrap();
        request.headers_mut().insert("sec-websocket-protocol", "etude.v1+json".parse().unwrap());
        // As many clients do, it closes where a message is longer than announced.
        let config = WebSocketConfig::default().max_message_size(Some(262_144));
        let (socket, response) =
            tokio_tungstenite::client_async_with_config(request, stream, Some(config)).await.unwrap();
        assert_eq!(response.headers()["sec-websocket-protocol"], "etude.v1+json");
        let mut client = Self { socket, unanswered: Vec::new() };
        let hello = client.receive().await;
        assert_eq!((&hello["type"], &hello["protocol"]), (&json!("hello"), &json!("etude.v1+json")));
        assert_eq!(
            (&hello["limits"]["frame_bytes"], &hello["limits"]["observations"]),
            (&json!(262_144), &json!(100_000))
        );
        client
    }

    pub(crate) async fn send(&mut self, frame: Value) {
        self.unanswered.push((frame["type"].clone(), CONTRACT.broken_by("ClientFrame", &frame)));
        self.socket.send(Message::text(frame.to_string())).await.unwrap();
    }

    pub(crate) async fn next(&mut self) -> Message {
        within("a message", self.socket.next()).await.unwrap().unwrap()
    }

    pub(crate) async fn receive(&mut self) -> Value {
        let message = self.next().await;
        let frame: Value = serde_json::from_str(message.to_text().unwrap_or_else(|_| panic!("{message:?}"))).unwrap();
        CONTRACT.check_frame(&frame);
        self.note_answer(&frame);
        frame
    }

    /// Notes which frame this one answers.
    fn note_answer(&mut self, answer: &Value) {
        let answered: &[&str] = match answer["type"].as_str().unwrap() {
            "opened" => &["open", "resume"],
            "received" => &["observe"],
            "done" => &["end"],
            "rewarded" => &["reward"],
            "error" => {
                let refused = self.unanswered.iter().position(|(_, broken)| broken.is_some()).unwrap_or(0);
                if refused < self.unanswered.len() {
                    self.unanswered.remove(refused);
                }
                return;
            }
            _ => return,
        };
        let is_answered = |(kind, _): &(Value, _)| answered.iter().any(|answered| kind == answered);
        if let Some(position) = self.unanswered.iter().position(is_answered) {
            let (_, broken) = self.unanswered.remove(position);
            assert_eq!(broken, None, "{answer} answers a frame that is not valid");
        }
    }

    /// Receives frames up to one of type `kind`, which comes last.
    pub(crate) async fn receive_until(&mut self, kind: &str) -> Vec<Value> {
        let mut frames = Vec::new();
        loop {
            let frame = self.receive().await;
            let is_last = frame["type"] == kind;
            assert!(is_last || frame["type"] != "error", "{frame}");
            frames.push(frame);
            if is_last {
                return frames;
            }
        }
    }

    /// Receives frames up to an error, which it gives.
    pub(crate) async fn receive_until_error(&mut self) -> Value {
        loop {
            let frame = self.receive().await;
            if frame["type"] == "error" {
                return frame;
            }
        }
    }

    /// Receives the close code.
    pub(crate) async fn closed(&mut self) -> u16 {
        loop {
            match self.next().await {
                Message::Close(frame) => return frame.unwrap().code.into(),
                Message::Text(text) => assert!(!text.contains("\"error\""), "{text}"),
                _ => {}
            }
        }
    }

    /// Opens a session and gives its id.
    pub(crate) async fn open(&mut self, open: Value) -> String {
        self.send(open).await;
        let opened = self.receive().await;
        assert_eq!((&opened["type"], &opened["received"]), (&json!("opened"), &json!(0)), "{opened}");
        opened["session"].as_str().unwrap().to_owned()
    }
}
