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

use std::collections::BTreeMap;
use std::iter::Enumerate;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use futures_util::future::try_join_all;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use utoipa::ToSchema;
use uuid::Uuid;

use super::policies::{Envelope, Named, Searched, base_weights, follow, parse};
use super::{Etude, MadePolicy, ServiceError};
use crate::attribute::Weights;
use crate::document::{Faults, Object, Path, Place};
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::{Conditions, HeuristicName, Mapper, ObservationDocument, Policy, Request, Stamp, StartReference};
use crate::model::{Model, Origin};

/// Most items of a batch: as large a data set as most, while an answer full of short policies stays at some ten megabytes.
pub const MAX_BATCH_ITEMS: usize = 10_000;

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

impl Etude {
    /// Makes a policy for every item of the batch in `body` (JSON), and stores them all at once. The batch came at `arrived`,
    /// from which its deadline counts; `now` is the same moment on the calendar. Gives for each item, in order, its policy or
    /// what is wrong with it.
    ///
    /// # Errors
    ///
    /// If the body is no batch, names no model, or the service cannot do it now; then nothing is stored.
    pub async fn make_policies(
        &self,
        body: impl AsRef<[u8]> + Send + 'static,
        arrived: Instant,
        now: Timestamp,
    ) -> Result<Vec<Result<MadePolicy, ServiceError>>, ServiceError> {
        let place = self.pool.admit()?;
        let document = parse(body, &place).await?;
        let (envelope, faults) = Envelope::read(&document, &BATCH_FIELDS, "items");
        let Some(envelope) = envelope else { return Err(faults.into()) };
        let deadline = envelope.deadline(arrived);
        let place = place.with_patience(deadline);
        let named = self.find(&envelope, faults, &place).await?;
        let batch = place.run(None, move |_| Ok(Batch::read(document, envelope.model, named))).await??;

        let batch = Arc::new(batch);
        let runners = (0..self.pool.n_threads()).map(|_| async {
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
        let mut answer = Vec::with_capacity(made.len());
        for (_, searched) in made {
            answer.push(searched.map(|Searched { policy, row, refinement }| {
                let row = row.at(now);
                let id = row.id.clone();
                rows.push(row);
                refinements.extend(refinement);
                MadePolicy { id, policy }
            }));
        }
        let are_refined = !refinements.is_empty();
        if !rows.is_empty() {
            self.store.add_policies(rows, refinements).await?;
        }
        if are_refined {
            self.refiner.wake();
        }
        Ok(answer)
    }
}

/// A batch that was checked, but for its items.
struct Batch {
    mapper: Arc<Mapper>,
    /// What the policies have in common.
    stamp: Stamp,
    /// What an item's own weights are written over.
    weights: Weights,
    /// What an item has unless it has its own.
    options: Map<String, Value>,
    /// The items that wait, with their places in the batch.
    waiting: Mutex<Enumerate<std::vec::IntoIter<Value>>>,
}

/// What became of an item, and its place in the batch.
type Outcome = (usize, Result<Searched, ServiceError>);

impl Batch {
    /// Reads all but the items against the model.
    fn read(mut document: Value, model: String, named: Named) -> Result<Self, Faults> {
        let Named { learner, model_hash, mapper } = named;
        let mut faults = Faults::default();
        let root = Place::root(&document);
        let object = root.object(&BATCH_FIELDS, &mut faults);
        let shared = object.and_then(|object| {
            let items = object.required("items", &mut faults);
            let items = items.and_then(|items| check_items(mapper.model(), &items, &mut faults));
            let shared = read_shared(
                mapper.model(),
                &object,
                |faults| base_weights(mapper.model(), learner.as_ref(), faults),
                &mut faults,
            );
            items.and(shared)
        });
        let (weights, options) = faults.check(shared)?;
        let items = match document.get_mut("items").map(Value::take) {
            Some(Value::Array(items)) => items,
            _ => Vec::new(),
        };
        let stamp = Stamp {
            model,
            model_hash,
            learner: learner.as_ref().map(|ready| ready.name.clone()),
            weights_version: learner.as_ref().map(|ready| ready.weights.version),
            ..Stamp::default()
        };
        Ok(Self { mapper, stamp, weights, options, waiting: Mutex::new(items.into_iter().enumerate()) })
    }

    /// Follows items that wait, one after the other, until a slice is over. Nothing if none waits any more.
    fn run_slice(&self, interrupt: &mut dyn Interrupt) -> Result<Vec<Outcome>, Cancelled> {
        let started = Instant::now();
        let mut slice = Vec::new();
        while slice.is_empty() || started.elapsed() < SLICE {
            let next = self.waiting.lock().unwrap_or_else(PoisonError::into_inner).next();
            let Some((n, item)) = next else { break };
            slice.push((n, self.follow(n, item, interrupt)?));
        }
        Ok(slice)
    }

    /// Follows the item at `n`.
    fn follow(
        &self,
        n: usize,
        item: Value,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Result<Searched, ServiceError>, Cancelled> {
        let items = Path::Member(&Path::Root, "items");
        let path = Path::Item(&items, n);
        let mut faults = Faults::default();
        if (Place { value: &item, path }).object(&ITEM_FIELDS, &mut faults).is_none() {
            return Ok(Err(faults.into()));
        }
        let document = self.as_single(item);
        let request = document.as_object().and_then(|members| {
            let object = Object { members, path };
            Request::read_over(self.mapper.model(), &object, |_| Some(self.weights.clone()), &mut faults)
        });
        let request = match faults.check(request) {
            Ok(request) => request,
            Err(faults) => return Ok(Err(faults.into())),
        };
        let stamp = Stamp { id: Some(Uuid::now_v7().to_string()), ..self.stamp.clone() };
        let place = Path::Member(&path, "demonstration");
        follow(&self.mapper, &request, (&document, &place), stamp, interrupt)
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

/// Checks how many items there are, and that their policies would not be too large together.
fn check_items(model: &Model, place: &Place<'_, '_>, faults: &mut Faults) -> Option<()> {
    let items = place.array(faults)?;
    if items.is_empty() || items.len() > MAX_BATCH_ITEMS {
        faults.note(place, format!("expected 1 to {MAX_BATCH_ITEMS} items, found {}", items.len()));
        return None;
    }
    let n_observations = items.iter().filter_map(|item| item.get("demonstration")?.as_array()).map(Vec::len).sum();
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
