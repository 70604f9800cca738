//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

mod deepening;
mod table;

use std::collections::BinaryHeap;
use std::ops::AddAssign;

pub(in crate::mapping) use deepening::Deepened;
pub(in crate::mapping) use table::CHUNK_LEN;
pub(super) use table::Table;
use table::stride_for;

use super::joint::Joint;
use super::projection::{Group, Projections};
use super::shares::{Parts, Way, Ways};
use super::{Grouping, Heuristic};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::Problem;
use crate::mapping::open_list::CheapestFirst;
use deepening::Deepening;

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

/// The distances and the costs-to-go of one problem, tabulated by observation and class of each group.
///
/// Both are sums over the groups. Those of single attributes have their tables side by side in memory, and an estimate takes
/// one look into each. Groups of several attributes have tables of their own once the estimates were deepened.
#[derive(Debug)]
pub(crate) struct Projected<'p> {
    problem: &'p Problem<'p>,
    columns: Vec<Column<'p>>,
    /// The groups' classes, one group after the other.
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
    /// The tables of groups of several attributes. The columns of these have no costs-to-go of their own any more.
    joint: Vec<Joint>,
    /// What deeper estimates are made of; `None` if there can be none.
    deepening: Option<Deepening<'p>>,
}

/// A group with a table.
#[derive(Clone, Copy, Debug)]
struct Column<'p> {
    group: &'p Group,
    /// The attribute's.
    position: usize,
    /// Where its values begin in the table.
    offset: usize,
    /// Whether its costs-to-go are in the table of a group of several attributes.
    is_joined: bool,
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
pub(in crate::mapping) struct Buffers {
    /// By column, the ways into each class, if they are few,
    ways: Vec<Ways>,
    /// where these groups have tables: nothing else that they depend on differs from problem to problem of a model.
    used: Vec<bool>,
    layer: Layer,
}

/// The entries of a column in the making.
#[derive(Debug, Default)]
struct Layer {
    /// By observation, the least term.
    least: Vec<f64>,
    /// By class, at an observation and at the next.
    here: Vec<Estimate>,
    next: Vec<Estimate>,
    open: BinaryHeap<CheapestFirst>,
}

/// Most edges of all groups with tables whose ways are kept: 1.5 MB. To gather more takes little of the time that their tables take.
const MAX_KEPT_EDGES: usize = 1 << 16;

impl Buffers {
    /// How much memory is kept, in bytes.
    pub(in crate::mapping) fn kept_bytes(&self) -> usize {
        let Layer { least, here, next, open } = &self.layer;
        self.ways.iter().map(Ways::size_bytes).sum::<usize>()
            + least.capacity() * size_of::<f64>()
            + (here.capacity() + next.capacity()) * size_of::<Estimate>()
            + open.capacity() * size_of::<CheapestFirst>()
    }
}

