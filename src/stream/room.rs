//! Places and memory of streams.
//!
//! All streams together take at most half of the memory. Idle streams take at most half of that.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::limits::Limits;
use super::queue::QUEUE_BYTES;
use crate::client::Client;
use crate::memory::{Held, Memory, NoRoom};
use crate::service::Places;

/// How much is read from a socket at a time. The websocket fills as much with zeros whenever it looks whether something has come, which is
/// several times for an observation of some 200 bytes; a larger frame is read in several parts.
pub const READ_BUFFER_BYTES: usize = 2 << 10;

/// Size of the buffer in which frames to the client are gathered before they are written.
pub const WRITE_BUFFER_BYTES: usize = 8 << 10;

/// A frame of up to this size fits into the buffers that every stream has. A larger one takes memory of its own.
pub const SMALL_FRAME_BYTES: usize = 16 << 10;

/// Memory of the buffers of a stream, 80 KiB: what was read, with a frame of which a part has come (one and a half small frames); the queue
/// of frames to be handled; the queue of frames to be written; the write buffer, and the frame that is being written.
const STREAM_BYTES: u64 =
    (SMALL_FRAME_BYTES * 3 / 2 + QUEUE_BYTES as usize + QUEUE_BYTES as usize + WRITE_BUFFER_BYTES + SMALL_FRAME_BYTES)
        as u64;

/// Memory of a large frame while it is read, per byte of the frame: its buffer grows by doubling, so it may be twice as large.
const BYTES_PER_READ_BYTE: u64 = 2;

/// Memory of a large frame while it is handled, per byte of the frame: its text, and the JSON values parsed from it. The smallest objects,
/// such as `{"x":1}`, take most, as each is a tree node with room for 11 entries.
const BYTES_PER_FRAME_BYTE: u64 = 96;

/// The places and the memory of all streams. Clones share them.
#[derive(Clone, Debug)]
pub struct Rooms(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    memory: Memory,
    /// The part of the memory that streams may take.
    part: Memory,
    places: Mutex<Places>,
    limits: Limits,
}

impl Rooms {
    /// Places and memory for as many streams as `limits` allow.
    #[must_use]
    pub fn new(memory: &Memory, limits: Limits) -> Self {
        let part = Memory::with_room(Self::part_bytes(memory));
        let places = Mutex::new(Places::new(limits.streams));
        Self(Arc::new(Shared { memory: memory.clone(), part, places, limits }))
    }

    /// How many idle streams fit into `memory`.
    #[must_use]
    pub fn most_streams(memory: &Memory) -> usize {
        usize::try_from(Self::part_bytes(memory) / 2 / STREAM_BYTES).unwrap_or(usize::MAX)
    }

    fn part_bytes(memory: &Memory) -> u64 {
        memory.room() / 2
    }

    /// Takes a place and the memory of an idle stream for `client`. A client may have no more streams than it leaves free for others.
    ///
    /// # Errors
    ///
    /// If there is no place for it, or no memory.
    pub fn admit(&self, client: Client) -> Result<Room, NotAdmitted> {
        if !self.places().take(client) {
            return Err(NotAdmitted::NoPlace);
        }
        let place = StreamPlace { rooms: self.clone(), client };
        Ok(Room { _small: self.try_take(STREAM_BYTES)?, reading: Mutex::default(), place })
    }

    fn try_take(&self, n_bytes: u64) -> Result<Taken, NoRoom> {
        Ok(Taken { _part: self.0.part.try_take(n_bytes)?, _whole: self.0.memory.try_take(n_bytes)? })
    }

    async fn take(&self, n_bytes: u64) -> Result<Taken, NoRoom> {
        Ok(Taken { _part: self.0.part.take(n_bytes).await?, _whole: self.0.memory.take(n_bytes).await? })
    }

    fn places(&self) -> MutexGuard<'_, Places> {
        self.0.places.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Why no further stream is admitted now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotAdmitted {
    /// The limit of streams is reached, in all or for this client.
    #[error("as many streams run as may")]
    NoPlace,
    /// There is no memory for it.
    #[error("there is no memory for one more stream now")]
    NoRoom(#[from] NoRoom),
}

/// Memory that a stream has taken; dropping it gives the memory back.
#[derive(Debug)]
pub struct Taken {
    _part: Held,
    _whole: Held,
}

/// The place of a stream; dropping it gives the place back.
#[derive(Debug)]
struct StreamPlace {
    rooms: Rooms,
    client: Client,
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        self.rooms.places().give_back(self.client);
    }
}

/// The place and the memory of one stream.
#[derive(Debug)]
pub struct Room {
    /// Memory for the frame that is being read.
    reading: Mutex<Vec<Taken>>,
    _small: Taken,
    place: StreamPlace,
}

/// Memory for a frame did not become free in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no memory for a frame of this size now")]
pub struct Crowded;

impl Room {
    /// Takes memory for `n_bytes` more of a large frame that is being read. It is given back by [`Self::has_read`].
    ///
    /// # Errors
    ///
    /// [`Crowded`] if the memory does not become free within the time that a slow reader is given.
    pub async fn take_to_read(&self, n_bytes: u64) -> Result<(), Crowded> {
        let taken = self.take(BYTES_PER_READ_BYTE * n_bytes).await?;
        self.reading().push(taken);
        Ok(())
    }

