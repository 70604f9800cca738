//! Dynamics of planning tasks: states by their values, and actions that need some values and change some.
//!
//! Each action has one operator at most (Bäckström & Nebel 1995, SAS+). It applies where all values that it needs are there; then it changes
//! values, some of them only where further values are there, all seen from before. What the body reaches is listed, or found as it is
//! searched if that is too much; then the operators give the projections that guide the search.

mod packed;
mod reading;

use std::io;
use std::sync::Arc;

use self::packed::Layout;
pub use self::packed::PackedState;
pub(super) use self::reading::read;
pub use self::reading::{ConditionalDocument, OperatorDocument, PlanningDocument};
use super::deadly::Deadly;
use super::dynamics::{Dynamics, write_definition};
use super::{Action, ActionIdx, CompileError, Implicit, Limits, Model, Operator, Outcome, StateIdx};
use crate::attribute::{AttributeDocument, Schema, Value};
use crate::interrupt::Interrupt;

/// Positions of attributes, and indices of values that they have.
pub(super) type Values = Vec<(usize, u32)>;

/// What an action needs, and what it changes.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Rule {
    /// What must be there.
    pub(super) when: Values,
    /// What is there then.
    pub(super) then: Values,
    /// What else is there then, if further values were there before; the later ones in place of the earlier.
    pub(super) conditional: Vec<(Values, Values)>,
}

/// A planning task, and a body in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Planning {
    schema: Schema,
    actions: Vec<Action>,
    /// The values that states may have, by attribute, all different. Shape `[n_attributes][domain size]`.
    domains: Vec<Vec<Value>>,
    /// By attribute, the index of its value at first.
    start: Vec<u32>,
    /// Those of actions that have one, in the order of the actions.
    rules: Vec<(ActionIdx, Rule)>,
    /// Where the body must never be.
    deadly: Option<Deadly>,
    layout: Layout,
    /// By attribute and value, indices of rules that need it: each rule once, under that of its needs whose attribute has the most values.
    by_need: Vec<Vec<Vec<u32>>>,
    /// Rules that need nothing.
    needless: Vec<u32>,
}

impl Planning {
    /// A task that the caller has checked: indices are those of attributes, values and actions, and no action has two rules.
    pub(super) fn new(
        schema: Schema,
        actions: Vec<Action>,
        domains: Vec<Vec<Value>>,
        start: Vec<u32>,
        mut rules: Vec<(ActionIdx, Rule)>,
    ) -> Self {
        rules.sort_by_key(|(action, _)| *action);
        let mut by_need: Vec<Vec<Vec<u32>>> = domains.iter().map(|domain| vec![Vec::new(); domain.len()]).collect();
        let mut needless = Vec::new();
        for ((_, rule), number) in rules.iter().zip(0..) {
            match rule.when.iter().max_by_key(|(attribute, _)| domains[*attribute].len()) {
                Some((attribute, value)) => by_need[*attribute][*value as usize].push(number),
                None => needless.push(number),
            }
        }
        let layout = Layout::new(domains.iter().map(Vec::len));
        Self { schema, actions, domains, start, rules, deadly: None, layout, by_need, needless }
    }

    /// The same task, in which no state must be entered for which the expression `text` holds, or has no value.
    ///
    /// # Errors
    ///
    /// What is wrong with it; or that the body starts in such a state.
    pub(super) fn avoiding(mut self, text: &str) -> Result<Self, String> {
        let deadly = Deadly::read(text, &self.schema, &self.domains)?;
        match deadly.holds(self.start.iter().copied()) {
            Ok(false) => {}
            Ok(true) => return Err("the state where the body starts is unsafe".to_owned()),
            Err(detail) => return Err(format!("in the state where the body starts: {detail}")),
        }
        self.deadly = Some(deadly);
        Ok(self)
    }

