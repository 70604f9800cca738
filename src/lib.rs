//! `etude` learns a task by watching it done.
//!
//! A demonstrator does a task; only the states that it passes through are seen, never its actions. The imitator has
//! another body. `etude` finds the policy, in the imitator's own actions, whose effects follow the demonstration most
//! closely, by minimizing action costs plus a weighted distance between observed and own states (Gudla & Huber, "Cost-Based
//! Policy Mapping for Imitation", FLAIRS 2003).
//!
//! # Architecture
//!
//! Two packages. `etude-core` is pure: models, mappings, learning, simulators; no I/O, no clock, no randomness of its own, and it can be
//! used without the rest. This one is the service and the program around it. Each module uses only those to its left, which a test holds:
//!
//! ```text
//! etude_core <- client, clock, compressed, memory, telemetry, picture <- experiment <- store <- service <- stream <- http <- config <- server <- cli
//! ```
//!
//! | module | is |
//! |---|---|
//! | [`etude_core`] | the core, with an architecture of its own |
//! | [`client`] | who is served, and lines in which clients have their turns |
//! | [`clock`] | what time it is, and new ids, as the server hands them in |
//! | `compressed` | data that was compressed, read as it comes |
//! | [`memory`] | the one budget of memory |
//! | [`picture`] | paths and timelines of policies, as SVG |
//! | [`experiment`] | the paper's figures |
//! | [`store`] | all SQL: one writer that groups commits, a pool of readers |
//! | [`service`] | the application: models, policies, sessions, learners, trials, the bounded pool that searches run on |
//! | [`stream`] | the stream protocol, one connection at a time, whatever its transport |
//! | [`http`] | routes, bodies, problem documents, the OpenAPI description |
//! | [`server`] | the assembled program, from listening to clean shutdown |
//! | [`cli`] | the subcommands |
//! | [`config`], [`telemetry`] | settings, logs and measurements |
//!
//! A request for a policy passes `http::policies` (body), `service::policies` and `service::requests` (its members, taken apart; the model
//! from `service::cache`), [`etude_core::mapping::Options`] and [`etude_core::mapping::Request`] (read against the model), `service::search`
//! in `service::pool`, [`etude_core::mapping::Mapper`] (search), [`etude_core::mapping::WrittenPolicy`] (the answer, and what is stored of
//! it), and `store::writer` (disk) before it is answered. If anything is wrong with it, `service::requests` reads it once more, as a
//! document, and tells all its faults. Batches, trials and sessions are read by the same two.
//!
//! An observation of a stream passes `http::stream` (transport), [`stream::run`] (frames), `service::sessions` (durable before it is
//! acknowledged) and [`etude_core::mapping::OnlineMapping`] (committed steps). A refinement refers to the session for its observations.
//!
//! A model passes `http::body` (decompressed, and read as it comes if it is large), [`etude_core::model::Definition::parse_from`] (into
//! compact arrays, with all faults), [`etude_core::model::Model::compile`], and `store::definitions` (its canonical text, in pieces if it
//! is long) before `store::writer` makes it visible.
//!
//! What a model of experience is told passes `service::experience` (its turn), [`etude_core::model::Tally`] (counted in memory, by `service::told`), and
//! `store::writer`, which gives the model its next hash with the batch. It is made a table when somebody searches it. What was counted is stored from time to
//! time, beside the batches, which alone are true: a service that starts counts only what came since.
//!
//! What is large takes its memory from [`memory`] before it begins. Clients take turns wherever they might wait for one another: `http::rounds`
//! tells whose connection is served next, `store` who reads next, and `service::pool` whose turn it is to search, compile or read a large body. A
//! model that is not at hand is made ready by `service::compiler`, once, however many ask for it.
//!
//! A trial goes the same way through `service::trials`, with weights that a [`etude_core::learning::Learner`] draws. Its reward is accepted
//! by `store::writer`, which numbers rewards in one log per learner; `service::learner_task` folds what is new in the log into the next
//! version of the weights.

pub mod cli;
pub mod client;
pub mod clock;
mod compressed;
pub mod config;
pub mod experiment;
pub mod http;
pub mod memory;
pub mod picture;
pub mod server;
pub mod service;
pub mod store;
pub mod stream;
pub mod telemetry;
