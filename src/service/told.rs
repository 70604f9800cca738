//! What models of experience were told, counted in memory: of as many models as there is room for.
//!
//! What is not in memory is counted anew from the batches of the store. So that this does not take longer and longer, what was counted is
//! stored from time to time, and only what came since is counted again.

mod stored;

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sha2::{Digest, Sha256};
use tokio::sync::OwnedMutexGuard;
use tokio_util::task::TaskTracker;

use super::definitions::{DefinitionReader, check_hash, corrupt_definition, unknown};
use super::hash::{hash_of, hex};
use super::{SearchPool, ServiceError};
use crate::client::Client;
use crate::memory::{Held, Memory, NoRoom};
use crate::store::{ModelRecord, ModelSize, NewBatch, Revision, Store, StoredBatch, StoredDefinition, pack_batch};
use etude_core::document::{self, Faults, Place};
use etude_core::interrupt::{Cancelled, Interrupt, Interrupted};
use etude_core::model::{Batch, Definition, Format, Limits, Tally};

/// What models were told, by the names of these.
#[derive(Clone, Debug)]
pub(super) struct Experiences {
    store: Arc<Store>,
    pool: SearchPool,
    memory: Memory,
    tasks: TaskTracker,
    rooms: Arc<Mutex<Rooms>>,
}

/// What was told to a model, if it is in memory. Whoever has locked it decides what comes next.
type Room = Arc<tokio::sync::Mutex<Option<Told>>>;

#[derive(Debug, Default)]
struct Rooms {
    /// Each with when it was used last. Names are the clients' to choose, so they are hashed with a seed.
    by_name: HashMap<String, (Room, u64)>,
    n_uses: u64,
}

/// What a model was told.
#[derive(Debug)]
pub(super) struct Told {
    /// Under which its batches are stored.
    pub(super) experience: i64,
    /// The hash of the model with all of it.
    pub(super) hash: String,
    n_batches: i64,
    pub(super) tally: Tally,
    /// How many transitions, and batches as so many each, came after what is stored of the tally.
    n_since_stored: usize,
    held: Held,
}

/// Which revision of a model is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Wanted<'h> {
    /// The one that there is.
    Current,
    /// The one with this hash, even if there is a later one.
    Revision(&'h str),
}

impl Experiences {
    /// Most models of which it is kept.
    const MAX_KEPT: usize = 64;

    pub(super) fn new(store: Arc<Store>, pool: SearchPool, memory: Memory, tasks: TaskTracker) -> Self {
        Self { store, pool, memory, tasks, rooms: Arc::default() }
    }

    fn rooms(&self) -> MutexGuard<'_, Rooms> {
        self.rooms.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until nobody else works with what the model called `name` was told.
    pub(super) async fn lock(&self, name: &str) -> OwnedMutexGuard<Option<Told>> {
        let room = self.rooms().room(name);
        room.lock_owned().await
    }

    /// Gives back the memory of what nobody works with now.
    pub(super) fn make_room(&self) {
        let idle = self.rooms().take_idle(0);
        drop(idle);
    }

    /// Gives back the memory of what the model called `name` was told, as it is gone, or another one.
    pub(super) fn forget(&self, name: &str) {
        let gone = self.rooms().by_name.remove(name);
        drop(gone);
    }

    /// The hash of the model called `name`, and under which id its batches are stored.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Unknown`] if there is no such model, [`ServiceError::Faults`] if it is not one of experience; if the store failed.
    pub(super) async fn head(&self, name: &str) -> Result<(String, i64), ServiceError> {
        let head = self.store.model_head(name).await?.ok_or_else(|| unknown(name, None))?;
        let Some(experience) = head.experience else {
            let detail = "this model is not made of experience: the kind of its dynamics is another one";
            return Err(Faults::one("", detail).into());
        };
        Ok((head.key.hash, experience))
    }

    /// What the model called `name` was told up to now: from `room`, which is its own, or from the store.
    ///
    /// # Errors
    ///
    /// As [`Self::head`]; if it cannot be counted now.
    pub(super) async fn current(&self, name: &str, room: &mut Option<Told>) -> Result<Told, ServiceError> {
        let (hash, experience) = self.head(name).await?;
        let known = room.take().filter(|told| told.experience == experience && told.hash == hash);
        match known {
            Some(told) => Ok(told),
            // It may have taken long.
            None => Ok(self.store_tally(self.count(name, Wanted::Current).await?).await),
        }
    }

