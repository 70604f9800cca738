//! States that follow from one another by rules, instead of being listed: an implicit graph.

use std::fmt::Debug;
use std::hash::Hash;

use super::{ActionIdx, Operator};
use crate::attribute::Value;
use crate::interrupt::{Interrupted, Meter};

/// Where an action may lead, as a view that is computed when it is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome<S> {
    /// The state that it leads to.
    pub to: S,
    /// How probable that is: above 0. The outcomes of a state and an action sum to 1.
    pub probability: f64,
    /// What the body pays for this transition; `None`: what its action costs.
    pub cost: Option<f64>,
}

impl<S> Outcome<S> {
    /// The only outcome of an action, at the action's cost.
    #[must_use]
    pub fn certain(to: S) -> Self {
        Self { to, probability: 1.0, cost: None }
    }

    /// The same outcome, at this cost: finite, at least 0.
    #[must_use]
    pub fn at_cost(self, cost: f64) -> Self {
        Self { cost: Some(cost), ..self }
    }

    /// The same outcome, with this probability: above 0, at most 1.
    #[must_use]
    pub fn with_probability(self, probability: f64) -> Self {
        Self { probability, ..self }
    }

    /// Whether it is the only outcome of its action.
    #[must_use]
    pub fn is_certain(&self) -> bool {
        self.probability >= 1.0
    }
}

/// Rules by which states follow from one another.
///
/// [`Model::explore`](super::Model::explore) makes a model of them. It lists the states that the body reaches, or leaves them to be found by
/// each search if they are too many: then the [`operators`](Self::operators) guide it. A state outside is a *row*: for each attribute, the
/// index of the state's value in the attribute's domain. Different states have different rows.
///
/// ```
/// use std::sync::Arc;
///
/// use etude_core::attribute::{Attribute, Schema, Value};
/// use etude_core::interrupt::Uninterrupted;
/// use etude_core::model::{Action, ActionIdx, Implicit, Limits, Model, Operator, Outcome};
///
/// /// A counter that goes round.
/// #[derive(Debug)]
/// struct Counter(u32);
///
/// impl Implicit for Counter {
///     type State = u32;
///
///     fn domains(&self) -> Vec<Vec<Value>> {
///         vec![(0..self.0).map(|n| Value::Number(n.into())).collect()]
///     }
///
///     fn row(&self, state: &u32) -> impl Iterator<Item = u32> {
///         std::iter::once(*state)
///     }
///
///     fn state_of(&self, row: &[Option<u32>]) -> Option<u32> {
///         row[0]
///     }
///
///     fn start_states(&self) -> Vec<u32> {
///         vec![0]
///     }
///
///     fn is_unsafe(&self, _: &u32) -> bool {
///         false
///     }
///
///     fn successors(&self, state: &u32) -> impl Iterator<Item = (ActionIdx, Outcome<u32>)> {
///         std::iter::once((0, Outcome::certain((state + 1) % self.0)))
///     }
///
///     fn operators(&self) -> impl Iterator<Item = Operator> {
///         let step = |n| Operator { action: 0, cost: None, kept: vec![], changed: vec![(0, n, (n + 1) % self.0)] };
///         (0..self.0).map(step)
///     }
/// }
///
/// let schema = Schema::new([Attribute::number("n")])?;
/// let count = Action { name: "count".into(), cost: 1.0 };
/// let model = Model::explore(schema, vec![count], Arc::new(Counter(10)), Limits::DEFAULT, &mut Uninterrupted)?;
/// assert_eq!((model.is_lazy(), model.states().len(), model.n_transitions()), (false, 10, 10));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub trait Implicit: Debug + Send + Sync + 'static {
    /// Everything that can change.
    type State: Clone + Debug + Eq + Hash + Send + Sync;

    /// The values that states may have, by attribute; not all must occur. Shape `[n_attributes][domain size]`.
    fn domains(&self) -> Vec<Vec<Value>>;

    /// The row of `state`: for each attribute, the index of its value in the domain. Shape `[n_attributes]`.
    fn row(&self, state: &Self::State) -> impl Iterator<Item = u32>;

    /// The state with this row, if there may be one; whether the body can reach it does not matter. `None` stands for values that
    /// [are derived](Self::is_derived) and not given.
    fn state_of(&self, row: &[Option<u32>]) -> Option<Self::State>;

    /// Whether the value of the attribute at `attribute` follows from those of others, so that a client need not give it.
    fn is_derived(&self, attribute: usize) -> bool {
        let _ = attribute;
        false
    }

    /// Where the imitator may start: at least one state, none of them unsafe, all different.
    fn start_states(&self) -> Vec<Self::State>;

    /// Whether `state` must never be entered.
    fn is_unsafe(&self, state: &Self::State) -> bool;

    /// Where each action leads from `state`, in the order of the actions; if it may lead to several states, these are different. An action
    /// may be left out, or lead nowhere else, if it has no effect; and it may lead into an unsafe state.
    fn successors(&self, state: &Self::State) -> impl Iterator<Item = (ActionIdx, Outcome<Self::State>)>;

    /// Every way in which the actions change attributes. See [`Operator`] for what these must cover.
    fn operators(&self) -> impl Iterator<Item = Operator>;

    /// Whether the operators tell all changes of the attribute at `attribute`. Searches estimate nothing by another.
    fn is_told(&self, attribute: usize) -> bool {
        let _ = attribute;
        true
    }

    /// About how much work it is to find the successors of a state, in tens of nanoseconds.
    fn work(&self) -> u64 {
        1
    }

    /// How much memory a state takes besides its own size, in bytes.
    fn state_bytes(&self) -> usize {
        0
    }

    /// How many states the body is certain to reach. If these are more than a model may have, nothing is explored in vain.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    fn least_states(&self, meter: &mut Meter<'_>) -> Result<u64, Interrupted> {
        let _ = meter;
        Ok(1)
    }
}
