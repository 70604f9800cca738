//! The distance between observations and states, looked up rather than computed.

mod terms;

use super::{Conditions, Demonstration};
use crate::attribute::{Attribute, MAX_COST, Schema, Value, Weights};
use crate::interrupt::{Meter, Signal};
use crate::model::{Model, StateIdx, States};
use terms::AttributeTerms;
pub(in crate::mapping) use terms::Terms;

/// Weighted terms of the distance for one demonstration, `e_i D(o_i, s)`. Attributes without weight, and those that were never observed,
/// take no part.
///
/// What an attribute adds depends only on the observed value, the observation's weight and the state's value, of which there are few: its
/// terms are computed once for each of them.
#[derive(Debug)]
pub(crate) struct Distances<'m> {
    schema: &'m Schema,
    states: &'m States,
    terms: Terms,
}

/// An attribute that takes part in the distance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ActiveAttribute<'d> {
    attribute: &'d Attribute,
    domain: &'d [Value],
    terms: &'d AttributeTerms,
}

/// A `term` of a distance to an observation of this weight. Finite: at most [`MAX_COST`].
#[inline]
fn weighted_term(weight: f64, term: f64) -> f64 {
    (weight * term).min(MAX_COST)
}

impl<'m> Distances<'m> {
    pub(crate) fn new(
        schema: &'m Schema,
        states: &'m States,
        demonstration: &Demonstration,
        weights: &Weights,
        conditions: &Conditions,
    ) -> Self {
        Self { schema, states, terms: Terms::of(schema, states, demonstration, weights, conditions) }
    }

    /// Of terms that belong to `model`.
    pub(crate) fn of_terms(model: &'m Model, terms: Terms) -> Self {
        Self { schema: model.schema(), states: model.states(), terms }
    }

    /// The terms alone.
    pub(crate) fn into_terms(self) -> Terms {
        self.terms
    }

    /// `e_i D(o_i, s)`, given the row of `s`. Finite, at least 0.
    #[inline]
    pub(crate) fn distance(&self, observation: usize, row: &[u32]) -> f64 {
        // Not `sum`, of which nothing is -0.
        self.active().fold(0.0, |sum, active| sum + active.term(observation, row[active.position()]))
    }

    /// `e_i D(o_i, s)` of all states, in the order of their numbers.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(crate) fn of_states(
        &self,
        observation: usize,
        states: &States,
        distances: &mut [f64],
        meter: &mut Meter<'_>,
    ) -> Result<(), Signal> {
        const CHUNK_LEN: usize = 1 << 10;
        for (first, distances) in (0..states.len()).step_by(CHUNK_LEN).zip(distances.chunks_mut(CHUNK_LEN)) {
            meter.go_on((distances.len() * self.terms.attributes.len()) as u64)?;
            distances.fill(0.0);
            for active in self.active() {
                for (state, distance) in (first..).zip(&mut *distances) {
                    *distance += active.term(observation, states.row(state)[active.position()]);
                }
            }
        }
        Ok(())
    }

    /// The terms of `e_i D(o_i, s)`, given the row of `s`, in schema order; attributes that take no part are left out.
    pub(crate) fn terms(&self, observation: usize, row: &[u32]) -> impl Iterator<Item = (usize, f64)> {
        self.active().map(move |active| (active.position(), active.term(observation, row[active.position()])))
    }

    /// What the attribute at `position` adds to the distance for the value at `value` of its domain; 0 if it takes
    /// no part.
    pub(crate) fn term(&self, position: usize, observation: usize, value: u32) -> f64 {
        self.of(position).map_or(0.0, |active| active.term(observation, value))
    }

    /// The attributes that take part, in schema order.
    #[inline]
    pub(crate) fn active(&self) -> impl Iterator<Item = ActiveAttribute<'_>> {
        let active = self.terms.attributes.iter().filter(|terms| terms.n_seen > 0);
        active.map(|terms| ActiveAttribute {
            attribute: &self.schema.attributes()[terms.position],
            domain: self.states.domain(terms.position),
            terms,
        })
    }

    /// Their positions.
    pub(crate) fn positions(&self) -> impl Iterator<Item = usize> {
        self.active().map(ActiveAttribute::position)
    }

    /// The attribute at `position`, if it takes part.
    pub(crate) fn of(&self, position: usize) -> Option<ActiveAttribute<'_>> {
        self.active().find(|active| active.position() == position)
    }

    /// Whether the attribute at `position` takes part.
    pub(crate) fn is_active(&self, position: usize) -> bool {
        self.of(position).is_some()
    }
}

