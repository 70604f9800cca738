//! How a long computation is stopped from outside.
//!
//! The core has no clock and no cancellation token of its own: it asks its caller, again and again, whether to go on. How
//! much work lies between two questions is each computation's to choose, so that it takes milliseconds at most; a
//! [`Meter`] counts it. What the answer rests on (a deadline, a vanished client, a shutdown) is the caller's affair.

use std::time::Duration;

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

/// Why a computation has no result, as a part of it would be of no use.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Interrupted {
    /// It was told to [`Signal::Cancel`].
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// It was told to [`Signal::Finish`] before it had come to its end.
    #[error("out of time")]
    OutOfTime,
}

impl From<Interrupted> for Signal {
    fn from(interrupted: Interrupted) -> Self {
        match interrupted {
            Interrupted::Cancelled(Cancelled) => Self::Cancel,
            Interrupted::OutOfTime => Self::Finish,
        }
    }
}

/// Tells a long computation whether to go on. It is asked often, so it should be cheap.
pub trait Interrupt {
    /// What to do next.
    fn poll(&mut self) -> Signal;
}

impl<F: FnMut() -> Signal> Interrupt for F {
    fn poll(&mut self) -> Signal {
        self()
    }
}

/// How long after its start a search that must answer within `deadline` is told to [`Signal::Finish`]. The rest, a twentieth of
/// `deadline` and a few microseconds, at most ten milliseconds, is what a search needs to notice the signal, to compute its lower bound, and
/// to make the mapping.
#[must_use]
pub fn time_until_finish(deadline: Duration) -> Duration {
    const LEAST_RESERVED: Duration = Duration::from_micros(25);
    const MOST_RESERVED: Duration = Duration::from_millis(10);
    deadline.saturating_sub((LEAST_RESERVED + deadline / 20).min(MOST_RESERVED))
}

/// Never interrupts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uninterrupted;

impl Interrupt for Uninterrupted {
    fn poll(&mut self) -> Signal {
        Signal::Continue
    }
}

/// Counts the work of a long computation, and asks its [`Interrupt`] once for every so many units of it.
pub struct Meter<'i> {
    interrupt: &'i mut dyn Interrupt,
    /// Units of work between two questions.
    every: u64,
    /// Units of work until the next question.
    left: u64,
}

impl<'i> Meter<'i> {
    /// A meter that asks at the first unit of work, and then after `every` units.
    pub fn new(interrupt: &'i mut dyn Interrupt, every: u64) -> Self {
        Self { interrupt, every, left: 0 }
    }

    /// Counts `units` of work that are about to be done; asks the interrupt if it is time to, and otherwise says to continue.
    #[inline]
    pub fn spend(&mut self, units: u64) -> Signal {
        if let Some(left) = self.left.checked_sub(units) {
            self.left = left;
            return Signal::Continue;
        }
        self.left = self.every;
        self.interrupt.poll()
    }

    /// As [`Self::spend`], for work that stops whatever the signal is.
    ///
    /// # Errors
    ///
    /// What the interrupt said, if that was not to continue.
    #[inline]
    pub fn go_on(&mut self, units: u64) -> Result<(), Signal> {
        match self.spend(units) {
            Signal::Continue => Ok(()),
            signal => Err(signal),
        }
    }

    /// As [`Self::spend`], for work that is of no use unless it is finished.
    ///
    /// # Errors
    ///
    /// What the interrupt said, if that was not to continue.
    #[inline]
    pub fn spend_or_stop(&mut self, units: u64) -> Result<(), Interrupted> {
        match self.spend(units) {
            Signal::Continue => Ok(()),
            Signal::Finish => Err(Interrupted::OutOfTime),
            Signal::Cancel => Err(Interrupted::Cancelled(Cancelled)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn little_time_is_reserved_for_the_end() {
        let until_finish = [0, 1, 20, 200, 86_400_000].map(|ms| time_until_finish(Duration::from_millis(ms)));
        let micros = [0, 925, 18_975, 190_000, 86_399_990_000].map(Duration::from_micros);
        assert_eq!(until_finish, micros);
    }
}
