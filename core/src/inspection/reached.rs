//! The states that a body comes to from where it starts, and the ways between them.

use std::borrow::Cow;

use crate::interrupt::{Interrupted, Meter};
use crate::mapping::{Conditions, Starts};
use crate::model::{ActionIdx, Model, Rows, Space, StateIdx, States, Transition};

/// Of a model that is searched lazily, so many states are explored, breadth first.
pub(super) const MAX_EXPLORED: usize = 1 << 15;

/// How much of what the body comes to was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Extent {
    /// All of it.
    Whole,
    /// What is closest to the start states.
    Part,
}

/// The states that a body comes to, numbered anew, breadth first from the start states on.
#[derive(Debug)]
pub(super) struct Reached<'m> {
    pub(super) extent: Extent,
    /// How many of the states are start states: the first.
    pub(super) n_starts: usize,
    /// Of each state that was explored, the first ones: where an action may lead. No transition leads to where it begins, or is one that the
    /// body cannot or must not make.
    pub(super) ways: Rows<Transition>,
    /// Which of `states` each is. Shape `[n_states]`.
    numbers: Vec<StateIdx>,
    states: Cow<'m, States>,
    /// Those of the first states of the model that are not unsafe and are not reached.
    pub(super) n_unreachable: u64,
    pub(super) unreachable: Vec<StateIdx>,
}

/// What stands where a state has no number yet.
const NONE: u32 = u32::MAX;

/// So many states are shown of each kind.
pub(super) const MAX_EXAMPLES: usize = 5;

impl<'m> Reached<'m> {
    /// Walks from the start states to all that the body comes to; to the first [`MAX_EXPLORED`] of a model that is searched lazily.
    pub(super) fn walk(
        model: &'m Model,
        conditions: &Conditions,
        starts: &Starts,
        meter: &mut Meter<'_>,
    ) -> Result<Self, Interrupted> {
        let mut is_lacking = vec![false; model.actions().len()];
        for action in &conditions.without {
            is_lacking[usize::from(*action)] = true;
        }
        let Some(mut explored) = model.explore_from(starts.rows()) else {
            let mut walk = Walk::new(model, &is_lacking, starts.states());
            walk.go(&mut model.whole(), usize::MAX, meter)?;
            let n_states = model.states().len();
            walk.known.resize(n_states as usize, NONE);
            let is_missed = |state: &StateIdx| walk.known[*state as usize] == NONE && !model.is_unsafe(*state);
            let missed = || (0..n_states).filter(is_missed);
            let (n_unreachable, unreachable) = (missed().count() as u64, missed().take(MAX_EXAMPLES).collect());
            return Ok(Self { n_unreachable, unreachable, ..Self::of(walk, starts, Cow::Borrowed(model.states())) });
        };
        let mut walk = Walk::new(model, &is_lacking, starts.states());
        walk.go(&mut explored, MAX_EXPLORED, meter)?;
        let states = explored.keep(&walk.numbers);
        walk.numbers = (0..states.len()).collect();
        Ok(Self::of(walk, starts, Cow::Owned(states)))
    }

    fn of(walk: Walk<'_>, starts: &Starts, states: Cow<'m, States>) -> Self {
        let extent = if walk.ways.n_rows() == walk.numbers.len() { Extent::Whole } else { Extent::Part };
        let (n_starts, numbers, ways) = (starts.states().len(), walk.numbers, walk.ways);
        Self { extent, n_starts, ways, numbers, states, n_unreachable: 0, unreachable: Vec::new() }
    }

    /// How many states were found.
    pub(super) fn n_states(&self) -> usize {
        self.numbers.len()
    }

    /// The row of a state.
    #[inline]
    pub(super) fn row(&self, state: u32) -> &[u32] {
        self.states.row(self.numbers[state as usize])
    }

    /// Its number in a model that numbers its states.
    pub(super) fn number(&self, state: u32) -> Option<StateIdx> {
        matches!(self.states, Cow::Borrowed(_)).then(|| self.numbers[state as usize])
    }

    /// The states that these numbers are of.
    pub(super) fn states(&self) -> &States {
        &self.states
    }

    /// The states that nothing leaves, of those that were explored.
    pub(super) fn dead_ends(&self) -> impl Iterator<Item = u32> {
        (0..).zip(self.ways.iter()).filter(|(_, ways)| ways.is_empty()).map(|(state, _)| state)
    }
}

