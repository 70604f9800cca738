//! Projections solved for one demonstration: tables of distances and exact costs-to-go.

use std::collections::BinaryHeap;

use super::bounded::{Basis, Bounded, Unsolved};
use super::projection::{ClassIdx, Group, ProjectedEdge, Projections};
use super::{Grouping, Heuristic};
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

/// What is known for making tables of groups of several attributes.
#[derive(Debug)]
struct Deepening<'p> {
    projections: &'p Projections,
    /// By group of a single attribute: whether it has a table.
    used: Vec<bool>,
    /// The next level of groups.
    level: usize,
    /// After how many expansions it is worth a try.
    due: u64,
    grouping: Grouping,
    forward: Option<Forward>,
}

/// Costs from the start.
#[derive(Debug)]
struct Forward {
    /// By observation and class, with the distance. Shape `[n_observations, width]`.
    costs: Vec<f64>,
    /// By column: what it costs in all.
    optima: Vec<f64>,
}

/// What came of an attempt to make the estimates better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::mapping) enum Deepened {
    /// Estimates have changed: they are higher, and infinite where nothing is worth finding.
    Yes,
    /// Nothing has changed.
    No,
    /// The interrupt said to finish; nothing has changed.
    CutShort,
}

/// Most entries of all tables together: 256 MB. Groups that do not fit, the largest, are left out, which keeps the bound a
/// bound.
pub(in crate::mapping) const MAX_ENTRIES: usize = 1 << 24;

/// Groups of several attributes are projected after this many expansions, and after as many as the model has transitions: looking at
/// these takes about as long.
const MIN_EXPANSIONS: u64 = 1 << 16;

/// How many expansions must have been done for each entry of a level's tables. An entry takes about as long as two; attempts that
/// fail should not take much of the search, and they are repeated whenever it has doubled.
const EXPANSIONS_PER_ENTRY: u64 = 16;

/// Most entries of the tables of a level: 256 MB with the room in hash tables.
const MAX_JOINT_ENTRIES: usize = 1 << 22;

