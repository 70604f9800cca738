//! The stream protocol over a websocket: a message is a frame.

use axum::body::Bytes;
use futures_util::future::{BoxFuture, abortable};
use futures_util::stream::{FuturesUnordered, SplitSink, SplitStream};
use futures_util::{FutureExt, SinkExt, StreamExt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{SetOnce, mpsc};
use tokio::time::MissedTickBehavior;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::error::ProtocolError;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};
use tokio_tungstenite::tungstenite::protocol::frame::{CloseFrame, Frame};
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_util::sync::CancellationToken;

use super::metered::Metered;
use super::{CLOSE_TIMEOUT, Inlet};
use crate::client::Client;
use crate::clock::timer_now;
use crate::service::Etude;
use crate::stream::{
    self, Closed, Crowded, Incoming, Limits, Outgoing, QUEUE_BYTES, READ_BUFFER_BYTES, Receiver, Room,
    SMALL_FRAME_BYTES, WRITE_BUFFER_BYTES, queue,
};

/// How much may wait in a websocket to be written: what is gathered, a frame, and the head of that. There is no more of ours, as
/// the next frame waits for the one before. The rest is for pongs: while the client reads nothing, those that find no room are left out,
/// but for the last one.
pub(super) const MAX_WRITE_BUFFER_BYTES: usize = WRITE_BUFFER_BYTES + SMALL_FRAME_BYTES + 1024;

/// A client is gone of which nothing came for so many intervals, after all but the first of which it was asked for a sign of life.
const MAX_SILENT_INTERVALS: u32 = 3;

/// Asks for a sign of life.
struct Ping;

/// Streams over `socket` until either end closes it.
pub(super) async fn serve<S>(
    etude: &Etude,
    client: Client,
    limits: Limits,
    socket: S,
    room: &Room,
    stopping: &CancellationToken,
) where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let config = WebSocketConfig::default()
        // What is larger is answered without being read.
        .max_message_size(Some(limits.frame_bytes))
        .max_frame_size(Some(limits.frame_bytes))
        .read_buffer_size(READ_BUFFER_BYTES)
        .write_buffer_size(WRITE_BUFFER_BYTES)
        .max_write_buffer_size(MAX_WRITE_BUFFER_BYTES);
    let socket = Metered::new(socket, room, limits.frame_bytes);
    let socket = WebSocketStream::from_raw_socket(socket, Role::Server, Some(config)).await;
    let (sink, source) = socket.split();
    let (came, mut incoming) = queue(QUEUE_BYTES);
    let (outgoing, goes) = queue(QUEUE_BYTES);
    let (pinger, pings) = mpsc::channel(1);
    // The client is not there any more, or cannot be spoken to.
    let lost = SetOnce::new();
    let speaking = async {
        // A search that still runs ends with the client.
        let is_lost = async { *lost.wait().await };
        let closed = stream::run(etude, client, limits, &mut incoming, &outgoing, stopping, is_lost).await;
        incoming.close();
        // Where the queue was full until now, this is the goodbye that a slow reader gets, who is not waited for longer than before; if
        // there was one already, nobody takes another. What is left to be written may take its time.
        let patience = limits.slow_after.min(CLOSE_TIMEOUT);
        let goodbye = tokio::time::timeout(patience, outgoing.send(Outgoing::Close(closed)));
        if let Ok(Ok(())) = goodbye.await {
            drop(outgoing);
            tokio::time::sleep(CLOSE_TIMEOUT).await;
        }
    };
    let listening = async {
        let read = read(source, Inlet { came, room }, pinger, limits).await;
        if let Some(closed) = read {
            // It is set here only.
            let _ = lost.set(closed);
        }
    };
    let (speaking, speaker) = abortable(speaking);
    // Each is polled only when it was woken: an observation wakes them one after the other.
    let parts: [BoxFuture<'_, Part>; 3] = [
        listening.map(|()| Part::Listening).boxed(),
        speaking.map(|_| Part::Speaking).boxed(),
        write(sink, goes, pings, room).map(|()| Part::Writing).boxed(),
    ];
    let mut parts = FuturesUnordered::from_iter(parts);
    let mut is_heard_out = false;
    loop {
        match parts.next().await {
            Some(Part::Listening) => is_heard_out = true,
            Some(Part::Writing) => break,
            Some(Part::Speaking) | None => return,
        }
    }
    speaker.abort();
    // The client's half of the closing handshake, for which a shutdown does not wait.
    let hearing = async {
        while !is_heard_out && let Some(part) = parts.next().await {
            is_heard_out = part == Part::Listening;
        }
    };
    tokio::select! {
        () = hearing => {}
        () = stopping.cancelled() => {}
        () = tokio::time::sleep(CLOSE_TIMEOUT) => {}
    }
}

/// What a connection does, all at the same time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Listening,
    Speaking,
    Writing,
}

