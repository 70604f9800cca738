//! What ways between the values of an attribute cost, where the costs of actions are shared among the attributes that change.

use super::projection::{Projection, Projections, ValueIdx};
use crate::mapping::Problem;
use crate::model::Rows;

/// The ways into each value of an attribute, of each pair of values the cheapest.
#[derive(Debug)]
pub(super) struct SharedWays(Rows<SharedWay>);

/// A way from a value.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct SharedWay {
    pub(super) from: ValueIdx,
    /// The attribute's share of the action's cost: the least over all ways between the two values.
    pub(super) share: f64,
    /// Part of the least distance that it pays if the action is extra: the least over all ways between the two values, so that `share` and
    /// `part` may be those of different ways.
    pub(super) part: f64,
}

impl SharedWay {
    /// What the attribute pays of an extra action, where `least_paid` of the distance is paid in all.
    #[inline]
    pub(super) fn of_extra(self, least_paid: f64) -> f64 {
        self.share + self.part * least_paid
    }
}

impl SharedWays {
    /// The ways of `projection`. Each attribute that a transition changes, of those with tables, pays the same part; `used` tells which
    /// have tables, and this one must.
    pub(super) fn new(
        projections: &Projections,
        projection: &Projection,
        problem: &Problem<'_>,
        used: &[bool],
    ) -> Self {
        let n_sharing = |set: &Vec<u16>| set.iter().map(|number| u32::from(used[usize::from(*number)])).sum::<u32>();
        let n_sharing: Vec<f64> = projections.change_sets.iter().map(|set| f64::from(n_sharing(set))).collect();
        let mut ways = projection.edges.filter_map(|edge| {
            let n_sharing = n_sharing[edge.change_set as usize];
            let cost = projections.cost(edge, &problem.body);
            // What the body lacks is no way.
            cost.is_finite().then(|| SharedWay { from: edge.from, share: cost / n_sharing, part: 1.0 / n_sharing })
        });
        ways.dedup(|way, other| {
            let is_same = way.from == other.from;
            if is_same {
                way.share = way.share.min(other.share);
                way.part = way.part.min(other.part);
            }
            is_same
        });
        ways.shrink_to_fit();
        Self(ways)
    }

    #[inline]
    pub(super) fn leading_to(&self, value: usize) -> &[SharedWay] {
        self.0.of(value)
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.0.size_bytes()
    }
}
