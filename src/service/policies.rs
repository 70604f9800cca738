//! Policies: made, stored, read.

use serde_json::value::RawValue;
use tokio_util::bytes::Bytes;

use super::idempotency::{IdempotencyKey, Repeat};
use super::learners::LearnerState;
use super::requests::{DEMONSTRATION, Named, SentRequest, base_weights, check_request};
use super::search::{Extent, MAX_INLINE_BYTES, Means, Searched, follow, is_quick, max_quick_observations};
use super::{Caller, Etude, Kind, PoolError, ServiceError};
use crate::memory::Held;
use crate::store::{Deletion, KeyTaken, Links, Needed, NewRequestKey, Page, PolicyFilter};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Object};
use etude_core::interrupt::{Cancelled, Interrupt};
use etude_core::mapping::{Demonstration, RequestKind, Stamp};
use etude_core::model::Model;

/// A policy that was just made.
#[derive(Debug)]
pub struct MadePolicy {
    /// Under which it is stored; `None` if it is not to be.
    pub id: Option<String>,
    /// The policy: JSON.
    pub policy: String,
    /// For the policy, and as much again while it is written into an answer, if it is much.
    pub held: Option<Held>,
}

impl Etude {
    /// Makes a policy for the request in `body` (JSON), and stores it unless the request says otherwise.
    ///
    /// # Errors
    ///
    /// If the body is no request, names no model, or the service cannot do it now.
    pub async fn make_policy(&self, body: impl Into<Bytes>, caller: Caller) -> Result<MadePolicy, ServiceError> {
        self.make_keyed_policy(None, body.into(), caller).await?.map_err(|KeyTaken| PoolError::Busy.into())
    }

    /// As [`Self::make_policy`], once: the same body with the same key again gives the same policy for a day, as it was made, if it was
    /// stored.
    ///
    /// # Errors
    ///
    /// Likewise, and [`ServiceError::KeyReused`] if another body came with the key.
    pub async fn make_policy_once(
        &self,
        key: &IdempotencyKey,
        body: impl Into<Bytes>,
        caller: Caller,
    ) -> Result<MadePolicy, ServiceError> {
        let body = body.into();
        let id = match self.repeat("policies".to_owned(), key, &body, caller).await? {
            Repeat::First(first) => match self.make_keyed_policy(Some(&first.key), body, caller).await? {
                Ok(made) => return Ok(made),
                Err(KeyTaken) => self.made_meanwhile(&first.key).await?,
            },
            Repeat::Answered(id) => id,
        };
        let made = self.store.policy_within(&id, Links::AsMade, &self.memory).await?;
        let (policy, held) = made.ok_or_else(|| unknown(&id))?;
        Ok(MadePolicy { id: Some(id), policy, held })
    }

    /// Makes a policy, and stores it with the key of its request, if that has one.
    async fn make_keyed_policy(
        &self,
        key: Option<&NewRequestKey>,
        body: Bytes,
        caller: Caller,
    ) -> Result<Result<MadePolicy, KeyTaken>, ServiceError> {
        let id = self.ids.next().to_string();
        let stamp = Stamp { id: Some(id.clone()), ..Stamp::default() };
        let weights = |model: &Model, learner: Option<&LearnerState>, faults: &mut Faults| {
            base_weights(model, learner, faults).map(|weights| (weights, ()))
        };
        let searched = self.search(RequestKind::Policy, &body, stamp, caller, weights).await?;
        let Some((searched, ())) = searched else {
            let check =
                |object: &Object<'_, '_>, model: &Model, learner: Option<&LearnerState>, faults: &mut Faults| {
                    check_request(object, model, |faults| base_weights(model, learner, faults), faults);
                };
            return Err(Box::pin(self.explain(RequestKind::Policy, body, caller, check)).await);
        };
        // The next request can be read to where this one stands, while the disk writes.
        drop(body);
        let Searched { policy, row, refinement, held, .. } = searched;
        let Some(row) = row else { return Ok(Ok(MadePolicy { id: None, policy, held })) };
        let is_refined = refinement.is_some();
        let row = row.at(caller.now);
        match key {
            None => self.store.add_policies(vec![row], refinement.into_iter().collect()).await?,
            Some(key) => {
                if let Err(taken) = self.store.add_keyed_policy(key.clone(), row, refinement).await? {
                    return Ok(Err(taken));
                }
            }
        }
        if is_refined {
            self.refiner.wake();
        }
        Ok(Ok(MadePolicy { id: Some(id), policy, held }))
    }

