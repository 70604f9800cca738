//! Bytes of a body that gather, and the memory that they take.

use axum::body::Bytes;

use super::answer::{self, UNCOUNTED_BYTES};
use crate::memory::{Held, Memory, NoRoom};

/// Bytes that are collected, whose memory is held if they are many.
pub(super) struct Collected<'m> {
    memory: &'m Memory,
    /// Most bodies come in one piece, which is not copied. All that there is, unless there are `bytes`.
    first: Bytes,
    bytes: Vec<u8>,
    /// The memory that is taken, if it is counted.
    held: Option<Held>,
}

impl<'m> Collected<'m> {
    pub(super) fn new(memory: &'m Memory) -> Self {
        Self { memory, first: Bytes::new(), bytes: Vec::new(), held: None }
    }

    pub(super) fn n_bytes(&self) -> usize {
        self.first.len().max(self.bytes.len())
    }

    /// How many bytes have room without more memory.
    pub(super) fn capacity(&self) -> usize {
        self.bytes.capacity()
    }

    /// Adds a chunk that may be kept as it is.
    pub(super) fn add(&mut self, chunk: Bytes) -> Result<(), NoRoom> {
        if self.n_bytes() == 0 {
            self.reserve(chunk.len())?;
            self.first = chunk;
            return Ok(());
        }
        if self.bytes.is_empty() {
            let first = std::mem::take(&mut self.first);
            self.push(&first)?;
        }
        self.push(&chunk)
    }

    pub(super) fn push(&mut self, chunk: &[u8]) -> Result<(), NoRoom> {
        let n_bytes = self.bytes.len() + chunk.len();
        if n_bytes > self.bytes.capacity() {
            // By what has arrived: a client need not send what it has announced.
            let capacity = n_bytes.next_power_of_two();
            self.reserve(capacity)?;
            self.bytes.reserve_exact(capacity - self.bytes.len());
        }
        self.bytes.extend_from_slice(chunk);
        Ok(())
    }

    /// Takes memory until `n_bytes` are held, if that is much.
    pub(super) fn reserve(&mut self, n_bytes: usize) -> Result<(), NoRoom> {
        match &mut self.held {
            Some(held) => held.grow_to(n_bytes as u64)?,
            None if n_bytes > UNCOUNTED_BYTES => self.held = Some(self.memory.try_take(n_bytes as u64)?),
            None => {}
        }
        Ok(())
    }

    /// The bytes, and their memory.
    pub(super) fn into_parts(self) -> (Bytes, Option<Held>) {
        let Self { first, bytes, mut held, .. } = self;
        if let Some(held) = &mut held {
            held.shrink_to(first.len().max(bytes.capacity()) as u64);
        }
        (if bytes.is_empty() { first } else { bytes.into() }, held)
    }

    /// The bytes, which hold their memory.
    pub(super) fn into_bytes(self) -> Bytes {
        let (bytes, held) = self.into_parts();
        answer::holding(bytes, held)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_taken_as_bytes_come_and_held_as_long_as_they_are() {
        let memory = Memory::with_room(1 << 20);
        let chunk = |n_bytes: usize| Bytes::from(vec![b' '; n_bytes]);
        let mut small = Collected::new(&memory);
        small.add(chunk(UNCOUNTED_BYTES / 2)).unwrap();
        small.add(chunk(UNCOUNTED_BYTES / 2)).unwrap();
        assert_eq!(memory.free(), 1 << 20, "what is small is not counted");
        small.add(chunk(1)).unwrap();
        let bytes = small.into_bytes();
        assert_eq!((bytes.len(), memory.free()), (UNCOUNTED_BYTES + 1, (1 << 20) - 2 * UNCOUNTED_BYTES as u64));
        let part = bytes.slice(..10);
        drop(bytes);
        assert!(memory.free() < 1 << 20);
        drop(part);
        assert_eq!(memory.free(), 1 << 20);
        let mut large = Collected::new(&memory);
        let refused = (0..1 << 10).find_map(|_| large.add(chunk(UNCOUNTED_BYTES)).err());
        assert_eq!(refused, Some(NoRoom { wanted: 2 << 20, room: 1 << 20 }));
        drop(large);
        assert_eq!(memory.free(), 1 << 20);
    }
}
