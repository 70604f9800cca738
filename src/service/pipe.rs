//! Bytes on their way from an asynchronous task to a thread that reads them.
//!
//! This is not tokio-util's `SyncIoBridge`, by which the thread would own the body: here the task keeps it, measures how fast it comes,
//! and throws the rest away once the reader has ended. A reader whose writer is gone fails, and takes what came for no whole.

use std::io::{self, BufRead, Read};

use tokio::sync::mpsc;

/// Chunks that wait, besides the one that is read and the one that is made.
const MAX_WAITING: usize = 1;

/// A way for chunks of bytes, and its end that is read, outside of asynchronous tasks.
pub(crate) fn pipe<B: AsRef<[u8]>>() -> (PipeWriter<B>, PipeReader<B>) {
    let (sender, chunks) = mpsc::channel(MAX_WAITING);
    (PipeWriter(sender), PipeReader { chunks, current: None, position: 0, has_ended: false })
}

/// The end that chunks are put into.
#[derive(Debug)]
pub(crate) struct PipeWriter<B>(mpsc::Sender<Option<io::Result<B>>>);

impl<B> PipeWriter<B> {
    /// Sends a chunk, or what the reader is to fail with. `false` if the reader is gone.
    pub(crate) async fn send(&self, chunk: io::Result<B>) -> bool {
        self.0.send(Some(chunk)).await.is_ok()
    }

    /// Says that all was sent. Dropping the pipe does not: then the reader fails.
    pub(crate) async fn end(self) {
        // The reader may be gone.
        let _ = self.0.send(None).await;
    }
}

/// Reads chunks as they come.
#[derive(Debug)]
pub(crate) struct PipeReader<B> {
    chunks: mpsc::Receiver<Option<io::Result<B>>>,
    current: Option<B>,
    position: usize,
    has_ended: bool,
}

impl<B: AsRef<[u8]>> BufRead for PipeReader<B> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        while !self.has_ended && self.current.as_ref().is_none_or(|chunk| self.position == chunk.as_ref().len()) {
            match self.chunks.blocking_recv() {
                Some(Some(chunk)) => (self.current, self.position) = (Some(chunk?), 0),
                Some(None) => (self.current, self.position, self.has_ended) = (None, 0, true),
                None => return Err(io::ErrorKind::UnexpectedEof.into()),
            }
        }
        Ok(self.current.as_ref().map_or(&[], |chunk| &chunk.as_ref()[self.position..]))
    }

    fn consume(&mut self, n_bytes: usize) {
        self.position += n_bytes;
    }
}

impl<B: AsRef<[u8]>> Read for PipeReader<B> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n_read = self.fill_buf()?.read(buffer)?;
        self.consume(n_read);
        Ok(n_read)
    }
}
