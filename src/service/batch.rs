//! Batches: many demonstrations against one model, across the threads of the pool.
//!
//! ```text
//! body --> shared options, checked once --> items that wait --slice--> thread --+--> policies, problems --> store: one transaction
//!                                                  ^                            |
//!                                                  +---- lines up again --------+    (as many at a time as the pool has threads)
//! ```
//!
//! A batch takes one place in the pool, whatever its size, and gives its threads back after every slice: a request that
//! comes meanwhile waits for a slice, not for the batch.

mod answer;
mod item;

use std::fmt;
use std::iter::Enumerate;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures_util::future::try_join_all;
use serde::de::{Deserializer, Error as _, SeqAccess, Visitor};
use serde_json::Value;
use serde_json::value::RawValue;
use tokio_util::bytes::Bytes;

use answer::Answer;
use item::{Item, ReadItem};

use super::learners::LearnerState;
use super::requests::{Named, Names, SentRequest, base_weights, most_demonstration_bytes, n_observations};
use super::search::{Extent, Means, Searched, follow, take_for_demonstration};
use super::{Caller, Etude, MadePolicy, ServiceError};
use crate::clock::{Clock, Ids};
use crate::memory::{Held, Memory};
use etude_core::attribute::Weights;
use etude_core::document::{self, Faults, Object, Path, Place};
use etude_core::interrupt::{Cancelled, Interrupt};
use etude_core::mapping::{Demonstration, Mapper, Options, Policy, Request, RequestKind, Stamp};
use etude_core::model::Model;

/// Most items of a batch: as large a data set as most, while an answer full of short policies stays at some ten megabytes.
pub const MAX_BATCH_ITEMS: usize = 10_000;

/// How long a batch keeps a thread before it lines up behind those who wait for one. Long beside the change of threads that it
/// costs, short beside what a client notices.
const SLICE: Duration = Duration::from_millis(5);

/// What became of a batch.
#[derive(Debug)]
pub struct MadePolicies {
    /// For each item, in order, its policy or what is wrong with it.
    pub items: Vec<Result<MadePolicy, ServiceError>>,
    /// For the policies, and as much again while they are put together, if they are much.
    pub held: Option<Held>,
}

impl Etude {
    /// Makes a policy for every item of the batch in `body` (JSON), and stores them all at once, unless the batch says otherwise. Gives for each item, in order, its policy
    /// or what is wrong with it.
    ///
    /// # Errors
    ///
    /// If the body is no batch, names no model, or the service cannot do it now; then nothing is stored.
    pub async fn make_policies(&self, body: impl Into<Bytes>, caller: Caller) -> Result<MadePolicies, ServiceError> {
        let body = body.into();
        match self.follow_batch(&body, caller).await? {
            Some(made) => Ok(made),
            None => Err(Box::pin(self.explain(RequestKind::Batch, body, caller, check_batch)).await),
        }
    }

    /// Nothing if something is wrong with the batch itself.
    async fn follow_batch(&self, body: &Bytes, caller: Caller) -> Result<Option<MadePolicies>, ServiceError> {
        let place = self.pool.admit(caller.client)?;
        let Some(sent) = self.read_sent(RequestKind::Batch, body, &place).await? else { return Ok(None) };
        let (names, faults) = self.read_names(&sent.rest, RequestKind::Batch, None);
        let names = names.filter(|names| faults.is_empty() && names.own_faults.is_empty());
        let Some(names) = names else { return Ok(None) };
        let deadline = self.deadline(&names, caller.arrived);
        let place = place.waiting_until(deadline);
        let Some(named) = self.find_for(body, &names, &place, deadline).await? else { return Ok(None) };
        let means = (self.memory.clone(), self.clock.clone(), self.ids.clone());
        let read = move |_: &mut dyn Interrupt| Ok(Batch::read(&sent, &names, named, means));
        let Some(batch) = place.run(None, read).await?? else { return Ok(None) };
        let batch = Arc::new(batch);
        let runners = (0..self.n_search_threads).map(|_| async {
            let mut made = Vec::new();
            loop {
                let batch = Arc::clone(&batch);
                let slice = place.run(deadline, move |interrupt| batch.run_slice(interrupt)).await?;
                if slice.is_empty() {
                    return Ok::<_, ServiceError>(made);
                }
                made.extend(slice);
            }
        });
        let mut made: Vec<_> = try_join_all(runners).await?.into_iter().flatten().collect();
        made.sort_unstable_by_key(|(n, _)| *n);
        // The disk is no concern of those who wait for a thread.
        drop(place);

        let (mut rows, mut refinements) = (Vec::new(), Vec::new());
        let mut items = Vec::with_capacity(made.len());
        for (_, searched) in made {
            items.push(searched.map(|Searched { policy, row, refinement, .. }| {
                let row = row.map(|row| row.at(caller.now));
                let id = row.as_ref().map(|row| row.id.clone());
                rows.extend(row);
                refinements.extend(refinement);
                MadePolicy { id, policy, held: None }
            }));
        }
        let are_refined = !refinements.is_empty();
        if !rows.is_empty() {
            self.store.add_policies(rows, refinements).await?;
        }
        if are_refined {
            self.refiner.wake();
        }
        // Once they are stored, they are answered, whatever else is told.
        let is_any_made = items.iter().any(Result::is_ok);
        let held = batch.answer().held.take().or_else(|| self.memory.try_take(0).ok().filter(|_| is_any_made));
        Ok(Some(MadePolicies { items, held }))
    }
}

