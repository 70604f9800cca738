//! What attributes add to distances, in tables.

use rustc_hash::FxHashMap;

use super::weighted_term;
use crate::attribute::{Schema, Value, Weights};
use crate::mapping::{Conditions, Demonstration};
use crate::model::{Model, States};

/// The terms of distances, without the model that they belong to.
#[derive(Debug, Default)]
pub(crate) struct Terms {
    /// In schema order, in which distances are summed.
    pub(super) attributes: Vec<AttributeTerms>,
}

/// What an attribute adds to distances.
#[derive(Debug)]
pub(super) struct AttributeTerms {
    pub(super) position: usize,
    pub(super) weight: f64,
    /// By observation: the number of the value that it saw, from 1 on; 0 if it did not see the attribute, or has no weight. Shape
    /// `[n_observations]`.
    pub(super) rows: Vec<u32>,
    /// How many of these are not 0: the attribute takes part if some are.
    pub(super) n_seen: usize,
    pub(super) n_values: usize,
    /// Terms by number and domain index. Shape `[1 + n_observed, n_values]`, the first row zero; empty if it would be too large.
    pub(super) table: Vec<f64>,
    /// The numbers of rows of the table that no observation has.
    free: Vec<u32>,
    /// The observed values and their observations' weights, in the order of their numbers, if there is no table.
    pub(super) untabled: Vec<(Value, f64)>,
}

/// Most entries of all tables together: 2 MB, which take a millisecond to fill. Values of larger domains are compared one by one.
const MAX_TABLE_ENTRIES: usize = 1 << 18;

impl Terms {
    /// Of the observations of a demonstration.
    pub(crate) fn of(
        schema: &Schema,
        states: &States,
        demonstration: &Demonstration,
        weights: &Weights,
        conditions: &Conditions,
    ) -> Self {
        let mut n_entries_left = MAX_TABLE_ENTRIES;
        let weighted = schema.attributes().iter().zip(weights.as_slice()).enumerate();
        let mut observed = DistinctValues::default();
        let mut attributes = Vec::with_capacity(schema.len());
        for (position, (attribute, weight)) in weighted.filter(|(_, (_, weight))| **weight > 0.0) {
            let domain = states.domain(position);
            let rows = observed.number(demonstration, conditions, position);
            let values = &observed.values;
            if values.is_empty() {
                continue;
            }
            let n_entries = (1 + values.len()).saturating_mul(domain.len());
            let (mut table, mut untabled) = (Vec::new(), Vec::new());
            if n_entries <= n_entries_left {
                n_entries_left -= n_entries;
                table.reserve_exact(n_entries);
                table.resize(domain.len(), 0.0);
                table.extend(values.iter().flat_map(|(value, observation_weight)| {
                    domain.iter().map(|own| weighted_term(*observation_weight, attribute.term(*weight, value, own)))
                }));
            } else {
                untabled
                    .extend(values.iter().map(|(value, observation_weight)| ((*value).clone(), *observation_weight)));
            }
            let n_seen = rows.iter().filter(|row| **row > 0).count();
            let (n_values, free) = (domain.len(), Vec::new());
            attributes.push(AttributeTerms {
                position,
                weight: *weight,
                rows,
                n_seen,
                n_values,
                table,
                free,
                untabled,
            });
        }
        Self { attributes }
    }

    /// Of no observations yet, and with tables whatever they take.
    pub(crate) fn none(states: &States, weights: &Weights) -> Self {
        let weighted = weights.as_slice().iter().enumerate().filter(|(_, weight)| **weight > 0.0);
        let attributes = weighted.map(|(position, weight)| {
            let n_values = states.domain(position).len();
            let (rows, free, untabled) = Default::default();
            let table = vec![0.0; n_values];
            AttributeTerms { position, weight: *weight, rows, n_seen: 0, n_values, table, free, untabled }
        });
        Self { attributes: attributes.collect() }
    }

    /// How many terms an observation has in tables.
    pub(crate) fn n_each(states: &States, weights: &Weights) -> usize {
        let weighted = weights.as_slice().iter().enumerate().filter(|(_, weight)| **weight > 0.0);
        weighted.map(|(position, _)| states.domain(position).len()).sum()
    }

    /// Takes another observation.
    pub(crate) fn push(&mut self, model: &Model, observation: &[Option<Value>], observation_weight: f64) {
        for own in &mut self.attributes {
            let AttributeTerms { position, weight, rows, n_seen, n_values, table, free, .. } = own;
            let Some(seen) = observation[*position].as_ref().filter(|_| observation_weight > 0.0) else {
                rows.push(0);
                continue;
            };
            let row = free.pop().map_or(table.len() / *n_values, |row| row as usize);
            table.resize(table.len().max((row + 1) * *n_values), 0.0);
            let attribute = &model.schema().attributes()[*position];
            for (term, value) in table[row * *n_values..].iter_mut().zip(model.states().domain(*position)) {
                *term = weighted_term(observation_weight, attribute.term(*weight, seen, value));
            }
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            rows.push(row as u32);
            *n_seen += 1;
        }
    }

    /// Drops the first `n_observations`.
    pub(crate) fn drop_first(&mut self, n_observations: usize) {
        for AttributeTerms { rows, n_seen, free, .. } in &mut self.attributes {
            let n_free = free.len();
            free.extend(rows.drain(..n_observations).filter(|row| *row > 0));
            *n_seen -= free.len() - n_free;
        }
    }

