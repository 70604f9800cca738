//! How observations are received: read, made durable, and mapped as far as that takes little.
//!
//! ```text
//! frame, and those that wait behind it
//!   | take_in_next: as it is, if nothing is wrong with it
//!   | take_in: as a document, which tells what is
//!   v
//! Coming
//!   | receive: one commit, and mapping while the disk is at work
//!   | receive_last, where the end waits behind them: mapping first, then one commit with the end
//!   v
//! one ReceivedFrame for each
//! ```

use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;

use super::SessionError;
use super::advancing::HERE;
use super::committed::CommittedSteps;
use super::ending::Ended;
use super::received::{Coming, ComingFrame, Observation, Received, ReceivedFrame, Waiting};
use super::session::Session;
use crate::memory::UNCOUNTED_BYTES;
use crate::service::requests::STATES;
use crate::service::{Etude, ServiceError};
use crate::store::NewObservations;
use etude_core::document::{Faults, Place};
use etude_core::mapping::{Demonstration, Options, Policy, WellFormed};

/// A mapping that takes longer does not begin before the disk is at work; to let that begin first takes some microseconds.
const SOME_TIME: Duration = Duration::from_micros(50);

impl Session {
    /// Takes the states from `seq` on into what is coming, given their text: an array. Says whether it did. It does if they come next, take
    /// little memory, and nothing is wrong with them; all else is left to [`Self::take_in`], which takes several times as long.
    pub fn take_in_next(&self, coming: &mut Coming, seq: u32, states: &str) -> bool {
        let n_received = coming.frames.last().map_or(self.n_received, |last| last.n_received);
        let model = self.mapper.model();
        let most = Policy::max_observations(model).min(Demonstration::MAX_OBSERVATIONS);
        if self.has_ended() || seq != n_received || self.perception.is_some() {
            return false;
        }
        // A text of three bytes is an observation of all attributes.
        let n_uncounted = UNCOUNTED_BYTES / Demonstration::bytes_of(model.schema(), 1) as u64;
        let max_len =
            most.saturating_sub(n_received as usize).min(usize::try_from(n_uncounted).unwrap_or(usize::MAX).max(1));
        let well_formed = WellFormed { max_len, ..WellFormed::in_text(model.schema(), states.len()) };
        let Ok(demonstration) = well_formed.read(states) else { return false };
        let Some(items) = states.trim().strip_prefix('[').and_then(|states| states.strip_suffix(']')) else {
            return false;
        };
        coming.stored.push(if coming.stored.is_empty() { '[' } else { ',' });
        coming.stored.push_str(items);
        let observations = demonstration.into_observations().map(|values| Observation { values, weight: None });
        let observations: Vec<Observation> = observations.collect();
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_OBSERVATIONS")]
        let n_received = n_received + observations.len() as u32;
        coming.frames.push(ComingFrame { seq, n_received, observations });
        true
    }

    /// Takes the states from `seq` on into what is coming, of which those that came before are ignored. `observation_weights` gives the
    /// weight of each of them, if not what the session was opened with.
    ///
    /// # Errors
    ///
    /// If something is wrong with them; then none was taken.
    pub fn take_in(
        &self,
        coming: &mut Coming,
        seq: u32,
        states: &Place<'_, '_>,
        observation_weights: Option<&Place<'_, '_>>,
    ) -> Result<(), SessionError> {
        let n_received = coming.frames.last().map_or(self.n_received, |last| last.n_received);
        if self.has_ended() {
            return Err(SessionError::Ended);
        }
        if seq > n_received {
            return Err(SessionError::Gap { expected: n_received });
        }
        let mut faults = Faults::default();
        let Some(items) = states.array(&mut faults) else { return Err(faults.into()) };
        let n_known = (n_received - seq) as usize;
        let new = items.get(n_known..).unwrap_or_default();
        if new.is_empty() {
            coming.frames.push(ComingFrame { seq, n_received, observations: Vec::new() });
            return Ok(());
        }
        let n_observations = n_received as usize + new.len();
        if n_observations > Demonstration::MAX_OBSERVATIONS {
            return Err(SessionError::TooMany);
        }
        if !Policy::check_size(self.mapper.model(), n_observations, states, &mut faults) {
            return Err(faults.into());
        }
        let schema = self.mapper.model().schema();
        let observed = match &self.perception {
            None => None,
            Some(perception) => {
                let states = new.iter().enumerate().map(|(n, state)| states.item(n_known + n, state));
                let observed = perception.observe_each(states, &mut faults);
                Some(faults.clone().check(observed)?)
            }
        };
        let new = observed.as_deref().unwrap_or(new);
        let places = new.iter().enumerate().map(|(n, state)| states.item(n_known + n, state));
        let read = Demonstration::read_observations(schema, places, &mut faults);
        let weights = match observation_weights {
            Some(place) => {
                let weights = Options::read_observation_weights(place, &mut faults);
                if let Some(weights) = weights.as_ref().filter(|weights| weights.len() != items.len()) {
                    let detail =
                        format!("expected one for each of the {} states, found {}", items.len(), weights.len());
                    faults.note(place, detail);
                }
                weights
            }
            None => Some(Vec::new()),
        };
        let (observations, weights) = faults.check(read.zip(weights))?;
        let mut weights = weights.into_iter().skip(n_known);
        let observations: Vec<Observation> =
            observations.into_iter().map(|values| Observation { values, weight: weights.next().flatten() }).collect();
        store(&mut coming.stored, new, &observations).map_err(ServiceError::Write)?;
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_OBSERVATIONS")]
        let n_received = n_observations as u32;
        coming.frames.push(ComingFrame { seq, n_received, observations });
        Ok(())
    }

