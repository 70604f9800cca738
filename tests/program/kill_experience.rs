//! Batches of experience that clients were told count, and those that they were not, whenever the program is killed.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::harness::client::Client;
use crate::harness::process::Process;
use crate::harness::waiting::within;
use serde_json::{Value, json};
use tokio::sync::{Mutex, Notify};

const FLAGS: [&str; 2] = ["--listen", "127.0.0.1:0"];

/// A way that is taken once a batch, and in other batches costs something else; and so much besides that what was counted is stored from time
/// to time.
fn batch(n: usize) -> Value {
    let cost = u32::try_from(n * n % 1009).unwrap();
    let mut transitions = vec![
        json!({"state": [0], "action": "on", "next": [1], "cost": cost}),
        json!({"state": [n + 1], "action": "on", "next": [n + 2], "count": 1 + n % 3}),
    ];
    transitions.resize(800, json!({"state": [0], "action": "wait", "next": [0]}));
    json!({"batch": format!("b{n}"), "transitions": transitions})
}

/// What clients know when the service is gone.
#[derive(Default)]
struct Known {
    /// Answers by batch.
    answered: Mutex<BTreeMap<usize, Value>>,
    /// The batch that nobody has begun to send.
    next: AtomicUsize,
    n_answered: AtomicUsize,
    changed: Notify,
}

/// Sends batches, each twice, and what was not answered before; until the service is gone.
async fn work(
    client: Client,
    url: String,
    known: Arc<Known>,
    unanswered: &mut Option<usize>,
) -> Result<(), reqwest::Error> {
    loop {
        let n = *unanswered.get_or_insert_with(|| known.next.fetch_add(1, Ordering::Relaxed));
        for _ in 0..2 {
            let answer = client.post(&url).json(&batch(n)).send().await?;
            assert_eq!(answer.status(), 200);
            let answer: Value = answer.json().await?;
            let before = known.answered.lock().await.insert(n, answer.clone());
            assert!(before.is_none_or(|before| before == answer), "{answer}");
        }
        *unanswered = None;
        known.n_answered.fetch_add(1, Ordering::Relaxed);
        known.changed.notify_one();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_batch_counts_once_after_thirty_kills() {
    const N_KILLS: usize = 30;
    const N_CLIENTS: usize = 4;
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let client = Client::new();
    let known = Arc::new(Known::default());
    let mut unanswered = vec![None; N_CLIENTS];
    // Any numbers will do, as long as they differ.
    let mut random = 54_321_u64;
    for kill in 0..N_KILLS {
        let process = Process::start_with(&FLAGS, &database);
        let model = format!("http://{}/v1/models/m", process.address);
        if kill == 0 {
            let definition = json!({
                "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on"}, {"name": "wait"}], "dynamics": {"kind": "experience", "start": [[0]]},
            });
            assert_eq!(client.put(&model).json(&definition).send().await.unwrap().status(), 201);
        }
        let before = known.n_answered.load(Ordering::Relaxed);
        let working: Vec<_> = unanswered
            .into_iter()
            .map(|mut unanswered| {
                let (client, url, known) = (client.clone(), format!("{model}/experience"), Arc::clone(&known));
                tokio::spawn(async move {
                    let end = work(client, url, known, &mut unanswered).await;
                    (end, unanswered)
                })
            })
            .collect();
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let enough = usize::try_from(random >> 61).unwrap();
        let answered = async {
            while known.n_answered.load(Ordering::Relaxed) <= before + enough {
                known.changed.notified().await;
            }
        };
        within("answered batches", answered).await;
        process.kill();
        unanswered = Vec::new();
        for client in working {
            let (end, left) = client.await.unwrap();
            assert!(end.is_err(), "the service is gone");
            unanswered.push(left);
        }
    }

    let process = Process::start_with(&FLAGS, &database);
    let base = format!("http://{}/v1", process.address);
    // What was not answered is sent once more, whether it was stored or not.
    let n_batches = known.next.load(Ordering::Relaxed);
    let mut answered = known.answered.lock().await;
    assert!(answered.len() >= N_KILLS);
    for n in 0..n_batches {
        let sent = client.post(format!("{base}/models/m/experience")).json(&batch(n)).send().await.unwrap();
        assert_eq!(sent.status(), 200);
        let answer: Value = sent.json().await.unwrap();
        let before = answered.insert(n, answer.clone());
        assert!(before.is_none_or(|before| before == answer), "batch {n}: {answer}");
    }
    let model: Value = client.get(format!("{base}/models/m")).send().await.unwrap().json().await.unwrap();
    let mut hashes: Vec<&str> = answered.values().map(|answer| answer["hash"].as_str().unwrap()).collect();
    assert!(hashes.contains(&model["hash"].as_str().unwrap()));
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), n_batches, "each has made a revision");
    // The mean tells whether each was counted, and how often.
    let request = json!({
        "model": "m", "demonstration": [{"x": 0}, {"x": 1}], "weights": {"x": 1e9}, "extra_weight": 0, "without": [], "store": false,
    });
    let policy: Value =
        client.post(format!("{base}/policies")).json(&request).send().await.unwrap().json().await.unwrap();
    let costs: Vec<f64> = (0..n_batches).map(|n| batch(n)["transitions"][0]["cost"].as_f64().unwrap()).collect();
    let mean = costs.iter().sum::<f64>() / f64::from(u32::try_from(n_batches).unwrap());
    assert_eq!(policy["steps"][1]["action_cost"].as_f64().unwrap().to_bits(), mean.to_bits(), "{policy}");
    process.kill();
    let stored = sqlx::SqlitePool::connect(database.to_str().unwrap()).await.unwrap();
    let counted: Option<i64> = sqlx::query_scalar("SELECT max(seq) FROM tallies").fetch_one(&stored).await.unwrap();
    assert!(counted.is_some_and(|counted| counted > 0), "what was counted was stored");
}
