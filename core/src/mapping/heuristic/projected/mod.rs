//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

mod room;
mod table;

use std::collections::BinaryHeap;
use std::ops::AddAssign;

#[cfg(test)]
pub(in crate::mapping) use room::MAX_ENTRIES;
use room::used_projections;
pub(in crate::mapping) use room::{TableRoom, most_bytes};
pub(in crate::mapping) use table::CHUNK_LEN;
use table::{Table, stride_for};

use super::Heuristic;
use super::projection::{Projection, Projections};
use super::shares::SharedWays;
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::{MoveKind, Problem};

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
    columns: Vec<Column<'p>>,
    /// By class, one attribute after the other.
    table: Table<Estimate>,
    /// What the columns come to that no action changes. Shape `[n_observations]`, with room for whole chunks.
    unchanged: Vec<Estimate>,
    /// The other columns, in order.
    changing: Vec<ChangingColumn>,
    /// Positions of attributes that take part in the distance but are in no table.
    untabled: Vec<usize>,
    /// Entries of tables that were left out.
    n_left_out: u64,
    /// The least distance at each observation, of whatever state: the sum of the least terms. Shape `[n_observations]`.
    least_distances: Vec<f64>,
    /// The least term of each column. Shape `[n_observations, n_columns]`.
    least_terms: Vec<f64>,
}

/// An attribute with a table.
#[derive(Clone, Copy, Debug)]
struct Column<'p> {
    projection: &'p Projection,
    /// Where its values begin in the table.
    offset: usize,
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
    /// The attribute's position.
    #[inline]
    pub(in crate::mapping) fn position(self) -> usize {
        self.position as usize
    }
}

