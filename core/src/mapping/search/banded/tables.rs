//! The tables of estimates, with fewer looks for each.

use rustc_hash::FxHashMap;

use crate::mapping::Problem;
use crate::mapping::heuristic::projected::{CHUNK_LEN, ChangingColumn, Estimate, Projected};

/// The columns of the tables of estimates, joined to two *parts*, so that an estimate takes two looks, however many columns there are: for
/// the classes that the states have that a search comes to.
#[derive(Debug, Default)]
pub(super) struct JoinedTables {
    /// By part, where the entries begin of the classes in its columns.
    rows: [FxHashMap<u128, u32>; 2],
    /// Of each row, by observation.
    entries: Vec<Estimate>,
    n_observations: usize,
    /// How many columns the first part has.
    divide_at: usize,
}

/// Most columns, so that the classes in a part's are a number.
pub(super) const MAX_COLUMNS: usize = 8;

impl JoinedTables {
    /// Forgets the rows, for a search of `problem` with these estimates.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, projected: &Projected<'_>) {
        self.rows.iter_mut().for_each(FxHashMap::clear);
        self.entries.clear();
        self.n_observations = problem.demonstration.len();
        let n_values = |column: &ChangingColumn| problem.model.states().domain(column.position()).len();
        let n_joined = |columns: &[ChangingColumn]| columns.iter().map(n_values).fold(1, usize::saturating_mul);
        let columns = projected.changing_columns();
        let most = |at: &usize| n_joined(&columns[..*at]).max(n_joined(&columns[*at..]));
        let divisions = columns.len().saturating_sub(MAX_COLUMNS / 2)..=columns.len().min(MAX_COLUMNS / 2);
        self.divide_at = divisions.min_by_key(most).unwrap_or_default();
    }

    /// How much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(self.entries.as_slice())
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        let rows: usize = self.rows.iter().map(|rows| rows.capacity() * size_of::<(u128, u32)>()).sum();
        self.entries.capacity() * size_of::<Estimate>() + rows
    }

    /// Where the entries of a state of these classes begin.
    pub(super) fn rows_of(&mut self, classes: &[u32], projected: &Projected<'_>) -> [u32; 2] {
        let (first, second) = classes.split_at(self.divide_at);
        [self.row_of(0, first, projected), self.row_of(1, second, projected)]
    }

    fn row_of(&mut self, part: usize, classes: &[u32], projected: &Projected<'_>) -> u32 {
        let key = classes.iter().fold(0, |key, class| key << u32::BITS | u128::from(*class));
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep them far below 2^32")]
        let next = self.entries.len() as u32;
        let row = *self.rows[part].entry(key).or_insert(next);
        if row == next {
            for first in (0..self.n_observations).step_by(CHUNK_LEN) {
                self.entries.extend(if part == 0 {
                    projected.estimate_chunk(first, classes)
                } else {
                    projected.sum_chunk([Estimate::default(); CHUNK_LEN], first, classes)
                });
            }
        }
        row
    }

    /// At a node of a state whose entries begin there.
    #[inline]
    pub(super) fn estimate(&self, rows: [u32; 2], observation: usize) -> Estimate {
        let [first, second] = rows;
        let mut sum = self.entries[first as usize + observation];
        sum += self.entries[second as usize + observation];
        sum
    }
}
