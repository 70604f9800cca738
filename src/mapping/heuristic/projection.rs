//! Lower bounds from projected problems, with costs partitioned among them.
//!
//! Keep of every state only a *group* of its attributes, and what is left is a small graph of classes, in which the
//! demonstration can be followed exactly. Doing so for several disjoint groups and adding up gives a lower bound of the whole
//! cost, if no cost is counted twice:
//!
//! - distances are sums over attributes, so each group pays the terms of its own;
//! - the cost of an action is split evenly among the groups that the transition changes. A group that it does not
//!   change moves for nothing, which is the projected `skip`.
//!
//! Every move of the real problem is then, in each group, a projected move, and the projected costs add up to at most
//! the real one. Hence the sum of the exact projected costs-to-go is admissible, and, as it satisfies the triangle inequality of
//! each projection, consistent (Holte, Felner, Newton, Meshulam & Furcy 2006, on additive pattern databases; Katz & Domshlak 2010,
//! on cost partitioning).

use std::collections::BinaryHeap;

use rustc_hash::{FxHashMap, FxHashSet};

use super::Heuristic;
use crate::interrupt::{Cancelled, Interrupt, Meter, Signal};
use crate::mapping::Problem;
use crate::mapping::open_list::CheapestFirst;
use crate::model::{ActionIdx, Model, StateIdx};

/// The projections of a model. They depend on neither demonstrations nor weights, so they are made once per model.
#[derive(Debug)]
pub(crate) struct Projections {
    groups: Vec<Group>,
    /// Distinct sets of groups that some transition changes.
    change_sets: Vec<Vec<u16>>,
}

/// A model, projected on some of its attributes.
#[derive(Debug)]
struct Group {
    /// Positions of the attributes, ascending.
    attributes: Vec<usize>,
    /// The class of each state. Shape `[n_states]`.
    class_of: Vec<ClassIdx>,
    /// The domain indices of each class's values. Shape `[n_classes, attributes.len()]`.
    class_rows: Vec<u32>,
    /// Distinct ways to change the class.
    edges: Vec<ProjectedEdge>,
    /// Whether its edges fit.
    is_kept: bool,
}

type ClassIdx = u32;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct ProjectedEdge {
    from: ClassIdx,
    to: ClassIdx,
    action: ActionIdx,
    /// Which groups change together with this one: an index into the change sets.
    change_set: u32,
}

/// Most edges of all groups together, and most entries of all change sets: 256 and 32 MB. Groups whose edges do not fit are
/// left out, which keeps the bound a bound.
const MAX_EDGES: usize = 1 << 24;

impl Projections {
    /// Projects `model` on each of its attributes that varies.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(crate) fn new(model: &Model, interrupt: &mut dyn Interrupt) -> Result<Self, Cancelled> {
        Self::bounded(model, MAX_EDGES, interrupt)
    }

    fn bounded(model: &Model, max_edges: usize, interrupt: &mut dyn Interrupt) -> Result<Self, Cancelled> {
        /// How many classes are looked up between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let states = model.states();
        let varies = |attribute: &usize| states.domain(*attribute).len() > 1;
        let groups =
            (0..model.schema().len()).filter(varies).map(|attribute| Group::new(model, &[attribute], &mut meter));
        let mut groups: Vec<Group> = groups.collect::<Result<_, _>>()?;

        let mut change_sets = ChangeSets::default();
        // `None` for a group that is left out.
        let mut edges: Vec<Option<FxHashSet<ProjectedEdge>>> = vec![Some(FxHashSet::default()); groups.len()];
        let mut n_edges = 0;
        let mut changed = Vec::new();
        for (from, transition) in model.graph().iter() {
            meter.spend_or_cancel(groups.len() as u64)?;
            let is_changed = |group: &Group| group.class(from) != group.class(transition.to);
            let kept = groups.iter().zip(&edges).zip(0u16..).filter(|((_, edges), _)| edges.is_some());
            changed.clear();
            changed.extend(kept.filter(|((group, _), _)| is_changed(group)).map(|(_, number)| number));
            let change_set = change_sets.number_of(&changed);
            for number in &changed {
                let group = &groups[usize::from(*number)];
                let (from, to) = (group.class(from), group.class(transition.to));
                let edge = ProjectedEdge { from, to, action: transition.action, change_set };
                let is_new = edges[usize::from(*number)].as_mut().is_some_and(|edges| edges.insert(edge));
                n_edges += usize::from(is_new);
            }
            if n_edges > max_edges || change_sets.n_entries > max_edges {
                leave_out_larger_half(&mut edges);
                change_sets.rebuild(&mut edges);
                n_edges = edges.iter().flatten().map(FxHashSet::len).sum();
            }
        }
        for (group, edges) in groups.iter_mut().zip(edges) {
            group.is_kept = edges.is_some();
            group.edges = edges.into_iter().flatten().collect();
            // The order of a hash set must not reach the results.
            group.edges.sort_unstable();
        }
        Ok(Self { groups, change_sets: change_sets.sets })
    }

    /// Approximate size in memory, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        let change_sets: usize =
            self.change_sets.iter().map(|set| size_of_val(set) + size_of_val(set.as_slice())).sum();
        change_sets + self.groups.iter().map(Group::size_bytes).sum::<usize>()
    }
}

