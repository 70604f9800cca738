//! The backward search of an abstraction, as far as the search of the model asks.

mod known;
mod missed;

use std::sync::Arc;

use super::forward::{self, CostFromStart};
use super::open::Open;
use super::{Abstraction, WayKind};
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::heuristic::projected::Projected;
use crate::mapping::heuristic::projection::Projections;
use crate::mapping::heuristic::shares::SharedWays;
use crate::mapping::{MoveKind, Problem};
use crate::model::StateIdx;
pub(in crate::mapping) use known::KnownCosts;

/// An abstraction of one problem, partly solved. With `H_i(c)` for what it costs the group to go on from the class c at observation i, `G`
/// for what it costs to come there at least, and F for the least `G + H` of what is left to be looked at,
///
/// - `H_i(c)` is exact if the node is *closed*;
/// - otherwise it is at least `F - G_i(c)`.
///
/// Both are admissible and consistent, whatever F is, as `G` is consistent.
#[derive(Debug)]
pub(in crate::mapping) struct Abstracted<'p> {
    pub(super) abstraction: Arc<Abstraction>,
    problem: &'p Problem<'p>,
    projected: &'p Projected<'p>,
    /// The group's columns that have tables, in order.
    columns: Vec<GroupColumn>,
    /// By class, where its values are among those of all columns. Shape `[n_classes, n_columns]`.
    values: Vec<u32>,
    /// How many values all columns have.
    width: usize,
    /// Of the columns' values, one after the other, what it costs to come there at least: the terms of `G`. Shape `[n_observations, width]`.
    from_start: Vec<f64>,
    /// Likewise, the terms of the distance.
    terms: Vec<f64>,
    /// What the group pays of a way, by its kind.
    kinds: Vec<WayCost>,
    /// `H` of what is closed; of what is open, the least known, negative; minus infinity for the rest.
    costs: KnownCosts,
    pub(super) open: Open,
    /// By observation, the least term of the group.
    least_terms: Vec<f64>,
    /// What the other attributes add to the cost of every mapping at least.
    least_rest: f64,
    /// F, with what the others add.
    least_f: f64,
}

/// A column of the group.
#[derive(Clone, Copy, Debug)]
struct GroupColumn {
    position: usize,
    /// Where its values begin in the projected tables,
    offset: usize,
    /// and among those of all columns.
    first: usize,
}

/// What the group pays of a way.
#[derive(Clone, Copy, Debug)]
struct WayCost {
    /// Of its cost; infinite if the body cannot go it.
    cost: f64,
    /// The part that it pays of the least distance, if it is an extra action.
    part: f64,
}

impl<'p> Abstracted<'p> {
    /// About how much memory it takes at first, in bytes.
    pub(super) fn bytes_for(n_classes: usize, problem: &Problem<'_>) -> usize {
        /// The ways into a class, its values, and its place in the open list.
        const CLASS_BYTES: usize = 256;
        KnownCosts::bytes_for(n_classes, problem.demonstration.len()).saturating_add(n_classes * CLASS_BYTES)
    }

    /// About how much memory it takes at most, in bytes, however far it is solved.
    pub(in crate::mapping) fn most_bytes(max_classes: usize, problem: &Problem<'_>) -> usize {
        /// How often a node is open, at different costs.
        const N_TIMES_OPEN: usize = 2;
        let n_nodes = max_classes.saturating_mul(problem.demonstration.len());
        Self::bytes_for(max_classes, problem)
            .saturating_add(n_nodes.saturating_mul(N_TIMES_OPEN * Open::NODE_BYTES + KnownCosts::NODE_BYTES))
    }

