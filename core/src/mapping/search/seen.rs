//! The states that a search has seen.

use std::ops::Range;

use rustc_hash::FxHashMap;

use crate::mapping::conditions::Body;
use crate::mapping::heuristic::projected::{CHUNK_LEN, ChangingColumn, Estimate, Projected};
use crate::model::{ActionIdx, Space, StateIdx, make_room};

/// A state's number among those that a search has seen, in the order in which it did.
pub(super) type SeenIdx = u32;

/// A way out of a state.
#[derive(Clone, Copy, Debug)]
pub(super) struct SeenWay {
    /// What the action costs.
    pub(super) cost: f64,
    pub(super) to: SeenIdx,
    pub(super) action: ActionIdx,
}

/// The states that searches of a model have reached, with copies of what a search reads most. A search reaches few of a model's states,
/// but each at many observations and by many ways; the copies lie close together in memory, however large the model is. They are kept for
/// later searches of the model.
#[derive(Debug, Default)]
pub(super) struct Seen {
    numbers: FxHashMap<StateIdx, SeenIdx>,
    states: Vec<StateIdx>,
    bounds: Vec<Bounds>,
    /// By state, the last search that came to it.
    came: Vec<SearchNumber>,
    ways: Vec<SeenWay>,
    /// The states' classes in the tables of estimates. Shape `[n_seen, columns.len()]`.
    classes: Vec<u32>,
    columns: Vec<ChangingColumn>,
    /// Whose ways these are.
    body: Body,
    /// This search.
    search: SearchNumber,
    /// States that this search has reached, including those that earlier searches reached.
    n_states: usize,
    /// Ways out of the states that this search has explored.
    n_ways: usize,
}

/// A search's number among those for which the states were kept, from 1 on; 0 for none.
type SearchNumber = u32;

/// Where the ways out of a state are.
#[derive(Clone, Copy, Debug)]
struct Bounds {
    begin: u32,
    end: u32,
    /// The last search that explored it, 0 if its ways are not known yet.
    explored_by: SearchNumber,
}

const UNEXPLORED: Bounds = Bounds { begin: 0, end: 0, explored_by: 0 };

/// Most states that are kept for later searches. An index may have a row for each, of as many bytes as 128.
const MAX_KEPT_STATES: usize = 1 << 16;

/// What a state takes, besides its ways, its entry in the index and its classes.
const STATE_BYTES: usize = size_of::<StateIdx>() + size_of::<Bounds>() + size_of::<SearchNumber>();

/// What an entry of the index takes, which is at most half empty just after it has grown.
const ENTRY_BYTES: usize = 2 * size_of::<(StateIdx, SeenIdx)>();

impl Seen {
    /// Makes room for a search in `space` of the ways of `body`, with estimates by `projected`: keeps the states that mean the same to it,
    /// unless they are too many. Gives whether they were kept.
    pub(super) fn prepare(&mut self, space: &impl Space, body: &Body, projected: &Projected<'_>) -> bool {
        let are_alike = space.keeps_numbers() && self.columns == projected.changing_columns() && self.body == *body;
        let are_kept = are_alike && self.states.len() <= MAX_KEPT_STATES && self.search < SearchNumber::MAX;
        if !are_kept {
            self.numbers.clear();
            self.states.clear();
            self.bounds.clear();
            self.came.clear();
            self.ways.clear();
            self.classes.clear();
            self.columns = projected.changing_columns().to_vec();
            self.body.clone_from(body);
            self.search = 0;
        }
        self.search += 1;
        (self.n_states, self.n_ways) = (0, 0);
        are_kept
    }

    /// How many states this search came to.
    pub(super) fn n_states(&self) -> usize {
        self.n_states
    }

    /// How much memory those take that this search came to, in bytes: the same whether or not others were there before.
    pub(super) fn size_bytes(&self) -> usize {
        self.bytes_of(self.n_states, self.n_ways)
    }

    /// How much memory so many states with so many ways out take, in bytes.
    pub(super) fn bytes_of(&self, n_states: usize, n_ways: usize) -> usize {
        let state_bytes = STATE_BYTES + self.columns.len() * size_of::<u32>();
        n_states * (state_bytes + ENTRY_BYTES) + n_ways * size_of::<SeenWay>()
    }

    /// How much memory those take, in bytes, if they are all of a model, of so many transitions and attributes.
    pub(super) fn bytes_for(n_states: usize, n_transitions: usize, n_attributes: usize) -> usize {
        n_states * (STATE_BYTES + n_attributes * size_of::<u32>() + ENTRY_BYTES) + n_transitions * size_of::<SeenWay>()
    }

    /// Makes room for `growth` times as many, once there is hardly any left.
    pub(super) fn make_room(&mut self, growth: f64) {
        make_room(&mut self.states, growth);
        make_room(&mut self.bounds, growth);
        make_room(&mut self.came, growth);
        make_room(&mut self.ways, growth);
        make_room(&mut self.classes, growth);
    }