    /// The model called `name` as a table, and the hash of that revision; no table if there is no state to start in.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Unknown`] if there is no such model, or it never had this revision; if it cannot be counted now.
    pub(super) async fn table(
        &self,
        name: &str,
        wanted: Wanted<'_>,
    ) -> Result<(String, Option<Definition>), ServiceError> {
        let (hash, _) = self.head(name).await?;
        let is_it = |hash: &str| wanted == Wanted::Current || wanted == Wanted::Revision(hash);
        if is_it(&hash) {
            let mut room = self.lock(name).await;
            let current = self.current(name, &mut room).await?;
            if is_it(&current.hash) {
                let (table, current) = self.table_of(current).await?;
                let hash = current.hash.clone();
                *room = Some(current);
                return Ok((hash, table));
            }
            *room = Some(current);
        }
        // An earlier revision is not kept, and nobody has to wait for it.
        let (table, told) = self.table_of(self.count(name, wanted).await?).await?;
        Ok((told.hash, table))
    }

    async fn table_of(&self, told: Told) -> Result<(Option<Definition>, Told), ServiceError> {
        // What is copied is about as much again.
        let _held = self.try_take(told.tally.size_bytes() as u64)?;
        let job = |interrupt: &mut dyn Interrupt| {
            let table = told.tally.definition(interrupt).map_err(cancelled)?;
            Ok((table, told))
        };
        Ok(self.pool.run_in_turn(Client::LOCAL, job).await?)
    }

    /// Takes memory until `held` holds `n_bytes`, likewise.
    fn grow(&self, held: &mut Held, n_bytes: u64) -> Result<(), NoRoom> {
        held.grow_to(n_bytes).or_else(|no_room| {
            self.make_room();
            held.grow_to(n_bytes).map_err(|_| no_room)
        })
    }

    /// Takes memory, if need be from what nobody works with now.
    fn try_take(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        self.memory.try_take(n_bytes).or_else(|_| {
            self.make_room();
            self.memory.try_take(n_bytes)
        })
    }

    /// Counts what was told to the model called `name`.
    ///
    /// # Errors
    ///
    /// [`ServiceError::Unknown`] if there is none, or it never had this revision; if it cannot be counted now.
    async fn count(&self, name: &str, wanted: Wanted<'_>) -> Result<Told, ServiceError> {
        let gone = || unknown(name, None);
        let ModelRecord { summary, definition, experience } = self.store.model(name).await?.ok_or_else(gone)?;
        let experience = experience.ok_or_else(gone)?;
        let definition_hash = summary.definition_hash().to_owned();
        let wanted = match wanted {
            Wanted::Current => summary.hash.clone(),
            Wanted::Revision(hash) => hash.to_owned(),
        };
        let last = self.store.revision(experience, &wanted).await?.ok_or_else(gone)?;
        let mut held = self.memory.try_take(0)?;
        let text = match definition {
            StoredDefinition::Text(text) => text.into_bytes(),
            StoredDefinition::Pieces(id) => {
                let (mut pieces, mut text) = (DefinitionReader::new(&summary, id), Vec::new());
                while let Some(piece) = pieces.next_in(&self.store).await? {
                    held.grow_to(2 * (text.len() + piece.len()) as u64)?;
                    text.extend_from_slice(&piece);
                }
                text
            }
        };
        check_hash(name, &hash_of(&text), &definition_hash)?;
        let corrupt = |error: String| corrupt_definition(name, error.into());
        let read = move |interrupt: &mut dyn Interrupt| {
            let definition = Definition::parse(&text, Format::Json, Limits::NONE, interrupt);
            Ok(definition.map(|definition| Tally::new(&definition)))
        };
        let tally = self.pool.run_in_turn(Client::LOCAL, read).await?.map_err(|error| corrupt(error.to_string()))?;
        let tally = tally.ok_or_else(|| corrupt("it is not a model of experience".to_owned()))?;
        let mut told = Told { experience, hash: definition_hash, n_batches: 0, tally, n_since_stored: 0, held };
        // About what is read of it.
        let n_known = summary.size.map_or(0, |size| size.n_states + size.n_transitions);
        self.grow(&mut told.held, 32 * n_known)?;
        if let Some(stored) = self.store.tally(experience, last).await? {
            self.grow(&mut told.held, RESTORED_BYTES * stored.content.len() as u64)?;
            let restore = move |_: &mut dyn Interrupt| Ok(told.with(&stored));
            told = self.pool.run_in_turn(Client::LOCAL, restore).await?;
        }
        while told.hash != wanted {
            let batches = self.store.batches(experience, told.n_batches).await?;
            if batches.is_empty() {
                // It was deleted meanwhile.
                return Err(gone());
            }
            let (this, wanted) = (self.clone(), wanted.clone());
            let fold = move |interrupt: &mut dyn Interrupt| this.fold(told, &batches, &wanted, interrupt);
            told = self.pool.run_in_turn(Client::LOCAL, fold).await??;
        }
        Ok(told)
    }

