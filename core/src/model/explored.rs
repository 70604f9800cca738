//! The part of an implicit graph that was found so far.
//!
//! ```text
//! search --Space--> Explored { found: rows, transitions }     read at every step, the same for all dynamics
//!                        |
//!                        +--Frontier--> NumberedStates<D>  called once per state: its successors, and their numbers
//! ```
//!
//! Searches are compiled once for all dynamics, whatever the type of their states. What depends on that type stands behind
//! [`Frontier`], which is called once for each state that is explored, not for each successor.

use std::fmt::Debug;

use rustc_hash::FxHashMap;

use super::{Graph, Implicit, Operator, OwnCost, Space, StateIdx, States, Transition, make_room};
use crate::interrupt::{Interrupted, Meter};

/// The states that were found, numbered in the order in which they were, and the transitions from those that were explored.
///
/// Actions without effect are no transitions, and neither are those into unsafe states.
#[derive(Debug)]
pub(crate) struct Explored<'d> {
    found: Found,
    frontier: Box<dyn Frontier + 'd>,
}

/// What is known of the states that were found.
#[derive(Debug)]
struct Found {
    states: States,
    /// Where the transitions from each state are; [`UNEXPLORED`] where they are not known yet. Shape `[n_states]`.
    bounds: Vec<(u32, u32)>,
    transitions: Vec<Transition>,
    /// One for each of the first transitions, as far as one has a cost of its own; the others have none.
    own_costs: Vec<OwnCost>,
    /// Likewise, as far as one is one of several outcomes; the others are certain.
    probabilities: Vec<f64>,
    /// Of how many states and actions there are several outcomes.
    n_stochastic: usize,
    /// Unsafe states, which only stochastic actions lead into, ascending.
    unsafe_states: Vec<StateIdx>,
}

impl Found {
    fn push(&mut self, transition: Transition, own_cost: Option<f64>) {
        if own_cost.is_some() {
            self.own_costs.resize(self.transitions.len(), OwnCost::NONE);
            self.own_costs.push(OwnCost::of(own_cost));
        }
        self.transitions.push(transition);
    }

    /// Says how probable the last transition is.
    fn set_probability(&mut self, probability: f64) {
        self.probabilities.resize(self.transitions.len() - 1, 1.0);
        self.probabilities.push(probability);
    }
}

const UNEXPLORED: (u32, u32) = (u32::MAX, u32::MAX);

/// What finds more states.
trait Frontier: Debug {
    /// Adds the transitions from the state numbered `from`, and the states that they lead to.
    fn explore(&mut self, from: StateIdx, found: &mut Found);

    /// Reserves memory for `growth` times as many states, once there is hardly any left.
    fn make_room(&mut self, growth: f64);

    /// About how much memory each state takes here, in bytes.
    fn state_bytes(&self) -> usize;
}

/// The states of `dynamics` that have a number.
#[derive(Debug)]
struct NumberedStates<'d, D: Implicit> {
    dynamics: &'d D,
    states: Vec<D::State>,
    numbers: FxHashMap<D::State, StateIdx>,
}

impl<D: Implicit> NumberedStates<'_, D> {
    fn number_of(&mut self, state: D::State, found: &mut Found) -> StateIdx {
        #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
        let next = self.states.len() as StateIdx;
        if let Some(number) = self.numbers.get(&state) {
            return *number;
        }
        found.states.push(self.dynamics.row(&state));
        found.bounds.push(UNEXPLORED);
        self.numbers.insert(state.clone(), next);
        self.states.push(state);
        next
    }
}