/// How much more than the limit a mapping may cost before its classes are dropped, relatively: more than sums differ by rounding.
const SLACK: f64 = 1e-9;

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
        let due = match grouping {
            // Groups are chosen by looking at states and transitions.
            _ if problem.model.is_lazy() => u64::MAX,
            Grouping::Widest => 0,
            Grouping::WhenItPays => MIN_EXPANSIONS.max(problem.model.graph().n_transitions() as u64),
        };
        projected.deepening = Some(Deepening { projections, used, level: 0, due, grouping, forward: None });
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

    /// After how many expansions better estimates are worth a try.
    pub(in crate::mapping) fn deepening_due(&self) -> u64 {
        self.deepening.as_ref().map_or(u64::MAX, |deepening| deepening.due)
    }

    /// Makes the estimates better for those nodes that may be on a mapping cheaper than `limit`, and infinite for others, if
    /// that is not much more work than the `n_expanded` expansions that were done.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if the interrupt of `meter` said so.
    pub(in crate::mapping) fn deepen(
        &mut self,
        limit: f64,
        n_expanded: u64,
        meter: &mut Meter<'_>,
    ) -> Result<Deepened, Cancelled> {
        let Some(mut deepening) = self.deepening.take() else { return Ok(Deepened::No) };
        let most_entries = match deepening.grouping {
            Grouping::Widest => MAX_JOINT_ENTRIES,
            Grouping::WhenItPays => usize::try_from(n_expanded / EXPANSIONS_PER_ENTRY).unwrap_or(usize::MAX),
        };
        let most_entries = most_entries.min(MAX_JOINT_ENTRIES);
        match self.solve_level(&mut deepening, limit, most_entries, meter) {
            Ok(None) => Ok(Deepened::No),
            Ok(Some(joint)) => {
                let columns = self.columns.iter();
                let joined = columns.filter(|column| joint.iter().any(|table| table.group().has(column.position)));
                for column in joined {
                    for row in self.entries.chunks_exact_mut(self.width) {
                        for entry in &mut row[column.offset..][..column.group.n_classes()] {
                            entry.cost_to_go = 0.0;
                        }
                    }
                }
                self.joint = joint;
                deepening.level += 1;
                if deepening.grouping == Grouping::WhenItPays {
                    deepening.due = n_expanded.saturating_mul(2);
                }
                self.deepening = Some(deepening);
                Ok(Deepened::Yes)
            }
            Err(Unsolved::TooLarge) => {
                // When the search has taken longer, more is worth while, and the limit may be lower.
                deepening.due = n_expanded.saturating_mul(2);
                self.deepening = (deepening.grouping == Grouping::WhenItPays).then_some(deepening);
                Ok(Deepened::No)
            }
            Err(Unsolved::Interrupted(Signal::Cancel)) => Err(Cancelled),
            Err(Unsolved::Interrupted(_)) => Ok(Deepened::CutShort),
        }
    }

    /// The tables of the next level's groups; `None` if there is no next level.
    fn solve_level(
        &self,
        deepening: &mut Deepening<'p>,
        limit: f64,
        mut n_left: usize,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Vec<Bounded<'p>>>, Unsolved> {
        let Deepening { projections, used, level, forward, .. } = deepening;
        let projections: &'p Projections = projections;
        let mut poll = || meter.spend(u64::MAX);
        let groups = projections.level(self.problem.model, *level, &mut poll).map_err(Unsolved::Interrupted)?;
        let Some(groups) = groups else { return Ok(None) };
        if forward.is_none() {
            *forward = Some(self.solve_forward(projections, used, meter).map_err(Unsolved::Interrupted)?);
        }
        let Some(Forward { costs, optima }) = forward else { return Ok(None) };
        let column_of = |position: usize| self.columns.iter().position(|column| column.position == position);
        let mut joint = Vec::new();
        for group in groups.iter().filter(|group| group.is_kept()) {
            let columns: Vec<Option<usize>> = group.positions().map(column_of).collect();
            let is_tabled = |position| !self.untabled.contains(&position);
            if columns.iter().all(Option::is_none) || !group.positions().all(is_tabled) {
                continue;
            }
            // A little more than the others leave, as sums differ by rounding.
            let others = (0..self.columns.len()).filter(|number| !columns.contains(&Some(*number)));
            let others: f64 = others.map(|number| optima[number]).sum();
            let positions: Vec<usize> = group.positions().collect();
            let parts = Parts::new(projections, self.problem, used, &positions);
            let offsets: Vec<Option<usize>> =
                columns.iter().map(|column| column.map(|number| self.columns[number].offset)).collect();
            let rows = self.least_terms.chunks_exact(self.columns.len());
            let least_terms = rows.map(|row| columns.iter().flatten().map(|number| row[*number]).sum());
            let least_terms: Vec<f64> = least_terms.collect();
            let basis = Basis {
                columns: &offsets,
                least_distances: &self.least_distances,
                least_terms: &least_terms,
                width: self.width,
                entries: &self.entries,
                forward: costs,
                limit: limit * (1.0 + SLACK) - others,
            };
            joint.push(Bounded::solve(group, &basis, |edge, more| parts.of(edge, more), &mut n_left, meter)?);
        }
        Ok(Some(joint))
    }

    /// Costs from the start, forwards over the demonstration: with `F_i(v)` as in [`super::bounded`],
    ///
    /// ```text
    /// F_0(start) = term(0, start)
    /// F_i(v) = min( F_{i-1}(v) + term(i, v),                  skip
    ///               F_{i-1}(v') + share(v', v) + term(i, v),  match
    ///               F_i(v') + share_i(v', v) + rest(i, v) )   extra
    /// ```
    fn solve_forward(
        &self,
        projections: &Projections,
        used: &[bool],
        meter: &mut Meter<'_>,
    ) -> Result<Forward, Signal> {
        let width = self.width;
        let mut costs = vec![f64::INFINITY; self.entries.len()];
        let mut optima = Vec::new();
        let start = self.problem.model.states().row(self.problem.start);
        let mut open = BinaryHeap::new();
        for (number, Column { group, position, offset }) in self.columns.iter().enumerate() {
            let n_classes = group.n_classes();
            let parts = Parts::new(projections, self.problem, used, &[*position]);
            let ways = Ways::into_classes(group, &parts).reversed();
            let first = start[*position] as usize;
            for i in 0..self.problem.demonstration.len() {
                let (before, after) = costs.split_at_mut(i * width);
                let here = &mut after[*offset..][..n_classes];
                let terms = &self.entries[i * width + offset..][..n_classes];
                let least = self.least_terms[i * self.columns.len() + number];
                if i == 0 {
                    here[first] = terms[first].distance;
                } else {
                    let before = &before[(i - 1) * width + offset..][..n_classes];
                    for class in 0..n_classes {
                        here[class] = here[class].min(before[class] + terms[class].distance);
                        for Way { class: to, share, .. } in ways.of(class) {
                            let to = *to as usize;
                            here[to] = here[to].min(before[class] + share + terms[to].distance);
                        }
                    }
                }
                match meter.spend((n_classes + ways.ways.len()) as u64) {
                    Signal::Continue => {}
                    signal => return Err(signal),
                }
                #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                open.extend((0..n_classes).map(|class| CheapestFirst { cost: here[class], id: class as u32 }));
                while let Some(CheapestFirst { cost, id }) = open.pop() {
                    if cost > here[id as usize] || cost == f64::INFINITY {
                        continue;
                    }
                    for way in ways.of(id as usize) {
                        let (to, rest) = (way.class as usize, terms[way.class as usize].distance - least);
                        let arrived = cost + way.share_of_extra(self.least_distances[i]) + rest;
                        if arrived < here[to] {
                            here[to] = arrived;
                            open.push(CheapestFirst { cost: arrived, id: way.class });
                        }
                    }
                }
            }
            let last = &costs[self.problem.last() * width + offset..][..n_classes];
            optima.push(last.iter().copied().fold(f64::INFINITY, f64::min));
        }
        Ok(Forward { costs, optima })
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
        let start = self.problem.model.states().row(self.problem.start);
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

/// How the costs of actions are divided, as one group sees it.
struct Parts<'p> {
    problem: &'p Problem<'p>,
    /// By kind of edge: what the action's cost is divided by.
    divisors: Vec<f64>,
}

