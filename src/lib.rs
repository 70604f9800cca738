//! `etude` learns a task by watching it done.
//!
//! A demonstrator does a task; only the states that it passes through are seen, never its actions. The imitator has
//! another body. `etude` finds the policy, in the imitator's own actions, whose effects follow the demonstration most
//! closely, by minimizing action costs plus a weighted distance between observed and own states (Gudla & Huber, "Cost-Based
//! Policy Mapping for Imitation", FLAIRS 2003).
//!
//! # Architecture
//!
//! The core, on the left, is pure: no I/O, no clock, no randomness of its own. The shell, on the right, knows the world. Each
//! module uses only those to its left.
//!
//! ```text
//! interrupt, document <- attribute <- model <- mapping <- learning <- world <- experiment   |   store <- service <- stream <- http <- server <- cli
//!                                                                                           |   memory, config, telemetry
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`document`] | reading JSON with all its faults, each with its pointer |
//! | [`interrupt`] | how a long computation is stopped from outside |
//! | [`attribute`] | attributes of states: kinds, values, weights, distance |
//! | [`model`] | what a body can do: `table` and `wumpus` dynamics, compiled to one state graph, or left to searches |
//! | [`mapping`] | the cheapest way to follow a demonstration: problem, search, heuristics, policy |
//! | [`learning`] | which attributes matter: a weight distribution, drawn from and learned from rewards |
//! | [`world`] | simulators that execute a policy and give its reward |
//! | [`experiment`] | the paper's figures |
//! | [`store`] | all SQL: one writer that groups commits, a pool of readers |
//! | [`service`] | the application: models, policies, sessions, learners, trials, the bounded pool that searches run on |
//! | [`stream`] | the stream protocol, one connection at a time, whatever its transport |
//! | [`http`] | routes, bodies, problem documents, the OpenAPI description |
//! | [`server`] | the assembled program, from listening to clean shutdown |
//! | [`cli`] | the subcommands |
//! | [`memory`] | the one budget of memory |
//! | [`config`], [`telemetry`] | settings, logs and measurements |
//!
//! A request for a policy passes `http::policies` (body), `service::policies` (a place in `service::pool`), `service::outline` (its
//! demonstration, for the model from `service::cache`), [`mapping::Request`] (faults), [`mapping::Mapper`] (search),
//! [`mapping::WrittenPolicy`] (the answer, and what is stored of it), and `store::writer` (disk) before it is answered. An observation
//! of a stream passes `http::stream` (transport), [`stream::run`] (frames), `service::sessions` (durable before it is acknowledged) and
//! [`mapping::OnlineMapping`] (committed steps).
//!
//! A model passes `http::body` (decompressed, and read as it comes if it is large), [`model::Definition::parse_from`] (into compact
//! arrays, with all faults), [`model::Model::compile`], and `store::definitions` (its canonical text, in pieces if it is long) before
//! `store::writer` makes it visible.
//!
//! What is large takes its memory from [`memory`] before it begins, and whose turn it is to use a thread is told by `service::pool`. A model
//! that is not at hand is made ready by `service::compiler`, once, however many ask for it.
//!
//! A trial goes the same way through `service::trials`, with weights that a [`learning::Learner`] draws. Its reward is accepted by
//! `store::writer`, which numbers rewards in one log per learner; `service::learner_task` folds what is new in the log into
//! the next version of the weights.

pub mod attribute;
pub mod cli;
pub mod config;
pub mod document;
pub mod experiment;
pub mod http;
pub mod interrupt;
pub mod learning;
pub mod mapping;
pub mod memory;
pub mod model;
pub mod server;
pub mod service;
pub mod store;
pub mod stream;
pub mod telemetry;
pub mod world;
