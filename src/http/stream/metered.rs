//! The frames of a websocket as they come, before they are put together.
//!
//! ```text
//! socket -> buffer -> at the head of a frame: pause? memory? -> small frames as they are, large ones in pieces -> websocket
//! ```
//!
//! Buffers of a websocket grow to the largest frame and never shrink; of pieces, they stay small. For a message that is not small, memory
//! is taken before it is read. What says nothing, such as a ping, is read slowly where there is much of it.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::pause::Pause;
use crate::stream::{READ_BUFFER_BYTES, Room, SMALL_FRAME_BYTES};

/// Frames that are larger come in pieces of this size. A multiple of 4, the size of a mask.
const PIECE_BYTES: u64 = READ_BUFFER_BYTES as u64;

/// A part of a message that is smaller says next to nothing.
const MIN_PART_BYTES: u64 = 1024;

/// Set in the first byte of the last frame of a message.
const FINAL: u8 = 0x80;

/// Set in the opcode of a frame that is no part of a message.
const CONTROL: u8 = 0x08;

/// Set in the second byte of a frame that is masked.
const MASKED: u8 = 0x80;

/// A socket that is read by a websocket.
pub(super) struct Metered<'r, S> {
    socket: S,
    room: &'r Room,
    max_bytes: u64,
    buffer: Box<[u8]>,
    /// What of the buffer was read from the socket and not passed on.
    unread: std::ops::Range<usize>,
    /// What is left of the head that is passed on.
    head: Vec<u8>,
    /// What is left of the piece that is passed on, and of the frame after that.
    n_in_piece: u64,
    n_after_piece: u64,
    /// The frame that is passed on.
    frame: Head,
    /// What has come of the message that is not complete.
    message_bytes: u64,
    /// Whether memory is taken for the next frame.
    is_paid: bool,
    pause: Pause,
    waiting: Option<Pin<Box<dyn Future<Output = io::Result<()>> + Send + 'r>>>,
}

/// The head of a frame.
#[derive(Clone, Copy, Default)]
struct Head {
    first: u8,
    mask: Option<[u8; 4]>,
    n_bytes: u64,
}

impl Head {
    const MAX_BYTES: usize = 14;

    /// The head that begins here, and how long it is.
    fn read(bytes: &[u8]) -> Option<(Self, usize)> {
        let (&[first, second], rest) = bytes.split_first_chunk()?;
        let (n_bytes, rest) = match second & !MASKED {
            126 => rest.split_first_chunk().map(|(length, rest)| (u16::from_be_bytes(*length).into(), rest))?,
            127 => rest.split_first_chunk().map(|(length, rest)| (u64::from_be_bytes(*length), rest))?,
            length => (length.into(), rest),
        };
        let is_masked = second & MASKED != 0;
        let (mask, rest) =
            if is_masked { rest.split_first_chunk().map(|(mask, rest)| (Some(*mask), rest))? } else { (None, rest) };
        Some((Self { first, mask, n_bytes }, bytes.len() - rest.len()))
    }

    fn write(self, to: &mut Vec<u8>) {
        let masked = if self.mask.is_some() { MASKED } else { 0 };
        to.push(self.first);
        match (u8::try_from(self.n_bytes), u16::try_from(self.n_bytes)) {
            (Ok(length @ ..126), _) => to.push(masked + length),
            (_, Ok(length)) => {
                to.push(masked + 126);
                to.extend(length.to_be_bytes());
            }
            _ => {
                to.push(masked + 127);
                to.extend(self.n_bytes.to_be_bytes());
            }
        }
        to.extend(self.mask.into_iter().flatten());
    }

    fn is_final(self) -> bool {
        self.first & FINAL != 0
    }

    fn is_control(self) -> bool {
        self.first & CONTROL != 0
    }
}

impl<'r, S> Metered<'r, S> {
    /// Reads `socket` for a websocket that refuses messages over `max_bytes`.
    pub(super) fn new(socket: S, room: &'r Room, max_bytes: usize) -> Self {
        Self {
            socket,
            room,
            max_bytes: max_bytes as u64,
            buffer: vec![0; READ_BUFFER_BYTES].into(),
            unread: 0..0,
            head: Vec::with_capacity(Head::MAX_BYTES),
            n_in_piece: 0,
            n_after_piece: 0,
            frame: Head::default(),
            message_bytes: 0,
            is_paid: false,
            pause: Pause::default(),
            waiting: None,
        }
    }