/// Passes on what comes, until nobody wants it; then reads on for the client's goodbye. Pings are answered by reading. Gives why the
/// client is lost, if it is.
async fn read<S>(
    mut source: SplitStream<WebSocketStream<S>>,
    inlet: Inlet<'_>,
    pinger: mpsc::Sender<Ping>,
    limits: Limits,
) -> Option<Closed>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut ticks = tokio::time::interval_at(timer_now() + limits.ping_every, limits.ping_every);
    // While the client's frames wait for us, its silence is not counted.
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut has_come, mut n_silent) = (false, 0);
    loop {
        let message = tokio::select! {
            biased;
            message = source.next() => message,
            _ = ticks.tick() => {
                n_silent = if std::mem::take(&mut has_come) { 0 } else { n_silent + 1 };
                if n_silent == MAX_SILENT_INTERVALS {
                    return Some(Closed::Silent);
                }
                if n_silent > 0 {
                    // Where one is on its way already, or nothing is written any more, there is no need for another.
                    let _ = pinger.try_send(Ping);
                }
                continue;
            }
        };
        has_come = true;
        let passed_on = match message {
            // A small one is copied, so that it does not keep what was read with it.
            Some(Ok(Message::Text(text))) if text.len() <= SMALL_FRAME_BYTES => {
                inlet.pass_on(Bytes::copy_from_slice(text.as_bytes())).await
            }
            Some(Ok(Message::Text(text))) => inlet.pass_on(text.into()).await,
            Some(Ok(Message::Binary(_))) => inlet.tell(Incoming::Binary).await,
            // A frame of its own is not given.
            Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_))) => continue,
            Some(Ok(Message::Close(_))) | None => return Some(Closed::ByClient),
            Some(Err(error)) => match what_is_wrong(error) {
                Ok(incoming) => {
                    let _ = inlet.tell(incoming).await;
                    return None;
                }
                Err(closed) => return Some(closed),
            },
        };
        if passed_on.is_break() {
            // Nobody wants it once the connection is closing. There may be much of it.
            tokio::task::yield_now().await;
        }
    }
}

/// What an error of reading tells of the client, or why that is lost.
fn what_is_wrong(error: Error) -> Result<Incoming, Closed> {
    match error {
        Error::Capacity(_) => Ok(Incoming::TooLarge),
        Error::Utf8(_) => Ok(Incoming::NotText),
        Error::Protocol(ProtocolError::ResetWithoutClosingHandshake) => Err(Closed::ByClient),
        Error::Protocol(error) => Ok(Incoming::Violation(error.to_string())),
        Error::Io(error) if error.kind() == std::io::ErrorKind::TimedOut => Err(Closed::Overloaded),
        Error::Io(error) => error.downcast::<Crowded>().map(|Crowded| Incoming::Crowded).map_err(|_| Closed::ByClient),
        _ => Err(Closed::ByClient),
    }
}

async fn write<S>(
    mut sink: SplitSink<WebSocketStream<S>, Message>,
    mut goes: Receiver<Outgoing>,
    mut pings: mpsc::Receiver<Ping>,
    room: &Room,
) where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let closed = write_frames(&mut sink, &mut goes, &mut pings, room).await;
    if let Some(closed) = closed {
        let (code, reason) = closed.code();
        let close = Message::Close(Some(CloseFrame { code: code.into(), reason: reason.into() }));
        // A client that does not read does not hear this either.
        let _ = tokio::time::timeout(CLOSE_TIMEOUT, sink.send(close)).await;
    }
}

/// Writes what goes to the client, until nothing more will. Gives how to close, if there is still something to be closed.
async fn write_frames<S>(
    sink: &mut SplitSink<WebSocketStream<S>, Message>,
    goes: &mut Receiver<Outgoing>,
    pings: &mut mpsc::Receiver<Ping>,
    room: &Room,
) -> Option<Closed>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    loop {
        let first = tokio::select! {
            biased;
            first = goes.recv() => first?,
            Some(Ping) = pings.recv() => {
                sink.flush().await.ok()?;
                sink.send(Message::Ping(Bytes::new())).await.ok()?;
                continue;
            }
        };
        // Pongs may have filled what waits to be written. They must not keep a frame of ours out, now or below.
        sink.flush().await.ok()?;
        // What waits together is written together: a write, and a wakeup of the client, cost more than a frame.
        let mut next = Some(first);
        while let Some(outgoing) = next {
            match outgoing.item {
                Outgoing::Frame(text) => {
                    let Ok(memory) = room.take_to_write(text.len()).await else { return Some(Closed::Overloaded) };
                    let is_small = memory.is_none();
                    let fed =
                        if is_small { sink.feed(Message::text(text)).await } else { write_pieces(sink, text).await };
                    if let Err(error) = fed {
                        tracing::debug!(error = &error as &dyn std::error::Error, "a frame could not be written");
                        // Where the client is gone, it does not hear this; a frame must not vanish without a word.
                        return Some(Closed::Failed);
                    }
                }
                Outgoing::Close(closed) => return Some(closed),
            }
            next = goes.try_recv();
        }
        sink.flush().await.ok()?;
    }
}

/// Writes a message in pieces, so that what they are gathered in does not grow to its size.
async fn write_pieces<S>(sink: &mut SplitSink<WebSocketStream<S>, Message>, text: String) -> Result<(), Error>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let mut left = Bytes::from(text);
    let mut kind = Data::Text;
    while !left.is_empty() {
        let piece = left.split_to(left.len().min(SMALL_FRAME_BYTES));
        sink.send(Message::Frame(Frame::message(piece, OpCode::Data(kind), left.is_empty()))).await?;
        kind = Data::Continue;
    }
    Ok(())
}
