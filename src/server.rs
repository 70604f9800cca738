//! The assembled program: application, routes and listener, from start to clean end.
//!
//! ```text
//! Server::start -> listening -> stop requested -> not ready, no new connections, requests end (drain time)
//!                                             -> searches aborted, answered 503 -> store closed
//! ```

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::net::{TcpListener, TcpSocket};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::clock::{Clock, Ids};
use crate::config::ServeConfig;
use crate::http::{self, Access, ConnectionLimits, Context, Rounds};
use crate::memory::Memory;
use crate::service::Etude;
use crate::service::ServiceError;
use crate::stream::Rooms;
use crate::telemetry;

/// Connections that may wait to be accepted; Linux takes `net.core.somaxconn` if that is less. Whoever comes when the line is full must send
/// its SYN again, a second later.
const MAX_UNACCEPTED: u32 = 4096;

/// How long answers may take to be sent, once searches were aborted.
const ABORT_GRACE: Duration = Duration::from_secs(2);

/// How often measurements are condensed.
const UPKEEP_EVERY: Duration = Duration::from_secs(5);

/// Why the service did not start or run.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The address cannot be listened on.
    #[error("cannot listen on {listen}")]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// Why not.
        #[source]
        source: std::io::Error,
    },
    /// The database cannot be used.
    #[error("cannot use the database {database}")]
    Store {
        /// The database.
        database: String,
        /// Why not.
        #[source]
        source: ServiceError,
    },
    /// Measurements cannot be set up.
    #[error("cannot set up measurements")]
    Measurements(#[from] metrics_exporter_prometheus::BuildError),
}

/// A service that listens.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    etude: Arc<Etude>,
    router: axum::Router,
    tasks: TaskTracker,
    streams: TaskTracker,
    rounds: Rounds,
    stopping: CancellationToken,
    abort: CancellationToken,
    connections: ConnectionLimits,
    drain_timeout: Duration,
}

impl Server {
    /// Opens the database and listens. Requests are answered from [`Self::run`] on.
    ///
    /// # Errors
    ///
    /// If the address, the database or the measurements cannot be had.
    pub async fn start(config: &ServeConfig) -> Result<Self, ServerError> {
        let config = &within_limits(config);
        let (tasks, stopping, abort) = (TaskTracker::new(), CancellationToken::new(), CancellationToken::new());
        let metrics = telemetry::measurements()?;
        let not_usable = |source| ServerError::Store { database: config.database.display().to_string(), source };
        let etude = Etude::open(&config.settings(Clock::system(), Ids::random()), &tasks, abort.clone())
            .await
            .map_err(not_usable)?;
        etude.begin(etude.clock().now()).await.map_err(not_usable)?;
        let listen = |source| ServerError::Listen { listen: config.listen, source };
        let listener = listen_on(config.listen).map_err(listen)?;
        let address = listener.local_addr().map_err(listen)?;
        tasks.spawn(upkeep(metrics.clone(), stopping.clone()));
        let etude = Arc::new(etude);
        tasks.spawn(Arc::clone(&etude).refine_until(stopping.clone()));
        tasks.spawn(Arc::clone(&etude).expire_until(stopping.clone()));
        tasks.spawn(Arc::clone(&etude).attend_until(stopping.clone()));
        let streams = TaskTracker::new();
        let rounds = Rounds::new(tokio::runtime::Handle::current().metrics().num_workers());
        tasks.spawn(Arc::clone(&etude).learn_periodically(config.learn_every, stopping.clone()));
        let stream_limits = config.stream_limits();
        let router = http::router(Context {
            etude: Arc::clone(&etude),
            access: Access::new(&config.allow_host, &config.allow_origin),
            stopping: stopping.clone(),
            max_body_bytes: config.max_body_bytes,
            max_model_bytes: config.max_model_bytes,
            max_model_text_bytes: config.max_model_text_bytes,
            metrics,
            stream_limits,
            stream_rooms: Rooms::new(etude.memory(), stream_limits),
            streams: streams.clone(),
            rounds: rounds.clone(),
            tasks: tasks.clone(),
        });
        Ok(Self {
            listener,
            address,
            etude,
            router,
            tasks,
            streams,
            rounds,
            stopping,
            abort,
            connections: config.connection_limits(),
            drain_timeout: config.drain_timeout,
        })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its budget of memory.
    #[must_use]
    pub fn memory(&self) -> &Memory {
        self.etude.memory()
    }

    /// Serves until `stop` completes, then lets requests end within the drain time, aborts what is left, and closes the
    /// database.
    pub async fn run(self, stop: impl Future<Output = ()> + Send + 'static) {
        let Self {
            listener,
            address,
            etude,
            router,
            tasks,
            streams,
            rounds,
            stopping,
            abort,
            connections,
            drain_timeout,
        } = self;
        tracing::info!(%address, "listening on http://{address}");
        tracing::info!("to read about it and try it: http://{address}/docs/");
        let announce = async {
            stop.await;
            tracing::info!("stopping");
            stopping.cancel();
        };
        let serving = async {
            tokio::join!(announce, http::serve(listener, router, &rounds, connections, &stopping));
            // Websockets are no longer the listener's.
            streams.close();
            streams.wait().await;
        };
        let overtime = async {
            stopping.cancelled().await;
            tokio::time::sleep(drain_timeout).await;
            tracing::warn!("the drain time is over; aborting searches");
            abort.cancel();
            tokio::time::sleep(ABORT_GRACE).await;
        };
        tokio::select! {
            () = serving => {}
            () = overtime => tracing::warn!("closing connections that are still open"),
        }
        abort.cancel();
        stopping.cancel();
        let noted = tokio::time::timeout(ABORT_GRACE, etude.note_alive(etude.clock().now())).await;
        if !matches!(noted, Ok(Ok(()))) {
            tracing::warn!("when the service ended could not be noted");
        }
        etude.close().await;
        tasks.close();
        // A search that never asks whether to stop would keep the process alive; the process ends without it.
        let ended = tokio::time::timeout(ABORT_GRACE, tasks.wait()).await;
        tracing::info!(is_clean = ended.is_ok(), "stopped");
    }
}

/// Listens at `address`, for bursts of connections too.
fn listen_on(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() }?;
    // So that a restart need not wait until the connections of before are forgotten.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(MAX_UNACCEPTED)
}

