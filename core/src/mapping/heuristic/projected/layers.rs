//! The tables of small problems, observation by observation, in memory that is kept.

use std::collections::BinaryHeap;
use std::ops::Range;

use super::extras::{Extras, settle};
use super::room::TableRoom;
use super::{ChangingColumn, Estimate};
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::conditions::Body;
use crate::mapping::distances::ActiveAttribute;
use crate::mapping::heuristic::Heuristic;
use crate::mapping::heuristic::projection::{Projection, Projections, ValueIdx};
use crate::mapping::heuristic::shares::{SharedWay, SharedWays};
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{MoveKind, Problem};

/// What [`Projected`](super::Projected) has, to the bit, of a problem in which ending is free and every attribute that takes part in the
/// distance has a table. What an observation costs in all classes lies side by side, so that it is solved in one go; and what is
/// the same for problems of the same body in which the same attributes take part is kept, and all memory with it.
#[derive(Debug, Default)]
pub(in crate::mapping) struct LayerTables {
    /// Of all attributes that take part, in order.
    columns: Vec<LayerColumn>,
    body: Body,
    n_classes: usize,
    /// Shape `[n_observations, n_classes]`.
    entries: Vec<Estimate>,
    /// The least term of each column. Shape `[n_observations, n_columns]`.
    least_terms: Vec<f64>,
    /// Sums, per observation, of the columns that no action changes. Shape `[n_observations]`.
    unchanged: Vec<Estimate>,
    /// The columns that actions change, in order.
    changing: Vec<ChangingColumn>,
    /// The ways of all columns.
    ways: Vec<ClassWay>,
    open: BinaryHeap<CheapestFirst>,
}

/// A way between classes.
#[derive(Clone, Copy, Debug)]
struct ClassWay {
    /// From a class.
    shared: SharedWay,
    to: u32,
}

#[derive(Debug)]
struct LayerColumn {
    position: usize,
    /// Where its values begin among the classes.
    offset: usize,
    n_values: usize,
    /// How many distinct ways there are to change a value.
    n_edges: usize,
    /// The ways between its values,
    shared: SharedWays,
    /// and which these are among the ways of all columns.
    ways: Range<usize>,
    /// Whether no action of the body changes it.
    is_constant: bool,
    /// The value that all states have that a search may come to, if no action of the body changes it.
    fixed: Option<ValueIdx>,
}

