//! How the costs of actions are shared among groups, and the ways between a group's classes at these costs.

use crate::mapping::Problem;
use crate::mapping::backward::Price;
use crate::mapping::heuristic::projection::{ClassIdx, Group, ProjectedEdge, Projections};
use crate::model::Rows;

/// How the costs of actions are divided, as one group sees it.
pub(super) struct Parts<'p> {
    problem: &'p Problem<'p>,
    /// By kind of edge: what the action's cost is divided by.
    divisors: Vec<f64>,
}

impl<'p> Parts<'p> {
    /// As the group of the attributes at `positions` sees it. `used` tells which groups of a single attribute have tables.
    ///
    /// Each attribute that a transition changes, of those with tables, pays the same part of the action's cost, and a group pays
    /// for its attributes. Where none of these changes, the first group of the partition that does pays all.
    pub(super) fn new(projections: &Projections, problem: &'p Problem<'p>, used: &[bool], positions: &[usize]) -> Self {
        let is_used = |number: &&u16| used[usize::from(**number)];
        let is_own = |number: &&u16| {
            let position = projections.groups()[usize::from(**number)].positions().next();
            position.is_some_and(|position| positions.contains(&position))
        };
        let divisors = projections.change_sets().iter().flat_map(|set| {
            let (mut n_all, mut n_own) = (0u32, 0u32);
            for number in set.iter().filter(is_used) {
                n_all += 1;
                n_own += u32::from(is_own(&number));
            }
            if n_all == 0 { [f64::INFINITY, 1.0] } else { [f64::from(n_all) / f64::from(n_own); 2] }
        });
        Self { problem, divisors: divisors.collect() }
    }

    /// What an edge costs, if its transition costs `more` than the action.
    #[inline]
    pub(super) fn of(&self, edge: &ProjectedEdge, more: f64) -> f64 {
        (self.problem.model.action(edge.action).cost + more) / self.divisors[edge.kind as usize]
    }
}

/// The ways between classes, by where they lead or where they come from, the cheapest of each pair.
#[derive(Debug)]
pub(super) struct Ways(Rows<Way>);

/// The way to or from a class.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Way {
    pub(super) class: ClassIdx,
    /// The least share of those that there are, and the least part, which may be of different ones.
    pub(super) price: Price,
}

impl Ways {
    /// The ways into each class, with where they come from.
    pub(super) fn into_classes(group: &Group, parts: &Parts<'_>) -> Self {
        let mut ways = group.edges().map(|edge| {
            let part = 1.0 / parts.divisors[edge.kind as usize];
            Way { class: edge.from, price: Price { share: parts.of(edge, 0.0), part } }
        });
        ways.dedup(|way, other| {
            let is_same = way.class == other.class;
            if is_same {
                way.price.share = way.price.share.min(other.price.share);
                way.price.part = way.price.part.min(other.price.part);
            }
            is_same
        });
        ways.shrink_to_fit();
        Self(ways)
    }

    /// The same ways, by where they come from.
    pub(super) fn reversed(&self) -> Self {
        let ways = self
            .0
            .iter()
            .zip(0..)
            .flat_map(|(ways, to)| ways.iter().map(move |way| (way.class, Way { class: to, ..*way })));
        Self(Rows::of_entries(self.0.n_rows(), ways))
    }

    #[inline]
    pub(super) fn of(&self, class: usize) -> &[Way] {
        self.0.of(class)
    }

    /// The ways of one class after the other.
    pub(super) fn iter(&self) -> impl Iterator<Item = &[Way]> {
        self.0.iter()
    }

    /// How many there are.
    pub(super) fn len(&self) -> usize {
        self.0.n_items()
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.0.size_bytes()
    }
}
