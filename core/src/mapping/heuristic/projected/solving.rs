//! Fills the tables: backwards over the demonstration, attribute by attribute.

use std::collections::BinaryHeap;

use super::extras::{Extras, settle};
use super::layers::LayerTables;
use super::room::{TableRoom, used_projections};
use super::table::Table;
use super::{ChangingColumn, Column, Estimate, Projected};
use crate::interrupt::{Cancelled, Interrupt, Interrupted, Meter};
use crate::mapping::conditions::Body;
use crate::mapping::heuristic::projection::Projections;
use crate::mapping::heuristic::shares::SharedWays;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::{MoveKind, Problem};

/// What solving takes besides its result, kept to be used again.
#[derive(Debug, Default)]
pub(in crate::mapping) struct TableBuffers {
    /// By column, the ways into each value, if they are few.
    ways: Vec<SharedWays>,
    /// The projections that have tables with these ways.
    used: Vec<bool>,
    /// The body whose ways they are.
    body: Body,
    layer: ColumnLayer,
    /// The tables of small problems.
    layers: LayerTables,
}

/// The entries of a column in the making.
#[derive(Debug, Default)]
struct ColumnLayer {
    /// By observation, the least term.
    least: Vec<f64>,
    /// By class, at an observation and at the next.
    here: Vec<Estimate>,
    next: Vec<Estimate>,
    open: BinaryHeap<CheapestFirst>,
}

/// Most edges of all projections with tables whose ways are kept: 1.5 MB. To gather more takes little of the time that their tables take.
const MAX_KEPT_EDGES: usize = 1 << 16;

/// Most entries of tables that are solved observation by observation, and then put in order: 1 MB, as that takes twice the memory.
const MAX_SMALL_ENTRIES: usize = 1 << 16;

/// And most of them at an observation. It takes half the time that it takes to solve the columns one after the other where they are to be; a little
/// more on a grid that has 632.
const MAX_SMALL_WIDTH: usize = 1 << 8;

impl TableBuffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        let ColumnLayer { least, here, next, open } = &self.layer;
        self.layers.kept_bytes()
            + self.ways.iter().map(SharedWays::size_bytes).sum::<usize>()
            + least.capacity() * size_of::<f64>()
            + (here.capacity() + next.capacity()) * size_of::<Estimate>()
            + open.capacity() * size_of::<CheapestFirst>()
    }
}

