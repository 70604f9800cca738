//! How a long computation is stopped from outside.
//!
//! The core has no clock and no cancellation token of its own: it asks its caller, every few hundred steps, whether to
//! go on. What the answer rests on (a deadline, a vanished client, a shutdown) is the caller's affair.

/// What a long computation is told when it asks whether to go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Go on.
    Continue,
    /// Time is up: answer with the best that is known.
    Finish,
    /// Nobody waits for an answer: stop at once.
    Cancel,
}

/// A computation was told to [`Signal::Cancel`] and has no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;

/// Asked by a long computation whether to go on. Called often, so it should be cheap.
pub trait Interrupt {
    /// What to do next.
    fn poll(&mut self) -> Signal;
}

impl<F: FnMut() -> Signal> Interrupt for F {
    fn poll(&mut self) -> Signal {
        self()
    }
}

/// Never interrupts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uninterrupted;

impl Interrupt for Uninterrupted {
    fn poll(&mut self) -> Signal {
        Signal::Continue
    }
}
