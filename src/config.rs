//! How `etude serve` is set up: by flags, or by environment variables of the same meaning.

mod values;

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

use axum::http::HeaderValue;
use clap::{Arg, Args, Command};

pub(crate) use self::values::{MIN_CONNECTIONS, parse_address, parse_count, parse_database, parse_whole};
use self::values::{
    parse_bytes, parse_connections, parse_duration, parse_memory, parse_period, parse_places, parse_threads,
};
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
    #[arg(long, env = "ETUDE_LISTEN", default_value = "127.0.0.1:8080", value_parser = parse_address, value_name = "HOST:PORT")]
    pub listen: SocketAddr,
    /// SQLite database; created if missing.
    #[arg(long, env = "ETUDE_DATABASE", default_value = "etude.db", value_parser = parse_database, value_name = "FILE")]
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
    /// Largest request body, as it is sent and after decompression.
    #[arg(long, env = "ETUDE_MAX_BODY_BYTES", value_parser = parse_bytes::<usize>, default_value_t = 8 * 1024 * 1024, value_name = "BYTES")]
    pub max_body_bytes: usize,
    /// Largest model, as it is sent [default: as other bodies].
    #[arg(long, env = "ETUDE_MAX_MODEL_BYTES", value_parser = parse_bytes::<usize>, value_name = "BYTES")]
    pub max_model_bytes: Option<usize>,
    /// Largest model after decompression.
    #[arg(long, env = "ETUDE_MAX_MODEL_TEXT_BYTES", value_parser = parse_bytes::<u64>, default_value_t = 512 * 1024 * 1024, value_name = "BYTES")]
    pub max_model_text_bytes: u64,
    /// Most states of a model; a world of rules, or a wumpus world, of more is searched lazily.
    #[arg(long, env = "ETUDE_MAX_STATES", value_parser = parse_whole::<usize>, default_value_t = model::Limits::DEFAULT.max_states, value_name = "N")]
    pub max_states: usize,
    /// Most transitions of a model.
    #[arg(
        long, env = "ETUDE_MAX_TRANSITIONS", value_parser = parse_whole::<usize>, default_value_t = model::Limits::DEFAULT.max_transitions, value_name = "N"
    )]
    pub max_transitions: usize,
    /// Memory that the service may use in all [default: three quarters of what the machine or its cgroup has].
    #[arg(long, env = "ETUDE_MAX_MEMORY", value_parser = parse_memory, value_name = "BYTES")]
    pub max_memory: Option<u64>,
    /// Of that, for models that are kept ready to be searched [default: a quarter, 1 GiB at most].
    #[arg(long, env = "ETUDE_MODEL_CACHE_BYTES", value_parser = parse_bytes::<u64>, value_name = "BYTES")]
    pub model_cache_bytes: Option<u64>,
    /// How long a search may take, counted from the arrival of its request, if the request has no `deadline_ms`.
    #[arg(
        long, env = "ETUDE_DEFAULT_DEADLINE", default_value = "10s", value_parser = parse_period, value_name = "TIME"
    )]
    pub default_deadline: Duration,
    /// Longest time of a search; a longer `deadline_ms` is cut to it.
    #[arg(long, env = "ETUDE_MAX_DEADLINE", default_value = "10m", value_parser = parse_period, value_name = "TIME")]
    pub max_deadline: Duration,
    /// How long compiling a model may take; a model that takes longer is refused.
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
    /// How long a client may leave answers and frames unread.
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
    /// The settings of the application, with its clock and its source of ids.
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
    /// Limits of connections.
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
        /// Open files of the database, the logs and the runtime.
        const OTHER_FILES: u64 = 64;
        /// Most memory of a connection that is idle or begins a request.
        const CONNECTION_BYTES: u64 = 64 * 1024;
        let max_memory = self.max_memory.unwrap_or_else(memory::default_max_bytes);
        let by_memory = max_memory.saturating_sub(Memory::new(max_memory).room()) / CONNECTION_BYTES;
        let allowed = usize::try_from(max_files.saturating_sub(OTHER_FILES).min(by_memory)).unwrap_or(usize::MAX);
        Self { max_connections: self.max_connections.min(allowed).max(MIN_CONNECTIONS), ..self.clone() }
    }

    /// Limits of streams.
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

/// Most searches that have run for longer than a moment, each of which keeps its memory until it is done. One client may have half of
/// these.
const MAX_LONG_SEARCHES: usize = 32;

/// The same command, for which environment variables that are set and empty are as if they were not set.
#[must_use]
pub fn without_empty_variables(command: Command) -> Command {
    let is_empty = |arg: &Arg| arg.get_env().and_then(std::env::var_os).is_some_and(|value| value.is_empty());
    let command = command.mut_args(|arg| if is_empty(&arg) { arg.env(None) } else { arg });
    command.mut_subcommands(without_empty_variables)
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
    }
}