impl<'d> ActiveAttribute<'d> {
    #[inline]
    fn position(self) -> usize {
        self.terms.position
    }

    /// What it adds for each value of its domain, in order; `None` if there is no table.
    #[inline]
    pub(crate) fn row(self, observation: usize) -> Option<&'d [f64]> {
        let first = self.terms.rows[observation] as usize * self.terms.n_values;
        self.terms.table.get(first..first + self.terms.n_values)
    }

    /// What it adds for the value at `value` of its domain.
    #[inline]
    pub(crate) fn term(self, observation: usize, value: u32) -> f64 {
        let Self { attribute, domain, terms } = self;
        let (row, value) = (terms.rows[observation] as usize, value as usize);
        match terms.table.get(row * terms.n_values + value) {
            Some(term) => *term,
            None if row == 0 => 0.0,
            None => {
                let (seen, observation_weight) = &terms.untabled[row - 1];
                weighted_term(*observation_weight, attribute.term(terms.weight, seen, &domain[value]))
            }
        }
    }
}

/// What ending costs: the terms of `D(o_n, s)`, each counted with the weight of the end.
#[derive(Debug)]
pub(crate) struct EndDistances {
    /// By attribute that was observed and weighs something: its position, and its terms by the state's value. In schema order.
    attributes: Vec<(usize, Vec<f64>)>,
}

impl EndDistances {
    /// For the observation `last`. Shape `[n_attributes]`.
    pub(crate) fn new(
        schema: &Schema,
        states: &States,
        last: &[Option<Value>],
        weights: &Weights,
        end_weight: f64,
    ) -> Self {
        let weighted = schema.attributes().iter().zip(weights.as_slice()).zip(last).enumerate();
        let attributes = weighted.filter_map(|(position, ((attribute, weight), seen))| {
            let seen = seen.as_ref().filter(|_| *weight > 0.0)?;
            let term = |own| weighted_term(end_weight, attribute.term(*weight, seen, own));
            Some((position, states.domain(position).iter().map(term).collect()))
        });
        Self { attributes: attributes.collect() }
    }

    /// Whether the attribute at `position` takes part.
    pub(crate) fn has(&self, position: usize) -> bool {
        self.attributes.iter().any(|(at, _)| *at == position)
    }

    /// What ending costs in a state with this row. Finite, at least 0.
    #[inline]
    pub(crate) fn cost(&self, row: &[u32]) -> f64 {
        self.attributes.iter().fold(0.0, |sum, (position, terms)| sum + terms[row[*position] as usize])
    }

    /// What the attribute at `position` adds to that, for the value at `value` of its domain.
    pub(crate) fn term(&self, position: usize, value: u32) -> f64 {
        let terms = self.attributes.iter().find(|(at, _)| *at == position);
        terms.map_or(0.0, |(_, terms)| terms[value as usize])
    }
}

/// The terms of `D(o, s)`, by position, given the row of `s`; attributes that weigh nothing or were not observed are left out.
pub(crate) fn plain_terms<'d>(
    schema: &'d Schema,
    states: &'d States,
    observation: &'d [Option<Value>],
    weights: &'d Weights,
    row: &'d [u32],
) -> impl Iterator<Item = (usize, f64)> + 'd {
    let weighted = schema.attributes().iter().zip(weights.as_slice()).zip(observation).enumerate();
    weighted.filter_map(move |(position, ((attribute, weight), seen))| {
        let seen = seen.as_ref().filter(|_| *weight > 0.0)?;
        Some((position, attribute.term(*weight, seen, &states.domain(position)[row[position] as usize])))
    })
}

