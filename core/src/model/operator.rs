//! What an action changes, attribute by attribute, whatever can be reached.

use super::ActionIdx;

/// A way in which an action changes the values of some attributes. Values are indices into the domains.
///
/// The operators of a model allow all that its transitions do, and may allow more. For each attribute that a transition changes, there is
/// an operator of its action that changes this attribute from and to the same values, that changes all others that the transition changes,
/// in whatever way, that keeps nothing but what the transition keeps, and that costs no more.
#[derive(Clone, Debug, PartialEq)]
pub struct Operator {
    /// The action.
    pub action: ActionIdx,
    /// What its transitions cost at least, if they have costs of their own; `None`: what the action costs.
    pub cost: Option<f64>,
    /// Positions of attributes, and the values that they must have and keep.
    pub kept: Vec<(usize, u32)>,
    /// Positions of attributes, and the values from and to which they change. Not empty.
    pub changed: Vec<(usize, u32, u32)>,
}
