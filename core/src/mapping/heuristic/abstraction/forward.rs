//! What it costs at least to come to a value of an attribute, by its projection alone.

use std::collections::BinaryHeap;

use crate::interrupt::{Interrupted, Meter};
use crate::mapping::heuristic::projected::{Column, Projected};
use crate::mapping::heuristic::shares::SharedWays;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::{MoveKind, Problem};
use crate::model::Rows;

/// What is asked for.
pub(super) struct CostFromStart<'s> {
    pub(super) problem: &'s Problem<'s>,
    pub(super) projected: &'s Projected<'s>,
    /// The number of the attribute's column.
    pub(super) number: usize,
    /// The ways into each of its values.
    pub(super) ways: &'s SharedWays,
}

/// Tells, by value and observation, the least cost of a way from the starts, with the node's distance; infinity where there is none. As the
/// [tables](Projected) do backwards: with `N_i(v)` for what it costs to be next at the value v, without its distance,
///
/// ```text
/// G_i(v) = min( N_i(v) + term(i, v),                            start, skip, match
///               G_i(v') + share_i(v', v) + rest(i, v) )         extra
/// ```
pub(super) fn solve(
    asked: &CostFromStart<'_>,
    mut tell: impl FnMut(usize, usize, f64),
    meter: &mut Meter<'_>,
) -> Result<(), Interrupted> {
    let CostFromStart { problem, projected, number, ways } = asked;
    let Column { projection, offset, .. } = projected.columns[*number];
    let (n_values, recurrence) = (projection.n_values, problem.recurrence());
    let entries = (0..n_values).flat_map(|to| ways.leading_to(to).iter().map(move |way| (way.from, (to, *way))));
    let ways_out = Rows::of_entries(n_values, entries);
    let mut here = vec![f64::INFINITY; n_values];
    let mut next = here.clone();
    for (_, row) in problem.starts.iter(problem.model) {
        next[row[projection.position] as usize] = 0.0;
    }
    let mut open: BinaryHeap<CheapestFirst> = BinaryHeap::new();
    for i in 0..=problem.last() {
        meter.spend_or_stop(n_values as u64)?;
        let term = |value: usize| projected.table.at(offset + value, i).distance;
        for (value, (here, next)) in here.iter_mut().zip(&next).enumerate() {
            *here = recurrence.arrive(MoveKind::Match, *next, term(value));
        }
        let least = projected.least_terms[i * projected.columns.len() + number];
        let least_paid = recurrence.paid(MoveKind::Extra, projected.least_distances[i]);
        let relax = |from: usize, here: &mut [f64], open: &mut BinaryHeap<CheapestFirst>| {
            for (to, way) in ways_out.of(from) {
                let before = here[from] + way.of_extra(least_paid);
                let extra = recurrence.arrive(MoveKind::Extra, before, term(*to) - least);
                if extra < here[*to] {
                    here[*to] = extra;
                    #[expect(clippy::cast_possible_truncation, reason = "values are counted in u32")]
                    open.push(CheapestFirst { cost: extra, id: *to as u32 });
                }
            }
        };
        for value in 0..n_values {
            relax(value, &mut here, &mut open);
        }
        while let Some(CheapestFirst { cost, id }) = open.pop() {
            meter.spend_or_stop(1)?;
            if cost <= here[id as usize] {
                relax(id as usize, &mut here, &mut open);
            }
        }
        next.clone_from(&here);
        for (value, next) in next.iter_mut().enumerate() {
            tell(value, i, here[value]);
            for way in ways.leading_to(value) {
                *next = next.min(here[way.from as usize] + way.share);
            }
        }
    }
    Ok(())
}
