//! How much clients have used processors of late.

use std::time::{Duration, Instant};

use rustc_hash::FxHashMap;

use crate::client::Client;

/// What was used so long ago counts half.
const HALF_LIFE: Duration = Duration::from_secs(1);

/// Who has used less than this is forgotten.
const NEGLIGIBLE_SECONDS: f64 = 1e-3;

/// How long each client has used processors, of late.
#[derive(Debug, Default)]
pub(super) struct Usage {
    by_client: FxHashMap<Client, Used>,
    /// Those that are negligible are forgotten when there are so many.
    n_most: usize,
}

/// So many seconds at some time, and nothing since.
#[derive(Clone, Copy, Debug)]
struct Used {
    seconds: f64,
    at: Instant,
}

impl Used {
    /// What it counts at `now`, in seconds.
    fn counts(self, now: Instant) -> f64 {
        let n_half_lives = now.saturating_duration_since(self.at).as_secs_f64() / HALF_LIFE.as_secs_f64();
        self.seconds * (-n_half_lives).exp2()
    }
}

impl Usage {
    /// What `client` has used, as it counts at `now`, in seconds.
    pub(super) fn of(&self, client: Client, now: Instant) -> f64 {
        self.by_client.get(&client).map_or(0.0, |used| used.counts(now))
    }

    /// Adds what `client` has used until `now`.
    pub(super) fn add(&mut self, client: Client, used: Duration, now: Instant) {
        let seconds = self.of(client, now) + used.as_secs_f64();
        self.by_client.insert(client, Used { seconds, at: now });
        if self.by_client.len() > self.n_most {
            self.by_client.retain(|_, used| used.counts(now) >= NEGLIGIBLE_SECONDS);
            self.n_most = 2 * self.by_client.len() + 64;
        }
    }
}
