//! A* over nodes `(i, s)`, as in the textbook (Hart, Nilsson & Raphael 1968): what the paper searched with, for its own heuristic.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use rustc_hash::FxHashMap;

use super::{Found, Move, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::heuristic::Heuristic;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{ActionIdx, Space, StateIdx, make_room, room_to_make};

/// Finds a mapping, the cheapest if `heuristic` is admissible, as far as `budget` allows. A node is expanded again if a cheaper
/// way to it is found, so the heuristic need not be consistent.
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
pub(in crate::mapping) fn search<S: Space, H: Heuristic>(
    problem: &Problem<'_>,
    space: &mut S,
    heuristic: &H,
    budget: Budget,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let last = problem.last();
    let recurrence = problem.recurrence();
    // Where ending costs something, nodes at the last observation lead to one more, the end.
    let goal = if problem.end.is_some() { last + 1 } else { last };
    let mut nodes = FoundNodes::default();
    let mut open = BinaryHeap::new();
    // With what was taken out.
    let mut most_open = 0;
    let (mut n_expanded, mut n_generated) = (0, 0);
    let mut meter = Meter::new(interrupt, POLL_EVERY);

    for state in problem.starts.states() {
        let row = space.row(*state);
        let g = recurrence.arrive(MoveKind::Start, 0.0, problem.distances.distance(0, row));
        let first = nodes.reach(CheapestWay { observation: 0, state: *state, g, action: NO_ACTION, parent: NO_PARENT });
        open.extend(first.map(|id| Open::new(g + heuristic.cost_to_go(0, row), g, 0, id)));
    }
    // The most promising start, and the farthest expanded node, among those the most promising: where a search out of budget goes on
    // greedily.
    let first = open.peek().map_or(0, |first: &Open| first.id);
    let mut farthest = Open::new(f64::INFINITY, 0.0, 0, first);

    while let Some(entry) = open.pop() {
        let node = *nodes.get(entry.id);
        if f64::from_bits(entry.g_bits) > node.g {
            continue;
        }
        let (i, state) = (node.observation as usize, node.state);
        if i == goal {
            let paths = vec![nodes.path(entry.id, last)];
            let least_f = f64::INFINITY;
            return Ok(Found { paths, is_complete: true, stopped_by: None, least_f, n_expanded, n_generated });
        }
        // Whatever is left of an expansion that is broken off costs at least the `f` of its node.
        let unfinished = |stopped_by, nodes: &FoundNodes, farthest: Open, n_expanded, n_generated| {
            let paths = [entry.id, farthest.id, first].map(|id| nodes.path(id, last)).to_vec();
            let (least_f, stopped_by) = (entry.f(), Some(stopped_by));
            Ok(Found { paths, is_complete: false, stopped_by, least_f, n_expanded, n_generated })
        };
        let stopped_by = match meter.spend(1) {
            Signal::Cancel => return Err(Cancelled),
            Signal::Finish => Some(StoppedBy::Deadline),
            Signal::Continue if n_expanded >= budget.max_expansions => Some(StoppedBy::MaxExpansions),
            Signal::Continue if is_out_of_memory(budget, &mut nodes, &mut open, most_open, space) => {
                Some(StoppedBy::Memory)
            }
            Signal::Continue => None,
        };
        if let Some(stopped_by) = stopped_by {
            return unfinished(stopped_by, &nodes, farthest, n_expanded, n_generated);
        }
        n_expanded += 1;
        if (entry.observation, farthest.f()) > (farthest.observation, entry.f()) {
            farthest = entry;
        }

        if i == last {
            let g = node.g + problem.end_cost(space.row(state));
            let way = CheapestWay { observation: entry.observation + 1, state, g, action: NO_ACTION, parent: entry.id };
            open.extend(nodes.reach(way).map(|id| Open::new(g, g, way.observation, id)));
        }
        let skip = (i < last).then_some((MoveKind::Skip, i + 1, state, 0.0, NO_ACTION));
        space.explore(state);
        let moves = problem.body.ways(space, state).flat_map(|(transition, cost)| {
            let moves = [(MoveKind::Match, i + 1), (MoveKind::Extra, i)].into_iter().filter(|(_, i)| *i <= last);
            moves.map(move |(kind, i)| (kind, i, transition.to, cost, transition.action))
        });
        for (kind, i, state, cost, action) in skip.into_iter().chain(moves) {
            match meter.spend(heuristic.work(i)) {
                Signal::Continue => {}
                Signal::Finish => {
                    return unfinished(StoppedBy::Deadline, &nodes, farthest, n_expanded, n_generated);
                }
                Signal::Cancel => return Err(Cancelled),
            }
            n_generated += 1;
            let row = space.row(state);
            let g = recurrence.arrive(kind, node.g + cost, problem.distances.distance(i, row));
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            let observation = i as u32;
            if let Some(id) = nodes.reach(CheapestWay { observation, state, g, action, parent: entry.id }) {
                open.push(Open::new(g + heuristic.cost_to_go(i, row), g, observation, id));
            }
        }
        most_open = most_open.max(open.len());
    }
    unreachable!("skipping leads to the last observation");
}

/// Whether there is no memory left. `most_open` nodes were open at the same time.
fn is_out_of_memory(
    budget: Budget,
    nodes: &mut FoundNodes,
    open: &mut BinaryHeap<Open>,
    most_open: usize,
    space: &mut impl Space,
) -> bool {
    /// As in [`best_first`](super::best_first).
    const SMALL: usize = 16;
    let n_bytes = nodes.size_bytes() + most_open * size_of::<Open>();
    let all_bytes = n_bytes + space.found_bytes();
    if all_bytes > budget.max_bytes / SMALL {
        #[expect(clippy::cast_precision_loss, reason = "about")]
        let growth = budget.max_bytes as f64 / all_bytes as f64;
        make_room(&mut nodes.ways, growth);
        let _ = open.try_reserve_exact(room_to_make(open.len(), open.capacity(), growth));
        space.make_room(growth);
    }
    budget.is_full(n_bytes, space)
}

/// The cheapest way found so far to a node.
#[derive(Clone, Copy, Debug)]
struct CheapestWay {
    /// Cost of the way, `g`.
    g: f64,
    /// Where it came from; [`NO_PARENT`] at the start.
    parent: NodeId,
    state: StateIdx,
    observation: u32,
    /// How it came.
    action: ActionIdx,
}

type NodeId = u32;

const NO_PARENT: NodeId = NodeId::MAX;

/// The nodes that were found, and where each is.
#[derive(Default)]
struct FoundNodes {
    ways: Vec<CheapestWay>,
    /// By observation and state.
    ids: FxHashMap<(u32, StateIdx), NodeId>,
}

/// What an entry of their hash table takes, in bytes, while it grows to twice its size.
const ENTRY_BYTES: usize = 4 * size_of::<((u32, StateIdx), NodeId)>();

/// About how much memory a search takes at most, in bytes, if it finds so many nodes.
pub(in crate::mapping) fn most_bytes(n_nodes: usize) -> usize {
    /// How often a node is open, at different costs.
    const N_TIMES_OPEN: usize = 4;
    n_nodes.saturating_mul(size_of::<CheapestWay>() + ENTRY_BYTES + N_TIMES_OPEN * size_of::<Open>())
}

impl FoundNodes {
    /// How much memory they take, in bytes, with their places in the index.
    fn size_bytes(&self) -> usize {
        size_of_val(self.ways.as_slice()) + self.ids.len() * ENTRY_BYTES
    }

    fn get(&self, id: NodeId) -> &CheapestWay {
        &self.ways[id as usize]
    }

    /// Takes note of a way to a node. Gives the node's id if the way is cheaper than any before.
    #[inline]
    fn reach(&mut self, way: CheapestWay) -> Option<NodeId> {
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        let next = self.ways.len() as NodeId;
        let id = *self.ids.entry((way.observation, way.state)).or_insert(next);
        if id == next {
            self.ways.push(way);
            return Some(id);
        }
        let known = &mut self.ways[id as usize];
        let is_cheaper = way.g < known.g;
        if is_cheaper {
            *known = way;
        }
        is_cheaper.then_some(id)
    }

    /// The way from the start to the node `id`, without the step to the end.
    fn path(&self, mut id: NodeId, last: usize) -> Vec<Move> {
        let mut moves = Vec::new();
        while id != NO_PARENT {
            let at = self.get(id);
            id = at.parent;
            if at.observation as usize > last {
                continue;
            }
            let kind = match (at.action == NO_ACTION, id != NO_PARENT && at.observation > self.get(id).observation) {
                _ if id == NO_PARENT => MoveKind::Start,
                (true, _) => MoveKind::Skip,
                (false, true) => MoveKind::Match,
                (false, false) => MoveKind::Extra,
            };
            let action = (at.action != NO_ACTION).then_some(at.action);
            moves.push(Move { kind, action, observation: at.observation, state: at.state });
        }
        moves.reverse();
        moves
    }
}

/// An entry of the open list. The greatest is expanded next: least `f`, then the later observation, then the most
/// recently found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Open {
    /// The bits of `f`, which are in its order, as it is not negative.
    f_bits: Reverse<u64>,
    observation: u32,
    id: NodeId,
    /// Those of the node's `g` when this was pushed: stale if the node has become cheaper.
    g_bits: u64,
}

impl Open {
    fn new(f: f64, g: f64, observation: u32, id: NodeId) -> Self {
        Self { f_bits: Reverse(f.to_bits()), observation, id, g_bits: g.to_bits() }
    }

    fn f(self) -> f64 {
        f64::from_bits(self.f_bits.0)
    }
}
