//! Batches: many demonstrations against one model, across the threads of the pool.
//!
//! ```text
//! body --> shared options, checked once --> items that wait --slice--> thread --+--> policies, problems --> store: one transaction
//!                                                  ^                            |
//!                                                  +---- lines up again --------+    (as many at a time as the pool has threads)
//! ```
//!
//! A batch of well-formed items is read in one pass (`outline`), any other as a document: what comes of an item is the same.
//!
//! A batch takes one place in the pool, whatever its size, and gives its threads back after every slice: a request that
//! comes meanwhile waits for a slice, not for the batch.

use std::collections::BTreeMap;
use std::iter::Enumerate;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::future::try_join_all;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::ToSchema;
use uuid::Uuid;

use super::outline::{AtHand, BatchOutline};
use super::policies::{
    Envelope, Extent, MAX_INLINE_BYTES, Named, Searched, base_weights, follow, parse, take_for_demonstration,
};
use super::{Admission, Caller, Etude, MadePolicy, ServiceError};
use crate::memory::{Held, Memory};
use etude_core::attribute::Weights;
use etude_core::document::{self, Faults, Object, Path, Place};
use etude_core::interrupt::{Cancelled, Interrupt};
use etude_core::mapping::{
    Conditions, Demonstration, HeuristicName, Mapper, ObservationDocument, Policy, Request, Stamp, StartReference,
};
use etude_core::model::{Model, Origin};

/// Most items of a batch: as large a data set as most, while an answer full of short policies stays at some ten megabytes.
pub const MAX_BATCH_ITEMS: usize = 10_000;

/// Most bytes of all policies of a batch: as many as the states of a single one may take. Items beyond that are told to be sent again.
const MAX_ANSWER_BYTES: usize = 64 << 20;

/// How long a batch keeps a thread before it lines up behind those who wait for one. Long beside the change of threads that it
/// costs, short beside what a client notices.
const SLICE: Duration = Duration::from_millis(5);

/// Every field of a batch.
const BATCH_FIELDS: [&str; 9] =
    ["model", "items", "weights", "learner", "lookahead", "start", "heuristic", "max_expansions", "deadline_ms"];

/// Every field of an item.
const ITEM_FIELDS: [&str; 6] = ["demonstration", "weights", "lookahead", "start", "heuristic", "max_expansions"];

/// Options that an item has from its batch unless it has its own; weights are shared attribute by attribute.
const SHARED_OPTIONS: [&str; 4] = ["lookahead", "start", "heuristic", "max_expansions"];

/// What became of a batch.
#[derive(Debug)]
pub struct MadePolicies {
    /// For each item, in order, its policy or what is wrong with it.
    pub items: Vec<Result<MadePolicy, ServiceError>>,
    /// For the policies, and as much again while they are put together, if they are much.
    pub held: Option<Held>,
}

