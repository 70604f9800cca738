//! The program as a process: its commands, its signals, kills, disks and terminals.

#![expect(clippy::unwrap_used, reason = "tests may panic")]

#[path = "../harness/mod.rs"]
mod harness;

mod command_lines;
mod commands;
mod disk;
mod experience;
mod imports;
mod inputs;
mod inspect;
mod kill_experience;
mod kill_rewards;
mod kill_streams;
mod observe;
mod readme;
mod signals;
mod terminal;
