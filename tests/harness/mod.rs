//! What the tests of the service and of the program share.

#![allow(dead_code, clippy::allow_attributes, reason = "each test binary uses its part of this module")]

pub(crate) mod client;
pub(crate) mod contract;
pub(crate) mod process;
pub(crate) mod python;
pub(crate) mod service;
pub(crate) mod waiting;