    /// Nothing is closed yet.
    pub(super) fn new(
        abstraction: Arc<Abstraction>,
        projections: &Projections,
        problem: &'p Problem<'p>,
        projected: &'p Projected<'p>,
        mut costs: KnownCosts,
        meter: &mut Meter<'_>,
    ) -> Result<Self, Interrupted> {
        let n_observations = problem.demonstration.len();
        let is_in_group = |position: usize| abstraction.positions.binary_search(&position).is_ok();
        let has_table = |position| projected.columns.iter().any(|column| column.projection.position == position);
        let used: Vec<bool> = projections.attributes.iter().map(|own| has_table(own.position)).collect();
        let (mut columns, mut numbers, mut width) = (Vec::new(), Vec::new(), 0);
        let (mut least_rest, mut least_all) = (0.0, 0.0);
        for (number, column) in projected.columns.iter().enumerate() {
            let position = column.projection.position;
            let of_start = |row: &[u32]| projected.table.at(column.offset + row[position] as usize, 0);
            let starts = problem.starts.iter(problem.model).map(|(_, row)| of_start(row));
            let least = starts.map(|start| start.distance + start.cost_to_go).fold(f64::INFINITY, f64::min);
            least_all += least;
            if is_in_group(position) {
                columns.push(GroupColumn { position, offset: column.offset, first: width });
                numbers.push(number);
                width += column.projection.n_values;
            } else {
                least_rest += least;
            }
        }
        let mut from_start = vec![0.0; n_observations * width];
        let mut terms = from_start.clone();
        let mut least_terms = vec![0.0; n_observations];
        for (own, number) in columns.iter().zip(numbers) {
            let ways = SharedWays::new(projections, projected.columns[number].projection, problem, &used);
            let cost = CostFromStart { problem, projected, number, ways: &ways };
            let tell = |value: usize, i: usize, cost: f64| {
                let at = i * width + own.first + value;
                from_start[at] = cost;
                terms[at] = projected.table.at(own.offset + value, i).distance;
            };
            forward::solve(&cost, tell, meter)?;
            for (i, least) in least_terms.iter_mut().enumerate() {
                *least += projected.least_terms[i * projected.columns.len() + number];
            }
        }
        // As their own projections have it, the attributes that a transition changes, of those with tables, pay the same of it. What none of
        // these pays, the group does.
        let part = |set: &Vec<u16>| {
            let sharing = set.iter().map(|number| usize::from(*number)).filter(|number| used[*number]);
            let (n_own, n) = sharing.fold((0_u32, 0_u32), |(n_own, n), number| {
                (n_own + u32::from(is_in_group(projections.attributes[number].position)), n + 1)
            });
            if n == 0 { 1.0 } else { f64::from(n_own) / f64::from(n) }
        };
        let parts: Vec<f64> = abstraction.change_sets.iter().map(part).collect();
        let kind_cost = |kind: &WayKind| {
            let part = parts[kind.change_set as usize];
            WayCost { cost: problem.body.cost(kind.action, Some(&kind.own_cost)) * part, part }
        };
        let kinds: Vec<WayCost> = abstraction.kinds.iter().map(kind_cost).collect();
        let positions = &abstraction.positions;
        let places = columns.iter().map(|own| (positions.binary_search(&own.position).unwrap_or_default(), own.first));
        let places: Vec<(usize, usize)> = places.collect();
        let mut values = Vec::with_capacity(abstraction.n_classes() * columns.len());
        for of_class in abstraction.values.chunks(positions.len()) {
            #[expect(clippy::cast_possible_truncation, reason = "values are counted in u32")]
            values.extend(places.iter().map(|(place, first)| *first as u32 + of_class[*place]));
        }
        costs.prepare(abstraction.n_classes(), n_observations);
        // Where single attributes cost nothing, what the cheapest action costs tells what matters.
        let costs_of_ways = kinds.iter().map(|kind| kind.cost).filter(|cost| *cost > 0.0 && cost.is_finite());
        let least = if least_all > 0.0 { Some(least_all) } else { costs_of_ways.reduce(f64::min) };
        let mut new = Self {
            open: Open::new(least.unwrap_or(f64::MIN_POSITIVE)),
            abstraction,
            problem,
            projected,
            columns,
            values,
            width,
            from_start,
            terms,
            kinds,
            costs,
            least_terms,
            least_rest,
            least_f: 0.0,
        };
        new.begin(meter)?;
        Ok(new)
    }

    /// Opens the end: every class at the last observation, but for those that no start leads to, as no action changes some attribute.
    fn begin(&mut self, meter: &mut Meter<'_>) -> Result<(), Interrupted> {
        let last = self.problem.last();
        let abstraction = Arc::clone(&self.abstraction);
        for (class, values) in abstraction.values.chunks(abstraction.positions.len()).enumerate() {
            meter.spend_or_stop(1)?;
            let cost = self.problem.end.as_ref().map_or(0.0, |end| {
                let values = abstraction.positions.iter().zip(values);
                values.fold(0.0, |sum, (position, value)| sum + end.term(*position, *value))
            });
            if self.cost_from_start(class, last).is_finite() {
                self.take(class, last, cost);
            }
        }
        self.least_f = self.open.advance();
        Ok(())
    }

    /// Where the values of a class are.
    #[inline]
    fn values(&self, class: usize) -> &[u32] {
        let n_columns = self.columns.len();
        &self.values[class * n_columns..][..n_columns]
    }

    /// `G`.
    #[inline]
    fn cost_from_start(&self, class: usize, i: usize) -> f64 {
        let from_start = &self.from_start[i * self.width..][..self.width];
        self.values(class).iter().fold(0.0, |sum, value| sum + from_start[*value as usize])
    }

    /// What the group pays of the distance.
    #[inline]
    fn distance(&self, class: usize, i: usize) -> f64 {
        let terms = &self.terms[i * self.width..][..self.width];
        self.values(class).iter().fold(0.0, |sum, value| sum + terms[*value as usize])
    }

    /// `H`, if the node is closed.
    #[inline]
    pub(super) fn closed_cost(&self, class: usize, i: usize) -> Option<f64> {
        let cost = self.costs.at(self.costs.number_of(class, i));
        cost.is_sign_positive().then_some(cost)
    }

