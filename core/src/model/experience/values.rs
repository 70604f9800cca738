//! States, each distinct value and each distinct row of them kept once.

use std::hash::{BuildHasher, Hash, RandomState};

use hashbrown::HashTable;

use crate::attribute::Value;
use crate::model::{StateIdx, States};

/// Distinct things, numbered from 0 in the order in which they were first met. Hashed with a seed, as clients choose them.
#[derive(Clone, Debug, Default)]
struct Numbers {
    table: HashTable<u32>,
    hasher: RandomState,
}

impl Numbers {
    /// The number of `wanted`, if `at` gives it for one of the numbers.
    fn find<T: Hash + Eq + ?Sized>(&self, wanted: &T, at: impl Fn(u32) -> bool) -> Option<u32> {
        self.table.find(self.hasher.hash_one(wanted), |number| at(*number)).copied()
    }

    /// Notes that `new` has `number`; `hash_of` gives the hashes of the others.
    fn insert<T: Hash + ?Sized>(&mut self, new: &T, number: u32, hash_of: impl Fn(&RandomState, u32) -> u64) {
        let Self { table, hasher } = self;
        table.insert_unique(hasher.hash_one(new), number, |number| hash_of(hasher, *number));
    }
}

/// States without repetition, which have so many attributes.
#[derive(Clone, Debug)]
pub(super) struct DistinctStates {
    /// By attribute: distinct values.
    domains: Vec<Vec<Value>>,
    known_values: Vec<Numbers>,
    /// Indices into the domains. Shape `[n_states, n_attributes]`.
    rows: Vec<u32>,
    known_rows: Numbers,
    n_text_bytes: usize,
}

impl DistinctStates {
    pub(super) fn new(n_attributes: usize) -> Self {
        Self {
            domains: vec![Vec::new(); n_attributes],
            known_values: vec![Numbers::default(); n_attributes],
            rows: Vec::new(),
            known_rows: Numbers::default(),
            n_text_bytes: 0,
        }
    }

    #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
    pub(super) fn len(&self) -> StateIdx {
        (self.rows.len() / self.domains.len()) as StateIdx
    }

    /// The values of `state`, in attribute order.
    pub(super) fn values(&self, state: StateIdx) -> impl Iterator<Item = &Value> {
        self.domains.iter().zip(self.row(state)).map(|(domain, value)| &domain[*value as usize])
    }

    fn row(&self, state: StateIdx) -> &[u32] {
        let n_attributes = self.domains.len();
        &self.rows[state as usize * n_attributes..][..n_attributes]
    }

    /// The number of the state with these values, if it is there.
    pub(super) fn find<'v>(&self, values: impl Iterator<Item = &'v Value>) -> Option<StateIdx> {
        let wanted = self.known_values.iter().zip(&self.domains).zip(values);
        let row = wanted.map(|((known, domain), value)| known.find(value, |number| domain[number as usize] == *value));
        let row: Vec<u32> = row.collect::<Option<_>>()?;
        self.known_rows.find(row.as_slice(), |state| self.row(state) == row)
    }

    /// The number of the state with these values, which is new if it was not there.
    #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
    pub(super) fn number_of(&mut self, values: impl Iterator<Item = Value>) -> StateIdx {
        let before = self.rows.len();
        for ((known, domain), value) in self.known_values.iter_mut().zip(&mut self.domains).zip(values) {
            let number = known.find(&value, |number| domain[number as usize] == value).unwrap_or_else(|| {
                let number = domain.len() as u32;
                known.insert(&value, number, |hasher, number| hasher.hash_one(&domain[number as usize]));
                if let Value::Text(text) = &value {
                    self.n_text_bytes += text.len();
                }
                domain.push(value);
                number
            });
            self.rows.push(number);
        }
        let (rows, n_attributes) = (&self.rows, self.domains.len());
        let row = |state: u32| &rows[state as usize * n_attributes..][..n_attributes];
        let state = (before / n_attributes) as StateIdx;
        if let Some(known) = self.known_rows.find(row(state), |other| row(other) == row(state)) {
            self.rows.truncate(before);
            return known;
        }
        self.known_rows.insert(row(state), state, |hasher, state| hasher.hash_one(row(state)));
        state
    }

    /// By attribute, the distinct values; and of each state, which of these it has: shape `[n_states, n_attributes]`.
    pub(super) fn parts(&self) -> (&[Vec<Value>], &[u32]) {
        (&self.domains, &self.rows)
    }

    /// The states with these parts, of so many attributes; `None` if there are none such.
    pub(super) fn of_parts(domains: &[Vec<Value>], rows: &[u32], n_attributes: usize) -> Option<Self> {
        if domains.len() != n_attributes || !rows.len().is_multiple_of(n_attributes.max(1)) {
            return None;
        }
        let mut states = Self::new(n_attributes);
        for row in rows.chunks_exact(n_attributes.max(1)) {
            let n_before = states.len();
            let values: Option<Vec<&Value>> =
                domains.iter().zip(row).map(|(domain, value)| domain.get(*value as usize)).collect();
            states.number_of(values?.into_iter().cloned());
            if states.len() == n_before {
                return None;
            }
        }
        Some(states)
    }

    /// The states, as a model has them.
    pub(super) fn into_states(self) -> States {
        States::new(self.domains, self.rows)
    }

    /// About how much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        /// What a value takes, and its number.
        const VALUE_BYTES: usize = 2 * (size_of::<Value>() + 2 * size_of::<u32>());
        let n_values: usize = self.domains.iter().map(Vec::len).sum();
        // Lists that grow have room to spare.
        2 * size_of_val(self.rows.as_slice())
            + self.len() as usize * 4 * size_of::<u32>()
            + n_values * VALUE_BYTES
            + self.n_text_bytes
    }
}
