//! `etude serve`.

use clap::Args;
use tokio_util::sync::CancellationToken;

use super::{CliError, runtime};
use crate::config::ServeConfig;
use crate::server::{Server, StopSignals};
use crate::telemetry::log_panics;

#[derive(Args, Debug)]
pub(super) struct Serve {
    #[command(flatten)]
    config: ServeConfig,
}

impl Serve {
    pub(super) fn run(&self) -> Result<(), CliError> {
        log_panics();
        let runtime = runtime()?;
        let served = runtime.block_on(async {
            // Listened for before anything is started, so that no signal is missed.
            let signals = StopSignals::listen()?;
            let stop = CancellationToken::new();
            let serving = async {
                let server = Server::start(&self.config).await?;
                let memory = server.memory().clone();
                // What is resident is the process's, which is this service's alone.
                let watching = async {
                    memory.watch().await;
                    std::future::pending().await
                };
                tokio::select! {
                    () = server.run(stop.clone().cancelled_owned()) => Ok(()),
                    ended = watching => ended,
                }
            };
            tokio::select! {
                served = serving => served,
                signal = signals.insist(stop.clone()) => {
                    tracing::warn!(signal, "stopped at once, as a second signal asks for it");
                    Err(CliError::Signal(signal))
                }
            }
        });
        // A job that does not look up must not keep the process: the store is closed, and nobody waits any more.
        runtime.shutdown_background();
        served
    }
}
