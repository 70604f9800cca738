//! Others that can solve the same problem.

use std::cell::Cell;
use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashSet};

use etude_core::mapping::Problem;
use etude_core::model::{Model, Start};
use pathfinding::prelude::astar;
use petgraph::visit::{EdgeRef, GraphBase, GraphRef, IntoEdgeReferences, IntoEdges, IntoNeighbors, Visitable};

pub(crate) struct Solved {
    pub(crate) cost: f64,
    pub(crate) n_expanded: u64,
    pub(crate) n_steps: Option<usize>,
}

/// Costs as the peers add them, in millionths: integers are totally ordered, and exact here.
pub(crate) type MicroCost = u64;

/// A node: observation and state. The first is [`ROOT`].
pub(crate) type Node = (u32, u32);

/// Stands before the first observation: from here, each start is reached by a move of its own.
const ROOT: Node = (u32::MAX, 0);

/// The problem for general searches.
pub(crate) struct Peer<'m> {
    model: &'m Model,
    starts: Vec<u32>,
    /// Terms of the distance by the state's value. Shape `[n_observations][n_attributes][domain size]`.
    terms: Vec<Vec<Vec<MicroCost>>>,
    action_costs: Vec<MicroCost>,
    n_expanded: Cell<u64>,
}

impl<'m> Peer<'m> {
    pub(crate) fn new(model: &'m Model, problem: &Problem<'_>) -> Self {
        let weights = problem.weights().as_slice();
        let terms = problem.demonstration().iter().map(|observation| {
            let attributes = model.schema().attributes().iter().zip(observation).zip(weights).enumerate();
            let terms = attributes.map(|(position, ((attribute, observed), weight))| {
                let term = |own| observed.as_ref().map_or(0, |observed| micro(attribute.term(*weight, observed, own)));
                model.states().domain(position).iter().map(term).collect()
            });
            terms.collect()
        });
        let action_costs = model.actions().iter().map(|action| micro(action.cost)).collect();
        let starts = match model.start() {
            Start::State(state) => vec![*state],
            Start::Candidates(states) => states.clone(),
            Start::Any => (0..model.states().len()).filter(|state| !model.is_unsafe(*state)).collect(),
        };
        Self { model, starts, terms: terms.collect(), action_costs, n_expanded: Cell::new(0) }
    }

    fn last(&self) -> u32 {
        u32::try_from(self.terms.len() - 1).expect("demonstrations are short")
    }

    /// The terms of a distance, by attribute.
    fn terms_of(&self, (i, state): Node) -> impl Iterator<Item = MicroCost> {
        let values = self.model.states().row(state);
        self.terms[i as usize].iter().zip(values).map(|(terms, value)| terms[*value as usize])
    }

    fn distance(&self, node: Node) -> MicroCost {
        self.terms_of(node).sum()
    }

    /// The moves out of a node, with what they cost.
    fn moves(&self, node: Node) -> impl Iterator<Item = (Node, MicroCost)> {
        let (i, state) = node;
        let (is_root, is_last) = (node == ROOT, i == self.last());
        let starts: &[u32] = if is_root { &self.starts } else { &[] };
        let starts = starts.iter().map(|start| ((0, *start), 0));
        let skip = (!is_root && !is_last).then(|| ((i + 1, state), 0));
        let transitions = if is_root { &[] } else { self.model.graph().successors(state) };
        let moves = transitions.iter().flat_map(move |transition| {
            let cost = self.action_costs[usize::from(transition.action)];
            let matched = (!is_last).then(|| ((i + 1, transition.to), cost));
            [matched, Some(((i, transition.to), cost))].into_iter().flatten()
        });
        starts.chain(skip).chain(moves).map(|(node, cost)| (node, cost + self.distance(node)))
    }

    fn solved(&self, cost: MicroCost) -> Solved {
        Solved { cost: cost as f64 / 1e6, n_expanded: self.n_expanded.get(), n_steps: None }
    }

    /// A* of the crate `pathfinding`.
    pub(crate) fn pathfinding(&self, heuristic: impl Fn(Node) -> MicroCost) -> Solved {
        self.n_expanded.set(0);
        let successors = |node: &Node| {
            self.n_expanded.set(self.n_expanded.get() + 1);
            self.moves(*node).collect::<Vec<_>>()
        };
        let is_end = |(i, _): &Node| *i == self.last();
        let found = astar(&ROOT, successors, |node| if *node == ROOT { 0 } else { heuristic(*node) }, is_end);
        let (_, cost) = found.expect("there is always a mapping");
        self.solved(cost)
    }

    /// A* of the crate `petgraph`, on a graph that is unfolded as it goes.
    pub(crate) fn petgraph(&self, heuristic: impl Fn(Node) -> MicroCost) -> Solved {
        self.n_expanded.set(0);
        let is_end = |(i, _): Node| i == self.last();
        let estimate = |node| if node == ROOT { 0 } else { heuristic(node) };
        let found = petgraph::algo::astar(Unfolded(self), ROOT, is_end, |edge| edge.cost, estimate);
        let (cost, _) = found.expect("there is always a mapping");
        self.solved(cost)
    }

