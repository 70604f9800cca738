//! A tally in a form to be stored, so that what it counts need not be counted again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::Tally;
use super::tally::SeenOutcome;
use super::values::DistinctStates;
use crate::attribute::{Attribute, Cycle, Kind, Value};

/// What a [`Tally`] has counted, to be written and read by any format of `serde` that keeps all bits of floats.
#[derive(Debug, Serialize, Deserialize)]
pub struct KeptTally<'t> {
    /// By attribute: distinct values.
    domains: Cow<'t, [Vec<Value>]>,
    /// Indices into the domains. Shape `[n_states, n_attributes]`.
    rows: Cow<'t, [u32]>,
    /// By first appearance.
    outcomes: Cow<'t, [SeenOutcome]>,
}

impl Tally {
    /// What was counted up to now.
    #[must_use]
    pub fn kept(&self) -> KeptTally<'_> {
        let (domains, rows) = self.states.parts();
        KeptTally { domains: domains.into(), rows: rows.into(), outcomes: (&self.outcomes).into() }
    }

    /// This tally, which has counted nothing yet, once it has counted what `kept` says: equal to the bit to the one that was kept. `None` if
    /// that was none of this model.
    #[must_use]
    pub fn with_kept(mut self, kept: KeptTally<'_>) -> Option<Self> {
        let KeptTally { domains, rows, outcomes } = kept;
        let are_values =
            |(attribute, domain): (&Attribute, &Vec<Value>)| domain.iter().all(|value| is_of(attribute, value));
        if !self.experience.schema.attributes().iter().zip(domains.iter()).all(are_values) {
            return None;
        }
        self.states = DistinctStates::of_parts(&domains, &rows, self.experience.schema.len())?;
        let unsafe_states = &self.experience.unsafe_states;
        if !unsafe_states.is_empty() {
            let is_unsafe = |state: &u32| {
                let values: Vec<Value> = self.states.values(*state).cloned().collect();
                unsafe_states.contains(&values)
            };
            self.n_unsafe = (0..self.states.len()).filter(is_unsafe).count();
        }
        let n_states = self.states.len();
        self.outcomes = outcomes.into_owned();
        for at in 0..self.outcomes.len() {
            let outcome = self.outcomes[at];
            let is_known = outcome.from < n_states
                && outcome.to < n_states
                && usize::from(outcome.action) < self.experience.actions.len()
                && outcome.count > 0
                && outcome.n_costs <= outcome.count
                && [outcome.cost, outcome.cost_sum].into_iter().all(|cost| cost.is_finite() && cost >= 0.0);
            let is_new = is_known && self.note_outcome(at);
            if !is_new {
                return None;
            }
        }
        Some(self)
    }
}

/// Whether an attribute can have this value.
fn is_of(attribute: &Attribute, value: &Value) -> bool {
    match (&attribute.kind, value) {
        (Kind::Cyclic { cycle: Cycle::Labels(labels), .. }, Value::Label(label)) => {
            (*label as usize) < labels.names().len()
        }
        (Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. }, Value::Number(number)) => {
            number.is_finite() && number.to_bits() != (-0.0_f64).to_bits()
        }
        (Kind::Category, Value::Text(_) | Value::Integer(_) | Value::Boolean(_)) => true,
        _ => false,
    }
}
