//! How a session is mapped: where observations arrive if that takes little, else in the pool; by what has come, and by time.

use std::num::NonZeroU32;
use std::sync::Arc;
use std::time::Duration;

use super::SessionError;
use super::committed::CommittedSteps;
use super::kept::{Kept, Unwritten};
use super::received::{Observation, Received, Waiting};
use super::session::Session;
use crate::clock::Clock;
use crate::memory::{Held, Memory, NoRoom, SMALL_BYTES};
use crate::service::search::take_beyond_small;
use crate::service::{Etude, ServiceError};
use crate::store::NewObservations;
use etude_core::interrupt::{Interrupt, Signal, Uninterrupted};
use etude_core::mapping::{Mapper, OnlineMapping, Stopped};

/// How long is searched where observations arrive. What takes longer is searched in the pool, and so are the session's next windows until they
/// take less.
pub(super) const HERE: Duration = Duration::from_micros(500);

/// How often a search asks whether to go on that takes less, at most. However late it is, one that asks so seldom has not been at work for long.
const FEW_QUESTIONS: u32 = 8;

/// Goes on for so long.
fn briefly(clock: &Clock) -> impl Interrupt {
    let (began, mut n_asked) = (clock.instant(), 0);
    move || {
        n_asked += 1;
        if n_asked > FEW_QUESTIONS && clock.elapsed(began) > HERE { Signal::Cancel } else { Signal::Continue }
    }
}

/// What a window is searched in: as much again as a search may always take is for the window, its terms of distances above all, and for what
/// an allocator takes beside.
fn window_bytes(memory: &Memory) -> u64 {
    (2 * Mapper::WINDOW_BYTES as u64).min(memory.room() / 4)
}

/// Most values of a window that is searched where observations arrive: nobody is asked whether to go on while it is made.
const MAX_WINDOW_VALUES: usize = 1 << 11;

/// Whether so many observations are mapped where they arrive without a search, in a model of `size` states and transitions: in less than a
/// millisecond.
fn are_few_nodes(size: usize, lookahead: Option<NonZeroU32>, n_observations: usize) -> bool {
    const MAX_INLINE_WORK: usize = 1 << 14;
    let n_layers = n_observations.saturating_mul(lookahead.map_or(1, |lookahead| lookahead.get() as usize));
    n_layers.saturating_mul(size) <= MAX_INLINE_WORK
}

/// A session's mapping on its way through what waits.
struct Advance {
    online: OnlineMapping,
    waiting: Waiting,
    /// How many of the steps the session knows of.
    n_noted: usize,
    n_met: u32,
    n_due: u32,
    /// How many decisions were made.
    n_decisions: u32,
}

/// What became of it in the pool.
enum Turned {
    Done(Advance),
    /// It has not begun.
    NoRoom(Advance),
}

impl Advance {
    /// Goes on in about `most_bytes`. Where ways are searched for, it may go on again after it was stopped.
    fn go_on(
        &mut self,
        most_bytes: u64,
        mapper: &Mapper,
        memory: &Memory,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(), Stopped> {
        self.online.limit(usize::try_from(most_bytes).unwrap_or(usize::MAX));
        loop {
            let committed = if let Some(decided) = self.online.decide_next(interrupt)? {
                self.n_decisions += 1;
                decided
            } else if let Some(Observation { values, weight }) = self.waiting.observations.next() {
                self.online.receive(&values, weight, interrupt)?
            } else if self.n_met < self.n_due {
                self.n_decisions += 1;
                self.online.decide(interrupt)?
            } else {
                return Ok(());
            };
            let Some(last) = committed.last() else { continue };
            self.n_met = last.step.observation + 1;
            let taken = self.waiting.steps.take_for(committed.len(), mapper.model(), memory);
            self.waiting.steps.extend(committed);
            taken.map_err(|_| Stopped::Memory)?;
        }
    }

    /// Why it did not go on in `most_bytes`.
    fn no_room(&self, most_bytes: u64, memory: &Memory) -> ServiceError {
        let no_room = NoRoom { wanted: most_bytes, room: memory.room() };
        self.online.shortage().map_or_else(|| no_room.into(), ServiceError::from)
    }
}

impl Session {
    /// The mapping as it was after the last step that is `kept`, if any is, of which the session takes note.
    pub(super) fn begin(&mut self, kept: Option<&Kept>) -> Result<OnlineMapping, SessionError> {
        let (mapper, weights, conditions) = (&self.mapper, self.weights.clone(), self.conditions.clone());
        let Some(kept) = kept else { return Ok(OnlineMapping::new(mapper, weights, conditions, self.lookahead)) };
        let online = OnlineMapping::resume(mapper, weights, conditions, self.lookahead, &kept.root, kept.moves());
        let online =
            online.ok_or_else(|| ServiceError::unreadable("steps", "root", &self.id, "it is not of these steps"))?;
        self.n_steps = kept.steps.len();
        self.n_met = kept.n_met();
        self.unwritten = Unwritten::after(self.n_steps);
        Ok(online)
    }

