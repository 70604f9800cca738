//! The tables of estimates, with fewer looks for each.

use rustc_hash::FxHashMap;

use super::super::seen::{Seen, SeenIdx};
use crate::mapping::Problem;
use crate::mapping::heuristic::projected::{ChangingColumn, Estimate, Projected};

/// The columns of the tables of estimates, joined to two *parts*, so that an estimate takes two looks, however many columns there are: for
/// the classes that the states have that a search comes to.
#[derive(Debug, Default)]
pub(super) struct JoinedTables {
    /// By part, the numbers of the classes in its columns. Kept for later searches, as what was seen is.
    numbers: [FxHashMap<u128, u32>; 2],
    /// By what was seen, the numbers of its classes in both parts.
    of_seen: Vec<[u32; 2]>,
    /// By these numbers, where the entries begin; [`UNMADE`] where they are not made yet.
    rows: [Vec<u32>; 2],
    /// Of each row, by observation.
    entries: Vec<Estimate>,
    /// How many columns the first part has.
    divide_at: usize,
}

const UNMADE: u32 = u32::MAX;

/// Most columns, so that the classes in a part's are a number.
pub(super) const MAX_COLUMNS: usize = 8;

impl JoinedTables {
    /// Forgets the rows, for a search of `problem` with these estimates; and what was seen, unless it was kept.
    pub(super) fn prepare(&mut self, problem: &Problem<'_>, projected: &Projected<'_>, are_kept: bool) {
        self.entries.clear();
        self.rows.iter_mut().for_each(|rows| rows.fill(UNMADE));
        if are_kept {
            return;
        }
        self.numbers.iter_mut().for_each(FxHashMap::clear);
        self.rows.iter_mut().for_each(Vec::clear);
        self.of_seen.clear();
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
        let numbers: usize = self.numbers.iter().map(|numbers| numbers.capacity() * size_of::<(u128, u32)>()).sum();
        let rows: usize = self.rows.iter().map(|rows| rows.capacity() * size_of::<u32>()).sum();
        numbers
            + rows
            + self.of_seen.capacity() * size_of::<[u32; 2]>()
            + self.entries.capacity() * size_of::<Estimate>()
    }

    /// Where the entries of a state begin.
    pub(super) fn rows_of(&mut self, state: SeenIdx, seen: &Seen, projected: &Projected<'_>) -> [u32; 2] {
        for state in self.of_seen.len()..=state as usize {
            #[expect(clippy::cast_possible_truncation, reason = "no more than there are states")]
            let (first, second) = seen.classes(state as SeenIdx).split_at(self.divide_at);
            let numbers = [self.number_of(0, first), self.number_of(1, second)];
            self.of_seen.push(numbers);
        }
        let [first, second] = self.of_seen[state as usize];
        [self.row_of(0, first, state, seen, projected), self.row_of(1, second, state, seen, projected)]
    }

    #[inline]
    fn row_of(&mut self, part: usize, number: u32, state: SeenIdx, seen: &Seen, projected: &Projected<'_>) -> u32 {
        let row = self.rows[part][number as usize];
        if row != UNMADE {
            return row;
        }
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep them far below 2^32")]
        let row = self.entries.len() as u32;
        let (first, second) = seen.classes(state).split_at(self.divide_at);
        projected.append_part(part == 0, if part == 0 { first } else { second }, &mut self.entries);
        self.rows[part][number as usize] = row;
        row
    }

    fn number_of(&mut self, part: usize, classes: &[u32]) -> u32 {
        let key = classes.iter().fold(0, |key, class| key << u32::BITS | u128::from(*class));
        #[expect(clippy::cast_possible_truncation, reason = "no more than there are states")]
        let next = self.rows[part].len() as u32;
        let number = *self.numbers[part].entry(key).or_insert(next);
        if number == next {
            self.rows[part].push(UNMADE);
        }
        number
    }

    /// The entries, without those of as many observations as come before `observation`.
    #[inline]
    pub(super) fn entries_from(&self, observation: usize) -> &[Estimate] {
        self.entries.get(observation..).unwrap_or_default()
    }
}
