//! Waiting that ends: for what a test needs before it goes on, and for what must come at last.

use std::process::Command;
use std::sync::mpsc;
use std::time::Duration;

/// Longer than anything here takes, also on a machine that is busy with other things; a test that waits for this fails.
pub(crate) const LIMIT: Duration = Duration::from_mins(2);

/// What `future` gives.
///
/// # Panics
///
/// If it takes longer than [`LIMIT`].
#[track_caller]
pub(crate) fn within<T>(what: &str, future: impl Future<Output = T>) -> impl Future<Output = T> {
    let place = std::panic::Location::caller();
    async move {
        let done = tokio::time::timeout(LIMIT, future).await;
        done.unwrap_or_else(|_| panic!("{place}: {what} took longer than {LIMIT:?}"))
    }
}

/// Tries again and again until `attempt` gives something.
///
/// # Panics
///
/// If that takes longer than [`LIMIT`].
#[track_caller]
pub(crate) fn until<T>(what: &str, mut attempt: impl AsyncFnMut() -> Option<T>) -> impl Future<Output = T> {
    within(what, async move {
        loop {
            if let Some(found) = attempt().await {
                return found;
            }
            tokio::task::yield_now().await;
        }
    })
}

/// Kills a process that still runs after [`LIMIT`], so that whoever waits for it goes on, and fails. Nothing happens once it is dropped.
pub(crate) struct Watchdog {
    _watched: mpsc::Sender<()>,
}

impl Watchdog {
    /// Watches the process with this id.
    pub(crate) fn watch(process: u32) -> Self {
        let (watched, ended) = mpsc::channel();
        std::thread::spawn(move || {
            if ended.recv_timeout(LIMIT) == Err(mpsc::RecvTimeoutError::Timeout) {
                send_signal("-KILL", process);
            }
        });
        Self { _watched: watched }
    }
}

/// Sends a signal, such as `-TERM`, to a process.
pub(crate) fn send_signal(signal: &str, process: u32) {
    assert!(Command::new("kill").args([signal, &process.to_string()]).status().unwrap().success());
}
