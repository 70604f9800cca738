//! Threads that jobs take turns on: who uses one, and who waits for one.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustc_hash::FxHashMap;
use tokio::sync::oneshot;

use super::PoolSettings;
use super::turns::{Class, LENT_AFTER, Level, Ticket, Turns};
use crate::client::Client;
use crate::clock::Clock;

/// Threads that jobs take turns on.
#[derive(Debug)]
pub(super) struct Threads(Mutex<Lines>);

#[derive(Debug)]
pub(super) struct Lines {
    clock: Clock,
    pub(super) turns: Turns,
    /// How to tell those who wait.
    waiting: FxHashMap<Ticket, oneshot::Sender<Class>>,
    /// Jobs that have made way and wait with all that they have done.
    pub(super) n_parked: usize,
}

impl Lines {
    /// Tells those whose turn it is.
    fn pass_on(&mut self) {
        while let Some((ticket, class)) = self.turns.next(self.clock.instant()) {
            if let Some(waiting) = self.waiting.remove(&ticket) {
                // Whoever has gone gives the thread back.
                let _ = waiting.send(class);
            }
        }
    }
}

impl Threads {
    pub(super) fn new(settings: PoolSettings, clock: Clock) -> Self {
        let n_short = settings.n_threads.max(1) + settings.max_waiting;
        let turns = Turns::new(settings.n_threads, n_short, settings.max_long);
        Self(Mutex::new(Lines { clock, turns, waiting: FxHashMap::default(), n_parked: 0 }))
    }

    /// The lines. A panic while they were locked leaves them whole.
    pub(super) fn lines(&self) -> MutexGuard<'_, Lines> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a thread, or lines up for one.
    pub(super) fn start_or_wait(self: &Arc<Self>, client: Client, class: Class, level: Level) -> Result<Turn, Waiting> {
        let mut lines = self.lines();
        let now = lines.clock.instant();
        if let Some(class) = lines.turns.try_start(client, class, now) {
            return Ok(Turn { threads: Arc::clone(self), client, class });
        }
        Err(self.line_up(&mut lines, client, class, level))
    }

    pub(super) fn line_up(self: &Arc<Self>, lines: &mut Lines, client: Client, class: Class, level: Level) -> Waiting {
        let (sender, granted) = oneshot::channel();
        let ticket = lines.turns.wait(client, class, level);
        lines.waiting.insert(ticket, sender);
        Waiting { threads: Arc::clone(self), client, class, ticket: Some(ticket), granted }
    }
}

/// The right to use a thread, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    pub(super) threads: Arc<Threads>,
    pub(super) client: Client,
    pub(super) class: Class,
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut lines = self.threads.lines();
        lines.turns.stop(self.client, self.class);
        lines.pass_on();
    }
}

/// A job that waits for its turn, until it is dropped.
#[derive(Debug)]
pub(super) struct Waiting {
    threads: Arc<Threads>,
    client: Client,
    class: Class,
    /// `None` once it has its turn.
    ticket: Option<Ticket>,
    granted: oneshot::Receiver<Class>,
}

impl Waiting {
    pub(super) async fn turn(mut self) -> Turn {
        loop {
            tokio::select! {
                biased;
                Ok(class) = &mut self.granted => {
                    self.ticket = None;
                    return Turn { threads: Arc::clone(&self.threads), client: self.client, class };
                }
                // By now long jobs may have been lent another thread.
                () = tokio::time::sleep(LENT_AFTER), if self.class == Class::Long => self.threads.lines().pass_on(),
            }
        }
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        let Some(ticket) = self.ticket else { return };
        let mut lines = self.threads.lines();
        lines.waiting.remove(&ticket);
        if !lines.turns.give_up(self.client, self.class, ticket)
            && let Ok(class) = self.granted.try_recv()
        {
            // Its turn was granted, but never used.
            lines.turns.stop(self.client, class);
        }
        lines.pass_on();
    }
}