impl<'p> Parts<'p> {
    /// As the group of the attributes at `positions` sees it. `used` tells which groups of a single attribute have tables.
    ///
    /// Each attribute that a transition changes, of those with tables, pays the same part of the action's cost, and a group pays
    /// for its attributes. Where none of these changes, the first group of the partition that does pays all.
    fn new(projections: &Projections, problem: &'p Problem<'p>, used: &[bool], positions: &[usize]) -> Self {
        let is_used = |number: &&u16| used[usize::from(**number)];
        let is_own = |number: &&u16| {
            let position = projections.groups()[usize::from(**number)].positions().next();
            position.is_some_and(|position| positions.contains(&position))
        };
        let divisors = projections.change_sets().iter().flat_map(|set| {
            let (mut n_all, mut n_own) = (0u32, 0u32);
            for number in set.iter().filter(is_used) {
                n_all += 1;
                n_own += u32::from(is_own(&number));
            }
            if n_all == 0 { [f64::INFINITY, 1.0] } else { [f64::from(n_all) / f64::from(n_own); 2] }
        });
        Self { problem, divisors: divisors.collect() }
    }

    /// What an edge costs, if its transition costs `more` than the action.
    #[inline]
    fn of(&self, edge: &ProjectedEdge, more: f64) -> f64 {
        (self.problem.model.action(edge.action).cost + more) / self.divisors[edge.kind as usize]
    }
}

/// The ways between classes, by where they lead or where they come from, the cheapest of each pair.
struct Ways {
    /// `offsets[v]..offsets[v + 1]` are the ways of `v`. Shape `[n_classes + 1]`.
    offsets: Vec<u32>,
    ways: Vec<Way>,
}

/// The way to or from a class: the least share of those that there are, and the least part, which may be of different ones.
#[derive(Clone, Copy, Debug, Default)]
struct Way {
    class: ClassIdx,
    /// Of the action's cost.
    share: f64,
    /// Of what else is paid: from 0 to 1.
    part: f64,
}

impl Way {
    /// What an extra action costs besides the distance that is left, if the least distance is `least_distance`.
    #[inline]
    fn share_of_extra(&self, least_distance: f64) -> f64 {
        self.share + self.part * least_distance
    }
}