    /// Dijkstra's algorithm, one observation after the other, written to be read: the cheapest way to every state at an
    /// observation, from those at the one before.
    pub(crate) fn layered(&self) -> Solved {
        let n_states = self.model.states().len() as usize;
        let mut n_expanded = 0;
        let mut costs: Vec<Option<MicroCost>> = vec![None; n_states];
        for start in &self.starts {
            costs[*start as usize] = Some(self.distance((0, *start)));
        }
        for i in 0..=self.last() {
            let mut open: BinaryHeap<Reverse<(MicroCost, u32)>> =
                costs.iter().zip(0..).filter_map(|(cost, state)| Some(Reverse(((*cost)?, state)))).collect();
            let mut next = vec![None; n_states];
            while let Some(Reverse((cost, state))) = open.pop() {
                if costs[state as usize] != Some(cost) {
                    continue;
                }
                n_expanded += 1;
                for ((layer, to), move_cost) in self.moves((i, state)) {
                    let costs = if layer == i { &mut costs } else { &mut next };
                    let known = &mut costs[to as usize];
                    if known.is_none_or(|known| cost + move_cost < known) {
                        *known = Some(cost + move_cost);
                        if layer == i {
                            open.push(Reverse((cost + move_cost, to)));
                        }
                    }
                }
            }
            if i < self.last() {
                costs = next;
            }
        }
        let cost = costs.into_iter().flatten().min().expect("there is always a mapping");
        Solved { cost: cost as f64 / 1e6, n_expanded, n_steps: None }
    }

    /// The paper's estimate.
    pub(crate) fn paper(&self, (i, state): Node) -> MicroCost {
        let ahead = i + 1..=self.last();
        let Some(j) = ahead.min_by_key(|j| self.distance((*j, state))) else { return 0 };
        let least = self.action_costs.iter().copied().min().unwrap_or(0);
        let mut terms: Vec<MicroCost> = self.terms_of((j, state)).filter(|term| *term > 0).collect();
        terms.sort_unstable_by(|a, b| b.cmp(a));
        let mut remaining: MicroCost = terms.iter().sum();
        let mut estimate = 0;
        for term in terms {
            remaining -= term;
            estimate += remaining + least;
        }
        estimate + MicroCost::from(self.last() - j) * least
    }
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "costs here are small and positive")]
pub(crate) fn micro(cost: f64) -> MicroCost {
    (cost * 1e6).round() as MicroCost
}

/// As [`micro`], rounded down by enough to stay a lower bound of sums of rounded costs.
pub(crate) fn micro_floor(cost: f64) -> MicroCost {
    micro(cost).saturating_sub(1000)
}

/// The nodes of a problem as a graph for `petgraph`.
#[derive(Clone, Copy)]
struct Unfolded<'p>(&'p Peer<'p>);

#[derive(Clone, Copy)]
struct Edge {
    from: Node,
    to: Node,
    cost: MicroCost,
}

impl EdgeRef for Edge {
    type NodeId = Node;
    type EdgeId = (Node, Node);
    type Weight = ();

    fn source(&self) -> Node {
        self.from
    }

    fn target(&self) -> Node {
        self.to
    }

    fn weight(&self) -> &() {
        &()
    }

    fn id(&self) -> (Node, Node) {
        (self.from, self.to)
    }
}

impl GraphBase for Unfolded<'_> {
    type NodeId = Node;
    type EdgeId = (Node, Node);
}

impl GraphRef for Unfolded<'_> {}

impl<'p> IntoNeighbors for Unfolded<'p> {
    type Neighbors = Box<dyn Iterator<Item = Node> + 'p>;

    fn neighbors(self, node: Node) -> Self::Neighbors {
        Box::new(self.0.moves(node).map(|(to, _)| to))
    }
}

impl petgraph::visit::Data for Unfolded<'_> {
    type NodeWeight = ();
    type EdgeWeight = ();
}

impl IntoEdgeReferences for Unfolded<'_> {
    type EdgeRef = Edge;
    type EdgeReferences = std::iter::Empty<Edge>;

    fn edge_references(self) -> Self::EdgeReferences {
        std::iter::empty()
    }
}

impl IntoEdges for Unfolded<'_> {
    type Edges = std::vec::IntoIter<Edge>;

    fn edges(self, from: Node) -> Self::Edges {
        self.0.n_expanded.set(self.0.n_expanded.get() + 1);
        let edges: Vec<Edge> = self.0.moves(from).map(|(to, cost)| Edge { from, to, cost }).collect();
        edges.into_iter()
    }
}

impl Visitable for Unfolded<'_> {
    type Map = HashSet<Node>;

    fn visit_map(&self) -> Self::Map {
        HashSet::new()
    }

    fn reset_map(&self, map: &mut Self::Map) {
        map.clear();
    }
}
