//! `etude demo`: the main job, over HTTP, on the world of the paper's figure 4.

use std::io::Write;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;

use clap::{Args, FromArgMatches};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::oneshot;

use super::client::{answer, client};
use super::{CliError, render, runtime, side_by_side};
use crate::config::{ServeConfig, without_empty_variables};
use crate::experiment::{CurvePlan, Scene};
use crate::server::Server;
use etude_core::mapping::Policy;

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
        running.await.map_err(std::io::Error::other)?;
        shown
    })
}

/// The defaults of the service, but for a free port and a temporary database.
fn config(database: &Path) -> Result<ServeConfig, CliError> {
    let option = |error: clap::Error| CliError::Faulty(error.to_string());
    let command = without_empty_variables(ServeConfig::augment_args(clap::Command::new("demo")));
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
    writeln!(out, "{}", render::steps(&policy, render::width()))?;
    write!(out, "{}", render::totals(&policy))?;

    writeln!(
        out,
        "\nPOST /v1/stream: the same while the demonstration is still running. Of what is observed, what has changed;\nof what \
         is committed, step, move, observation, action, and whether it is proven or the lookahead was used up.\n"
    )?;
    side_by_side::stream(&client, &format!("http://{address}"), "figure-4", &demonstration, out).await?;
    writeln!(out)?;
    learn(address, out).await
}

/// Trials in the world of figure 6, until the gold is found time after time.
async fn learn(address: SocketAddr, out: &mut impl Write) -> Result<(), CliError> {
    /// So many trials in a row must fetch the gold.
    const ENOUGH: usize = 10;
    /// A line of rewards.
    const SHOWN: usize = 20;
    let client = super::client::Client::new(&format!("http://{address}").parse().map_err(CliError::Faulty)?)?;
    let scene = Scene::figure_6();
    let plan = CurvePlan::documented();
    writeln!(
        out,
        "The gold that another demonstrator fetched is gone; there is some more two cells away. With default weights"
    )?;
    let _: Value = client.put("/v1/models/figure-6", scene.model()).await?;
    let request = json!({"model": "figure-6", "demonstration": scene.demonstration()});
    let reward_of = |policy: &Value| -> Result<f64, CliError> {
        let actions: Vec<String> = Vec::deserialize(&policy["actions"]).map_err(std::io::Error::from)?;
        Ok(scene.execute(&actions).reward)
    };
    let policy: Value = client.post("/v1/policies", &request).await?;
    writeln!(
        out,
        "the imitator comes home without any: reward {}. So it learns from trials which weights matter.\n",
        reward_of(&policy)?
    )?;

    writeln!(out, "POST /v1/learners/gold/trials, PUT /v1/trials/../reward, until {ENOUGH} in a row fetch the gold:")?;
    let _: Value = client.put("/v1/learners/gold", &plan.learner).await?;
    let (mut n_trials, mut n_found) = (0, 0);
    while n_trials < plan.n_trials && n_found < ENOUGH {
        let trial: Value = client.post("/v1/learners/gold/trials", &request).await?;
        let reward = reward_of(&trial["policy"])?;
        let path = format!("/v1/trials/{}/reward", trial["id"].as_str().unwrap_or_default());
        let _: Value = client.put(&path, &json!({"reward": reward})).await?;
        let _: Value = client.post("/v1/learners/gold/learn", &Value::Null).await?;
        n_found = if reward > 0.0 { n_found + 1 } else { 0 };
        n_trials += 1;
        write!(out, "{}{reward:>5}", if n_trials % SHOWN == 1 { "\n " } else { "" })?;
    }
    let weights: Value = client.get("/v1/learners/gold/weights").await?;
    let learned = json!({"learner": "gold", "model": "figure-6", "demonstration": scene.demonstration()});
    let policy: Value = client.post("/v1/policies", &learned).await?;
    writeln!(
        out,
        "\n\nWeights after {n_trials} trials, all 1 at first; their means give a policy with reward {}:\n",
        reward_of(&policy)?
    )?;
    write!(out, "{}", render::weights(&weights))?;
    Ok(())
}

fn document(text: &str) -> Result<Value, CliError> {
    serde_json::from_str(text).map_err(|error| CliError::Io(error.into()))
}
