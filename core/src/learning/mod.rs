//! Learning: which attributes of a task matter, from the rewards of trials.
//!
//! A [`Learner`] keeps a normal distribution per attribute. A *trial* draws one weight vector from it
//! ([`Learner::draw`]), maps a demonstration with these weights, executes the policy and earns a reward, from which the
//! distribution learns ([`Learner::learn`]).
//!
//! ```text
//! Learner (definition: attributes, rule, seed) --initial--> Distribution, version 0
//!                                                              |
//!    (seed, trial number) --draw--> weights --> trial --> reward --> log of accepted rewards, 1, 2, 3 ..
//!                                                              |        |
//!                             Distribution, version 1, 2, .. <-+--learn-+   a pure fold over the log, in its order
//! ```
//!
//! Everything here is a pure function: the same definition and the same log give the same bits, on any machine, however
//! the trials were spread over clients and time. Attributes are known by name only, so that what was learned in one world can
//! be used in any other whose model has those attributes ([`Learner::weights_for`]).

mod definition;
mod distribution;
mod learner;

pub use definition::{AlgorithmDocument, LearnerDocument, PerAttributeDocument};
pub use distribution::Distribution;
pub use learner::{Algorithm, Learner, MissingAttributes};