    /// The attributes of a state.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// The actions of the body.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    fn has(&self, state: &PackedState, values: &Values) -> bool {
        values.iter().all(|(attribute, value)| self.layout.get(state, *attribute) == *value)
    }

    fn after(&self, state: &PackedState, rule: &Rule) -> PackedState {
        let mut next = state.clone();
        let fired = rule.conditional.iter().filter(|(when, _)| self.has(state, when)).flat_map(|(_, then)| then);
        for (attribute, value) in rule.then.iter().chain(fired) {
            self.layout.set(&mut next, *attribute, *value);
        }
        next
    }

    /// Every operator of a rule. What changes a value that the rule does not need may change it from any, and what is conditional may happen or
    /// not: that gives several, or, if they would be too many, some that change more than the rule does at a time, which only costs a bound.
    fn operators_of(&self, action: ActionIdx, rule: &Rule) -> Vec<Operator> {
        /// Most operators of a rule that are told apart.
        const MAX_EXACT: usize = 256;
        // By attribute that may change: from what, to what. Staying is changing from a value to itself.
        let mut changes: Vec<(usize, Vec<(u32, u32)>)> = Vec::new();
        let conditional =
            rule.conditional.iter().flat_map(|(when, then)| then.iter().map(move |change| (change, Some(when))));
        let all = rule.then.iter().map(|change| (change, None)).chain(conditional);
        for (&(attribute, to), condition) in all {
            let mut needs = rule.when.iter().chain(condition.into_iter().flatten());
            let needed = needs.find(|(needed, _)| *needed == attribute).map(|(_, from)| *from);
            let n_values = u32::try_from(self.domains[attribute].len()).unwrap_or(u32::MAX);
            let from = needed.map_or(0..n_values, |from| from..from + 1);
            let position = changes.iter().position(|(changed, _)| *changed == attribute).unwrap_or_else(|| {
                changes.push((attribute, Vec::new()));
                changes.len() - 1
            });
            let ways = &mut changes[position].1;
            ways.extend(from.clone().map(|from| (from, to)));
            if condition.is_some() {
                ways.extend(from.map(|from| (from, from)));
            }
        }
        for (_, ways) in &mut changes {
            ways.sort_unstable();
            ways.dedup();
        }
        let is_changed = |attribute: usize| changes.iter().any(|(changed, _)| *changed == attribute);
        let kept: Values = rule.when.iter().filter(|(attribute, _)| !is_changed(*attribute)).copied().collect();
        let operator = |changed: Vec<(usize, u32, u32)>| Operator { action, cost: None, kept: kept.clone(), changed };
        let n_exact = changes.iter().fold(1_usize, |n, (_, ways)| n.saturating_mul(ways.len()));
        if n_exact > MAX_EXACT {
            let n_ways = changes.iter().map(|(_, ways)| ways.len()).max().unwrap_or_default();
            let nth = |n: usize| {
                let way = |(attribute, ways): &(usize, Vec<(u32, u32)>)| {
                    let changing: Vec<_> = ways.iter().filter(|(from, to)| from != to).collect();
                    let (from, to) = changing.get(n % changing.len().max(1))?;
                    Some((*attribute, *from, *to))
                };
                operator(changes.iter().filter_map(way).collect())
            };
            return (0..n_ways).map(nth).collect();
        }
        let mut combined: Vec<Vec<(usize, u32, u32)>> = vec![Vec::new()];
        for (attribute, ways) in &changes {
            let extended = |before: &Vec<(usize, u32, u32)>| {
                let with = |(from, to): &(u32, u32)| {
                    let mut changed = before.clone();
                    changed.extend((from != to).then_some((*attribute, *from, *to)));
                    changed
                };
                ways.iter().map(with).collect::<Vec<_>>()
            };
            combined = combined.iter().flat_map(extended).collect();
        }
        combined.sort_unstable();
        combined.dedup();
        combined.into_iter().filter(|changed| !changed.is_empty()).map(operator).collect()
    }
}

impl Dynamics for Planning {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, limits: Limits) -> u64 {
        /// Exploring keeps the states themselves, their numbers, and the transitions from each, beside what is compiled.
        const EXPLORED_BYTES: u64 = (4 * size_of::<(PackedState, StateIdx)>()) as u64;
        let n_states = self.domains.iter().fold(1_u64, |n, domain| n.saturating_mul(domain.len() as u64));
        let n_states = n_states.min(limits.max_states as u64);
        let n_transitions = n_states.saturating_mul(self.rules.len() as u64);
        let compiled = Model::compiled_bytes(n_states, n_transitions, self.schema.len() as u64);
        compiled.saturating_add(n_states.saturating_mul(EXPLORED_BYTES)).min(limits.max_bytes as u64)
    }

    fn compile(self: Arc<Self>, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError> {
        Ok(Model::explore(self.schema.clone(), self.actions.clone(), self, limits, interrupt)?)
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        let attributes = self.schema.attributes().iter().map(AttributeDocument::from);
        write_definition(writer, Some(attributes.collect()), &self.actions, self)
    }
}

impl Implicit for Planning {
    type State = PackedState;

    fn domains(&self) -> Vec<Vec<Value>> {
        self.domains.clone()
    }

    fn row(&self, state: &PackedState) -> impl Iterator<Item = u32> {
        self.layout.unpack(state)
    }

    fn state_of(&self, row: &[Option<u32>]) -> Option<PackedState> {
        let values = row.iter().copied().collect::<Option<Vec<u32>>>()?;
        let state = self.layout.pack(values.into_iter());
        (!self.is_unsafe(&state)).then_some(state)
    }

    fn start_states(&self) -> Vec<PackedState> {
        vec![self.layout.pack(self.start.iter().copied())]
    }

    /// A state that cannot be told to be safe is not.
    fn is_unsafe(&self, state: &PackedState) -> bool {
        self.deadly.as_ref().is_some_and(|deadly| deadly.holds(self.layout.unpack(state)).unwrap_or(true))
    }

    fn successors(&self, state: &PackedState) -> impl Iterator<Item = (ActionIdx, Outcome<PackedState>)> {
        let needed =
            self.by_need.iter().enumerate().flat_map(|(at, rules)| &rules[self.layout.get(state, at) as usize]);
        let mut applicable: Vec<u32> = needed.chain(&self.needless).copied().collect();
        applicable.retain(|number| self.has(state, &self.rules[*number as usize].1.when));
        // As rules are in the order of their actions, so are these.
        applicable.sort_unstable();
        let outcomes: Vec<_> = applicable
            .into_iter()
            .map(|number| {
                let (action, rule) = &self.rules[number as usize];
                (*action, Outcome::certain(self.after(state, rule)))
            })
            .collect();
        outcomes.into_iter()
    }

    fn operators(&self) -> impl Iterator<Item = Operator> {
        self.rules.iter().flat_map(|(action, rule)| self.operators_of(*action, rule))
    }
}

#[cfg(test)]
mod tests;