/// The texts of the items of a batch, of which there must not be too many.
fn item_texts(items: &str) -> Option<Vec<&str>> {
    struct Texts;
    impl<'de> Visitor<'de> for Texts {
        type Value = Vec<&'de str>;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("an array of items")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
            let mut texts = Vec::new();
            while let Some(item) = items.next_element::<&RawValue>()? {
                texts.push(item.get());
                if texts.len() > MAX_BATCH_ITEMS {
                    return Err(A::Error::custom("too many items"));
                }
            }
            Ok(texts)
        }
    }
    serde_json::Deserializer::from_str(items).deserialize_seq(Texts).ok().filter(|texts| !texts.is_empty())
}

/// A batch that was checked, but for its items.
#[derive(Debug)]
struct Batch {
    mapper: Arc<Mapper>,
    /// What the policies have in common.
    stamp: Stamp,
    /// Whether they are stored.
    is_stored: bool,
    /// What an item's own weights are written over.
    weights: Weights,
    /// What an item has unless it has its own.
    shared: Options,
    memory: Memory,
    clock: Clock,
    ids: Ids,
    /// For what waits.
    _sent_held: Option<Held>,
    /// What the answer takes.
    answer: Mutex<Answer>,
    /// The items that wait, with their places in the batch.
    waiting: Mutex<Enumerate<std::vec::IntoIter<Item>>>,
}

/// What became of an item, and its place in the batch.
type Outcome = (usize, Result<Searched, ServiceError>);

impl Batch {
    /// Reads a batch against its model: what its items share, and their demonstrations. Nothing if something is wrong with the batch
    /// itself.
    fn read(
        sent: &SentRequest,
        names: &Names,
        named: Named,
        (memory, clock, ids): (Memory, Clock, Ids),
    ) -> Result<Option<Self>, ServiceError> {
        let model = named.mapper.model();
        let mut faults = Faults::default();
        let object = Place::root(&sent.rest).object(RequestKind::Batch.fields(), &mut faults);
        let shared = object.and_then(|object| read_shared(&object, model, named.learner.as_ref(), &mut faults));
        let shared = shared.filter(|_| faults.is_empty());
        let Some(((weights, shared), texts)) = shared.zip(item_texts(sent.observed())) else { return Ok(None) };
        let mut held = None;
        let most_bytes = most_demonstration_bytes(model, sent.observed());
        // Where all demonstrations have no room together, they are read one by one, once it is their turn.
        let have_room = memory.reserve(&mut held, most_bytes).is_ok();
        let most_bytes = if have_room { most_bytes } else { document::parsed_bytes(sent.observed().as_bytes()) };
        memory.reserve(&mut held, most_bytes)?;
        let (mut items, mut n_bytes) = (Vec::with_capacity(texts.len()), 0);
        let (mut n_left, mut n_values) = (Policy::max_observations(model), 0);
        for text in texts {
            let item = if have_room {
                Item::read(
                    sent,
                    text,
                    (model, &shared, items.len()),
                    n_left.min(Demonstration::MAX_OBSERVATIONS),
                    n_values,
                )
            } else {
                Item::parse(text, &shared, items.len())
            };
            let Some(item) = item else { return Ok(None) };
            // What is told of too many observations is told of the batch.
            let Some(left) = n_left.checked_sub(item.n_observations()) else { return Ok(None) };
            n_left = left;
            // Most are about as long as the one before.
            n_values = item.n_observations() * model.schema().len();
            n_bytes += item.size_bytes();
            memory.reserve(&mut held, most_bytes + n_bytes)?;
            items.push(item);
        }
        if let Some(held) = &mut held {
            held.shrink_to(n_bytes as u64);
        }
        let stamp = names.stamp(Stamp::default(), &named);
        let answer = Mutex::new(Answer::default());
        let waiting = Mutex::new(items.into_iter().enumerate());
        Ok(Some(Self {
            _sent_held: held,
            mapper: named.mapper,
            stamp,
            is_stored: names.is_stored,
            weights,
            shared,
            memory,
            clock,
            ids,
            answer,
            waiting,
        }))
    }