/// Leaves out half of the groups that are kept, those with the most edges; the later ones among equals.
fn leave_out_larger_half(edges: &mut [Option<FxHashSet<ProjectedEdge>>]) {
    let kept = edges.iter().enumerate().filter_map(|(number, edges)| Some((edges.as_ref()?.len(), number)));
    let mut kept: Vec<_> = kept.collect();
    kept.sort_unstable();
    for (_, number) in kept.drain(kept.len() / 2..) {
        edges[number] = None;
    }
}

/// Distinct sets of groups, numbered as they are found.
#[derive(Default)]
struct ChangeSets {
    sets: Vec<Vec<u16>>,
    numbers: FxHashMap<Vec<u16>, u32>,
    n_entries: usize,
}

impl ChangeSets {
    fn number_of(&mut self, set: &[u16]) -> u32 {
        self.numbers.get(set).copied().unwrap_or_else(|| {
            #[expect(clippy::cast_possible_truncation, reason = "at most one per transition, fewer than 2^32")]
            let number = self.sets.len() as u32;
            self.numbers.insert(set.to_vec(), number);
            self.sets.push(set.to_vec());
            self.n_entries += set.len();
            number
        })
    }

    /// Removes the groups that have no edges any more, and numbers the sets anew.
    fn rebuild(&mut self, edges: &mut [Option<FxHashSet<ProjectedEdge>>]) {
        let old = std::mem::take(self);
        let numbers: Vec<u32> = old
            .sets
            .into_iter()
            .map(|mut set| {
                set.retain(|group| edges[usize::from(*group)].is_some());
                self.number_of(&set)
            })
            .collect();
        for edges in edges.iter_mut().flatten() {
            let renumbered =
                |edge: ProjectedEdge| ProjectedEdge { change_set: numbers[edge.change_set as usize], ..edge };
            *edges = std::mem::take(edges).into_iter().map(renumbered).collect();
        }
    }
}

impl Group {
    fn new(model: &Model, attributes: &[usize], meter: &mut Meter<'_>) -> Result<Self, Cancelled> {
        let states = model.states();
        let mut classes: FxHashMap<Vec<u32>, ClassIdx> = FxHashMap::default();
        let mut class_rows = Vec::new();
        let mut key = Vec::with_capacity(attributes.len());
        let class_of = (0..states.len()).map(|state| {
            meter.spend_or_cancel(1)?;
            let row = states.row(state);
            key.clear();
            key.extend(attributes.iter().map(|attribute| row[*attribute]));
            Ok(classes.get(&key).copied().unwrap_or_else(|| {
                #[expect(clippy::cast_possible_truncation, reason = "at most one per state")]
                let class = classes.len() as ClassIdx;
                classes.insert(key.clone(), class);
                class_rows.extend_from_slice(&key);
                class
            }))
        });
        let class_of = class_of.collect::<Result<_, _>>()?;
        Ok(Self { attributes: attributes.to_vec(), class_of, class_rows, edges: Vec::new(), is_kept: true })
    }

