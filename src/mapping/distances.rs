//! The distance between observations and states, looked up rather than computed.

use rustc_hash::FxHashMap;

use super::Demonstration;
use crate::attribute::{Attribute, Schema, Value, Weights};
use crate::model::{StateIdx, States};

/// Weighted terms of the distance for one demonstration. Attributes without weight, and those that were never observed,
/// take no part.
///
/// What an attribute adds depends only on the observed and the state's value, of which there are few: its terms are
/// computed once per pair of distinct values.
#[derive(Debug)]
pub(crate) struct Distances<'m> {
    /// In schema order, in which distances are summed.
    active: Vec<ActiveAttribute<'m>>,
}

/// An attribute that takes part in the distance.
#[derive(Debug)]
struct ActiveAttribute<'m> {
    position: usize,
    attribute: &'m Attribute,
    weight: f64,
    /// By observation: which of `observed` it saw, plus 1; 0 if it did not see the attribute. Shape `[n_observations]`.
    rows: Vec<u32>,
    /// Distinct observed values.
    observed: Vec<Value>,
    domain: &'m [Value],
    /// Shape `[1 + observed.len(), domain.len()]`, the first row zero; empty if that would be too large.
    table: Vec<f64>,
}

/// Most entries of all tables together: 2 MB, which take a millisecond to fill. Values of larger domains are compared one by one.
const MAX_TABLE_ENTRIES: usize = 1 << 18;

impl<'m> Distances<'m> {
    pub(crate) fn new(
        schema: &'m Schema,
        states: &'m States,
        demonstration: &Demonstration,
        weights: &Weights,
    ) -> Self {
        let mut n_entries_left = MAX_TABLE_ENTRIES;
        let weighted = schema.attributes().iter().zip(weights.as_slice()).enumerate();
        let active = weighted.filter(|(_, (_, weight))| **weight > 0.0).map(|(position, (attribute, weight))| {
            let domain = states.domain(position);
            let (rows, observed) = number_observed(demonstration, position);
            let n_entries = (1 + observed.len()).saturating_mul(domain.len());
            let mut active =
                ActiveAttribute { position, attribute, weight: *weight, rows, observed, domain, table: Vec::new() };
            if n_entries <= n_entries_left {
                n_entries_left -= n_entries;
                active.fill_table();
            }
            active
        });
        Self { active: active.filter(|active| !active.observed.is_empty()).collect() }
    }

    /// `D(o_i, s)`, given the row of `s`. Finite, at least 0.
    #[inline]
    pub(crate) fn distance(&self, observation: usize, row: &[u32]) -> f64 {
        // Not `sum`, of which nothing is -0.
        self.active.iter().fold(0.0, |sum, active| sum + active.term(observation, row[active.position]))
    }

    /// The terms of `D(o_i, s)`, given the row of `s`, in schema order; attributes that take no part are left out.
    pub(crate) fn terms(&self, observation: usize, row: &[u32]) -> impl Iterator<Item = (usize, f64)> {
        self.active.iter().map(move |active| (active.position, active.term(observation, row[active.position])))
    }

    /// What the attribute at `position` adds to the distance for the value at `value` of its domain; 0 if it takes
    /// no part.
    pub(crate) fn term(&self, position: usize, observation: usize, value: u32) -> f64 {
        let active = self.active.iter().find(|active| active.position == position);
        active.map_or(0.0, |active| active.term(observation, value))
    }

    /// Whether the attribute at `position` takes part.
    pub(crate) fn is_active(&self, position: usize) -> bool {
        self.active.iter().any(|active| active.position == position)
    }
}

impl ActiveAttribute<'_> {
    #[inline]
    fn term(&self, observation: usize, value: u32) -> f64 {
        let (row, value) = (self.rows[observation] as usize, value as usize);
        match self.table.get(row * self.domain.len() + value) {
            Some(term) => *term,
            None if row == 0 => 0.0,
            None => self.attribute.term(self.weight, &self.observed[row - 1], &self.domain[value]),
        }
    }

    fn fill_table(&mut self) {
        self.table.reserve_exact((1 + self.observed.len()) * self.domain.len());
        self.table.extend(std::iter::repeat_n(0.0, self.domain.len()));
        for observed in &self.observed {
            let terms = self.domain.iter().map(|own| self.attribute.term(self.weight, observed, own));
            self.table.extend(terms);
        }
    }
}

/// Weighted terms of the distance of a single observation.
#[derive(Debug)]
pub(crate) struct ObservedDistances {
    /// Positions of the attributes that were observed and weigh something, ascending, with their terms by the state's
    /// value. Shape `[domain size]` each.
    terms: Vec<(usize, Vec<f64>)>,
}

impl ObservedDistances {
    pub(crate) fn new(schema: &Schema, states: &States, observation: &[Option<Value>], weights: &Weights) -> Self {
        let weighted = schema.attributes().iter().zip(weights.as_slice()).zip(observation).enumerate();
        let terms =
            weighted.filter(|(_, ((_, weight), _))| **weight > 0.0).filter_map(|(position, (weighted, observed))| {
                let (attribute, weight) = weighted;
                let observed = observed.as_ref()?;
                let terms = states.domain(position).iter().map(|own| attribute.term(*weight, observed, own));
                Some((position, terms.collect()))
            });
        Self { terms: terms.collect() }
    }

    /// `D(o, s)`: the same float as [`Distances::distance`] gives.
    #[inline]
    pub(crate) fn distance(&self, states: &States, state: StateIdx) -> f64 {
        let row = states.row(state);
        self.terms.iter().fold(0.0, |sum, (position, terms)| sum + terms[row[*position] as usize])
    }

    /// The terms of `D(o, s)`, in schema order; attributes that take no part are left out.
    pub(crate) fn terms(&self, states: &States, state: StateIdx) -> impl Iterator<Item = (usize, f64)> {
        let row = states.row(state);
        self.terms.iter().map(move |(position, terms)| (*position, terms[row[*position] as usize]))
    }
}

/// Numbers the distinct values that a demonstration shows of the attribute at `position`: per observation its
/// number plus 1, or 0 if it was not seen; and the values.
fn number_observed(demonstration: &Demonstration, position: usize) -> (Vec<u32>, Vec<Value>) {
    let mut numbers: FxHashMap<&Value, u32> = FxHashMap::default();
    let mut observed = Vec::new();
    let rows = (0..demonstration.len()).map(|i| {
        let Some(value) = &demonstration.observation(i)[position] else { return 0 };
        *numbers.entry(value).or_insert_with(|| {
            observed.push(value.clone());
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            let number = observed.len() as u32;
            number
        })
    });
    (rows.collect(), observed)
}
