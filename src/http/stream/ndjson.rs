//! The stream protocol over NDJSON: a line is a frame, in the body of the request and in that of the answer.

use std::convert::Infallible;
use std::pin::Pin;

use axum::body::{BodyDataStream, Bytes};
use axum::extract::Request;
use axum::http::header::EXPECT;
use futures_util::StreamExt;
use futures_util::stream::Peekable;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::pause::Pause;
use super::{CLOSE_TIMEOUT, Inlet};
use crate::client::Client;
use crate::service::Etude;
use crate::stream::{
    self, Closed, Incoming, Limits, Outgoing, QUEUE_BYTES, Receiver, Room, SMALL_FRAME_BYTES, Taken, queue,
};

/// Lines of an answer, on their way into its body.
pub(super) type Lines = mpsc::Sender<Result<Bytes, Infallible>>;

/// The body of a request. A client that waits to be told to send it (`Expect: 100-continue`, as `curl` does for a second) is told
/// so when the body is first asked for, which must be before the answer begins.
pub(super) async fn begin_reading(request: Request) -> Peekable<BodyDataStream> {
    let waits = request.headers().contains_key(EXPECT);
    let mut body = request.into_body().into_data_stream().peekable();
    if waits {
        let _asked = futures_util::poll!(Pin::new(&mut body).peek());
        tokio::task::yield_now().await;
    }
    body
}

/// Streams from `body` into `lines` until either ends. The answer ends with the lines; where the request goes on, it is not read any
/// more, and its connection is closed after the answer.
pub(super) async fn serve(
    etude: &Etude,
    client: Client,
    limits: Limits,
    body: Peekable<BodyDataStream>,
    lines: Lines,
    room: &Room,
    stopping: &CancellationToken,
) {
    let (came, mut incoming) = queue(QUEUE_BYTES);
    let (outgoing, goes) = queue(QUEUE_BYTES);
    let speaking = async {
        let is_lost = async {
            // The client does not read any more: it is gone.
            lines.closed().await;
            Closed::ByClient
        };
        stream::run(etude, client, limits, &mut incoming, &outgoing, stopping, is_lost).await;
        drop(outgoing);
        // What is left to be written may take this long.
        tokio::time::sleep(CLOSE_TIMEOUT).await;
    };
    let listening = async {
        read(body, limits.frame_bytes, Inlet { came, room }).await;
        std::future::pending::<()>().await;
    };
    tokio::select! {
        () = write(&lines, goes, room) => {}
        () = speaking => {}
        () = listening => {}
    }
}

/// Passes on lines as frames. Ends with the body, or with a line that ends the stream.
pub(super) async fn read(mut body: Peekable<BodyDataStream>, frame_bytes: usize, inlet: Inlet<'_>) {
    let (mut line, mut pause) = (Vec::new(), Pause::default());
    while let Some(Ok(chunk)) = body.next().await {
        for part in chunk.split_inclusive(|byte| *byte == b'\n') {
            // A line of which no end comes takes no more than one that is complete.
            let n_bytes = line.len() + part.len();
            if n_bytes > frame_bytes + 1 {
                let _ = inlet.tell(Incoming::TooLarge).await;
                return;
            }
            if n_bytes > SMALL_FRAME_BYTES {
                // With the part that makes it large comes what was small.
                let n_more = if line.len() > SMALL_FRAME_BYTES { part.len() } else { n_bytes };
                if inlet.room.take_to_read(n_more as u64).await.is_err() {
                    let _ = inlet.tell(Incoming::Crowded).await;
                    return;
                }
            }
            line.extend_from_slice(part);
            if !line.ends_with(b"\n") {
                continue;
            }
            if line.trim_ascii().is_empty() {
                line = Vec::new();
                inlet.room.has_read();
                pause.count();
                if let Some(pause) = pause.due() {
                    pause.await;
                }
                continue;
            }
            pause.reset();
            if inlet.pass_on(std::mem::take(&mut line).into()).await.is_break() {
                return;
            }
        }
    }
    if !line.trim_ascii().is_empty() {
        let _ = inlet.pass_on(line.into()).await;
    }
}

/// Lines on their way to the client, with their memory.
struct Line {
    text: String,
    _memory: Option<Taken>,
}

impl AsRef<[u8]> for Line {
    fn as_ref(&self) -> &[u8] {
        self.text.as_bytes()
    }
}

pub(super) async fn write(lines: &Lines, mut goes: Receiver<Outgoing>, room: &Room) {
    let mut next = goes.recv().await;
    while let Some(outgoing) = next.take() {
        let Outgoing::Frame(mut text) = outgoing.item else { return };
        text.push('\n');
        // What waits together is written together.
        while text.len() <= SMALL_FRAME_BYTES
            && let Some(after) = goes.try_recv()
        {
            match after.item {
                Outgoing::Frame(more) if text.len() + more.len() < SMALL_FRAME_BYTES => {
                    text.push_str(&more);
                    text.push('\n');
                }
                _ => {
                    next = Some(after);
                    break;
                }
            }
        }
        let Ok(memory) = room.take_to_write(text.len()).await else { return };
        let is_small = memory.is_none();
        let line = if is_small { text.into() } else { Bytes::from_owner(Line { text, _memory: memory }) };
        if lines.send(Ok(line)).await.is_err() {
            return;
        }
        if next.is_none() {
            next = goes.recv().await;
        }
    }
}