    /// How much memory is kept for them, in bytes.
    pub(super) fn kept_bytes(&self) -> usize {
        self.numbers.capacity() * size_of::<(StateIdx, SeenIdx)>()
            + self.states.capacity() * STATE_BYTES
            + self.ways.capacity() * size_of::<SeenWay>()
            + self.classes.capacity() * size_of::<u32>()
    }

    /// The number of a state to which this search comes, from now on.
    #[inline]
    pub(super) fn number_of(&mut self, state: StateIdx, space: &impl Space, projected: &Projected<'_>) -> SeenIdx {
        #[expect(clippy::cast_possible_truncation, reason = "no more than there are states")]
        let next = self.states.len() as SeenIdx;
        let number = *self.numbers.entry(state).or_insert(next);
        if number == next {
            self.states.push(state);
            self.bounds.push(UNEXPLORED);
            self.came.push(0);
            self.classes.extend(projected.classes(space.row(state)));
        }
        self.come_to(number);
        number
    }

    /// Counts a state to which this search comes.
    #[inline]
    fn come_to(&mut self, number: SeenIdx) {
        let came = &mut self.came[number as usize];
        self.n_states += usize::from(*came != self.search);
        *came = self.search;
    }

    /// The model's number of a state.
    #[inline]
    pub(super) fn state(&self, number: SeenIdx) -> StateIdx {
        self.states[number as usize]
    }

    /// Where the ways out of a state are, if this search explored it.
    #[inline]
    pub(super) fn explored(&self, number: SeenIdx) -> Option<Range<usize>> {
        let bounds = self.bounds[number as usize];
        (bounds.explored_by == self.search).then(|| bounds.ways())
    }

    /// Sees where the actions lead from a state. Gives where the ways are.
    #[cold]
    pub(super) fn explore(
        &mut self,
        number: SeenIdx,
        space: &mut impl Space,
        projected: &Projected<'_>,
    ) -> Range<usize> {
        let ways = self.known_ways(number, space, projected);
        ways.clone().for_each(|at| self.come_to(self.ways[at].to));
        self.n_ways += ways.len();
        self.bounds[number as usize].explored_by = self.search;
        ways
    }

    /// Where the ways out of a state are; nothing is counted.
    #[inline]
    pub(super) fn known_ways(
        &mut self,
        number: SeenIdx,
        space: &mut impl Space,
        projected: &Projected<'_>,
    ) -> Range<usize> {
        let known = self.bounds[number as usize];
        if known.explored_by == 0 { self.see_ways(number, space, projected) } else { known.ways() }
    }

    #[cold]
    fn see_ways(&mut self, number: SeenIdx, space: &mut impl Space, projected: &Projected<'_>) -> Range<usize> {
        let state = self.state(number);
        space.explore(state);
        let begin = self.ways.len();
        let body = std::mem::take(&mut self.body);
        for (transition, cost) in body.ways(space, state) {
            let to = self.number_of(transition.to, space, projected);
            self.ways.push(SeenWay { cost, to, action: transition.action });
        }
        self.body = body;
        #[expect(clippy::cast_possible_truncation, reason = "models have fewer than 2^32 transitions")]
        let [begin, end] = [begin, self.ways.len()].map(|bound| bound as u32);
        let bounds = Bounds { begin, end, explored_by: self.search };
        self.bounds[number as usize] = bounds;
        bounds.ways()
    }

    /// The way out of a state that is there.
    #[inline]
    pub(super) fn way(&self, at: usize) -> SeenWay {
        self.ways[at]
    }

    /// The classes of a state.
    #[inline]
    pub(super) fn classes(&self, number: SeenIdx) -> &[u32] {
        let n_classes = self.columns.len();
        &self.classes[number as usize * n_classes..][..n_classes]
    }
}

impl Bounds {
    #[inline]
    fn ways(self) -> Range<usize> {
        self.begin as usize..self.end as usize
    }
}

/// What the nodes of the states that were seen cost, and what is still to be paid after them.
#[derive(Debug)]
pub(super) struct Estimates<'s, 'p, S> {
    pub(super) seen: &'s Seen,
    pub(super) projected: &'s Projected<'p>,
    pub(super) space: &'s S,
}

impl<S: Space> Estimates<'_, '_, S> {
    /// At a node.
    #[inline]
    pub(super) fn of(&self, state: SeenIdx, observation: u32) -> Estimate {
        let values = || self.space.row(self.seen.state(state));
        self.projected.estimate(observation as usize, self.seen.classes(state), values)
    }

    /// At the nodes of a state at [`CHUNK_LEN`] observations from `first` on; `None` if an estimate takes more than the tables. Past the
    /// last observation the entries mean nothing.
    #[inline]
    pub(super) fn of_all(&self, state: SeenIdx, first: u32) -> Option<[Estimate; CHUNK_LEN]> {
        let classes = self.seen.classes(state);
        self.projected.are_all_in_columns().then(|| self.projected.estimate_chunk(first as usize, classes))
    }
}
