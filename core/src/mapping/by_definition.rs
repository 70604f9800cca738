//! What mappings cost by definition, written to be read, for tests to hold searches and estimates against.

use super::Problem;
use crate::model::StateIdx;

/// `D(o_i, s)`.
pub(super) fn distance(problem: &Problem<'_>, i: usize, state: StateIdx) -> f64 {
    problem.distances.distance(i, problem.model.states().row(state))
}

/// The moves out of a node, with what they cost.
pub(super) fn moves(problem: &Problem<'_>, i: usize, state: StateIdx) -> Vec<(usize, StateIdx, f64)> {
    let mut moves = vec![(i + 1, state, 0.0)];
    for transition in problem.model.graph().successors(state) {
        let cost = problem.model.action(transition.action).cost;
        moves.extend([(i + 1, transition.to, cost), (i, transition.to, cost)]);
    }
    moves.retain(|(i, _, _)| *i <= problem.last());
    moves.into_iter().map(|(i, state, cost)| (i, state, cost + distance(problem, i, state))).collect()
}

/// Every observation with every state.
pub(super) fn nodes(problem: &Problem<'_>) -> Vec<(usize, StateIdx)> {
    (0..=problem.last()).flat_map(|i| (0..problem.model.states().len()).map(move |state| (i, state))).collect()
}

/// Least costs of all nodes, from the start and to the end, by going over all moves until nothing changes.
pub(super) fn least_costs(problem: &Problem<'_>) -> [Vec<Vec<f64>>; 2] {
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