impl<'p> Projected<'p> {
    /// Solves the projected problems, backwards over the demonstration. `None` if `interrupt` said to finish first. `buffers` are of
    /// the same model.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(crate) fn solve(
        projections: &'p Projections,
        problem: &'p Problem<'p>,
        room: TableRoom,
        buffers: &mut TableBuffers,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        Self::solve_by(projections, problem, room, buffers, MAX_SMALL_ENTRIES, interrupt)
    }

    /// The same, where tables of up to so many entries are solved observation by observation.
    pub(super) fn solve_by(
        projections: &'p Projections,
        problem: &'p Problem<'p>,
        room: TableRoom,
        buffers: &mut TableBuffers,
        max_small_entries: usize,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        /// How many classes are looked at between two looks at the interrupt: tens of microseconds.
        const POLL_EVERY: u64 = 1 << 11;
        let (used, n_left_out) = used_projections(projections, problem, room);
        let mut projected = Self { n_left_out, ..Self::blind(problem) };
        let (mut width, n_observations) = (0, problem.demonstration.len());
        for (projection, _) in projections.attributes.iter().zip(&used).filter(|(_, is_used)| **is_used) {
            let is_constant = projection.is_constant(&problem.body);
            let fixed = is_constant.then(|| problem.starts.common_value(problem.model, projection.position)).flatten();
            projected.columns.push(Column { projection, offset: width, fixed });
            width += projection.n_values;
            projected.untabled.retain(|at| *at != projection.position);
        }
        projected.table = Table::filled_with(Estimate::default(), width, n_observations);
        projected.least_terms = vec![0.0; n_observations * projected.columns.len()];
        projected.least_distances = vec![0.0; n_observations];
        let meter = &mut Meter::new(interrupt, POLL_EVERY);
        let is_small = width <= MAX_SMALL_WIDTH && width * n_observations <= max_small_entries;
        let are_layers_solved = if is_small && problem.end.is_none() && projected.are_all_in_columns() {
            buffers.layers.solve(projections, problem, room, meter)
        } else {
            Ok(false)
        };
        let filled = match are_layers_solved {
            Ok(true) => {
                projected.take(&buffers.layers);
                Ok(())
            }
            Ok(false) => projected.fill(projections, &used, buffers, meter),
            Err(interrupted) => Err(interrupted),
        };
        match filled {
            Ok(()) => Ok(Some(projected)),
            Err(Interrupted::OutOfTime) => Ok(None),
            Err(Interrupted::Cancelled(cancelled)) => Err(cancelled),
        }
    }

    /// Takes over what was solved observation by observation, of the same columns.
    fn take(&mut self, layers: &LayerTables) {
        for observation in 0..self.problem.demonstration.len() {
            let (entries, unchanged) = layers.at(observation);
            for (class, entry) in entries.iter().enumerate() {
                *self.table.at_mut(class, observation) = *entry;
            }
            self.unchanged[observation] = unchanged;
            let least = layers.least_terms(observation);
            self.least_terms[observation * least.len()..][..least.len()].copy_from_slice(least);
            self.least_distances[observation] = least.iter().fold(0.0, |sum, least| sum + least);
        }
        layers.changing_columns().clone_into(&mut self.changing);
    }

    /// Fills the tables, of the projections that are `used`.
    fn fill(
        &mut self,
        projections: &Projections,
        used: &[bool],
        buffers: &mut TableBuffers,
        meter: &mut Meter<'_>,
    ) -> Result<(), Interrupted> {
        for number in 0..self.columns.len() {
            self.write_terms(number, &mut buffers.layer.least, meter)?;
        }
        self.add_constants();
        let problem = self.problem;
        let ways_of = |column: &Column<'_>| SharedWays::new(projections, column.projection, problem, used);
        let n_edges: usize = self.columns.iter().map(|column| column.projection.edges.n_items()).sum();
        let are_kept = n_edges <= MAX_KEPT_EDGES;
        if are_kept && (buffers.used != used || buffers.body != problem.body) {
            buffers.ways = self.columns.iter().map(ways_of).collect();
            used.clone_into(&mut buffers.used);
            buffers.body.clone_from(&problem.body);
        }
        for number in 0..self.columns.len() {
            let made = (!are_kept).then(|| ways_of(&self.columns[number]));
            let ways = made.as_ref().unwrap_or_else(|| &buffers.ways[number]);
            self.solve_column(number, ways, &mut buffers.layer, meter)?;
        }
        self.tell_unchanged();
        Ok(())
    }

    /// Writes the terms of a column, and the least of them at each observation. What no action changes stays as it was at the start.
    fn write_terms(&mut self, number: usize, least: &mut Vec<f64>, meter: &mut Meter<'_>) -> Result<(), Interrupted> {
        let (n_observations, n_columns) = (self.problem.demonstration.len(), self.columns.len());
        let Column { projection, offset, fixed } = self.columns[number];
        let position = projection.position;
        let Some(terms) = self.problem.distances.of(position) else { return Ok(()) };
        least.clear();
        least.resize(n_observations, f64::INFINITY);
        for value in (0..).take(projection.n_values) {
            meter.spend_or_stop(n_observations as u64)?;
            let entries = self.table.of_mut(offset + value as usize);
            for ((i, least), entry) in least.iter_mut().enumerate().zip(entries) {
                entry.distance = terms.term(i, value);
                if fixed.is_none_or(|fixed| value == fixed) {
                    *least = least.min(entry.distance);
                }
            }
        }
        for (i, least) in least.iter().enumerate() {
            self.least_terms[i * n_columns + number] = *least;
            self.least_distances[i] += least;
        }
        Ok(())
    }

    /// Adds what attributes of a single value add to the least distances.
    fn add_constants(&mut self) {
        for position in self.untabled.iter().filter(|at| self.problem.model.states().domain(**at).len() == 1) {
            for (i, least) in self.least_distances.iter_mut().enumerate() {
                *least += self.problem.distances.term(*position, i, 0);
            }
        }
    }

    /// Sums up the columns that no action changes.
    fn tell_unchanged(&mut self) {
        self.unchanged.fill(Estimate::default());
        self.changing.clear();
        for Column { projection, offset, fixed } in &self.columns {
            let position = projection.position;
            if let Some(fixed) = fixed {
                let entries = self.table.of_mut(offset + *fixed as usize);
                self.unchanged.iter_mut().zip(entries).for_each(|(sum, entry)| *sum += *entry);
            } else {
                self.changing.push(ChangingColumn::new(position, *offset));
            }
        }
    }

    /// Fills the table of an attribute: with `N_i(v) = term(i+1, v) + H_{i+1}(v)`, what it costs to be next at class `v`,
    ///
    /// ```text
    /// H_n(v) = min( what v adds to the cost of ending,       end
    ///               share_n(v, v') + rest(n, v') + H_n(v') ) extra
    /// H_i(v) = min( N_i(v),                                  skip
    ///               share(v, v') + N_i(v'),                  match
    ///               share_i(v, v') + rest(i, v') + H_i(v') ) extra
    /// ```
    ///
    /// with `share_i` and `rest` as in [`projection`](super::super::projection).
    ///
    /// The lines of extra actions refer to the same observation, so each observation is a pass of Dijkstra's algorithm from those
    /// classes that an extra action improves.
    fn solve_column(
        &mut self,
        number: usize,
        predecessors: &SharedWays,
        layer: &mut ColumnLayer,
        meter: &mut Meter<'_>,
    ) -> Result<(), Interrupted> {
        let Column { projection, offset, .. } = self.columns[number];
        let (n_values, last, recurrence) = (projection.n_values, self.problem.last(), self.problem.recurrence());
        let end = self.problem.end.as_ref();
        let ColumnLayer { here, next, open, .. } = layer;
        next.clear();
        next.resize(n_values, Estimate::default());
        here.clone_from(next);
        open.clear();
        let (mut here, mut next) = (here.as_mut_slice(), next.as_mut_slice());
        for i in (0..=last).rev() {
            meter.spend_or_stop(n_values as u64)?;
            for (value, here) in (0..).zip(here.iter_mut()) {
                here.distance = self.table.at(offset + value as usize, i).distance;
                let next = next[value as usize];
                here.cost_to_go = if i < last {
                    recurrence.go_on(MoveKind::Skip, next.distance, next.cost_to_go)
                } else {
                    end.map_or(0.0, |end| end.term(projection.position, value))
                };
            }
            if i < last {
                for (value, next) in next.iter().enumerate() {
                    let cost = recurrence.go_on(MoveKind::Match, next.distance, next.cost_to_go);
                    for way in predecessors.leading_to(value) {
                        let matched = way.share + cost;
                        let known = &mut here[way.from as usize].cost_to_go;
                        if matched < *known {
                            *known = matched;
                        }
                    }
                }
            }
            if i < last || end.is_some() {
                let least = self.least_terms[i * self.columns.len() + number];
                let least_paid = recurrence.paid(MoveKind::Extra, self.least_distances[i]);
                settle(recurrence, predecessors, here, Extras { least, least_paid }, open, meter)?;
            }
            for (value, entry) in here.iter().enumerate() {
                self.table.at_mut(offset + value, i).cost_to_go = entry.cost_to_go;
            }
            std::mem::swap(&mut here, &mut next);
        }
        Ok(())
    }
}
