//! The tables of estimates, with fewer looks for each.

use rustc_hash::FxHashMap;

use crate::mapping::Problem;
use crate::mapping::heuristic::projected::{CHUNK_LEN, ChangingColumn, Estimate, Projected};
use crate::model::{Model, StateIdx};

/// The columns of the tables of estimates, joined to two *tables*, so that an estimate takes two looks, however many columns
/// there are.
#[derive(Debug, Default)]
pub(super) struct JoinedTables {
    columns: Vec<ChangingColumn>,
    /// The distinct classes that states have in the columns of a part: those of the first part, then those of the second.
    joined: Vec<Vec<u32>>,
    n_first: usize,
    /// By state, which of these it has.
    classes: Vec<[u32; 2]>,
    /// What they come to. Shape `[n_observations, n_joined]`.
    entries: Vec<Estimate>,
}

impl JoinedTables {
    /// How much memory is kept, in bytes, besides what each state takes.
    pub(super) fn kept_bytes(&self) -> usize {
        let joined = self.joined.len() * self.columns.len() * size_of::<u32>();
        joined + self.entries.capacity() * size_of::<Estimate>()
    }

    /// Sums up the entries of `projected`.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, projected: &Projected<'_>) {
        if self.classes.is_empty() || self.columns != projected.changing_columns() {
            self.join(problem.model, projected);
        }
        let (n_observations, n_joined) = (problem.demonstration.len(), self.joined.len());
        self.entries.resize(n_observations.next_multiple_of(CHUNK_LEN) * n_joined, Estimate::default());
        for first in (0..n_observations).step_by(CHUNK_LEN) {
            let of_chunk = &mut self.entries[first * n_joined..];
            for (number, classes) in self.joined.iter().enumerate() {
                let sums = if number < self.n_first {
                    projected.estimate_chunk(first, classes)
                } else {
                    projected.sum_chunk([Estimate::default(); CHUNK_LEN], first, classes)
                };
                of_chunk[number..].iter_mut().step_by(n_joined).zip(sums).for_each(|(entry, sum)| *entry = sum);
            }
        }
    }

    /// Divides the columns so that neither part has many classes.
    fn join(&mut self, model: &Model, projected: &Projected<'_>) {
        self.columns = projected.changing_columns().to_vec();
        let n_values = |column: &ChangingColumn| model.states().domain(column.position()).len();
        let n_joined = |columns: &[ChangingColumn]| columns.iter().map(n_values).fold(1, usize::saturating_mul);
        let most = |at: &usize| n_joined(&self.columns[..*at]).max(n_joined(&self.columns[*at..]));
        let n_columns = self.columns.len();
        let divide_at = (0..=n_columns).min_by_key(most).unwrap_or_default();

        self.joined.clear();
        self.classes.clear();
        self.classes.resize(model.graph().n_states(), [0; 2]);
        for (part, range) in [0..divide_at, divide_at..n_columns].into_iter().enumerate() {
            self.n_first = self.joined.len();
            let columns: Vec<(usize, u128)> = self.columns[range.clone()]
                .iter()
                .map(|column| (column.position(), n_values(column) as u128))
                .collect();
            let mut numbers: FxHashMap<u128, u32> = FxHashMap::default();
            for (state, of_state) in (0..).zip(&mut self.classes) {
                let row = model.states().row(state);
                let values = columns.iter().fold(0, |all, (position, n)| all * n + u128::from(row[*position]));
                of_state[part] = *numbers.entry(values).or_insert_with(|| {
                    self.joined.push(projected.classes(row).skip(range.start).take(range.len()).collect());
                    #[expect(clippy::cast_possible_truncation, reason = "no more than two for each state")]
                    let number = self.joined.len() as u32 - 1;
                    number
                });
            }
        }
    }

    /// The entries of an observation.
    #[inline]
    pub(super) fn at(&self, observation: usize) -> &[Estimate] {
        &self.entries[observation * self.joined.len()..][..self.joined.len()]
    }

    /// What the node of a state costs, given the entries of its observation.
    #[inline]
    pub(super) fn estimate(&self, entries: &[Estimate], state: StateIdx) -> Estimate {
        let [first, second] = self.classes[state as usize].map(|class| entries[class as usize]);
        let mut sum = first;
        sum += second;
        sum
    }
}
