//! Observations on their way into a session.

use super::SessionError;
use super::committed::CommittedSteps;
use etude_core::mapping::Warning;

/// An observation as it was read.
#[derive(Clone, Debug)]
pub struct Observation {
    /// Shape `[n_attributes]`; `None` where an attribute was not observed.
    pub values: Vec<Option<etude_core::attribute::Value>>,
    /// Its weight; `None`: what the session was opened with.
    pub weight: Option<f64>,
}

/// Frames of observations that come one after the other and are received together, by one commit.
#[derive(Debug, Default)]
pub struct Coming {
    pub(super) frames: Vec<ComingFrame>,
    /// Their observations as they are stored: an array in JSON, without its last bracket.
    pub(super) stored: String,
}

impl Coming {
    /// How many observations there are with it; `None` if nothing is coming.
    #[must_use]
    pub fn n_received(&self) -> Option<u32> {
        self.frames.last().map(|last| last.n_received)
    }
}

/// What is new of a frame.
#[derive(Debug)]
pub(super) struct ComingFrame {
    /// Index of the first of its states, which may have been received before.
    pub(super) seq: u32,
    /// How many observations there are with it.
    pub(super) n_received: u32,
    pub(super) observations: Vec<Observation>,
}

/// A frame of observations that are durable.
#[derive(Debug)]
pub struct ReceivedFrame {
    /// How many observations were received with it.
    pub n_received: u32,
    /// What there is to warn of for the first time.
    pub warnings: Vec<Warning>,
    /// What became of its observations besides. After an error the session is to be dropped.
    pub mapped: Result<Received, SessionError>,
}

/// What was received and is not mapped yet, or not in full.
#[derive(Debug, Default)]
pub struct Waiting {
    pub(super) observations: std::vec::IntoIter<Observation>,
    /// What was committed before.
    pub(super) steps: CommittedSteps,
}

impl From<Vec<Observation>> for Waiting {
    fn from(observations: Vec<Observation>) -> Self {
        Self { observations: observations.into_iter(), steps: CommittedSteps::default() }
    }
}

/// What became of observations that were received, besides being durable.
#[derive(Debug)]
pub enum Received {
    /// They were mapped at the same time, and commit these steps.
    Mapped(CommittedSteps),
    /// They take longer to be mapped: see [`Session::advance`](super::Session::advance).
    Waiting(Waiting),
}

/// What was received since the start, as it is stored, for as long as that is short: whoever ends such a session need not read it again.
#[derive(Debug, Default)]
pub(super) struct ReceivedText(Option<String>);

impl ReceivedText {
    /// Most bytes: some tens of observations.
    const MAX_BYTES: usize = 8 << 10;

    /// Nothing was received yet.
    pub(super) fn from_start() -> Self {
        Self(Some(String::new()))
    }

    /// Adds what was received next: an array in JSON that is not empty.
    pub(super) fn add(&mut self, states: &str) {
        let Some(text) = self.0.as_mut().filter(|text| text.len() + states.len() <= Self::MAX_BYTES) else {
            self.0 = None;
            return;
        };
        if text.pop().is_some() {
            text.push(',');
            text.push_str(&states[1..]);
        } else {
            text.push_str(states);
        }
    }

    /// How much memory it takes, in bytes.
    pub(super) fn n_bytes(&self) -> usize {
        self.0.as_ref().map_or(0, String::capacity)
    }

    /// Whether all that was received is known so far.
    pub(super) fn is_known(&self) -> bool {
        self.0.is_some()
    }

    /// All that was received: an array in JSON; `None` if it is not known, or nothing was.
    pub(super) fn whole(&self) -> Option<&str> {
        self.0.as_deref().filter(|text| !text.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_received_is_known_while_it_is_short() {
        let mut text = ReceivedText::from_start();
        assert_eq!(text.whole(), None);
        text.add("[[0]]");
        text.add("[0.5,[1],[2]]");
        assert_eq!(text.whole(), Some("[[0],0.5,[1],[2]]"));
        assert!(text.n_bytes() >= "[[0],0.5,[1],[2]]".len());
        text.add(&format!("[[{}]]", "9".repeat(ReceivedText::MAX_BYTES)));
        assert_eq!((text.whole(), text.n_bytes()), (None, 0));
        text.add("[[3]]");
        assert_eq!(text.whole(), None, "it is not the whole");
        let mut resumed = ReceivedText::default();
        resumed.add("[[3]]");
        assert_eq!(resumed.whole(), None);
    }
}
