//! The core of `etude`: how an agent with one body follows what an agent with another body was seen doing.
//!
//! A demonstrator does a task; only the states that it passes through are seen, never its actions. Given a [`model`] of what the imitator
//! can do, [`mapping`] finds the cheapest way to follow those states: action costs plus a weighted distance between observed and own
//! states (Gudla & Huber, "Cost-Based Policy Mapping for Imitation", FLAIRS 2003). [`learning`] changes the weights by the rewards that
//! executions earn.
//!
//! Everything here is pure: there is no I/O, no clock and no source of randomness. A long computation asks its caller whether to go on
//! ([`interrupt`]), and a draw follows from a seed and a number.
//!
//! # Architecture
//!
//! Each module uses only those to its left; a test of the service holds that order.
//!
//! ```text
//! interrupt, document <- attribute <- expression <- model <- mapping <- inspection, learning <- world
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`interrupt`] | how a long computation is stopped from outside |
//! | [`document`] | reading JSON with all its faults, each with its pointer |
//! | [`attribute`] | attributes of states: kinds, values, weights, distance |
//! | `expression` | expressions of CEL: checked once, evaluated often |
//! | [`model`] | what a body can do: dynamics of any kind, compiled to one state graph, or searched lazily |
//! | [`mapping`] | the cheapest way to follow a demonstration: problem, search, heuristics, streams, policy |
//! | [`inspection`] | what can be said of a body before it follows anything, and what of a demonstration it can never meet |
//! | [`learning`] | which attributes matter: a weight distribution, drawn from and learned from rewards |
//! | [`world`] | simulators that execute a policy and give its reward |
//!
//! # From nothing to a policy
//!
//! ```
//! use etude_core::attribute::{Attribute, Schema};
//! use etude_core::interrupt::Uninterrupted;
//! use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Settings};
//! use etude_core::model::ModelBuilder;
//!
//! let schema = Schema::new([Attribute::number("x")])?;
//! let mut body = ModelBuilder::new(schema.clone());
//! let forward = body.action("forward", 0.3)?;
//! let cells: Vec<_> = (0..3).map(|x| body.state([x.into()])).collect::<Result<_, _>>()?;
//! body.transition(cells[0], forward, cells[1])?;
//! body.transition(cells[1], forward, cells[2])?;
//! let mapper = Mapper::new(body.build()?, &mut Uninterrupted)?;
//!
//! let demonstration = Demonstration::new(&schema, (0..3).map(|x| [Some(x.into())]))?;
//! let problem = Problem::new(mapper.model(), demonstration, schema.weights(), Conditions::default());
//! let mapping = mapper.map(&problem, Settings::default(), &mut Uninterrupted)?;
//! assert_eq!((mapping.moves.len(), mapping.cost.actions), (3, 0.6));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! `examples/corridor.rs` goes a little further.

pub mod attribute;
pub mod document;
#[cfg(feature = "rules")]
mod expression;
pub mod inspection;
pub mod interrupt;
pub mod learning;
pub mod mapping;
pub mod model;
pub mod world;
