//! What tests share: how they make problems, and what mappings cost by definition, written to be read, for searches and estimates to be
//! held against.

use proptest::prelude::*;
use serde_json::{Value, json};

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

/// Conditions of a request in its own words: starts and actions by numbers to be made to fit, weights, and own costs of some transitions.
#[derive(Clone, Debug)]
pub(super) struct AnyConditions {
    starts: Option<Vec<usize>>,
    observation_weights: Vec<f64>,
    extra_weight: f64,
    end_weight: f64,
    without: Option<usize>,
    action_cost: Option<(usize, f64)>,
}

/// Any conditions: in half of the cases the default of each.
pub(super) fn any_conditions() -> impl Strategy<Value = AnyConditions> {
    let weight = || prop_oneof![2 => Just(1.0), 1 => Just(0.0), 1 => 0.0..3.0];
    (
        prop::option::of(prop::collection::vec(0usize..20, 1..4)),
        prop_oneof![Just(Vec::new()), prop::collection::vec(weight(), 20)],
        prop_oneof![2 => Just(1.0), 1 => Just(0.0), 1 => 0.0..1.0],
        prop_oneof![2 => Just(0.0), 1 => Just(10.0), 1 => 0.0..3.0],
        prop::option::weighted(0.3, 0usize..9),
        prop::option::weighted(0.3, (0usize..9, 0.0..3.0)),
    )
        .prop_map(|(starts, observation_weights, extra_weight, end_weight, without, action_cost)| AnyConditions {
            starts,
            observation_weights,
            extra_weight,
            end_weight,
            without,
            action_cost,
        })
}

/// The request under these conditions.
pub(super) fn with_conditions(mut request: Value, model: &Value, conditions: &AnyConditions) -> Value {
    let count = |value: &Value| value.as_array().map_or(0, Vec::len);
    let n_observations = count(&request["demonstration"]);
    let (n_states, actions) = (count(&model["dynamics"]["states"]), &model["actions"]);
    if let Some(starts) = &conditions.starts {
        request["start"] = starts.iter().map(|start| json!(start % n_states)).collect();
    }
    if !conditions.observation_weights.is_empty() {
        request["observation_weights"] = json!(conditions.observation_weights[..n_observations]);
    }
    request["extra_weight"] = json!(conditions.extra_weight);
    request["end_weight"] = json!(conditions.end_weight);
    let name = |action: usize| actions[action % count(actions)]["name"].as_str().unwrap().to_owned();
    if let Some(action) = conditions.without {
        request["without"] = json!([name(action)]);
    }
    if let Some((action, cost)) = conditions.action_cost {
        request["action_costs"] = json!({name(action): cost});
    }
    request
}

/// `e_i D(o_i, s)`.
pub(super) fn distance(problem: &Problem<'_>, i: usize, state: StateIdx) -> f64 {
    problem.distances.distance(i, problem.model.states().row(state))
}

/// The moves out of a node, with what they cost.
pub(super) fn moves(problem: &Problem<'_>, i: usize, state: StateIdx) -> Vec<(usize, StateIdx, f64)> {
    let mut moves = vec![(i + 1, state, 0.0, 1.0)];
    for (action, outcome) in problem.model.outcomes(state) {
        if problem.conditions.without.contains(&action) {
            continue;
        }
        let of_request = problem.conditions.action_costs.iter().find(|(other, _)| *other == action);
        let of_action = of_request.map_or(problem.model.action(action).cost, |(_, cost)| *cost);
        let cost = outcome.cost.unwrap_or(of_action);
        moves.extend([(i + 1, outcome.to, cost, 1.0), (i, outcome.to, cost, problem.conditions.extra_weight)]);
    }
    moves.retain(|(i, ..)| *i <= problem.last());
    moves.into_iter().map(|(i, state, cost, part)| (i, state, cost + part * distance(problem, i, state))).collect()
}

/// What ending in a state costs.
fn end(problem: &Problem<'_>, state: StateIdx) -> f64 {
    let (schema, states) = (problem.model.schema(), problem.model.states());
    let seen = problem.demonstration.observation(problem.last()).iter().zip(states.values(state));
    let weighted = schema.attributes().iter().zip(problem.weights.as_slice()).zip(seen);
    let terms = weighted.map(|((attribute, weight), (seen, own))| {
        seen.as_ref().map_or(0.0, |seen| weight * attribute.delta(seen, own).powi(2))
    });
    problem.conditions.end_weight * terms.sum::<f64>()
}

/// What the cheapest mapping costs, given the least costs from the start.
pub(super) fn optimum(problem: &Problem<'_>, from_start: &[Vec<f64>]) -> f64 {
    let costs = (0..).zip(&from_start[problem.last()]).map(|(state, cost)| cost + end(problem, state));
    costs.fold(f64::INFINITY, f64::min)
}

/// Every observation with every state.
pub(super) fn nodes(problem: &Problem<'_>) -> Vec<(usize, StateIdx)> {
    (0..=problem.last()).flat_map(|i| (0..problem.model.states().len()).map(move |state| (i, state))).collect()
}

/// Least costs of all nodes, from the start and to the end, by going over all moves until nothing changes.
pub(super) fn least_costs(problem: &Problem<'_>) -> [Vec<Vec<f64>>; 2] {
    let unknown = vec![vec![f64::INFINITY; problem.model.states().len() as usize]; problem.last() + 1];
    let (mut from_start, mut to_end) = (unknown.clone(), unknown);
    for start in problem.starts.states() {
        from_start[0][*start as usize] = distance(problem, 0, *start);
    }
    (0..).zip(&mut to_end[problem.last()]).for_each(|(state, to_end)| *to_end = end(problem, state));
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