    /// Follows items that wait, one after the other, until a slice is over. Nothing if none waits any more.
    fn run_slice(&self, interrupt: &mut dyn Interrupt) -> Result<Vec<Outcome>, Cancelled> {
        let started = self.clock.instant();
        let mut slice = Vec::new();
        while slice.is_empty() || self.clock.elapsed(started) < SLICE {
            let next = self.waiting.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some((n, item)) = next else { break };
            let searched =
                if self.answer().is_full { Err(ServiceError::BatchFull) } else { self.follow(n, item, interrupt)? };
            let taken_in = self.answer().take_in(searched, &self.memory);
            // With less in it, the next batch may have room for it.
            let taken_in = taken_in.map_err(|error| match error {
                ServiceError::NoRoom(_) => ServiceError::BatchFull,
                error => error,
            });
            slice.push((n, taken_in));
        }
        Ok(slice)
    }

    fn answer(&self) -> MutexGuard<'_, Answer> {
        self.answer.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Follows the item at `n`.
    fn follow(
        &self,
        n: usize,
        item: Item,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Result<Searched, ServiceError>, Cancelled> {
        let items = Path::Member(&Path::Root, "items");
        let path = Path::Item(&items, n);
        let demonstration_path = Path::Member(&path, "demonstration");
        let Item { document, read, mut faults } = item;
        let is_observed = faults.is_empty();
        let (model, place) = (self.mapper.model(), Place { value: &document, path });
        let Some(object) = place.object(RequestKind::Item.fields(), &mut faults) else { return Ok(Err(faults.into())) };
        let weights = |_: &mut Faults| Some(self.weights.clone());
        let (demonstration, observed, _held) = if let Some(ReadItem { demonstration, observed }) = read {
            (Some(demonstration), Some(observed), None)
        } else {
            let held = match take_for_demonstration(model, n_observations(&document), &self.memory) {
                Ok(held) => held,
                Err(no_room) => return Ok(Err(no_room.into())),
            };
            let demonstration = is_observed.then(|| Request::read_demonstration(model, &object, &mut faults));
            (demonstration.flatten(), None, held)
        };
        let request = Request::of(demonstration, model, &object, &self.shared, weights, &mut faults);
        let request = match faults.check(request) {
            Ok(request) => request,
            Err(faults) => return Ok(Err(faults.into())),
        };
        let id = self.is_stored.then(|| self.ids.next().to_string());
        let stamp = Stamp { id, ..self.stamp.clone() };
        let observed = match observed {
            Some(observed) => observed,
            // To be refined, it is stored as text.
            None if request.lookahead.is_some() => document["demonstration"].to_string().into(),
            None => Bytes::new(),
        };
        let observed = (std::str::from_utf8(&observed).unwrap_or_default(), &demonstration_path);
        let means = Means { clock: &self.clock, memory: &self.memory, extent: Extent::Any };
        follow(&self.mapper, request, observed, stamp, means, interrupt)
    }
}

/// Notes what is wrong with a batch, but for its items.
fn check_batch(object: &Object<'_, '_>, model: &Model, learner: Option<&LearnerState>, faults: &mut Faults) {
    if let Some(place) = object.required("items", faults)
        && let Some(items) = place.array(faults)
    {
        check_items(model, items, &place, faults);
    }
    read_shared(object, model, learner, faults);
}

/// Notes that there are too many items, or that their policies would be too large together.
fn check_items(model: &Model, items: &[Value], place: &Place<'_, '_>, faults: &mut Faults) {
    if !(1..=MAX_BATCH_ITEMS).contains(&items.len()) {
        faults.note(place, format!("expected 1 to {MAX_BATCH_ITEMS} items, found {}", items.len()));
        return;
    }
    let n_observations = items.iter().map(n_observations).sum();
    if !Policy::check_size(model, n_observations, place, &mut Faults::default()) {
        let detail = format!(
            "the policies of {n_observations} observations together would be larger than that of a single demonstration may \
             be: send fewer items at a time"
        );
        faults.note(place, detail);
    }
}

/// Reads what the items share: the weights, and the other options.
fn read_shared(
    object: &Object<'_, '_>,
    model: &Model,
    learner: Option<&LearnerState>,
    faults: &mut Faults,
) -> Option<(Weights, Options)> {
    let options = Options::read(object, model, &Options::default(), faults);
    Options::check_model(model, object, faults);
    let base = base_weights(model, learner, faults)?;
    let options = options?;
    Some((options.weights_over(base), Options { weights: Vec::new(), ..options }))
}

#[cfg(test)]
mod tests;