    fn class(&self, state: StateIdx) -> ClassIdx {
        self.class_of[state as usize]
    }

    fn n_classes(&self) -> usize {
        self.class_rows.len() / self.attributes.len()
    }

    /// What the group's attributes add to the distance of the observation `i` and the class `class`.
    fn term(&self, problem: &Problem<'_>, i: usize, class: usize) -> f64 {
        let row = &self.class_rows[class * self.attributes.len()..];
        let values = self.attributes.iter().zip(row);
        values.map(|(attribute, value)| problem.distances.term(*attribute, i, *value)).sum()
    }

    fn size_bytes(&self) -> usize {
        size_of_val(self.class_of.as_slice())
            + size_of_val(self.class_rows.as_slice())
            + size_of_val(self.edges.as_slice())
    }
}

/// The sum of exact costs-to-go in the projections, for one problem.
#[derive(Debug)]
pub(crate) struct Projected<'m> {
    tables: Vec<Table<'m>>,
}

#[derive(Debug)]
struct Table<'m> {
    group: &'m Group,
    /// Shape `[n_observations, n_classes]`.
    cost_to_go: Vec<f64>,
}

/// Most entries of all tables together: 128 MB. Groups that do not fit, the largest, are left out, which keeps the bound a
/// bound.
const MAX_TABLE_ENTRIES: usize = 1 << 24;

impl<'m> Projected<'m> {
    /// Solves the projected problems, backwards over the demonstration. `None` if `interrupt` said to finish first.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(crate) fn solve(
        projections: &'m Projections,
        problem: &Problem<'_>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        let used = used_groups(projections, problem, MAX_TABLE_ENTRIES);
        let n_sharing: Vec<f64> = projections
            .change_sets
            .iter()
            .map(|groups| f64::from(groups.iter().map(|group| u32::from(used[usize::from(*group)])).sum::<u32>()))
            .collect();
        let mut tables = Vec::new();
        for (group, _) in projections.groups.iter().zip(used).filter(|(_, is_used)| *is_used) {
            let share =
                |edge: &ProjectedEdge| problem.model.action(edge.action).cost / n_sharing[edge.change_set as usize];
            match Table::solve(group, problem, share, interrupt)? {
                Some(table) => tables.push(table),
                None => return Ok(None),
            }
        }
        Ok(Some(Self { tables }))
    }
}

/// Which groups have tables, the smallest first as far as `max_entries` go.
fn used_groups(projections: &Projections, problem: &Problem<'_>, max_entries: usize) -> Vec<bool> {
    let groups = &projections.groups;
    // A group whose attributes weigh nothing would take its share of the actions' costs to no purpose.
    let is_wanted = |group: &Group| {
        group.is_kept && group.attributes.iter().any(|attribute| problem.distances.is_active(*attribute))
    };
    let mut wanted: Vec<usize> = (0..groups.len()).filter(|number| is_wanted(&groups[*number])).collect();
    wanted.sort_by_key(|number| groups[*number].n_classes());
    let mut used = vec![false; groups.len()];
    let mut n_left = max_entries;
    for number in wanted {
        let n_entries = problem.demonstration.len().saturating_mul(groups[number].n_classes());
        let Some(left) = n_left.checked_sub(n_entries) else { break };
        n_left = left;
        used[number] = true;
    }
    used
}

impl Heuristic for Projected<'_> {
    #[inline]
    fn cost_to_go(&self, observation: usize, state: StateIdx) -> f64 {
        self.tables.iter().map(|table| table.cost_to_go(observation, state)).sum()
    }
}

impl<'m> Table<'m> {
    #[inline]
    fn cost_to_go(&self, observation: usize, state: StateIdx) -> f64 {
        self.cost_to_go[observation * self.group.n_classes() + self.group.class(state) as usize]
    }

