//! Connections: let in, served, and ended in good order.
//!
//! ```text
//! accept -> a place? -- yes -> served in rounds until it ends, is idle for too long, or makes room for another
//!              |
//!              +- no -> whoever has been without a request longest makes room; if nobody is, the newcomer is answered 503
//! ```
//!
//! A connection takes its place along when it becomes a websocket.
//!
//! This is not hyper-util's `GracefulShutdown`, which ends all connections together: here each can also be ended alone, when it makes
//! room for another, and all are closed at once if the future that serves them is dropped.

use std::io::{self, Write};
use std::pin::{Pin, pin};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::Router;
use axum::body::{Body, Bytes, HttpBody};
use axum::http::{Request, StatusCode};
use axum::response::Response;
use hyper::body::{Frame, Incoming, SizeHint};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use socket2::{SockRef, TcpKeepalive};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use super::answer::UNCOUNTED_BYTES;
use super::places::{Activity, Busy, ConnectionPlace, Places};
use super::problem::{Problem, ProblemKind};
use super::rounds::Rounds;
use super::stalled::Stalled;
use crate::client::Client;
use crate::clock::timer_now;
use crate::service;

/// How much a connection may read ahead, also of a request's head: held by each, and not counted.
const READ_AHEAD_BYTES: usize = 32 * 1024;

/// Idle time of a connection before TCP keepalive sends its first probe.
const KEEPALIVE_AFTER: Duration = Duration::from_secs(30);
/// Time between probes.
const KEEPALIVE_EVERY: Duration = Duration::from_secs(10);
/// Unanswered probes after which the peer counts as gone.
const KEEPALIVE_RETRIES: u32 = 3;

/// How long sent data may stay unacknowledged (`TCP_USER_TIMEOUT`).
const UNACKNOWLEDGED_TIMEOUT: Duration = Duration::from_mins(1);

/// How much of what is sent may wait in the kernel before more is taken. With more, a client that reads slowly but steadily may seem
/// to read nothing for longer than it may.
const MAX_UNSENT_BYTES: u32 = 128 * 1024;

/// How long to wait where nothing can be accepted, such as without file descriptors.
const ACCEPT_AGAIN_AFTER: Duration = Duration::from_millis(100);

/// Newcomers that are told at the same time that there is no place, each of which takes a file descriptor for a moment. More are
/// told so without waiting for their request, and may not hear it.
const MAX_REFUSED_POLITELY: usize = 8;

/// How long such a newcomer may take to send its request, and to hear the answer.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(1);

/// Most of its request that is read.
const MAX_REFUSED_BYTES: u64 = 64 * 1024;

/// How often it is logged that connections are refused.
const LOG_EVERY: Duration = Duration::from_secs(1);

/// What connections may use.
#[derive(Clone, Copy, Debug)]
pub struct ConnectionLimits {
    /// Most connections at the same time.
    pub max_connections: usize,
    /// How long a client may take to send a request up to its body, or keep a connection without one.
    pub head_timeout: Duration,
    /// How long a client may leave unread what waits for it.
    pub slow_reader_timeout: Duration,
}

/// Serves `router` on whatever connects, in `rounds` and within `limits`, until `stopping` is cancelled and the requests that run then are
/// answered. Connections are closed at once if the returned future is dropped.
pub async fn serve(
    listener: TcpListener,
    router: Router,
    rounds: &Rounds,
    limits: ConnectionLimits,
    stopping: &CancellationToken,
) {
    let mut builder = http1::Builder::new();
    // Without a timer there is no timeout.
    builder.timer(TokioTimer::new()).header_read_timeout(limits.head_timeout).max_buf_size(READ_AHEAD_BYTES);
    let places = Arc::new(Places::new(limits.max_connections));
    let refusal: Arc<str> = refusal().into();
    let (mut connections, mut refusals) = (JoinSet::new(), JoinSet::new());
    let (mut refused, mut failed) = (Tally::default(), Tally::default());
    let mut last_failure = None;
    loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => {
                    let client = Client::from(peer.ip());
                    if let Some((place, end)) = places.enter(client) {
                        prepare(&stream);
                        let activity = Arc::clone(place.activity());
                        let socket = Stalled::new(stream, limits.slow_reader_timeout, place);
                        let serving = serve_connection(builder.clone(), socket, activity, client, router.clone(), end);
                        connections.spawn(rounds.run(client, serving));
                        continue;
                    }
                    refused.note();
                    metrics::counter!("etude_connections_refused_total").increment(1);
                    if refusals.len() < MAX_REFUSED_POLITELY {
                        refusals.spawn(tokio::time::timeout(REFUSAL_TIMEOUT, refuse(stream, Arc::clone(&refusal))));
                    } else if let Ok(stream) = stream.into_std() {
                        // As much as goes at once; nothing was written before, so that all does.
                        let _ = (&stream).write(refusal.as_bytes());
                    }
                }
                Err(error) if is_of_one_connection(&error) => {}
                Err(error) => {
                    failed.note();
                    last_failure = Some(error);
                    places.make_room();
                    tokio::time::sleep(ACCEPT_AGAIN_AFTER).await;
                }
            },
            Some(_) = connections.join_next() => {}
            Some(_) = refusals.join_next() => {}
            n_refused = refused.due() => {
                let (n_taken, max_connections) = (places.n_taken(), limits.max_connections);
                tracing::warn!(n_refused, n_taken, max_connections, "connections are refused: their places are taken");
            }
            n_failed = failed.due() => {
                let error = last_failure.as_ref().map(|error| error as &dyn std::error::Error);
                tracing::error!(error, n_failed, "connections cannot be accepted");
            }
            () = stopping.cancelled() => break,
        }
    }
    drop(listener);
    places.end_all();
    while connections.join_next().await.is_some() {}
}

