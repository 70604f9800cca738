//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

mod deepening;
mod shares;

use std::collections::BinaryHeap;

pub(in crate::mapping) use deepening::Deepened;

use super::bounded::Bounded;
use super::projection::{Group, Projections};
use super::{Grouping, Heuristic};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::Problem;
use crate::mapping::open_list::CheapestFirst;
use deepening::Deepening;
use shares::{Parts, Ways};

/// What a node `(i, s)` costs: what is paid on arriving, and what must still be paid after.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::mapping) struct Estimate {
    /// `D(o_i, s)`.
    pub(in crate::mapping) distance: f64,
    /// A lower bound of the cost from here to the end.
    pub(in crate::mapping) cost_to_go: f64,
}

/// The distances and the costs-to-go of one problem, tabulated by observation and class of each group.
///
/// Both are sums over the groups. Those of single attributes have their tables side by side in memory, and an estimate takes
/// one look into each. Groups of several attributes have tables of their own once the estimates were deepened.
#[derive(Debug)]
pub(crate) struct Projected<'p> {
    problem: &'p Problem<'p>,
    columns: Vec<Column<'p>>,
    /// Entries per observation.
    width: usize,
    /// Shape `[n_observations, width]`; in each row the groups' classes, one group after the other.
    entries: Vec<Estimate>,
    /// Positions of attributes that take part in the distance but are in no table.
    untabled: Vec<usize>,
    /// Entries of tables that were left out.
    n_left_out: u64,
    /// The least distance at each observation, of whatever state: the sum of the least terms. Shape `[n_observations]`.
    least_distances: Vec<f64>,
    /// The least term of each column. Shape `[n_observations, n_columns]`.
    least_terms: Vec<f64>,
    /// The tables of groups of several attributes. The columns of these have no costs-to-go of their own any more.
    joint: Vec<Bounded<'p>>,
    /// What deeper estimates are made of; `None` if there can be none.
    deepening: Option<Deepening<'p>>,
}

/// A group with a table.
#[derive(Debug)]
struct Column<'p> {
    group: &'p Group,
    /// The attribute's.
    position: usize,
    /// Where its values begin in a row.
    offset: usize,
}

/// Most entries of all tables together: 256 MB. Groups that do not fit, the largest, are left out, which keeps the bound a
/// bound.
pub(in crate::mapping) const MAX_ENTRIES: usize = 1 << 24;