/// Most entries of all tables together: 256 MB. Groups that do not fit, the largest, are left out, which keeps the bound a
/// bound.
pub(in crate::mapping) const MAX_ENTRIES: usize = 1 << 24;

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
        grouping: Grouping,
        room: TableRoom,
        buffers: &mut Buffers,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        /// How many classes are looked at between two looks at the interrupt: tens of microseconds.
        const POLL_EVERY: u64 = 1 << 11;
        let (used, n_left_out) = used_groups(projections, problem, room);
        let mut projected = Self { n_left_out, ..Self::blind(problem) };
        let (mut width, n_observations) = (0, problem.demonstration.len());
        for (group, _) in projections.groups().iter().zip(&used).filter(|(_, is_used)| **is_used) {
            let Some(position) = group.positions().next() else { continue };
            projected.columns.push(Column { group, position, offset: width, is_joined: false });
            width += group.n_classes();
            projected.untabled.retain(|at| *at != position);
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
        let ways_of = |Column { group, position, .. }: &Column<'_>| {
            Ways::into_classes(group, &Parts::new(projections, problem, &used, &[*position]))
        };
        let n_edges: usize = projected.columns.iter().map(|column| column.group.n_edges()).sum();
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
        projected.deepening = Some(Deepening::new(projections, problem, used, grouping));
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
            joint: Vec::new(),
            deepening: None,
            n_left_out: 0,
        }
    }

    /// How much memory the tables take, in bytes, but for those that deeper estimates are made of.
    pub(in crate::mapping) fn size_bytes(&self) -> usize {
        self.table.size_bytes()
            + size_of_val(self.unchanged.as_slice())
            + size_of_val(self.least_distances.as_slice())
            + size_of_val(self.least_terms.as_slice())
    }

    /// The same of those.
    pub(in crate::mapping) fn deepened_bytes(&self) -> usize {
        let forward = self.deepening.as_ref().map_or(0, Deepening::size_bytes);
        forward + self.joint.iter().map(Joint::size_bytes).sum::<usize>()
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
        let mut unchanging = self.columns.iter().filter(|column| column.group.n_edges() == 0);
        unchanging.all(|column| values[column.position] == self.problem.start_row[column.position])
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
        self.joint.is_empty() && self.untabled.is_empty()
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
        for table in &self.joint {
            sum.cost_to_go += table.cost_to_go(observation, values);
        }
        for position in &self.untabled {
            sum.distance += self.problem.distances.term(*position, observation, values[*position]);
        }
        sum
    }

    /// Writes the terms of a column, and the least of them at each observation. What no action changes stays as it was at the start.
    fn write_terms(&mut self, number: usize, least: &mut Vec<f64>, meter: &mut Meter<'_>) -> Signal {
        let (n_observations, n_columns) = (self.problem.demonstration.len(), self.columns.len());
        let Column { group, position, offset, .. } = self.columns[number];
        let start = self.problem.start_row[position];
        let is_unchanged = group.n_edges() == 0;
        let Some(terms) = self.problem.distances.of(position) else { return Signal::Continue };
        least.clear();
        least.resize(n_observations, f64::INFINITY);
        for value in (0..).take(group.n_classes()) {
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
        for Column { group, position, offset, .. } in &self.columns {
            if group.n_edges() == 0 {
                let entries = self.table.of_mut(offset + self.problem.start_row[*position] as usize);
                self.unchanged.iter_mut().zip(entries).for_each(|(sum, entry)| *sum += *entry);
            } else {
                #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                self.changing.push(ChangingColumn { offset: *offset as u32, position: *position as u32 });
            }
        }
    }

    /// Fills the table of a group: with `N_i(v) = term(i+1, v) + H_{i+1}(v)`, what it costs to be next at class `v`,
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
    fn solve_column(&mut self, number: usize, predecessors: &Ways, layer: &mut Layer, meter: &mut Meter<'_>) -> Signal {
        let Column { group, offset, .. } = self.columns[number];
        let n_classes = group.n_classes();
        let Layer { here, next, open, .. } = layer;
        next.clear();
        next.extend((0..n_classes).map(|class| self.table.at(offset + class, self.problem.last())));
        here.clone_from(next);
        open.clear();
        let (mut here, mut next) = (here.as_mut_slice(), next.as_mut_slice());
        for i in (0..self.problem.last()).rev() {
            match meter.spend(n_classes as u64) {
                Signal::Continue => {}
                signal => return signal,
            }
            for (class, (here, next)) in here.iter_mut().zip(&*next).enumerate() {
                here.distance = self.table.at(offset + class, i).distance;
                here.cost_to_go = next.distance + next.cost_to_go;
            }
            for (class, next) in next.iter().enumerate() {
                let cost = next.distance + next.cost_to_go;
                for way in predecessors.of(class) {
                    let matched = way.price.share + cost;
                    let known = &mut here[way.class as usize].cost_to_go;
                    if matched < *known {
                        *known = matched;
                    }
                }
            }
            let least = self.least_terms[i * self.columns.len() + number];
            let least_distance = self.least_distances[i];
            for class in 0..n_classes {
                let cost = here[class].distance - least + here[class].cost_to_go;
                relax(predecessors, class, cost, least_distance, here, open);
            }
            while let Some(CheapestFirst { cost, id: class }) = open.pop() {
                match meter.spend(1) {
                    Signal::Continue => {}
                    signal => return signal,
                }
                let entry = here[class as usize];
                if cost <= entry.cost_to_go {
                    let cost = entry.distance - least + cost;
                    relax(predecessors, class as usize, cost, least_distance, here, open);
                }
            }
            for (class, entry) in here.iter().enumerate() {
                self.table.at_mut(offset + class, i).cost_to_go = entry.cost_to_go;
            }
            std::mem::swap(&mut here, &mut next);
        }
        Signal::Continue
    }
}

