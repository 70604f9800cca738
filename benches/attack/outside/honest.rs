//! Clients who want something small, and wait for it.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use reqwest::{Client, Method, StatusCode};
use serde_json::{Value, json};
use tokio::net::TcpSocket;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::{self, Message};

use super::Failure;
use crate::worlds::World;

/// How long a client goes on trying.
const TIMEOUT: Duration = Duration::from_secs(30);

/// When it tries again where it is not told.
const PAUSE: Duration = Duration::from_secs(1);

/// Small models are registered under so many names in turn.
const N_MODELS: usize = 500;

/// More than the service waits for before it begins to read.
const UPLOAD_BYTES: usize = 1_200_000;

/// What is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Kind {
    /// Whether the service is ready.
    Ready,
    /// A policy of figure 4.
    Policy,
    /// A policy of a cave.
    Cave,
    /// A small model registered.
    PutModel,
    /// A small model read.
    GetModel,
    /// The newest policies.
    List,
    /// A trial of figure 4 and its reward.
    Trial,
    /// A stream of figure 4 over a websocket, from `open` to `done`.
    Stream,
    /// A small model registered by a large body.
    Upload,
}

impl Kind {
    pub(crate) const ALL: [Self; 9] = [
        Self::Ready,
        Self::Policy,
        Self::Cave,
        Self::PutModel,
        Self::GetModel,
        Self::List,
        Self::Trial,
        Self::Stream,
        Self::Upload,
    ];
}

/// Why an attempt gave nothing.
enum Missed {
    /// It may be tried again.
    Busy(Option<Duration>, String),
    /// It never will.
    Wrong(String),
}

/// Honest clients, all of one address.
pub(crate) struct Honest {
    client: Client,
    address: SocketAddr,
    from: Ipv4Addr,
    demonstration: Vec<Value>,
    cave: Value,
    /// How often a connection was refused or broke off.
    pub(crate) n_broken: AtomicU64,
    /// What they were told to come again for, and how often.
    pub(crate) told: Mutex<BTreeMap<(Kind, String), u64>>,
}

impl Honest {
    /// Registers the models and the learner that are asked for later.
    pub(crate) async fn prepare(address: SocketAddr, from: Ipv4Addr, cave: &World) -> Result<Self, Failure> {
        let client = Client::builder().no_proxy().local_address(IpAddr::from(from)).build()?;
        let demonstration = serde_json::from_str(include_str!("../../../examples/figure-4/demonstration.json"))?;
        let figure: Value = serde_json::from_str(include_str!("../../../examples/figure-4/model.json"))?;
        let request = json!({"model": "cave", "demonstration": cave.demonstration});
        let honest = Self {
            client,
            address,
            from,
            demonstration,
            cave: request,
            n_broken: AtomicU64::new(0),
            told: Mutex::default(),
        };
        let learner = json!({"attributes": ["x", "y", "heading", "gold", "arrows"], "sd": 3, "seed": 1});
        for (path, body) in [
            ("/v1/models/figure-4", &figure),
            ("/v1/models/cave", &cave.model),
            ("/v1/models/small-0", &small_model(0)),
            ("/v1/learners/gold", &learner),
        ] {
            let put = honest.send(Method::PUT, path, Some(body)).await;
            put.map_err(|(Missed::Busy(_, why) | Missed::Wrong(why))| format!("{path}: {why}"))?;
        }
        Ok(honest)
    }

    /// The `n`th wish. Tries until it is fulfilled, as often as it is told to come again; gives how often it was.
    ///
    /// # Errors
    ///
    /// What was answered at last, if it is not fulfilled in time or never will be.
    pub(crate) async fn ask(&self, kind: Kind, n: usize) -> Result<u32, String> {
        let mut n_retries = 0;
        let mut last = "no answer".to_owned();
        let asking = async {
            loop {
                match self.attempt(kind, n).await {
                    Ok(()) => return Ok(n_retries),
                    Err(Missed::Wrong(why)) => return Err(why),
                    Err(Missed::Busy(after, why)) => {
                        *self.told().entry((kind, shortened(&why))).or_default() += 1;
                        last = why;
                        sleep(after.unwrap_or(PAUSE)).await;
                        n_retries += 1;
                    }
                }
            }
        };
        let asked = timeout(TIMEOUT, asking).await;
        asked.unwrap_or_else(|_| Err(format!("in {} s, last: {last}", TIMEOUT.as_secs())))
    }

