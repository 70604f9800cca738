//! Slow reading of what says nothing.

use std::time::Duration;

use tokio::time::Sleep;

/// How often something that says nothing may come between two frames before reading pauses: more than any client needs.
const MAX_IN_A_ROW: u32 = 16;

/// How long it then pauses. So what says nothing costs hardly anything, and what is sent meanwhile waits at the client.
const PAUSE: Duration = Duration::from_millis(10);

/// Counts what says nothing: pings, blank lines, the smallest parts of messages.
#[derive(Debug, Default)]
pub(super) struct Pause {
    n_in_a_row: u32,
}

impl Pause {
    /// Something came that says nothing.
    pub(super) fn count(&mut self) {
        self.n_in_a_row += 1;
    }

    /// Something came that says something.
    pub(super) fn reset(&mut self) {
        self.n_in_a_row = 0;
    }

    /// A pause, if there must be one before reading on.
    pub(super) fn due(&mut self) -> Option<Sleep> {
        (self.n_in_a_row >= MAX_IN_A_ROW).then(|| {
            self.reset();
            tokio::time::sleep(PAUSE)
        })
    }
}
