//! How the costs of actions are shared among groups, and the ways between a group's classes at these costs.

use crate::mapping::Problem;
use crate::mapping::heuristic::projection::{ClassIdx, Group, ProjectedEdge, Projections};

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
pub(super) struct Ways {
    /// `offsets[v]..offsets[v + 1]` are the ways of `v`. Shape `[n_classes + 1]`.
    offsets: Vec<u32>,
    pub(super) ways: Vec<Way>,
}

/// The way to or from a class: the least share of those that there are, and the least part, which may be of different ones.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Way {
    pub(super) class: ClassIdx,
    /// Of the action's cost.
    pub(super) share: f64,
    /// Of what else is paid: from 0 to 1.
    part: f64,
}

impl Way {
    /// What an extra action costs besides the distance that is left, if the least distance is `least_distance`.
    #[inline]
    pub(super) fn share_of_extra(&self, least_distance: f64) -> f64 {
        self.share + self.part * least_distance
    }
}

impl Ways {
    /// The ways into each class, with where they come from.
    pub(super) fn into_classes(group: &Group, parts: &Parts<'_>) -> Self {
        let mut offsets = Vec::with_capacity(group.n_classes() + 1);
        offsets.push(0);
        let mut ways: Vec<Way> = Vec::with_capacity(group.n_edges());
        for class in 0..group.n_classes() {
            let first = ways.len();
            for edge in group.edges_into(class) {
                let (share, part) = (parts.of(edge, 0.0), 1.0 / parts.divisors[edge.kind as usize]);
                match ways[first..].last_mut() {
                    Some(way) if way.class == edge.from => {
                        way.share = way.share.min(share);
                        way.part = way.part.min(part);
                    }
                    _ => ways.push(Way { class: edge.from, share, part }),
                }
            }
            #[expect(clippy::cast_possible_truncation, reason = "at most `MAX_EDGES`")]
            offsets.push(ways.len() as u32);
        }
        Self { offsets, ways }
    }

    /// The same ways, by where they come from.
    pub(super) fn reversed(&self) -> Self {
        let n_classes = self.offsets.len() - 1;
        let mut offsets = vec![0; n_classes + 1];
        for way in &self.ways {
            offsets[way.class as usize + 1] += 1;
        }
        for class in 0..n_classes {
            offsets[class + 1] += offsets[class];
        }
        let mut free: Vec<u32> = offsets.clone();
        let mut ways = vec![Way::default(); self.ways.len()];
        for to in 0..n_classes {
            for way in self.of(to) {
                let place = &mut free[way.class as usize];
                #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
                let class = to as ClassIdx;
                ways[*place as usize] = Way { class, ..*way };
                *place += 1;
            }
        }
        Self { offsets, ways }
    }

    #[inline]
    pub(super) fn of(&self, class: usize) -> &[Way] {
        &self.ways[self.offsets[class] as usize..self.offsets[class + 1] as usize]
    }
}
