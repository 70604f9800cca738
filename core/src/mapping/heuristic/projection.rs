//! Lower bounds from projected problems, with costs partitioned among them.
//!
//! Keep of every state only a *group* of its attributes, and what is left is a small graph of classes, in which the
//! demonstration can be followed exactly. Doing so for several disjoint groups and adding up gives a lower bound of the whole
//! cost, if no cost is counted twice:
//!
//! - distances are sums over attributes, so each group pays the terms of its own;
//! - the cost of an action is split evenly among the attributes that the transition changes, of those that take part, and a group
//!   pays for its attributes. A group that it does not change moves for nothing, which is the projected `skip`. Where
//!   none of the attributes that change takes part, the first group that changes pays all;
//! - an extra action pays the distance once more, in all attributes: also in those that it does not change, which a projection
//!   on the others does not see. So let `least_k(i)` be the least term of the attribute k at observation i, of any value that
//!   it may have; it is above 0 where the body can never have what was seen. The sum of these over all attributes is paid
//!   by every extra action at i, and is split as the cost of the action is (`share_i`, of both); a group that changes pays, besides,
//!   what its terms are above their least (`rest`).
//!
//! Every move of the real problem is then, in each group, a projected move or none, and the projected costs add up to at most
//! the real one. Hence the sum of the exact projected costs-to-go is admissible, and, as it satisfies the triangle inequality of
//! each projection, consistent (Holte, Felner, Newton, Meshulam & Furcy 2006, on additive pattern databases; Katz & Domshlak 2010,
//! on cost partitioning). The coarser the partition into groups the higher the estimate, as a group pays at least what its
//! attributes pay alone.
//!
//! Each attribute alone is projected for every problem. The groups of several that [`grouping`] chooses have many classes, and their
//! tables are made for searches that take long ([`super::joint`]).

use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

use rustc_hash::FxHashMap;

use super::edges::EdgeSets;
use super::grouping::{self, Partition};
use crate::interrupt::{Interrupt, Interrupted, Meter};
use crate::model::{ActionIdx, Model, Operator, Rows};

/// The projections of a model. They depend on neither demonstrations nor weights, so they are made once per model.
#[derive(Debug)]
pub(crate) struct Projections {
    groups: Vec<Group>,
    /// Distinct sets of groups that some transition changes.
    change_sets: Vec<Vec<u16>>,
    /// Partitions into larger and larger groups, chosen when a search is long enough; `None` until then, and once they were
    /// [released](Self::release).
    levels: Mutex<Option<Levels>>,
}

/// Shared with the searches that use them.
type Levels = Arc<[Level]>;

/// A partition of the attributes into groups.
#[derive(Debug)]
struct Level {
    partition: Partition,
    /// Its groups of several attributes, built when a search is long enough.
    groups: OnceLock<Arc<Groups>>,
}

/// The groups of several attributes of a level.
#[derive(Debug)]
pub(super) struct Groups {
    pub(super) groups: Vec<Group>,
    /// How much memory it takes to build them.
    bytes_to_build: usize,
}

impl Groups {
    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.groups.iter().map(Group::size_bytes).sum()
    }
}

/// Why there are no groups.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unbuilt {
    /// They would take more memory than they may.
    TooLarge,
    Interrupted(Interrupted),
}

impl From<Interrupted> for Unbuilt {
    fn from(interrupted: Interrupted) -> Self {
        Self::Interrupted(interrupted)
    }
}

/// The classes of states that have the same values of some attributes.
///
/// The class of a state is a number in mixed radix, with the domain indices of the attributes' values as digits; some
/// classes may have no states.
#[derive(Clone, Debug)]
pub(super) struct Classes {
    /// The attributes, ascending.
    digits: Vec<Digit>,
    n_classes: usize,
}

/// A model, projected on some of its attributes.
#[derive(Debug)]
pub(super) struct Group {
    classes: Classes,
    /// Distinct ways to change the class, by where they lead; no rows if they do not fit.
    edges: Rows<ProjectedEdge>,
    /// Whether its edges fit.
    is_kept: bool,
}

/// An attribute of a group.
#[derive(Clone, Copy, Debug)]
struct Digit {
    /// The attribute's position.
    position: usize,
    /// What the attribute's domain index is multiplied with.
    stride: usize,
    /// How many values the attribute has.
    n_values: usize,
}

/// A class of a group.
pub(super) type ClassIdx = u32;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct ProjectedEdge {
    pub(super) from: ClassIdx,
    /// Which single attributes change with it: an index into the change sets, doubled; plus 1 if the group is the first of its
    /// partition's that change.
    pub(super) kind: u32,
    pub(super) action: ActionIdx,
}

