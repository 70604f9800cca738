//! Better estimates for a search that takes long: tables of groups of several attributes.

use std::collections::BinaryHeap;

use super::{Column, Layer, Projected, Table};
use crate::interrupt::{Cancelled, Meter, Signal};
use crate::mapping::Problem;
use crate::mapping::cost::SLACK;
use crate::mapping::heuristic::joint::{self, Basis, Joint, Room, Unsolved};
use crate::mapping::heuristic::projection::{Group, Projections};
use crate::mapping::heuristic::shares::{Parts, Way, Ways};
use crate::mapping::heuristic::{Grouping, GroupingPatience};
use crate::mapping::open_list::CheapestFirst;

/// What is known for making tables of groups of several attributes.
#[derive(Debug)]
pub(super) struct Deepening<'p> {
    projections: &'p Projections,
    /// By group of a single attribute: whether it has a table.
    used: Vec<bool>,
    /// The next level of groups.
    level: usize,
    /// After how many expansions it is worth a try.
    due: u64,
    grouping: Grouping,
    patience: GroupingPatience,
    forward: Option<Forward>,
    /// How much memory the groups take that were used. The model keeps them.
    group_bytes: usize,
}

impl<'p> Deepening<'p> {
    /// Nothing is made yet. `used` tells which groups of a single attribute have tables.
    pub(super) fn new(
        projections: &'p Projections,
        problem: &Problem<'_>,
        used: Vec<bool>,
        grouping: Grouping,
    ) -> Self {
        let patience = GroupingPatience::DEFAULT;
        let due = patience.due(grouping, problem);
        Self { projections, used, level: 0, due, grouping, patience, forward: None, group_bytes: 0 }
    }

    /// Size in memory, in bytes, with the groups that were used.
    pub(super) fn size_bytes(&self) -> usize {
        self.group_bytes + self.forward.as_ref().map_or(0, |forward| forward.costs.size_bytes())
    }
}

impl GroupingPatience {
    /// After how many expansions of a search for `problem` a first level is worth a try.
    fn due(self, grouping: Grouping, problem: &Problem<'_>) -> u64 {
        match grouping {
            // Groups are chosen by looking at states and transitions.
            _ if problem.model.is_lazy() => u64::MAX,
            Grouping::Widest => 0,
            Grouping::WhenItPays => {
                let n_transitions = problem.model.graph().n_transitions() as u64;
                self.min_expansions.max(n_transitions * self.expansions_per_transition)
            }
        }
    }

    /// What tables may be made in `max_bytes` after `n_expanded` expansions.
    fn room(self, n_expanded: u64, max_bytes: usize) -> Room {
        let bounded = n_expanded.checked_div(self.expansions_per_entry).unwrap_or(u64::MAX);
        let full = n_expanded.saturating_mul(self.full_entries_per_expansion);
        let [bounded, full] = [bounded, full].map(|n_entries| usize::try_from(n_entries).unwrap_or(usize::MAX));
        Room { bounded, full, bytes: max_bytes }
    }
}

/// Costs from the start.
#[derive(Debug)]
struct Forward {
    /// By class and observation, with the distance.
    costs: Table<f64>,
    /// By column: what it costs in all.
    optima: Vec<f64>,
}

/// What came of an attempt to make the estimates better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::mapping) enum Deepened {
    /// Estimates have changed, and are infinite where nothing is worth finding.
    Yes,
    /// Nothing has changed.
    No,
    /// The interrupt said to finish.
    CutShort,
}

impl<'p> Projected<'p> {
    /// Sets when attributes are projected together, before any were.
    pub(in crate::mapping) fn set_patience(&mut self, patience: GroupingPatience) {
        if let Some(deepening) = &mut self.deepening {
            deepening.patience = patience;
            deepening.due = patience.due(deepening.grouping, self.problem);
        }
    }

    /// After how many expansions better estimates are worth a try.
    pub(in crate::mapping) fn deepening_due(&self) -> u64 {
        self.deepening.as_ref().map_or(u64::MAX, |deepening| deepening.due)
    }

