//! A* over nodes `(i, s)` (Hart, Nilsson & Raphael 1968).

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use rustc_hash::FxHashMap;

use super::{Found, Move, MoveKind, NO_ACTION, POLL_EVERY};
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::heuristic::Heuristic;
use crate::mapping::{Budget, Problem, StoppedBy};
use crate::model::{ActionIdx, Space, StateIdx, make_room, room_to_make};

/// Finds the cheapest mapping, as far as `heuristic` is admissible and `budget` allows, among those of at most `most_f`. If there is
/// none, it comes to its end without one. A node is expanded again if a cheaper
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
    most_f: f64,
    interrupt: &mut dyn Interrupt,
) -> Result<Found, Cancelled> {
    let last = problem.last();
    let actions = problem.model.actions();
    let mut nodes = Nodes::new(problem.demonstration.len(), space.n_states(), budget);
    let mut open = BinaryHeap::new();
    // With what was taken out.
    let mut most_open = 0;
    let (mut n_expanded, mut n_generated) = (0, 0);
    let mut meter = Meter::new(interrupt, POLL_EVERY);

    let row = space.row(problem.start);
    let g = problem.distances.distance(0, row);
    let first = nodes.reach(Way { observation: 0, state: problem.start, g, action: NO_ACTION, parent: 0 });
    open.extend(first.map(|id| Open { f: g + heuristic.cost_to_go(0, row), g, observation: 0, id }));
    // The farthest expanded node, and among those the most promising: where a search out of budget goes on greedily.
    let mut farthest = Open { f: f64::INFINITY, g, observation: 0, id: 0 };

    while let Some(entry) = open.pop() {
        let node = *nodes.get(entry.id);
        if entry.g > node.g {
            continue;
        }
        let (i, state) = (node.observation as usize, node.state);
        if i == last {
            let paths = vec![nodes.path(entry.id)];
            let least_f = f64::INFINITY;
            return Ok(Found { paths, is_complete: true, stopped_by: None, least_f, n_expanded, n_generated });
        }
        // Whatever is left of an expansion that is broken off costs at least the `f` of its node.
        let unfinished = |stopped_by, nodes: &Nodes, farthest: Open, n_expanded, n_generated| {
            let paths = [entry.id, farthest.id, 0].map(|id| nodes.path(id)).to_vec();
            let (least_f, stopped_by) = (entry.f, Some(stopped_by));
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
        if (entry.observation, farthest.f) > (farthest.observation, entry.f) {
            farthest = entry;
        }

        let skip = (i + 1, state, 0.0, NO_ACTION);
        space.explore(state);
        let moves = space.successors(state).iter().flat_map(|transition| {
            let cost = actions[usize::from(transition.action)].cost;
            [i + 1, i].map(|i| (i, transition.to, cost, transition.action))
        });
        for (i, state, cost, action) in std::iter::once(skip).chain(moves) {
            match meter.spend(heuristic.work(i)) {
                Signal::Continue => {}
                Signal::Finish => {
                    return unfinished(StoppedBy::Deadline, &nodes, farthest, n_expanded, n_generated);
                }
                Signal::Cancel => return Err(Cancelled),
            }
            n_generated += 1;
            let row = space.row(state);
            let g = node.g + cost + problem.distances.distance(i, row);
            #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX_OBSERVATIONS")]
            let observation = i as u32;
            if let Some(id) = nodes.reach(Way { observation, state, g, action, parent: entry.id }) {
                let f = g + heuristic.cost_to_go(i, row);
                if f <= most_f {
                    open.push(Open { f, g, observation, id });
                }
            }
        }
        most_open = most_open.max(open.len());
    }
    // Whatever is left costs more than `most_f`: there is no such mapping.
    let paths = [farthest.id, 0].map(|id| nodes.path(id)).to_vec();
    Ok(Found { paths, is_complete: true, stopped_by: None, least_f: f64::INFINITY, n_expanded, n_generated })
}

/// Whether there is no memory left. `most_open` nodes were open at the same time.
fn is_out_of_memory(
    budget: Budget,
    nodes: &mut Nodes,
    open: &mut BinaryHeap<Open>,
    most_open: usize,
    space: &mut impl Space,
) -> bool {
    /// As in [`best_first`](super::best_first).
    const SMALL: usize = 16;
    let n_bytes = nodes.size_bytes() + most_open * size_of::<Open>();
    let all_bytes = n_bytes + space.found_bytes();
    if all_bytes > budget.max_bytes / SMALL {
        let fixed_bytes = nodes.fixed_bytes();
        let most = budget.beside(fixed_bytes).max_bytes;
        #[expect(clippy::cast_precision_loss, reason = "about")]
        let growth = most as f64 / (all_bytes - fixed_bytes) as f64;
        make_room(&mut nodes.ways, growth);
        let _ = open.try_reserve_exact(room_to_make(open.len(), open.capacity(), growth));
        space.make_room(growth);
    }
    budget.is_full(n_bytes, space)
}

/// The cheapest way found so far to a node.
#[derive(Clone, Copy, Debug)]
struct Way {
    /// Cost of the way, `g`.
    g: f64,
    /// Where it came from.
    parent: NodeId,
    state: StateIdx,
    observation: u32,
    /// How it came.
    action: ActionIdx,
}

type NodeId = u32;

/// The least part of the memory that is taken at once.
const PAGE_BYTES: usize = 4096;

/// The nodes that were found, and where each is.
struct Nodes {
    ways: Vec<Way>,
    index: NodeIndex,
    /// How many keys each observation has.
    n_keys: usize,
}

/// Finds the id of a node.
enum NodeIndex {
    /// By `i * n_keys + s`, plus 1; 0 for none. Zeroed pages cost nothing until they are touched.
    Dense(Vec<NodeId>),
    /// For problems of which a dense index would be too large.
    Sparse(FxHashMap<u64, NodeId>),
}

/// Most entries of a dense index: 256 MB, and no more than this part of the memory.
const MAX_DENSE_INDEX: usize = 1 << 26;
const DENSE_INDEX_PART: usize = 4;

/// About how much memory a search takes at most, in bytes, if it finds so many nodes.
pub(in crate::mapping) fn most_bytes(n_nodes: usize) -> usize {
    /// How often a node is open, at different costs.
    const N_TIMES_OPEN: usize = 4;
    n_nodes.saturating_mul(size_of::<Way>() + size_of::<NodeId>() + N_TIMES_OPEN * size_of::<Open>())
}

impl Nodes {
    fn new(n_observations: usize, n_states: Option<usize>, budget: Budget) -> Self {
        let n_keys = n_states.unwrap_or(1 << StateIdx::BITS);
        let n_nodes = n_observations.saturating_mul(n_keys);
        let most = MAX_DENSE_INDEX.min(budget.max_bytes / DENSE_INDEX_PART / size_of::<NodeId>());
        let index =
            if n_nodes <= most { NodeIndex::Dense(vec![0; n_nodes]) } else { NodeIndex::Sparse(FxHashMap::default()) };
        Self { ways: Vec::new(), index, n_keys }
    }

    /// How much memory they take, in bytes, with their places in the index.
    fn size_bytes(&self) -> usize {
        /// Of a hash table, while it grows to twice its size.
        const ENTRY_BYTES: usize = 4 * size_of::<(u64, NodeId)>();
        let index = match &self.index {
            NodeIndex::Dense(_) => self.fixed_bytes(),
            NodeIndex::Sparse(ids) => ids.len() * ENTRY_BYTES,
        };
        size_of_val(self.ways.as_slice()) + index
    }

    /// What of this becomes no more.
    fn fixed_bytes(&self) -> usize {
        match &self.index {
            // A page of the memory is taken for the first node in it.
            NodeIndex::Dense(ids) => size_of_val(ids.as_slice()).min(self.ways.len().saturating_mul(PAGE_BYTES)),
            NodeIndex::Sparse(_) => 0,
        }
    }

    fn get(&self, id: NodeId) -> &Way {
        &self.ways[id as usize]
    }

    /// Takes note of a way to a node. Gives the node's id if the way is cheaper than any before.
    #[inline]
    fn reach(&mut self, way: Way) -> Option<NodeId> {
        #[expect(clippy::cast_possible_truncation, reason = "budgets keep nodes far below 2^32")]
        let next = self.ways.len() as NodeId;
        let key = way.observation as usize * self.n_keys + way.state as usize;
        let id = match &mut self.index {
            NodeIndex::Dense(ids) => {
                let id = ids[key];
                if id == 0 {
                    ids[key] = next + 1;
                    next
                } else {
                    id - 1
                }
            }
            NodeIndex::Sparse(ids) => *ids.entry(key as u64).or_insert(next),
        };
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

    /// The way from the start to the node `id`.
    fn path(&self, id: NodeId) -> Vec<Move> {
        let mut moves = Vec::new();
        let mut at = self.get(id);
        loop {
            let parent = self.get(at.parent);
            let is_start = at.observation == 0 && at.action == NO_ACTION;
            let kind = match (at.action == NO_ACTION, at.observation > parent.observation) {
                _ if is_start => MoveKind::Start,
                (true, _) => MoveKind::Skip,
                (false, true) => MoveKind::Match,
                (false, false) => MoveKind::Extra,
            };
            let action = (at.action != NO_ACTION).then_some(at.action);
            moves.push(Move { kind, action, observation: at.observation, state: at.state });
            if is_start {
                moves.reverse();
                return moves;
            }
            at = parent;
        }
    }
}

/// An entry of the open list. The greatest is expanded next: least `f`, then the later observation, then the most
/// recently found.
#[derive(Clone, Copy, Debug)]
struct Open {
    f: f64,
    /// The node's `g` when this was pushed: stale if the node has become cheaper.
    g: f64,
    observation: u32,
    id: NodeId,
}

impl Ord for Open {
    fn cmp(&self, other: &Self) -> Ordering {
        let key = |open: &Self| (open.observation, open.id);
        other.f.total_cmp(&self.f).then_with(|| key(self).cmp(&key(other)))
    }
}

impl PartialOrd for Open {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Open {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Open {}
