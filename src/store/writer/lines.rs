//! Where requests wait for the writer.

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::MAX_GROUP;
use super::verb::Job;

/// Requests with more bytes are large. A group of small ones comes to 1 MiB at most.
pub(super) const MAX_SMALL_BYTES: usize = 4 << 10;

/// A group that has so much of large requests takes no more of them. One piece of a definition comes to about twice as much.
pub(in crate::store) const MAX_LARGE_BYTES: usize = 512 << 10;

/// Most requests that wait in a line. Beyond this, those who ask wait to get in line, which slows their clients down.
pub(super) const MAX_WAITING: usize = 1024;

/// Requests that wait for the writer, in two lines. Requests of a line are written in the order in which they came; between the lines
/// there is no order.
#[derive(Debug)]
pub(super) struct Lines {
    /// All of it goes into the next group.
    small: mpsc::Receiver<Job>,
    /// A part of it goes into the next group. Each caller waits for its answer before it writes again, so that all have their turns.
    large: mpsc::Receiver<Job>,
    closing: CancellationToken,
    has_small_ended: bool,
    has_large_ended: bool,
}

impl Lines {
    /// The lines, and their senders: for small requests, and for large ones.
    pub(super) fn new(closing: CancellationToken) -> (Self, [mpsc::Sender<Job>; 2]) {
        let (small_end, small) = mpsc::channel(MAX_WAITING);
        let (large_end, large) = mpsc::channel(MAX_WAITING);
        let lines = Self { small, large, closing, has_small_ended: false, has_large_ended: false };
        (lines, [small_end, large_end])
    }

    /// Waits until there is something for a group, and takes it. Says whether there was any: not once everything was taken and nobody
    /// may bring more.
    pub(super) async fn take(&mut self, group: &mut Vec<Job>) -> bool {
        let mut n_large_bytes = 0;
        while group.is_empty() {
            if self.has_small_ended && self.has_large_ended {
                return false;
            }
            tokio::select! {
                biased;
                () = self.closing.cancelled(), if !(self.small.is_closed() && self.large.is_closed()) => {
                    // What waits is still received.
                    self.small.close();
                    self.large.close();
                }
                n_jobs = self.small.recv_many(group, MAX_GROUP), if !self.has_small_ended => {
                    self.has_small_ended = n_jobs == 0;
                }
                job = self.large.recv(), if !self.has_large_ended => match job {
                    Some(job) => {
                        n_large_bytes += job.n_bytes();
                        group.push(job);
                    }
                    None => self.has_large_ended = true,
                },
            }
        }
        while n_large_bytes < MAX_LARGE_BYTES
            && group.len() < 2 * MAX_GROUP
            && let Ok(job) = self.large.try_recv()
        {
            n_large_bytes += job.n_bytes();
            group.push(job);
        }
        true
    }

    /// Takes what waits now, and nothing that comes meanwhile.
    pub(super) fn drain(&mut self) -> impl Iterator<Item = Job> {
        let (n_small, n_large) = (self.small.len(), self.large.len());
        let small = (0..n_small).map_while(|_| self.small.try_recv().ok());
        small.chain((0..n_large).map_while(|_| self.large.try_recv().ok()))
    }
}
