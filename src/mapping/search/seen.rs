//! The states that a search has seen.

use std::ops::Range;

use rustc_hash::FxHashMap;

use super::nodes::{BLOCK_LEN, Estimates};
use crate::mapping::heuristic::projected::{ChangingColumn, Estimate, Projected};
use crate::model::{Action, ActionIdx, Space, StateIdx};

/// A state's number among those that a search has seen, in the order in which it did.
pub(super) type SeenIdx = u32;

/// A way out of a state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Way {
    /// What the action costs.
    pub(super) cost: f64,
    pub(super) to: SeenIdx,
    pub(super) action: ActionIdx,
}

/// The states that were seen, with all that a search looks at again and again: it sees few of a model's states, but each at many
/// observations and from many sides. So they are close together in memory, however large the model is, and other searches of
/// the model find them there.
#[derive(Debug, Default)]
pub(super) struct Seen {
    numbers: FxHashMap<StateIdx, SeenIdx>,
    states: Vec<StateIdx>,
    /// Where the ways out of each state are; [`UNEXPLORED`] where they are not known yet.
    bounds: Vec<(u32, u32)>,
    ways: Vec<Way>,
    /// Where the states' entries are in the tables of estimates. Shape `[n_seen, columns.len()]`.
    places: Vec<u32>,
    columns: Vec<ChangingColumn>,
    /// How many bytes they took before this search.
    bytes_before: usize,
}

const UNEXPLORED: (u32, u32) = (u32::MAX, u32::MAX);

impl Seen {
    /// Makes room for a search in `space`, with estimates by `projected`: keeps the states that mean the same to it.
    pub(super) fn prepare(&mut self, space: &impl Space, projected: &Projected<'_>) {
        if !space.keeps_numbers() || self.columns != projected.changing_columns() {
            self.numbers.clear();
            self.states.clear();
            self.bounds.clear();
            self.ways.clear();
            self.places.clear();
            self.columns = projected.changing_columns().to_vec();
        }
        self.bytes_before = self.n_bytes();
    }

    /// How much memory those take that this search was the first to see, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.n_bytes() - self.bytes_before
    }

    fn n_bytes(&self) -> usize {
        /// Of the index, which is at most half empty just after it has grown.
        const ENTRY_BYTES: usize = 2 * size_of::<(StateIdx, SeenIdx)>();
        let state_bytes = size_of::<StateIdx>() + size_of::<(u32, u32)>() + self.columns.len() * size_of::<u32>();
        self.states.len() * (state_bytes + ENTRY_BYTES) + self.ways.len() * size_of::<Way>()
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.numbers.capacity() * size_of::<(StateIdx, SeenIdx)>()
            + self.ways.capacity() * size_of::<Way>()
            + self.places.capacity() * size_of::<u32>()
    }

    /// The number of a state, from now on.
    #[inline]
    pub(super) fn number_of(&mut self, state: StateIdx, space: &impl Space, projected: &Projected<'_>) -> SeenIdx {
        #[expect(clippy::cast_possible_truncation, reason = "no more than there are states")]
        let next = self.states.len() as SeenIdx;
        let number = *self.numbers.entry(state).or_insert(next);
        if number == next {
            self.states.push(state);
            self.bounds.push(UNEXPLORED);
            self.places.extend(projected.places(space.row(state)));
        }
        number
    }

    /// The model's number of a state.
    #[inline]
    pub(super) fn state(&self, number: SeenIdx) -> StateIdx {
        self.states[number as usize]
    }

    /// Where the ways out of a state are, if it was explored.
    #[inline]
    pub(super) fn explored(&self, number: SeenIdx) -> Option<Range<usize>> {
        let bounds = self.bounds[number as usize];
        (bounds != UNEXPLORED).then_some(bounds.0 as usize..bounds.1 as usize)
    }

    /// Sees where the actions lead from a state. Gives where the ways are.
    #[cold]
    pub(super) fn explore(
        &mut self,
        number: SeenIdx,
        space: &mut impl Space,
        projected: &Projected<'_>,
        actions: &[Action],
    ) -> Range<usize> {
        let state = self.state(number);
        space.explore(state);
        let begin = self.ways.len();
        for transition in space.successors(state) {
            let to = self.number_of(transition.to, space, projected);
            let cost = actions[usize::from(transition.action)].cost;
            self.ways.push(Way { cost, to, action: transition.action });
        }
        #[expect(clippy::cast_possible_truncation, reason = "models have fewer than 2^32 transitions")]
        let bounds = [begin, self.ways.len()].map(|bound| bound as u32);
        self.bounds[number as usize] = bounds.into();
        begin..self.ways.len()
    }

    /// The way out of a state that is there.
    #[inline]
    pub(super) fn way(&self, at: usize) -> Way {
        self.ways[at]
    }

    /// Where the entries of a state are.
    #[inline]
    fn places(&self, number: SeenIdx) -> &[u32] {
        let n_places = self.columns.len();
        &self.places[number as usize * n_places..][..n_places]
    }
}

/// Estimates of the states that were seen.
#[derive(Debug)]
pub(super) struct SeenEstimates<'s, 'p, S> {
    pub(super) seen: &'s Seen,
    pub(super) projected: &'s Projected<'p>,
    pub(super) space: &'s S,
}

impl<S: Space> Estimates for SeenEstimates<'_, '_, S> {
    #[inline]
    fn of(&self, state: SeenIdx, observation: u32) -> Estimate {
        let values = || self.space.row(self.seen.state(state));
        self.projected.estimate(observation as usize, self.seen.places(state), values)
    }

    #[inline]
    fn of_all(&self, state: SeenIdx, first: u32) -> Option<[Estimate; BLOCK_LEN]> {
        let places = self.seen.places(state);
        self.projected.are_all_in_columns().then(|| self.projected.estimate_chunk(first as usize, places))
    }
}