impl<D: Implicit> Frontier for NumberedStates<'_, D> {
    fn explore(&mut self, from: StateIdx, found: &mut Found) {
        let dynamics = self.dynamics;
        let state = self.states[from as usize].clone();
        let mut last_stochastic = None;
        for (action, outcome) in dynamics.successors(&state) {
            if outcome.is_certain() {
                if outcome.to != state && !dynamics.is_unsafe(&outcome.to) {
                    let to = self.number_of(outcome.to, found);
                    found.push(Transition { action, to }, outcome.cost);
                }
                continue;
            }
            let is_unsafe = dynamics.is_unsafe(&outcome.to);
            let n_known = self.states.len();
            let to = self.number_of(outcome.to, found);
            if is_unsafe && self.states.len() > n_known {
                found.unsafe_states.push(to);
                found.bounds[to as usize] = (0, 0);
            }
            found.push(Transition { action, to }, outcome.cost);
            found.set_probability(outcome.probability);
            found.n_stochastic += usize::from(last_stochastic.replace(action) != Some(action));
        }
    }

    fn make_room(&mut self, growth: f64) {
        make_room(&mut self.states, growth);
    }

    fn state_bytes(&self) -> usize {
        // The index is at most half empty just after it has grown.
        size_of::<D::State>() + 2 * size_of::<(D::State, StateIdx)>() + 2 * self.dynamics.state_bytes()
    }
}

impl<'d> Explored<'d> {
    /// Only the states `first`, numbered from 0, none of them explored.
    fn new<D: Implicit>(dynamics: &'d D, first: impl IntoIterator<Item = D::State>) -> Self {
        let states = States::new(dynamics.domains(), Vec::new());
        let mut found = Found {
            states,
            bounds: Vec::new(),
            transitions: Vec::new(),
            own_costs: Vec::new(),
            probabilities: Vec::new(),
            n_stochastic: 0,
            unsafe_states: Vec::new(),
        };
        let mut numbered = NumberedStates { dynamics, states: Vec::new(), numbers: FxHashMap::default() };
        for state in first {
            numbered.number_of(state, &mut found);
        }
        Self { found, frontier: Box::new(numbered) }
    }

    /// How many states were found.
    pub(super) fn n_found(&self) -> usize {
        self.found.bounds.len()
    }

    /// Of how many states and actions several outcomes were found.
    pub(super) fn n_stochastic(&self) -> usize {
        self.found.n_stochastic
    }

    /// The unsafe states that were found, ascending.
    pub(super) fn unsafe_states(&self) -> &[StateIdx] {
        &self.found.unsafe_states
    }

    /// How many transitions were found.
    pub(super) fn n_transitions(&self) -> usize {
        self.found.transitions.len()
    }

    /// The states `kept`, numbered in this order.
    pub(crate) fn keep(&self, kept: &[StateIdx]) -> States {
        self.found.states.keep(kept)
    }

    /// The states that were found.
    pub(super) fn into_states(self) -> States {
        self.found.states
    }

    /// What was found: the states, and the transitions between them.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn into_parts(self, meter: &mut Meter<'_>) -> Result<(States, Graph), Interrupted> {
        let Self { found: Found { states, bounds, transitions, own_costs, probabilities, .. }, .. } = self;
        let explored = (0..).zip(&bounds).filter(|(_, bounds)| **bounds != UNEXPLORED);
        let numbers =
            explored.flat_map(|(from, (begin, end))| (*begin as usize..*end as usize).map(move |n| (from, n)));
        let n_states = states.len() as usize;
        let graph = if own_costs.is_empty() && probabilities.is_empty() {
            Graph::new(n_states, numbers.map(|(from, n)| (from, transitions[n])), meter)?
        } else {
            let own_cost = |n: usize| own_costs.get(n).copied().unwrap_or(OwnCost::NONE);
            let probability = |n: usize| probabilities.get(n).copied().unwrap_or(1.0);
            let edges = numbers.map(|(from, n)| (from, (transitions[n], own_cost(n), probability(n))));
            Graph::of_outcomes(n_states, edges, meter)?
        };
        Ok((states, graph))
    }
}

