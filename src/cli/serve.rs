//! `etude serve`.

use clap::Args;

use super::{CliError, runtime};
use crate::config::ServeConfig;
use crate::server::{Server, stop_signal};

#[derive(Args, Debug)]
pub(super) struct Serve {
    #[command(flatten)]
    config: ServeConfig,
}

impl Serve {
    pub(super) fn run(&self) -> Result<(), CliError> {
        let runtime = runtime()?;
        let served = runtime.block_on(async {
            // Listened for before anything is started, so that no signal is missed.
            let stop = stop_signal()?;
            let server = Server::start(&self.config).await?;
            server.run(stop).await;
            Ok(())
        });
        // A job that does not look up must not keep the process: the store is closed, and nobody waits any more.
        runtime.shutdown_background();
        served
    }
}
