//! `etude` learns a task by watching it done.
//!
//! A demonstrator does a task; only the states that it passes through are seen, never its actions. The imitator has
//! another body. `etude` finds the policy, in the imitator's own actions, whose effects follow the demonstration most
//! closely, by minimizing action costs plus a weighted distance between observed and own states (Gudla & Huber, "Cost-Based
//! Policy Mapping for Imitation", FLAIRS 2003).
//!
//! # Architecture
//!
//! The core is pure: no I/O, no clock, no randomness of its own. Each module uses only those to its left.
//!
//! ```text
//! document <- attribute <- model <- mapping
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`document`] | reading JSON with all its faults, each with its pointer |
//! | [`attribute`] | attributes of states: kinds, values, weights, distance |
//! | [`model`] | what a body can do: `table` and `wumpus` dynamics, compiled to one state graph |
//! | [`mapping`] | the cheapest way to follow a demonstration: problem, search, heuristics, policy |
//! | [`interrupt`] | how a long computation is stopped from outside |

pub mod attribute;
pub mod document;
pub mod interrupt;
pub mod mapping;
pub mod model;