/// The distance to a single observation, looked up in tables, or computed once these were dropped.
#[derive(Debug, Default)]
pub(crate) struct ObservedDistances {
    /// Those that were observed and weigh something, in schema order.
    attributes: Vec<ObservedAttribute>,
    size_bytes: usize,
}

/// An attribute that was observed and weighs something.
#[derive(Debug)]
struct ObservedAttribute {
    position: usize,
    weight: f64,
    value: Value,
    /// The observation's weight, `e`.
    observation_weight: f64,
    /// Terms by the state's value. Shape `[domain size]`; empty if there is no table.
    table: Vec<f64>,
}

impl ObservedDistances {
    /// With tables. Nothing is observed if the observation's weight is 0.
    pub(crate) fn new(
        model: &Model,
        observation: &[Option<Value>],
        weights: &Weights,
        observation_weight: f64,
    ) -> Self {
        let weighted = weights.as_slice().iter().zip(observation).enumerate();
        let weighted = weighted.filter(|(_, (weight, _))| observation_weight > 0.0 && **weight > 0.0);
        let attributes = weighted.filter_map(|(position, (weight, value))| {
            Some(ObservedAttribute {
                position,
                weight: *weight,
                value: value.clone()?,
                observation_weight,
                table: Vec::new(),
            })
        });
        let mut distances = Self { attributes: attributes.collect(), size_bytes: 0 };
        distances.fill_tables(model);
        distances
    }

    /// Makes the tables, unless they are there.
    pub(crate) fn fill_tables(&mut self, model: &Model) {
        for attribute in self.attributes.iter_mut().filter(|attribute| attribute.table.is_empty()) {
            let ObservedAttribute { position, weight, value, observation_weight, table } = attribute;
            let domain = model.states().domain(*position);
            let attribute = &model.schema().attributes()[*position];
            *table = domain
                .iter()
                .map(|own| weighted_term(*observation_weight, attribute.term(*weight, value, own)))
                .collect();
        }
        self.measure();
    }

    /// Drops the tables. Few distances will be asked for.
    pub(crate) fn drop_tables(&mut self) {
        for attribute in &mut self.attributes {
            attribute.table = Vec::new();
        }
        self.measure();
    }

    fn measure(&mut self) {
        let sizes = self.attributes.iter().map(|attribute| {
            let n_text_bytes = if let Value::Text(text) = &attribute.value { text.len() } else { 0 };
            size_of::<ObservedAttribute>() + n_text_bytes + attribute.table.capacity() * size_of::<f64>()
        });
        self.size_bytes = sizes.sum();
    }

    /// Approximate size in memory, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        self.size_bytes
    }

    /// `e D(o, s)`: the same float as [`Distances::distance`] gives.
    #[inline]
    pub(crate) fn distance(&self, model: &Model, state: StateIdx) -> f64 {
        let row = model.states().row(state);
        self.attributes.iter().fold(0.0, |sum, attribute| sum + attribute.term(model, row[attribute.position]))
    }

    /// The terms of `e D(o, s)`, in schema order; attributes that take no part are left out.
    pub(crate) fn terms(&self, model: &Model, state: StateIdx) -> impl Iterator<Item = (usize, f64)> {
        let row = model.states().row(state);
        self.attributes
            .iter()
            .map(move |attribute| (attribute.position, attribute.term(model, row[attribute.position])))
    }
}

impl ObservedAttribute {
    #[inline]
    fn term(&self, model: &Model, value: u32) -> f64 {
        if let Some(term) = self.table.get(value as usize) {
            return *term;
        }
        let own = &model.states().domain(self.position)[value as usize];
        weighted_term(
            self.observation_weight,
            model.schema().attributes()[self.position].term(self.weight, &self.value, own),
        )
    }
}
