//! Under which conditions a demonstration is followed, besides the weights of attributes.

use serde::{Deserialize, Serialize};

use super::recurrence::Recurrence;
use crate::model::{ActionIdx, Model, Origin, OwnCost, Space, StateIdx, Transition};

/// What a mapping may start from, what it pays besides the weights of attributes, and what the body lacks. By default: the model's start,
/// the paper's costs, and the model's body.
///
/// As it is stored, states and actions are numbers of the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Conditions {
    /// The start states; `None`: those of the model. Not empty.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub starts: Option<Vec<Origin>>,
    /// The weights of the observations, `e_i`: finite, at least 0. Those past the last one are 1.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub observation_weights: Vec<f64>,
    /// The part of the distance that an extra action pays, `x`: 0 to 1.
    pub extra_weight: f64,
    /// The weight with which the distance between the last state and the last observation is paid once more: finite, at least 0.
    pub end_weight: f64,
    /// The actions that the body lacks.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub without: Vec<ActionIdx>,
    /// Actions that cost this instead: finite, at least 0.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub action_costs: Vec<(ActionIdx, f64)>,
    /// If there: observations are dropped that stay within this of the last one kept, by positions of attributes, and are equal to it in all
    /// other attributes. Their weights are lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub collapse: Option<Vec<(usize, f64)>>,
}

impl Default for Conditions {
    fn default() -> Self {
        Self {
            starts: None,
            observation_weights: Vec::new(),
            extra_weight: Self::DEFAULT_EXTRA_WEIGHT,
            end_weight: Self::DEFAULT_END_WEIGHT,
            without: Vec::new(),
            action_costs: Vec::new(),
            collapse: None,
        }
    }
}

impl Conditions {
    /// Extra actions pay the whole distance.
    pub const DEFAULT_EXTRA_WEIGHT: f64 = 1.0;
    /// The end is free.
    pub const DEFAULT_END_WEIGHT: f64 = 0.0;

    /// Whether they are the default.
    #[must_use]
    pub fn are_default(&self) -> bool {
        *self == Self::default()
    }

    /// The model's, but with this start.
    #[must_use]
    pub fn starting_at(start: Origin) -> Self {
        Self { starts: Some(vec![start]), ..Self::default() }
    }

    /// The weight of the observation at `index`.
    #[must_use]
    pub fn observation_weight(&self, index: usize) -> f64 {
        self.observation_weights.get(index).copied().unwrap_or(1.0)
    }

    /// These conditions with the weights that are `told` of `n_observations`; for the others they stay as they are.
    #[must_use]
    pub fn with_observation_weights(mut self, told: &[Option<f64>], n_observations: usize) -> Self {
        if told.iter().any(Option::is_some) {
            let told = |i: usize| told.get(i).copied().flatten();
            let weights = (0..n_observations).map(|i| told(i).unwrap_or_else(|| self.observation_weight(i)));
            let weights = weights.collect();
            self.observation_weights = weights;
        }
        self
    }

    /// Whether all states and actions that they name are in `model`.
    #[must_use]
    pub fn fit(&self, model: &Model) -> bool {
        let has_state = |origin: &Origin| match origin {
            Origin::State(state) => *state < model.states().len(),
            Origin::Row(_) => model.is_lazy(),
        };
        let has_action = |action: &ActionIdx| usize::from(*action) < model.actions().len();
        self.starts.iter().flatten().all(has_state)
            && self.without.iter().all(has_action)
            && self.action_costs.iter().map(|(action, _)| action).all(has_action)
            && self.collapse.iter().flatten().all(|(position, _)| *position < model.schema().len())
    }

    /// These conditions for the observations with these numbers alone.
    pub(super) fn of_kept(&self, numbers: &[u32]) -> Self {
        let weights = match self.observation_weights.as_slice() {
            [] => Vec::new(),
            _ => numbers.iter().map(|number| self.observation_weight(*number as usize)).collect(),
        };
        Self { observation_weights: weights, ..self.clone() }
    }

    pub(super) fn recurrence(&self) -> Recurrence {
        Recurrence { extra_weight: self.extra_weight }
    }

    /// The body that is left of the model's.
    pub(super) fn body(&self, model: &Model) -> Body {
        let mut costs: Vec<f64> = model.actions().iter().map(|action| action.cost).collect();
        for (action, cost) in &self.action_costs {
            costs[usize::from(*action)] = *cost;
        }
        for action in &self.without {
            costs[usize::from(*action)] = f64::INFINITY;
        }
        Body(costs)
    }
}

/// What the body's actions cost, unless a transition has its own cost. Those that it lacks cost infinitely much, so that no way takes them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Body(Vec<f64>);

impl Body {
    /// What an action costs, in a transition with this cost of its own, if any.
    #[inline]
    pub(super) fn cost(&self, action: ActionIdx, own: Option<&OwnCost>) -> f64 {
        let cost = self.0[usize::from(action)];
        match own {
            Some(own) if cost.is_finite() => own.or(cost),
            _ => cost,
        }
    }

    /// The transitions that the body can make from a state, which was explored, with what each costs.
    #[inline]
    pub(super) fn ways<'s>(
        &'s self,
        space: &'s impl Space,
        state: StateIdx,
    ) -> impl Iterator<Item = (&'s Transition, f64)> + Clone {
        let own = space.own_costs(state);
        let costed = space.successors(state).iter().enumerate();
        costed.map(move |(n, way)| (way, self.cost(way.action, own.get(n)))).filter(|(_, cost)| cost.is_finite())
    }

    /// What it costs to go from one state to another by this action: the cheapest, if several lead there.
    pub(super) fn step_cost(&self, space: &impl Space, from: StateIdx, action: ActionIdx, to: StateIdx) -> f64 {
        if space.own_costs(from).is_empty() {
            return self.cost(action, None);
        }
        let ways = self.ways(space, from).filter(|(way, _)| way.action == action && way.to == to);
        ways.map(|(_, cost)| cost).fold(f64::INFINITY, f64::min)
    }

    /// Whether the body has an action.
    #[inline]
    pub(super) fn has(&self, action: ActionIdx) -> bool {
        self.0[usize::from(action)].is_finite()
    }

    /// The least cost of an action; 0 if the body has none.
    pub(super) fn least_cost(&self) -> f64 {
        self.0.iter().copied().filter(|cost| cost.is_finite()).reduce(f64::min).unwrap_or(0.0)
    }
}