/// Offers every class an extra action into `class`, which costs `cost` from its arrival on, without the least distance.
#[inline]
fn relax(
    predecessors: &Ways,
    class: usize,
    cost: f64,
    least_distance: f64,
    here: &mut [Estimate],
    open: &mut BinaryHeap<CheapestFirst>,
) {
    for way in predecessors.of(class) {
        let extra = way.price.of_extra(least_distance) + cost;
        let known = &mut here[way.class as usize].cost_to_go;
        if extra < *known {
            *known = extra;
            open.push(CheapestFirst { cost: extra, id: way.class });
        }
    }
}

impl Heuristic for Projected<'_> {
    #[inline]
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        let joint: f64 = self.joint.iter().map(|table| table.cost_to_go(observation, row)).sum();
        self.columns.iter().fold(joint, |sum, Column { position, offset, .. }| {
            sum + self.table.at(offset + row[*position] as usize, observation).cost_to_go
        })
    }
}

/// How much memory tables for `problem` take at most, in bytes, of two attempts to make them within `room`, and whether these have all
/// distances.
pub(in crate::mapping) fn most_bytes(
    projections: &Projections,
    problem: &Problem<'_>,
    room: TableRoom,
) -> (usize, bool) {
    /// Two tables; beside each, the least terms take half as much at most.
    const N_TIMES: usize = 3;
    let (used, _) = used_groups(projections, problem, TableRoom { few: room.most, ..room });
    let groups = projections.groups().iter().zip(&used).filter(|(_, is_used)| **is_used).map(|(group, _)| group);
    let n_observations = problem.demonstration.len();
    let n_classes: usize = groups.clone().map(Group::n_classes).sum();
    let n_entries = Table::<Estimate>::n_entries_for(n_classes, n_observations);
    let n_edges: usize = groups.clone().map(Group::n_edges).sum();
    let n_bytes = N_TIMES * n_entries * size_of::<Estimate>()
        + 2 * n_edges * size_of::<Way>()
        + 2 * stride_for(n_observations) * (size_of::<Estimate>() + size_of::<f64>());
    let has = |position| groups.clone().any(|group| group.positions().any(|at| at == position));
    let mut active = (0..problem.model.schema().len()).filter(|position| problem.distances.is_active(*position));
    (n_bytes, active.all(has))
}

/// How large tables may be.
#[derive(Clone, Copy, Debug)]
pub(in crate::mapping) struct TableRoom {
    /// How many entries those may have that are made now,
    pub(in crate::mapping) few: usize,
    /// and those that may be made instead, if the search takes long.
    pub(in crate::mapping) most: usize,
    /// How many ways there may be between the classes of a group.
    max_ways: usize,
    /// What the search may take in all.
    pub(in crate::mapping) max_bytes: usize,
}

impl TableRoom {
    /// Any that take a quarter of `max_bytes`, and no more while they are made. So two of them leave half.
    pub(in crate::mapping) fn within(max_bytes: usize) -> Self {
        const PART: usize = 4;
        let most = MAX_ENTRIES.min(max_bytes / PART / size_of::<Estimate>());
        Self { few: most, most, max_ways: max_bytes / PART / size_of::<Way>(), max_bytes }
    }

    /// At first at most so many entries.
    pub(in crate::mapping) fn at_first(self, few: usize) -> Self {
        Self { few: few.min(self.most), ..self }
    }
}

/// Which groups have tables, the smallest first as far as there is room for a few; and how many entries the others would have, as far
/// as there is room for most.
fn used_groups(projections: &Projections, problem: &Problem<'_>, room: TableRoom) -> (Vec<bool>, u64) {
    let groups = projections.groups();
    // A group whose attributes weigh nothing would take its share of the actions' costs to no purpose.
    let is_wanted = |group: &Group| {
        group.is_kept()
            && group.n_edges() <= room.max_ways
            && group.positions().any(|at| problem.distances.is_active(at))
    };
    let mut wanted: Vec<usize> = (0..groups.len()).filter(|number| is_wanted(&groups[*number])).collect();
    wanted.sort_by_key(|number| groups[*number].n_classes());
    let mut used = vec![false; groups.len()];
    let mut n_entries = 0_usize;
    let mut n_left_out = 0;
    for number in wanted {
        let of_group = stride_for(problem.demonstration.len()).saturating_mul(groups[number].n_classes());
        n_entries = n_entries.saturating_add(of_group);
        match n_entries {
            n if n <= room.few => used[number] = true,
            n if n <= room.most => n_left_out += of_group as u64,
            _ => break,
        }
    }
    (used, n_left_out)
}

#[cfg(test)]
mod tests;
