//! Answers: written as JSON, with their memory counted until they are sent. Whoever reads a large one too slowly is cut off.

use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::body::{Body, Bytes, HttpBody};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use futures_util::{Stream, TryStreamExt};
use hyper::body::{Frame, SizeHint};
use serde::Serialize;
use tokio::time::Instant;

use super::problem::Problem;
use crate::clock::timer_now;
use crate::memory::{self, Held, Memory, NoRoom};
use crate::service::ServiceError;

/// Bodies and answers up to this size are not counted: the memory budget reserves room for small ones.
#[expect(clippy::cast_possible_truncation, reason = "64 KiB")]
pub(super) const UNCOUNTED_BYTES: usize = memory::UNCOUNTED_BYTES as usize;

/// How long a client may take to read an answer, however slowly it does.
const READ_TIMEOUT: Duration = Duration::from_mins(1);

/// Least rate at which an answer must be read once [`READ_TIMEOUT`] has passed. Until it is read, its memory is not free for others.
const MIN_BYTES_PER_S: u64 = 64 * 1024;

/// A JSON answer.
pub(super) fn json(status: StatusCode, answer: &impl Serialize) -> Response {
    match serde_json::to_string(answer) {
        Ok(text) => json_text(status, text),
        Err(error) => Problem::from(ServiceError::Write(error)).into_response(),
    }
}

/// An answer that is JSON already.
pub(super) fn json_text(status: StatusCode, text: String) -> Response {
    let mut response = (status, text).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    response
}

/// An answer whose JSON comes in parts.
pub(super) fn json_stream(parts: impl Stream<Item = Result<Bytes, ServiceError>> + Send + 'static) -> Response {
    // It is too late for another answer. The connection is closed in the middle of this one, so that no client takes it for complete.
    let parts = parts.inspect_err(|error| {
        tracing::error!(error = error as &dyn std::error::Error, "an answer was cut off");
    });
    let mut response = paced(Body::from_stream(parts)).into_response();
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    response
}

/// Takes the memory of an answer that is at hand, until it is written.
///
/// # Errors
///
/// If there is no room. Then the answer is what it was.
pub(super) fn count(response: &mut Response, memory: &Memory) -> Result<(), NoRoom> {
    let n_bytes = HttpBody::size_hint(response.body()).exact().unwrap_or(0);
    if n_bytes > UNCOUNTED_BYTES as u64 && response.extensions_mut().remove::<IsCounted>().is_none() {
        keep_until_sent(response, memory.try_take(n_bytes)?);
    }
    Ok(())
}

/// The memory of an answer is held already.
#[derive(Clone, Copy)]
struct IsCounted;

/// An answer whose memory was taken before, if it is much. It is not counted again.
pub(super) fn counted(mut response: Response, held: Option<Held>) -> Response {
    if let Some(mut held) = held {
        held.shrink_to(HttpBody::size_hint(response.body()).exact().unwrap_or(u64::MAX));
        keep_until_sent(&mut response, held);
        response.extensions_mut().insert(IsCounted);
    }
    response
}

fn keep_until_sent(response: &mut Response, held: Held) {
    let body = std::mem::take(response.body_mut());
    *response.body_mut() = Body::new(Paced { held: Some(held), ..Paced::new(body) });
}

/// An answer that is cut off if it is read too slowly.
pub(super) fn paced(body: Body) -> Body {
    Body::new(Paced::new(body))
}

/// Bytes that hold their memory, if there is some to be held, until the last part of them is dropped.
pub(super) fn holding(bytes: Bytes, held: Option<Held>) -> Bytes {
    struct Holding {
        bytes: Bytes,
        _held: Held,
    }
    impl AsRef<[u8]> for Holding {
        fn as_ref(&self) -> &[u8] {
            &self.bytes
        }
    }
    match held {
        Some(held) => Bytes::from_owner(Holding { bytes, _held: held }),
        None => bytes,
    }
}

/// A body that gives its data in pieces, each when the ones before are almost written.
struct Paced {
    body: Body,
    held: Option<Held>,
    /// Data from the body that was not handed on yet.
    rest: Bytes,
    n_given: u64,
    /// How long the client was waited for.
    waited: Duration,
    given_at: Option<Instant>,
}

/// The client takes too long to read an answer.
#[derive(Debug, thiserror::Error)]
#[error("the answer was read slower than {MIN_BYTES_PER_S} bytes/s")]
struct ReadTooSlowly;

impl Paced {
    fn new(body: Body) -> Self {
        Self { body, held: None, rest: Bytes::new(), n_given: 0, waited: Duration::ZERO, given_at: None }
    }
}

