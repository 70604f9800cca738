//! Writing to a client that may not read.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use crate::clock::timer_now;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;

/// What is told when writing begins to wait, and when it goes on.
pub(super) trait Watcher: Unpin {
    fn is_writing(&self, is_writing: bool);

    /// How much longer than usual the other end is waited for.
    fn grace(&self) -> Duration;
}

/// A socket that fails with [`io::ErrorKind::TimedOut`] once a write has made no progress for a while: the other end has read nothing, and no
/// buffer in between has taken a byte.
#[derive(Debug)]
pub(super) struct Stalled<S, W> {
    socket: S,
    watcher: W,
    /// How long nothing may be read before the socket fails, besides what the watcher adds.
    timeout: Duration,
    /// Whether the last write found no room.
    is_waiting: bool,
    /// Made when it is first needed, as most answers go at once.
    alarm: Option<Pin<Box<Sleep>>>,
}

impl<S, W: Watcher> Stalled<S, W> {
    pub(super) fn new(socket: S, timeout: Duration, watcher: W) -> Self {
        Self { socket, watcher, timeout, is_waiting: false, alarm: None }
    }

    fn watch(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if written.is_ready() {
            if self.is_waiting {
                self.is_waiting = false;
                self.watcher.is_writing(false);
            }
            return written;
        }
        if !self.is_waiting {
            self.is_waiting = true;
            self.watcher.is_writing(true);
            let deadline = timer_now() + self.timeout + self.watcher.grace();
            match &mut self.alarm {
                Some(alarm) => alarm.as_mut().reset(deadline),
                None => self.alarm = Some(Box::pin(tokio::time::sleep_until(deadline))),
            }
        }
        if let Some(alarm) = &mut self.alarm {
            ready!(alarm.as_mut().poll(cx));
        }
        Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "what was sent is not read")))
    }
}

impl<S: AsyncRead + Unpin, W: Watcher> AsyncRead for Stalled<S, W> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_read(cx, buffer)
    }
}

/// A socket has nothing to flush, and is shut down at once: only writing waits for the other end.
impl<S: AsyncWrite + Unpin, W: Watcher> AsyncWrite for Stalled<S, W> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.socket).poll_write(cx, bytes);
        self.watch(cx, written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        parts: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.socket).poll_write_vectored(cx, parts);
        self.watch(cx, written)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::rc::Rc;

    use futures_util::FutureExt;
    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};

    use super::*;

    impl Watcher for Rc<Cell<bool>> {
        fn is_writing(&self, is_writing: bool) {
            self.set(is_writing);
        }

        fn grace(&self) -> Duration {
            Duration::ZERO
        }
    }

    type Written = Stalled<DuplexStream, Rc<Cell<bool>>>;

    const TIMEOUT: Duration = Duration::from_secs(10);

    /// An end that is written to, of a way that holds four bytes, the end that is read, and whether writing waits.
    fn way() -> (Written, DuplexStream, Rc<Cell<bool>>) {
        let (written, read) = duplex(4);
        let is_writing = Rc::default();
        (Stalled::new(written, TIMEOUT, Rc::clone(&is_writing)), read, is_writing)
    }

    #[tokio::test(start_paused = true)]
    async fn what_nobody_reads_is_not_written_for_ever() {
        let (mut written, read, is_writing) = way();
        let started = timer_now();
        let error = written.write_all(b"hello").await.unwrap_err();
        assert_eq!((error.kind(), started.elapsed()), (io::ErrorKind::TimedOut, TIMEOUT));
        assert!(is_writing.get());
        drop(read);
    }

    #[tokio::test(start_paused = true)]
    async fn who_reads_a_little_now_and_then_is_waited_for() {
        let (mut written, mut read, is_writing) = way();
        let writing = async {
            written.write_all(b"hello, world").await.unwrap();
            written
        };
        let reading = async {
            let mut bytes = [0; 12];
            for byte in &mut bytes {
                tokio::time::sleep(TIMEOUT * 9 / 10).await;
                *byte = read.read_u8().await.unwrap();
            }
            bytes
        };
        let (written, bytes) = tokio::join!(writing, reading);
        assert_eq!((&bytes, is_writing.get()), (b"hello, world", false));
        drop(written);
    }

    #[tokio::test(start_paused = true)]
    async fn time_between_writes_does_not_count() {
        let (mut written, mut read, is_writing) = way();
        let mut bytes = [0; 4];
        for _ in 0..3 {
            written.write_all(b"four").await.unwrap();
            tokio::time::sleep(TIMEOUT).await;
            // It waits for room, which is made just in time.
            assert!(written.write_u8(b'!').now_or_never().is_none() && is_writing.get());
            tokio::time::sleep(TIMEOUT / 2).await;
            read.read_exact(&mut bytes).await.unwrap();
            written.write_all(b"room").await.unwrap();
            read.read_exact(&mut bytes).await.unwrap();
            assert!(!is_writing.get());
        }
    }
}