/// Most edges of all groups together, and most entries of all change sets: 256 and 32 MB. Groups whose edges do not fit are
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
        const EDGE_BYTES: usize = 4 * size_of::<(ClassIdx, ProjectedEdge)>();
        Self::bounded(model, MAX_EDGES.min(max_bytes / EDGE_BYTES), interrupt)
    }

    fn bounded(model: &Model, max_edges: usize, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        /// How many classes are looked up between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let states = model.states();
        let varies = |attribute: &usize| states.domain(*attribute).len() > 1;
        let alone = (0..model.schema().len()).filter(varies).map(|attribute| Group::new(model, &[attribute]));
        let mut groups: Vec<Group> = alone.collect();

        let mut found = EdgeSets::of(&groups, max_edges);
        match model.unexplored() {
            None => {
                for (from, transition) in model.graph().iter() {
                    meter.spend_or_stop(groups.len() as u64)?;
                    found.add_transition(transition.action, states.row(from), states.row(transition.to));
                }
            }
            Some(cave) => {
                for operator in cave.operators() {
                    meter.spend_or_stop(groups.len() as u64)?;
                    found.add_operator(&operator);
                }
            }
        }
        let EdgeSets { edges, change_sets, .. } = found;
        for (group, edges) in groups.iter_mut().zip(edges) {
            group.is_kept = edges.is_some();
            let edges: Vec<(ClassIdx, ProjectedEdge)> = edges.into_iter().flatten().collect();
            group.set_edges(&edges, &mut meter)?;
        }
        Ok(Self { groups, change_sets: change_sets.sets, levels: Mutex::default() })
    }

    /// The groups of a single attribute.
    pub(super) fn groups(&self) -> &[Group] {
        &self.groups
    }

    /// The groups of several attributes at a level, from 0; they are the larger the higher the level. `None` if there is
    /// no such level. They are made when they are first asked for, in time proportional to the transitions, and kept.
    ///
    /// # Errors
    ///
    /// [`Unbuilt::TooLarge`] if building them takes more than `max_bytes`, also where they are there already, so that a search does not
    /// depend on those before it; what `interrupt` said, if that was not to continue.
    pub(super) fn level(
        &self,
        model: &Model,
        level: usize,
        max_bytes: usize,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Arc<Groups>>, Unbuilt> {
        if grouping::bytes_for(model) > max_bytes {
            return Err(Unbuilt::TooLarge);
        }
        // Two searches that come at the same time may both do the work, with the same result.
        let levels = self.levels().clone();
        let levels = if let Some(levels) = levels {
            levels
        } else {
            let partitions = grouping::choose(model, interrupt)?;
            let levels = partitions.into_iter().map(|partition| Level { partition, groups: OnceLock::new() });
            let levels: Levels = levels.collect();
            Arc::clone(self.levels().get_or_insert(levels))
        };
        let Some(level) = levels.get(level) else { return Ok(None) };
        let groups = if let Some(groups) = level.groups.get() {
            groups
        } else {
            let groups = self.joint_groups(model, &level.partition, max_bytes, interrupt)?;
            level.groups.get_or_init(|| Arc::new(groups))
        };
        if groups.bytes_to_build > max_bytes { Err(Unbuilt::TooLarge) } else { Ok(Some(Arc::clone(groups))) }
    }

    fn levels(&self) -> MutexGuard<'_, Option<Levels>> {
        self.levels.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Gives back what was kept for searches that take long; the next one makes it anew.
    pub(crate) fn release(&self) {
        drop(self.levels().take());
    }

    /// Projects `model` on the groups of `partition` that have several attributes.
    fn joint_groups(
        &self,
        model: &Model,
        partition: &Partition,
        max_bytes: usize,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Groups, Unbuilt> {
        /// What an edge takes in a list, with the room for more, and then in rows.
        const EDGE_BYTES: usize = 2 * size_of::<(ClassIdx, ProjectedEdge)>() + size_of::<ProjectedEdge>();
        /// How many classes are looked up between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let mut numbers: FxHashMap<&[u16], u32> = FxHashMap::default();
        numbers.extend(self.change_sets.iter().map(Vec::as_slice).zip(0..));
        let states = model.states();
        let joint = partition.iter().filter(|positions| positions.len() > 1);
        let mut groups: Vec<Group> = joint.map(|positions| Group::new(model, positions)).collect();
        let n_classes = groups.iter().map(Group::n_classes).fold(0, usize::saturating_add);
        let mut bytes_to_build = n_classes.saturating_mul(size_of::<u32>());
        let mut edges: Vec<Vec<(ClassIdx, ProjectedEdge)>> = vec![Vec::new(); groups.len()];
        let mut changed = Vec::new();
        for (from, transition) in model.graph().iter() {
            meter.spend_or_stop((self.groups.len() + groups.len()) as u64)?;
            let (row, row_after) = (states.row(from), states.row(transition.to));
            let is_changed = |group: &Group| group.positions().any(|at| row[at] != row_after[at]);
            changed.clear();
            let singles = self.groups.iter().zip(0u16..).filter(|(group, _)| group.is_kept && is_changed(group));
            changed.extend(singles.map(|(_, number)| number));
            // Every transition's set is there, as all were looked at when the projections were made.
            let Some(change_set) = numbers.get(changed.as_slice()) else { continue };
            let mut is_first = 1;
            for (group, edges) in groups.iter().zip(&mut edges).filter(|(group, _)| is_changed(group)) {
                let kind = change_set * 2 + is_first;
                is_first = 0;
                if edges.len() <= MAX_EDGES {
                    bytes_to_build += EDGE_BYTES;
                    #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                    let [from, to] = [row, row_after].map(|row| group.class_of(row) as ClassIdx);
                    edges.push((to, ProjectedEdge { from, kind, action: transition.action }));
                }
            }
            if bytes_to_build > max_bytes {
                return Err(Unbuilt::TooLarge);
            }
        }
        for (group, edges) in groups.iter_mut().zip(edges) {
            group.is_kept = edges.len() <= MAX_EDGES;
            if group.is_kept {
                group.set_edges(&edges, &mut meter)?;
            }
        }
        Ok(Groups { groups, bytes_to_build })
    }

    /// Distinct sets of groups that some transition changes.
    pub(super) fn change_sets(&self) -> &[Vec<u16>] {
        &self.change_sets
    }

    /// Approximate size in memory, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        let change_sets: usize =
            self.change_sets.iter().map(|set| size_of_val(set) + size_of_val(set.as_slice())).sum();
        let levels = self.levels();
        let joint = levels.iter().flat_map(|levels| levels.iter()).filter_map(|level| level.groups.get());
        let joint: usize = joint.map(|groups| groups.size_bytes()).sum();
        change_sets + joint + self.groups.iter().map(Group::size_bytes).sum::<usize>()
    }
}

