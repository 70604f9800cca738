//! The recurrence: what each kind of move costs, and which may follow which.
//!
//! From the start on, with `G(i, s)` for what the cheapest way to the node `(i, s)` costs,
//!
//! ```text
//! G(0, s_0) = D(o_0, s_0)                                   start
//! G(i, s) = min( G(i-1, s)  +            D(o_i, s),         skip
//!                G(i-1, s') + A(a)     + D(o_i, s),         match, by an action a from s'
//!                G(i, s')   + A(a)     + D(o_i, s) )        extra, by an action a from s'
//! ```
//!
//! and from the end back, with `H(i, s)` for what it costs to go on from the node,
//!
//! ```text
//! H(n, s) = 0
//! H(i, s) = min(        D(o_{i+1}, s)  + H(i+1, s),         skip
//!                A(a) + D(o_{i+1}, s') + H(i+1, s'),        match, by an action a to s'
//!                A(a) + D(o_i, s')     + H(i, s') )         extra, by an action a to s'
//! ```
//!
//! Searches, layers and repairs of an online mapping and completions go forwards ([`MoveKind::arrive`]), sweeps and the tables of
//! projections backwards ([`MoveKind::go_on`]). What a kind of move pays of a distance is said by [`MoveKind::paid`] alone. Floats
//! are added in the order in which they stand here, from the left forwards and from the right backwards, so that whoever uses the same
//! direction comes to the same bits.

use super::MoveKind;

impl MoveKind {
    /// What a move of this kind pays of the distance at the node to which it leads: all of it.
    #[expect(clippy::unused_self, reason = "this is where kinds will differ")]
    #[inline]
    pub(super) fn paid(self, distance: f64) -> f64 {
        distance
    }

    /// What the way to a node costs that ends with a move of this kind: `before` is what the way costs up to there with the move's action,
    /// and `distance` that at the node.
    #[inline]
    pub(super) fn arrive(self, before: f64, distance: f64) -> f64 {
        before + self.paid(distance)
    }

    /// What it costs, besides the action, to come to a node by a move of this kind and to go on from there, if that costs `cost_to_go`.
    #[inline]
    pub(super) fn go_on(self, distance: f64, cost_to_go: f64) -> f64 {
        self.paid(distance) + cost_to_go
    }

    /// Whether a cheapest way needs a move of this kind right after one of the kind `last`.
    ///
    /// A skip next to an extra action, in either order, costs no less than the action as a match, which comes to the same node without
    /// the distance in between. So they are never chained.
    #[inline]
    pub(super) fn may_follow(self, last: Self) -> bool {
        !matches!((last, self), (Self::Extra, Self::Skip) | (Self::Skip, Self::Extra))
    }
}
