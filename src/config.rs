//! How `etude serve` is set up: by flags, or by environment variables of the same meaning.

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

use axum::http::HeaderValue;
use clap::Args;

use crate::clock::{Clock, Ids};
use crate::http::{self, ConnectionLimits};
use crate::memory::{self, Memory};
use crate::service::{PoolSettings, Settings, TimeLimits};
use crate::stream::{Limits, Rooms};
use etude_core::model;

/// Settings of the service.
#[derive(Args, Clone, Debug)]
pub struct ServeConfig {
    /// Address to listen on; port 0 takes a free one and logs it.
    #[arg(long, env = "ETUDE_LISTEN", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
    /// SQLite database; created if missing.
    #[arg(long, env = "ETUDE_DATABASE", default_value = "etude.db", value_name = "FILE")]
    pub database: PathBuf,
    /// Name by which the service may be asked for, besides IP addresses, localhost and the machine's own names; `*` for any.
    #[arg(
        long, env = "ETUDE_ALLOW_HOST", value_delimiter = ',', value_parser = http::allowed_host, value_name = "NAME"
    )]
    pub allow_host: Vec<String>,
    /// Origin of web pages that may use the service, besides its own, such as `https://app.example`.
    #[arg(
        long, env = "ETUDE_ALLOW_ORIGIN", value_delimiter = ',', value_parser = http::allowed_origin, value_name = "ORIGIN"
    )]
    pub allow_origin: Vec<HeaderValue>,
    /// Searches that run at the same time [default: one per core].
    #[arg(long, env = "ETUDE_SEARCH_THREADS", value_parser = parse_threads, value_name = "N")]
    pub search_threads: Option<NonZeroUsize>,
    /// Searches that wait for a thread; further ones are answered 503.
    #[arg(long, env = "ETUDE_SEARCH_QUEUE", default_value_t = 256, value_parser = parse_places, value_name = "N")]
    pub search_queue: usize,
    /// Largest request body; once it is decompressed, too.
    #[arg(long, env = "ETUDE_MAX_BODY_BYTES", default_value_t = 8 * 1024 * 1024, value_name = "BYTES")]
    pub max_body_bytes: usize,
    /// Largest model, as it is sent [default: as other bodies].
    #[arg(long, env = "ETUDE_MAX_MODEL_BYTES", value_name = "BYTES")]
    pub max_model_bytes: Option<usize>,
    /// Largest model, once it is decompressed.
    #[arg(long, env = "ETUDE_MAX_MODEL_TEXT_BYTES", default_value_t = 512 * 1024 * 1024, value_name = "BYTES")]
    pub max_model_text_bytes: u64,
    /// Most states of a model; a wumpus world of more is searched lazily.
    #[arg(long, env = "ETUDE_MAX_STATES", default_value_t = model::Limits::DEFAULT.max_states, value_name = "N")]
    pub max_states: usize,
    /// Most transitions of a model.
    #[arg(
        long, env = "ETUDE_MAX_TRANSITIONS", default_value_t = model::Limits::DEFAULT.max_transitions, value_name = "N"
    )]
    pub max_transitions: usize,
    /// Memory that the service may use in all [default: three quarters of what the machine or its cgroup has].
    #[arg(long, env = "ETUDE_MAX_MEMORY", value_parser = parse_memory, value_name = "BYTES")]
    pub max_memory: Option<u64>,
    /// Of that, for models that are kept ready to be searched [default: a quarter, 1 GiB at most].
    #[arg(long, env = "ETUDE_MODEL_CACHE_BYTES", value_name = "BYTES")]
    pub model_cache_bytes: Option<u64>,
    /// How long a search may take, from the arrival of its request, unless that says so itself.
    #[arg(
        long, env = "ETUDE_DEFAULT_DEADLINE", default_value = "10s", value_parser = parse_period, value_name = "TIME"
    )]
    pub default_deadline: Duration,
    /// How long a search may take at most, whatever its request says.
    #[arg(long, env = "ETUDE_MAX_DEADLINE", default_value = "10m", value_parser = parse_period, value_name = "TIME")]
    pub max_deadline: Duration,
    /// How long compiling a model may take; beyond that, it is refused.
    #[arg(long, env = "ETUDE_MAX_COMPILE_TIME", default_value = "30s", value_parser = parse_period, value_name = "TIME")]
    pub max_compile_time: Duration,
    /// Connections at the same time; lowered to what the limits of files and of memory allow. Further ones are answered 503.
    #[arg(
        long, env = "ETUDE_MAX_CONNECTIONS", default_value_t = 10_000, value_parser = parse_connections, value_name = "N"
    )]
    pub max_connections: usize,
    /// Streams that may run at the same time, half of them of one client, on three quarters of the connections and in a quarter of the
    /// memory at most; further ones are answered 503.
    #[arg(long, env = "ETUDE_MAX_STREAMS", default_value_t = 4096, value_parser = parse_places, value_name = "N")]
    pub max_streams: usize,
    /// How long a session may be idle before it expires.
    #[arg(
        long, env = "ETUDE_SESSION_IDLE_TIMEOUT", default_value = "1h", value_parser = parse_duration, value_name = "TIME"
    )]
    pub session_idle_timeout: Duration,
    /// How long a client may leave unread what waits for it.
    #[arg(
        long, env = "ETUDE_SLOW_READER_TIMEOUT", default_value = "10s", value_parser = parse_period, value_name = "TIME"
    )]
    pub slow_reader_timeout: Duration,
    /// How often rewards are folded into the weights of their learners, such as 100ms or 1s; above 0.
    #[arg(long, env = "ETUDE_LEARN_EVERY", default_value = "1s", value_parser = parse_period, value_name = "TIME")]
    pub learn_every: Duration,
    /// How long a client may take to send a request up to its body, or keep a connection without one.
    #[arg(long, env = "ETUDE_HEAD_TIMEOUT", default_value = "2m", value_parser = parse_period, value_name = "TIME")]
    pub head_timeout: Duration,
    /// How long requests may go on after SIGTERM, SIGINT or SIGHUP, such as 500ms, 10s or 1m; a second SIGTERM or SIGINT ends them at
    /// once.
    #[arg(long, env = "ETUDE_DRAIN_TIMEOUT", default_value = "10s", value_parser = parse_duration, value_name = "TIME")]
    pub drain_timeout: Duration,
}

