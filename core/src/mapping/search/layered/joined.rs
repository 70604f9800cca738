//! The tables of estimates, with fewer looks for each.

use crate::mapping::heuristic::projected::{ChangingColumn, Estimate, LayerTables};
use crate::model::{Model, StateIdx};

/// The columns of the tables of estimates, in two *parts*. What those of a part come to is added up for all combinations of their values, as far as
/// these are few, so that an estimate takes two looks in most models, however many columns there are.
#[derive(Debug, Default)]
pub(super) struct JoinedTables {
    columns: Vec<ChangingColumn>,
    parts: [Part; 2],
    n_sums: usize,
    /// By state, which sum of the first columns of each part it has.
    joined: Vec<[u32; 2]>,
    /// And which of those that are left, one part after the other. Shape `[n_states, n_left]`.
    left: Vec<u32>,
    /// Shape `[n_observations, n_sums]`.
    sums: Vec<Estimate>,
}

/// Some of the columns, one after the other.
#[derive(Debug, Default)]
struct Part {
    /// Those that are added up: where their classes begin, and how many there are.
    joined: Vec<(usize, usize)>,
    /// The same of those that are left.
    left: Vec<(usize, usize)>,
    n_sums: usize,
}

impl Part {
    /// Of columns given by where their classes begin and how many there are. So many sums are made at most, unless a single column has more.
    fn of(columns: impl Iterator<Item = (usize, usize)>, max_joined: usize) -> Self {
        let mut part = Self { n_sums: 1, ..Self::default() };
        for (first, n_classes) in columns {
            let n_joined = part.n_sums.saturating_mul(n_classes);
            if part.left.is_empty() && (n_joined <= max_joined || part.joined.is_empty()) {
                part.joined.push((first, n_classes));
                part.n_sums = n_joined;
            } else {
                part.left.push((first, n_classes));
            }
        }
        part.n_sums += part.left.iter().map(|(_, n_classes)| n_classes).sum::<usize>();
        part
    }

    /// Which of its sums a state has, given its classes.
    fn looks(&self, classes: &[u32]) -> impl Iterator<Item = usize> {
        let (joined, left) = classes.split_at(self.joined.len());
        let (mut number, mut n_joined) = (0, 1);
        for ((first, n_classes), class) in self.joined.iter().zip(joined) {
            number += (*class as usize - first) * n_joined;
            n_joined *= n_classes;
        }
        let left = self.left.iter().zip(left).scan(n_joined, |begin, ((first, n_classes), class)| {
            let look = *begin + *class as usize - first;
            *begin += n_classes;
            Some(look)
        });
        std::iter::once(number).chain(left)
    }

    /// Writes its sums: `sum` with what `entries` say of the columns that are added up, and what they say of each that is left.
    #[inline]
    fn sum_up(&self, sum: Estimate, entries: &[Estimate], sums: &mut [Estimate]) {
        sums[0] = sum;
        let mut n_joined = 1;
        for (first, n_classes) in &self.joined {
            let entries = &entries[*first..][..*n_classes];
            if n_joined == 1 {
                let sum = sums[0];
                for (joined, entry) in sums.iter_mut().zip(entries) {
                    *joined = sum;
                    *joined += *entry;
                }
            } else {
                // From the last value on, as the sums before are those of the first.
                for (value, entry) in entries.iter().enumerate().skip(1).rev() {
                    let (before, after) = sums.split_at_mut(value * n_joined);
                    for (joined, sum) in after[..n_joined].iter_mut().zip(before) {
                        *joined = *sum;
                        *joined += *entry;
                    }
                }
                for sum in &mut sums[..n_joined] {
                    *sum += entries[0];
                }
            }
            n_joined *= n_classes;
        }
        for (first, n_classes) in &self.left {
            sums[n_joined..][..*n_classes].copy_from_slice(&entries[*first..][..*n_classes]);
            n_joined += n_classes;
        }
    }
}

/// What the nodes of an observation cost.
#[derive(Clone, Copy)]
pub(super) struct LayerEstimates<'t> {
    tables: &'t JoinedTables,
    sums: &'t [Estimate],
}

impl LayerEstimates<'_> {
    /// What the node of a state costs.
    #[expect(clippy::inline_always, reason = "it is what a search does most")]
    #[inline(always)]
    pub(super) fn of(&self, state: StateIdx) -> Estimate {
        let [mut first, mut second] = self.tables.joined[state as usize].map(|look| self.sums[look as usize]);
        if !self.tables.left.is_empty() {
            self.add_left(state, &mut first, &mut second);
        }
        first += second;
        first
    }

    /// Adds what the columns of a state come to that are left of each part.
    #[cold]
    fn add_left(&self, state: StateIdx, first: &mut Estimate, second: &mut Estimate) {
        let n_left = self.tables.parts.each_ref().map(|part| part.left.len());
        let left = &self.tables.left[state as usize * (n_left[0] + n_left[1])..];
        let (of_first, left) = left.split_at(n_left[0]);
        for look in of_first {
            *first += self.sums[*look as usize];
        }
        for look in &left[..n_left[1]] {
            *second += self.sums[*look as usize];
        }
    }
}