#[cfg(test)]
impl Projections {
    /// As if these partitions had been chosen.
    pub(super) fn with_levels(model: &Model, partitions: impl IntoIterator<Item = Partition>) -> Self {
        let projections = Self::new(model, usize::MAX, &mut crate::interrupt::Uninterrupted).unwrap();
        let levels = partitions.into_iter().map(|partition| Level { partition, groups: OnceLock::new() });
        *projections.levels() = Some(levels.collect());
        projections
    }
}

impl Classes {
    /// The class of a state with these domain indices, shape `[n_attributes]`.
    #[inline]
    pub(super) fn of(&self, values: &[u32]) -> usize {
        self.digits.iter().map(|digit| values[digit.position] as usize * digit.stride).sum()
    }

    /// Whether the attribute at `position` tells them apart.
    pub(super) fn has(&self, position: usize) -> bool {
        self.digits.iter().any(|digit| digit.position == position)
    }
}

impl Group {
    fn new(model: &Model, positions: &[usize]) -> Self {
        let mut n_classes = 1;
        let digits = positions.iter().map(|position| {
            let n_values = model.states().domain(*position).len();
            let digit = Digit { position: *position, stride: n_classes, n_values };
            n_classes *= n_values;
            digit
        });
        let digits = digits.collect();
        Self { classes: Classes { digits, n_classes }, edges: Rows::default(), is_kept: true }
    }

    /// Takes the edges, each with the class that it leads to, and sorts them.
    fn set_edges(&mut self, edges: &[(ClassIdx, ProjectedEdge)], meter: &mut Meter<'_>) -> Result<(), Interrupted> {
        let entries = edges.iter().copied();
        self.edges = Rows::try_of_entries(self.n_classes(), entries, || meter.spend_or_stop(1))?;
        for class in 0..self.n_classes() {
            let into = self.edges.of_mut(class);
            meter.spend_or_stop(1 + into.len() as u64)?;
            into.sort_unstable();
        }
        self.edges.dedup(|edge, other| edge == other);
        self.edges.shrink_to_fit();
        Ok(())
    }

