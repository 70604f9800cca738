//! Distinct ways to change the classes of groups, gathered from transitions or operators.

use rustc_hash::{FxHashMap, FxHashSet};

use super::projection::{ClassIdx, Group, ProjectedEdge};
use crate::model::{ActionIdx, Operator};

/// The edges of all groups, as they are found.
pub(super) struct EdgeSets<'g> {
    groups: &'g [Group],
    /// By an attribute's position: the group that it is in.
    group_of: FxHashMap<usize, u16>,
    /// By group; `None` for one that is left out.
    pub(super) edges: Vec<Option<FxHashSet<(ClassIdx, ProjectedEdge)>>>,
    n_edges: usize,
    max_edges: usize,
    pub(super) change_sets: ChangeSets,
    /// The groups that change, of those that are kept.
    changed: Vec<u16>,
}

impl<'g> EdgeSets<'g> {
    pub(super) fn of(groups: &'g [Group], max_edges: usize) -> Self {
        let edges = vec![Some(FxHashSet::default()); groups.len()];
        let positions =
            groups.iter().zip(0..).flat_map(|(group, number)| group.positions().map(move |at| (at, number)));
        let group_of = positions.collect();
        Self { groups, group_of, edges, n_edges: 0, max_edges, change_sets: ChangeSets::default(), changed: Vec::new() }
    }

    /// Adds what a transition between states with these rows changes.
    pub(super) fn add_transition(&mut self, action: ActionIdx, row: &[u32], row_after: &[u32]) {
        let kept = self.groups.iter().zip(&self.edges).zip(0u16..).filter(|((_, edges), _)| edges.is_some());
        let changed = kept.filter(|((group, _), _)| group.positions().any(|at| row[at] != row_after[at]));
        self.changed.clear();
        self.changed.extend(changed.map(|(_, number)| number));
        let change_set = self.change_sets.number_of(&self.changed);
        let groups = self.groups;
        for n in 0..self.changed.len() {
            let group = &groups[usize::from(self.changed[n])];
            #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
            let [from, to] = [row, row_after].map(|row| group.class_of(row) as ClassIdx);
            self.insert(n, to, ProjectedEdge { from, kind: change_set * 2, action });
        }
        self.make_room();
    }

    /// Adds what any transition that is like `operator` may change.
    pub(super) fn add_operator(&mut self, operator: &Operator) {
        let changed = operator.changed.iter().filter_map(|(at, _, _)| self.group_of.get(at).copied());
        self.changed.clear();
        self.changed.extend(changed.filter(|number| self.edges[usize::from(*number)].is_some()));
        self.changed.sort_unstable();
        self.changed.dedup();
        let change_set = self.change_sets.number_of(&self.changed);
        let groups = self.groups;
        for n in 0..self.changed.len() {
            for (from, to) in groups[usize::from(self.changed[n])].classes_of(operator) {
                self.insert(n, to, ProjectedEdge { from, kind: change_set * 2, action: operator.action });
            }
        }
        self.make_room();
    }

    /// Adds an edge of the `n`-th group that changes.
    fn insert(&mut self, n: usize, to: ClassIdx, edge: ProjectedEdge) {
        let edges = &mut self.edges[usize::from(self.changed[n])];
        let is_new = edges.as_mut().is_some_and(|edges| edges.insert((to, edge)));
        self.n_edges += usize::from(is_new);
    }

    fn make_room(&mut self) {
        if self.n_edges > self.max_edges || self.change_sets.n_entries > self.max_edges {
            leave_out_larger_half(&mut self.edges);
            self.change_sets.rebuild(&mut self.edges);
            self.n_edges = self.edges.iter().flatten().map(FxHashSet::len).sum();
        }
    }
}

/// Leaves out half of the groups that are kept, those with the most edges; the later ones among equals.
fn leave_out_larger_half(edges: &mut [Option<FxHashSet<(ClassIdx, ProjectedEdge)>>]) {
    let kept = edges.iter().enumerate().filter_map(|(number, edges)| Some((edges.as_ref()?.len(), number)));
    let mut kept: Vec<_> = kept.collect();
    kept.sort_unstable();
    for (_, number) in kept.drain(kept.len() / 2..) {
        edges[number] = None;
    }
}

/// Distinct sets of groups, numbered as they are found.
#[derive(Default)]
pub(super) struct ChangeSets {
    pub(super) sets: Vec<Vec<u16>>,
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
    fn rebuild(&mut self, edges: &mut [Option<FxHashSet<(ClassIdx, ProjectedEdge)>>]) {
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
            let renumbered = |(to, edge): (ClassIdx, ProjectedEdge)| {
                (to, ProjectedEdge { kind: numbers[edge.kind as usize / 2] * 2, ..edge })
            };
            *edges = std::mem::take(edges).into_iter().map(renumbered).collect();
        }
    }
}