    /// With `N_i(v) = term(i+1, v) + H_{i+1}(v)`, what it costs to be next at class `v`:
    ///
    /// ```text
    /// H_n(v) = 0
    /// H_i(v) = min( N_i(v),                              skip
    ///               share(v, v') + N_i(v'),              match
    ///               share(v, v') + term(i, v') + H_i(v') extra )
    /// ```
    ///
    /// The last row refers to the same observation, so each observation is one pass of Dijkstra's algorithm.
    fn solve(
        group: &'m Group,
        problem: &Problem<'_>,
        share: impl Fn(&ProjectedEdge) -> f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Self>, Cancelled> {
        /// How many classes are looked at between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let (n_observations, n_classes) = (problem.demonstration.len(), group.n_classes());
        let predecessors = Predecessors::new(n_classes, &group.edges, share);
        let mut cost_to_go = vec![0.0; n_observations * n_classes];
        let terms = |i: usize| (0..n_classes).map(move |class| group.term(problem, i, class));
        let mut next: Vec<f64> = vec![0.0; n_classes];
        let mut here: Vec<f64> = terms(problem.last()).collect();
        let mut open = BinaryHeap::new();
        for i in (0..problem.last()).rev() {
            match meter.spend(n_classes as u64) {
                Signal::Continue => {}
                Signal::Finish => return Ok(None),
                Signal::Cancel => return Err(Cancelled),
            }
            let (row, row_after) = cost_to_go[i * n_classes..(i + 2) * n_classes].split_at_mut(n_classes);
            for class in 0..n_classes {
                next[class] = here[class] + row_after[class];
            }
            here.clear();
            here.extend(terms(i));
            row.copy_from_slice(&next);
            for (class, cost) in next.iter().enumerate() {
                for (from, share) in predecessors.of(class) {
                    let from = &mut row[*from as usize];
                    *from = from.min(share + cost);
                }
            }
            open.extend(row.iter().zip(0..).map(|(cost, class)| CheapestFirst { cost: *cost, id: class }));
            while let Some(CheapestFirst { cost, id: class }) = open.pop() {
                match meter.spend(1) {
                    Signal::Continue => {}
                    Signal::Finish => return Ok(None),
                    Signal::Cancel => return Err(Cancelled),
                }
                if cost > row[class as usize] {
                    continue;
                }
                for (from, share) in predecessors.of(class as usize) {
                    let extra = share + here[class as usize] + cost;
                    if extra < row[*from as usize] {
                        row[*from as usize] = extra;
                        open.push(CheapestFirst { cost: extra, id: *from });
                    }
                }
            }
        }
        Ok(Some(Self { group, cost_to_go }))
    }
}

/// The ways into each class, cheapest of each origin.
struct Predecessors {
    /// `offsets[v]..offsets[v + 1]` are the edges into `v`. Shape `[n_classes + 1]`.
    offsets: Vec<usize>,
    edges: Vec<(ClassIdx, f64)>,
}

impl Predecessors {
    fn new(n_classes: usize, edges: &[ProjectedEdge], share: impl Fn(&ProjectedEdge) -> f64) -> Self {
        let mut into: Vec<_> = edges.iter().map(|edge| (edge.to, edge.from, share(edge))).collect();
        into.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
        into.dedup_by_key(|(to, from, _)| (*to, *from));
        let mut offsets = vec![0; n_classes + 1];
        for (to, _, _) in &into {
            offsets[*to as usize + 1] += 1;
        }
        for class in 0..n_classes {
            offsets[class + 1] += offsets[class];
        }
        Self { offsets, edges: into.into_iter().map(|(_, from, share)| (from, share)).collect() }
    }

    fn of(&self, class: usize) -> &[(ClassIdx, f64)] {
        &self.edges[self.offsets[class]..self.offsets[class + 1]]
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::interrupt::Uninterrupted;
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
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let kept = |max_edges| {
            let projections = Projections::bounded(&model, max_edges, &mut Uninterrupted).unwrap();
            projections.groups.iter().map(|group| (group.is_kept, group.edges.len())).collect::<Vec<_>>()
        };
        assert_eq!(kept(MAX_EDGES), [(true, 99), (true, 2)]);
        assert_eq!(kept(50), [(false, 0), (true, 2)]);
        assert_eq!(kept(1), [(false, 0), (false, 0)]);
    }
}
