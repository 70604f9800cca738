//! What streams take of the service: places and memory.
//!
//! All streams together take half of the memory at most, and half of that while they are idle.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::limits::Limits;
use super::queue::QUEUE_BYTES;
use crate::memory::{Held, Memory, NoRoom};
use crate::service::{Client, Places};

/// How much is read from a socket at once. Held by every stream, most of which wait for a small frame; a larger one is read in
/// several goes.
pub const READ_BUFFER_BYTES: usize = 8 << 10;

/// How much of what goes to the client is gathered before it is written.
pub const WRITE_BUFFER_BYTES: usize = 8 << 10;

/// Frames up to this size need no more memory than every stream has; larger ones take theirs.
pub const SMALL_FRAME_BYTES: usize = 16 << 10;

/// What every stream takes for its buffers: what was read, and may be a part of a frame of what was put together of it; frames that wait to
/// be handled; frames that wait to be written; and a frame that is written with what was gathered before. 80 KiB.
const STREAM_BYTES: u64 =
    (3 * READ_BUFFER_BYTES + QUEUE_BYTES as usize + QUEUE_BYTES as usize + WRITE_BUFFER_BYTES + SMALL_FRAME_BYTES)
        as u64;

/// What a frame takes that is larger than small while it comes, for each of its bytes, as what it is collected in may be twice as large.
const BYTES_PER_READ_BYTE: u64 = 2;

/// What a frame takes that is larger than small while it is handled, for each of its bytes: its text, and what is read from that. The
/// smallest objects, such as `{"x":1}`, take most, as each has a node of 11 entries.
const BYTES_PER_FRAME_BYTE: u64 = 96;

/// Room for all streams. Clones share it.
#[derive(Clone, Debug)]
pub struct Rooms(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    memory: Memory,
    /// The part of it that is for streams.
    part: Memory,
    places: Mutex<Places>,
    limits: Limits,
}

impl Rooms {
    /// Room for as many streams as there may be.
    #[must_use]
    pub fn new(memory: &Memory, limits: Limits) -> Self {
        let part = Memory::with_room(Self::part_bytes(memory));
        let places = Mutex::new(Places::new(limits.streams));
        Self(Arc::new(Shared { memory: memory.clone(), part, places, limits }))
    }

    /// How many streams there may be, however little each of them needs.
    #[must_use]
    pub fn most_streams(memory: &Memory) -> usize {
        usize::try_from(Self::part_bytes(memory) / 2 / STREAM_BYTES).unwrap_or(usize::MAX)
    }

    fn part_bytes(memory: &Memory) -> u64 {
        memory.room() / 2
    }

    /// Room for a stream of `client`: what every one takes. A client may have as many streams as it leaves to others.
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

/// Why there is no room for one more stream now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NotAdmitted {
    /// As many streams run as may, or as many of this client's.
    #[error("as many streams run as may")]
    NoPlace,
    /// There is no memory for it.
    #[error("there is no memory for one more stream now")]
    NoRoom(#[from] NoRoom),
}

/// Memory that a stream has taken, until this is dropped.
#[derive(Debug)]
pub struct Taken {
    _part: Held,
    _whole: Held,
}

/// A place for a stream, until this is dropped.
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

/// What a stream takes of the service.
#[derive(Debug)]
pub struct Room {
    /// For the frame that comes.
    reading: Mutex<Vec<Taken>>,
    _small: Taken,
    place: StreamPlace,
}

/// There was no memory for a frame for as long as it may wait for that.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no memory for a frame of this size now")]
pub struct Crowded;

impl Room {
    /// Takes what so many more bytes of a frame need that is larger than small, until [`Self::has_read`].
    ///
    /// # Errors
    ///
    /// [`Crowded`] if that is not free for as long as a slow reader is waited for.
    pub async fn take_to_read(&self, n_bytes: u64) -> Result<(), Crowded> {
        let taken = self.take(BYTES_PER_READ_BYTE * n_bytes).await?;
        self.reading().push(taken);
        Ok(())
    }

    /// Gives back what was taken to read a frame, which is complete.
    pub fn has_read(&self) {
        self.reading().clear();
    }

    /// Takes what a frame of `n_bytes` needs that came, until it is handled: nothing if it is small.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if that is not free for as long as a slow reader is waited for.
    pub async fn take_to_handle(&self, n_bytes: usize) -> Result<Option<Taken>, Crowded> {
        self.take_if_large(n_bytes, BYTES_PER_FRAME_BYTE).await
    }

    /// Takes what a frame of `n_bytes` needs that goes to the client, until it is written: nothing if it is small.
    ///
    /// # Errors
    ///
    /// [`Crowded`] if that is not free for as long as a slow reader is waited for.
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