    /// Counts stored batches, up to the one that gave the model the hash `wanted`.
    fn fold(
        &self,
        mut told: Told,
        batches: &[StoredBatch],
        wanted: &str,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Result<Told, ServiceError>, Cancelled> {
        for stored in batches {
            if told.hash == wanted {
                break;
            }
            let mut add = || -> Result<Result<(), ServiceError>, Cancelled> {
                let corrupt =
                    |error: String| ServiceError::unreadable("batches", "content", stored.hash.clone(), error);
                let text = match stored.text() {
                    Ok(text) => text,
                    Err(error) => return Ok(Err(error.into())),
                };
                let mut parsing = None;
                if let Err(no_room) = self.memory.reserve(&mut parsing, document::parsed_bytes(&text)) {
                    return Ok(Err(no_room.into()));
                }
                let document = match document::parse(&text) {
                    Ok(document) => document,
                    Err(error) => return Ok(Err(corrupt(error.to_string()))),
                };
                let mut faults = Faults::default();
                let read = told.tally.read_batch(&Place::root(&document), &mut faults, interrupt).map_err(cancelled)?;
                let batch = match faults.check(read) {
                    Ok(batch) => batch,
                    Err(faults) => return Ok(Err(corrupt(faults.to_string()))),
                };
                if told.hash_with(&batch) != stored.hash {
                    return Ok(Err(corrupt("it is not what the hash of its model is of".to_owned())));
                }
                Ok(self.add(&mut told, &batch).map_err(Into::into))
            };
            if let Err(error) = add()? {
                return Ok(Err(error));
            }
        }
        Ok(Ok(told))
    }

    /// Counts a batch that is not stored yet: what is to be stored of it, or what is wrong with it; then nothing was counted.
    pub(super) fn accept(
        &self,
        told: &mut Told,
        model: &str,
        batch: &Batch,
        limits: Limits,
    ) -> Result<NewBatch, ServiceError> {
        let mut faults = Faults::default();
        told.tally.check(batch, limits, &mut faults);
        if !faults.is_empty() {
            return Err(faults.into());
        }
        let content = pack_batch(batch.text.as_bytes())?;
        let (hash_before, n_before) = (told.hash.clone(), told.n_batches);
        self.add(told, batch)?;
        Ok(NewBatch {
            model: model.to_owned(),
            experience: told.experience,
            hash_before,
            n_before,
            batch: batch.id.clone(),
            content_hash: hash_of(&batch.text),
            hash: told.hash.clone(),
            revision: told.revision(),
            content,
        })
    }

    fn add(&self, told: &mut Told, batch: &Batch) -> Result<(), NoRoom> {
        let needed = (told.tally.size_bytes() + Tally::growth_bytes(batch)) as u64;
        self.grow(&mut told.held, needed)?;
        told.hash = told.hash_with(batch);
        told.n_batches += 1;
        told.tally.add(batch);
        told.n_since_stored += BATCH_AS_TRANSITIONS + batch.len();
        told.held.shrink_to(told.tally.size_bytes() as u64);
        Ok(())
    }
}

impl Rooms {
    fn room(&mut self, name: &str) -> Room {
        self.n_uses += 1;
        if let Some((room, last_used)) = self.by_name.get_mut(name) {
            *last_used = self.n_uses;
            return Arc::clone(room);
        }
        drop(self.take_idle(Experiences::MAX_KEPT - 1));
        let room = Room::default();
        self.by_name.insert(name.to_owned(), (Arc::clone(&room), self.n_uses));
        room
    }

    /// Takes out what nobody works with, what was not used for longest first, until at most so many are left.
    fn take_idle(&mut self, n_left: usize) -> Vec<Room> {
        let is_idle = |room: &Room| Arc::strong_count(room) == 1;
        let mut idle: Vec<(u64, String)> = Vec::new();
        if self.by_name.len() > n_left {
            let rooms = self.by_name.iter().filter(|(_, (room, _))| is_idle(room));
            idle.extend(rooms.map(|(name, (_, last_used))| (*last_used, name.clone())));
        }
        idle.sort_unstable();
        idle.truncate(self.by_name.len().saturating_sub(n_left));
        idle.iter().filter_map(|(_, name)| Some(self.by_name.remove(name)?.0)).collect()
    }
}

impl Told {
    /// The hash of the model once it is told `batch` as well.
    fn hash_with(&self, batch: &Batch) -> String {
        hex(Sha256::new().chain_update(&self.hash).chain_update(&batch.text).finalize())
    }

    fn revision(&self) -> Revision {
        revision(&self.tally)
    }
}

/// A batch takes as long to count as so many of its transitions.
const BATCH_AS_TRANSITIONS: usize = 16;

/// What a tally takes, and what is read of it before, for each byte of what is stored.
const RESTORED_BYTES: u64 = 24;

/// How much there is of what was experienced.
pub(super) fn revision(tally: &Tally) -> Revision {
    let counts = tally.counts();
    Revision {
        size: ModelSize { n_states: counts.n_states as u64, n_transitions: counts.n_transitions as u64 },
        n_stochastic: counts.n_stochastic as u64,
        n_unsafe: counts.n_unsafe as u64,
    }
}

/// Jobs without a deadline are told to finish by nobody.
fn cancelled(_: Interrupted) -> Cancelled {
    Cancelled
}

#[cfg(test)]
mod tests;
