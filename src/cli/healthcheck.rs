//! `etude healthcheck`.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use clap::Args;

use super::{CliError, client, runtime};
use crate::config::parse_address;

/// How long the service may take to say that it is ready.
const TIMEOUT: Duration = Duration::from_secs(3);

#[derive(Args, Debug)]
pub(super) struct Healthcheck {
    /// Address that the service listens on.
    #[arg(long, env = "ETUDE_LISTEN", default_value = "127.0.0.1:8080", value_parser = parse_address, value_name = "HOST:PORT")]
    listen: SocketAddr,
}

impl Healthcheck {
    pub(super) fn run(&self) -> Result<(), CliError> {
        let url = format!("http://{}/readyz", reachable(self.listen));
        runtime()?.block_on(async {
            let http = |source| client::failed(&url, source);
            let client = reqwest::Client::builder().timeout(TIMEOUT).no_proxy().build().map_err(http)?;
            let answer = client.get(&url).send().await.map_err(http)?;
            if answer.status().is_success() { Ok(()) } else { Err(client::refused(&url, answer).await) }
        })
    }
}

/// An address at which a service that listens on `listen` is reached from the same machine.
fn reachable(mut listen: SocketAddr) -> SocketAddr {
    if listen.ip().is_unspecified() {
        listen.set_ip(match listen {
            SocketAddr::V4(_) => IpAddr::V4(Ipv4Addr::LOCALHOST),
            SocketAddr::V6(_) => IpAddr::V6(Ipv6Addr::LOCALHOST),
        });
    }
    listen
}
