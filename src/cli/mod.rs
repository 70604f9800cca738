//! The command line.

mod client;
mod demo;
mod drawing;
mod experience;
mod experiment;
mod healthcheck;
mod input;
mod inspect;
mod learner;
mod map;
mod model;
mod openapi;
mod opened;
mod options;
mod render;
mod serve;
mod side_by_side;
mod stream;
mod written;

use std::error::Error;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use crate::config::without_empty_variables;
use crate::server::ServerError;
use crate::telemetry::{LogConfig, start_logging};
use etude_core::document::Faults;

/// Learns a task by watching it done: finds the policy, in an agent's own actions, whose effects follow a demonstration
/// most closely.
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    #[command(flatten)]
    log: LogConfig,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service.
    Serve(serve::Serve),
    /// Map a demonstration from files, without a service.
    Map(map::Map),
    /// Map a demonstration while it is still running: observations from standard input, one JSON line each; steps to
    /// standard output.
    Stream(stream::Stream),
    /// Start a service, send it the demonstration of figure 4, and show what comes back.
    Demo,
    /// Make models from the files of other tools, and inspect models.
    Model(model::ModelCommand),
    /// Check, export and import learners.
    Learner(learner::LearnerCommand),
    /// Reproduce the paper's experiments: pictures and tables of its figures 4, 7 and 8.
    Experiment(experiment::Experiment),
    /// Print the OpenAPI description of the service.
    Openapi,
    /// Ask a running service whether it is ready; for container health checks.
    Healthcheck(healthcheck::Healthcheck),
}

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
enum CliError {
    /// A file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {}", path.display())]
    Write {
        path: PathBuf,
        #[source]
        source: io::Error,
    },
    /// A file is JSON, but not what was asked for.
    #[error("{what} has faults:\n{faults}")]
    Faults { what: String, faults: Faults },
    /// A file of another tool gives no model.
    #[error("cannot import {}: {source}", path.display())]
    Import {
        path: PathBuf,
        #[source]
        source: etude_core::model::ImportError,
    },
    /// A flag, or something in a file, is not what it should be: what, where, and what is wrong with it.
    #[error("{0}")]
    Faulty(String),
    /// The search has no answer.
    #[error(transparent)]
    Cancelled(#[from] etude_core::interrupt::Cancelled),
    /// An observation could not be mapped.
    #[error(transparent)]
    Stopped(#[from] etude_core::mapping::Stopped),
    /// A policy could not be written.
    #[error(transparent)]
    WritePolicy(#[from] etude_core::mapping::WriteError),
    /// A model could not be prepared.
    #[error(transparent)]
    Interrupted(#[from] etude_core::interrupt::Interrupted),
    /// The service did not start or run.
    #[error(transparent)]
    Server(#[from] ServerError),
    /// There is no service to be asked.
    #[error("no service answers at {url}: {why}. Start one with `etude serve`, or give the address of another")]
    NoService { url: String, why: String },
    /// A service could not be asked.
    #[error("cannot ask {url}")]
    Http {
        url: String,
        #[source]
        source: reqwest::Error,
    },
    /// A service answered something else than expected.
    #[error("{url} answered {status}: {told}")]
    Answer { url: String, status: u16, told: String },
    /// A database did not do as asked.
    #[error(transparent)]
    Service(#[from] crate::service::ServiceError),
    /// The log of a learner's rewards gives other weights than are stored.
    #[error("{name}: version {version} of the weights is {stored}, but the log gives {replayed}")]
    Replay { name: String, version: u64, stored: String, replayed: String },
    /// An experiment failed.
    #[error(transparent)]
    Experiment(crate::experiment::LocalError),
    /// A picture could not be drawn.
    #[error(transparent)]
    Picture(#[from] crate::picture::PictureError),
    /// A stream ended without a policy.
    #[error("the stream ended without a policy: {0}")]
    Stream(String),
    /// Input or output failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// A second signal has stopped the service before its work was done.
    #[error("stopped by signal {0}")]
    Signal(i32),
    /// Nothing can be logged.
    #[error(transparent)]
    Log(#[from] crate::telemetry::LogError),
}

/// Runs the program with the arguments of the process.
#[must_use]
pub fn run() -> ExitCode {
    let Cli { log, command } = arguments();
    // Other commands have their output, which log lines would stand between.
    let default_filter = if matches!(command, Command::Serve(_)) { "info" } else { "warn" };
    // What was logged is written before an error is reported.
    let done = start_logging(&log, default_filter).map_err(CliError::from).and_then(|_logging| match command {
        Command::Serve(serve) => serve.run(),
        Command::Map(map) => map.run(&mut io::stdout().lock()),
        Command::Stream(stream) => stream.run(&mut io::stdout()),
        Command::Demo => demo::run(&mut io::stdout()),
        Command::Experiment(experiment) => experiment.run(&mut io::stdout().lock()),
        Command::Model(model) => model.run(&mut io::stdout().lock()),
        Command::Learner(learner) => learner.run(&mut io::stdout().lock()),
        Command::Openapi => openapi::run(&mut io::stdout().lock()),
        Command::Healthcheck(healthcheck) => healthcheck.run(),
    });
    match done {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever read our output has seen enough.
        Err(CliError::Io(error)) if error.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        // As a shell tells of who was killed by it. To tell more could take as long as what was cut short.
        Err(CliError::Signal(signal)) => ExitCode::from(u8::try_from(128 + signal).unwrap_or(u8::MAX)),
        Err(error) => {
            report(&error);
            ExitCode::FAILURE
        }
    }
}

/// The arguments of the process. Ends it if they are wrong, or ask for help.
fn arguments() -> Cli {
    // What begins like a number is the value of a flag, not another flag.
    let command =
        without_empty_variables(Cli::command()).mut_subcommands(|command| command.allow_negative_numbers(true));
    let read = command.clone().try_get_matches().and_then(|mut matches| Cli::from_arg_matches_mut(&mut matches));
    read.unwrap_or_else(|error| with_variable(error, &command).exit())
}

/// The same error, which says so if what is wrong was said by an environment variable.
fn with_variable(mut error: clap::Error, command: &clap::Command) -> clap::Error {
    let Some(ContextValue::String(shown)) = error.get(ContextKind::InvalidArg) else { return error };
    let flag = shown.split(' ').next().unwrap_or_default().to_owned();
    let is_typed = |argument: std::ffi::OsString| {
        argument.to_str().is_some_and(|argument| argument.split('=').next() == Some(&flag))
    };
    let all = std::iter::once(command).chain(command.get_subcommands());
    let mut variables = all.flat_map(clap::Command::get_arguments).filter_map(|arg| {
        let is_meant = arg.get_long().is_some_and(|long| flag.strip_prefix("--") == Some(long));
        arg.get_env().filter(|variable| is_meant && std::env::var_os(variable).is_some())
    });
    if let Some(variable) = variables.next().filter(|_| !std::env::args_os().any(is_typed)) {
        let told = format!("this is the value of the environment variable {}", variable.display());
        error.insert(ContextKind::Suggested, ContextValue::StyledStrs(vec![told.into()]));
    }
    error
}

/// Writes an error and its causes to standard error, without the numbers that the system has for them.
fn report(error: &CliError) {
    let plain = |message: String| message.split(" (os error ").next().unwrap_or_default().to_owned();
    let mut text = plain(error.to_string());
    let mut cause = error.source();
    while let Some(error) = cause {
        let message = plain(error.to_string());
        // Some messages include their cause already.
        if !text.contains(&message) {
            text.push_str(": ");
            text.push_str(&message);
        }
        cause = error.source();
    }
    note(&text);
}

/// Tells whoever watches of something, beside the output.
fn note(text: &str) {
    #[expect(clippy::print_stderr, reason = "this is where what is no output goes")]
    {
        eprintln!("etude: {text}");
    }
}

fn write_file(path: &Path, text: &str) -> Result<(), CliError> {
    std::fs::write(path, text).map_err(|source| CliError::Write { path: path.to_owned(), source })
}

/// A runtime for what is asynchronous.
fn runtime() -> Result<tokio::runtime::Runtime, CliError> {
    /// After so many tasks a thread that has more to do looks at sockets and timers. By itself it does so after 61: when many send at once, whoever
    /// comes then is not even noticed for as long as these take.
    const EVENT_INTERVAL: u32 = 8;
    Ok(tokio::runtime::Builder::new_multi_thread().event_interval(EVENT_INTERVAL).enable_all().build()?)
}
