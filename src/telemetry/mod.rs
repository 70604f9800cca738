//! Logs and measurements of the process.

mod log_lines;

use std::io::{self, IsTerminal};
use std::sync::{Mutex, PoisonError};

use clap::{Args, ValueEnum};
use log_lines::LogLines;
use metrics_exporter_prometheus::{BuildError, Matcher, PrometheusBuilder, PrometheusHandle};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::ParseError;

/// What is logged, and how. Logs go to standard error.
#[derive(Args, Clone, Debug)]
pub struct LogConfig {
    /// What is logged: a level, or directives such as `etude=debug,sqlx=warn` [default: info for serve, else warn].
    #[arg(long = "log", env = "ETUDE_LOG", value_parser = parse_filter, value_name = "FILTER", global = true)]
    pub filter: Option<String>,
    /// How lines are written.
    #[arg(long = "log-format", env = "ETUDE_LOG_FORMAT", value_enum, default_value_t, global = true)]
    pub format: LogFormat,
}

/// How log lines are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people; in colour on a terminal.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

fn parse_filter(text: &str) -> Result<String, String> {
    const EXPECTED: &str =
        "expected off, error, warn, info, debug or trace, or directives with them, such as etude=debug,sqlx=warn";
    EnvFilter::try_new(text).map(|_| text.to_owned()).map_err(|_| EXPECTED.to_owned())
}

/// Why nothing can be logged.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The filter is none.
    #[error("--log: {0}")]
    Filter(#[from] ParseError),
    /// Nothing can write lines.
    #[error("cannot log")]
    Start(#[from] io::Error),
}

/// Logging, as long as this is there: when it is dropped, all lines are written, unless nobody takes them away for a second.
#[must_use]
pub struct Logging(LogLines);

impl Drop for Logging {
    fn drop(&mut self) {
        self.0.flush();
    }
}

/// Starts logging; what `default_filter` says if `config` says nothing. Lines are written by a thread of their own, a moment later, and
/// dropped where nobody takes them away.
///
/// # Errors
///
/// If the filter is none, or there are no more threads.
pub fn start_logging(config: &LogConfig, default_filter: &str) -> Result<Logging, LogError> {
    let filter = EnvFilter::try_new(config.filter.as_deref().unwrap_or(default_filter))?;
    let lines = LogLines::start(io::stderr())?;
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(lines.clone());
    match config.format {
        LogFormat::Text => builder.with_ansi(io::stderr().is_terminal()).init(),
        LogFormat::Json => builder.json().flatten_event(true).with_current_span(true).with_span_list(false).init(),
    }
    Ok(Logging(lines))
}

/// Logs panics. Rust's own hook writes to standard error, which blocks the thread if nobody reads it.
pub fn log_panics() {
    std::panic::set_hook(Box::new(|panic| {
        let backtrace = std::backtrace::Backtrace::capture();
        let is_captured = backtrace.status() == std::backtrace::BacktraceStatus::Captured;
        tracing::error!(backtrace = is_captured.then(|| tracing::field::display(backtrace)), "{panic}");
    }));
}

/// Seconds. From a search of a small world to one that takes minutes.
const DURATION_BUCKETS: [f64; 14] =
    [0.000_1, 0.000_3, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0];

/// What is measured in this process. The first call installs the recorder.
///
/// # Errors
///
/// If the recorder cannot be built.
pub fn measurements() -> Result<PrometheusHandle, BuildError> {
    static HANDLE: Mutex<Option<PrometheusHandle>> = Mutex::new(None);
    let mut installed = HANDLE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(handle) = &*installed {
        return Ok(handle.clone());
    }
    let durations = Matcher::Suffix("_seconds".to_owned());
    let recorder = PrometheusBuilder::new().set_buckets_for_metric(durations, &DURATION_BUCKETS)?.build_recorder();
    let handle = installed.insert(recorder.handle()).clone();
    if metrics::set_global_recorder(recorder).is_err() {
        tracing::warn!("another recorder of measurements is installed; /metrics will stay empty");
    }
    Ok(handle)
}
