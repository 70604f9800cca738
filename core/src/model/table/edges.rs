//! The transitions of a table, by column, and how those of a state and an action come together.

use crate::interrupt::{Interrupted, Meter};
use crate::model::reading::{COLUMNS_BYTES, add_to_column};
use crate::model::{Action, ActionIdx, Outcome, OwnCost, StateIdx, Transition};

/// Transitions in the order of the document, by column: 10 bytes each, and eight more for each of the last two columns if it is there.
#[derive(Clone, Debug, Default)]
pub(in crate::model) struct Edges {
    pub(super) from: Vec<StateIdx>,
    pub(super) action: Vec<ActionIdx>,
    pub(super) to: Vec<StateIdx>,
    /// Above 0, at most 1; empty if all are 1.
    pub(super) probabilities: Vec<f64>,
    /// Empty if no transition has a cost of its own.
    pub(super) own_costs: Vec<OwnCost>,
    /// Of how many states and actions there are several outcomes.
    pub(super) n_stochastic: usize,
}

/// By how much the probabilities of a state and an action may miss 1.
const TOLERANCE: f64 = 1e-9;

/// The transitions of states and actions, each with its number, ordered by all three.
pub(super) type Keys = Vec<(StateIdx, ActionIdx, u32)>;

/// What is wrong with the transitions of a state and an action.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::model) enum Uneven {
    /// Transition `number` has no probability, as little as `before`.
    Twice { number: u32, before: u32 },
    /// From transition `number` on, the probabilities sum to this.
    Sum { number: u32, sum: f64 },
}

impl Edges {
    pub(in crate::model) fn push(&mut self, from: StateIdx, action: ActionIdx, outcome: Outcome<StateIdx>) {
        add_to_column(&mut self.probabilities, self.from.len(), outcome.probability, 1.0, !outcome.is_certain());
        let own_cost = OwnCost::of(outcome.cost);
        add_to_column(&mut self.own_costs, self.from.len(), own_cost, OwnCost::NONE, outcome.cost.is_some());
        self.from.push(from);
        self.action.push(action);
        self.to.push(outcome.to);
    }

    pub(in crate::model) fn len(&self) -> usize {
        self.from.len()
    }

    /// Keeps the transitions of states and actions for which `number` gives the action's new number. Order is kept.
    pub(in crate::model) fn keep(&mut self, number: impl Fn(StateIdx, ActionIdx) -> Option<ActionIdx>) {
        let numbers: Vec<Option<ActionIdx>> =
            self.from.iter().zip(&self.action).map(|(from, action)| number(*from, *action)).collect();
        keep_some(&mut self.from, &numbers);
        keep_some(&mut self.to, &numbers);
        keep_some(&mut self.probabilities, &numbers);
        keep_some(&mut self.own_costs, &numbers);
        self.action = numbers.into_iter().flatten().collect();
    }

    /// Leaves out the costs of their own for which `is_said` holds, as the action's cost says the same.
    pub(in crate::model) fn leave_out_costs(&mut self, is_said: impl Fn(ActionIdx, f64) -> bool) {
        for (own_cost, action) in self.own_costs.iter_mut().zip(&self.action) {
            if own_cost.get().is_some_and(|cost| is_said(*action, cost)) {
                *own_cost = OwnCost::NONE;
            }
        }
        if self.own_costs.iter().all(|own_cost| own_cost.get().is_none()) {
            self.own_costs = Vec::new();
        }
    }

    /// The state that transition `number` leaves, and its action.
    pub(in crate::model) fn pair(&self, number: u32) -> (StateIdx, ActionIdx) {
        (self.from[number as usize], self.action[number as usize])
    }

    /// Whether there are costs or probabilities.
    pub(super) fn has_columns(&self) -> bool {
        !(self.own_costs.is_empty() && self.probabilities.is_empty())
    }

    /// What costs and probabilities take beyond the transitions themselves, once compiled, in bytes.
    pub(super) fn columns_bytes(&self) -> u64 {
        if self.has_columns() { (self.len() * COLUMNS_BYTES) as u64 } else { 0 }
    }

    pub(super) fn probability(&self, n: usize) -> f64 {
        self.probabilities.get(n).copied().unwrap_or(1.0)
    }

    pub(super) fn own_cost(&self, n: usize) -> OwnCost {
        self.own_costs.get(n).copied().unwrap_or(OwnCost::NONE)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (StateIdx, Transition)> + Clone {
        let transitions = self.action.iter().zip(&self.to).map(|(action, to)| Transition { action: *action, to: *to });
        self.from.iter().copied().zip(transitions)
    }

    /// Every transition with its cost and its probability.
    pub(super) fn outcomes(&self) -> impl Iterator<Item = (StateIdx, (Transition, OwnCost, f64))> + Clone {
        let numbered = self.iter().enumerate();
        numbered.map(|(n, (from, transition))| (from, (transition, self.own_cost(n), self.probability(n))))
    }

    /// Puts the transitions of each state and action together: those that lead to the same state add up, and what says nothing new is left
    /// out. Gives what is wrong where they do not make one outcome, or several whose probabilities sum to 1; then they are of no use.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(in crate::model) fn settle(
        &mut self,
        actions: &[Action],
        meter: &mut Meter<'_>,
    ) -> Result<Vec<Uneven>, Interrupted> {
        let key = |n: usize| Some((self.from[n], self.action[n]));
        let Some(keys) = keys_by_pair(self.len(), !self.probabilities.is_empty(), key, meter)? else {
            return Ok(Vec::new());
        };
        let uneven = find_uneven(&keys, &self.probabilities);
        if uneven.is_empty() {
            self.merge(keys, |action| actions[usize::from(action)].cost, meter)?;
        }
        Ok(uneven)
    }