    /// Begins the next piece of a frame, of which so many bytes are left.
    fn begin_piece(&mut self, n_left: u64) {
        let n_bytes = n_left.min(PIECE_BYTES);
        (self.n_in_piece, self.n_after_piece) = (n_bytes, n_left - n_bytes);
        // The first piece is of the frame's kind, the last one ends what the frame would have.
        let kind = if n_left == self.frame.n_bytes { self.frame.first & !FINAL } else { 0 };
        let is_last = self.n_after_piece == 0;
        let first = kind | if is_last { self.frame.first & FINAL } else { 0 };
        Head { first, n_bytes, ..self.frame }.write(&mut self.head);
    }

    /// Begins a frame. Gives what there is to wait for before.
    fn begin_frame(
        &mut self,
        frame: Head,
        n_read: usize,
    ) -> Option<Pin<Box<dyn Future<Output = io::Result<()>> + Send + 'r>>> {
        if let Some(pause) = self.pause.due() {
            return Some(Box::pin(async move {
                pause.await;
                Ok(())
            }));
        }
        let in_all = self.message_bytes.saturating_add(frame.n_bytes);
        // What is too large is refused without being read.
        let is_taken = frame.is_control() || in_all <= self.max_bytes;
        if is_taken && !frame.is_control() && in_all > SMALL_FRAME_BYTES as u64 && !self.is_paid {
            self.is_paid = true;
            let room = self.room;
            return Some(Box::pin(async move { room.take_to_read(frame.n_bytes).await.map_err(io::Error::other) }));
        }
        self.is_paid = false;
        self.unread.start += n_read;
        self.frame = frame;
        if frame.is_control() || !frame.is_final() && frame.n_bytes < MIN_PART_BYTES {
            self.pause.count();
        } else if frame.is_final() {
            self.pause.reset();
        }
        if !frame.is_control() {
            self.message_bytes = if frame.is_final() { 0 } else { in_all };
        }
        if is_taken {
            self.begin_piece(frame.n_bytes);
        } else {
            frame.write(&mut self.head);
            (self.n_in_piece, self.n_after_piece) = (frame.n_bytes, 0);
        }
        None
    }

    /// Passes on what is read already, until there is something to wait for, or nothing left.
    fn pass_on(&mut self, to: &mut ReadBuf<'_>) {
        while to.remaining() > 0 && self.waiting.is_none() {
            let unread = &self.buffer[self.unread.clone()];
            if !self.head.is_empty() {
                let n_bytes = self.head.len().min(to.remaining());
                to.put_slice(&self.head[..n_bytes]);
                self.head.drain(..n_bytes);
            } else if self.n_in_piece > 0 && !unread.is_empty() {
                let n_left = usize::try_from(self.n_in_piece).unwrap_or(usize::MAX);
                let n_bytes = unread.len().min(n_left).min(to.remaining());
                to.put_slice(&unread[..n_bytes]);
                self.unread.start += n_bytes;
                self.n_in_piece -= n_bytes as u64;
            } else if self.n_in_piece == 0 && self.n_after_piece > 0 {
                self.begin_piece(self.n_after_piece);
            } else if self.n_in_piece == 0
                && let Some((frame, n_read)) = Head::read(unread)
            {
                self.waiting = self.begin_frame(frame, n_read);
            } else {
                return;
            }
        }
    }
}

impl<S: AsyncRead + Unpin> Metered<'_, S> {
    /// Reads more into the buffer. Gives how much, nothing at the end.
    fn fill(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<usize>> {
        // At most a part of a head.
        self.buffer.copy_within(self.unread.clone(), 0);
        self.unread = 0..self.unread.len();
        let mut more = ReadBuf::new(&mut self.buffer[self.unread.end..]);
        ready!(Pin::new(&mut self.socket).poll_read(cx, &mut more))?;
        let n_read = more.filled().len();
        self.unread.end += n_read;
        Poll::Ready(Ok(n_read))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Metered<'_, S> {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, to: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = self.get_mut();
        let before = to.filled().len();
        loop {
            if let Some(waiting) = &mut this.waiting {
                ready!(waiting.as_mut().poll(cx))?;
                this.waiting = None;
            }
            this.pass_on(to);
            if to.filled().len() > before || to.remaining() == 0 {
                return Poll::Ready(Ok(()));
            }
            if this.waiting.is_none() && ready!(this.fill(cx))? == 0 {
                return Poll::Ready(Ok(()));
            }
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Metered<'_, S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.socket).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(cx)
    }
}
