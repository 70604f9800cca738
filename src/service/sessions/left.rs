//! Where sessions are left that nobody drives any more, if steps wait in them for so long at most.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use tokio::sync::mpsc;

/// How long to wait before a session is tried again that could not be taken up.
pub(super) const RETRY_AFTER: Duration = Duration::from_secs(1);

/// When a step of which session is due.
pub(super) type Due = (Instant, String);

/// Where sessions are left.
#[derive(Debug)]
pub(in crate::service) struct Left {
    /// Holds a session once for each time that it was left.
    sender: mpsc::UnboundedSender<Due>,
    /// Until somebody attends to them.
    pub(super) receiver: Mutex<Option<mpsc::UnboundedReceiver<Due>>>,
}

impl Default for Left {
    fn default() -> Self {
        let (sender, receiver) = mpsc::unbounded_channel();
        Self { sender, receiver: Mutex::new(Some(receiver)) }
    }
}

impl Left {
    /// The way for a session to be left, once it is dropped.
    pub(super) fn leaving(&self, id: &str) -> Leaving {
        Leaving { id: id.to_owned(), due: None, sender: self.sender.clone() }
    }
}

/// Leaves a session when it is dropped, if a step is due.
#[derive(Debug)]
pub(super) struct Leaving {
    id: String,
    due: Option<Instant>,
    sender: mpsc::UnboundedSender<Due>,
}

impl Leaving {
    /// A step is due then, or none is.
    pub(super) fn until(&mut self, due: Option<Instant>) {
        self.due = due;
    }
}

impl Drop for Leaving {
    fn drop(&mut self) {
        if let Some(due) = self.due {
            // Where nobody attends to it any more, the service ends.
            let _ = self.sender.send((due, std::mem::take(&mut self.id)));
        }
    }
}
