//! The recurrence: what each kind of move costs, and which may follow which.
//!
//! From the start on, with `G(i, s)` for what the cheapest way to the node `(i, s)` costs, `e_i` for the weight of an observation, and
//! `x` for the part of the distance that an extra action pays,
//!
//! ```text
//! G(0, s_0) = e_0 D(o_0, s_0)                                             start, for each of the start states
//! G(i, s) = min( G(i-1, s)  +                e_i D(o_i, s),               skip
//!                G(i-1, s') + A(s', a, s) +  e_i D(o_i, s),               match, by an action a from s'
//!                G(i, s')   + A(s', a, s) +  x e_i D(o_i, s) )            extra, by an action a from s'
//! ```
//!
//! and from the end back, with `H(i, s)` for what it costs to go on from the node, and `w` for the weight of the end,
//!
//! ```text
//! H(n, s) = min(                w D(o_n, s),                              end
//!                A(s, a, s') +  x e_n D(o_n, s') + H(n, s') )             extra, by an action a to s'
//! H(i, s) = min(                e_{i+1} D(o_{i+1}, s)  + H(i+1, s),       skip
//!                A(s, a, s') +  e_{i+1} D(o_{i+1}, s') + H(i+1, s'),      match, by an action a to s'
//!                A(s, a, s') +  x e_i D(o_i, s') + H(i, s') )             extra, by an action a to s'
//! ```
//!
//! Searches, layers of an online mapping and completions go forwards ([`Recurrence::arrive`]), sweeps and the tables of
//! projections backwards ([`Recurrence::go_on`]). What a kind of move pays of a distance is said by [`Recurrence::paid`] alone;
//! distances have the weight of their observation in them already ([`Distances`](super::distances::Distances)). Floats are added in the
//! order in which they stand here, from the left forwards and from the right backwards, so that whoever uses the same direction comes to
//! the same bits.

use super::MoveKind;

/// What moves cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Recurrence {
    /// `x`: 0 to 1.
    pub(super) extra_weight: f64,
}

impl Default for Recurrence {
    /// Extra actions pay the whole distance, as in the paper.
    fn default() -> Self {
        Self { extra_weight: 1.0 }
    }
}

impl Recurrence {
    /// Whether moves of all kinds pay the same part of a distance, so that ways to a node may be compared before they pay it.
    #[inline]
    pub(super) fn pays_alike(self) -> bool {
        self.extra_weight == 1.0
    }

    /// What a move of this kind pays of the distance at the node to which it leads.
    #[inline]
    pub(super) fn paid(self, kind: MoveKind, distance: f64) -> f64 {
        match kind {
            MoveKind::Extra => self.extra_weight * distance,
            MoveKind::Start | MoveKind::Match | MoveKind::Skip => distance,
        }
    }

    /// What the way to a node costs that ends with a move of this kind: `before` is what the way costs up to there with the move's action,
    /// and `distance` that at the node.
    #[inline]
    pub(super) fn arrive(self, kind: MoveKind, before: f64, distance: f64) -> f64 {
        before + self.paid(kind, distance)
    }

    /// What it costs, besides the action, to come to a node by a move of this kind and to go on from there, if that costs `cost_to_go`.
    #[inline]
    pub(super) fn go_on(self, kind: MoveKind, distance: f64, cost_to_go: f64) -> f64 {
        self.paid(kind, distance) + cost_to_go
    }

    /// Whether a cheapest way needs a move of the kind `next` right after one of the kind `last`.
    ///
    /// A skip after an extra action costs no less than the action as a match, which comes to the same node without the distance in between.
    /// So does a skip before an extra action, if that pays the whole distance. What costs no less is never chained.
    #[inline]
    pub(super) fn may_follow(self, last: MoveKind, next: MoveKind) -> bool {
        match (last, next) {
            (MoveKind::Extra, MoveKind::Skip) => false,
            (MoveKind::Skip, MoveKind::Extra) => !self.pays_alike(),
            _ => true,
        }
    }
}
