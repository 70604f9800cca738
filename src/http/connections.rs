//! Connections: accepted, served, and ended in good order.

use std::collections::HashMap;
use std::pin::pin;
use std::time::Duration;

use axum::Router;
use axum::http::Request;
use axum::serve::{Listener, ListenerExt};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use crate::service::Client;

/// Serves `router` on whatever connects, until `stopping` is cancelled and the requests that run then are answered. A client
/// whose next request is not there, up to its body, after `head_timeout` finds its connection closed. So does everybody if the
/// returned future is dropped.
pub async fn serve(listener: TcpListener, router: Router, head_timeout: Duration, stopping: &CancellationToken) {
    let mut builder = http1::Builder::new();
    // Without a timer there is no timeout.
    builder.timer(TokioTimer::new()).header_read_timeout(head_timeout);
    let mut listener = listener.tap_io(|stream| {
        // Small answers should not wait for more.
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!(error = &error as &dyn std::error::Error, "could not set TCP_NODELAY");
        }
    });
    let mut connections = JoinSet::new();
    // Dropped to end them. To ask a token costs a lock, which connections would share, twice a request.
    let mut ends = HashMap::new();
    loop {
        tokio::select! {
            // Waits a moment where there are no more file descriptors.
            (stream, peer) = listener.accept() => {
                let (end, ended) = oneshot::channel();
                let client = Client::from(peer.ip());
                let connection = serve_connection(builder.clone(), stream, client, router.clone(), ended);
                let connection = connections.spawn(connection);
                ends.insert(connection.id(), end);
            }
            Some(served) = connections.join_next_with_id() => {
                ends.remove(&served.map_or_else(|error| error.id(), |(id, ())| id));
            }
            () = stopping.cancelled() => break,
        }
    }
    drop((listener, ends));
    while connections.join_next().await.is_some() {}
}

/// Serves a connection until it ends, or what runs on it when `end` is dropped has ended.
async fn serve_connection(
    builder: http1::Builder,
    stream: TcpStream,
    client: Client,
    router: Router,
    end: oneshot::Receiver<()>,
) {
    let service = router.into_service::<Incoming>().map_request(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(client);
        request
    });
    let service = TowerToHyperService::new(service);
    let mut connection = pin!(builder.serve_connection(TokioIo::new(stream), service).with_upgrades());
    let served = tokio::select! {
        served = connection.as_mut() => served,
        _ = end => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = served {
        tracing::debug!(error = &error as &dyn std::error::Error, "a connection broke");
    }
}
