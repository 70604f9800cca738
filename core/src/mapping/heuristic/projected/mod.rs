//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

mod extras;
mod layers;
mod room;
mod solving;
mod table;

use std::ops::AddAssign;

pub(in crate::mapping) use layers::LayerTables;
#[cfg(test)]
pub(in crate::mapping) use room::MAX_ENTRIES;
pub(in crate::mapping) use room::{TableRoom, most_bytes, most_bytes_of_all};
pub(in crate::mapping) use solving::TableBuffers;
pub(in crate::mapping) use table::CHUNK_LEN;
pub(super) use table::Table;
use table::stride_for;

use super::Heuristic;
use super::projection::{Projection, ValueIdx};
use crate::mapping::Problem;

/// What a node `(i, s)` costs: what is paid on arriving, and what must still be paid after.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::mapping) struct Estimate {
    /// `D(o_i, s)`.
    pub(in crate::mapping) distance: f64,
    /// A lower bound of the cost from here to the end.
    pub(in crate::mapping) cost_to_go: f64,
}

impl AddAssign for Estimate {
    #[inline]
    fn add_assign(&mut self, other: Self) {
        self.distance += other.distance;
        self.cost_to_go += other.cost_to_go;
    }
}

/// The distances and the costs-to-go of one problem, tabulated by observation and value of each attribute.
///
/// Both are sums over the attributes, whose tables lie side by side in memory: an estimate takes one look into each. A value's number in
/// all tables together is its *class*.
#[derive(Debug)]
pub(crate) struct Projected<'p> {
    problem: &'p Problem<'p>,
    pub(super) columns: Vec<Column<'p>>,
    /// By class, one attribute after the other.
    pub(super) table: Table<Estimate>,
    /// Sums, per observation, of the columns that no action changes. Shape `[n_observations]`, padded to whole chunks.
    unchanged: Vec<Estimate>,
    /// The columns that actions change, in order.
    changing: Vec<ChangingColumn>,
    /// Positions of attributes that take part in the distance but are in no table.
    untabled: Vec<usize>,
    /// Entries of tables that were left out.
    n_left_out: u64,
    /// The least distance at each observation, of whatever state: the sum of the least terms. Shape `[n_observations]`.
    pub(super) least_distances: Vec<f64>,
    /// The least term of each column. Shape `[n_observations, n_columns]`.
    pub(super) least_terms: Vec<f64>,
}

/// An attribute with a table.
#[derive(Clone, Copy, Debug)]
pub(super) struct Column<'p> {
    pub(super) projection: &'p Projection,
    /// Where its values begin in the table.
    pub(super) offset: usize,
    /// The value that all states have that a search may come to, if no action of the body changes it.
    fixed: Option<ValueIdx>,
}

/// A column of an attribute that actions change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::mapping) struct ChangingColumn {
    /// The attribute's.
    position: u32,
    /// Where its values begin in the table.
    offset: u32,
}

impl ChangingColumn {
    fn new(position: usize, offset: usize) -> Self {
        #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
        Self { position: position as u32, offset: offset as u32 }
    }

    /// The attribute's position.
    #[inline]
    pub(in crate::mapping) fn position(self) -> usize {
        self.position as usize
    }

    /// Where its values begin in the table.
    #[inline]
    pub(in crate::mapping) fn offset(self) -> usize {
        self.offset as usize
    }
}

impl<'p> Projected<'p> {
    /// Distances without costs-to-go: nothing is estimated.
    pub(crate) fn blind(problem: &'p Problem<'p>) -> Self {
        let untabled = (0..problem.model.schema().len()).filter(|position| problem.distances.is_active(*position));
        Self {
            problem,
            columns: Vec::new(),
            table: Table::default(),
            unchanged: vec![Estimate::default(); stride_for(problem.demonstration.len())],
            changing: Vec::new(),
            untabled: untabled.collect(),
            least_distances: Vec::new(),
            least_terms: Vec::new(),
            n_left_out: 0,
        }
    }

    /// How much memory the tables take, in bytes.
    pub(in crate::mapping) fn size_bytes(&self) -> usize {
        self.table.size_bytes()
            + size_of_val(self.unchanged.as_slice())
            + size_of_val(self.least_distances.as_slice())
            + size_of_val(self.least_terms.as_slice())
    }

