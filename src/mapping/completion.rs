//! What is done when the budget of a search runs out: the rest of the demonstration is followed greedily.

use super::Problem;
use super::heuristic::Heuristic;
use super::search::{Move, MoveKind};
use crate::model::StateIdx;

/// Whether a completion may act without advancing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extras {
    Allowed,
    Avoided,
}

/// Most extra actions under one observation; a body that needs more is not worth following greedily.
const MAX_EXTRAS: usize = 64;

/// Extends `path` to the last observation, each time by the move of least cost plus estimate. Takes
/// `O(n_observations * (1 + extras))` looks at a state's successors.
pub(super) fn complete<H: Heuristic>(
    problem: &Problem<'_>,
    heuristic: &H,
    extras: Extras,
    mut path: Vec<Move>,
) -> Vec<Move> {
    let Some(end) = path.last().copied() else { return path };
    let (mut i, mut state) = (end.observation as usize, end.state);
    let mut seen = vec![state];
    while i < problem.last() {
        let may_linger = extras == Extras::Allowed && seen.len() <= MAX_EXTRAS;
        let (step, next) = best_move(problem, heuristic, i, state, may_linger.then_some(&seen));
        i = next;
        state = step.state;
        if step.kind != MoveKind::Extra {
            seen.clear();
        }
        seen.push(state);
        path.push(step);
    }
    path
}

/// The move out of `(i, state)` of least cost plus estimate, the first found among equals, and the observation it leads
/// to. Extra actions are looked at if `seen` is given, and may not lead to the states in it.
fn best_move<H: Heuristic>(
    problem: &Problem<'_>,
    heuristic: &H,
    i: usize,
    state: StateIdx,
    seen: Option<&Vec<StateIdx>>,
) -> (Move, usize) {
    let distance = |i: usize, state| problem.distances.distance(i, state);
    let estimate = |i: usize, state, cost: f64| cost + distance(i, state) + heuristic.cost_to_go(i, state);
    #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
    let step = |kind, action, i: usize, state| Move { kind, action, observation: i as u32, state };

    let mut best = (estimate(i + 1, state, 0.0), step(MoveKind::Skip, None, i + 1, state), i + 1);
    for transition in problem.model.graph().successors(state) {
        let (action, to) = (transition.action, transition.to);
        let cost = problem.model.action(action).cost;
        let advanced = estimate(i + 1, to, cost);
        if advanced < best.0 {
            best = (advanced, step(MoveKind::Match, Some(action), i + 1, to), i + 1);
        }
        if seen.is_some_and(|seen| !seen.contains(&to)) {
            let lingered = estimate(i, to, cost);
            if lingered < best.0 {
                best = (lingered, step(MoveKind::Extra, Some(action), i, to), i);
            }
        }
    }
    (best.1, best.2)
}
