//! Policies as they are stored.

use crate::problems::{example, mapper, problem};
use etude::store::{NewPolicy, NewRefinement, PolicyClass, PolicyFilter, RefinementEnd, Store, pack_steps};
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Mapper, Policy, Request, Stamp, Status, WrittenPolicy};
use jiff::Timestamp;
use proptest::prelude::*;
use serde_json::{Value, json};
use tokio_util::task::TaskTracker;

/// A policy as it is answered, and as it is stored.
#[derive(Clone)]
struct Written {
    answer: String,
    summary: String,
    steps: Vec<u8>,
}

/// The policy that `request` gives, and what it is written as.
fn follow(mapper: &Mapper, request: &Value, stamp: &Stamp) -> (Policy, Written) {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    let read = Request::read(mapper.model(), &object, &mut faults);
    let request = faults.check(read).unwrap();
    let mapping = mapper.map(&request.problem, request.settings, &mut Uninterrupted).unwrap();
    let written = WrittenPolicy::new(stamp, &request.problem, &mapping).unwrap();
    let answer = written.answer(None).unwrap();
    let (summary, steps) = written.into_stored();
    let written = Written { answer, summary, steps: pack_steps(&steps).unwrap() };
    (Policy::new(stamp, &request.problem, &mapping).unwrap(), written)
}

fn stamp(id: &str) -> Stamp {
    Stamp { id: Some(id.to_owned()), model: r#""coverage":{"#.to_owned(), ..Stamp::default() }
}

fn figure_4(stamp: &Stamp) -> (Policy, Written) {
    follow(&mapper(&example("figure-4/model.json")), &example("figure-4/request.json"), stamp)
}

fn new(id: &str, Written { summary, steps, .. }: Written) -> NewPolicy {
    let class = PolicyClass { model: "m".to_owned(), learner: None, status: Status::Optimal };
    NewPolicy { id: id.to_owned(), class, summary, steps, created_at: Timestamp::UNIX_EPOCH }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_policy_is_read_as_it_was_answered(
        (model, mut request) in problem(),
        huge in any::<bool>(),
        max_expansions in prop::option::of(0..4_u64),
    ) {
        let mut model = model;
        if huge && model["attributes"][0]["kind"] == "number" {
            // Neither whole nor short.
            for state in model["dynamics"]["states"].as_array_mut().unwrap() {
                state[0] = json!(state[0].as_f64().unwrap() * 1e300 / 3.0);
            }
        }
        request["max_expansions"] = json!(max_expansions);
        let (policy, written) = follow(&mapper(&model), &request, &stamp("p"));
        prop_assert_eq!(&written.answer, &serde_json::to_string(&policy).unwrap());
        let mut summary = serde_json::to_value(&policy).unwrap();
        summary.as_object_mut().unwrap().retain(|member, _| member != "actions" && member != "steps");
        prop_assert_eq!(serde_json::from_str::<Value>(&written.summary).unwrap(), summary);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let answer = written.answer.clone();
        let stored = runtime.block_on(async {
            let directory = tempfile::tempdir().unwrap();
            let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
            store.add_policies(vec![new("p", written)], Vec::new()).await.unwrap();
            store.policy("p").await.unwrap().unwrap()
        });
        prop_assert_eq!(stored, answer);
    }
}

#[test]
fn a_policy_takes_a_fifth_of_what_is_answered_at_most() {
    let (_, Written { answer, summary, steps }) = figure_4(&stamp("p"));
    assert!(
        5 * (summary.len() + steps.len()) < answer.len(),
        "{} + {} of {}",
        summary.len(),
        steps.len(),
        answer.len()
    );
}

#[tokio::test]
async fn a_refined_policy_is_read_and_listed_with_its_link() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    let refinement = NewRefinement {
        policy_id: "p".to_owned(),
        model_hash: String::new(),
        session_id: None,
        request: "{}".to_owned(),
    };
    let (mut policy, written) = figure_4(&stamp("p"));
    store.add_policies(vec![new("p", written.clone())], vec![refinement]).await.unwrap();
    assert_eq!(store.policy("p").await.unwrap().unwrap(), written.answer);
    let (_, refined) = figure_4(&Stamp { refines: Some("p".to_owned()), ..stamp("q") });
    let answer = refined.answer.clone();
    let end = RefinementEnd { policy_id: "p".to_owned(), refined: Some(new("q", refined)) };
    store.end_refinement(end).await.unwrap();
    policy.refined_by = Some("q".to_owned());
    assert_eq!(store.policy("p").await.unwrap().unwrap(), serde_json::to_string(&policy).unwrap());
    assert_eq!(store.policy("q").await.unwrap().unwrap(), answer);
    let listed = store.policies(&PolicyFilter::default(), 0, 100).await.unwrap().items;
    let listed: Vec<Value> = listed.iter().map(|row| serde_json::from_str(row.summary.get()).unwrap()).collect();
    assert_eq!(listed.iter().map(|summary| &summary["id"]).collect::<Vec<_>>(), ["p", "q"]);
    assert_eq!(listed[0]["refined_by"], "q");
}

#[tokio::test]
async fn a_long_policy_is_read_as_it_was_answered() {
    let mut request = example("figure-4/request.json");
    let observations = request["demonstration"].as_array().unwrap();
    let there_and_back: Vec<Value> = observations.iter().chain(observations.iter().rev()).cloned().collect();
    request["demonstration"] = Value::Array(there_and_back.iter().cycle().take(3000).cloned().collect());
    let (policy, written) = follow(&mapper(&example("figure-4/model.json")), &request, &stamp("long"));
    assert_eq!(written.answer, serde_json::to_string(&policy).unwrap());
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    store.add_policies(vec![new("long", written)], Vec::new()).await.unwrap();
    assert_eq!(store.policy("long").await.unwrap().unwrap(), serde_json::to_string(&policy).unwrap());
}

#[tokio::test]
async fn policies_that_come_together_are_stored_together_and_one_that_cannot_be_spoils_no_other() {
    const N_POLICIES: usize = 200;
    let (_, written) = figure_4(&stamp("p"));
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
    store.add_policies(vec![new("100", written.clone())], Vec::new()).await.unwrap();
    let policies = (0..N_POLICIES).map(|n| store.add_policies(vec![new(&n.to_string(), written.clone())], Vec::new()));
    let added = futures_util::future::join_all(policies).await;
    let refused: Vec<_> = added.iter().enumerate().filter(|(_, added)| added.is_err()).map(|(n, _)| n).collect();
    assert_eq!(refused, [100], "its id is taken");
    let listed = store.policies(&PolicyFilter::default(), 0, 1000).await.unwrap().items;
    assert_eq!(listed.len(), N_POLICIES);
    for n in 0..N_POLICIES {
        assert_eq!(store.policy(&n.to_string()).await.unwrap().as_ref(), Some(&written.answer));
    }
}
