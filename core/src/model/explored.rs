//! The part of a cave that was come to.

use rustc_hash::FxHashMap;

use super::wumpus::{Act, Cave, CaveState};
use super::{ActionIdx, Graph, Space, StateIdx, States, Transition, make_room};
use crate::interrupt::{Interrupted, Meter};

/// The states of a cave that were found, numbered in the order in which they were, and the ways out of those that were explored.
///
/// An action without effect is no way, and neither is one into death.
#[derive(Debug)]
pub(crate) struct Explored<'c> {
    cave: &'c Cave,
    acts: Vec<(ActionIdx, Act)>,
    found: Vec<CaveState>,
    indices: FxHashMap<CaveState, StateIdx>,
    states: States,
    /// Where the ways out of each state are; [`UNEXPLORED`] where they are not known yet. Shape `[found.len()]`.
    bounds: Vec<(u32, u32)>,
    ways: Vec<Transition>,
}

const UNEXPLORED: (u32, u32) = (u32::MAX, u32::MAX);

impl<'c> Explored<'c> {
    /// Nothing but the state `first`, which gets the number 0.
    pub(crate) fn new(cave: &'c Cave, first: CaveState) -> Self {
        let acts = (0..).zip(cave.actions()).filter_map(|(index, action)| Some((index, Act::named(&action.name)?)));
        let mut explored = Self {
            cave,
            acts: acts.collect(),
            found: Vec::new(),
            indices: FxHashMap::default(),
            states: States::new(cave.domains(), Vec::new()),
            bounds: Vec::new(),
            ways: Vec::new(),
        };
        explored.number_of(first);
        explored
    }

    /// How many states were found.
    pub(super) fn n_found(&self) -> usize {
        self.found.len()
    }

    /// How many ways out of those that were explored.
    pub(super) fn n_ways(&self) -> usize {
        self.ways.len()
    }

    /// How much work it is to explore a state, in successors.
    pub(super) fn n_acts(&self) -> u64 {
        self.acts.len() as u64
    }

    /// The states `kept`, numbered in this order.
    pub(crate) fn keep(&self, kept: &[StateIdx]) -> States {
        let rows = kept.iter().flat_map(|state| self.states.row(*state)).copied().collect();
        States::new(self.cave.domains(), rows)
    }

    /// What was found: the states, and the transitions between them.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn into_parts(self, meter: &mut Meter<'_>) -> Result<(States, Graph), Interrupted> {
        let Self { states, bounds, ways, .. } = self;
        let explored = (0..).zip(&bounds).filter(|(_, bounds)| **bounds != UNEXPLORED);
        let edges = explored.flat_map(|(from, (begin, end))| {
            let ways = &ways[*begin as usize..*end as usize];
            ways.iter().map(move |way| (from, *way))
        });
        let graph = Graph::new(states.len() as usize, edges, meter)?;
        Ok((states, graph))
    }

    fn number_of(&mut self, state: CaveState) -> StateIdx {
        #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
        let next = self.found.len() as StateIdx;
        let number = *self.indices.entry(state).or_insert(next);
        if number == next {
            self.found.push(state);
            self.states.push(self.cave.row(&state));
            self.bounds.push(UNEXPLORED);
        }
        number
    }
}

impl Space for Explored<'_> {
    fn explore(&mut self, from: StateIdx) {
        if self.bounds[from as usize] != UNEXPLORED {
            return;
        }
        let state = self.found[from as usize];
        let begin = self.ways.len();
        for n in 0..self.acts.len() {
            let (action, act) = self.acts[n];
            let next = self.cave.after(state, act);
            if next != state && !self.cave.is_deadly(&next) {
                let to = self.number_of(next);
                self.ways.push(Transition { action, to });
            }
        }
        #[expect(clippy::cast_possible_truncation, reason = "at most six for each state")]
        let bounds = [begin, self.ways.len()].map(|bound| bound as u32);
        self.bounds[from as usize] = bounds.into();
    }

    #[inline]
    fn successors(&self, state: StateIdx) -> &[Transition] {
        let (begin, end) = self.bounds[state as usize];
        debug_assert!((begin, end) != UNEXPLORED, "only what was explored has successors");
        &self.ways[begin as usize..end as usize]
    }

    #[inline]
    fn row(&self, state: StateIdx) -> &[u32] {
        self.states.row(state)
    }

    fn keeps_numbers(&self) -> bool {
        false
    }

    fn n_states(&self) -> Option<usize> {
        None
    }

    fn make_room(&mut self, growth: f64) {
        make_room(&mut self.found, growth);
        make_room(&mut self.bounds, growth);
        make_room(&mut self.ways, growth);
        self.states.make_room(growth);
    }

    #[inline]
    fn found_bytes(&self) -> usize {
        /// Of the index, which is at most half empty just after it has grown.
        const ENTRY_BYTES: usize = 2 * size_of::<(CaveState, StateIdx)>();
        let row_bytes = size_of_val(self.states.row(0));
        let state_bytes = size_of::<CaveState>() + size_of::<(u32, u32)>() + row_bytes;
        self.found.len() * (state_bytes + ENTRY_BYTES) + self.ways.len() * size_of::<Transition>()
    }
}