/// Serves a connection until it ends. Once the other end of `end` is dropped, only the request or stream that runs then is
/// finished.
async fn serve_connection(
    builder: http1::Builder,
    socket: Stalled<TcpStream, ConnectionPlace>,
    activity: Arc<Activity>,
    client: Client,
    router: Router,
    end: oneshot::Receiver<()>,
) {
    let on_request = Arc::clone(&activity);
    let service = service_fn(move |mut request: Request<Incoming>| {
        let busy = Activity::begin(&on_request);
        request.extensions_mut().insert(client);
        let router = router.clone();
        async move {
            // A request that came too late: this connection makes room for another, and ends once this task hears of it.
            let Some(busy) = busy else { return std::future::pending().await };
            router.oneshot(request).await.map(|response| until_given(response, busy))
        }
    });
    let mut connection = pin!(builder.serve_connection(TokioIo::new(socket), service).with_upgrades());
    let served = tokio::select! {
        served = connection.as_mut() => served,
        _ = end => {
            // All that was answered is written, as far as it goes, whenever this task does something else.
            if activity.makes_room() && !activity.is_writing() {
                return;
            }
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = served {
        tracing::debug!(error = &error as &dyn std::error::Error, "a connection broke");
    }
}

/// Marks the answer that is a stream.
#[derive(Clone, Copy, Debug)]
pub(super) struct IsStream;

/// The connection is busy with a request until its answer was given to be written.
fn until_given(response: Response, busy: Busy) -> Response {
    let is_websocket = response.status() == StatusCode::SWITCHING_PROTOCOLS;
    if is_websocket || response.extensions().get::<IsStream>().is_some() {
        busy.is_stream();
    }
    if is_websocket {
        busy.for_ever();
        return response;
    }
    // It goes in one piece.
    if HttpBody::size_hint(response.body()).exact().is_some_and(|n_bytes| n_bytes <= UNCOUNTED_BYTES as u64) {
        return response;
    }
    response.map(|body| Body::new(BusyBody { body, _busy: busy }))
}

/// The body of an answer. The connection counts as busy until the body ends.
struct BusyBody {
    body: Body,
    _busy: Busy,
}

impl HttpBody for BusyBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.get_mut().body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        HttpBody::size_hint(&self.body)
    }
}

/// Sets the options of a socket. Failures are ignored: a connection works without them.
fn prepare(stream: &TcpStream) {
    let socket = SockRef::from(stream);
    let keepalive = TcpKeepalive::new().with_time(KEEPALIVE_AFTER).with_interval(KEEPALIVE_EVERY);
    let set = || -> io::Result<()> {
        // Small answers should not wait for more.
        stream.set_nodelay(true)?;
        socket.set_tcp_keepalive(&keepalive.with_retries(KEEPALIVE_RETRIES))?;
        #[cfg(target_os = "linux")]
        {
            socket.set_tcp_user_timeout(Some(UNACKNOWLEDGED_TIMEOUT))?;
            socket.set_tcp_notsent_lowat(MAX_UNSENT_BYTES)?;
        }
        Ok(())
    };
    if let Err(error) = set() {
        tracing::debug!(error = &error as &dyn std::error::Error, "a socket could not be set up");
    }
}

/// Whether an error of accepting is that of a connection which is gone already, and says nothing of others.
fn is_of_one_connection(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
    matches!(error.kind(), ConnectionAborted | ConnectionRefused | ConnectionReset)
}

/// The answer to a newcomer if all places are taken.
fn refusal() -> String {
    let problem = Problem::new(ProblemKind::Busy, "as many connections are open as may be");
    let body = problem.text();
    let (n_bytes, retry_after) = (body.len(), service::RETRY_AFTER.as_secs());
    format!(
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: application/problem+json\r\nretry-after: {retry_after}\r\n\
         connection: close\r\ncontent-length: {n_bytes}\r\n\r\n{body}"
    )
}

/// Tells a newcomer that there is no place.
async fn refuse(mut stream: TcpStream, refusal: Arc<str>) -> io::Result<()> {
    // Many clients take an answer to a request that they have not sent for a fault. They are not waited for long.
    let mut begun = [0; 1024];
    let _ = tokio::time::timeout(REFUSAL_TIMEOUT / 2, stream.read(&mut begun)).await;
    stream.write_all(refusal.as_bytes()).await?;
    stream.shutdown().await?;
    // Closing a socket with unread data resets the connection, and the answer may be lost.
    tokio::io::copy(&mut stream.take(MAX_REFUSED_BYTES), &mut tokio::io::sink()).await?;
    Ok(())
}

/// Counts what is logged, at most once in [`LOG_EVERY`].
#[derive(Debug, Default)]
struct Tally {
    n_unlogged: u64,
    logged_at: Option<Instant>,
}

impl Tally {
    fn note(&mut self) {
        self.n_unlogged += 1;
    }

    /// Completes when there is something to be logged, and gives how often it happened.
    async fn due(&mut self) -> u64 {
        if self.n_unlogged == 0 {
            return std::future::pending().await;
        }
        if let Some(logged_at) = self.logged_at {
            tokio::time::sleep_until(logged_at + LOG_EVERY).await;
        }
        self.logged_at = Some(timer_now());
        std::mem::take(&mut self.n_unlogged)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::poll;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn what_happens_often_is_logged_once_a_second_with_a_count() {
        let mut tally = Tally::default();
        assert!(poll!(pin!(tally.due())).is_pending());
        tally.note();
        assert_eq!(tally.due().await, 1);
        let first = timer_now();
        for _ in 0..1000 {
            tally.note();
        }
        assert!(poll!(pin!(tally.due())).is_pending());
        assert_eq!((tally.due().await, first.elapsed()), (1000, LOG_EVERY));
    }
}