    /// Takes a cheaper way from a node to the end.
    #[expect(clippy::inline_always, reason = "it is what the backward search does most")]
    #[inline(always)]
    fn take(&mut self, class: usize, i: usize, cost: f64) {
        let node = self.costs.number_of(class, i);
        if self.costs.lower(node, cost) {
            self.open.push(self.least_rest + cost + self.cost_from_start(class, i), node);
        }
    }

    /// What moves to a closed node cost, with what it costs to go on from there.
    #[inline]
    fn moves_to(&self, class: usize, i: usize, cost_to_go: f64) -> MovesTo {
        let (recurrence, distance) = (self.problem.recurrence(), self.distance(class, i));
        MovesTo {
            advanced: recurrence.go_on(MoveKind::Match, distance, cost_to_go),
            // By rounding, what is above the least may be below 0.
            lingered: recurrence.go_on(MoveKind::Extra, (distance - self.least_terms[i]).max(0.0), cost_to_go),
            least_paid: recurrence.paid(MoveKind::Extra, self.projected.least_distances[i]),
        }
    }

    /// Closes the nodes of the least `f`.
    fn expand_bucket(&mut self, meter: &mut Meter<'_>) -> Result<(), Interrupted> {
        let last = self.problem.last();
        let abstraction = Arc::clone(&self.abstraction);
        // If extra actions pay nothing, a skip after one costs what a match does.
        let needs_matches = self.problem.recurrence().paid(MoveKind::Extra, 1.0) > 0.0;
        while let Some(node) = self.open.pop() {
            let (class, i) = self.costs.node_of(node);
            let known = self.costs.at(node);
            if known.is_sign_positive() {
                continue;
            }
            let ways = abstraction.ways.of(class);
            meter.spend_or_stop(1 + ways.len() as u64)?;
            self.costs.close(node);
            let moves = self.moves_to(class, i, -known);
            if let Some(before) = i.checked_sub(1) {
                self.take(class, before, moves.advanced);
                if needs_matches {
                    for way in ways {
                        self.take(way.from as usize, before, moves.matched(self.kinds[way.kind as usize]));
                    }
                }
            }
            if i < last || self.problem.end.is_some() {
                for way in ways {
                    self.take(way.from as usize, i, moves.extra(self.kinds[way.kind as usize]));
                }
            }
        }
        self.least_f = self.open.advance();
        Ok(())
    }

    /// Makes the estimate for a state at an observation exact, as far as classes tell; or, if that would take longer, shows that no mapping
    /// through it costs as little as `f`. Says whether it is exact.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(in crate::mapping) fn settle(
        &mut self,
        state: StateIdx,
        i: usize,
        f: f64,
        meter: &mut Meter<'_>,
    ) -> Result<bool, Interrupted> {
        /// So much more at once, so that not every node is looked at again for every bucket.
        const AHEAD: f64 = 1.0 / 64.0;
        let (class, f) = (self.abstraction.classes[state as usize] as usize, f * (1.0 + AHEAD));
        while self.closed_cost(class, i).is_none() && self.least_f <= f && !self.open.is_empty() {
            self.expand_bucket(meter)?;
        }
        Ok(self.closed_cost(class, i).is_some())
    }

    /// By what an estimate for a state at an observation rises: what the group costs above the sum of what its attributes cost alone.
    pub(in crate::mapping) fn rise(&self, state: StateIdx, i: usize) -> f64 {
        let class = self.abstraction.classes[state as usize] as usize;
        let values = self.columns.iter().zip(self.values(class));
        let alone = values.fold(0.0, |sum, (own, value)| {
            sum + self.projected.table.at(own.offset + *value as usize - own.first, i).cost_to_go
        });
        let at_least = || self.least_f - self.least_rest - self.cost_from_start(class, i);
        (self.closed_cost(class, i).unwrap_or_else(at_least) - alone).max(0.0)
    }

    /// What was known, to be used again.
    pub(in crate::mapping) fn into_costs(self) -> KnownCosts {
        self.costs
    }

    /// How much memory it takes, in bytes.
    pub(in crate::mapping) fn size_bytes(&self) -> usize {
        self.costs.size_bytes()
            + size_of_val(self.from_start.as_slice())
            + size_of_val(self.terms.as_slice())
            + size_of_val(self.values.as_slice())
            + size_of_val(self.least_terms.as_slice())
            + self.open.size_bytes()
    }
}

/// What moves to a node cost.
#[derive(Clone, Copy, Debug)]
struct MovesTo {
    /// Without an action, from the observation before.
    advanced: f64,
    /// By an extra action, without what the action costs and the group's part of `least_paid`.
    lingered: f64,
    least_paid: f64,
}

impl MovesTo {
    #[inline]
    fn matched(self, way: WayCost) -> f64 {
        way.cost + self.advanced
    }

    #[inline]
    fn extra(self, way: WayCost) -> f64 {
        way.cost + way.part * self.least_paid + self.lingered
    }
}