    /// The classes from and to which `operator` changes, whatever the values of which it says nothing.
    pub(super) fn classes_of(&self, operator: &Operator) -> Vec<(ClassIdx, ClassIdx)> {
        let mut classes = vec![(0, 0)];
        for Digit { position, stride, n_values } in &self.classes.digits {
            let kept = operator.kept.iter().find(|(at, _)| at == position).map(|(_, value)| (*value, *value));
            let changed = operator.changed.iter().find(|(at, _, _)| at == position).map(|(_, from, to)| (*from, *to));
            #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
            let (stride, n_values) = (*stride as ClassIdx, *n_values as u32);
            let values: Vec<(u32, u32)> = match kept.or(changed) {
                Some(values) => vec![values],
                None => (0..n_values).map(|value| (value, value)).collect(),
            };
            let with =
                |(from, to): (u32, u32), class: &(ClassIdx, ClassIdx)| (class.0 + from * stride, class.1 + to * stride);
            classes = values.iter().flat_map(|values| classes.iter().map(|class| with(*values, class))).collect();
        }
        classes
    }

    /// The classes.
    pub(super) fn classes(&self) -> &Classes {
        &self.classes
    }

    /// The class of a state with these domain indices, shape `[n_attributes]`.
    #[inline]
    pub(super) fn class_of(&self, values: &[u32]) -> usize {
        self.classes.of(values)
    }

    pub(super) fn n_classes(&self) -> usize {
        self.classes.n_classes
    }

    /// The edges into a class, by where they come from.
    #[inline]
    pub(super) fn edges_into(&self, class: usize) -> &[ProjectedEdge] {
        if self.is_kept { self.edges.of(class) } else { &[] }
    }

    /// The edges by where they lead, and in each row by where they come from. No rows if they do not fit.
    pub(super) fn edges(&self) -> &Rows<ProjectedEdge> {
        &self.edges
    }

    pub(super) fn n_edges(&self) -> usize {
        self.edges.n_items()
    }

    /// The positions of its attributes, and how many values they have: the digits of a class, the lowest first.
    pub(super) fn digits(&self) -> impl Iterator<Item = (usize, usize)> {
        self.classes.digits.iter().map(|digit| (digit.position, digit.n_values))
    }

    pub(super) fn is_kept(&self) -> bool {
        self.is_kept
    }

    /// Positions of its attributes.
    pub(super) fn positions(&self) -> impl Iterator<Item = usize> {
        self.classes.digits.iter().map(|digit| digit.position)
    }

    fn size_bytes(&self) -> usize {
        self.edges.size_bytes()
    }
}

#[cfg(test)]
mod tests {
    use rustc_hash::FxHashSet;
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
            projections.groups.iter().map(|group| (group.is_kept, group.edges.n_items())).collect::<Vec<_>>()
        };
        assert_eq!(kept(MAX_EDGES), [(true, 99), (true, 2)]);
        assert_eq!(kept(50), [(false, 0), (true, 2)]);
        assert_eq!(kept(1), [(false, 0), (false, 0)]);
    }

    #[test]
    fn operators_allow_all_that_transitions_do_in_groups_of_any_attributes() {
        let definition = json!({"dynamics": {
            "kind": "wumpus", "width": 4, "height": 3, "pits": [[3, 2]], "wumpi": [[2, 0], [0, 2]],
            "gold": [[1, 0], [1, 0], [2, 0]], "arrows": 2,
        }});
        let definition = Definition::read(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let Definition::Wumpus(cave) = definition else { panic!("a cave") };
        let partitions: [&[&[usize]]; 3] =
            [&[&[0, 1, 2], &[3, 8, 9], &[4, 6, 7], &[5]], &[&[0, 3], &[1, 4], &[2, 5]], &[&[0, 1], &[2, 4, 6], &[3]]];
        for partition in partitions {
            let groups: Vec<Group> = partition.iter().map(|positions| Group::new(&model, positions)).collect();
            let (mut known, mut lazy) = (EdgeSets::of(&groups, MAX_EDGES), EdgeSets::of(&groups, MAX_EDGES));
            for (from, transition) in model.graph().iter() {
                let [row, row_after] = [from, transition.to].map(|state| model.states().row(state));
                known.add_transition(transition.action, row, row_after);
            }
            cave.operators().for_each(|operator| lazy.add_operator(&operator));
            let of = |found: &EdgeSets<'_>, group: usize| -> FxHashSet<(ClassIdx, ClassIdx, ActionIdx, Vec<u16>)> {
                let edges = found.edges[group].iter().flatten();
                let set = |edge: &ProjectedEdge| found.change_sets.sets[edge.kind as usize / 2].clone();
                edges.map(|(to, edge)| (edge.from, *to, edge.action, set(edge))).collect()
            };
            for group in 0..groups.len() {
                let (known, lazy) = (of(&known, group), of(&lazy, group));
                assert!(!known.is_empty() && known.is_subset(&lazy), "{:?} of {partition:?}", partition[group]);
            }
        }
    }
}
