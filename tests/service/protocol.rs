//! The transcript in the description of the stream protocol, replayed.

use std::collections::BTreeMap;

use crate::harness::service::Service;
use crate::harness::waiting::within;
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

const PAGE: &str = include_str!("../../src/stream/protocol.md");

/// Strings such as `$session` stand for whatever came first in their place.
#[derive(Default)]
struct Placeholders(BTreeMap<String, String>);

impl Placeholders {
    /// Gives `told` with what is known filled in, and what is not taken from `came`.
    fn fill(&mut self, told: &Value, came: &Value) -> Value {
        match told {
            Value::String(name) if name.starts_with('$') => {
                if let Some(text) = came.as_str() {
                    self.0.entry(name.clone()).or_insert_with(|| text.to_owned());
                }
                self.0.get(name).map_or(Value::Null, |text| json!(text))
            }
            Value::Object(members) => {
                let filled = members.iter().map(|(name, told)| (name.clone(), self.fill(told, &came[name])));
                Value::Object(filled.collect())
            }
            other => other.clone(),
        }
    }
}

#[tokio::test]
async fn the_transcript_of_the_protocol_happens_as_written() {
    let service = Service::start(&[]).await;
    let corridor = json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "forward", "cost": 1}],
        "dynamics": {
            "kind": "table", "states": [[0], [1], [2], [3]], "start": 0,
            "transitions": [[0, "forward", 1], [1, "forward", 2], [2, "forward", 3]],
        },
    });
    assert_eq!(service.put("/v1/models/corridor", &corridor).await.0, 201);
    let connect = async || {
        let (socket, _) =
            tokio_tungstenite::connect_async(format!("ws://{}/v1/stream", service.address)).await.unwrap();
        socket
    };
    let transcript = PAGE.split("```text\n").nth(1).unwrap().split("```").next().unwrap();
    let mut placeholders = Placeholders::default();
    let mut socket = connect().await;
    let mut n_frames = 0;
    for line in transcript.lines() {
        let (mark, rest) = line.split_once(' ').unwrap();
        match mark {
            ">" => {
                let frame = placeholders.fill(&serde_json::from_str(rest).unwrap(), &Value::Null);
                socket.send(Message::text(frame.to_string())).await.unwrap();
            }
            "<" => {
                let message = within("a message", socket.next()).await.unwrap().unwrap();
                let came: Value = serde_json::from_str(message.to_text().unwrap()).unwrap();
                let told = placeholders.fill(&serde_json::from_str(rest).unwrap(), &came);
                assert_eq!(came, told, "after {n_frames} frames");
            }
            _ => match rest.strip_prefix("closed with ") {
                None => socket = connect().await,
                Some(code) => {
                    let message = within("a message", socket.next()).await.unwrap().unwrap();
                    let Message::Close(Some(close)) = message else { panic!("{message:?}") };
                    assert_eq!(u16::from(close.code).to_string(), code);
                }
            },
        }
        n_frames += 1;
    }
    assert!(n_frames > 20, "the transcript is there");
    assert_eq!(placeholders.0["$version"], env!("CARGO_PKG_VERSION"));
    let (status, _) = service.get(&format!("/v1/policies/{}", placeholders.0["$policy"])).await;
    assert_eq!(status, 200);
}