    /// Gives back the memory that was taken to read a frame, once the frame is complete.
    pub fn has_read(&self) {
        self.reading().clear();
    }

    /// Takes memory to handle a frame of `n_bytes` that was read; none if the frame is small.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if the memory does not become free within the time that a slow reader is given.
    pub async fn take_to_handle(&self, n_bytes: usize) -> Result<Option<Taken>, Crowded> {
        self.take_if_large(n_bytes, BYTES_PER_FRAME_BYTE).await
    }

    /// Takes memory to write a frame of `n_bytes` to the client; none if the frame is small.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if the memory does not become free within the time that a slow reader is given.
    pub async fn take_to_write(&self, n_bytes: usize) -> Result<Option<Taken>, Crowded> {
        self.take_if_large(n_bytes, 1).await
    }

    async fn take_if_large(&self, n_bytes: usize, bytes_per_byte: u64) -> Result<Option<Taken>, Crowded> {
        if n_bytes <= SMALL_FRAME_BYTES { Ok(None) } else { self.take(bytes_per_byte * n_bytes as u64).await.map(Some) }
    }

    fn reading(&self) -> MutexGuard<'_, Vec<Taken>> {
        self.reading.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn limits(&self) -> Limits {
        self.place.rooms.0.limits
    }

    async fn take(&self, n_bytes: u64) -> Result<Taken, Crowded> {
        let patience: Duration = self.limits().slow_after;
        tokio::time::timeout(patience, self.place.rooms.take(n_bytes)).await.map_err(|_| Crowded)?.map_err(|_| Crowded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIB: u64 = 1 << 10;

    const LIMITS: Limits = Limits {
        frame_bytes: 256 << 10,
        streams: 8,
        slow_after: Duration::from_secs(10),
        idle_after: Duration::from_hours(1),
        ping_every: Duration::from_secs(30),
    };

    #[tokio::test]
    async fn a_stream_takes_little_but_while_a_large_frame_is_read_handled_or_written() {
        let memory = Memory::with_room(64 << 20);
        let taken = || ((64 << 20) - memory.free()) / KIB;
        let room = Rooms::new(&memory, LIMITS).admit(Client::LOCAL).unwrap();
        assert_eq!(taken(), 80);
        assert!(room.take_to_handle(SMALL_FRAME_BYTES).await.unwrap().is_none());
        assert!(room.take_to_write(SMALL_FRAME_BYTES).await.unwrap().is_none());
        room.take_to_read(60 * KIB).await.unwrap();
        room.take_to_read(40 * KIB).await.unwrap();
        assert_eq!(taken(), 80 + 2 * 100);
        let held = room.take_to_handle(100 << 10).await.unwrap();
        room.has_read();
        assert_eq!(taken(), 80 + 96 * 100);
        drop(held);
        let held = room.take_to_write(100 << 10).await.unwrap();
        assert_eq!(taken(), 80 + 100);
        drop(held);
        assert_eq!(taken(), 80, "nothing large is left");
        drop(room);
        assert_eq!(taken(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn a_large_frame_waits_for_memory_but_not_for_ever() {
        let memory = Memory::with_room(4 << 20);
        let rooms = Rooms::new(&memory, LIMITS);
        let room = rooms.admit(Client::LOCAL).unwrap();
        let others = [1 << 20; 4].map(|most| memory.try_take(memory.free().min(most)).unwrap());
        assert!(matches!(rooms.admit(Client::LOCAL), Err(NotAdmitted::NoRoom(_))));
        assert!(
            rooms.admit(Client::LOCAL).is_err_and(|error| error != NotAdmitted::NoPlace),
            "its place is given back"
        );
        let started = crate::clock::timer_now();
        assert_eq!(room.take_to_read(20 * KIB).await, Err(Crowded));
        assert_eq!(started.elapsed(), LIMITS.slow_after);
        let mut waiting = Box::pin(room.take_to_read(20 * KIB));
        assert!(futures_util::poll!(&mut waiting).is_pending());
        drop(others);
        assert_eq!(waiting.await, Ok(()));
    }

    #[tokio::test]
    async fn one_client_leaves_as_many_streams_to_others_as_it_has() {
        let rooms = Rooms::new(&Memory::with_room(16 << 20), LIMITS);
        let client = |n| Client::from(std::net::IpAddr::from([10, 0, 0, n]));
        let of_first: Vec<Room> = std::iter::from_fn(|| rooms.admit(client(1)).ok()).collect();
        assert_eq!(rooms.admit(client(1)).err(), Some(NotAdmitted::NoPlace));
        let of_second: Vec<Room> = std::iter::from_fn(|| rooms.admit(client(2)).ok()).collect();
        assert_eq!((of_first.len(), of_second.len()), (5, 2), "of {}", LIMITS.streams);
        drop(of_first);
        assert!(rooms.admit(client(2)).is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn all_streams_together_take_half_of_the_memory_at_most() {
        let memory = Memory::with_room(64 << 20);
        let rooms = Rooms::new(&memory, LIMITS);
        let room = rooms.admit(Client::LOCAL).unwrap();
        let mut held = Vec::new();
        while let Ok(frame) = room.take_to_handle(100 << 10).await {
            held.push(frame);
        }
        assert!(memory.free() >= 32 << 20 && !held.is_empty(), "{}", memory.free());
        assert!(rooms.admit(Client::LOCAL).is_ok(), "what is small is left to others");
    }
}
