//! Lower bounds from projected problems, with costs partitioned among them.
//!
//! Keep of every state only one attribute, and what is left is a small graph of the attribute's values, in which the demonstration can be
//! followed exactly. Doing so for every attribute and adding up gives a lower bound of the whole cost, if no cost is counted twice:
//!
//! - distances are sums over attributes, so each attribute pays its own terms;
//! - the cost of a transition is split evenly among the attributes that the transition changes, of those that take part. An attribute that
//!   it does not change moves for nothing, which is the projected `skip`;
//! - an extra action pays its part x of the distance once more, in all attributes: also in those that it does not change, which the others'
//!   projections do not see. So let `least_k(i)` be the least term of the attribute k at observation i, of any value that
//!   it may have; it is above 0 where the body can never have what was seen. The part x of the sum of these over all attributes is paid
//!   by every extra action at i, and is split as the cost of the action is (`share_i`, of both); an attribute that changes pays, besides,
//!   the part x of what its term is above its least (`rest`);
//! - what ending costs is a sum over attributes, as distances are. Extra actions at the last observation may save some of it.
//!
//! Every move of the real problem is then, in each attribute, a projected move or none, and the projected costs add up to at most
//! the real one. Hence the sum of the exact projected costs-to-go is admissible, and, as it satisfies the triangle inequality of
//! each projection, consistent (Holte, Felner, Newton, Meshulam & Furcy 2006, on additive pattern databases; Katz & Domshlak 2010,
//! on cost partitioning).
//!
//! Attributes could be projected together, for higher estimates. That was measured on caves, random tables, a planner's model of
//! two-valued attributes and a large grid, and shortened no search: making the tables took as long as what they saved. Where it does
//! shorten searches, an [abstraction](super::abstraction) does it without tables.

use rustc_hash::{FxHashMap, FxHashSet};

use crate::interrupt::{Interrupt, Interrupted, Meter};
use crate::mapping::conditions::Body;
use crate::model::{ActionIdx, Model, Operator, OwnCost, Rows};

/// The projections of a model. They depend on neither demonstrations nor weights, so they are made once per model.
#[derive(Debug)]
pub(crate) struct Projections {
    /// By attribute that varies.
    pub(super) attributes: Vec<Projection>,
    /// Distinct sets of these that some transition changes.
    pub(super) change_sets: Vec<Vec<u16>>,
    /// Distinct costs that transitions have of their own, as [`Edge::own_cost`] numbers them.
    own_costs: Vec<f64>,
}

/// A model, projected on one of its attributes.
#[derive(Debug)]
pub(super) struct Projection {
    /// The attribute's.
    pub(super) position: usize,
    pub(super) n_values: usize,
    /// Distinct ways to change the value, by the value to which they lead, and in each row by the one from which; no rows if they do not
    /// fit.
    pub(super) edges: Rows<Edge>,
    /// Whether its edges fit.
    pub(super) is_kept: bool,
}

/// The domain index of an attribute's value.
pub(super) type ValueIdx = u32;

/// A way to change a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Edge {
    pub(super) from: ValueIdx,
    /// Which attributes change with it.
    pub(super) change_set: u32,
    pub(super) action: ActionIdx,
    /// The number of what the transition costs itself, from 1 on; 0: what the action costs.
    own_cost: OwnCostIdx,
}

type OwnCostIdx = u16;

/// Distinct costs that transitions have of their own.
#[derive(Default)]
struct OwnCosts {
    /// In the order of their numbers. The last number there can be is that of the least of all further costs, which keeps the bound a
    /// bound.
    costs: Vec<f64>,
    numbers: FxHashMap<u64, OwnCostIdx>,
}