    /// Makes the estimates better for those nodes that may be on a mapping cheaper than `limit`, and infinite for others, if
    /// that is not much more work than the `n_expanded` expansions that were done, and takes no more than `max_bytes` besides.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if the interrupt of `meter` said so.
    pub(in crate::mapping) fn deepen(
        &mut self,
        limit: f64,
        n_expanded: u64,
        max_bytes: usize,
        meter: &mut Meter<'_>,
    ) -> Result<Deepened, Cancelled> {
        let Some(mut deepening) = self.deepening.take() else { return Ok(Deepened::No) };
        let room = match deepening.grouping {
            Grouping::Widest => Room { bounded: usize::MAX, full: usize::MAX, bytes: max_bytes },
            Grouping::WhenItPays => deepening.patience.room(n_expanded, max_bytes),
        };
        match self.solve_level(&mut deepening, limit, room, meter) {
            Ok(None) | Err(Unsolved::Impossible) => Ok(Deepened::No),
            Ok(Some(joint)) => {
                self.joint = joint;
                deepening.level += 1;
                if deepening.grouping == Grouping::WhenItPays {
                    deepening.due = n_expanded.saturating_mul(2);
                }
                let divided = self.divide_columns(&deepening, meter);
                self.tell_unchanged();
                self.deepening = Some(deepening);
                match divided {
                    Ok(()) => Ok(Deepened::Yes),
                    Err(Signal::Cancel) => Err(Cancelled),
                    Err(_) => Ok(Deepened::CutShort),
                }
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

    /// Takes the costs-to-go out of the columns whose attributes are in groups with tables, and puts them back into those that were in
    /// such groups at the level before.
    fn divide_columns(&mut self, deepening: &Deepening<'p>, meter: &mut Meter<'_>) -> Result<(), Signal> {
        for number in 0..self.columns.len() {
            let Column { group, position, offset, is_joined } = self.columns[number];
            let is_joined_now = self.joint.iter().any(|table| table.has(position));
            self.columns[number].is_joined = is_joined_now;
            if is_joined_now {
                for class in 0..group.n_classes() {
                    self.table.of_mut(offset + class).iter_mut().for_each(|entry| entry.cost_to_go = 0.0);
                }
            } else if is_joined {
                let parts = Parts::new(deepening.projections, self.problem, &deepening.used, &[position]);
                let ways = Ways::into_classes(group, &parts);
                match self.solve_column(number, &ways, &mut Layer::default(), meter) {
                    Signal::Continue => {}
                    signal => return Err(signal),
                }
            }
        }
        Ok(())
    }

    /// The tables of the next level's groups; `None` if there is no next level.
    fn solve_level(
        &self,
        deepening: &mut Deepening<'p>,
        limit: f64,
        mut room: Room,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Vec<Joint>>, Unsolved> {
        let Deepening { projections, used, level, forward, group_bytes, .. } = deepening;
        let mut poll = || meter.spend(u64::MAX);
        let Some(groups) = projections.level(self.problem.model, *level, room.bytes, &mut poll)? else {
            return Ok(None);
        };
        room.bytes = room.bytes.saturating_sub(groups.size_bytes());
        if forward.is_none() {
            let n_bytes = self.forward_bytes();
            room.bytes = room.bytes.checked_sub(n_bytes).ok_or(Unsolved::TooLarge)?;
            *forward = Some(self.solve_forward(projections, used, meter).map_err(Unsolved::Interrupted)?);
        }
        let Some(forward) = forward else { return Ok(None) };
        let bases = groups.groups.iter().filter(|group| group.is_kept());
        let bases: Vec<Basis<'_>> =
            bases.filter_map(|group| self.basis(group, projections, used, forward, limit)).collect();
        let joint = joint::solve(&bases, room, meter)?;
        *group_bytes += groups.size_bytes();
        Ok(Some(joint))
    }

    /// What the table of a group is made from; `None` if its attributes have no tables.
    fn basis<'b>(
        &'b self,
        group: &'b Group,
        projections: &Projections,
        used: &[bool],
        forward: &'b Forward,
        limit: f64,
    ) -> Option<Basis<'b>> {
        let column_of = |position: usize| self.columns.iter().position(|column| column.position == position);
        let columns: Vec<Option<usize>> = group.positions().map(column_of).collect();
        let is_tabled = |position| !self.untabled.contains(&position);
        if columns.iter().all(Option::is_none) || !group.positions().all(is_tabled) {
            return None;
        }
        let others = (0..self.columns.len()).filter(|number| !columns.contains(&Some(*number)));
        let others: f64 = others.map(|number| forward.optima[number]).sum();
        let positions: Vec<usize> = group.positions().collect();
        let rows = self.least_terms.chunks_exact(self.columns.len());
        let least_terms = rows.map(|row| columns.iter().flatten().map(|number| row[*number]).sum());
        Some(Basis {
            group,
            parts: Parts::new(projections, self.problem, used, &positions),
            states: self.problem.model.states(),
            least_terms: least_terms.collect(),
            columns: columns.iter().map(|column| column.map(|number| self.columns[number].offset)).collect(),
            table: &self.table,
            forward: &forward.costs,
            least_distances: &self.least_distances,
            // A little more than the others leave, as sums differ by rounding.
            limit: limit * (1.0 + SLACK) - others,
        })
    }

    /// How much memory costs from the start take, in bytes, with what it takes to make them: the ways of a column, in both directions.
    fn forward_bytes(&self) -> usize {
        let groups = self.columns.iter().map(|column| column.group);
        let width = groups.clone().map(Group::n_classes).sum();
        let n_ways = groups.map(Group::n_edges).max().unwrap_or_default();
        let n_entries = Table::<f64>::n_entries_for(width, self.problem.demonstration.len());
        n_entries * size_of::<f64>() + 2 * n_ways * size_of::<Way>()
    }

    /// Costs from the start, forwards over the demonstration: with `F_i(v)` as in [`bounded`](crate::mapping::heuristic::joint),
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
        let (last, n_observations) = (self.problem.last(), self.problem.demonstration.len());
        let width = self.columns.iter().map(|column| column.group.n_classes()).sum();
        let mut costs = Table::filled_with(f64::INFINITY, width, n_observations);
        let mut optima = Vec::new();
        let start = &self.problem.start_row;
        let mut open = BinaryHeap::new();
        for (number, Column { group, position, offset, .. }) in self.columns.iter().enumerate() {
            let n_classes = group.n_classes();
            let parts = Parts::new(projections, self.problem, used, &[*position]);
            let ways = Ways::into_classes(group, &parts).reversed();
            let first = start[*position] as usize;
            let (mut before, mut here) = (vec![f64::INFINITY; n_classes], vec![f64::INFINITY; n_classes]);
            for i in 0..n_observations {
                let term = |class: usize| self.table.at(offset + class, i).distance;
                let least = self.least_terms[i * self.columns.len() + number];
                std::mem::swap(&mut before, &mut here);
                here.fill(f64::INFINITY);
                if i == 0 {
                    here[first] = term(first);
                } else {
                    for class in 0..n_classes {
                        here[class] = here[class].min(before[class] + term(class));
                        for Way { class: to, price } in ways.of(class) {
                            let to = *to as usize;
                            here[to] = here[to].min(before[class] + price.share + term(to));
                        }
                    }
                }
                match meter.spend((n_classes + ways.len()) as u64) {
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
                        let (to, rest) = (way.class as usize, term(way.class as usize) - least);
                        let arrived = cost + way.price.of_extra(self.least_distances[i]) + rest;
                        if arrived < here[to] {
                            here[to] = arrived;
                            open.push(CheapestFirst { cost: arrived, id: way.class });
                        }
                    }
                }
                for (class, cost) in here.iter().enumerate() {
                    *costs.at_mut(offset + class, i) = *cost;
                }
            }
            let of_last = (0..n_classes).map(|class| costs.at(offset + class, last));
            optima.push(of_last.fold(f64::INFINITY, f64::min));
        }
        Ok(Forward { costs, optima })
    }
}
