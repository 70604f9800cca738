use jiff::Timestamp;
use serde_json::json;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::*;
use crate::client::Client;
use crate::memory::UNCOUNTED_BYTES;
use crate::service::{PoolSettings, Settings};
use etude_core::document::ParseError;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Limits};

/// A model of 256 attributes and one state.
fn wide() -> Mapper {
    let attribute = |n: usize| json!({"name": format!("{n}"), "kind": "number"});
    let model = json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    });
    let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    Mapper::new(model, &mut Uninterrupted).unwrap()
}

fn sent(body: String, memory: &Memory) -> Result<Option<SentRequest>, ServiceError> {
    SentRequest::read(RequestKind::Policy, &body.into(), memory)
}

#[test]
fn a_demonstration_that_takes_long_to_answer_is_not_read_where_it_arrives() {
    let (wide, memory) = (wide(), Memory::with_room(1 << 30));
    let most = max_quick_observations(wide.model());
    let is_read = |len: usize| {
        let body = format!(r#"{{"demonstration": [{}], "model": "a"}}"#, vec!["{}"; len].join(","));
        sent(body, &memory).unwrap().unwrap().demonstration(wide.model(), most).is_some()
    };
    assert!(most > 5 && is_read(most) && !is_read(most + 1));
    let n_bytes = most * Demonstration::bytes_of(wide.model().schema(), 1);
    assert!(n_bytes as u64 <= UNCOUNTED_BYTES, "{n_bytes}");
}

#[test]
fn a_demonstration_that_takes_much_memory_is_not_read_without() {
    let wide = wide();
    let body = format!(r#"{{"demonstration": [{}], "model": "a"}}"#, vec!["{}"; 5000].join(","));
    let values = (5000 * 256 * size_of::<Option<etude_core::attribute::Value>>()) as u64;
    let memory = Memory::with_room(1 << 30);
    let sent = sent(body, &memory).unwrap().unwrap();
    let (demonstration, held) = sent.counted_demonstration(wide.model(), &memory).unwrap().unwrap();
    assert!(demonstration.len() == 5000 && (values..values * 5 / 4).contains(&held.unwrap().n_bytes()));
    assert!(sent.counted_demonstration(wide.model(), &Memory::with_room(values)).is_err());
}

#[test]
fn what_a_request_says_besides_its_demonstration_is_counted() {
    let body = |n: usize| {
        let weights: Vec<_> = (0..n).map(|n| format!(r#"{{"{n}":0}}"#)).collect();
        format!(r#"{{"demonstration": [{{}}], "model": "a", "weights": [{}]}}"#, weights.join(","))
    };
    let taken = |n: usize| {
        let memory = Memory::with_room(1 << 30);
        let _sent = sent(body(n), &memory).unwrap().unwrap();
        (1 << 30) - memory.free()
    };
    assert!(taken(100) == 0 && taken(5000) > 5000 * 600);
    assert!(sent(body(5000), &Memory::with_room(1 << 20)).is_err());
}

#[tokio::test]
async fn a_small_body_that_becomes_much_is_counted() {
    let pool = crate::service::SearchPool::new(
        PoolSettings { n_threads: 1, max_waiting: 1, max_long: 1 },
        crate::clock::Clock::system(),
        TaskTracker::new(),
        CancellationToken::new(),
    );
    let (place, memory) = (pool.admit_when_needed(Client::LOCAL), Memory::with_room(1 << 30));
    let blank = vec![b' '; MAX_UNCOUNTED_TEXT_BYTES - 4].into_iter().chain(*b"null").collect::<Vec<_>>();
    let (_, held) = parse(blank.into(), &place, &memory).await.unwrap();
    assert!(held.is_none());
    let body = format!("[{}]", vec![r#"{"":0}"#; 5000].join(","));
    let (_, held) = parse(body.clone().into(), &place, &memory).await.unwrap();
    assert!(body.len() < MAX_INLINE_BYTES && held.unwrap().n_bytes() > 5000 * 600);
    assert!(parse(body.into(), &place, &Memory::with_room(1 << 20)).await.is_err());
}

/// As long as a body is not JSON, nobody can rely on what it names.
#[tokio::test]
async fn a_body_that_is_not_json_is_told_so_whatever_it_names() {
    let directory = tempfile::tempdir().unwrap();
    let settings = Settings::of_test(directory.path());
    let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
    let caller = Caller { client: Client::LOCAL, arrived: etude.clock.instant(), now: Timestamp::UNIX_EPOCH };
    let blanks = " ".repeat(MAX_INLINE_BYTES);
    for (states, is_json) in
        [("{x}", false), ("01", false), ("[1,2}", false), (&*format!("{blanks}{{x}}"), false), ("{}", true)]
    {
        let policy = format!(r#"{{"model":"none","demonstration":[{states}]}}"#);
        let batch = format!(r#"{{"model":"none","items":[{{"demonstration":[{states}]}}]}}"#);
        for error in [
            etude.make_policy(policy, caller).await.unwrap_err(),
            etude.make_policies(batch, caller).await.unwrap_err(),
        ] {
            let is_told = match error {
                ServiceError::Parse(ParseError::Syntax { .. }) => !is_json,
                ServiceError::Unknown { .. } => is_json,
                _ => false,
            };
            assert!(is_told, "{states}: {error:?}");
        }
    }
}