impl Etude {
    /// Makes a policy for every item of the batch in `body` (JSON, cheap to clone), and stores them all at once. Gives for each item,
    /// in order, its policy or what is wrong with it.
    ///
    /// # Errors
    ///
    /// If the body is no batch, names no model, or the service cannot do it now; then nothing is stored.
    pub async fn make_policies(
        self: &Arc<Self>,
        body: impl AsRef<[u8]> + Clone + Send + 'static,
        caller: Caller,
    ) -> Result<MadePolicies, ServiceError> {
        let place = self.pool.admit(caller.client)?;
        let sent = self.read_batch(body.clone(), &place).await?;
        let (envelope, faults) = self.read_envelope(&sent.document, &BATCH_FIELDS, "items");
        let Some(envelope) = envelope else { return Err(faults.into()) };
        let deadline = self.deadline(&envelope, caller.arrived);
        let place = place.with_patience(deadline);
        let named = self.find(&envelope, faults, &place, deadline).await?;
        let sent = if sent.is_for(&named.mapper) {
            drop(body);
            sent
        } else {
            // Another model was given this name meanwhile.
            let (document, held) = parse(body, &place, &self.memory).await?;
            SentBatch { document, read: None, held }
        };
        let memory = self.memory.clone();
        let read = move |_: &mut dyn Interrupt| Ok(Batch::read(sent, envelope, named, memory));
        let batch = Arc::new(place.run(None, read).await??);
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
                let row = row.at(caller.now);
                let id = row.id.clone();
                rows.push(row);
                refinements.extend(refinement);
                MadePolicy { id, policy, held: None }
            }));
        }
        let are_refined = !refinements.is_empty();
        let is_any_stored = !rows.is_empty();
        if is_any_stored {
            self.store.add_policies(rows, refinements).await?;
        }
        if are_refined {
            self.refiner.wake();
        }
        // Once they are stored, they are answered, whatever else is told.
        let held = batch.answer().held.take().or_else(|| self.memory.try_take(0).ok().filter(|_| is_any_stored));
        Ok(MadePolicies { items, held })
    }

    /// Reads a batch, by its `place` in the pool if it is large.
    async fn read_batch(
        self: &Arc<Self>,
        body: impl AsRef<[u8]> + Send + 'static,
        place: &Admission,
    ) -> Result<SentBatch, ServiceError> {
        let etude = Arc::clone(self);
        let n_bytes = body.as_ref().len();
        let read = move || {
            let at_hand = |model: &str| etude.mapper_at_hand(model).map(|(_, mapper)| mapper);
            SentBatch::read(body.as_ref(), &at_hand, &etude.memory)
        };
        if n_bytes <= MAX_INLINE_BYTES { read() } else { place.run_reading(n_bytes, read).await? }
    }
}

/// A batch as it was sent.
struct SentBatch {
    /// With something else in place of the items, if they were read already.
    document: Value,
    /// The items that were read for a model.
    read: Option<(Arc<Mapper>, Vec<Item>)>,
    /// For both, if they are much.
    held: Option<Held>,
}

impl SentBatch {
    /// Reads a batch in one pass if that can be, else as a document. Items with a lookahead need documents: their requests are stored, to
    /// be refined.
    fn read(body: &[u8], at_hand: AtHand<'_>, memory: &Memory) -> Result<Self, ServiceError> {
        let outline = BatchOutline::read(body, at_hand, memory).filter(|BatchOutline { document, items, .. }| {
            document["lookahead"].is_null() && items.iter().all(|(item, _)| item["lookahead"].is_null())
        });
        let Some(BatchOutline { document, items, mapper, held }) = outline else {
            let held = memory.try_take(document::parsed_bytes(body) as u64)?;
            return Ok(Self { document: document::parse(body)?, read: None, held: Some(held) });
        };
        let as_item = |(document, demonstration)| Item { document, demonstration: Some(demonstration) };
        Ok(Self { document, read: Some((mapper, items.into_iter().map(as_item).collect())), held })
    }

    /// Whether it can be followed by this model.
    fn is_for(&self, mapper: &Arc<Mapper>) -> bool {
        self.read.as_ref().is_none_or(|(read_for, _)| Arc::ptr_eq(read_for, mapper))
    }
}

/// An item that waits.
#[derive(Debug)]
struct Item {
    document: Value,
    /// If it was read already; then the document has something else in its place.
    demonstration: Option<Demonstration>,
}

impl Item {
    fn n_observations(&self) -> usize {
        self.demonstration.as_ref().map_or_else(|| n_observations(&self.document), Demonstration::len)
    }
}