    /// Adds up the transitions to the same state, where nothing is wrong with them.
    pub(super) fn merge(
        &mut self,
        mut keys: Keys,
        action_cost: impl Fn(ActionIdx) -> f64,
        meter: &mut Meter<'_>,
    ) -> Result<(), Interrupted> {
        if self.probabilities.is_empty() {
            return Ok(());
        }
        let mut is_merged = vec![false; self.len()];
        self.n_stochastic = 0;
        let to = std::mem::take(&mut self.to);
        for pair in keys.chunk_by_mut(is_same_pair) {
            meter.spend_or_stop(pair.len() as u64)?;
            pair.sort_unstable_by_key(|(_, _, number)| (to[*number as usize], *number));
            let mut n_outcomes = 0;
            for same in pair.chunk_by(|one, other| to[one.2 as usize] == to[other.2 as usize]) {
                n_outcomes += 1;
                let [(_, action, first), others @ ..] = same else { continue };
                if !others.is_empty() {
                    self.add_up(same, action_cost(*action));
                }
                for (_, _, number) in others {
                    is_merged[*number as usize] = true;
                }
                if same.len() == pair.len() {
                    // By less than the tolerance, perhaps.
                    self.probabilities[*first as usize] = 1.0;
                }
            }
            self.n_stochastic += usize::from(n_outcomes > 1);
        }
        self.to = to;
        retain(&mut self.from, &is_merged);
        retain(&mut self.action, &is_merged);
        retain(&mut self.to, &is_merged);
        retain(&mut self.probabilities, &is_merged);
        retain(&mut self.own_costs, &is_merged);
        if self.n_stochastic == 0 {
            self.probabilities = Vec::new();
        }
        Ok(())
    }

    /// Gives the first of transitions to the same state what they come to together: the sum of their probabilities, and the mean of their
    /// costs by these.
    fn add_up(&mut self, same: &[(StateIdx, ActionIdx, u32)], action_cost: f64) {
        let numbers = || same.iter().map(|(_, _, number)| *number as usize);
        let Some(first) = numbers().next() else { return };
        let sum: f64 = numbers().map(|n| self.probability(n)).sum();
        let costs: Vec<OwnCost> = numbers().map(|n| self.own_cost(n)).collect();
        if costs.iter().any(|cost| cost.get().is_some()) {
            let terms = numbers().zip(&costs).map(|(n, cost)| self.probability(n) * cost.or(action_cost));
            // What costs the same each time costs that.
            let is_same = costs.windows(2).all(|pair| pair[0].or(action_cost) == pair[1].or(action_cost));
            let mean = if is_same { costs[0].or(action_cost) } else { terms.sum::<f64>() / sum };
            self.own_costs[first] = OwnCost::of(Some(mean));
        }
        self.probabilities[first] = sum.min(1.0);
    }
}

fn is_same_pair(one: &(StateIdx, ActionIdx, u32), other: &(StateIdx, ActionIdx, u32)) -> bool {
    (one.0, one.1) == (other.0, other.1)
}

/// Keeps those items of `column`, which may be empty, for which there is something in `kept`.
fn keep_some<T, N>(column: &mut Vec<T>, kept: &[Option<N>]) {
    let mut kept = kept.iter();
    column.retain(|_| kept.next().is_some_and(Option::is_some));
}

fn retain<T>(column: &mut Vec<T>, is_merged: &[bool]) {
    let mut is_merged = is_merged.iter();
    column.retain(|_| is_merged.next() != Some(&true));
}

/// The transitions, ordered by the key that they have, if any: their state and action. `None` if nothing need be known of them: each has a
/// key of its own, and none has a probability.
pub(super) fn keys_by_pair(
    n_transitions: usize,
    are_probable: bool,
    key: impl Fn(usize) -> Option<(StateIdx, ActionIdx)>,
    meter: &mut Meter<'_>,
) -> Result<Option<Keys>, Interrupted> {
    // Most documents list transitions in ascending order, without repetitions.
    let mut last = None;
    let is_ascending = (0..n_transitions).all(|n| {
        let before = std::mem::replace(&mut last, key(n));
        last.is_some() && before < last
    });
    if is_ascending && !are_probable {
        return Ok(None);
    }
    let mut keys = Vec::with_capacity(n_transitions);
    for (n, number) in (0..n_transitions).zip(0..) {
        meter.spend_or_stop(1)?;
        keys.extend(key(n).map(|(from, action)| (from, action, number)));
    }
    keys.sort_unstable();
    Ok(Some(keys))
}

/// What is wrong with the transitions of a state and an action, in the order of their numbers. `probabilities` are empty if all are 1.
pub(super) fn find_uneven(keys: &Keys, probabilities: &[f64]) -> Vec<Uneven> {
    let probability = |number: u32| probabilities.get(number as usize).copied().unwrap_or(1.0);
    let mut uneven: Vec<(u32, Uneven)> = Vec::new();
    for pair in keys.chunk_by(is_same_pair) {
        let sum: f64 = pair.iter().map(|(_, _, number)| probability(*number)).sum();
        if (sum - 1.0).abs() <= TOLERANCE {
            continue;
        }
        if pair.iter().all(|(_, _, number)| probability(*number) >= 1.0) {
            let again = pair.windows(2).map(|two| (two[1].2, Uneven::Twice { number: two[1].2, before: two[0].2 }));
            uneven.extend(again);
        } else {
            let number = pair[0].2;
            uneven.push((number, Uneven::Sum { number, sum }));
        }
    }
    uneven.sort_unstable_by_key(|(number, _)| *number);
    uneven.into_iter().map(|(_, uneven)| uneven).collect()
}