impl Space for Explored<'_> {
    #[inline]
    fn explore(&mut self, from: StateIdx) {
        if self.found.bounds[from as usize] != UNEXPLORED {
            return;
        }
        let begin = self.found.transitions.len();
        self.frontier.explore(from, &mut self.found);
        #[expect(clippy::cast_possible_truncation, reason = "memory is spent before there are 2^32 transitions")]
        let bounds = [begin, self.found.transitions.len()].map(|bound| bound as u32);
        self.found.bounds[from as usize] = bounds.into();
    }

    #[inline]
    fn successors(&self, state: StateIdx) -> &[Transition] {
        let (begin, end) = self.found.bounds[state as usize];
        debug_assert!((begin, end) != UNEXPLORED, "only what was explored has successors");
        &self.found.transitions[begin as usize..end as usize]
    }

    #[inline]
    fn own_costs(&self, state: StateIdx) -> &[OwnCost] {
        let (begin, end) = self.found.bounds[state as usize];
        let n_costs = self.found.own_costs.len();
        &self.found.own_costs[n_costs.min(begin as usize)..n_costs.min(end as usize)]
    }

    #[inline]
    fn row(&self, state: StateIdx) -> &[u32] {
        self.found.states.row(state)
    }

    fn keeps_numbers(&self) -> bool {
        false
    }

    fn n_states(&self) -> Option<usize> {
        None
    }

    fn make_room(&mut self, growth: f64) {
        make_room(&mut self.found.bounds, growth);
        make_room(&mut self.found.transitions, growth);
        make_room(&mut self.found.own_costs, growth);
        make_room(&mut self.found.probabilities, growth);
        self.found.states.make_room(growth);
        self.frontier.make_room(growth);
    }

    #[inline]
    fn found_bytes(&self) -> usize {
        let row_bytes = size_of_val(self.found.states.row(0));
        let state_bytes = self.frontier.state_bytes() + size_of::<(u32, u32)>() + row_bytes;
        let transition_bytes =
            size_of_val(self.found.transitions.as_slice()) + size_of_val(self.found.own_costs.as_slice());
        let transition_bytes = transition_bytes + size_of_val(self.found.probabilities.as_slice());
        self.n_found() * state_bytes + transition_bytes
    }
}

/// [`Implicit`] dynamics, whatever the type of their states.
pub(crate) trait Unexplored: Debug + Send + Sync {
    /// Only the start states, in their order, none of them explored.
    fn explore_from_start(&self) -> Explored<'_>;

    /// Only the states with these rows, numbered in their order, none of them explored. `None` if there is no such state.
    fn explore_from(&self, rows: &[Vec<u32>]) -> Option<Explored<'_>>;

    /// The whole row of the state with this one, as [`Implicit::state_of`].
    fn complete_row(&self, row: &[Option<u32>]) -> Option<Vec<u32>>;

    /// As [`Implicit::is_derived`].
    fn is_derived(&self, attribute: usize) -> bool;

    /// As [`Implicit::operators`].
    fn operators(&self) -> Box<dyn Iterator<Item = Operator> + '_>;

    /// As [`Implicit::is_told`].
    fn is_told(&self, attribute: usize) -> bool;
}

impl<D: Implicit> Unexplored for D {
    fn explore_from_start(&self) -> Explored<'_> {
        Explored::new(self, self.start_states())
    }

    fn explore_from(&self, rows: &[Vec<u32>]) -> Option<Explored<'_>> {
        let state_of = |row: &Vec<u32>| self.state_of(&row.iter().copied().map(Some).collect::<Vec<_>>());
        let states: Option<Vec<D::State>> = rows.iter().map(state_of).collect();
        Some(Explored::new(self, states?))
    }

    fn complete_row(&self, row: &[Option<u32>]) -> Option<Vec<u32>> {
        let state = self.state_of(row)?;
        Some(self.row(&state).collect())
    }

    fn is_derived(&self, attribute: usize) -> bool {
        Implicit::is_derived(self, attribute)
    }

    fn operators(&self) -> Box<dyn Iterator<Item = Operator> + '_> {
        Box::new(Implicit::operators(self))
    }

    fn is_told(&self, attribute: usize) -> bool {
        Implicit::is_told(self, attribute)
    }
}