    /// Receives what is coming, at least one frame: it is durable when this returns. What takes less time than the disk is mapped while that
    /// writes.
    ///
    /// # Errors
    ///
    /// After any the session is to be dropped.
    pub async fn receive(
        &mut self,
        etude: &Etude,
        coming: Coming,
        now: Timestamp,
    ) -> Result<Vec<ReceivedFrame>, SessionError> {
        if coming.stored.is_empty() {
            etude.store.touch_session(&self.id, self.owner, now).await??;
            return Ok(self.map_frames(etude, coming.frames));
        }
        let (frames, new) = self.written(etude, coming, now)?;
        let appending = etude.store.append_observations(new);
        let mapping = async {
            if self.takes_some_time {
                // What writes runs on this thread, once it has nothing else to do.
                tokio::task::yield_now().await;
            }
            self.map_frames(etude, frames)
        };
        // In this order: the disk is at work before the mapping begins.
        let (appended, received) = tokio::join!(biased; appending, mapping);
        appended??;
        self.n_received = self.n_sent;
        Ok(received)
    }

    /// Receives what is coming as [`Self::receive`] does, and ends the demonstration by the same commit, if all of that takes little. Gives its
    /// end; `None` if it is still to be [ended](Self::end).
    ///
    /// # Errors
    ///
    /// After any the session is to be dropped.
    pub async fn receive_last(
        &mut self,
        etude: &Etude,
        coming: Coming,
        now: Timestamp,
    ) -> Result<(Vec<ReceivedFrame>, Option<Ended>), SessionError> {
        if coming.stored.is_empty() || !self.text.is_known() {
            return Ok((self.receive(etude, coming, now).await?, None));
        }
        let (frames, new) = self.written(etude, coming, now)?;
        let received = self.map_frames(etude, frames);
        let are_mapped = received.iter().all(|frame| matches!(frame.mapped, Ok(Received::Mapped(_))));
        let is_short = are_mapped && self.ends_inline(&etude.clock);
        let texts = if is_short { self.texts_if_known(etude).ok().flatten() } else { None };
        let concluded = match texts {
            Some(texts) => Some(self.conclude_all(etude, texts, true).await),
            None => None,
        };
        let ended = if let Some(Ok(concluded)) = concluded {
            Some(self.store_end(etude, concluded, Some(new), now).await?)
        } else {
            // Whatever kept it from ending, they were received.
            etude.store.append_observations(new).await??;
            concluded.transpose()?;
            None
        };
        self.n_received = self.n_sent;
        Ok((received, ended))
    }

    /// What is coming as it is stored, and its frames. Takes note of it.
    fn written(
        &mut self,
        etude: &Etude,
        Coming { frames, mut stored }: Coming,
        now: Timestamp,
    ) -> Result<(Vec<ComingFrame>, NewObservations), SessionError> {
        let steps = match &self.online {
            Some(online) if self.unwritten.are_enough(self.is_inline(1)) => {
                Some(self.unwritten.take(online, &self.watch, self.n_received)?)
            }
            _ => None,
        };
        self.n_sent = frames.last().map_or(self.n_received, |last| last.n_received);
        if let Some(waits) = &mut self.waits {
            waits.came(self.n_received, Duration::ZERO, etude.clock.instant());
        }
        stored.push(']');
        self.text.add(&stored);
        let new = NewObservations {
            session_id: self.id.clone(),
            owner: self.owner,
            seq: self.n_received,
            n_states: self.n_sent - self.n_received,
            states: stored,
            at: now,
            service_time: self.waits.as_ref().map(|_| etude.store.service_time(now)),
            steps,
        };
        Ok((frames, new))
    }

    /// Maps as much of `frames` as is done where they arrive. What comes after a frame that takes longer, or when they have taken as long
    /// together, or have many steps, waits for its turn to be told.
    fn map_frames(&mut self, etude: &Etude, frames: Vec<ComingFrame>) -> Vec<ReceivedFrame> {
        let (mut n_received, mut n_bytes, mut all_mapped) = (self.n_received, 0, true);
        let began = etude.clock.instant();
        let frames = frames.into_iter().map(|ComingFrame { seq, n_received: n_then, observations }| {
            for (index, observation) in (n_received as usize..).zip(&observations) {
                self.watch.observe(self.mapper.model(), index, &observation.values);
            }
            n_received = n_then;
            let warnings = self.watch.news(self.mapper.model(), seq as usize, &STATES);
            let waiting = Waiting::from(observations);
            let mapped = if waiting.observations.len() == 0 {
                Ok(Received::Mapped(CommittedSteps::default()))
            } else if all_mapped && n_bytes <= UNCOUNTED_BYTES && etude.clock.elapsed(began) <= HERE {
                self.map_here(etude, waiting, 0)
            } else {
                Ok(Received::Waiting(waiting))
            };
            match &mapped {
                Ok(Received::Mapped(steps)) => n_bytes += steps.n_bytes() as u64,
                _ => all_mapped = false,
            }
            ReceivedFrame { n_received, warnings, mapped }
        });
        let frames = frames.collect();
        self.takes_some_time = etude.clock.elapsed(began) > SOME_TIME;
        frames
    }
}

/// Writes observed states to `stored`: before each that came with a weight, that number.
fn store(stored: &mut String, states: &[Value], observations: &[Observation]) -> serde_json::Result<()> {
    let weights = observations.iter().map(|observation| observation.weight);
    for (state, weight) in states.iter().zip(weights) {
        for value in weight.map(Value::from).iter().chain([state]) {
            stored.push(if stored.is_empty() { '[' } else { ',' });
            stored.push_str(&serde_json::to_string(value)?);
        }
    }
    Ok(())
}