impl Ways {
    /// The ways into each class, with where they come from.
    fn into_classes(group: &Group, parts: &Parts<'_>) -> Self {
        let mut offsets = Vec::with_capacity(group.n_classes() + 1);
        offsets.push(0);
        let mut ways: Vec<Way> = Vec::with_capacity(group.n_edges());
        for class in 0..group.n_classes() {
            let first = ways.len();
            for edge in group.edges_into(class) {
                let (share, part) = (parts.of(edge, 0.0), 1.0 / parts.divisors[edge.kind as usize]);
                match ways[first..].last_mut() {
                    Some(way) if way.class == edge.from => {
                        way.share = way.share.min(share);
                        way.part = way.part.min(part);
                    }
                    _ => ways.push(Way { class: edge.from, share, part }),
                }
            }
            #[expect(clippy::cast_possible_truncation, reason = "at most `MAX_EDGES`")]
            offsets.push(ways.len() as u32);
        }
        Self { offsets, ways }
    }

    /// The same ways, by where they come from.
    fn reversed(&self) -> Self {
        let n_classes = self.offsets.len() - 1;
        let mut offsets = vec![0; n_classes + 1];
        for way in &self.ways {
            offsets[way.class as usize + 1] += 1;
        }
        for class in 0..n_classes {
            offsets[class + 1] += offsets[class];
        }
        let mut free: Vec<u32> = offsets.clone();
        let mut ways = vec![Way::default(); self.ways.len()];
        for to in 0..n_classes {
            for way in self.of(to) {
                let place = &mut free[way.class as usize];
                #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                let class = to as ClassIdx;
                ways[*place as usize] = Way { class, ..*way };
                *place += 1;
            }
        }
        Self { offsets, ways }
    }