/// A batch that was checked, but for its items.
#[derive(Debug)]
struct Batch {
    mapper: Arc<Mapper>,
    /// What the policies have in common.
    stamp: Stamp,
    /// What an item's own weights are written over.
    weights: Weights,
    /// What an item has unless it has its own.
    options: Map<String, Value>,
    memory: Memory,
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
    /// Reads all but the items against the model.
    fn read(sent: SentBatch, envelope: Envelope, named: Named, memory: Memory) -> Result<Self, ServiceError> {
        let Envelope { model, over_limits: mut faults, .. } = envelope;
        let SentBatch { mut document, read, held } = sent;
        let Named { learner, model_hash, mapper } = named;
        let root = Place::root(&document);
        let object = root.object(&BATCH_FIELDS, &mut faults);
        let shared = object.and_then(|object| {
            let items = object.required("items", &mut faults);
            let items = items.and_then(|place| {
                let lengths: Vec<_> = match &read {
                    Some((_, items)) => items.iter().map(Item::n_observations).collect(),
                    None => place.array(&mut faults)?.iter().map(n_observations).collect(),
                };
                check_items(mapper.model(), &lengths, &place, &mut faults)
            });
            let shared = read_shared(
                mapper.model(),
                &object,
                |faults| base_weights(mapper.model(), learner.as_ref(), faults),
                &mut faults,
            );
            items.and(shared)
        });
        let (weights, options) = faults.check(shared)?;
        let items = match (read, document["items"].take()) {
            (Some((_, items)), _) => items,
            (None, Value::Array(items)) => {
                items.into_iter().map(|document| Item { document, demonstration: None }).collect()
            }
            (None, _) => Vec::new(),
        };
        let stamp = Stamp {
            model,
            model_hash,
            learner: learner.as_ref().map(|ready| ready.name.clone()),
            weights_version: learner.as_ref().map(|ready| ready.weights.version),
            ..Stamp::default()
        };
        let answer = Mutex::new(Answer { held: None, n_bytes: 0, n_other_bytes: 0, is_full: false });
        let waiting = Mutex::new(items.into_iter().enumerate());
        Ok(Self { _sent_held: held, mapper, stamp, weights, options, memory, answer, waiting })
    }

