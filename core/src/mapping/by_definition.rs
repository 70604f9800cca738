//! What tests share: how they make problems, and what mappings cost by definition, written to be read, for searches and estimates to be
//! held against.

use serde_json::Value;

use super::{Mapper, Problem, Request};
use crate::document::{Faults, Place};
use crate::interrupt::Uninterrupted;
use crate::model::{Definition, Limits, Model, StateIdx};

/// The model that a document defines.
pub(super) fn compiled(document: &Value) -> Model {
    let definition = Definition::read(document, Limits::NONE, &mut Uninterrupted).unwrap();
    Model::compile(&definition, Limits::NONE, &mut Uninterrupted).unwrap()
}

/// The model that a document defines, prepared.
pub(super) fn prepared(document: &Value) -> Mapper {
    Mapper::new(compiled(document), &mut Uninterrupted).unwrap()
}

/// The problem of a request.
pub(super) fn problem<'m>(model: &'m Model, request: &Value) -> Problem<'m> {
    let mut faults = Faults::default();
    let object = Place::root(request).object(Request::FIELDS, &mut faults).unwrap();
    Request::read(model, &object, &mut faults).unwrap().problem
}

/// Transitions by state, action and next state, made to fit into `n_states` states and to be one for each state and action.
pub(super) fn fitted(mut transitions: Vec<(usize, usize, usize)>, n_states: usize) -> Vec<(usize, usize, usize)> {
    for (from, _, to) in &mut transitions {
        (*from, *to) = (*from % n_states, *to % n_states);
    }
    transitions.sort_unstable();
    transitions.dedup_by_key(|(from, action, _)| (*from, *action));
    transitions
}

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
