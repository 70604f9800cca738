//! Spawns the whole application on a free port, with a database of its own.

use std::net::SocketAddr;
use std::path::Path;

use clap::Parser;
use etude::config::ServeConfig;
use etude::server::Server;
use reqwest::{Method, Response};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use crate::harness::client::Client;
use crate::harness::waiting::{LIMIT, until, within};

#[derive(Parser)]
struct Flags {
    #[command(flatten)]
    config: ServeConfig,
}

/// The settings that `flags` give, with defaults for the others.
pub(crate) fn flags(flags: &[&str]) -> ServeConfig {
    Flags::parse_from(["etude"].iter().chain(flags)).config
}

/// A running service.
pub(crate) struct Service {
    pub(crate) address: SocketAddr,
    pub(crate) client: Client,
    pub(crate) directory: TempDir,
    stop: oneshot::Sender<()>,
    running: JoinHandle<()>,
}

impl Service {
    /// Starts a service with the default settings, but for `flags`.
    pub(crate) async fn start(flags: &[&str]) -> Self {
        Self::start_in(tempfile::tempdir().unwrap(), flags).await
    }

    /// Starts a service whose database is in `directory`.
    pub(crate) async fn start_in(directory: TempDir, flags: &[&str]) -> Self {
        Self::start_set_up(directory, flags, |_| {}).await
    }

    /// Starts a service with `flags`, and with settings that no flag gives.
    pub(crate) async fn start_set_up(
        directory: TempDir,
        flags: &[&str],
        set_up: impl FnOnce(&mut ServeConfig),
    ) -> Self {
        let database = directory.path().join("etude.db");
        let own = ["etude", "--listen", "127.0.0.1:0", "--database", database.to_str().unwrap()];
        let Flags { mut config } = Flags::parse_from(own.iter().chain(flags));
        set_up(&mut config);
        let server = Server::start(&config).await.unwrap();
        let address = server.address();
        let (stop, stopped) = oneshot::channel::<()>();
        let running = tokio::spawn(async move {
            server.run(async { drop(stopped.await) }).await;
        });
        let client = Client::of(reqwest::Client::builder().no_proxy().timeout(LIMIT).build().unwrap());
        Self { address, client, directory, stop, running }
    }

    /// Stops the service and waits for its end. Gives the directory of its database back.
    pub(crate) async fn stop(self) -> TempDir {
        drop(self.client);
        drop(self.stop);
        within("the end of the service", self.running).await.unwrap();
        self.directory
    }

    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    /// Sends a request with a JSON body, or with none if it is null.
    pub(crate) async fn send(&self, method: Method, path: &str, body: &Value) -> Response {
        let request = self.client.request(method, self.url(path));
        let request = if body.is_null() { request } else { request.json(body) };
        request.send().await.unwrap()
    }

    pub(crate) async fn get(&self, path: &str) -> (u16, Value) {
        answer(self.send(Method::GET, path, &Value::Null).await).await
    }

    pub(crate) async fn put(&self, path: &str, body: &Value) -> (u16, Value) {
        answer(self.send(Method::PUT, path, body).await).await
    }

    pub(crate) async fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        answer(self.send(Method::POST, path, body).await).await
    }

    pub(crate) async fn delete(&self, path: &str) -> (u16, Value) {
        answer(self.send(Method::DELETE, path, &Value::Null).await).await
    }

    /// A measurement of `/metrics`, without labels; 0 if it was not made yet.
    pub(crate) async fn measurement(&self, name: &str) -> f64 {
        let text = self.client.get(self.url("/metrics")).send().await.unwrap().text().await.unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.map_or(0.0, |value| value.parse().unwrap())
    }

    /// Reads a policy until it is refined, and gives the one that refines it.
    pub(crate) async fn refined(&self, policy_id: &str) -> Value {
        let path = format!("/v1/policies/{policy_id}");
        let refined_by = async || self.get(&path).await.1["refined_by"].as_str().map(str::to_owned);
        let refined_by = until("a refinement", refined_by).await;
        self.get(&format!("/v1/policies/{refined_by}")).await.1
    }

    /// Reads a resource until its status is `status`, and gives it.
    pub(crate) async fn until_status(&self, path: &str, status: &str) -> Value {
        let has_status = async || Some(self.get(path).await.1).filter(|found| found["status"] == status);
        until(&format!("{path} with status {status}"), has_status).await
    }

    /// Waits until something is searched.
    pub(crate) async fn until_searching(&self) {
        let is_searching = async || (self.measurement("etude_search_jobs").await >= 1.0).then_some(());
        until("the begin of a search", is_searching).await;
    }

    /// Waits until nothing is searched any more.
    pub(crate) async fn until_idle(&self) {
        let is_idle = async || (self.measurement("etude_search_jobs").await == 0.0).then_some(());
        until("the end of all searches", is_idle).await;
    }
}

/// Status and body of an answer; a body that is not JSON is given as a string.
pub(crate) async fn answer(response: Response) -> (u16, Value) {
    let status = response.status().as_u16();
    let text = response.text().await.unwrap();
    (status, serde_json::from_str(&text).unwrap_or(Value::String(text)))
}

/// A model of a long way from end to end, of which nothing is observed but the ends: policies of many large steps.
pub(crate) fn long_way() -> Value {
    let n = 60;
    let attribute = |n: usize| json!({"name": format!("{n:0>64}"), "kind": "number", "weight": 1e6});
    let end = |state: usize| if state == 0 { 1 } else { u32::from(state == n - 1) * 2 };
    let way = (1..n).flat_map(|state| [json!([state - 1, "on", state]), json!([state, "back", state - 1])]);
    json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(),
        "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}],
        "dynamics": {
            "kind": "table",
            "states": (0..n).map(|state| vec![end(state); 256]).collect::<Vec<_>>(),
            "transitions": way.collect::<Vec<_>>(),
            "start": 0,
        },
    })
}

/// So many observations of somebody who goes the [long way](long_way) to and fro, two each.
pub(crate) fn to_and_fro(n_observations: usize) -> Vec<Value> {
    let name = format!("{:0>64}", 0);
    let seen = [json!({&name: 1}), json!({}), json!({&name: 2}), json!({})];
    seen.into_iter().cycle().take(n_observations).collect()
}

/// A document of the examples.
pub(crate) fn example(path: &str) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples").join(path);
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}