    /// Follows items that wait, one after the other, until a slice is over. Nothing if none waits any more.
    fn run_slice(&self, interrupt: &mut dyn Interrupt) -> Result<Vec<Outcome>, Cancelled> {
        let started = Instant::now();
        let mut slice = Vec::new();
        while slice.is_empty() || started.elapsed() < SLICE {
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
        let mut faults = Faults::default();
        let Item { document, demonstration } = item;
        if (Place { value: &document, path }).object(&ITEM_FIELDS, &mut faults).is_none() {
            return Ok(Err(faults.into()));
        }
        let document = self.as_single(document);
        let unread = if demonstration.is_none() { n_observations(&document) } else { 0 };
        let _demonstration_held = match take_for_demonstration(self.mapper.model(), unread, &self.memory) {
            Ok(held) => held,
            Err(no_room) => return Ok(Err(no_room.into())),
        };
        let request = document.as_object().and_then(|members| {
            let (model, object) = (self.mapper.model(), Object { members, path });
            let base = |_: &mut Faults| Some(self.weights.clone());
            match demonstration {
                // It is not too long, as all of them together are not.
                Some(read) => Request::read_beside(Some(read), model, &object, base, &mut faults),
                None => Request::read_over(model, &object, base, &mut faults),
            }
        });
        let request = match faults.check(request) {
            Ok(request) => request,
            Err(faults) => return Ok(Err(faults.into())),
        };
        let stamp = Stamp { id: Some(Uuid::now_v7().to_string()), ..self.stamp.clone() };
        let place = Path::Member(&path, "demonstration");
        follow(&self.mapper, request, (&document, &place), stamp, &self.memory, Extent::Any, interrupt)
    }

    /// The item as a request of its own.
    fn as_single(&self, mut item: Value) -> Value {
        item["model"] = self.stamp.model.clone().into();
        for (name, shared) in &self.options {
            if item[name].is_null() {
                item[name] = shared.clone();
            }
        }
        item
    }
}

/// What the answer to a batch takes.
#[derive(Debug)]
struct Answer {
    /// For the policies as they will be answered, as they will be stored, and as they are put together; for what is to be refined, and
    /// for what is wrong.
    held: Option<Held>,
    /// Of the policies.
    n_bytes: usize,
    /// For the rest.
    n_other_bytes: usize,
    is_full: bool,
}

impl Answer {
    /// Takes in what became of an item, if the answer has room for it.
    fn take_in(&mut self, searched: Result<Searched, ServiceError>, memory: &Memory) -> Result<Searched, ServiceError> {
        const N_COPIES: usize = 3;
        /// As it is told, and as it is put together.
        const PROBLEM_BYTES: usize = 1024;
        let (n_bytes, n_other_bytes) = match &searched {
            Ok(Searched { policy, refinement, .. }) => {
                (policy.len(), refinement.as_ref().map_or(0, |refinement| refinement.request.len()))
            }
            Err(ServiceError::Faults(faults)) => (0, PROBLEM_BYTES + N_COPIES * faults.size_bytes()),
            Err(_) => (0, PROBLEM_BYTES),
        };
        let (n_bytes, n_other_bytes) = (self.n_bytes + n_bytes, self.n_other_bytes + n_other_bytes);
        let no_room = memory.hold(&mut self.held, N_COPIES * n_bytes + n_other_bytes).is_err();
        self.is_full |= no_room || n_bytes > MAX_ANSWER_BYTES;
        match searched {
            Ok(searched) if !self.is_full => {
                (self.n_bytes, self.n_other_bytes) = (n_bytes, n_other_bytes);
                Ok(Searched { held: None, ..searched })
            }
            Err(error) if !no_room => {
                self.n_other_bytes = n_other_bytes;
                Err(error)
            }
            _ => Err(ServiceError::BatchFull),
        }
    }
}

/// How many observations an item has, as far as can be told without its faults.
fn n_observations(item: &Value) -> usize {
    item.get("demonstration").and_then(Value::as_array).map_or(0, Vec::len)
}

/// Checks how many items there are, and that their policies would not be too large together. `lengths` is how many observations each
/// of them has.
fn check_items(model: &Model, lengths: &[usize], place: &Place<'_, '_>, faults: &mut Faults) -> Option<()> {
    if !(1..=MAX_BATCH_ITEMS).contains(&lengths.len()) {
        faults.note(place, format!("expected 1 to {MAX_BATCH_ITEMS} items, found {}", lengths.len()));
        return None;
    }
    let n_observations = lengths.iter().sum();
    if !Policy::check_size(model, n_observations, place, &mut Faults::default()) {
        let detail = format!(
            "the policies of {n_observations} observations together would be larger than that of a single demonstration may \
             be: send fewer items at a time"
        );
        faults.note(place, detail);
        return None;
    }
    Some(())
}

/// Reads the options that the items share: the weights, and the others by name, in a form that is quick to read again.
fn read_shared(
    model: &Model,
    object: &Object<'_, '_>,
    base: impl FnOnce(&mut Faults) -> Option<Weights>,
    faults: &mut Faults,
) -> Option<(Weights, Map<String, Value>)> {
    let conditions = Conditions::read(model, object, faults);
    let options = Request::read_options(object, faults);
    Request::check_lookahead(model, object, faults);
    let base = base(faults)?;
    let (conditions, _) = (conditions?, options?);
    let mut shared = Map::new();
    for name in SHARED_OPTIONS {
        let value = match conditions.start {
            // Values would be looked up among all states, for every item.
            Some(Origin::State(start)) if name == "start" => Some(start.into()),
            _ => object.optional(name).map(|place| place.value.clone()),
        };
        shared.extend(value.map(|value| (name.to_owned(), value)));
    }
    Some((conditions.weights_over(base), shared))
}

/// A request for policies, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct BatchRequest {
    /// Name of the imitator's model.
    #[schema(example = "figure-4")]
    pub model: String,
    /// What is to be followed. With more observations together than a single policy may have, the batch is refused.
    #[schema(min_items = 1, max_items = 10_000)]
    pub items: Vec<BatchItemRequest>,
    /// Weights by attribute name, each at least 0; attributes not named keep the learner's or the model's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<BTreeMap<String, f64>>,
    /// Name of a learner whose mean weights are used, for attributes that no `weights` name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learner: Option<String>,
    /// As in a single request, for items without their own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1, maximum = 100_000)]
    pub lookahead: Option<u32>,
    /// As in a single request, for items without their own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartReference>,
    /// As in a single request, for items without their own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heuristic: Option<HeuristicName>,
    /// Most nodes to expand for an item without its own; then the best mapping found so far is answered, with `status`
    /// `bounded`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_expansions: Option<u64>,
    /// Most milliseconds for the whole batch, waiting included; items that are not done by then get the best mapping found,
    /// with `status` `bounded`, or `local` if they have a lookahead. At most a day.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(maximum = 86_400_000)]
    pub deadline_ms: Option<u64>,
}