/// What the ways do.
#[derive(Debug)]
pub(super) struct Effects {
    /// By attribute, how many ways change it.
    pub(super) n_changing: Vec<u64>,
    /// By action, from how many states there is a way by it.
    pub(super) n_applying: Vec<u64>,
}

impl Effects {
    pub(super) fn of(model: &Model, reached: &Reached<'_>, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        let mut n_changing = vec![0; model.schema().len()];
        let mut n_applying = vec![0; model.actions().len()];
        for (from, ways) in (0..).zip(reached.ways.iter()) {
            let before = reached.row(from);
            meter.spend_or_stop(1 + (ways.len() * before.len()) as u64)?;
            for ways in ways.chunk_by(|one, other| one.action == other.action) {
                n_applying[usize::from(ways[0].action)] += 1;
            }
            for way in ways {
                let pairs = before.iter().zip(reached.row(way.to));
                for (n, (before, after)) in n_changing.iter_mut().zip(pairs) {
                    *n += u64::from(before != after);
                }
            }
        }
        Ok(Self { n_changing, n_applying })
    }
}

/// A walk through a space.
struct Walk<'w> {
    model: &'w Model,
    is_lacking: &'w [bool],
    /// By the space's number of a state, the number here; [`NONE`] if it was not found.
    known: Vec<u32>,
    /// The other way round.
    numbers: Vec<StateIdx>,
    ways: Rows<Transition>,
}

impl<'w> Walk<'w> {
    fn new(model: &'w Model, is_lacking: &'w [bool], starts: &[StateIdx]) -> Self {
        let mut walk = Self { model, is_lacking, known: Vec::new(), numbers: Vec::new(), ways: Rows::default() };
        for start in starts {
            walk.number_of(*start);
        }
        walk
    }

    fn go(&mut self, space: &mut impl Space, max_explored: usize, meter: &mut Meter<'_>) -> Result<(), Interrupted> {
        let mut from = 0;
        let mut ways = Vec::new();
        while from < self.numbers.len().min(max_explored) {
            let state = self.numbers[from];
            space.explore(state);
            let successors = space.successors(state);
            meter.spend_or_stop(1 + successors.len() as u64)?;
            let outcomes = successors.chunk_by(|one, other| one.action == other.action);
            for outcomes in outcomes {
                if !self.is_taken(outcomes) {
                    continue;
                }
                for Transition { action, to } in outcomes.iter().filter(|way| way.to != state) {
                    let to = self.number_of(*to);
                    ways.push(Transition { action: *action, to });
                }
            }
            self.ways.push(ways.drain(..));
            from += 1;
        }
        Ok(())
    }

    /// Whether the body takes an action with these outcomes: it has it, and none of them is unsafe.
    fn is_taken(&self, outcomes: &[Transition]) -> bool {
        let has = |action: ActionIdx| !self.is_lacking[usize::from(action)];
        // States of a model that is searched lazily have other numbers, and are safe if they are found.
        let is_safe = |to| self.model.is_lazy() || !self.model.is_unsafe(to);
        outcomes.iter().all(|way| has(way.action) && is_safe(way.to))
    }

    #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
    fn number_of(&mut self, state: StateIdx) -> u32 {
        if self.known.len() <= state as usize {
            self.known.resize(state as usize + 1, NONE);
        }
        let known = &mut self.known[state as usize];
        if *known == NONE {
            *known = self.numbers.len() as u32;
            self.numbers.push(state);
        }
        *known
    }
}

/// By attribute, `Some(0)` if no action ever changes it, whatever can be reached; else it is not known how many ways do.
pub(super) fn changed_by_operators(model: &Model, conditions: &Conditions) -> Vec<Option<u64>> {
    let mut changed_by = vec![model.is_lazy().then_some(0); model.schema().len()];
    for operator in model.operators().into_iter().flatten() {
        if !conditions.without.contains(&operator.action) {
            operator.changed.iter().for_each(|(position, ..)| changed_by[*position] = None);
        }
    }
    changed_by
}

/// By action, `Some(0)` if it never changes anything, whatever can be reached; else it is not known from how many states it does.
pub(super) fn applying_by_operators(model: &Model) -> Vec<Option<u64>> {
    let mut applying = vec![model.is_lazy().then_some(0); model.actions().len()];
    for operator in model.operators().into_iter().flatten() {
        applying[usize::from(operator.action)] = None;
    }
    applying
}