/// What solving takes besides its result, kept to be used again.
#[derive(Debug, Default)]
pub(in crate::mapping) struct TableBuffers {
    /// By column, the ways into each value, if they are few.
    ways: Vec<SharedWays>,
    /// The projections that have tables with these ways: nothing else that they depend on differs from problem to problem of a model.
    used: Vec<bool>,
    layer: ColumnLayer,
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

impl TableBuffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        let ColumnLayer { least, here, next, open } = &self.layer;
        self.ways.iter().map(SharedWays::size_bytes).sum::<usize>()
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
        /// How many classes are looked at between two looks at the interrupt: tens of microseconds.
        const POLL_EVERY: u64 = 1 << 11;
        let (used, n_left_out) = used_projections(projections, problem, room);
        let mut projected = Self { n_left_out, ..Self::blind(problem) };
        let (mut width, n_observations) = (0, problem.demonstration.len());
        for (projection, _) in projections.attributes.iter().zip(&used).filter(|(_, is_used)| **is_used) {
            projected.columns.push(Column { projection, offset: width });
            width += projection.n_values;
            projected.untabled.retain(|at| *at != projection.position);
        }
        projected.table = Table::filled_with(Estimate::default(), width, n_observations);
        projected.least_terms = vec![0.0; n_observations * projected.columns.len()];
        projected.least_distances = vec![0.0; n_observations];
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        for number in 0..projected.columns.len() {
            match projected.write_terms(number, &mut buffers.layer.least, &mut meter) {
                Signal::Continue => {}
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        projected.add_constants();
        let ways_of = |column: &Column<'_>| SharedWays::new(projections, column.projection, problem, &used);
        let n_edges: usize = projected.columns.iter().map(|column| column.projection.edges.n_items()).sum();
        let are_kept = n_edges <= MAX_KEPT_EDGES;
        if are_kept && buffers.used != used {
            buffers.ways = projected.columns.iter().map(ways_of).collect();
            buffers.used.clone_from(&used);
        }
        for number in 0..projected.columns.len() {
            let made = (!are_kept).then(|| ways_of(&projected.columns[number]));
            let ways = made.as_ref().unwrap_or_else(|| &buffers.ways[number]);
            match projected.solve_column(number, ways, &mut buffers.layer, &mut meter) {
                Signal::Continue => {}
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        projected.tell_unchanged();
        Ok(Some(projected))
    }

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

    /// How many entries the tables would have that were left out, because only few were asked for.
    pub(in crate::mapping) fn n_left_out(&self) -> u64 {
        self.n_left_out
    }

    /// The columns that tell states apart, in order.
    pub(in crate::mapping) fn changing_columns(&self) -> &[ChangingColumn] {
        &self.changing
    }

    /// Whether something is said of states with this row: what no action changes is as it is at the start.
    pub(in crate::mapping) fn speaks_of(&self, values: &[u32]) -> bool {
        let mut constant = self.columns.iter().map(|column| column.projection).filter(|own| own.is_constant());
        constant.all(|own| values[own.position] == self.problem.start_row[own.position])
    }

    /// The classes of the state with this row, by their numbers in the table: one of each of the
    /// [changing columns](Self::changing_columns).
    #[inline]
    pub(in crate::mapping) fn classes(&self, values: &[u32]) -> impl Iterator<Item = u32> {
        self.changing.iter().map(|column| column.offset + values[column.position as usize])
    }

    /// Whether that and what is the same for all states is all that an estimate is made of.
    #[inline]
    pub(in crate::mapping) fn are_all_in_columns(&self) -> bool {
        self.untabled.is_empty()
    }

    /// What the node of a state costs that the start leads to and that is of [these classes](Self::classes). `values` gives its row.
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

    /// The same for as many observations from `first` on, if they are [all in columns](Self::are_all_in_columns). After the last
    /// observation it is nothing.
    #[inline]
    pub(in crate::mapping) fn estimate_chunk(&self, first: usize, classes: &[u32]) -> [Estimate; CHUNK_LEN] {
        self.sum_chunk(self.unchanged[first..].first_chunk().copied().unwrap_or_default(), first, classes)
    }

    /// The same, but of these classes alone, to be added to `sums`.
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

    /// What is not in the columns.
    #[inline(never)]
    fn others(&self, observation: usize, values: &[u32]) -> Estimate {
        let mut sum = Estimate::default();
        for position in &self.untabled {
            sum.distance += self.problem.distances.term(*position, observation, values[*position]);
        }
        sum
    }

    /// Writes the terms of a column, and the least of them at each observation. What no action changes stays as it was at the start.
    fn write_terms(&mut self, number: usize, least: &mut Vec<f64>, meter: &mut Meter<'_>) -> Signal {
        let (n_observations, n_columns) = (self.problem.demonstration.len(), self.columns.len());
        let Column { projection, offset } = self.columns[number];
        let position = projection.position;
        let start = self.problem.start_row[position];
        let is_unchanged = projection.is_constant();
        let Some(terms) = self.problem.distances.of(position) else { return Signal::Continue };
        least.clear();
        least.resize(n_observations, f64::INFINITY);
        for value in (0..).take(projection.n_values) {
            match meter.spend(n_observations as u64) {
                Signal::Continue => {}
                signal => return signal,
            }
            let entries = self.table.of_mut(offset + value as usize);
            for ((i, least), entry) in least.iter_mut().enumerate().zip(entries) {
                entry.distance = terms.term(i, value);
                if !is_unchanged || value == start {
                    *least = least.min(entry.distance);
                }
            }
        }
        for (i, least) in least.iter().enumerate() {
            self.least_terms[i * n_columns + number] = *least;
            self.least_distances[i] += least;
        }
        Signal::Continue
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
        for Column { projection, offset } in &self.columns {
            let position = projection.position;
            if projection.is_constant() {
                let entries = self.table.of_mut(offset + self.problem.start_row[position] as usize);
                self.unchanged.iter_mut().zip(entries).for_each(|(sum, entry)| *sum += *entry);
            } else {
                #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                self.changing.push(ChangingColumn { offset: *offset as u32, position: position as u32 });
            }
        }
    }

    /// Fills the table of an attribute: with `N_i(v) = term(i+1, v) + H_{i+1}(v)`, what it costs to be next at class `v`,
    ///
    /// ```text
    /// H_n(v) = 0
    /// H_i(v) = min( N_i(v),                                  skip
    ///               share(v, v') + N_i(v'),                  match
    ///               share_i(v, v') + rest(i, v') + H_i(v') ) extra
    /// ```
    ///
    /// with `share_i` and `rest` as in [`super::projection`].
    ///
    /// The last line refers to the same observation, so each observation is a pass of Dijkstra's algorithm from those
    /// classes that an extra action improves.
    fn solve_column(
        &mut self,
        number: usize,
        predecessors: &SharedWays,
        layer: &mut ColumnLayer,
        meter: &mut Meter<'_>,
    ) -> Signal {
        let Column { projection, offset } = self.columns[number];
        let n_values = projection.n_values;
        let ColumnLayer { here, next, open, .. } = layer;
        next.clear();
        next.extend((0..n_values).map(|value| self.table.at(offset + value, self.problem.last())));
        here.clone_from(next);
        open.clear();
        let (mut here, mut next) = (here.as_mut_slice(), next.as_mut_slice());
        for i in (0..self.problem.last()).rev() {
            match meter.spend(n_values as u64) {
                Signal::Continue => {}
                signal => return signal,
            }
            for (value, (here, next)) in here.iter_mut().zip(&*next).enumerate() {
                here.distance = self.table.at(offset + value, i).distance;
                here.cost_to_go = MoveKind::Skip.go_on(next.distance, next.cost_to_go);
            }
            for (value, next) in next.iter().enumerate() {
                let cost = MoveKind::Match.go_on(next.distance, next.cost_to_go);
                for way in predecessors.leading_to(value) {
                    let matched = way.share + cost;
                    let known = &mut here[way.from as usize].cost_to_go;
                    if matched < *known {
                        *known = matched;
                    }
                }
            }
            let least = self.least_terms[i * self.columns.len() + number];
            let least_distance = self.least_distances[i];
            for value in 0..n_values {
                let cost = MoveKind::Extra.go_on(here[value].distance - least, here[value].cost_to_go);
                relax(predecessors, value, cost, least_distance, here, open);
            }
            while let Some(CheapestFirst { cost, id: value }) = open.pop() {
                match meter.spend(1) {
                    Signal::Continue => {}
                    signal => return signal,
                }
                let entry = here[value as usize];
                if cost <= entry.cost_to_go {
                    let cost = MoveKind::Extra.go_on(entry.distance - least, cost);
                    relax(predecessors, value as usize, cost, least_distance, here, open);
                }
            }
            for (value, entry) in here.iter().enumerate() {
                self.table.at_mut(offset + value, i).cost_to_go = entry.cost_to_go;
            }
            std::mem::swap(&mut here, &mut next);
        }
        Signal::Continue
    }
}

/// Offers every value an extra action into `value`, which costs `cost` from its arrival on, without the least distance.
#[inline]
fn relax(
    predecessors: &SharedWays,
    value: usize,
    cost: f64,
    least_distance: f64,
    here: &mut [Estimate],
    open: &mut BinaryHeap<CheapestFirst>,
) {
    for way in predecessors.leading_to(value) {
        let extra = way.of_extra(least_distance) + cost;
        let known = &mut here[way.from as usize].cost_to_go;
        if extra < *known {
            *known = extra;
            open.push(CheapestFirst { cost: extra, id: way.from });
        }
    }
}

impl Heuristic for Projected<'_> {
    #[inline]
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        self.columns.iter().fold(0.0, |sum, Column { projection, offset }| {
            sum + self.table.at(offset + row[projection.position] as usize, observation).cost_to_go
        })
    }
}

#[cfg(test)]
mod tests;