/// An item of a batch: a demonstration, with options of its own where it needs them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct BatchItemRequest {
    /// The observed states, as in a single request.
    pub demonstration: Vec<ObservationDocument>,
    /// Weights by attribute name, each at least 0; attributes not named keep the batch's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<BTreeMap<String, f64>>,
    /// Instead of the batch's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1, maximum = 100_000)]
    pub lookahead: Option<u32>,
    /// Instead of the batch's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<StartReference>,
    /// Instead of the batch's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heuristic: Option<HeuristicName>,
    /// Instead of the batch's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_expansions: Option<u64>,
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use etude_core::interrupt::Uninterrupted;
    use etude_core::model::{Definition, Limits};

    const MODEL: &str = include_str!("../../examples/figure-4/model.json");
    const DEMONSTRATION: &str = include_str!("../../examples/figure-4/demonstration.json");

    fn mapper() -> Arc<Mapper> {
        let model = serde_json::from_str(MODEL).unwrap();
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap())
    }

    /// What comes of the items, but for ids and times, and whether they were read in one pass if the model is at hand.
    fn follow(text: &str, mapper: &Arc<Mapper>, is_at_hand: bool) -> (Vec<Result<Value, String>>, bool) {
        let at_hand = |model: &str| (is_at_hand && model == "figure-4").then(|| Arc::clone(mapper));
        let sent = SentBatch::read(text.as_bytes(), &at_hand, &Memory::with_room(1 << 30)).unwrap();
        let is_read = sent.read.is_some();
        let (envelope, _) = Envelope::read(&sent.document, &BATCH_FIELDS, "items");
        let Some(envelope) = envelope else { return (Vec::new(), is_read) };
        let named = Named { learner: None, model_hash: "hash".to_owned(), mapper: Arc::clone(mapper) };
        let batch = match Batch::read(sent, envelope, named, Memory::with_room(1 << 30)) {
            Ok(batch) => batch,
            Err(faults) => return (vec![Err(format!("{faults:?}"))], is_read),
        };
        let mut outcomes = Vec::new();
        loop {
            let slice = batch.run_slice(&mut Uninterrupted).unwrap();
            if slice.is_empty() {
                return (outcomes, is_read);
            }
            outcomes.extend(slice.into_iter().map(|(_, outcome)| match outcome {
                Ok(Searched { policy, .. }) => {
                    let mut policy: Value = serde_json::from_str(&policy).unwrap();
                    policy["id"] = Value::Null;
                    policy["search"]["elapsed_us"] = Value::Null;
                    Ok(policy)
                }
                Err(error) => Err(format!("{error:?}")),
            }));
        }
    }

    #[test]
    fn what_comes_of_an_item_does_not_depend_on_how_the_batch_was_read() {
        let mapper = mapper();
        let demonstration: Value = serde_json::from_str(DEMONSTRATION).unwrap();
        let good = json!({"demonstration": demonstration});
        let with = |name: &str, value: Value| {
            let mut item = good.clone();
            item[name] = value;
            item
        };
        let items = json!([
            good,
            with("weights", json!({"gold": 3, "x": 0})),
            with("weights", json!({"gold": -1, "mood": 1})),
            with("start", json!(7)),
            with("start", json!(100_000)),
            with("max_expansions", json!(5)),
            with("heuristic", json!("paper")),
            with("heuristic", json!("magic")),
            with("lookahead", Value::Null),
            with("model", json!("other")),
            {"demonstration": [demonstration[0]]},
        ]);
        let n_items = items.as_array().unwrap().len();
        let shared = r#""weights": {"x": 2}, "start": 3, "heuristic": "none""#;
        for options in [r#""deadline_ms": null"#, shared, r#""weights": {"mood": 1}"#, r#""speed": 1"#] {
            let model_first = format!(r#"{{"model": "figure-4", {options}, "items": {items}}}"#);
            let items_first = format!(r#"{{"items": {items}, {options}, "model": "figure-4"}}"#);
            let (expected, is_read) = follow(&model_first, &mapper, false);
            assert!(!is_read, "no model was at hand");
            assert!(expected.len() == n_items || expected.len() == 1);
            for text in [&model_first, &items_first] {
                assert_eq!(follow(text, &mapper, true), (expected.clone(), true), "{text}");
            }
        }
    }

    #[test]
    fn a_batch_with_anything_out_of_the_ordinary_is_read_as_a_document() {
        let mapper = mapper();
        let good = format!(r#"{{"demonstration": {DEMONSTRATION}}}"#);
        let lookahead = format!(r#"{{"demonstration": {DEMONSTRATION}, "lookahead": 2}}"#);
        for (items, options) in [
            (format!("[{good}, {{}}]"), ""),
            (format!("[{good}, 7]"), ""),
            (format!(r#"[{{"demonstration": [{{"speed": 1}}]}}, {good}]"#), ""),
            (format!("[{good}, {lookahead}]"), ""),
            (format!("[{good}]"), r#""lookahead": 2, "#),
            ("{}".to_owned(), ""),
        ] {
            let text = format!(r#"{{{options}"items": {items}, "model": "figure-4"}}"#);
            assert_eq!(follow(&text, &mapper, true), follow(&text, &mapper, false), "{text}");
        }
    }

    #[test]
    fn what_is_wrong_with_items_takes_memory_too() {
        let mapper = mapper();
        let item = format!(r#"{{"demonstration": [{}]}}"#, vec!["9"; 500].join(","));
        let text = format!(r#"{{"model": "figure-4", "items": [{}]}}"#, vec![item.as_str(); 100].join(","));
        let told = |room: u64| {
            let memory = Memory::with_room(room);
            let sent = SentBatch::read(text.as_bytes(), &|_| None, &Memory::with_room(1 << 30)).unwrap();
            let (envelope, _) = Envelope::read(&sent.document, &BATCH_FIELDS, "items");
            let named = Named { learner: None, model_hash: "hash".to_owned(), mapper: Arc::clone(&mapper) };
            let batch = Batch::read(sent, envelope.unwrap(), named, memory.clone()).unwrap();
            let mut n_told = 0;
            loop {
                let slice = batch.run_slice(&mut Uninterrupted).unwrap();
                if slice.is_empty() {
                    return (n_told, room - memory.free());
                }
                n_told += slice.iter().filter(|(_, outcome)| matches!(outcome, Err(ServiceError::Faults(_)))).count();
            }
        };
        let (n_told, taken) = told(1 << 30);
        assert!(n_told == 100 && taken > 100 * 500 * 200, "{n_told}, {taken}");
        let (n_told, taken) = told(taken / 2);
        assert!((10..60).contains(&n_told), "{n_told}, {taken}");
    }
}