    #[inline]
    fn of(&self, class: usize) -> &[Way] {
        &self.ways[self.offsets[class] as usize..self.offsets[class + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::{Value, json};

    use super::*;
    use crate::document::{Faults, Place};
    use crate::interrupt::Uninterrupted;
    use crate::mapping::Request;
    use crate::model::{Definition, Limits, Model, StateIdx};

    /// A model of up to 12 states and three attributes, of which some weigh nothing, and a demonstration.
    fn model_and_demonstration() -> impl Strategy<Value = (Value, Value)> {
        let weights = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
        let costs = prop::array::uniform3(prop_oneof![Just(0.0), Just(1.0), 0.1..3.0]);
        let row = || prop::array::uniform3(0u8..3);
        let seen = prop::array::uniform3(prop::option::weighted(0.8, 0u8..4));
        (2usize..12).prop_flat_map(move |n_states| {
            let ways = prop::collection::vec((0..n_states, 0usize..3, 0..n_states), 0..3 * n_states);
            let rows = prop::collection::vec(row(), n_states);
            (weights.clone(), costs.clone(), rows, ways, prop::collection::vec(seen.clone(), 1..6)).prop_map(
                |(weights, costs, rows, mut ways, seen)| {
                    ways.sort_unstable();
                    ways.dedup_by_key(|(from, action, _)| (*from, *action));
                    let attributes = ["a", "b", "c"].into_iter().zip(weights);
                    let attributes =
                        attributes.map(|(name, weight)| json!({"name": name, "kind": "number", "weight": weight}));
                    let actions =
                        costs.iter().enumerate().map(|(n, cost)| json!({"name": format!("{n}"), "cost": cost}));
                    let model = json!({
                        "attributes": attributes.collect::<Value>(), "actions": actions.collect::<Value>(),
                        "dynamics": {"kind": "table", "states": rows, "transitions": ways, "start": 0},
                    });
                    (model, json!(seen))
                },
            )
        })
    }

    fn distance(problem: &Problem<'_>, i: usize, state: StateIdx) -> f64 {
        problem.distances.distance(i, problem.model.states().row(state))
    }

    /// The moves out of a node, with what they cost.
    fn moves(problem: &Problem<'_>, i: usize, state: StateIdx) -> Vec<(usize, StateIdx, f64)> {
        let mut moves = vec![(i + 1, state, 0.0)];
        for transition in problem.model.graph().successors(state) {
            let cost = problem.model.action(transition.action).cost;
            moves.extend([(i + 1, transition.to, cost), (i, transition.to, cost)]);
        }
        moves.retain(|(i, _, _)| *i <= problem.last());
        moves.into_iter().map(|(i, state, cost)| (i, state, cost + distance(problem, i, state))).collect()
    }

    fn nodes(problem: &Problem<'_>) -> Vec<(usize, StateIdx)> {
        (0..=problem.last()).flat_map(|i| (0..problem.model.states().len()).map(move |state| (i, state))).collect()
    }

    /// Least costs of all nodes, from the start and to the end, by going over all moves until nothing changes.
    fn least_costs(problem: &Problem<'_>) -> [Vec<Vec<f64>>; 2] {
        let unknown = vec![vec![f64::INFINITY; problem.model.states().len() as usize]; problem.last() + 1];
        let (mut from_start, mut to_end) = (unknown.clone(), unknown);
        from_start[0][problem.start as usize] = distance(problem, 0, problem.start);
        to_end[problem.last()].fill(0.0);
        loop {
            let mut has_changed = false;
            for (i, state) in nodes(problem) {
                for (next, to, cost) in moves(problem, i, state) {
                    let (state, to) = (state as usize, to as usize);
                    let arrived = from_start[i][state] + cost;
                    if arrived < from_start[next][to] {
                        from_start[next][to] = arrived;
                        has_changed = true;
                    }
                    let completed = cost + to_end[next][to];
                    if completed < to_end[i][state] {
                        to_end[i][state] = completed;
                        has_changed = true;
                    }
                }
            }
            if !has_changed {
                return [from_start, to_end];
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn estimates_are_admissible_and_consistent_and_grow_with_the_groups(
            (definition, demonstration) in model_and_demonstration(),
            groups in prop_oneof![
                Just(vec![vec![0, 1], vec![2]]), Just(vec![vec![0], vec![1, 2]]), Just(vec![vec![0, 2], vec![1]]),
                Just(vec![vec![0, 1, 2]]),
            ],
            room in prop_oneof![Just(0.0), 0.0..0.5, Just(f64::INFINITY)],
        ) {
            let definition = Definition::read(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
            let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
            let varies = |at: &usize| model.states().domain(*at).len() > 1;
            let partition = groups.into_iter().map(|group| group.into_iter().filter(varies).collect());
            let partition: Vec<Vec<usize>> = partition.filter(|group: &Vec<usize>| !group.is_empty()).collect();
            let projections = Projections::with_levels(&model, [partition]);
            let seen: Vec<Value> = demonstration.as_array().unwrap().iter().map(|seen| {
                json!({"a": seen[0], "b": seen[1], "c": seen[2]})
            }).collect();
            let request = json!({"model": "m", "demonstration": seen});
            let mut faults = Faults::default();
            let object = Place::root(&request).object(&Request::FIELDS, &mut faults).unwrap();
            let problem = Request::read(&model, &object, &mut faults).unwrap().problem;
            let [from_start, to_end] = least_costs(&problem);
            let optimum = from_start[problem.last()].iter().copied().fold(f64::INFINITY, f64::min);
            let limit = optimum * (1.0 + room) + 1e-6;
            let close = 1e-9 * (1.0 + optimum);

            let solved = Projected::solve(&projections, &problem, Grouping::Widest, MAX_ENTRIES, &mut Uninterrupted).unwrap();
            let mut projected = solved.unwrap();
            let mut alone: Vec<f64> = Vec::new();
            for is_deep in [false, true] {
                if is_deep {
                    let mut interrupt = Uninterrupted;
                    let mut meter = Meter::new(&mut interrupt, 1);
                    prop_assert_eq!(projected.deepen(limit, 0, &mut meter), Ok(Deepened::Yes));
                }
                for (number, (i, state)) in nodes(&problem).into_iter().enumerate() {
                    let estimate = projected.at(i).of(problem.model.states().row(state));
                    prop_assert!((estimate.distance - distance(&problem, i, state)).abs() <= close);
                    let h = estimate.cost_to_go;
                    let through = from_start[i][state as usize] + to_end[i][state as usize];
                    if !is_deep || through < limit {
                        prop_assert!(h <= to_end[i][state as usize] + close, "admissible at ({i}, {state})");
                    }
                    for (next, to, cost) in moves(&problem, i, state) {
                        let next_h = projected.at(next).of(problem.model.states().row(to)).cost_to_go;
                        prop_assert!(h == f64::INFINITY || h <= cost + next_h + close, "consistent at ({i}, {state})");
                    }
                    if is_deep {
                        prop_assert!(h >= alone[number] - close, "no lower than alone");
                    } else {
                        alone.push(h);
                    }
                }
            }
        }
    }
}
