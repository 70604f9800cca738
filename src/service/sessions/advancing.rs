//! How a session is mapped: where observations arrive if that takes little, else in the pool; by what has come, and by time.

use std::sync::Arc;

use super::SessionError;
use super::committed::CommittedSteps;
use super::kept::{Kept, Unwritten};
use super::session::{Observation, Session};
use crate::memory::{Held, NoRoom, SMALL_BYTES};
use crate::service::search::take_beyond_small;
use crate::service::{Etude, PoolError, ServiceError};
use crate::store::NewObservations;
use etude_core::interrupt::{Interrupt, Uninterrupted};
use etude_core::mapping::{Mapper, OnlineMapping, Stopped};

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

    /// Maps observations that were received, and gives the steps that they commit.
    ///
    /// # Errors
    ///
    /// If the service ends, or there is no memory for them; the session is then to be resumed.
    pub async fn advance(
        &mut self,
        etude: &Etude,
        observations: Vec<Observation>,
    ) -> Result<CommittedSteps, SessionError> {
        self.map(etude, observations, 0).await
    }

    /// Commits the steps that are due by now, decided by what has come: durable when this returns, as they follow from nothing else.
    ///
    /// # Errors
    ///
    /// As [`Self::advance`], and if they cannot be stored.
    pub async fn decide(&mut self, etude: &Etude) -> Result<CommittedSteps, SessionError> {
        let now = etude.clock.instant();
        let n_due = self.waits.as_ref().map_or(0, |waits| waits.n_due(self.n_received, now));
        let steps = self.map(etude, Vec::new(), n_due).await?;
        if let Some(online) = self.online.as_ref().filter(|_| !steps.is_empty()) {
            let new = self.unwritten.take(online, &self.watch, self.n_received)?;
            let new = NewObservations::none(self.id.clone(), self.owner, self.n_received, new);
            etude.store.append_observations(new).await??;
        }
        Ok(steps)
    }

    /// Maps observations that were received, then decides until the steps have met `n_due` observations. Gives the steps that are committed.
    async fn map(
        &mut self,
        etude: &Etude,
        observations: Vec<Observation>,
        n_due: u32,
    ) -> Result<CommittedSteps, SessionError> {
        let mut n_met = self.n_met;
        let online = self.online.take().ok_or(SessionError::NotOpen)?;
        let is_inline = self.is_inline(observations.len().max(1));
        let held_bytes = self.held.n_bytes();
        let (mapper, memory) = (Arc::clone(&self.mapper), etude.memory.clone());
        // Any number of sessions may be searched in turn, each with its memory: as much again is for the window, its terms of distances above
        // all, and for what an allocator takes beside.
        let n_bytes = (2 * Mapper::WINDOW_BYTES as u64).min(memory.room() / 4);
        let window = if is_inline { None } else { Some(memory.take(n_bytes).await.map_err(ServiceError::from)?) };
        let job = move |interrupt: &mut dyn Interrupt| {
            let _window = window;
            // Others find something too. What it really took is kept afterwards.
            let wanted = if is_inline { 0 } else { u64::MAX };
            let spare = take_beyond_small(wanted, &memory);
            let most_bytes = held_bytes + SMALL_BYTES + spare.as_ref().map_or(0, Held::n_bytes);
            let no_room = NoRoom { wanted: most_bytes, room: memory.room() };
            let mut online = online.within(usize::try_from(most_bytes).unwrap_or(usize::MAX));
            let mut steps = CommittedSteps::default();
            let mut observations = observations.iter();
            while !observations.as_slice().is_empty() || n_met < n_due {
                let committed = match observations.next() {
                    Some(Observation { values, weight }) => online.observe(values, *weight, interrupt),
                    None => online.decide(interrupt),
                };
                match committed {
                    Ok(committed) => {
                        if steps.take_for(committed.len(), mapper.model(), &memory).is_err() {
                            return Ok(Err(no_room));
                        }
                        n_met = committed.last().map_or(n_met, |last| last.step.observation + 1);
                        steps.extend(committed);
                    }
                    Err(Stopped::Cancelled(cancelled)) => return Err(cancelled),
                    Err(Stopped::Memory) => return Ok(Err(no_room)),
                }
            }
            Ok(Ok((online, steps, n_met)))
        };
        let advanced = if is_inline {
            job(&mut Uninterrupted).map_err(|_| PoolError::Stopped)?
        } else {
            etude.pool.run_in_turn(self.client, job).await?
        };
        let (online, steps, n_met) = advanced.map_err(ServiceError::from)?;
        self.reserve(online.size_bytes() as u64)?;
        self.online = Some(online);
        self.n_steps += steps.len();
        self.unwritten.extend(&steps);
        self.n_met = n_met;
        if let Some(waits) = &mut self.waits {
            waits.met(n_met);
        }
        Ok(steps)
    }

    /// Counts what the mapping takes.
    pub(super) fn reserve(&mut self, n_bytes: u64) -> Result<(), SessionError> {
        // Most windows grow and shrink a little all the time.
        if n_bytes < self.held.n_bytes() / 2 {
            self.held.shrink_to(n_bytes);
        }
        self.held.grow_to(n_bytes).map_err(|no_room| ServiceError::from(no_room).into())
    }
}