    /// Entries of the tables that were left out because the room asked for was small.
    pub(in crate::mapping) fn n_left_out(&self) -> u64 {
        self.n_left_out
    }

    /// The columns that tell states apart, in order.
    pub(in crate::mapping) fn changing_columns(&self) -> &[ChangingColumn] {
        &self.changing
    }

    /// Whether estimates hold for a state with this row: attributes that no action changes must have their value at the start.
    pub(in crate::mapping) fn speaks_of(&self, values: &[u32]) -> bool {
        self.columns.iter().all(|own| own.fixed.is_none_or(|fixed| values[own.projection.position] == fixed))
    }

    /// The classes of the state with this row: one for each of the [changing columns](Self::changing_columns), in order.
    #[inline]
    pub(in crate::mapping) fn classes(&self, values: &[u32]) -> impl Iterator<Item = u32> {
        self.changing.iter().map(|column| column.offset + values[column.position as usize])
    }

    /// Whether the tables give whole estimates, so that none depends on an attribute without a table.
    #[inline]
    pub(in crate::mapping) fn are_all_in_columns(&self) -> bool {
        self.untabled.is_empty()
    }

    /// The estimate for a state that is reachable from the start, by its [classes](Self::classes). `values` gives its row, and is called only
    /// if some attribute has no table.
    #[inline]
    pub(in crate::mapping) fn estimate<'v>(
        &self,
        observation: usize,
        classes: &[u32],
        values: impl FnOnce() -> &'v [u32],
    ) -> Estimate {
        let mut sum = self.unchanged[observation];
        for class in classes {
            sum += self.table.at(*class as usize, observation);
        }
        if !self.are_all_in_columns() {
            sum += self.others(observation, values());
        }
        sum
    }

    /// The estimates for [`CHUNK_LEN`] observations from `first` on, if they are [all in columns](Self::are_all_in_columns); zero past the
    /// last observation.
    #[inline]
    pub(in crate::mapping) fn estimate_chunk(&self, first: usize, classes: &[u32]) -> [Estimate; CHUNK_LEN] {
        self.sum_chunk(self.unchanged[first..].first_chunk().copied().unwrap_or_default(), first, classes)
    }

    /// Appends the estimates for all observations, and some that mean nothing, of the part with these classes; with what is the same in all
    /// states if it `is_first`.
    pub(in crate::mapping) fn append_part(&self, is_first: bool, classes: &[u32], parts: &mut Vec<Estimate>) {
        let begin = parts.len();
        if is_first {
            parts.extend_from_slice(&self.unchanged);
        } else {
            parts.resize(begin + self.unchanged.len(), Estimate::default());
        }
        for class in classes {
            let entries = self.table.of(*class as usize);
            parts[begin..].iter_mut().zip(entries).for_each(|(sum, entry)| *sum += *entry);
        }
    }

    /// `sums` with the entries of these classes added, for [`CHUNK_LEN`] observations from `first` on.
    #[inline]
    pub(in crate::mapping) fn sum_chunk(
        &self,
        mut sums: [Estimate; CHUNK_LEN],
        first: usize,
        classes: &[u32],
    ) -> [Estimate; CHUNK_LEN] {
        for class in classes {
            let Some(entries) = self.table.chunk(*class as usize, first) else { continue };
            sums.iter_mut().zip(entries).for_each(|(sum, entry)| *sum += *entry);
        }
        sums
    }

    /// The terms of attributes without a table.
    #[inline(never)]
    fn others(&self, observation: usize, values: &[u32]) -> Estimate {
        let mut sum = Estimate::default();
        for position in &self.untabled {
            sum.distance += self.problem.distances.term(*position, observation, values[*position]);
        }
        sum
    }
}

impl Heuristic for Projected<'_> {
    #[inline]
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        self.columns.iter().fold(0.0, |sum, Column { projection, offset, .. }| {
            sum + self.table.at(offset + row[projection.position] as usize, observation).cost_to_go
        })
    }
}

#[cfg(test)]
mod tests;