impl ServeConfig {
    /// The settings of an application that goes by `clock` and makes `ids`.
    #[must_use]
    pub fn settings(&self, clock: Clock, ids: Ids) -> Settings {
        let n_cores = std::thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let max_memory = self.max_memory.unwrap_or_else(memory::default_max_bytes);
        let memory = Memory::new(max_memory);
        Settings {
            database: self.database.clone(),
            limits: model::Limits {
                max_states: self.max_states,
                max_transitions: self.max_transitions,
                max_bytes: usize::try_from(memory.room() / 2).unwrap_or(usize::MAX),
                ..model::Limits::DEFAULT
            },
            memory,
            clock,
            ids,
            model_cache_bytes: self.model_cache_bytes.unwrap_or(MAX_MODEL_CACHE_BYTES.min(max_memory / 4)),
            session_idle_timeout: self.session_idle_timeout,
            time_limits: TimeLimits {
                default_deadline: self.default_deadline.min(self.max_deadline),
                max_deadline: self.max_deadline,
                compile: self.max_compile_time,
            },
            pool: PoolSettings {
                n_threads: self.search_threads.map_or(n_cores, NonZeroUsize::get),
                max_waiting: self.search_queue,
                max_long: MAX_LONG_SEARCHES,
            },
        }
    }
}

impl ServeConfig {
    /// What connections may use.
    #[must_use]
    pub fn connection_limits(&self) -> ConnectionLimits {
        ConnectionLimits {
            max_connections: self.max_connections,
            head_timeout: self.head_timeout,
            slow_reader_timeout: self.slow_reader_timeout,
        }
    }

    /// The same settings, with no more connections than `max_files` open files and the memory that is kept for them allow.
    #[must_use]
    pub fn within(&self, max_files: u64) -> Self {
        /// Files that are no connections: those of the database, of logs, of the runtime.
        const OTHER_FILES: u64 = 64;
        /// What an idle connection, or one that begins a request, uses at most.
        const CONNECTION_BYTES: u64 = 64 * 1024;
        let max_memory = self.max_memory.unwrap_or_else(memory::default_max_bytes);
        let by_memory = max_memory.saturating_sub(Memory::new(max_memory).room()) / CONNECTION_BYTES;
        let allowed = usize::try_from(max_files.saturating_sub(OTHER_FILES).min(by_memory)).unwrap_or(usize::MAX);
        Self { max_connections: self.max_connections.min(allowed).max(MIN_CONNECTIONS), ..self.clone() }
    }

    /// What a stream may use.
    #[must_use]
    pub fn stream_limits(&self) -> Limits {
        let memory = Memory::new(self.max_memory.unwrap_or_else(memory::default_max_bytes));
        let by_connections = self.max_connections - self.max_connections / 4;
        Limits {
            frame_bytes: STREAM_FRAME_BYTES,
            // Whatever streams there are, requests get through.
            streams: self.max_streams.min(by_connections).min(Rooms::most_streams(&memory)),
            slow_after: self.slow_reader_timeout,
            idle_after: self.session_idle_timeout,
            ping_every: STREAM_PING_INTERVAL,
        }
    }
}

/// Largest frame of a stream: a thousand observations of a dozen attributes.
const STREAM_FRAME_BYTES: usize = 262_144;

/// How often a silent client of a stream is asked for a sign of life: a peer that is gone without a word is noticed within two minutes.
const STREAM_PING_INTERVAL: Duration = Duration::from_secs(30);

/// Most memory for models by default.
const MAX_MODEL_CACHE_BYTES: u64 = 1 << 30;

