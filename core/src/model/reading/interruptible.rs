//! A text that is interrupted while nothing is made of it: blanks, or a string without end.

use std::io::{self, BufRead, Read};

use crate::interrupt::{Interrupt, Meter};

/// Bytes between two questions whether to go on, which take less than a millisecond to be read or decompressed.
const POLL_EVERY: u64 = 64 << 10;

/// A reader that fails with an [`Interrupted`](crate::interrupt::Interrupted) when it is told to stop.
pub(in crate::model) struct Interruptible<'i, R> {
    inner: R,
    meter: Meter<'i>,
    /// Bytes that were taken since they were last counted.
    n_taken: u64,
}

impl<'i, R> Interruptible<'i, R> {
    pub(in crate::model) fn new(inner: R, interrupt: &'i mut dyn Interrupt) -> Self {
        Self { inner, meter: Meter::new(interrupt, POLL_EVERY), n_taken: 0 }
    }

    fn go_on(&mut self) -> io::Result<()> {
        self.meter.spend_or_stop(std::mem::take(&mut self.n_taken)).map_err(io::Error::other)
    }
}

impl<R: Read> Read for Interruptible<'_, R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.go_on()?;
        let n_read = self.inner.read(buffer)?;
        self.n_taken += n_read as u64;
        Ok(n_read)
    }
}

impl<R: BufRead> BufRead for Interruptible<'_, R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.go_on()?;
        self.inner.fill_buf()
    }

    fn consume(&mut self, n_bytes: usize) {
        self.inner.consume(n_bytes);
        self.n_taken += n_bytes as u64;
    }
}