/// The settings, with no more connections than the process can have open files.
fn within_limits(config: &ServeConfig) -> ServeConfig {
    let config_within = config.within(raise_file_limit());
    let (wanted, max_connections) = (config.max_connections, config_within.max_connections);
    if max_connections < wanted {
        tracing::warn!(wanted, max_connections, "fewer connections, as files (ulimit -n) and memory are limited");
    }
    config_within
}

/// Raises the limit of open files as far as is allowed, as each connection needs one. Returns the new limit.
fn raise_file_limit() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let (Some(soft), hard) = (limit.current, limit.maximum) else { return u64::MAX };
    if hard.is_some_and(|hard| hard <= soft) {
        return soft;
    }
    match setrlimit(Resource::Nofile, Rlimit { current: hard, maximum: hard }) {
        Ok(()) => {
            tracing::info!(from = soft, to = hard, "the limit of open files is raised");
            hard.unwrap_or(u64::MAX)
        }
        Err(error) => {
            tracing::warn!(error = &error as &dyn std::error::Error, "the limit of open files cannot be raised");
            soft
        }
    }
}

async fn upkeep(metrics: metrics_exporter_prometheus::PrometheusHandle, stopping: CancellationToken) {
    let mut ticks = tokio::time::interval(UPKEEP_EVERY);
    loop {
        tokio::select! {
            _ = ticks.tick() => metrics.run_upkeep(),
            () = stopping.cancelled() => return,
        }
    }
}

/// The signals that stop the service.
///
/// SIGTERM, SIGINT and SIGHUP stop it in good order; a second SIGTERM or SIGINT is for those who do not want to wait for that.
/// A second SIGHUP is none of these, as service managers send it along with SIGTERM.
#[derive(Debug)]
pub struct StopSignals {
    terminate: Signal,
    interrupt: Signal,
    hangup: Signal,
}

impl StopSignals {
    /// Listens for them from now on, also as the first process of a container, where they would be ignored otherwise.
    ///
    /// # Errors
    ///
    /// If signals cannot be listened for.
    pub fn listen() -> std::io::Result<Self> {
        let [terminate, interrupt, hangup] =
            [SignalKind::terminate(), SignalKind::interrupt(), SignalKind::hangup()].map(signal);
        Ok(Self { terminate: terminate?, interrupt: interrupt?, hangup: hangup? })
    }

    /// Cancels `stop` at the first of them. Completes at the second SIGTERM or SIGINT, with its number.
    pub async fn insist(mut self, stop: CancellationToken) -> i32 {
        let mut n_before = 0;
        loop {
            let kind = tokio::select! {
                _ = self.terminate.recv() => Some(SignalKind::terminate()),
                _ = self.interrupt.recv() => Some(SignalKind::interrupt()),
                _ = self.hangup.recv() => None,
            };
            stop.cancel();
            match kind {
                Some(kind) if n_before > 0 => return kind.as_raw_value(),
                Some(_) => n_before += 1,
                None => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[tokio::test]
    async fn connections_that_come_in_a_burst_wait_in_line() {
        let somaxconn =
            fs::read_to_string("/proc/sys/net/core/somaxconn").ok().and_then(|most| most.trim().parse().ok());
        let n_connections = somaxconn.unwrap_or(128).min(512);
        let listener = listen_on(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = listener.local_addr().unwrap();
        // Nobody accepts them. If one did not fit in line, this would end with the kernel's timeout.
        let connecting = (0..n_connections).map(|_| tokio::net::TcpStream::connect(address));
        let connected = futures_util::future::try_join_all(connecting).await.unwrap();
        assert_eq!(connected.len(), n_connections);
    }
}