impl<'p> Projected<'p> {
    /// Solves the projected problems, backwards over the demonstration. `None` if `interrupt` said to finish first.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(crate) fn solve(
        projections: &'p Projections,
        problem: &'p Problem<'p>,
        grouping: Grouping,
        max_entries: usize,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        /// How many classes are looked at between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let (used, n_left_out) = used_groups(projections, problem, max_entries);
        let mut projected = Self { n_left_out, ..Self::blind(problem) };
        for (group, _) in projections.groups().iter().zip(&used).filter(|(_, is_used)| **is_used) {
            let Some(position) = group.positions().next() else { continue };
            projected.columns.push(Column { group, position, offset: projected.width });
            projected.width += group.n_classes();
            projected.untabled.retain(|at| *at != position);
        }
        projected.least_terms.reserve(problem.demonstration.len() * projected.columns.len());
        projected.least_distances.reserve(problem.demonstration.len());
        projected.entries = vec![Estimate::default(); problem.demonstration.len() * projected.width];
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        for i in 0..problem.demonstration.len() {
            match meter.spend(projected.width as u64) {
                Signal::Continue => projected.write_terms(i),
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        for number in 0..projected.columns.len() {
            let parts = Parts::new(projections, problem, &used, &[projected.columns[number].position]);
            match projected.solve_column(number, &parts, &mut meter) {
                Signal::Continue => {}
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        projected.deepening = Some(Deepening::new(projections, problem, used, grouping));
        Ok(Some(projected))
    }

    /// Distances without costs-to-go: nothing is estimated.
    pub(crate) fn blind(problem: &'p Problem<'p>) -> Self {
        let untabled = (0..problem.model.schema().len()).filter(|position| problem.distances.is_active(*position));
        Self {
            problem,
            columns: Vec::new(),
            width: 0,
            entries: Vec::new(),
            untabled: untabled.collect(),
            least_distances: Vec::new(),
            least_terms: Vec::new(),
            joint: Vec::new(),
            deepening: None,
            n_left_out: 0,
        }
    }

    /// How many entries the tables would have that were left out, because only few were asked for.
    pub(in crate::mapping) fn n_left_out(&self) -> u64 {
        self.n_left_out
    }

    /// What the nodes at one observation cost.
    #[inline]
    pub(in crate::mapping) fn at(&self, observation: usize) -> EstimatesAt<'_> {
        let row = &self.entries[observation * self.width..(observation + 1) * self.width];
        EstimatesAt { projected: self, row, observation }
    }

    /// Writes the terms of an observation, and the least of them. What no action changes stays as it was at the start.
    fn write_terms(&mut self, i: usize) {
        let start = &self.problem.start_row;
        let row = &mut self.entries[i * self.width..][..self.width];
        let mut least_distance = 0.0;
        for Column { group, position, offset } in &self.columns {
            let row = &mut row[*offset..][..group.n_classes()];
            group.write_terms(self.problem, i, row);
            let least = if group.n_edges() == 0 {
                row[start[*position] as usize].distance
            } else {
                row.iter().map(|entry| entry.distance).fold(f64::INFINITY, f64::min)
            };
            self.least_terms.push(least);
            least_distance += least;
        }
        for position in &self.untabled {
            if self.problem.model.states().domain(*position).len() == 1 {
                least_distance += self.problem.distances.term(*position, i, 0);
            }
        }
        self.least_distances.push(least_distance);
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
    fn solve_column(&mut self, number: usize, parts: &Parts<'_>, meter: &mut Meter<'_>) -> Signal {
        let Column { group, offset, .. } = self.columns[number];
        let n_classes = group.n_classes();
        let predecessors = Ways::into_classes(group, parts);
        let mut open = BinaryHeap::new();
        for i in (0..self.problem.last()).rev() {
            match meter.spend(n_classes as u64) {
                Signal::Continue => {}
                signal => return signal,
            }
            let (before, after) = self.entries.split_at_mut((i + 1) * self.width);
            let here = &mut before[i * self.width + offset..][..n_classes];
            let next = &after[offset..][..n_classes];
            for (entry, next) in here.iter_mut().zip(next) {
                entry.cost_to_go = next.distance + next.cost_to_go;
            }
            for (class, next) in next.iter().enumerate() {
                let cost = next.distance + next.cost_to_go;
                for way in predecessors.of(class) {
                    let from = &mut here[way.class as usize].cost_to_go;
                    *from = from.min(way.share + cost);
                }
            }
            let least = self.least_terms[i * self.columns.len() + number];
            let least_distance = self.least_distances[i];
            for class in 0..n_classes {
                let cost = here[class].distance - least + here[class].cost_to_go;
                relax(&predecessors, class, cost, least_distance, here, &mut open);
            }
            while let Some(CheapestFirst { cost, id: class }) = open.pop() {
                match meter.spend(1) {
                    Signal::Continue => {}
                    signal => return signal,
                }
                let entry = here[class as usize];
                if cost <= entry.cost_to_go {
                    let cost = entry.distance - least + cost;
                    relax(&predecessors, class as usize, cost, least_distance, here, &mut open);
                }
            }
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
        let extra = way.share_of_extra(least_distance) + cost;
        let known = &mut here[way.class as usize].cost_to_go;
        if extra < *known {
            *known = extra;
            open.push(CheapestFirst { cost: extra, id: way.class });
        }
    }
}

/// What the nodes at one observation cost.
#[derive(Clone, Copy, Debug)]
pub(in crate::mapping) struct EstimatesAt<'p> {
    projected: &'p Projected<'p>,
    row: &'p [Estimate],
    observation: usize,
}

impl EstimatesAt<'_> {
    /// What the node of the state with this row costs.
    #[inline]
    pub(in crate::mapping) fn of(&self, values: &[u32]) -> Estimate {
        let projected = self.projected;
        let mut sum = Estimate::default();
        let mut add = |entry: Estimate| {
            sum.distance += entry.distance;
            sum.cost_to_go += entry.cost_to_go;
        };
        for Column { position, offset, .. } in &projected.columns {
            add(self.row[offset + values[*position] as usize]);
        }
        for table in &projected.joint {
            sum.cost_to_go += table.cost_to_go(self.observation, values);
        }
        for position in &projected.untabled {
            sum.distance += projected.problem.distances.term(*position, self.observation, values[*position]);
        }
        sum
    }
}

impl Heuristic for Projected<'_> {
    #[inline]
    fn cost_to_go(&self, observation: usize, row: &[u32]) -> f64 {
        self.at(observation).of(row).cost_to_go
    }
}

/// Which groups have tables, the smallest first as far as `max_entries` go; and how many entries the others would have, as far
/// as all together go.
fn used_groups(projections: &Projections, problem: &Problem<'_>, max_entries: usize) -> (Vec<bool>, u64) {
    let groups = projections.groups();
    // A group whose attributes weigh nothing would take its share of the actions' costs to no purpose.
    let mut wanted: Vec<usize> = (0..groups.len())
        .filter(|number| {
            groups[*number].is_kept() && groups[*number].positions().any(|at| problem.distances.is_active(at))
        })
        .collect();
    wanted.sort_by_key(|number| groups[*number].n_classes());
    let mut used = vec![false; groups.len()];
    let mut n_entries = 0_usize;
    let mut n_left_out = 0;
    for number in wanted {
        let of_group = problem.demonstration.len().saturating_mul(groups[number].n_classes());
        n_entries = n_entries.saturating_add(of_group);
        match n_entries {
            n if n <= max_entries => used[number] = true,
            n if n <= MAX_ENTRIES => n_left_out += of_group as u64,
            _ => break,
        }
    }
    (used, n_left_out)
}

#[cfg(test)]
mod tests;