impl LayerTables {
    /// Solves the projected problems. Says whether they could be, by [`Projections`] of the same model as before: whether every attribute that
    /// takes part is projected, and there is room for all. Ending must be free.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(in crate::mapping) fn solve(
        &mut self,
        projections: &Projections,
        problem: &Problem<'_>,
        room: TableRoom,
        meter: &mut Meter<'_>,
    ) -> Result<bool, Interrupted> {
        let is_known = self.body == problem.body
            && self.columns.iter().map(|column| column.position).eq(problem.distances.positions());
        if !is_known && !self.gather(projections, problem) {
            return Ok(false);
        }
        let n_observations = problem.demonstration.len();
        if !room.has_all(n_observations, self.columns.iter().map(|column| (column.n_values, column.n_edges))) {
            return Ok(false);
        }
        self.changing.clear();
        for column in &mut self.columns {
            let fixed = column.is_constant.then(|| problem.starts.common_value(problem.model, column.position));
            column.fixed = fixed.flatten();
            if column.fixed.is_none() {
                self.changing.push(ChangingColumn::new(column.position, column.offset));
            }
        }
        self.entries.resize(n_observations * self.n_classes, Estimate::default());
        self.unchanged.resize(n_observations, Estimate::default());
        self.least_terms.resize(n_observations * self.columns.len(), 0.0);
        self.open.clear();
        for observation in (0..n_observations).rev() {
            meter.spend_or_stop(self.n_classes as u64)?;
            self.solve_at(observation, problem, meter)?;
        }
        Ok(true)
    }

    /// Gathers the columns for `problem`. Says whether there is one for each attribute that takes part.
    fn gather(&mut self, projections: &Projections, problem: &Problem<'_>) -> bool {
        self.columns.clear();
        self.ways.clear();
        self.body.clone_from(&problem.body);
        self.n_classes = 0;
        let takes_part = |own: &Projection| own.is_kept && problem.distances.is_active(own.position);
        let used: Vec<bool> = projections.attributes.iter().map(takes_part).collect();
        let n_used = used.iter().filter(|is_used| **is_used).count();
        if n_used < problem.distances.positions().count() {
            return false;
        }
        for (own, _) in projections.attributes.iter().zip(&used).filter(|(_, is_used)| **is_used) {
            let shared = SharedWays::new(projections, own, problem, &used);
            #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
            let offset = self.n_classes as u32;
            let first_way = self.ways.len();
            for (value, to) in (0..own.n_values).zip(offset..) {
                let into = shared.leading_to(value).iter();
                let of_class = |way: &SharedWay| SharedWay { from: offset + way.from, ..*way };
                self.ways.extend(into.map(|way| ClassWay { shared: of_class(way), to }));
            }
            self.columns.push(LayerColumn {
                position: own.position,
                offset: self.n_classes,
                n_values: own.n_values,
                n_edges: own.edges.n_items(),
                shared,
                ways: first_way..self.ways.len(),
                is_constant: own.is_constant(&problem.body),
                fixed: None,
            });
            self.n_classes += own.n_values;
        }
        true
    }

    /// Solves an observation, when the next one is solved.
    fn solve_at(
        &mut self,
        observation: usize,
        problem: &Problem<'_>,
        meter: &mut Meter<'_>,
    ) -> Result<(), Interrupted> {
        let recurrence = problem.recurrence();
        let (before, after) = self.entries.split_at_mut((observation + 1) * self.n_classes);
        let (here, after) = (&mut before[observation * self.n_classes..], &*after);
        let mut least_distance = 0.0;
        let least_terms = &mut self.least_terms[observation * self.columns.len()..][..self.columns.len()];
        for ((column, terms), least) in self.columns.iter().zip(problem.distances.active()).zip(&mut *least_terms) {
            *least = column.write_terms(terms, observation, here);
            least_distance += *least;
        }
        if observation < problem.last() {
            for (here, next) in here.iter_mut().zip(after) {
                here.cost_to_go = recurrence.go_on(MoveKind::Skip, next.distance, next.cost_to_go);
            }
            for way in &self.ways {
                let Estimate { distance, cost_to_go } = after[way.to as usize];
                let matched = way.shared.share + recurrence.go_on(MoveKind::Match, distance, cost_to_go);
                let known = &mut here[way.shared.from as usize].cost_to_go;
                if matched < *known {
                    *known = matched;
                }
            }
            let least_paid = recurrence.paid(MoveKind::Extra, least_distance);
            for (column, least) in self.columns.iter().zip(least_terms) {
                let extras = Extras { least: *least, least_paid };
                if !pass(recurrence, &self.ways[column.ways.clone()], here, extras) {
                    let here = &mut here[column.offset..][..column.n_values];
                    settle(recurrence, &column.shared, here, extras, &mut self.open, meter)?;
                }
            }
        } else {
            for entry in &mut *here {
                entry.cost_to_go = 0.0;
            }
        }
        let unchanged = self.columns.iter().filter_map(|column| Some(here[column.offset + column.fixed? as usize]));
        let add_up = |mut sum, entry| {
            sum += entry;
            sum
        };
        self.unchanged[observation] = unchanged.fold(Estimate::default(), add_up);
        Ok(())
    }

    /// The columns that tell states apart, in order.
    pub(in crate::mapping) fn changing_columns(&self) -> &[ChangingColumn] {
        &self.changing
    }

    /// The classes of the state with this row: one for each of the [changing columns](Self::changing_columns), in order.
    pub(in crate::mapping) fn classes(&self, row: &[u32]) -> impl Iterator<Item = u32> {
        self.changing.iter().map(|column| column.offset + row[column.position()])
    }

    /// What all classes cost at an observation, and what all states pay beside.
    #[inline]
    pub(in crate::mapping) fn at(&self, observation: usize) -> (&[Estimate], Estimate) {
        (&self.entries[observation * self.n_classes..][..self.n_classes], self.unchanged[observation])
    }

    /// The least term of each column at an observation.
    pub(super) fn least_terms(&self, observation: usize) -> &[f64] {
        &self.least_terms[observation * self.columns.len()..][..self.columns.len()]
    }

    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        self.columns.iter().map(|column| size_of::<LayerColumn>() + column.shared.size_bytes()).sum::<usize>()
            + (self.entries.capacity() + self.unchanged.capacity()) * size_of::<Estimate>()
            + self.least_terms.capacity() * size_of::<f64>()
            + self.ways.capacity() * size_of::<ClassWay>()
            + self.open.capacity() * size_of::<CheapestFirst>()
    }
}

/// Lets extra actions make the costs-to-go of a column at an observation cheaper, there and back over its ways. Says whether none can any more:
/// nearly always.
fn pass(recurrence: Recurrence, ways: &[ClassWay], here: &mut [Estimate], extras: Extras) -> bool {
    const N_PASSES: usize = 2;
    let Extras { least, least_paid } = extras;
    let mut take = |way: &ClassWay| {
        let Estimate { distance, cost_to_go } = here[way.to as usize];
        let extra = way.shared.of_extra(least_paid) + recurrence.go_on(MoveKind::Extra, distance - least, cost_to_go);
        let known = &mut here[way.shared.from as usize].cost_to_go;
        let is_cheaper = extra < *known;
        if is_cheaper {
            *known = extra;
        }
        is_cheaper
    };
    for _ in 0..N_PASSES {
        if !ways.iter().fold(false, |any, way| any | take(way))
            || !ways.iter().rev().fold(false, |any, way| any | take(way))
        {
            return true;
        }
    }
    false
}

impl LayerColumn {
    /// Writes what it adds to the distances at an observation, and gives the least.
    #[inline]
    fn write_terms(&self, terms: ActiveAttribute<'_>, observation: usize, classes: &mut [Estimate]) -> f64 {
        let here = &mut classes[self.offset..][..self.n_values];
        if let Some(terms) = terms.row(observation) {
            here.iter_mut().zip(terms).for_each(|(entry, term)| entry.distance = *term);
        } else {
            (0..).zip(&mut *here).for_each(|(value, entry)| entry.distance = terms.term(observation, value));
        }
        match self.fixed {
            Some(fixed) => here[fixed as usize].distance,
            None => here.iter().map(|entry| entry.distance).fold(f64::INFINITY, |a, b| if b < a { b } else { a }),
        }
    }
}

impl Heuristic for LayerTables {
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        let (entries, _) = self.at(observation);
        let of_column = |column: &LayerColumn| entries[column.offset + row[column.position] as usize].cost_to_go;
        self.columns.iter().fold(0.0, |sum, column| sum + of_column(column))
    }
}
