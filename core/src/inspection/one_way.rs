//! Attributes that change one way only, whatever can be reached.

use super::{Parts, Query};
use crate::interrupt::{Interrupted, Meter};
use crate::model::{Model, Rows};

/// For each attribute of a model that is searched lazily, between which of its values there is a way back.
#[derive(Debug, Default)]
pub(super) struct OneWay {
    /// Positions of attributes that weigh something, each with its parts by value.
    attributes: Vec<(usize, Vec<u32>)>,
}

impl OneWay {
    /// What the operators of the body tell. Of a model that lists its states, nothing: its transitions tell more.
    pub(super) fn of(model: &Model, query: &Query, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        let mut one_way = Self::default();
        let Some(operators) = model.operators() else { return Ok(one_way) };
        let mut changes: Vec<Vec<(u32, u32)>> = vec![Vec::new(); model.schema().len()];
        for operator in operators {
            meter.spend_or_stop(1 + operator.changed.len() as u64)?;
            if !query.conditions.without.contains(&operator.action) {
                operator.changed.iter().for_each(|(position, from, to)| changes[*position].push((*from, *to)));
            }
        }
        let weighed = query.weights.as_slice().iter().zip(changes).enumerate();
        for (position, (_, mut changes)) in weighed.filter(|(_, (weight, _))| **weight > 0.0) {
            changes.sort_unstable();
            changes.dedup();
            let n_values = model.states().domain(position).len();
            let rows = Rows::of_entries(n_values, changes.iter().copied());
            let parts = Parts::of_graph(n_values, |value| rows.of(value as usize), |to| *to, meter)?;
            one_way.attributes.push((position, parts.of));
        }
        Ok(one_way)
    }

    /// Whether no state that looks like the one with the row `to` can follow the one with the row `from`, from which a transition has led there.
    pub(super) fn bars(&self, from: &[u32], to: &[u32]) -> bool {
        let part = |parts: &[u32], value: u32| parts[value as usize];
        self.attributes.iter().any(|(at, parts)| part(parts, from[*at]) != part(parts, to[*at]))
    }
}
