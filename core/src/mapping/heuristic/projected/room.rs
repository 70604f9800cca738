//! Which attributes have tables, as far as there is memory.

use super::Estimate;
use super::table::{Table, stride_for};
use crate::mapping::Problem;
use crate::mapping::heuristic::projection::{Projection, Projections};
use crate::mapping::heuristic::shares::SharedWay;

/// Most entries of all tables together: 256 MB. Attributes that do not fit, the largest, are left out, which keeps the bound a
/// bound.
pub(in crate::mapping) const MAX_ENTRIES: usize = 1 << 24;

/// How much memory tables for `problem` take at most, in bytes, of two attempts to make them within `room`, and whether these have all
/// distances.
pub(in crate::mapping) fn most_bytes(
    projections: &Projections,
    problem: &Problem<'_>,
    room: TableRoom,
) -> (usize, bool) {
    let (used, _) = used_projections(projections, problem, TableRoom { few: room.most, ..room });
    let tabled = projections.attributes.iter().zip(&used).filter(|(_, is_used)| **is_used).map(|(own, _)| own);
    let n_bytes = bytes_of(tabled.clone(), problem.demonstration.len());
    let has = |position| tabled.clone().any(|own| own.position == position);
    let mut active = (0..problem.model.schema().len()).filter(|position| problem.distances.is_active(*position));
    (n_bytes, active.all(has))
}

/// The same of tables for `n_observations` of all attributes, which is sooner told.
pub(in crate::mapping) fn most_bytes_of_all(projections: &Projections, n_observations: usize) -> usize {
    bytes_of(projections.attributes.iter(), n_observations)
}

fn bytes_of<'p>(tabled: impl Iterator<Item = &'p Projection> + Clone, n_observations: usize) -> usize {
    /// Two tables; beside each, the least terms take half as much at most.
    const N_TIMES: usize = 3;
    let n_classes: usize = tabled.clone().map(|own| own.n_values).sum();
    let n_entries = Table::<Estimate>::n_entries_for(n_classes, n_observations);
    let n_edges: usize = tabled.map(|own| own.edges.n_items()).sum();
    N_TIMES * n_entries * size_of::<Estimate>()
        + 2 * n_edges * size_of::<SharedWay>()
        + 2 * stride_for(n_observations) * (size_of::<Estimate>() + size_of::<f64>())
}

/// How large tables may be.
#[derive(Clone, Copy, Debug)]
pub(in crate::mapping) struct TableRoom {
    /// How many entries those may have that are made now,
    pub(in crate::mapping) few: usize,
    /// and those that may be made instead, if the search takes long.
    pub(in crate::mapping) most: usize,
    /// How many ways there may be between the values of an attribute.
    max_ways: usize,
    /// What the search may take in all.
    pub(in crate::mapping) max_bytes: usize,
}

impl TableRoom {
    /// Any that take a quarter of `max_bytes`, and no more while they are made. So two of them leave half.
    pub(in crate::mapping) fn within(max_bytes: usize) -> Self {
        const PART: usize = 4;
        let most = MAX_ENTRIES.min(max_bytes / PART / size_of::<Estimate>());
        Self { few: most, most, max_ways: max_bytes / PART / size_of::<SharedWay>(), max_bytes }
    }

    /// Whether all tables may be made of columns of so many values, with so many ways between these.
    pub(super) fn has_all(self, n_observations: usize, columns: impl Iterator<Item = (usize, usize)>) -> bool {
        let stride = stride_for(n_observations);
        let add = |n_entries: usize, (n_values, n_ways)| {
            let n_entries = n_entries.saturating_add(stride.saturating_mul(n_values));
            (n_ways <= self.max_ways && n_entries <= self.few).then_some(n_entries)
        };
        columns.into_iter().try_fold(0, add).is_some()
    }

    /// At first at most so many entries.
    pub(in crate::mapping) fn at_first(self, few: usize) -> Self {
        Self { few: few.min(self.most), ..self }
    }
}

/// Which projections have tables, the smallest first as far as there is room for a few; and how many entries the others would have, as
/// far as there is room for most.
pub(super) fn used_projections(projections: &Projections, problem: &Problem<'_>, room: TableRoom) -> (Vec<bool>, u64) {
    let attributes = &projections.attributes;
    // An attribute that weighs nothing would take its share of the actions' costs to no purpose.
    let is_wanted =
        |own: &Projection| own.is_kept && own.edges.n_items() <= room.max_ways && problem.depends_on(own.position);
    let mut wanted: Vec<usize> = (0..attributes.len()).filter(|number| is_wanted(&attributes[*number])).collect();
    wanted.sort_by_key(|number| attributes[*number].n_values);
    let mut used = vec![false; attributes.len()];
    let mut n_entries = 0_usize;
    let mut n_left_out = 0;
    for number in wanted {
        let of_attribute = stride_for(problem.demonstration.len()).saturating_mul(attributes[number].n_values);
        n_entries = n_entries.saturating_add(of_attribute);
        match n_entries {
            n if n <= room.few => used[number] = true,
            n if n <= room.most => n_left_out += of_attribute as u64,
            _ => break,
        }
    }
    (used, n_left_out)
}