impl OwnCosts {
    fn number_of(&mut self, cost: f64) -> OwnCostIdx {
        if let Some(number) = self.numbers.get(&cost.to_bits()) {
            return *number;
        }
        if self.costs.len() < usize::from(OwnCostIdx::MAX) {
            self.costs.push(cost);
        } else if let Some(last) = self.costs.last_mut() {
            *last = last.min(cost);
            return OwnCostIdx::MAX;
        }
        #[expect(clippy::cast_possible_truncation, reason = "there are at most MAX")]
        let number = self.costs.len() as OwnCostIdx;
        self.numbers.insert(cost.to_bits(), number);
        number
    }
}

/// Most edges of all projections together, and most entries of all change sets: 256 and 32 MB. Projections whose edges do not fit are
/// left out, which keeps the bound a bound.
const MAX_EDGES: usize = 1 << 24;

impl Projections {
    /// Projects `model` on each of its attributes that varies; a model that is searched lazily, by its operators. Takes about
    /// `max_bytes` at most while it does: attributes of which the projections do not fit are left out.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub(crate) fn new(model: &Model, max_bytes: usize, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        /// What an edge takes in a set of them, which is at most half empty just after it has grown, and then in a list and in rows.
        const EDGE_BYTES: usize = 4 * size_of::<(ValueIdx, Edge)>();
        Self::bounded(model, MAX_EDGES.min(max_bytes / EDGE_BYTES), interrupt)
    }

    fn bounded(model: &Model, max_edges: usize, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        /// How many values are looked up between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let states = model.states();
        let positions = (0..model.schema().len()).filter(|position| states.domain(*position).len() > 1);
        let mut found = EdgeSets::of(positions.collect(), max_edges);
        for (position, edges) in found.positions.iter().zip(&mut found.edges) {
            *edges = edges.take().filter(|_| model.is_told(*position));
        }
        match model.operators() {
            None => {
                let graph = model.graph();
                for from in 0..states.len() {
                    let own_costs = graph.own_costs(from);
                    for (n, transition) in graph.successors(from).iter().enumerate() {
                        meter.spend_or_stop(found.positions.len() as u64)?;
                        let own_cost = own_costs.get(n).and_then(|cost| cost.get());
                        let rows = (states.row(from), states.row(transition.to));
                        found.add_transition(transition.action, own_cost, rows);
                    }
                }
            }
            Some(operators) => {
                for operator in operators {
                    meter.spend_or_stop(found.positions.len() as u64)?;
                    found.add_operator(&operator);
                }
            }
        }
        let EdgeSets { positions, edges, change_sets, own_costs, .. } = found;
        let mut attributes = Vec::with_capacity(positions.len());
        for (position, edges) in positions.into_iter().zip(edges) {
            let n_values = states.domain(position).len();
            let is_kept = edges.is_some();
            let edges: Vec<(ValueIdx, Edge)> = edges.into_iter().flatten().collect();
            let mut edges = Rows::try_of_entries(n_values, edges.iter().copied(), || meter.spend_or_stop(1))?;
            for value in 0..n_values {
                let into = edges.of_mut(value);
                meter.spend_or_stop(1 + into.len() as u64)?;
                into.sort_unstable();
            }
            attributes.push(Projection { position, n_values, edges, is_kept });
        }
        Ok(Self { attributes, change_sets: change_sets.sets, own_costs: own_costs.costs })
    }

    /// Approximate size in memory, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        let change_sets: usize =
            self.change_sets.iter().map(|set| size_of_val(set) + size_of_val(set.as_slice())).sum();
        change_sets + self.attributes.iter().map(|attribute| attribute.edges.size_bytes()).sum::<usize>()
    }
}

impl Projections {
    /// What an edge costs a body: infinite if it lacks the action.
    pub(super) fn cost(&self, edge: &Edge, body: &Body) -> f64 {
        let own = usize::from(edge.own_cost).checked_sub(1).map(|number| OwnCost::of(Some(self.own_costs[number])));
        body.cost(edge.action, own.as_ref())
    }
}

