//! What is done when the budget of a search runs out: the rest of the demonstration is followed greedily.

use super::Problem;
use super::heuristic::Heuristic;
use super::search::{Move, MoveKind, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::model::{Space, StateIdx};

/// Whether a completion may act without advancing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extras {
    Allowed,
    Avoided,
}

/// Most extra actions under one observation; a body that needs more is not worth following greedily.
const MAX_EXTRAS: usize = 64;

/// Work that completions may do after an interrupt said to finish, in looked-up distances: tens of milliseconds with a few attributes. That
/// is enough for most demonstrations; the rest of a longer one is skipped.
pub(super) const GRACE: u64 = 1 << 20;

/// What completions may still spend, all of those of a search together.
pub(super) struct Allowance<'i> {
    meter: Meter<'i>,
    grace_left: u64,
    is_over: bool,
}

impl<'i> Allowance<'i> {
    pub(super) fn new(interrupt: &'i mut dyn Interrupt) -> Self {
        Self { meter: Meter::new(interrupt, POLL_EVERY), grace_left: GRACE, is_over: false }
    }

    /// Counts `units` of work that are about to be done. Says whether they may be.
    fn spend(&mut self, units: u64) -> Result<bool, Cancelled> {
        match self.meter.spend(units) {
            Signal::Cancel => return Err(Cancelled),
            Signal::Finish => self.is_over = true,
            Signal::Continue => {}
        }
        if self.is_over {
            self.grace_left = self.grace_left.saturating_sub(units);
        }
        Ok(self.grace_left > 0)
    }
}

/// Extends `path` to the last observation, each time by the move of least cost plus estimate; where `allowance` is used
/// up, by skipping on. There, extra actions may follow that save more of what ending costs. Takes `O(n_observations * (1 + extras))` looks at a state's successors.
///
/// # Errors
///
/// [`Cancelled`] if the interrupt of `allowance` said so.
pub(super) fn complete<S: Space, H: Heuristic>(
    problem: &Problem<'_>,
    space: &mut S,
    heuristic: &H,
    extras: Extras,
    mut path: Vec<Move>,
    allowance: &mut Allowance<'_>,
) -> Result<Vec<Move>, Cancelled> {
    let Some(end) = path.last().copied() else { return Ok(path) };
    let (mut i, mut state) = (end.observation as usize, end.state);
    let mut seen = vec![state];
    let may_linger = |seen: &[StateIdx]| extras == Extras::Allowed && seen.len() <= MAX_EXTRAS;
    while i < problem.last() || (problem.end.is_some() && may_linger(&seen)) {
        space.explore(state);
        let n_looks = 1 + 2 * space.successors(state).len() as u64;
        if !allowance.spend(n_looks * heuristic.work(i))? {
            let skipped = i + 1..=problem.last();
            path.extend(skipped.map(|i| skip_to(i, state)));
            break;
        }
        let seen_here = may_linger(&seen).then_some(seen.as_slice());
        let Some(step) = best_move(problem, space, heuristic, i, state, seen_here) else { break };
        i = step.observation as usize;
        state = step.state;
        if step.kind != MoveKind::Extra {
            seen.clear();
        }
        seen.push(state);
        path.push(step);
    }
    Ok(path)
}

fn skip_to(i: usize, state: StateIdx) -> Move {
    #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
    let observation = i as u32;
    Move { kind: MoveKind::Skip, action: None, observation, state }
}

/// The move out of `(i, state)` of least cost plus estimate, the first found among equals; `None` if it is best to end there. Extra actions
/// are looked at if `seen` is given, and may not lead to the states in it.
fn best_move<S: Space, H: Heuristic>(
    problem: &Problem<'_>,
    space: &S,
    heuristic: &H,
    i: usize,
    state: StateIdx,
    seen: Option<&[StateIdx]>,
) -> Option<Move> {
    let recurrence = problem.recurrence();
    let estimate = |kind: MoveKind, i: usize, state, cost: f64| {
        let row = space.row(state);
        // The cost of ending here, as an estimate may say that an action saves some of it that does not.
        let to_go = if i < problem.last() { heuristic.cost_to_go(i, row) } else { problem.end_cost(row) };
        recurrence.arrive(kind, cost, problem.distances.distance(i, row)) + to_go
    };
    #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
    let step = |kind, action, i: usize, state| Move { kind, action: Some(action), observation: i as u32, state };

    let may_advance = i < problem.last();
    let mut best = if may_advance {
        (estimate(MoveKind::Skip, i + 1, state, 0.0), Some(skip_to(i + 1, state)))
    } else {
        (problem.end_cost(space.row(state)), None)
    };
    for (transition, cost) in problem.body.ways(space, state) {
        let (action, to) = (transition.action, transition.to);
        if may_advance {
            let advanced = estimate(MoveKind::Match, i + 1, to, cost);
            if advanced < best.0 {
                best = (advanced, Some(step(MoveKind::Match, action, i + 1, to)));
            }
        }
        if seen.is_some_and(|seen| !seen.contains(&to)) {
            let lingered = estimate(MoveKind::Extra, i, to, cost);
            if lingered < best.0 {
                best = (lingered, Some(step(MoveKind::Extra, action, i, to)));
            }
        }
    }
    best.1
}
