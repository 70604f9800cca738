use serde_json::json;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::*;
use crate::client::Client;
use crate::clock::Clock;
use crate::service::{ModelText, Settings};
use crate::store::Store;
use etude_core::model::Format;

#[tokio::test]
async fn a_trial_whose_number_another_server_has_taken_is_drawn_with_the_next() {
    let directory = tempfile::tempdir().unwrap();
    let (settings, tasks) = (Settings::of_test(directory.path()), TaskTracker::new());
    let etude = Etude::open(&settings, &tasks, CancellationToken::new()).await.unwrap();
    let (arrived, now) = (Clock::system().instant(), Timestamp::UNIX_EPOCH);
    let caller = || Caller { client: Client::LOCAL, arrived, now };
    let name = Name::new("n").unwrap();
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [],
        "dynamics": {"kind": "table", "states": [[0]], "transitions": []},
    });
    let text = ModelText::Whole(model.to_string().into_bytes());
    etude.put_model(&name, text, Format::Json, caller()).await.unwrap();
    etude.put_learner(&name, br#"{"attributes": ["x"]}"#, now).await.unwrap();
    let body = || json!({"model": "n", "demonstration": [{"x": 1}]}).to_string();
    let first = etude.make_trial(&name, body(), caller()).await.unwrap();
    assert_eq!(first.trial.number, 1);

    let sequence = etude.learner_row(&name).await.unwrap().sequence;
    let other = Store::open(&directory.path().join("etude.db"), &tasks).await.unwrap();
    let taken = |number: u64| NewTrial {
        id: format!("t{number}"),
        learner: sequence,
        number,
        weights: "{}".to_owned(),
        weights_version: 0,
        policy_id: format!("p{number}"),
        policy: None,
        refinement: None,
        key: None,
        created_at: now,
        lease_expires_at: now,
    };
    for number in [2, 3] {
        assert_eq!(other.open_trial(taken(number)).await.unwrap(), Opened::Yes);
    }
    let next = etude.make_trial(&name, body(), caller()).await.unwrap();
    assert_eq!(next.trial.number, 4);
    assert_eq!(other.open_trial(taken(5)).await.unwrap(), Opened::Yes);
    let open = json!({"type": "open", "model": "n", "learner": "n", "explore": true});
    let session = etude.open_session(&open, caller()).await.unwrap();
    let explored = etude.trial(session.trial_id().unwrap(), now).await.unwrap();
    assert_eq!(explored.trial.number, 6);
}
