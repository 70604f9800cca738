//! `etude learner`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::client::{Client, ServerUrl};
use super::opened::read_json;
use super::{CliError, runtime, write_file};
use crate::clock::{Clock, Ids};
use crate::config::parse_database;
use crate::memory::{self, Memory};
use crate::service::{Etude, Name, PoolSettings, Replay, Settings, TimeLimits};
use etude_core::document::{Faults, Place};
use etude_core::learning::{Distribution, Learner, LearnerDocument};
use etude_core::model::Limits;

/// What an exported learner says it is.
const FORMAT: &str = "etude.learner.v1";

#[derive(Args, Debug)]
pub(super) struct LearnerCommand {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Compute a learner's weights anew from the log of its rewards, and compare every version bit for bit.
    Replay {
        /// The learner.
        name: String,
        /// SQLite database of the service.
        #[arg(long, env = "ETUDE_DATABASE", default_value = "etude.db", value_parser = parse_database, value_name = "FILE")]
        database: PathBuf,
    },
    /// Write a learner with what it has learned as JSON.
    Export {
        /// The learner.
        name: String,
        #[command(flatten)]
        place: Location,
        /// Where to write it; standard output if left out.
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Register an exported learner, starting from what the exported one had learned.
    Import {
        /// The exported learner; `-` is standard input.
        file: PathBuf,
        #[command(flatten)]
        place: Location,
        /// A name for it; the one that it was exported under if left out.
        #[arg(long)]
        name: Option<String>,
    },
}

/// Where a learner is.
#[derive(Args, Debug)]
struct Location {
    /// SQLite database of a service, which must not run if it is written to.
    #[arg(long, env = "ETUDE_DATABASE", default_value = "etude.db", value_parser = parse_database, value_name = "FILE")]
    database: PathBuf,
    /// A running service, such as `http://127.0.0.1:8080`, instead of a database.
    #[arg(long, value_name = "URL")]
    server: Option<ServerUrl>,
}

/// An exported learner.
#[derive(Debug, Serialize, Deserialize)]
struct Exported {
    format: String,
    /// The name it was exported under.
    learner: String,
    /// The version of its weights.
    weights_version: u64,
    /// How many trials it had learned from.
    trials: u64,
    /// The learner, starting from what it had learned.
    definition: LearnerDocument,
}

impl LearnerCommand {
    pub(super) fn run(&self, out: &mut impl Write) -> Result<(), CliError> {
        let runtime = runtime()?;
        match &self.command {
            Command::Replay { name, database } => runtime.block_on(replay(name, database, out)),
            Command::Export { name, place, out: file } => {
                let exported = runtime.block_on(export(name, place))?;
                let text = serde_json::to_string_pretty(&exported).map_err(io::Error::from)? + "\n";
                match file {
                    Some(file) => write_file(file, &text),
                    None => Ok(out.write_all(text.as_bytes())?),
                }
            }
            Command::Import { file, place, name } => {
                let exported = read_exported(file)?;
                let name = name.as_deref().unwrap_or(&exported.learner);
                runtime.block_on(import(name, &exported.definition, place))?;
                writeln!(out, "{name}: registered, starting from what {} trials have taught", exported.trials)?;
                Ok(())
            }
        }
    }
}

async fn replay(name: &str, database: &Path, out: &mut impl Write) -> Result<(), CliError> {
    let name = checked(name)?;
    let Replay { n_rewards, n_versions, first_difference } =
        with_database(database, Use::Read, async |etude| Ok(etude.replay(&name).await?)).await?;
    match first_difference {
        None => {
            writeln!(out, "{name}: {n_rewards} rewards give all {n_versions} versions of the weights, bit for bit")?;
            Ok(())
        }
        Some(difference) => Err(CliError::Replay {
            name: name.to_string(),
            version: difference.version,
            stored: format!("{:?}", difference.stored),
            replayed: format!("{:?}", difference.replayed),
        }),
    }
}

async fn export(name: &str, place: &Location) -> Result<Exported, CliError> {
    let name = checked(name)?;
    let exported = |definition, weights_version, trials| Exported {
        format: FORMAT.to_owned(),
        learner: name.to_string(),
        weights_version,
        trials,
        definition,
    };
    let Some(url) = &place.server else {
        let learned = async |etude: &Etude| Ok(etude.learned(&name).await?);
        let (definition, weights) = with_database(&place.database, Use::Read, learned).await?;
        return Ok(exported(definition, weights.version, weights.n_trials));
    };
    let client = Client::new(url)?;
    let definition: LearnerDocument = client.get(&format!("/v1/learners/{name}")).await?;
    let weights: Value = client.get(&format!("/v1/learners/{name}/weights")).await?;
    let learner = read_definition(&definition, "the service's answer")?;
    let numbers = |field: &str| {
        let weights = weights["weights"].as_array().map(Vec::as_slice).unwrap_or_default();
        weights.iter().filter_map(|weight| weight[field].as_f64()).collect()
    };
    let expected_reward = weights["expected_reward"].as_f64();
    let distribution = Distribution { mean: numbers("mean"), sd: numbers("sd"), expected_reward };
    let count = |field: &str| weights[field].as_u64().unwrap_or_default();
    Ok(exported(learner.starting_from(distribution).document(), count("version"), count("trials")))
}

async fn import(name: &str, definition: &LearnerDocument, place: &Location) -> Result<(), CliError> {
    let name = checked(name)?;
    if let Some(url) = &place.server {
        let _: Value = Client::new(url)?.put(&format!("/v1/learners/{name}"), definition).await?;
        return Ok(());
    }
    let text = definition.text();
    with_database(&place.database, Use::Write, async |etude| {
        etude.put_learner(&name, text.as_bytes(), etude.clock().now()).await?;
        Ok(())
    })
    .await
}

fn read_exported(file: &Path) -> Result<Exported, CliError> {
    let document = read_json(file)?;
    let faulty = |faults| CliError::Faults { what: file.display().to_string(), faults };
    let format = Place::root(&document).value.get("format").and_then(Value::as_str);
    if format != Some(FORMAT) {
        let detail = format!("{}: is no exported learner: its \"format\" is not {FORMAT:?}", file.display());
        return Err(CliError::Faulty(detail));
    }
    let exported: Exported = serde_json::from_value(document)
        .map_err(|error| faulty(Faults::one("", format!("this is no exported learner: {error}"))))?;
    read_definition(&exported.definition, &file.display().to_string())?;
    Ok(exported)
}

fn read_definition(definition: &LearnerDocument, what: &str) -> Result<Learner, CliError> {
    let document = serde_json::to_value(definition).map_err(io::Error::from)?;
    Learner::read(&document).map_err(|faults| CliError::Faults { what: what.to_owned(), faults })
}

fn checked(name: &str) -> Result<Name, CliError> {
    Name::new(name).map_err(|error| CliError::Faulty(format!("{name:?}: {error}")))
}

/// What a database is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Use {
    /// To be read, also beside a running service.
    Read,
    /// To be written to, by nobody else.
    Write,
}

/// Does something with the database of a service.
async fn with_database<T>(
    database: &Path,
    usage: Use,
    work: impl AsyncFnOnce(&Etude) -> Result<T, CliError>,
) -> Result<T, CliError> {
    if !database.exists() {
        let detail = format!("there is no database {}: name the one of the service by --database", database.display());
        return Err(CliError::Faulty(detail));
    }
    let settings = Settings {
        database: database.to_owned(),
        limits: Limits::DEFAULT,
        memory: Memory::new(memory::default_max_bytes()),
        model_cache_bytes: 0,
        pool: PoolSettings { n_threads: 1, max_waiting: 0, max_long: 1 },
        session_idle_timeout: Duration::MAX,
        time_limits: TimeLimits::DEFAULT,
        clock: Clock::system(),
        ids: Ids::random(),
    };
    let tasks = TaskTracker::new();
    let etude = match usage {
        Use::Read => Etude::open_to_read(&settings, &tasks).await,
        Use::Write => Etude::open(&settings, &tasks, CancellationToken::new()).await,
    };
    let etude = etude?;
    let done = work(&etude).await;
    etude.close().await;
    tasks.close();
    tasks.wait().await;
    done
}
