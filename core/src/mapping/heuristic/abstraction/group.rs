//! Which attributes are projected together.

use crate::interrupt::{Interrupted, Meter};
use crate::mapping::Problem;
use crate::model::Model;

/// Pairs of attributes of a listed model of which one changes at few values of the other: at fewer than half of those that it has, counting
/// transitions that keep it. So where one is tells what can be done there.
///
/// # Errors
///
/// What the interrupt of `meter` said, if that was not to continue.
pub(super) fn coupled(model: &Model, meter: &mut Meter<'_>) -> Result<Vec<(usize, usize)>, Interrupted> {
    /// About how many states are looked at, as all of them would take as long as many a search.
    const SAMPLE_LEN: u32 = 1 << 12;
    /// Most pairs of an attribute and a value, which take a byte each.
    const MAX_ENTRIES: usize = 1 << 20;
    let (states, graph) = (model.states(), model.graph());
    let varying = (0..model.schema().len()).filter(|position| states.domain(*position).len() > 1);
    let positions: Vec<usize> = varying.collect();
    // Where the values of each begin.
    let offsets: Vec<usize> = positions
        .iter()
        .scan(0, |end, position| Some(std::mem::replace(end, *end + states.domain(*position).len())))
        .collect();
    let width: usize = positions.iter().map(|position| states.domain(*position).len()).sum();
    if positions.len().saturating_mul(width) > MAX_ENTRIES {
        return Ok(Vec::new());
    }
    // By attribute that changes, the values at which it does of those that do not.
    let mut values = vec![vec![false; width]; positions.len()];
    // No divisor of the sizes that domains mostly have, whose values would be skipped.
    let step = (states.len() / SAMPLE_LEN) | 1;
    for from in (0..states.len()).step_by(step as usize) {
        for transition in graph.successors(from) {
            meter.spend_or_stop(positions.len() as u64)?;
            let (row, row_after) = (states.row(from), states.row(transition.to));
            let is_changed = |at: &usize| row[*at] != row_after[*at];
            for (values, _) in values.iter_mut().zip(&positions).filter(|(_, at)| is_changed(at)) {
                for (at, offset) in positions.iter().zip(&offsets).filter(|(at, _)| !is_changed(at)) {
                    values[offset + row[*at] as usize] = true;
                }
            }
        }
    }
    let mut pairs = Vec::new();
    for (one, values) in positions.iter().zip(&values) {
        meter.spend_or_stop(width as u64)?;
        for (other, offset) in positions.iter().zip(&offsets).filter(|(other, _)| *other != one) {
            let n_values = states.domain(*other).len();
            let n_passed = values[*offset..][..n_values].iter().filter(|is_passed| **is_passed).count();
            if (1..n_values.div_ceil(2)).contains(&n_passed) {
                pairs.push((*one, *other));
            }
        }
    }
    Ok(pairs)
}

/// The attributes that matter to `problem` and are coupled with others that do, ascending.
pub(super) fn of_problem(problem: &Problem<'_>, coupled: &[(usize, usize)]) -> Vec<usize> {
    let matter = coupled.iter().filter(|(one, other)| problem.depends_on(*one) && problem.depends_on(*other));
    let mut positions: Vec<usize> = matter.flat_map(|(one, other)| [*one, *other]).collect();
    positions.sort_unstable();
    positions.dedup();
    positions
}