    /// Searches for the policy that a request asks for, and stamps it. `weights` are those from which the request starts, and what is to
    /// be known of them; they are asked for only if nothing else is wrong. Nothing if something is wrong with the request: see
    /// [`Etude::explain`].
    pub(super) async fn search<T: Send + 'static>(
        &self,
        kind: RequestKind,
        body: &Bytes,
        stamp: Stamp,
        caller: Caller,
        weights: impl FnOnce(&Model, Option<&LearnerState>, &mut Faults) -> Option<(Weights, T)> + Send + 'static,
    ) -> Result<Option<(Searched, T)>, ServiceError> {
        let place = self.pool.admit_when_needed(caller.client);
        let Some(sent) = self.read_sent(kind, body, &place).await? else { return Ok(None) };
        let (names, faults) = self.read_names(&sent.rest, kind, None);
        let names = names.filter(|names| faults.is_empty() && names.own_faults.is_empty());
        let Some(names) = names else { return Ok(None) };
        let deadline = self.deadline(&names, caller.arrived);
        let place = place.waiting_until(deadline);
        let Some(named) = self.find_for(body, &names, &place, deadline).await? else { return Ok(None) };
        let stamp = names.stamp(stamp, &named);
        let model = named.mapper.model();
        let is_small = body.len() <= MAX_INLINE_BYTES;
        let demonstration = is_small.then(|| sent.demonstration(model, max_quick_observations(model))).flatten();
        let is_quick = demonstration.as_ref().is_some_and(|read| is_quick(model, &sent.rest, read.len()));
        let (memory, clock) = (self.memory.clone(), self.clock.clone());
        let extent = if is_quick { Extent::Quick } else { Extent::Any };
        let job = move |interrupt: &mut dyn Interrupt| {
            let means = Means { clock: &clock, memory: &memory, extent };
            search_sent(kind, &sent, demonstration, &named, weights, stamp, means, interrupt)
        };
        if is_quick { self.pool.run_here(deadline, job)? } else { place.run(deadline, job).await? }
    }

    /// The policy with this id (JSON), and the memory that it takes, if that is much.
    ///
    /// # Errors
    ///
    /// If there is none, or no memory for it.
    pub async fn policy(&self, id: &str) -> Result<(String, Option<Held>), ServiceError> {
        self.store.policy_within(id, Links::Now, &self.memory).await?.ok_or_else(|| unknown(id))
    }

    /// Deletes the policy with this id. What links it and others forgets it; if it waits to be refined, it does not any more.
    ///
    /// # Errors
    ///
    /// If there is none, or it is a trial's.
    pub async fn delete_policy(&self, id: &str) -> Result<(), ServiceError> {
        match self.store.delete_policy(id).await? {
            Ok(Deletion::Deleted) => Ok(()),
            Ok(Deletion::Unknown) => Err(unknown(id)),
            Err(Needed) => {
                let because = "it is the policy of a trial";
                Err(ServiceError::InUse { kind: Kind::Policy, id: id.to_owned(), because })
            }
        }
    }

    /// At most `limit` of the policies that are wanted, without their steps (JSON), in the order in which they were stored, from the first
    /// after the sequence number `after`.
    ///
    /// # Errors
    ///
    /// If the store failed.
    pub async fn policies(
        &self,
        filter: &PolicyFilter,
        after: i64,
        limit: u32,
    ) -> Result<Page<Box<RawValue>>, ServiceError> {
        let page = self.store.policies(filter, after, limit).await?;
        Ok(page.map(|policy| policy.summary))
    }
}

