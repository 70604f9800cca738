//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

use std::collections::BinaryHeap;

use super::Heuristic;
use super::projection::{Group, ProjectedEdge, Projections};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::Problem;
use crate::mapping::open_list::CheapestFirst;

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
/// Both are sums over the groups, and a state's class in each is a few additions away from its row, so an estimate takes
/// one look into a table per group, side by side in memory.
#[derive(Debug)]
pub(crate) struct Projected<'p> {
    problem: &'p Problem<'p>,
    columns: Vec<Column<'p>>,
    /// Of the columns of a single attribute: its position, and where its values begin in a row.
    singles: Vec<(usize, usize)>,
    /// The other columns.
    groups: Vec<usize>,
    /// Entries per observation.
    width: usize,
    /// Shape `[n_observations, width]`; in each row the groups' classes, one group after the other.
    entries: Vec<Estimate>,
    /// Positions of attributes that take part in the distance but are in no table.
    untabled: Vec<usize>,
}

/// A group with a table.
#[derive(Debug)]
struct Column<'p> {
    group: &'p Group,
    /// Where its classes begin in a row.
    offset: usize,
}

/// Most entries of all tables together: 256 MB. Groups that do not fit, the largest, are left out, which keeps the bound a
/// bound.
const MAX_ENTRIES: usize = 1 << 24;

impl<'p> Projected<'p> {
    /// Solves the projected problems, backwards over the demonstration. `None` if `interrupt` said to finish first.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(crate) fn solve(
        projections: &'p Projections,
        problem: &'p Problem<'p>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        /// How many classes are looked at between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let used = used_groups(projections, problem, MAX_ENTRIES);
        let mut projected = Self::blind(problem);
        for (group, _) in projections.groups().iter().zip(&used).filter(|(_, is_used)| **is_used) {
            let column = Column { group, offset: projected.width };
            match group.single() {
                Some(position) => projected.singles.push((position, projected.width)),
                None => projected.groups.push(projected.columns.len()),
            }
            projected.columns.push(column);
            projected.width += group.n_classes();
            projected.untabled.retain(|position| !group.has(*position));
        }
        projected.entries = vec![Estimate::default(); problem.demonstration.len() * projected.width];
        let n_sharing = projections.change_sets().iter().map(|groups| {
            let n_sharing: u32 = groups.iter().map(|group| u32::from(used[usize::from(*group)])).sum();
            f64::from(n_sharing)
        });
        let n_sharing: Vec<f64> = n_sharing.collect();
        let share = |edge: &ProjectedEdge| problem.model.action(edge.action).cost / n_sharing[edge.change_set as usize];
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        for number in 0..projected.columns.len() {
            match projected.solve_column(number, share, &mut meter) {
                Signal::Continue => {}
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
        }
        Ok(Some(projected))
    }

    /// Distances without costs-to-go: nothing is estimated.
    pub(crate) fn blind(problem: &'p Problem<'p>) -> Self {
        let untabled = (0..problem.model.schema().len()).filter(|position| problem.distances.is_active(*position));
        Self {
            problem,
            columns: Vec::new(),
            singles: Vec::new(),
            groups: Vec::new(),
            width: 0,
            entries: Vec::new(),
            untabled: untabled.collect(),
        }
    }

