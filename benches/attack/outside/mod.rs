//! The service seen from outside, over loopback: the program in a process of its own, honest clients and attackers.

#![allow(
    dead_code,
    unused_imports,
    clippy::allow_attributes,
    reason = "the benchmark and the test use their parts of this module"
)]

mod attacks;
mod honest;
mod service;
#[path = "../../mapping/table.rs"]
mod table;

pub(crate) use attacks::{Attack, Attacker, Size};
pub(crate) use honest::{Honest, Kind};
pub(crate) use service::{Group, Service};

pub(crate) type Failure = Box<dyn std::error::Error + Send + Sync>;
