//! What a connection may use, and what a client is told of it.

use std::time::Duration;

use etude_core::mapping::Demonstration;

use super::frames::HelloLimits;

/// What a connection may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Largest frame, in bytes.
    pub frame_bytes: usize,
    /// How many streams may run at the same time.
    pub streams: usize,
    /// How long a client may take to read what waits for it.
    pub slow_after: Duration,
    /// How long a connection may stay silent.
    pub idle_after: Duration,
    /// How often a client of which nothing comes is asked for a sign of life, where the transport can. Above 0.
    pub ping_every: Duration,
}

impl Limits {
    /// Longest message that is sent, in bytes.
    #[must_use]
    pub fn message_bytes(&self) -> usize {
        self.frame_bytes
    }
}

impl From<Limits> for HelloLimits {
    fn from(limits: Limits) -> Self {
        let message_bytes = limits.message_bytes();
        let Limits { frame_bytes, streams, slow_after, idle_after, ping_every } = limits;
        let ms = |time: Duration| u64::try_from(time.as_millis()).unwrap_or(u64::MAX);
        Self {
            frame_bytes,
            message_bytes,
            observations: Demonstration::MAX_OBSERVATIONS,
            streams,
            idle_timeout_ms: ms(idle_after),
            slow_reader_timeout_ms: ms(slow_after),
            ping_interval_ms: ms(ping_every),
        }
    }
}