    /// Maps what waits, and gives the steps that are committed.
    ///
    /// # Errors
    ///
    /// If the service ends, or there is no memory for them; the session is then to be resumed.
    pub async fn advance(&mut self, etude: &Etude, waiting: Waiting) -> Result<CommittedSteps, SessionError> {
        self.map(etude, waiting, 0).await
    }

    /// Commits the steps that are due by now, decided by what has come: durable when this returns, as they follow from nothing else.
    ///
    /// # Errors
    ///
    /// As [`Self::advance`], and if they cannot be stored.
    pub async fn decide(&mut self, etude: &Etude) -> Result<CommittedSteps, SessionError> {
        let now = etude.clock.instant();
        let n_due = self.waits.as_ref().map_or(0, |waits| waits.n_due(self.n_received, now));
        let steps = self.map(etude, Waiting::default(), n_due).await?;
        if let Some(online) = self.online.as_ref().filter(|_| !steps.is_empty()) {
            let new = self.unwritten.take(online, &self.watch, self.n_received)?;
            let new = NewObservations::none(self.id.clone(), self.owner, self.n_received, new);
            etude.store.append_observations(new).await??;
        }
        Ok(steps)
    }

    /// Maps what waits, then decides until the steps have met `n_due` observations. Gives the steps that are committed.
    async fn map(&mut self, etude: &Etude, waiting: Waiting, n_due: u32) -> Result<CommittedSteps, SessionError> {
        let waiting = match self.map_here(etude, waiting, n_due)? {
            Received::Mapped(steps) => return Ok(steps),
            Received::Waiting(waiting) => waiting,
        };
        let mut advance = self.begin_to_advance(waiting, n_due)?;
        let mut window = None;
        let advance = loop {
            match self.advance_in_turn(etude, advance, window.take()).await? {
                Turned::Done(advance) => break advance,
                // Others have taken so much of the memory that not even a window can be searched.
                Turned::NoRoom(again) => {
                    advance = again;
                    window = Some(etude.memory.take(window_bytes(&etude.memory)).await.map_err(ServiceError::from)?);
                }
            }
        };
        self.take_note(advance).map(|waiting| waiting.steps)
    }

    /// Goes on in the pool, in the memory of a `window` if that was taken before.
    async fn advance_in_turn(
        &mut self,
        etude: &Etude,
        mut advance: Advance,
        window: Option<Held>,
    ) -> Result<Turned, SessionError> {
        let (held_bytes, searches) = (self.held.n_bytes(), advance.online.searches());
        let (mapper, memory) = (Arc::clone(&self.mapper), etude.memory.clone());
        let job = move |interrupt: &mut dyn Interrupt| {
            // Not before its turn: any number of sessions may wait, and those that search have room then.
            let window =
                window.map_or_else(|| memory.try_take_as_large(if searches { window_bytes(&memory) } else { 0 }), Ok);
            let Ok(_window) = window else { return Ok(Ok((Turned::NoRoom(advance), true))) };
            // Others find something too. What it really took is kept afterwards.
            let spare = take_beyond_small(u64::MAX, &memory);
            let most_bytes = held_bytes + SMALL_BYTES + spare.as_ref().map_or(0, Held::n_bytes);
            let mut n_asked = 0;
            let mut counting = || {
                n_asked += 1;
                interrupt.poll()
            };
            match advance.go_on(most_bytes, &mapper, &memory, &mut counting) {
                Ok(()) => {
                    let is_slow = n_asked > FEW_QUESTIONS * advance.n_decisions;
                    Ok(Ok((Turned::Done(advance), is_slow)))
                }
                Err(Stopped::Cancelled(cancelled)) => Err(cancelled),
                Err(Stopped::Memory) => Ok(Err(advance.no_room(most_bytes, &memory))),
            }
        };
        let (turned, is_slow) = etude.pool.run_in_turn(self.client, job).await??;
        self.is_slow = is_slow;
        Ok(turned)
    }