impl Projection {
    /// Whether no action of a body changes the attribute.
    pub(super) fn is_constant(&self, body: &Body) -> bool {
        !self.edges.iter().flatten().any(|edge| body.has(edge.action))
    }
}

/// The edges of all projections, as they are found.
struct EdgeSets {
    positions: Vec<usize>,
    /// By projection, each edge with the value to which it leads; `None` for one that is left out.
    edges: Vec<Option<FxHashSet<(ValueIdx, Edge)>>>,
    n_edges: usize,
    max_edges: usize,
    change_sets: ChangeSets,
    own_costs: OwnCosts,
    /// The values that change, from and to what, of the projections that are kept.
    changed: Vec<(u16, ValueIdx, ValueIdx)>,
}

impl EdgeSets {
    fn of(positions: Vec<usize>, max_edges: usize) -> Self {
        let edges = vec![Some(FxHashSet::default()); positions.len()];
        let (change_sets, own_costs) = (ChangeSets::default(), OwnCosts::default());
        Self { positions, edges, n_edges: 0, max_edges, change_sets, own_costs, changed: Vec::new() }
    }

    /// Adds what a transition between states with these rows changes.
    fn add_transition(&mut self, action: ActionIdx, own_cost: Option<f64>, (row, row_after): (&[u32], &[u32])) {
        let values = (0..).zip(&self.positions).map(|(number, at)| (number, row[*at], row_after[*at]));
        let edges = &self.edges;
        self.changed.clear();
        self.changed.extend(values.filter(|(number, from, to)| from != to && edges[usize::from(*number)].is_some()));
        self.insert_changes(action, own_cost);
    }

    /// Adds what any transition that is like `operator` changes.
    fn add_operator(&mut self, operator: &Operator) {
        self.changed.clear();
        for (number, (position, edges)) in (0..).zip(self.positions.iter().zip(&self.edges)) {
            let change = operator.changed.iter().find(|(at, _, _)| at == position);
            self.changed.extend(change.filter(|_| edges.is_some()).map(|(_, from, to)| (number, *from, *to)));
        }
        self.insert_changes(operator.action, operator.cost);
    }

    fn insert_changes(&mut self, action: ActionIdx, own_cost: Option<f64>) {
        let own_cost = own_cost.map_or(0, |cost| self.own_costs.number_of(cost));
        let change_set = self.change_sets.number_of(self.changed.iter().map(|(number, _, _)| *number));
        for (number, from, to) in &self.changed {
            let edges = self.edges[usize::from(*number)].as_mut();
            let is_new =
                edges.is_some_and(|edges| edges.insert((*to, Edge { from: *from, change_set, action, own_cost })));
            self.n_edges += usize::from(is_new);
        }
        if self.n_edges > self.max_edges || self.change_sets.n_entries > self.max_edges {
            self.leave_out_larger_half();
            self.change_sets.rebuild(&mut self.edges);
            self.n_edges = self.edges.iter().flatten().map(FxHashSet::len).sum();
        }
    }

    /// Leaves out half of the projections that are kept, those with the most edges; the later ones among equals.
    fn leave_out_larger_half(&mut self) {
        let kept = self.edges.iter().enumerate().filter_map(|(number, edges)| Some((edges.as_ref()?.len(), number)));
        let mut kept: Vec<_> = kept.collect();
        kept.sort_unstable();
        for (_, number) in kept.drain(kept.len() / 2..) {
            self.edges[number] = None;
        }
    }
}

/// Distinct sets of projections, numbered as they are found.
#[derive(Default)]
pub(super) struct ChangeSets {
    pub(super) sets: Vec<Vec<u16>>,
    numbers: FxHashMap<Vec<u16>, u32>,
    n_entries: usize,
    /// The set in hand.
    set: Vec<u16>,
}