impl JoinedTables {
    /// How much memory is kept, in bytes, besides what each state takes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.sums.capacity() * size_of::<Estimate>()
    }

    /// Sums up the entries of `tables`, for so many observations.
    pub(super) fn prepare(&mut self, model: &Model, tables: &LayerTables, n_observations: usize) {
        if self.joined.is_empty() || self.columns != tables.changing_columns() {
            self.join(model, tables);
        }
        self.sums.resize(n_observations * self.n_sums, Estimate::default());
        let [first, second] = &self.parts;
        for (observation, sums) in self.sums.chunks_exact_mut(self.n_sums).enumerate() {
            let (entries, unchanged) = tables.at(observation);
            let (firsts, seconds) = sums.split_at_mut(first.n_sums);
            first.sum_up(unchanged, entries, firsts);
            second.sum_up(Estimate::default(), entries, seconds);
        }
    }

    /// Divides the columns so that neither part has many combinations.
    fn join(&mut self, model: &Model, tables: &LayerTables) {
        /// Whatever a model has, to add up so few takes little.
        const FEW: usize = 64;
        tables.changing_columns().clone_into(&mut self.columns);
        let n_values = |column: &ChangingColumn| model.states().domain(column.position()).len();
        let n_joined = |columns: &[ChangingColumn]| columns.iter().map(n_values).fold(1, usize::saturating_mul);
        let most = |at: &usize| n_joined(&self.columns[..*at]).max(n_joined(&self.columns[*at..]));
        let divide_at = (0..=self.columns.len()).min_by_key(most).unwrap_or_default();
        let (first, second) = self.columns.split_at(divide_at);
        let max_joined = model.graph().n_states().max(FEW);
        let part = |columns: &[ChangingColumn]| {
            Part::of(columns.iter().map(|column| (column.offset(), n_values(column))), max_joined)
        };
        self.parts = [part(first), part(second)];
        let [first, second] = &self.parts;
        let n_first = first.n_sums;
        self.n_sums = n_first + second.n_sums;
        self.joined.clear();
        self.left.clear();
        for state in 0..model.states().len() {
            let classes: Vec<u32> = tables.classes(model.states().row(state)).collect();
            let (of_first, of_second) = classes.split_at(divide_at);
            #[expect(clippy::cast_possible_truncation, reason = "there are few sums")]
            let mut first = first.looks(of_first).map(|look| look as u32);
            #[expect(clippy::cast_possible_truncation, reason = "there are few sums")]
            let mut second = second.looks(of_second).map(|look| (n_first + look) as u32);
            self.joined.push([first.next().unwrap_or_default(), second.next().unwrap_or_default()]);
            self.left.extend(first.chain(second));
        }
    }

    /// The estimates at an observation.
    #[inline]
    pub(super) fn at(&self, observation: usize) -> LayerEstimates<'_> {
        LayerEstimates { tables: self, sums: &self.sums[observation * self.n_sums..][..self.n_sums] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_those_of_the_columns_one_after_the_other_be_they_joined_or_left() {
        let columns = [(1, 3), (4, 2), (6, 4), (10, 2)];
        let entry = |class: u32| Estimate { distance: 0.1 * f64::from(class), cost_to_go: 1.0 / f64::from(1 + class) };
        let entries: Vec<Estimate> = (0..12).map(entry).collect();
        let first = Estimate { distance: 0.3, cost_to_go: 0.7 };
        for (max_joined, n_sums) in [(0, 3 + 2 + 4 + 2), (6, 6 + 4 + 2), (24, 24 + 2), (48, 48)] {
            let part = Part::of(columns.into_iter(), max_joined);
            assert_eq!(part.n_sums, n_sums);
            let mut sums = vec![Estimate::default(); n_sums];
            part.sum_up(first, &entries, &mut sums);
            for number in 0..48 {
                let classes = [1 + number % 3, 4 + number / 3 % 2, 6 + number / 6 % 4, 10 + number / 24];
                let add_up = |mut sum: Estimate, of: Estimate| {
                    sum += of;
                    sum
                };
                let looked_up = part.looks(&classes).map(|look| sums[look]).reduce(add_up);
                assert_eq!(looked_up, Some(classes.iter().map(|class| entries[*class as usize]).fold(first, add_up)));
            }
        }
        assert_eq!(Part::of(std::iter::empty(), 1).n_sums, 1);
    }
}