fn unknown(id: &str) -> ServiceError {
    ServiceError::Unknown { kind: Kind::Policy, name: id.to_owned(), pointer: None }
}

/// Reads the rest of a request, whose demonstration was read before if it is small, and searches for its policy. Nothing if something is
/// wrong with it.
#[expect(clippy::too_many_arguments, reason = "all of them are what one search is of")]
fn search_sent<T>(
    kind: RequestKind,
    sent: &SentRequest,
    demonstration: Option<Demonstration>,
    named: &Named,
    weights: impl FnOnce(&Model, Option<&LearnerState>, &mut Faults) -> Option<(Weights, T)>,
    stamp: Stamp,
    means: Means<'_>,
    interrupt: &mut dyn Interrupt,
) -> Result<Result<Option<(Searched, T)>, ServiceError>, Cancelled> {
    let Named { mapper, learner, .. } = named;
    let (demonstration, _held) = match demonstration {
        Some(demonstration) => (demonstration, None),
        None => match sent.counted_demonstration(mapper.model(), means.memory) {
            Ok(Some(read)) => read,
            Ok(None) => return Ok(Ok(None)),
            Err(error) => return Ok(Err(error)),
        },
    };
    let mut known = None;
    let weights = |faults: &mut Faults| {
        let (weights, of_weights) = weights(mapper.model(), learner.as_ref(), faults)?;
        known = Some(of_weights);
        Some(weights)
    };
    let request = sent.request(kind, demonstration, mapper.model(), weights);
    let Some((request, known)) = request.zip(known) else { return Ok(Ok(None)) };
    let searched = follow(mapper, request, (sent.observed(), &DEMONSTRATION), stamp, means, interrupt)?;
    Ok(searched.map(|searched| Some((searched, known))))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use jiff::Timestamp;
    use serde_json::{Value, json};
    use tokio_util::sync::CancellationToken;
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::client::Client;
    use crate::clock::Clock;
    use crate::memory::{Memory, SMALL_BYTES};
    use crate::service::{ModelText, Name, Settings};
    use crate::store::RequestKey;
    use etude_core::interrupt::Uninterrupted;
    use etude_core::mapping::Mapper;
    use etude_core::model::{Definition, Format, Limits};

    fn caller() -> Caller {
        Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Timestamp::UNIX_EPOCH }
    }

    /// A service that has `model`, called `m`.
    async fn etude(directory: &std::path::Path, model: &Value) -> Etude {
        let settings = Settings::of_test(directory);
        let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
        let text = ModelText::Whole(model.to_string().into_bytes());
        etude.put_model(&Name::new("m").unwrap(), text, Format::Json, caller()).await.unwrap();
        etude
    }

    /// A line of so many states, to whose end leads a policy of as many steps.
    fn line(n_states: usize) -> Value {
        let states: Vec<_> = (0..n_states).map(|state| json!([u8::from(state + 1 == n_states)])).collect();
        let transitions: Vec<_> = (1..n_states).map(|state| json!([state - 1, "on", state])).collect();
        json!({
            "attributes": [{"name": "end", "kind": "number", "weight": 1e9}], "actions": [{"name": "on", "cost": 0.3}],
            "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions},
        })
    }

    #[tokio::test]
    async fn a_policy_that_cannot_be_answered_is_not_stored() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path(), &line(1000)).await;
        let body = json!({"model": "m", "demonstration": [{}, {"end": 1}]}).to_string();
        let large = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
        let small: Vec<_> = std::iter::from_fn(|| etude.memory.try_take(SMALL_BYTES).ok()).collect();
        let refused = etude.make_policy(body.clone().into_bytes(), caller()).await;
        assert!(matches!(refused, Err(ServiceError::NoRoom(_))), "{refused:?}");
        assert_eq!(etude.policies(&PolicyFilter::default(), 0, 10).await.unwrap().items.len(), 0);
        drop((large, small));
        let free = etude.memory.free();
        let made = etude.make_policy(body.into_bytes(), caller()).await.unwrap();
        assert!(made.policy.len() > 64 << 10 && free - etude.memory.free() >= made.policy.len() as u64);
        drop(made);
        assert_eq!(etude.memory.free(), free);
    }

    /// The client of the first one went away, but what it has asked for was on its way to the disk.
    #[tokio::test]
    async fn a_policy_whose_key_was_taken_while_it_was_searched_for_is_not_stored() {
        let directory = tempfile::tempdir().unwrap();
        let etude = etude(directory.path(), &line(3)).await;
        let body = Bytes::from(json!({"model": "m", "demonstration": [{"end": 1}]}).to_string());
        let key = IdempotencyKey::new(b"k").unwrap();
        let first = etude.make_policy_once(&key, body.clone(), caller()).await.unwrap();
        let Repeat::First(other) = etude.repeat("other".to_owned(), &key, &body, caller()).await.unwrap() else {
            panic!("it is of another scope")
        };
        let taken =
            NewRequestKey { key: RequestKey { scope: "policies".to_owned(), ..other.key.key.clone() }, ..other.key };
        let late = etude.make_keyed_policy(Some(&taken), body, caller()).await.unwrap();
        assert_eq!(late.unwrap_err(), KeyTaken);
        assert_eq!(etude.policies(&PolicyFilter::default(), 0, 10).await.unwrap().items.len(), 1);
        assert_eq!(Some(etude.made_meanwhile(&taken).await.unwrap()), first.id);
    }

    #[test]
    fn what_is_to_be_refined_is_counted() {
        let model = json!({
            "attributes": [{"name": "x", "kind": "number"}, {"name": "door", "kind": "category"}],
            "actions": [{"name": "on"}, {"name": "back"}],
            "dynamics": {
                "kind": "table", "states": (0..9).map(|x| json!([x, "open"])).collect::<Vec<_>>(),
                "transitions": (1..9).flat_map(|x| [json!([x - 1, "on", x]), json!([x, "back", x - 1])]).collect::<Vec<_>>(),
            },
        });
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap());
        let document = json!({
            "model": "m", "lookahead": 1, "deadline_ms": 1000,
            "demonstration": (0..100).map(|n| json!({"x": n % 4 * 2, "door": "x".repeat(1000)})).collect::<Vec<_>>(),
        });
        let memory = Memory::with_room(1 << 30);
        let sent = SentRequest::read(RequestKind::Policy, &document.to_string().into(), &memory).unwrap().unwrap();
        let named = Named { learner: None, model_hash: "hash".to_owned(), mapper };
        let stamp = Stamp { id: Some("p".to_owned()), model: "m".to_owned(), ..Stamp::default() };
        let weights = |model: &Model, learner: Option<&LearnerState>, faults: &mut Faults| {
            Some((base_weights(model, learner, faults)?, ()))
        };
        let means = Means { clock: &Clock::system(), memory: &memory, extent: Extent::Any };
        let searched = search_sent(RequestKind::Policy, &sent, None, &named, weights, stamp, means, &mut Uninterrupted);
        let (searched, ()) = searched.unwrap().unwrap().unwrap();
        let request = searched.refinement.unwrap().request;
        assert!(searched.policy.len() < 64 << 10 && searched.held.unwrap().n_bytes() > 100_000);
        let policy: Value = serde_json::from_str(&searched.policy).unwrap();
        let written: Value = serde_json::from_str(&request).unwrap();
        let expected = json!({
            "model": "m", "demonstration": document["demonstration"], "weights": {"x": 1.0, "door": 1.0},
            "cost": policy["cost"]["total"],
        });
        assert_eq!(written, expected);
    }
}