    pub(crate) fn told(&self) -> MutexGuard<'_, BTreeMap<(Kind, String), u64>> {
        self.told.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn attempt(&self, kind: Kind, n: usize) -> Result<(), Missed> {
        let answered = match kind {
            Kind::Ready => self.send(Method::GET, "/readyz", None).await,
            Kind::Policy => {
                let request = json!({"model": "figure-4", "demonstration": self.demonstration});
                self.send(Method::POST, "/v1/policies", Some(&request)).await
            }
            Kind::Cave => self.send(Method::POST, "/v1/policies", Some(&self.cave)).await,
            Kind::PutModel => {
                let n = n % N_MODELS;
                self.send(Method::PUT, &format!("/v1/models/small-{n}"), Some(&small_model(n))).await
            }
            Kind::GetModel => self.send(Method::GET, "/v1/models/small-0", None).await,
            Kind::List => self.send(Method::GET, "/v1/policies?limit=10", None).await,
            Kind::Trial => {
                let request = json!({"model": "figure-4", "demonstration": self.demonstration});
                let trial = self.send(Method::POST, "/v1/learners/gold/trials", Some(&request)).await?;
                let path = format!("/v1/trials/{}/reward", trial["id"].as_str().unwrap_or_default());
                self.send(Method::PUT, &path, Some(&json!({"reward": n % 1000}))).await
            }
            Kind::Stream => return self.stream().await,
            Kind::Upload => {
                let body = format!("{}{}", small_model(0), " ".repeat(UPLOAD_BYTES));
                self.send_body(Method::PUT, "/v1/models/small-0", Some(body)).await
            }
        };
        answered.map(drop)
    }

    async fn send(&self, method: Method, path: &str, body: Option<&Value>) -> Result<Value, Missed> {
        self.send_body(method, path, body.map(ToString::to_string)).await
    }

    async fn send_body(&self, method: Method, path: &str, body: Option<String>) -> Result<Value, Missed> {
        let mut request = self.client.request(method, format!("http://{}{path}", self.address));
        if let Some(body) = body {
            request = request.header("content-type", "application/json").body(body);
        }
        let answer = request.send().await.map_err(|error| self.broken(&error))?;
        let (status, after) = (answer.status(), answer.headers().get("retry-after"));
        let after = after.and_then(|after| after.to_str().ok()?.parse().ok()).map(Duration::from_secs);
        let text = answer.text().await.map_err(|error| self.broken(&error))?;
        match status {
            StatusCode::SERVICE_UNAVAILABLE | StatusCode::TOO_MANY_REQUESTS => Err(Missed::Busy(after, text)),
            // The probe's answers are no JSON.
            _ if status.is_success() => Ok(serde_json::from_str(&text).unwrap_or_default()),
            _ => Err(Missed::Wrong(format!("{status}: {text}"))),
        }
    }

    async fn stream(&self) -> Result<(), Missed> {
        let url = format!("ws://{}/v1/stream", self.address);
        let connecting = async {
            let socket = TcpSocket::new_v4()?;
            socket.bind((self.from, 0).into())?;
            let stream = socket.connect(self.address).await?;
            stream.set_nodelay(true)?;
            tokio_tungstenite::client_async(url, stream).await
        };
        let (mut socket, _) = connecting.await.map_err(|error| match error {
            tungstenite::Error::Http(answer) if answer.status() != StatusCode::SERVICE_UNAVAILABLE => {
                Missed::Wrong(answer.status().to_string())
            }
            error => self.broken(&error),
        })?;
        let n_observations = self.demonstration.len();
        let observing = self.demonstration.iter().enumerate();
        let frames = std::iter::once(json!({"type": "open", "model": "figure-4"}))
            .chain(observing.map(|(seq, state)| json!({"type": "observe", "seq": seq, "states": [state]})))
            .chain([json!({"type": "end", "seq": n_observations})]);
        for frame in frames {
            socket.send(Message::text(frame.to_string())).await.map_err(|error| self.broken(&error))?;
        }
        while let Some(message) = socket.next().await {
            let Message::Text(text) = message.map_err(|error| self.broken(&error))? else { continue };
            let frame: Value = serde_json::from_str(&text).unwrap_or_default();
            match (frame["type"].as_str(), frame["problem"]["type"].as_str()) {
                (Some("done"), _) => return Ok(()),
                (Some("error"), Some("/problems/overloaded")) => return Err(Missed::Busy(None, text.to_string())),
                (Some("error"), _) => return Err(Missed::Wrong(text.to_string())),
                _ => {}
            }
        }
        Err(self.broken(&tungstenite::Error::ConnectionClosed))
    }

    fn broken(&self, error: &(dyn std::error::Error + 'static)) -> Missed {
        self.n_broken.fetch_add(1, Ordering::Relaxed);
        let chain = std::iter::successors(Some(error), |error| error.source());
        Missed::Busy(None, chain.map(ToString::to_string).collect::<Vec<_>>().join(": "))
    }
}

/// What a problem says, without its numbers.
fn shortened(why: &str) -> String {
    let problem: Value = serde_json::from_str(why).unwrap_or_default();
    let detail = problem["detail"].as_str().or(problem["problem"]["detail"].as_str()).unwrap_or(why);
    detail.chars().filter(|character| !character.is_ascii_digit()).take(120).collect()
}

/// A corridor of four states, of whose kind there are many.
fn small_model(n: usize) -> Value {
    json!({
        "attributes": [{"name": "x", "kind": "number"}],
        "actions": [{"name": "forward", "cost": n}],
        "dynamics": {
            "kind": "table", "states": [[0], [1], [2], [3]], "start": 0,
            "transitions": [[0, "forward", 1], [1, "forward", 2], [2, "forward", 3]],
        },
    })
}
