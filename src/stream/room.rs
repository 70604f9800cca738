//! What a stream takes of the memory of the service.

use std::time::Duration;

use tokio::sync::OnceCell;

use super::engine::Limits;
use super::queue::QUEUE_BYTES;
use crate::memory::{Held, Memory, NoRoom};

/// How much is read from a socket at once. Held by every stream, most of which wait for a small frame; a larger one is read in
/// several goes.
pub const READ_BUFFER_BYTES: usize = 8 << 10;

/// How much of what goes to the client is gathered before it is written.
pub const WRITE_BUFFER_BYTES: usize = 8 << 10;

/// Frames up to this size need no more memory than every stream has; larger ones take theirs.
pub const SMALL_FRAME_BYTES: usize = 16 << 10;

/// What every stream takes for its buffers: what was read, frames that wait to be handled, frames that wait to be written, and a frame
/// that is written with what was gathered before. 64 KiB.
const STREAM_BYTES: u64 =
    (READ_BUFFER_BYTES + QUEUE_BYTES as usize + QUEUE_BYTES as usize + WRITE_BUFFER_BYTES + SMALL_FRAME_BYTES) as u64;

/// What a stream takes besides, once a frame is larger than small, until its end, as buffers do not shrink: so many of the largest frames.
/// One is read while another one waits to be written and a third one is.
const LARGE_FRAMES: u64 = 3;

/// What a frame takes that is larger than small while it is handled, for each of its bytes: its text, and what is read from that.
const BYTES_PER_FRAME_BYTE: u64 = 16;

/// What a stream takes of the memory of the service.
///
/// Not counted is what has come of a frame that is not complete, of which a transport may not tell.
#[derive(Debug)]
pub struct Room {
    memory: Memory,
    large: OnceCell<Held>,
    limits: Limits,
    _small: Held,
}

/// There was no memory for a frame for as long as it may wait for that.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no memory for a frame of this size now")]
pub struct Crowded;

impl Room {
    /// Takes what every stream does.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if it is not free.
    pub fn admit(memory: &Memory, limits: Limits) -> Result<Self, NoRoom> {
        Ok(Self { memory: memory.clone(), large: OnceCell::new(), limits, _small: memory.try_take(STREAM_BYTES)? })
    }

    /// Takes what buffers need for a frame of `n_bytes`, until the stream ends.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if that is not free for as long as a slow reader is waited for.
    pub async fn take_for_buffers(&self, n_bytes: usize) -> Result<(), Crowded> {
        if n_bytes > SMALL_FRAME_BYTES {
            let n_bytes = LARGE_FRAMES * self.limits.frame_bytes as u64;
            self.large.get_or_try_init(|| self.take(n_bytes)).await?;
        }
        Ok(())
    }

    /// Takes what a frame of `n_bytes` needs that came, until it is handled.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if that is not free for as long as a slow reader is waited for.
    pub async fn take_for_frame(&self, n_bytes: usize) -> Result<Option<Held>, Crowded> {
        self.take_for_buffers(n_bytes).await?;
        let is_small = n_bytes <= SMALL_FRAME_BYTES;
        if is_small { Ok(None) } else { self.take(BYTES_PER_FRAME_BYTE * n_bytes as u64).await.map(Some) }
    }

    async fn take(&self, n_bytes: u64) -> Result<Held, Crowded> {
        let patience: Duration = self.limits.slow_after;
        tokio::time::timeout(patience, self.memory.take(n_bytes)).await.map_err(|_| Crowded)?.map_err(|_| Crowded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIB: u64 = 1 << 10;

    const LIMITS: Limits = Limits {
        frame_bytes: 256 << 10,
        streams: 1,
        slow_after: Duration::from_secs(10),
        idle_after: Duration::from_hours(1),
        ping_every: Duration::from_secs(30),
    };

    #[tokio::test]
    async fn a_stream_takes_little_until_a_frame_is_large() {
        let memory = Memory::with_room(8 << 20);
        let taken = || ((8 << 20) - memory.free()) / KIB;
        let room = Room::admit(&memory, LIMITS).unwrap();
        assert_eq!(taken(), 64);
        assert!(room.take_for_frame(SMALL_FRAME_BYTES).await.unwrap().is_none());
        assert_eq!(taken(), 64);
        let held = room.take_for_frame(100 << 10).await.unwrap();
        assert_eq!(taken(), 64 + 3 * 256 + 16 * 100);
        drop(held);
        assert_eq!(taken(), 64 + 3 * 256, "buffers do not shrink");
        room.take_for_buffers(200 << 10).await.unwrap();
        assert_eq!(taken(), 64 + 3 * 256);
        drop(room);
        assert_eq!(taken(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn a_large_frame_waits_for_memory_but_not_for_ever() {
        let memory = Memory::with_room(1 << 20);
        let room = Room::admit(&memory, LIMITS).unwrap();
        let others = memory.try_take(memory.free()).unwrap();
        assert!(Room::admit(&memory, LIMITS).is_err());
        let started = tokio::time::Instant::now();
        assert_eq!(room.take_for_buffers(SMALL_FRAME_BYTES + 1).await, Err(Crowded));
        assert_eq!(started.elapsed(), LIMITS.slow_after);
        let mut waiting = Box::pin(room.take_for_buffers(SMALL_FRAME_BYTES + 1));
        assert!(futures_util::poll!(&mut waiting).is_pending());
        drop(others);
        assert_eq!(waiting.await, Ok(()));
    }
}