/// Least memory of a service: it keeps half of that for what it does not count.
const MIN_MEMORY_BYTES: u64 = 128 << 20;

/// Most threads: half of those that the runtime has for what blocks.
const MAX_THREADS: usize = 256;

/// Most searches that have run for longer than a moment, each of which keeps its memory until it is done. One client may have half of
/// these.
const MAX_LONG_SEARCHES: usize = 32;

/// Fewest connections, whatever the limits are.
pub(crate) const MIN_CONNECTIONS: usize = 16;

/// Most searches that wait, connections, and streams: beyond what memory and files allow.
const MAX_PLACES: usize = 1_000_000;

fn parse_at_most(text: &str, most: usize) -> Result<usize, String> {
    let count: usize = text.parse().map_err(|error: std::num::ParseIntError| error.to_string())?;
    if count <= most { Ok(count) } else { Err(format!("expected at most {most}")) }
}

fn parse_places(text: &str) -> Result<usize, String> {
    parse_at_most(text, MAX_PLACES)
}

fn parse_connections(text: &str) -> Result<usize, String> {
    let count = parse_places(text)?;
    if count >= MIN_CONNECTIONS { Ok(count) } else { Err(format!("expected at least {MIN_CONNECTIONS}")) }
}

fn parse_threads(text: &str) -> Result<NonZeroUsize, String> {
    NonZeroUsize::new(parse_at_most(text, MAX_THREADS)?).ok_or_else(|| "expected at least 1".to_owned())
}

/// Reads a number of bytes, such as 800000000, 512M or 2G (2^20 and 2^30 bytes).
fn parse_memory(text: &str) -> Result<u64, String> {
    const UNITS: [(char, u64); 3] = [('K', 1 << 10), ('M', 1 << 20), ('G', 1 << 30)];
    let number = text.strip_suffix("iB").unwrap_or(text);
    let with_unit = UNITS.iter().find_map(|(letter, unit)| Some((number.strip_suffix(*letter)?, *unit)));
    let (digits, unit) = with_unit.unwrap_or((number, 1));
    let n_bytes = digits.parse::<u64>().ok().and_then(|count| count.checked_mul(unit));
    let n_bytes = n_bytes.ok_or("expected a number of bytes, such as 800000000, 512M or 2G")?;
    if n_bytes >= MIN_MEMORY_BYTES { Ok(n_bytes) } else { Err("expected at least 128M".to_owned()) }
}

fn parse_duration(text: &str) -> Result<Duration, String> {
    let duration: jiff::SignedDuration = text.parse().map_err(|error: jiff::Error| error.to_string())?;
    Duration::try_from(duration).map_err(|_| "expected a time of at least 0".to_owned())
}

fn parse_period(text: &str) -> Result<Duration, String> {
    parse_duration(text)
        .and_then(|period| if period.is_zero() { Err("expected a time above 0".to_owned()) } else { Ok(period) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_no_more_connections_than_files_and_memory_allow() {
        #[derive(clap::Parser)]
        struct Flags {
            #[command(flatten)]
            config: ServeConfig,
        }
        let flags = ["etude", "--max-memory", "1G", "--max-connections"];
        let config = |n: &'static str| <Flags as clap::Parser>::parse_from(flags.into_iter().chain([n])).config;
        let allowed = |n: &'static str, max_files: u64| config(n).within(max_files).max_connections;
        assert_eq!((allowed("1000", 1_000_000), allowed("1000", 1024), allowed("1000", 64)), (1000, 960, 16));
        assert_eq!(allowed("10000", 1_000_000), 5461, "a third of the memory is theirs");
        let few = config("16").within(1024);
        assert_eq!((few.stream_limits().streams, few.connection_limits().max_connections), (12, 16));
        assert!(parse_connections("15").is_err() && parse_connections("1000001").is_err());
    }

    #[test]
    fn times_are_written_with_their_unit() {
        assert_eq!(parse_duration("1s"), Ok(Duration::from_secs(1)));
        assert_eq!(parse_duration("500ms"), Ok(Duration::from_millis(500)));
        assert!(parse_duration("-1s").is_err() && parse_duration("7").is_err());
    }

    #[test]
    fn memory_is_written_in_bytes_or_with_a_unit() {
        assert_eq!((parse_memory("134217728"), parse_memory("2G")), (Ok(128 << 20), Ok(2 << 30)));
        assert_eq!((parse_memory("512M"), parse_memory("512MiB")), (Ok(512 << 20), Ok(512 << 20)));
        for text in ["", "G", "1.5G", "-1", "127M", "99999999999G", "2T"] {
            assert!(parse_memory(text).is_err(), "{text}");
        }
    }

    #[test]
    fn more_places_than_there_can_be_are_refused() {
        assert_eq!((parse_places("0"), parse_places("1000000")), (Ok(0), Ok(MAX_PLACES)));
        assert!(parse_places("1000001").is_err() && parse_places("18446744073709551615").is_err());
        assert!(parse_threads("256").is_ok() && parse_threads("257").is_err() && parse_threads("0").is_err());
    }
}
