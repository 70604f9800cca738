//! The service, in the process of the tests, mostly over HTTP.

#![expect(
    clippy::unwrap_used,
    clippy::too_many_lines,
    clippy::cast_possible_truncation,
    reason = "tests may panic, and are read top to bottom"
)]

#[path = "../harness/mod.rs"]
mod harness;
#[path = "../../core/tests/suite/oracle/mod.rs"]
mod oracle;
#[path = "../../core/tests/suite/problems.rs"]
mod problems;

mod agreement;
mod batch;
mod contract;
mod deletion;
mod experience;
mod filters;
mod front;
mod http;
mod idempotency;
mod imports;
mod inputs;
mod learning;
mod limits;
mod observe;
mod protocol;
mod replacement;
mod reports;
mod rules;
mod stored_policies;
mod stream;
mod trials;
mod uploads;
