//! Who asks for something, and since when.

use std::time::Instant;

use jiff::Timestamp;

use crate::client::Client;

/// A request's caller.
#[derive(Clone, Copy, Debug)]
pub struct Caller {
    /// Who asks.
    pub client: Client,
    /// When the request arrived: what deadlines count from.
    pub arrived: Instant,
    /// The same moment on the calendar.
    pub now: Timestamp,
}
