//! What clients were told is there, whenever the program is killed.

use std::collections::BTreeMap;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::harness::client::Client;
use crate::harness::process::Process;
use crate::harness::service::example;
use crate::harness::waiting::within;
use serde_json::{Value, json};
use tokio::sync::{Mutex, Notify};

const FLAGS: [&str; 4] = ["--listen", "127.0.0.1:0", "--learn-every", "3ms"];

/// What clients know when the service is gone.
#[derive(Default)]
struct Known {
    /// Acknowledged rewards by trial.
    acknowledged: Mutex<BTreeMap<String, f64>>,
    n_acknowledged: AtomicUsize,
    changed: Notify,
}

/// Draws trials and rewards them, until the service is gone.
async fn work(client: Client, base: String, request: Arc<Value>, known: Arc<Known>) -> Result<(), reqwest::Error> {
    loop {
        let trials = client.post(format!("{base}/v1/learners/gold/trials")).json(&*request).send().await?;
        let trial: Value = trials.json().await?;
        let id = trial["id"].as_str().unwrap().to_owned();
        let reward = trial["weights"]["gold"].as_f64().unwrap() * 100.0 - 50.0;
        for _ in 0..2 {
            let sent = client.put(format!("{base}/v1/trials/{id}/reward")).json(&json!({"reward": reward}));
            let answer = sent.send().await?;
            assert_eq!(answer.status(), 200);
            answer.bytes().await?;
            known.acknowledged.lock().await.insert(id.clone(), reward);
        }
        known.n_acknowledged.fetch_add(1, Ordering::Relaxed);
        known.changed.notify_one();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_acknowledged_reward_is_there_once_after_a_hundred_kills() {
    const N_KILLS: usize = 100;
    const N_CLIENTS: usize = 6;
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let client = Client::new();
    let demonstration = example("figure-6/demonstration.json");
    let request = Arc::new(json!({"model": "figure-6", "demonstration": demonstration}));
    let known = Arc::new(Known::default());
    // Any numbers will do, as long as they differ.
    let mut random = 12_345_u64;
    for kill in 0..N_KILLS {
        let process = Process::start_with(&FLAGS, &database);
        let base = format!("http://{}", process.address);
        if kill == 0 {
            let put = async |path: &str, body: Value| {
                let sent = client.put(format!("{base}{path}")).json(&body).send().await.unwrap();
                assert_eq!(sent.status(), 201);
            };
            put("/v1/models/figure-6", example("figure-6/model.json")).await;
            put("/v1/learners/gold", json!({"attributes": ["x", "y", "heading", "gold", "arrows"]})).await;
        }
        let before = known.n_acknowledged.load(Ordering::Relaxed);
        let working: Vec<_> = (0..N_CLIENTS)
            .map(|_| tokio::spawn(work(client.clone(), base.clone(), request.clone(), known.clone())))
            .collect();
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let enough = usize::try_from(random >> 60).unwrap();
        let acknowledged = async {
            while known.n_acknowledged.load(Ordering::Relaxed) <= before + enough {
                known.changed.notified().await;
            }
        };
        within("acknowledged rewards", acknowledged).await;
        process.kill();
        for client in working {
            assert!(client.await.unwrap().is_err(), "the service is gone");
        }
    }

    let process = Process::start_with(&FLAGS, &database);
    let mut stored = BTreeMap::new();
    let mut orders = Vec::new();
    let mut query = "?limit=1000".to_owned();
    loop {
        let url = format!("http://{}/v1/learners/gold/trials{query}", process.address);
        let page: Value = client.get(url).send().await.unwrap().json().await.unwrap();
        for trial in page["items"].as_array().unwrap().iter().filter(|trial| trial["reward"].is_number()) {
            orders.push(trial["reward_order"].as_u64().unwrap());
            stored.insert(trial["id"].as_str().unwrap().to_owned(), trial["reward"].as_f64().unwrap());
        }
        let Some(next) = page["next"].as_str() else { break };
        query = format!("?limit=1000&after={next}");
    }
    process.kill();
    let acknowledged = known.acknowledged.lock().await;
    assert!(acknowledged.len() > N_KILLS);
    for (trial, reward) in &*acknowledged {
        assert_eq!(stored.get(trial), Some(reward), "trial {trial}");
    }
    orders.sort_unstable();
    assert_eq!(orders, (1..=stored.len() as u64).collect::<Vec<_>>());
    let mut replay = Command::new(env!("CARGO_BIN_EXE_etude"));
    let replayed = replay.args(["learner", "replay", "gold", "--database"]).arg(&database).output().unwrap();
    assert!(replayed.status.success(), "{}", String::from_utf8_lossy(&replayed.stderr));
}
