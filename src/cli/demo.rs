//! `etude demo`: the main job, over HTTP, on the world of the paper's figure 4.

use std::io::Write;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;

use clap::{Args, FromArgMatches};
use serde_json::{Value, json};
use tokio::sync::oneshot;

use super::client::{answer, client};
use super::{CliError, render, runtime, side_by_side};
use crate::config::ServeConfig;
use crate::mapping::Policy;
use crate::server::Server;

const MODEL: &str = include_str!("../../examples/figure-4/model.json");
const DEMONSTRATION: &str = include_str!("../../examples/figure-4/demonstration.json");

pub(super) fn run(out: &mut impl Write) -> Result<(), CliError> {
    let directory = tempfile::tempdir()?;
    let config = config(&directory.path().join("demo.db"))?;
    runtime()?.block_on(async {
        let server = Server::start(&config).await?;
        let address = server.address();
        let (stop, stopped) = oneshot::channel::<()>();
        let running = tokio::spawn(server.run(async {
            // An error means that the other end is gone, which is as good a reason to stop.
            let _ = stopped.await;
        }));
        let shown = show(address, out).await;
        drop(stop);
        running.await.map_err(std::io::Error::other)??;
        shown
    })
}

/// The defaults of the service, but for a free port and a temporary database.
fn config(database: &Path) -> Result<ServeConfig, CliError> {
    let option = |error: clap::Error| CliError::Option(error.to_string());
    let command = ServeConfig::augment_args(clap::Command::new("demo"));
    let matches = command.try_get_matches_from(["demo"]).map_err(option)?;
    let config = ServeConfig::from_arg_matches(&matches).map_err(option)?;
    let listen = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    Ok(ServeConfig { listen, database: database.to_owned(), ..config })
}

async fn show(address: SocketAddr, out: &mut impl Write) -> Result<(), CliError> {
    let client = client()?;
    let model = document(MODEL)?;
    let demonstration = document(DEMONSTRATION)?;

    writeln!(out, "A service runs on http://{address} with a temporary database.\n")?;
    writeln!(
        out,
        "PUT /v1/models/figure-4: a body that cannot shoot, in a cave with three wumpi and a piece of gold."
    )?;
    let url = format!("http://{address}/v1/models/figure-4");
    let registered: Value = answer(&url, client.put(&url).json(&model)).await?;
    let counts = &registered["counts"];
    writeln!(out, "  {} states, {} transitions\n", counts["states"], counts["transitions"])?;

    writeln!(out, "POST /v1/policies: what a demonstrator that can shoot was seen to do.")?;
    let url = format!("http://{address}/v1/policies");
    let request = json!({"model": "figure-4", "demonstration": demonstration});
    let policy: Policy = answer(&url, client.post(&url).json(&request)).await?;
    writeln!(out, "  {} observed states in, a policy of {} steps out\n", policy.coverage.observed, policy.steps.len())?;

    write!(out, "{}", render::cave(&model, &demonstration, &policy))?;
    writeln!(out, "    o demonstrator   x imitator   S start   W wumpus   G gold\n")?;
    writeln!(out, "{}", render::steps(&policy))?;
    write!(out, "{}", render::totals(&policy))?;

    writeln!(
        out,
        "\nPOST /v1/stream: the same while the demonstration is still running. Of what is observed, what has changed;\nof what \
         is committed, step, move, observation, action, and whether it is proven or the lookahead was used up.\n"
    )?;
    side_by_side::stream(&client, &format!("http://{address}"), "figure-4", &demonstration, out).await
}

fn document(text: &str) -> Result<Value, CliError> {
    serde_json::from_str(text).map_err(|error| CliError::Io(error.into()))
}