    /// Maps as much of what waits as is done where observations arrive.
    pub(super) fn map_here(&mut self, etude: &Etude, waiting: Waiting, n_due: u32) -> Result<Received, SessionError> {
        if !self.is_inline(waiting.observations.len().max(1)) {
            return Ok(Received::Waiting(waiting));
        }
        let mut advance = self.begin_to_advance(waiting, n_due)?;
        let searches = advance.online.searches();
        let most_bytes = self.held.n_bytes() + SMALL_BYTES;
        let mut brief = briefly(&etude.clock);
        let interrupt: &mut dyn Interrupt = if searches { &mut brief } else { &mut Uninterrupted };
        match advance.go_on(most_bytes, &self.mapper, &etude.memory, interrupt) {
            Ok(()) => self.take_note(advance).map(|waiting| Received::Mapped(waiting.steps)),
            Err(_) if searches => {
                self.is_slow = true;
                self.take_note(advance).map(Received::Waiting)
            }
            Err(_) => Err(advance.no_room(most_bytes, &etude.memory).into()),
        }
    }

    fn begin_to_advance(&mut self, waiting: Waiting, n_due: u32) -> Result<Advance, SessionError> {
        let online = self.online.take().ok_or(SessionError::NotOpen)?;
        let n_noted = waiting.steps.len();
        Ok(Advance { online, waiting, n_noted, n_met: self.n_met, n_due, n_decisions: 0 })
    }

    /// Takes note of what was mapped, and gives what is left, with all the steps.
    fn take_note(&mut self, advance: Advance) -> Result<Waiting, SessionError> {
        let Advance { online, waiting, n_noted, n_met, .. } = advance;
        self.reserve((online.size_bytes() + self.text.n_bytes()) as u64)?;
        self.online = Some(online);
        let steps = waiting.steps.get(n_noted..).unwrap_or_default();
        self.n_steps += steps.len();
        self.unwritten.extend(steps);
        self.n_met = n_met;
        if let Some(waits) = &mut self.waits {
            waits.met(n_met);
        }
        Ok(waiting)
    }

    /// Finds the rest of the mapping, if the session is so short that its end takes little. Gives whether it has found it.
    pub(super) fn ends_inline(&self, clock: &Clock) -> bool {
        let n_observations = self.n_sent as usize;
        let n_values = (n_observations + self.n_steps).saturating_mul(self.mapper.model().schema().len());
        let Some(online) =
            self.online.as_ref().filter(|_| n_values <= MAX_WINDOW_VALUES && self.is_inline(n_observations))
        else {
            return false;
        };
        online.find_rest(&mut briefly(clock)).is_ok()
    }

    /// Whether so many observations are mapped where they arrive, as far as one can tell.
    pub(super) fn is_inline(&self, n_observations: usize) -> bool {
        let Some(online) = self.online.as_ref() else { return false };
        if online.searches() {
            let n_ahead = self.lookahead.map_or(usize::MAX, |lookahead| lookahead.get() as usize);
            return !self.is_slow && n_ahead.saturating_mul(self.mapper.model().schema().len()) <= MAX_WINDOW_VALUES;
        }
        let graph = self.mapper.model().graph();
        are_few_nodes(graph.n_states() + graph.n_transitions(), self.lookahead, n_observations)
    }

    /// Counts what the mapping, and the text of what was received, take.
    pub(super) fn reserve(&mut self, n_bytes: u64) -> Result<(), SessionError> {
        // Most windows grow and shrink a little all the time.
        if n_bytes < self.held.n_bytes() / 2 {
            self.held.shrink_to(n_bytes);
        }
        self.held.grow_to(n_bytes).map_err(|no_room| ServiceError::from(no_room).into())
    }
}

#[cfg(test)]
mod tests;
