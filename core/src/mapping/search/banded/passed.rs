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
    states: Vec<SeenIdx>,
    /// By what was seen, the search's own number; [`UNNUMBERED`] where it was not in this search.
    numbers: Vec<PassedIdx>,
    /// Where the ways out are; [`UNEXPLORED`] if they are not known yet.
    bounds: Vec<[u32; 2]>,
    ways: Vec<PassedWay>,
    tables: JoinedTables,
    /// Where the entries of each state are in the tables.
    rows: Vec<[u32; 2]>,
}

const UNNUMBERED: PassedIdx = PassedIdx::MAX;

const UNEXPLORED: [u32; 2] = [u32::MAX, u32::MAX];

/// What a state takes, besides its ways and entries of tables.
const STATE_BYTES: usize = size_of::<SeenIdx>() + size_of::<PassedIdx>() + 2 * size_of::<[u32; 2]>();

impl Passed {
    /// Forgets them, for a search of `problem` in `space` with these estimates.
    pub(super) fn prepare(&mut self, space: &impl Space, problem: &Problem<'_>, projected: &Projected<'_>) {
        for state in self.states.drain(..) {
            self.numbers[state as usize] = UNNUMBERED;
        }
        self.seen.prepare(space, &problem.body, projected);
        self.tables.prepare(problem, projected);
        self.bounds.clear();
        self.ways.clear();
        self.rows.clear();
    }

    /// How much memory they take, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.seen.size_bytes()
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
            self.states.push(seen);
            self.bounds.push(UNEXPLORED);
            self.rows.push(self.tables.rows_of(self.seen.classes(seen), projected));
        }
        *number
    }

    /// The model's number of a state.
    pub(super) fn state(&self, number: PassedIdx) -> StateIdx {
        self.seen.state(self.states[number as usize])
    }

    /// Where the ways out of a state are, if it was explored.
    #[inline]
    pub(super) fn explored(&self, number: PassedIdx) -> Option<Range<usize>> {
        let bounds @ [begin, end] = self.bounds[number as usize];
        (bounds != UNEXPLORED).then_some(begin as usize..end as usize)
    }

    /// Sees where the actions lead from a state.
    #[cold]
    pub(super) fn explore(
        &mut self,
        number: PassedIdx,
        space: &mut impl Space,
        projected: &Projected<'_>,
    ) -> Range<usize> {
        let seen = self.states[number as usize];
        let ways = self.seen.explore(seen, space, projected);
        let begin = self.ways.len();
        for at in ways {
            let way = self.seen.way(at);
            let to = self.number_of_seen(way.to, projected);
            self.ways.push(PassedWay { cost: way.cost, to, action: way.action });
        }
        #[expect(clippy::cast_possible_truncation, reason = "models have fewer than 2^32 transitions")]
        {
            self.bounds[number as usize] = [begin as u32, self.ways.len() as u32];
        }
        begin..self.ways.len()
    }

    /// Ways out of a state.
    #[inline]
    pub(super) fn ways(&self, range: Range<usize>) -> &[PassedWay] {
        &self.ways[range]
    }

    /// The estimate at a node.
    #[inline]
    pub(super) fn estimate(&self, number: PassedIdx, observation: usize) -> Estimate {
        self.tables.estimate(self.rows[number as usize], observation)
    }

    /// How many there are.
    #[inline]
    pub(super) fn len(&self) -> usize {
        self.states.len()
    }
}
