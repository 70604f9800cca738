//! When the service was last known to be alive.
//!
//! Sessions expire once nothing has come for them for too long. Time in which nothing could come, because the service was stopped,
//! suspended, or could not write, does not count: whoever notes that it is alive finds when that was done last, and moves the open
//! sessions on by what was between.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::{StoreError, as_integer};

/// A sign of life.
#[derive(Clone, Copy, Debug)]
pub(super) struct Alive {
    /// When.
    pub(super) now: Timestamp,
    /// Signs of life come at least so often. Twice as long without any is time in which there was none to be given.
    pub(super) every: Duration,
}

/// Notes a sign of life, once everything has arrived in its table. `was_interrupted` if it is the first one since the service
/// was started, or since something could not be written.
pub(super) async fn note(
    connection: &mut SqliteConnection,
    Alive { now, every }: Alive,
    was_interrupted: bool,
) -> Result<(), StoreError> {
    let now_ms = now.as_millisecond();
    // What came for a session is a sign of life too.
    let query = sqlx::query_scalar(
        "SELECT MAX(at_ms) FROM
             (SELECT last_alive_ms AS at_ms FROM service
              UNION ALL SELECT MAX(active_at_ms) FROM sessions WHERE status = 'open')",
    );
    let last_ms: Option<i64> = query.fetch_one(&mut *connection).await?;
    let gap_ms = last_ms.map_or(0, |last_ms| now_ms.saturating_sub(last_ms));
    let usual_ms = as_integer(u64::try_from(every.as_millis()).unwrap_or(u64::MAX)).saturating_mul(2);
    if gap_ms > 0 && (was_interrupted || gap_ms > usual_ms) {
        let moved = sqlx::query(
            "UPDATE sessions SET active_at_ms = MIN(active_at_ms + $1, $2) WHERE status = 'open' AND active_at_ms < $2",
        );
        let n_moved = moved.bind(gap_ms).bind(now_ms).execute(&mut *connection).await?.rows_affected();
        if n_moved > 0 {
            tracing::info!(gap_ms, n_sessions = n_moved, "time without service does not count for open sessions");
        }
    }
    sqlx::query(
        "INSERT INTO service (id, last_alive_ms) VALUES (1, $1)
         ON CONFLICT (id) DO UPDATE SET last_alive_ms = excluded.last_alive_ms",
    )
    .bind(now_ms)
    .execute(connection)
    .await?;
    Ok(())
}
