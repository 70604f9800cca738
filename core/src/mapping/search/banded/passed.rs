//! The states that a search has come to, as it numbers them.

use std::ops::Range;

use super::super::seen::{Seen, SeenIdx};
use super::tables::JoinedTables;
use crate::mapping::Problem;
use crate::mapping::heuristic::projected::{CHUNK_LEN, Estimate, Projected};
use crate::model::{ActionIdx, Space, StateIdx};

/// A state's number in a search: states are numbered in the order in which it comes to them, whatever searches came to before.
pub(super) type PassedIdx = u32;

/// A way out of a state.
#[derive(Clone, Copy, Debug)]
pub(super) struct PassedWay {
    /// What the action costs.
    pub(super) cost: f64,
    pub(super) to: PassedIdx,
    pub(super) action: ActionIdx,
}

/// What was [seen](Seen) of the states that this search has come to, by its own numbers.
#[derive(Debug, Default)]
pub(super) struct Passed {
    /// Kept for later searches.
    seen: Seen,
    states: Vec<PassedState>,
    /// By what was seen, the search's own number; [`UNNUMBERED`] where it was not in this search.
    numbers: Vec<PassedIdx>,
    ways: Vec<PassedWay>,
    tables: JoinedTables,
}

/// A state that this search has come to.
#[derive(Clone, Copy, Debug)]
struct PassedState {
    seen: SeenIdx,
    /// Where the entries are in the tables.
    rows: [u32; 2],
    /// Where the ways out are; [`UNEXPLORED`] if they are not known yet.
    ways: [u32; 2],
}

const UNNUMBERED: PassedIdx = PassedIdx::MAX;

const UNEXPLORED: [u32; 2] = [u32::MAX, u32::MAX];

/// What a state takes, besides its ways and entries of tables.
const STATE_BYTES: usize = size_of::<PassedState>() + size_of::<PassedIdx>();

impl Passed {
    /// Forgets them, for a search of `problem` in `space` with these estimates.
    pub(super) fn prepare(&mut self, space: &impl Space, problem: &Problem<'_>, projected: &Projected<'_>) {
        for state in self.states.drain(..) {
            self.numbers[state.seen as usize] = UNNUMBERED;
        }
        let are_kept = self.seen.prepare(space, &problem.body, projected);
        self.tables.prepare(problem, projected, are_kept);
        self.ways.clear();
    }

    /// How much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.seen.bytes_of(self.states.len(), self.ways.len())
            + self.states.len() * STATE_BYTES
            + size_of_val(self.ways.as_slice())
            + self.tables.size_bytes()
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.seen.kept_bytes()
            + self.states.capacity() * STATE_BYTES
            + self.ways.capacity() * size_of::<PassedWay>()
            + self.numbers.capacity() * size_of::<PassedIdx>()
            + self.tables.kept_bytes()
    }

    /// How much memory those take, in bytes, if they are all of a model, of so many transitions and attributes, and have entries of their own
    /// for so many observations.
    pub(super) fn bytes_for(
        n_states: usize,
        n_transitions: usize,
        n_attributes: usize,
        n_observations: usize,
    ) -> usize {
        let state_bytes = STATE_BYTES + 2 * n_observations.next_multiple_of(CHUNK_LEN) * size_of::<Estimate>();
        Seen::bytes_for(n_states, n_transitions, n_attributes)
            + n_states.saturating_mul(state_bytes)
            + n_transitions * size_of::<PassedWay>()
    }

    /// The number of a state to which this search comes, by the model's.
    pub(super) fn number_of(&mut self, state: StateIdx, space: &impl Space, projected: &Projected<'_>) -> PassedIdx {
        let seen = self.seen.number_of(state, space, projected);
        self.number_of_seen(seen, projected)
    }

    fn number_of_seen(&mut self, seen: SeenIdx, projected: &Projected<'_>) -> PassedIdx {
        if self.numbers.len() <= seen as usize {
            self.numbers.resize(seen as usize + 1, UNNUMBERED);
        }
        let number = &mut self.numbers[seen as usize];
        if *number == UNNUMBERED {
            #[expect(clippy::cast_possible_truncation, reason = "no more than there are states")]
            let next = self.states.len() as PassedIdx;
            *number = next;
            let rows = self.tables.rows_of(seen, &self.seen, projected);
            self.states.push(PassedState { seen, rows, ways: UNEXPLORED });
        }
        *number
    }

    /// The model's number of a state.
    pub(super) fn state(&self, number: PassedIdx) -> StateIdx {
        self.seen.state(self.states[number as usize].seen)
    }

    /// Where the ways out of a state are.
    #[inline]
    pub(super) fn explore(
        &mut self,
        number: PassedIdx,
        space: &mut impl Space,
        projected: &Projected<'_>,
    ) -> Range<u32> {
        let ways @ [begin, end] = self.states[number as usize].ways;
        if ways == UNEXPLORED { self.see_ways(number, space, projected) } else { begin..end }
    }

    /// Sees where the actions lead from a state.
    #[cold]
    fn see_ways(&mut self, number: PassedIdx, space: &mut impl Space, projected: &Projected<'_>) -> Range<u32> {
        let seen = self.states[number as usize].seen;
        let begin = self.ways.len();
        for at in self.seen.known_ways(seen, space, projected) {
            let way = self.seen.way(at);
            let to = self.number_of_seen(way.to, projected);
            self.ways.push(PassedWay { cost: way.cost, to, action: way.action });
        }
        #[expect(clippy::cast_possible_truncation, reason = "models have fewer than 2^32 transitions")]
        let ways @ [begin, end] = [begin as u32, self.ways.len() as u32];
        self.states[number as usize].ways = ways;
        begin..end
    }

    /// Ways out of a state.
    #[inline]
    pub(super) fn ways(&self, range: &Range<u32>) -> &[PassedWay] {
        &self.ways[range.start as usize..range.end as usize]
    }

    /// The estimate at a node.
    pub(super) fn estimate(&self, number: PassedIdx, observation: usize) -> Estimate {
        self.estimates(observation).of(number)
    }

    /// The estimates at the nodes of an observation.
    #[inline]
    pub(super) fn estimates(&self, observation: usize) -> Estimates<'_> {
        Estimates { states: &self.states, entries: self.tables.entries_from(observation) }
    }

    /// How many there are.
    #[inline]
    pub(super) fn len(&self) -> usize {
        self.states.len()
    }
}

/// The estimates at the nodes of an observation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Estimates<'p> {
    states: &'p [PassedState],
    entries: &'p [Estimate],
}

impl Estimates<'_> {
    /// At the node of a state.
    #[inline]
    pub(super) fn of(self, number: PassedIdx) -> Estimate {
        let [first, second] = self.states[number as usize].rows;
        let mut sum = self.entries[first as usize];
        sum += self.entries[second as usize];
        sum
    }
}