impl HttpBody for Paced {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = self.get_mut();
        // Only the client's time counts, not the body's.
        if let Some(given_at) = this.given_at.take() {
            this.waited += given_at.elapsed();
            if this.waited > READ_TIMEOUT + Duration::from_secs(this.n_given / MIN_BYTES_PER_S) {
                return Poll::Ready(Some(Err(axum::Error::new(ReadTooSlowly))));
            }
        }
        while this.rest.is_empty() {
            match ready!(Pin::new(&mut this.body).poll_frame(cx)?) {
                Some(frame) => match frame.into_data() {
                    Ok(data) => this.rest = holding(data, this.held.take()),
                    Err(frame) => return Poll::Ready(Some(Ok(frame))),
                },
                None => return Poll::Ready(None),
            }
        }
        let piece = this.rest.split_to(this.rest.len().min(UNCOUNTED_BYTES));
        this.n_given += piece.len() as u64;
        this.given_at = Some(timer_now());
        Poll::Ready(Some(Ok(Frame::data(piece))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        let n_left = self.rest.len() as u64;
        let of_body = HttpBody::size_hint(&self.body);
        let mut hint = SizeHint::new();
        hint.set_lower(of_body.lower() + n_left);
        if let Some(upper) = of_body.upper() {
            hint.set_upper(upper + n_left);
        }
        hint
    }
}

#[cfg(test)]
mod tests {
    use axum::response::IntoResponse;
    use futures_util::{StreamExt, stream};

    use super::*;

    #[tokio::test]
    async fn a_large_answer_holds_its_memory_until_the_last_piece_is_written() {
        let memory = Memory::with_room(1 << 20);
        let mut small = vec![b' '; UNCOUNTED_BYTES].into_response();
        count(&mut small, &memory).unwrap();
        assert_eq!(memory.free(), 1 << 20);
        let mut large = vec![b' '; UNCOUNTED_BYTES * 3 + 1].into_response();
        count(&mut large, &memory).unwrap();
        let free = memory.free();
        assert_eq!(free, (1 << 20) - (3 * UNCOUNTED_BYTES as u64 + 4096));
        assert_eq!(HttpBody::size_hint(large.body()).exact(), Some(3 * UNCOUNTED_BYTES as u64 + 1));
        let pieces: Vec<_> = large.into_body().into_data_stream().collect().await;
        let sizes: Vec<_> = pieces.iter().map(|piece| piece.as_ref().unwrap().len()).collect();
        assert_eq!((sizes, memory.free()), (vec![UNCOUNTED_BYTES, UNCOUNTED_BYTES, UNCOUNTED_BYTES, 1], free));
        drop(pieces);
        assert_eq!(memory.free(), 1 << 20);
        let mut too_large = vec![b' '; 2 << 20].into_response();
        assert!(count(&mut too_large, &memory).is_err());
    }

    #[tokio::test]
    async fn an_answer_whose_memory_was_taken_before_is_not_counted_again() {
        let memory = Memory::with_room(1 << 20);
        let held = memory.try_take(1 << 20).unwrap();
        let mut response = counted(vec![b' '; 1 << 19].into_response(), Some(held));
        assert_eq!(memory.free(), 1 << 19, "what it does not need is given back");
        let _others = memory.try_take(1 << 19).unwrap();
        count(&mut response, &memory).unwrap();
        drop(response);
        assert_eq!(memory.free(), 1 << 19);
    }

    #[tokio::test]
    async fn an_answer_that_is_dropped_gives_its_memory_back() {
        let memory = Memory::with_room(1 << 20);
        let mut response = vec![b' '; 1 << 20].into_response();
        count(&mut response, &memory).unwrap();
        assert_eq!(memory.free(), 0);
        drop(response);
        assert_eq!(memory.free(), 1 << 20);
    }

    /// Reads an answer, a piece after each `pause`. Gives what was read of it, and for how long.
    async fn read(body: Body, pause: Duration) -> (usize, Duration, bool) {
        let (mut pieces, started, mut n_read) = (body.into_data_stream(), timer_now(), 0);
        while let Some(piece) = pieces.next().await {
            let Ok(piece) = piece else { return (n_read, started.elapsed(), false) };
            n_read += piece.len();
            tokio::time::sleep(pause).await;
        }
        (n_read, started.elapsed(), true)
    }

    #[tokio::test(start_paused = true)]
    async fn who_reads_an_answer_too_slowly_is_cut_off() {
        let answer = || paced(Body::from(vec![b' '; UNCOUNTED_BYTES * 200]));
        let (n_read, elapsed, is_whole) = read(answer(), Duration::from_millis(1500)).await;
        assert!(!is_whole && n_read < UNCOUNTED_BYTES * 200, "{n_read}");
        assert!(READ_TIMEOUT < elapsed && elapsed < READ_TIMEOUT * 4, "{elapsed:?}");
        assert_eq!(read(answer(), Duration::from_millis(990)).await.0, UNCOUNTED_BYTES * 200);
    }

    #[tokio::test(start_paused = true)]
    async fn time_that_an_answer_takes_to_be_made_is_not_the_clients() {
        let parts = stream::iter(0..10).then(|_| async {
            tokio::time::sleep(READ_TIMEOUT).await;
            Ok::<_, std::convert::Infallible>("part")
        });
        assert!(read(paced(Body::from_stream(parts)), Duration::ZERO).await.2);
    }
}