    /// How much memory they take, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        let of_attribute = |own: &AttributeTerms| {
            let numbers = (own.rows.capacity() + own.free.capacity()) * size_of::<u32>();
            size_of::<AttributeTerms>() + own.table.capacity() * size_of::<f64>() + numbers
        };
        self.attributes.iter().map(of_attribute).sum()
    }
}

/// The distinct values that a demonstration shows of an attribute, each with the weight of its observation.
#[derive(Default)]
struct DistinctValues<'d> {
    /// In the order in which they come.
    values: Vec<(&'d Value, f64)>,
    /// Their numbers, from 1 on, once they are more than [`FEW`](Self::FEW); of weights, the bits.
    numbers: FxHashMap<(&'d Value, u64), u32>,
}

impl<'d> DistinctValues<'d> {
    /// So many values are compared one by one in less time than hashing takes.
    const FEW: usize = 16;

    /// Forgets the values, and numbers those of the attribute at `position`. Gives the number of each observation's, or 0 if it
    /// did not see the attribute or has no weight.
    fn number(&mut self, demonstration: &'d Demonstration, conditions: &Conditions, position: usize) -> Vec<u32> {
        self.values.clear();
        self.numbers.clear();
        let seen = demonstration.iter().enumerate().map(|(i, observation)| {
            let observation_weight = conditions.observation_weight(i);
            observation[position].as_ref().filter(|_| observation_weight > 0.0).map(|value| (value, observation_weight))
        });
        seen.map(|value| value.map_or(0, |value| self.number_of(value))).collect()
    }

    #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
    fn number_of(&mut self, value: (&'d Value, f64)) -> u32 {
        let key = |(value, observation_weight): (&'d Value, f64)| (value, observation_weight.to_bits());
        let known = if self.values.len() <= Self::FEW {
            self.values.iter().position(|known| *known == value).map(|n| n as u32 + 1)
        } else {
            self.numbers.get(&key(value)).copied()
        };
        known.unwrap_or_else(|| {
            self.values.push(value);
            if self.values.len() > Self::FEW {
                let first = self.numbers.len();
                self.numbers.extend(self.values[first..].iter().copied().map(key).zip(first as u32 + 1..));
            }
            self.values.len() as u32
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::super::Distances;
    use super::*;
    use crate::mapping::by_definition::compiled;

    proptest! {
        /// Whatever comes and goes, a window's terms are those of its observations.
        #[test]
        fn terms_that_are_kept_are_those_that_are_computed_anew(
            seen in prop::collection::vec((prop::array::uniform2(prop::option::of(0u8..5)), 0u8..3, 0usize..4), 1..30),
            weights in prop::array::uniform2(prop_oneof![Just(0.0), 0.1..3.0]),
        ) {
            let states: serde_json::Value = (0..12).map(|n| json!([n % 4, n / 4])).collect();
            let model = compiled(&json!({
                "attributes": [{"name": "a", "kind": "number"}, {"name": "b", "kind": "number"}],
                "actions": [],
                "dynamics": {"kind": "table", "states": states, "transitions": []},
            }));
            let (schema, states, weights) = (model.schema(), model.states(), Weights::of(weights));
            let mut terms = Terms::none(states, &weights);
            let (mut window, mut conditions) = (Vec::new(), Conditions::default());
            for (values, observation_weight, n_dropped) in seen {
                let observation = values.map(|value| value.map(|value| Value::Number(value.into()))).to_vec();
                terms.push(&model, &observation, observation_weight.into());
                window.push(observation);
                conditions.observation_weights.push(observation_weight.into());
                let n_dropped = n_dropped.min(window.len() - 1);
                terms.drop_first(n_dropped);
                window.drain(..n_dropped);
                conditions.observation_weights.drain(..n_dropped);
                let demonstration = Demonstration::of(window.iter().cloned()).unwrap();
                let anew = Distances::new(schema, states, &demonstration, &weights, &conditions);
                let kept = Distances::of_terms(&model, std::mem::take(&mut terms));
                for (i, state) in (0..window.len()).flat_map(|i| (0..states.len()).map(move |state| (i, state))) {
                    let told = |distances: &Distances<'_>| distances.terms(i, states.row(state)).collect::<Vec<_>>();
                    prop_assert_eq!(told(&kept), told(&anew));
                }
                terms = kept.into_terms();
            }
        }
    }

    #[test]
    fn observed_values_are_numbered_as_they_come_be_they_few_or_many() {
        let few = i64::try_from(DistinctValues::FEW).unwrap();
        let demonstrations = [3, few, few + 1, 1, 40].map(|n_distinct| {
            let values = (0..100).map(|i| (i % 9 != 8).then_some(Value::Integer(i * 7 % n_distinct)));
            Demonstration::of(values.map(|value| vec![None, value])).unwrap()
        });
        let mut observed = DistinctValues::default();
        for demonstration in &demonstrations {
            let rows = observed.number(demonstration, &Conditions::default(), 1);
            let mut known = Vec::new();
            for (observation, row) in demonstration.iter().zip(rows) {
                let Some(value) = &observation[1] else {
                    assert_eq!(row, 0);
                    continue;
                };
                if !known.contains(&(value, 1.0)) {
                    known.push((value, 1.0));
                }
                assert_eq!(known[row as usize - 1], (value, 1.0));
            }
            assert_eq!(observed.values, known);
        }
    }
}