    /// What the nodes at one observation cost.
    #[inline]
    pub(in crate::mapping) fn at(&self, observation: usize) -> EstimatesAt<'_> {
        let row = &self.entries[observation * self.width..(observation + 1) * self.width];
        EstimatesAt { projected: self, row, observation }
    }

    /// Fills the table of a group: with `N_i(v) = term(i+1, v) + H_{i+1}(v)`, what it costs to be next at class `v`,
    ///
    /// ```text
    /// H_n(v) = 0
    /// H_i(v) = min( N_i(v),                              skip
    ///               share(v, v') + N_i(v'),              match
    ///               share(v, v') + term(i, v') + H_i(v') extra )
    /// ```
    ///
    /// The last line refers to the same observation, so each observation is a pass of Dijkstra's algorithm from those
    /// classes that an extra action improves.
    fn solve_column(&mut self, number: usize, share: impl Fn(&ProjectedEdge) -> f64, meter: &mut Meter<'_>) -> Signal {
        let Column { group, offset } = self.columns[number];
        let n_classes = group.n_classes();
        let predecessors = Predecessors::new(n_classes, group.edges(), share);
        for i in 0..self.problem.demonstration.len() {
            let row = &mut self.entries[i * self.width + offset..][..n_classes];
            group.write_terms(self.problem, i, row);
        }
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
                for (from, share) in predecessors.of(class) {
                    let from = &mut here[*from as usize].cost_to_go;
                    *from = from.min(share + cost);
                }
            }
            for class in 0..n_classes {
                let cost = here[class].distance + here[class].cost_to_go;
                relax(&predecessors, class, cost, here, &mut open);
            }
            while let Some(CheapestFirst { cost, id: class }) = open.pop() {
                match meter.spend(1) {
                    Signal::Continue => {}
                    signal => return signal,
                }
                let entry = here[class as usize];
                if cost <= entry.cost_to_go {
                    relax(&predecessors, class as usize, entry.distance + cost, here, &mut open);
                }
            }
        }
        Signal::Continue
    }
}

/// Offers every class an extra action into `class`, which costs `cost` from its arrival on.
#[inline]
fn relax(
    predecessors: &Predecessors,
    class: usize,
    cost: f64,
    here: &mut [Estimate],
    open: &mut BinaryHeap<CheapestFirst>,
) {
    for (from, share) in predecessors.of(class) {
        let extra = share + cost;
        let known = &mut here[*from as usize].cost_to_go;
        if extra < *known {
            *known = extra;
            open.push(CheapestFirst { cost: extra, id: *from });
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
        for (position, offset) in &projected.singles {
            add(self.row[offset + values[*position] as usize]);
        }
        for Column { group, offset } in projected.groups.iter().map(|number| &projected.columns[*number]) {
            add(self.row[offset + group.class_of(values)]);
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

/// Which groups have tables, the smallest first as far as `max_entries` go.
fn used_groups(projections: &Projections, problem: &Problem<'_>, max_entries: usize) -> Vec<bool> {
    let groups = projections.groups();
    // A group whose attributes weigh nothing would take its share of the actions' costs to no purpose.
    let mut wanted: Vec<usize> = (0..groups.len())
        .filter(|number| {
            groups[*number].is_kept() && groups[*number].positions().any(|at| problem.distances.is_active(at))
        })
        .collect();
    wanted.sort_by_key(|number| groups[*number].n_classes());
    let mut used = vec![false; groups.len()];
    let mut n_left = max_entries;
    for number in wanted {
        let n_entries = problem.demonstration.len().saturating_mul(groups[number].n_classes());
        let Some(left) = n_left.checked_sub(n_entries) else { break };
        n_left = left;
        used[number] = true;
    }
    used
}

/// The ways into each class, cheapest of each origin.
struct Predecessors {
    /// `offsets[v]..offsets[v + 1]` are the edges into `v`. Shape `[n_classes + 1]`.
    offsets: Vec<u32>,
    edges: Vec<(u32, f64)>,
}

impl Predecessors {
    fn new(n_classes: usize, edges: &[ProjectedEdge], share: impl Fn(&ProjectedEdge) -> f64) -> Self {
        let mut into: Vec<_> = edges.iter().map(|edge| (edge.to, edge.from, share(edge))).collect();
        into.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
        into.dedup_by_key(|(to, from, _)| (*to, *from));
        let mut offsets = vec![0; n_classes + 1];
        for (to, _, _) in &into {
            offsets[*to as usize + 1] += 1;
        }
        for class in 0..n_classes {
            offsets[class + 1] += offsets[class];
        }
        Self { offsets, edges: into.into_iter().map(|(_, from, share)| (from, share)).collect() }
    }

    #[inline]
    fn of(&self, class: usize) -> &[(u32, f64)] {
        &self.edges[self.offsets[class] as usize..self.offsets[class + 1] as usize]
    }
}
