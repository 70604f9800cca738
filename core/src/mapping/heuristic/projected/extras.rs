//! Actions that are taken under the same observation, in projected problems.

use std::collections::BinaryHeap;

use super::Estimate;
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::MoveKind;
use crate::mapping::heuristic::shares::SharedWays;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;

/// How extra actions at an observation are paid.
#[derive(Clone, Copy)]
pub(super) struct Extras {
    /// The least term of the column, which is paid
    pub(super) least: f64,
    /// with those of all others: so much.
    pub(super) least_paid: f64,
}

/// Lets extra actions make the costs-to-go of a column at an observation cheaper.
pub(super) fn settle(
    recurrence: Recurrence,
    predecessors: &SharedWays,
    here: &mut [Estimate],
    Extras { least, least_paid }: Extras,
    open: &mut BinaryHeap<CheapestFirst>,
    meter: &mut Meter<'_>,
) -> Result<(), Interrupted> {
    let linger = |distance: f64, cost: f64| recurrence.go_on(MoveKind::Extra, distance - least, cost);
    for value in 0..here.len() {
        let cost = linger(here[value].distance, here[value].cost_to_go);
        relax(predecessors, value, cost, least_paid, here, open);
    }
    while let Some(CheapestFirst { cost, id: value }) = open.pop() {
        meter.spend_or_stop(1)?;
        let entry = here[value as usize];
        if cost <= entry.cost_to_go {
            relax(predecessors, value as usize, linger(entry.distance, cost), least_paid, here, open);
        }
    }
    Ok(())
}

/// Offers every value an extra action into `value`, which costs `cost` from its arrival on, without `least_paid` of the distance.
#[inline]
fn relax(
    predecessors: &SharedWays,
    value: usize,
    cost: f64,
    least_paid: f64,
    here: &mut [Estimate],
    open: &mut BinaryHeap<CheapestFirst>,
) {
    for way in predecessors.leading_to(value) {
        let extra = way.of_extra(least_paid) + cost;
        let known = &mut here[way.from as usize].cost_to_go;
        if extra < *known {
            *known = extra;
            open.push(CheapestFirst { cost: extra, id: way.from });
        }
    }
}
