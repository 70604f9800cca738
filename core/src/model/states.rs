//! The states of a model, interned, and which of them the imitator may start in.

use super::room::make_room;
use crate::attribute::Value;

/// Index of a state in its model.
pub type StateIdx = u32;

/// Where the imitator may start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Start {
    /// In this state.
    State(StateIdx),
    /// In one of these states, whichever begins the cheapest mapping. Not empty.
    Candidates(Vec<StateIdx>),
    /// In any state that may be entered, whichever begins the cheapest mapping.
    Any,
}

/// The states of a model. Each attribute's distinct values are kept once, in its *domain*, and a state is a row
/// of indices into the domains, so that a distance can be looked up per (observation, value) instead of computed per
/// state. Several states may have the same values.
#[derive(Clone, Debug, PartialEq)]
pub struct States {
    /// Distinct values by attribute. Shape `[n_attributes][domain size]`.
    domains: Vec<Vec<Value>>,
    /// Indices into the domains. Shape `[n_states, n_attributes]`, row by row.
    rows: Vec<u32>,
}

impl States {
    /// States with the given `domains`, from rows of indices into them, one after the other.
    pub(super) fn new(domains: Vec<Vec<Value>>, rows: Vec<u32>) -> Self {
        debug_assert!(rows.len().is_multiple_of(domains.len()), "whole rows");
        Self { domains, rows }
    }

    /// Adds a state, by its row.
    pub(crate) fn push(&mut self, row: impl Iterator<Item = u32>) {
        self.rows.extend(row);
        debug_assert!(self.rows.len().is_multiple_of(self.domains.len()), "a whole row");
    }

    /// The states `kept`, numbered in this order.
    pub(crate) fn keep(&self, kept: &[StateIdx]) -> Self {
        let rows = kept.iter().flat_map(|state| self.row(*state)).copied().collect();
        Self::new(self.domains.clone(), rows)
    }

    /// Makes room for `growth` times as many, once there is hardly any left.
    pub(super) fn make_room(&mut self, growth: f64) {
        make_room(&mut self.rows, growth);
    }

    /// How many states there are.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
    pub fn len(&self) -> StateIdx {
        (self.rows.len() / self.domains.len()) as StateIdx
    }

    /// Whether there are none. Never the case in a model.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Distinct values of the attribute at `attribute`. States may use all or fewer of them.
    #[must_use]
    pub fn domain(&self, attribute: usize) -> &[Value] {
        &self.domains[attribute]
    }

    /// The row of `state`: per attribute, the index of its value in the domain. Shape `[n_attributes]`.
    #[inline]
    #[must_use]
    pub fn row(&self, state: StateIdx) -> &[u32] {
        let n_attributes = self.domains.len();
        let from = state as usize * n_attributes;
        &self.rows[from..from + n_attributes]
    }

    /// The values of `state`, in attribute order.
    pub fn values(&self, state: StateIdx) -> impl Iterator<Item = &Value> {
        self.domains.iter().zip(self.row(state)).map(|(domain, value)| &domain[*value as usize])
    }

    pub(super) fn size_bytes(&self) -> usize {
        let texts = |domain: &[Value]| {
            domain.iter().map(|value| if let Value::Text(text) = value { text.len() } else { 0 }).sum::<usize>()
        };
        let domains: usize = self.domains.iter().map(|domain| size_of_val(domain.as_slice()) + texts(domain)).sum();
        domains + size_of_val(self.rows.as_slice())
    }
}
