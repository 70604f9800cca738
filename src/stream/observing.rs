//! How observations are answered: those that wait one behind the other are received together, by one commit.

use jiff::Timestamp;
use serde_json::Value;

use super::closing::{Closed, Over, ends, not_allowed};
use super::engine::Connection;
use super::frames::{ClientFrame, ServerFrame};
use super::messages::{Incoming, read_frame};
use super::queue::{Receiver, Weighed};
use super::room::{SMALL_FRAME_BYTES, Taken};
use crate::service::{Coming, Received, ReceivedFrame, Session, SessionError};
use etude_core::document::{Members, Path, Place};

/// Frames that are received together have so many bytes at most: what is larger is written after what is small.
const BYTES_TOGETHER: usize = 4 << 10;

impl Connection<'_> {
    /// Receives what is observed from `seq` on in a frame of `n_bytes`, as [`Self::receive`] does.
    pub(super) async fn observe(
        &mut self,
        seq: u32,
        (frame, memory): (Value, Option<Taken>),
        n_bytes: usize,
        incoming: &mut Receiver<Incoming>,
        now: Timestamp,
    ) -> Result<Option<Closed>, Over> {
        let Some(session) = &mut self.session else { return Err(not_allowed("open or resume a session first")) };
        let mut coming = Coming::default();
        if let Err(error) = take_in(session, &mut coming, seq, &frame) {
            return self.go_on_or_end(&error).await;
        }
        // Nobody waits for a search with what it does not need.
        drop((frame, memory));
        self.receive(coming, n_bytes, incoming, now).await
    }

    /// Takes in what came, if it is a small frame of observations that come next, and nothing is wrong with it: most frames are. This is read
    /// without a document in between.
    pub(super) fn take_in_next(&self, came: &Incoming) -> Option<Coming> {
        let mut coming = Coming::default();
        let Incoming::Frame { text, .. } = came else { return None };
        let is_small = text.len() <= SMALL_FRAME_BYTES.min(self.limits.frame_bytes);
        let session = self.session.as_ref().filter(|_| is_small)?;
        take_in_text(session, &mut coming, text).then_some(coming)
    }

    /// Receives what is coming by a frame of `n_bytes`, together with the frames of observations that wait behind it, and answers each of
    /// them.
    pub(super) async fn receive(
        &mut self,
        mut coming: Coming,
        mut n_bytes: usize,
        incoming: &mut Receiver<Incoming>,
        now: Timestamp,
    ) -> Result<Option<Closed>, Over> {
        let outlet = self.outlet;
        let Some(session) = &mut self.session else { return Err(not_allowed("open or resume a session first")) };
        // Their room in the queue is given back once they are answered.
        let mut others = Vec::new();
        while n_bytes < BYTES_TOGETHER
            && let Some(next) = incoming.try_recv()
        {
            n_bytes += next.item.n_bytes();
            if n_bytes > BYTES_TOGETHER || !take_in_waiting(session, &mut coming, &next.item) {
                self.next = Some(next);
                break;
            }
            others.push(next);
        }
        let is_last = self.next.as_ref().is_some_and(|next| ends_after(&next.item, &coming));
        let received = if is_last {
            session.receive_last(self.etude, coming, now).await
        } else {
            session.receive(self.etude, coming, now).await.map(|received| (received, None))
        };
        let (received, ended) = match received {
            Ok(received) => received,
            Err(error) => return self.go_on_or_end(&error).await,
        };
        for ReceivedFrame { n_received, warnings, mapped } in received {
            let mapped = match mapped {
                Ok(mapped) => mapped,
                Err(error) => return self.go_on_or_end(&error).await,
            };
            outlet.send(&ServerFrame::Received { seq: n_received, warnings: &warnings }).await?;
            let steps = match mapped {
                Received::Mapped(steps) => steps,
                Received::Waiting(waiting) => {
                    // Others have their turn.
                    tokio::task::yield_now().await;
                    session.advance(self.etude, waiting).await.map_err(|error| ends(&error))?
                }
            };
            outlet.send_steps(&steps).await?;
        }
        let Some(ended) = ended else { return Ok(None) };
        // What said that it ends is answered too.
        self.next = None;
        self.ended(&ended).await
    }
}

/// Whether what waits ends a demonstration that has come as far as what is coming.
fn ends_after(next: &Incoming, coming: &Coming) -> bool {
    let Incoming::Frame { text, .. } = next else { return false };
    text.len() <= SMALL_FRAME_BYTES
        && matches!(read_frame(text), Ok(ClientFrame::End { seq }) if Some(seq) == coming.n_received())
}

/// Takes in a frame that waits, if it is one of observations with which nothing is wrong. Says whether it was taken; whatever else it is, it is
/// to be answered by itself.
fn take_in_waiting(session: &Session, coming: &mut Coming, next: &Incoming) -> bool {
    let Incoming::Frame { text, .. } = next else { return false };
    if take_in_text(session, coming, text) {
        return true;
    }
    let Ok(ClientFrame::Observe { seq, frame }) = read_frame(text) else { return false };
    take_in(session, coming, seq, &frame).is_ok()
}

/// Takes in a frame of observations that come next and have no weights of their own, if nothing is wrong with it. Says whether it was taken.
fn take_in_text(session: &Session, coming: &mut Coming, text: &[u8]) -> bool {
    let members = std::str::from_utf8(text).ok().and_then(|text| Members::split(text, ClientFrame::OBSERVE_FIELDS));
    let Some(mut members) = members else { return false };
    let is_plain = members.take("type") == Some("\"observe\"") && members.take("observation_weights").is_none();
    let seq = members.take("seq").and_then(|seq| seq.parse().ok());
    let next = seq.zip(members.take("states")).filter(|_| is_plain);
    next.is_some_and(|(seq, states)| session.take_in_next(coming, seq, states))
}

fn take_in(session: &Session, coming: &mut Coming, seq: u32, frame: &Value) -> Result<(), SessionError> {
    let root = Place::root(frame);
    let states = Place { value: &frame["states"], path: Path::Member(&root.path, "states") };
    let weights = root.value.get("observation_weights").filter(|weights| !weights.is_null());
    let weights = weights.map(|value| Place { value, path: Path::Member(&root.path, "observation_weights") });
    session.take_in(coming, seq, &states, weights.as_ref())
}
