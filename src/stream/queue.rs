//! Queues between a transport and the protocol, bounded in bytes.
//!
//! What is queued takes room until whoever took it out is done with it: at most [`QUEUE_BYTES`] of small frames at a time, or one
//! that is larger, alone.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

/// How much there is room for: enough to keep both ends busy.
pub const QUEUE_BYTES: u32 = 16 << 10;

/// What anything queued takes at least, so that nothing is free.
const MIN_ITEM_BYTES: usize = 64;

/// Something that takes room in a queue.
pub trait Weighed {
    /// How much, in bytes.
    fn n_bytes(&self) -> usize;
}

/// A queue with room for `max_bytes`. An item that is larger takes all of the room.
#[must_use]
pub fn queue<T: Weighed>(max_bytes: u32) -> (Sender<T>, Receiver<T>) {
    let (sender, items) = mpsc::unbounded_channel();
    let room = Arc::new(Semaphore::new(max_bytes as usize));
    (Sender { items: sender, room: Arc::clone(&room), max_bytes }, Receiver { items, room })
}

/// Nobody receives any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("nobody receives any more")]
pub struct Gone;

/// The end that things are put in at.
#[derive(Debug)]
pub struct Sender<T> {
    items: mpsc::UnboundedSender<Queued<T>>,
    room: Arc<Semaphore>,
    max_bytes: u32,
}

/// Something that was queued, and its room there, until this is dropped.
#[derive(Debug)]
pub struct Queued<T> {
    /// What it is.
    pub item: T,
    _room: OwnedSemaphorePermit,
}

impl<T: Weighed> Sender<T> {
    /// Puts `item` in once there is room for it.
    ///
    /// # Errors
    ///
    /// [`Gone`] if nobody receives any more.
    pub async fn send(&self, item: T) -> Result<(), Gone> {
        self.reserve(item.n_bytes()).await?.send(item)
    }

    /// Waits until there is room for something of `n_bytes`, and keeps it.
    ///
    /// # Errors
    ///
    /// [`Gone`] if nobody receives any more.
    pub async fn reserve(&self, n_bytes: usize) -> Result<Reserved<'_, T>, Gone> {
        let n_bytes = u32::try_from(n_bytes.max(MIN_ITEM_BYTES)).unwrap_or(u32::MAX).min(self.max_bytes);
        let room = Arc::clone(&self.room).acquire_many_owned(n_bytes).await.map_err(|_| Gone)?;
        Ok(Reserved { items: &self.items, room })
    }
}

/// Room in a queue that is kept for something, until this is dropped.
#[derive(Debug)]
pub struct Reserved<'q, T> {
    items: &'q mpsc::UnboundedSender<Queued<T>>,
    room: OwnedSemaphorePermit,
}

impl<T> Reserved<'_, T> {
    /// Puts `item` in.
    ///
    /// # Errors
    ///
    /// [`Gone`] if nobody receives any more.
    pub fn send(self, item: T) -> Result<(), Gone> {
        self.items.send(Queued { item, _room: self.room }).map_err(|_| Gone)
    }
}

/// The end that things are taken out at.
#[derive(Debug)]
pub struct Receiver<T> {
    items: mpsc::UnboundedReceiver<Queued<T>>,
    room: Arc<Semaphore>,
}

impl<T> Receiver<T> {
    /// What comes next; `None` once nothing will.
    pub async fn recv(&mut self) -> Option<Queued<T>> {
        self.items.recv().await
    }

    /// What is there already.
    pub fn try_recv(&mut self) -> Option<Queued<T>> {
        self.items.try_recv().ok()
    }

    /// Lets nothing more in.
    pub fn close(&mut self) {
        self.room.close();
        self.items.close();
    }
}

/// Tells senders that wait for room that the receiver is gone.
impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        self.close();
    }
}

#[cfg(test)]
mod tests {
    use futures_util::poll;

    use super::*;

    impl Weighed for usize {
        fn n_bytes(&self) -> usize {
            *self
        }
    }

    #[tokio::test]
    async fn as_many_bytes_wait_as_there_is_room_for_and_a_larger_item_waits_alone() {
        let (sender, mut receiver) = queue(1000);
        sender.send(600).await.unwrap();
        let mut second = Box::pin(sender.send(500));
        assert!(poll!(&mut second).is_pending());
        let first = receiver.recv().await.unwrap();
        assert!(poll!(&mut second).is_pending(), "it is taken out, but not done with");
        drop(first);
        second.await.unwrap();
        let mut large = Box::pin(sender.send(1 << 40));
        assert!(poll!(&mut large).is_pending());
        drop(receiver.try_recv());
        large.await.unwrap();
        assert!(poll!(Box::pin(sender.send(1))).is_pending());
        assert_eq!(receiver.recv().await.map(|queued| queued.item), Some(1 << 40));
        for _ in 0..1000 / MIN_ITEM_BYTES {
            sender.send(0).await.unwrap();
        }
        assert!(poll!(Box::pin(sender.send(0))).is_pending(), "nothing is free");
    }

    #[tokio::test]
    async fn who_waits_for_room_hears_that_nobody_receives_any_more() {
        let (sender, mut receiver) = queue(100);
        sender.send(100).await.unwrap();
        let mut waiting = Box::pin(sender.send(100));
        assert!(poll!(&mut waiting).is_pending());
        receiver.close();
        assert_eq!(waiting.await, Err(Gone));
        assert!(receiver.recv().await.is_some(), "what was let in comes out");
        let (sender, receiver) = queue(100);
        drop(receiver);
        assert_eq!(sender.send(1).await, Err(Gone));
    }
}
