//! Dynamics that were experienced: transitions that a body was seen to make, counted.
//!
//! ```text
//! definition --> Tally --add(batch)--> Tally --add(batch)--> ..        each with its counts
//!                                        |
//!                                        +--> a table   (compiled only when somebody searches)
//! ```
//!
//! Relative frequencies become probabilities, mean costs become costs (Gudla & Huber, FLAIRS 2003, let the imitator learn its model by
//! exploring). Which batches there were, and whether one came twice, is the caller's affair.

mod batch;
mod document;
mod kept;
mod reading;
mod tally;
mod values;

use std::collections::HashSet;
use std::io;
use std::sync::Arc;

use serde::Serialize;

pub use batch::Batch;
pub use document::{ExperienceDocument, SeenStateDocument, SeenStatesDocument};
pub use kept::KeptTally;
pub(super) use reading::read;
pub use tally::{ExperienceCounts, Tally};

use super::dynamics::{Dynamics, write_definition};
use super::{Action, CompileError, Limits, Model};
use crate::attribute::{AttributeDocument, Cycle, Kind, Schema, Value};
use crate::document::Faults;
use crate::interrupt::Interrupt;

/// A model whose states and transitions are those that are experienced.
#[derive(Clone, Debug)]
pub struct Experience {
    schema: Schema,
    actions: Vec<Action>,
    /// How often a state and an action must have been seen to be in the model: at least once.
    min_count: u64,
    /// To multiples of what the values of an attribute are rounded, if they are. Shape `[n_attributes]`.
    bins: Vec<Option<f64>>,
    /// Rounded, all different; none: the imitator starts anywhere.
    start: Vec<Vec<Value>>,
    /// Rounded.
    unsafe_states: HashSet<Vec<Value>>,
    /// What it was read from, in canonical form.
    document: ExperienceDocument,
}

impl Experience {
    /// These values of a state, rounded as the definition says: half away from zero, on a circle modulo its period.
    fn binned(&self, mut values: Vec<Value>) -> Vec<Value> {
        for ((attribute, width), value) in self.schema.attributes().iter().zip(&self.bins).zip(&mut values) {
            let (Some(width), Value::Number(number)) = (width, value) else { continue };
            let mut rounded = (*number / width).round() * width;
            if let Kind::Cyclic { cycle: Cycle::Period(period), .. } = attribute.kind {
                rounded = rounded.rem_euclid(period);
                if rounded >= period {
                    rounded = 0.0;
                }
            }
            // Where floats are coarser than the bins, there is nothing to round. Adding 0.0 turns -0.0 into 0.0.
            if rounded.is_finite() {
                *number = rounded + 0.0;
            }
        }
        values
    }
}

impl Dynamics for Experience {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, _: Limits) -> u64 {
        Model::compiled_bytes(self.start.len() as u64, 0, self.schema.len() as u64)
    }

    /// What there is before anything was experienced: the states to start in.
    fn compile(self: Arc<Self>, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError> {
        match Tally::of(self).table(interrupt)? {
            Some(table) => Arc::new(table).compile(limits, interrupt),
            None => Err(Faults::one("/dynamics", NOTHING_YET).into()),
        }
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        #[derive(Serialize)]
        struct Written<'e> {
            kind: &'static str,
            #[serde(flatten)]
            experience: &'e ExperienceDocument,
        }
        let attributes = self.schema.attributes().iter().map(AttributeDocument::from);
        let written = Written { kind: "experience", experience: &self.document };
        write_definition(writer, Some(attributes.collect()), &self.actions, &written)
    }
}

/// Why there is no model yet.
pub const NOTHING_YET: &str = "nothing was experienced yet: there is no state that the imitator may start in";
