//! Dynamics that are told by rules: expressions of CEL over the attributes.
//!
//! ```text
//! JSON --reading--> Rules { domains, rules } --explore--> states, listed or searched lazily
//!                      |
//!                      +--operators--> what each rule changes, for estimates
//! ```
//!
//! A state is a row of indices into the declared domains. Of the rules of an action, the first whose condition holds applies. What an
//! expression gives that its attribute may not have, or that it gives nothing, is a fault where a state that is explored when the model is
//! compiled comes to it ([`Dynamics::compile`]); in a state that only a search finds, the action then has no effect.

mod document;
mod domain;
mod dynamics;
mod operators;
mod reading;

use std::sync::OnceLock;

pub use document::{OutcomeDocument, RuleDocument, RulesDocument, StatesDocument};
use domain::Domain;
use operators::Plans;
pub(super) use reading::read;

use super::{Action, ActionIdx};
use crate::attribute::{MAX_COST, Schema};
use crate::expression::{Datum, Expression};

/// A body and its world, told by rules.
#[derive(Debug)]
pub(crate) struct Rules {
    schema: Schema,
    actions: Vec<Action>,
    /// By attribute.
    domains: Vec<Domain>,
    /// The rules of each action, in their order. Shape `[n_actions]`.
    by_action: Vec<Vec<Rule>>,
    /// Whether a state must never be entered.
    deadly: Option<Placed>,
    /// At least one, all different, none of them unsafe.
    start: Vec<State>,
    /// What it was read from, in canonical form.
    document: RulesDocument,
    /// See [`super::Implicit::work`].
    work: u64,
    /// How the operators are told, once that was asked for.
    plans: OnceLock<Plans>,
}

/// The row of a state. Shape `[n_attributes]`.
type State = Box<[u32]>;

/// What an action does in some states.
#[derive(Debug)]
struct Rule {
    /// Which; `None`: all in which no earlier rule of the action applies.
    when: Option<Placed>,
    /// At least one; their probabilities sum to 1.
    effects: Vec<Effect>,
    /// What it costs, if that is not what the action costs.
    cost: Option<Placed>,
}

/// What may come of a rule.
#[derive(Debug)]
struct Effect {
    probability: f64,
    /// The attributes that get another value, by their positions, and which.
    then: Vec<(usize, Placed)>,
}

/// An expression, and where it stands in the definition.
#[derive(Debug)]
struct Placed {
    expression: Expression,
    /// As a JSON pointer.
    pointer: String,
    /// In a document of several lines: the line.
    line: Option<u64>,
    /// The number of its rule, from 0.
    rule: Option<usize>,
    /// What was wrong with its value, in the first state where something was.
    trouble: OnceLock<String>,
}

/// Why an expression is of no use in a state.
#[derive(Debug)]
struct Unfit {
    offset: u32,
    detail: String,
}

impl Placed {
    /// Where in the definition the character at the byte `offset` stands, in words.
    fn place(&self, offset: u32) -> String {
        let place = self.expression.place(offset);
        self.rule.map_or(place.clone(), |rule| format!("rule {rule}, {place}"))
    }

    fn evaluate<'a>(&'a self, variables: &'a [Datum<'a>]) -> Result<Datum<'a>, Unfit> {
        let unfit = |failure: crate::expression::Failure| Unfit { offset: failure.offset, detail: failure.detail };
        self.expression.evaluate(variables).map_err(unfit)
    }

    fn flag(&self, variables: &[Datum<'_>]) -> Result<bool, Unfit> {
        match self.evaluate(variables)? {
            Datum::Bool(flag) => Ok(flag),
            other => Err(Unfit { offset: 0, detail: format!("expected bool, found {} ({other})", other.type_name()) }),
        }
    }

    fn cost(&self, variables: &[Datum<'_>]) -> Result<f64, Unfit> {
        let value = self.evaluate(variables)?;
        cost_of(&value)
            .ok_or_else(|| Unfit { offset: 0, detail: format!("{value} is no cost, which is 0 to {MAX_COST:e}") })
    }

    /// The index of its value in `domain`, that of an attribute called `name`.
    fn index(&self, variables: &[Datum<'_>], domain: &Domain, name: &str) -> Result<u32, Unfit> {
        let value = self.evaluate(variables)?;
        domain.position(&value).ok_or_else(|| Unfit { offset: 0, detail: domain.refusal(&value, name) })
    }
}

/// The cost that a value is, if it is one.
fn cost_of(value: &Datum<'_>) -> Option<f64> {
    let cost = match value {
        #[expect(clippy::cast_precision_loss, reason = "a cost is a float")]
        Datum::Int(cost) => *cost as f64,
        Datum::Double(cost) => *cost,
        _ => return None,
    };
    // Adding 0.0 turns -0.0 into 0.0, so that equal costs have equal bits.
    (0.0..=MAX_COST).contains(&cost).then_some(cost + 0.0)
}

impl Rules {
    /// The values of a state, as expressions see them.
    fn variables(&self, row: &[u32]) -> Vec<Datum<'_>> {
        self.domains.iter().zip(row).map(|(domain, index)| domain.datum(*index)).collect()
    }

    /// The rule of an action that applies where attributes have these values; what else is said of conditions without a value, `note` takes.
    fn applying<'r>(
        &'r self,
        action: ActionIdx,
        variables: &[Datum<'_>],
        mut note: impl FnMut(&'r Placed, Unfit),
    ) -> Option<&'r Rule> {
        self.by_action[usize::from(action)].iter().find(|rule| match &rule.when {
            None => true,
            Some(when) => when.flag(variables).unwrap_or_else(|unfit| {
                note(when, unfit);
                false
            }),
        })
    }

    /// Every expression, in the order in which they stand.
    fn expressions(&self) -> impl Iterator<Item = &Placed> {
        let rules = self.by_action.iter().flatten().flat_map(|rule| {
            let effects = rule.effects.iter().flat_map(|effect| effect.then.iter().map(|(_, placed)| placed));
            rule.when.iter().chain(effects).chain(&rule.cost)
        });
        rules.chain(&self.deadly)
    }
}

#[cfg(test)]
mod tests;