impl ChangeSets {
    pub(super) fn number_of(&mut self, set: impl Iterator<Item = u16>) -> u32 {
        self.set.clear();
        self.set.extend(set);
        self.numbers.get(&self.set).copied().unwrap_or_else(|| {
            #[expect(clippy::cast_possible_truncation, reason = "at most one per transition, fewer than 2^32")]
            let number = self.sets.len() as u32;
            self.numbers.insert(self.set.clone(), number);
            self.sets.push(self.set.clone());
            self.n_entries += self.set.len();
            number
        })
    }

    /// Removes the projections that have no edges any more, and numbers the sets anew.
    fn rebuild(&mut self, edges: &mut [Option<FxHashSet<(ValueIdx, Edge)>>]) {
        let old = std::mem::take(self);
        let is_kept = |number: &u16| edges[usize::from(*number)].is_some();
        let numbers: Vec<u32> =
            old.sets.into_iter().map(|set| self.number_of(set.into_iter().filter(is_kept))).collect();
        for edges in edges.iter_mut().flatten() {
            let renumbered =
                |(to, edge): (ValueIdx, Edge)| (to, Edge { change_set: numbers[edge.change_set as usize], ..edge });
            *edges = std::mem::take(edges).into_iter().map(renumbered).collect();
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::mapping::by_definition::compiled;
    use crate::model::{Definition, Limits};

    #[test]
    fn projections_whose_edges_do_not_fit_are_left_out_largest_first() {
        let states: Vec<_> = (0..100).map(|n| json!([n, n % 2])).collect();
        let transitions: Vec<_> = (0..99).map(|n| json!([n, 0, n + 1])).collect();
        let model = json!({
            "attributes": [{"name": "n", "kind": "number"}, {"name": "parity", "kind": "number"}],
            "actions": [{"name": "on"}],
            "dynamics": {"kind": "table", "states": states, "transitions": transitions},
        });
        let model = compiled(&model);
        let kept = |max_edges| {
            let projections = Projections::bounded(&model, max_edges, &mut Uninterrupted).unwrap();
            projections.attributes.iter().map(|own| (own.is_kept, own.edges.n_items())).collect::<Vec<_>>()
        };
        assert_eq!(kept(MAX_EDGES), [(true, 99), (true, 2)]);
        assert_eq!(kept(50), [(false, 0), (true, 2)]);
        assert_eq!(kept(1), [(false, 0), (false, 0)]);
    }

    #[test]
    fn operators_allow_all_that_transitions_do() {
        let definition = json!({"dynamics": {
            "kind": "wumpus", "width": 4, "height": 3, "pits": [[3, 2]], "wumpi": [[2, 0], [0, 2]],
            "gold": [[1, 0], [1, 0], [2, 0]], "arrows": 2,
        }});
        let definition = Definition::read(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let unlisted = Limits { max_states: 0, ..Limits::DEFAULT };
        let unlisted = Model::compile(&definition, unlisted, &mut Uninterrupted).unwrap();
        let none = || EdgeSets::of((0..model.schema().len()).collect(), MAX_EDGES);
        let (mut known, mut lazy) = (none(), none());
        for (from, transition) in model.graph().iter() {
            let [row, row_after] = [from, transition.to].map(|state| model.states().row(state));
            known.add_transition(transition.action, None, (row, row_after));
        }
        unlisted.operators().unwrap().for_each(|operator| lazy.add_operator(&operator));
        let of = |found: &EdgeSets, number: usize| -> FxHashSet<(ValueIdx, ValueIdx, ActionIdx, Vec<u16>)> {
            let set = |edge: &Edge| found.change_sets.sets[edge.change_set as usize].clone();
            let edges = found.edges[number].iter().flatten();
            edges.map(|(to, edge)| (edge.from, *to, edge.action, set(edge))).collect()
        };
        for number in 0..model.schema().len() {
            let (known, lazy) = (of(&known, number), of(&lazy, number));
            assert!(!known.is_empty() && known.is_subset(&lazy), "attribute {number}");
        }
    }
}
