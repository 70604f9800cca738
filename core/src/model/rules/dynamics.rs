//! Rules as a source of states: which there are, and how they follow from one another.

use std::io;
use std::sync::Arc;

use serde::Serialize;

use super::domain::Domain;
use super::{Effect, Placed, Rules, RulesDocument, State, Unfit};
use crate::attribute::{AttributeDocument, Schema, Value};
use crate::document::Faults;
use crate::expression::Datum;
use crate::interrupt::Interrupt;
use crate::model::dynamics::{Dynamics, write_definition};
use crate::model::{ActionIdx, CompileError, Implicit, Limits, Model, Operator, Outcome, StateIdx};

impl Dynamics for Rules {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, limits: Limits) -> u64 {
        let n_states = self.domains.iter().fold(1u64, |n, domain| n.saturating_mul(domain.len().into()));
        let n_states = n_states.min(limits.max_states as u64);
        let n_transitions = n_states.saturating_mul(self.actions.len() as u64);
        let n_values: u64 = self.domains.iter().map(|domain| u64::from(domain.len())).sum();
        let compiled = Model::compiled_bytes(n_states, n_transitions, self.schema.len() as u64);
        let compiled = compiled.saturating_add(n_values * size_of::<Value>() as u64);
        // Exploring keeps the states themselves, their numbers, and the transitions from each, beside what is compiled.
        let state_bytes = 2 * self.state_bytes() + 4 * size_of::<(State, StateIdx)>();
        compiled.saturating_add(n_states.saturating_mul(state_bytes as u64)).min(limits.max_bytes as u64)
    }

    fn compile(self: Arc<Self>, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError> {
        let rules = Arc::clone(&self);
        let (schema, actions) = (self.schema.clone(), self.actions.clone());
        let mut model = Model::explore(schema, actions, self, limits, interrupt)?;
        let mut faults = Faults::default();
        for placed in rules.expressions() {
            if let Some(trouble) = placed.trouble.get() {
                faults.note_in(placed.line, placed.pointer.clone(), trouble.clone());
            }
        }
        if !faults.is_empty() {
            return Err(faults.into());
        }
        // There may be more of them where no state was found yet.
        if model.is_lazy() && rules.is_stochastic() {
            model.n_stochastic = model.n_stochastic.max(1);
        }
        Ok(model)
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        #[derive(Serialize)]
        struct Written<'r> {
            kind: &'static str,
            #[serde(flatten)]
            rules: &'r RulesDocument,
        }
        let attributes = self.schema.attributes().iter().zip(&self.domains).map(|(attribute, domain)| {
            AttributeDocument { values: domain.document(), ..AttributeDocument::from(attribute) }
        });
        let written = Written { kind: "rules", rules: &self.document };
        write_definition(writer, Some(attributes.collect()), &self.actions, &written)
    }
}

impl Rules {
    /// Whether some rule has several outcomes.
    fn is_stochastic(&self) -> bool {
        self.by_action.iter().flatten().any(|rule| rule.effects.len() > 1)
    }

    /// Notes that an expression is of no use in `state`, unless it was so in another before.
    fn note(&self, placed: &Placed, unfit: &Unfit, state: &State) {
        placed.trouble.get_or_init(|| {
            /// Longest text of a state.
            const MAX_CHARS: usize = 300;
            let values = self.schema.attributes().iter().zip(self.domains.iter().zip(state));
            let values = values.map(|(attribute, (domain, index))| attribute.write_value(&domain.value(*index)));
            let shown = serde_json::to_string(&self.schema.by_attribute(values)).unwrap_or_default();
            let cut: String = shown.chars().take(MAX_CHARS).collect();
            let ellipsis = if cut.len() < shown.len() { ".." } else { "" };
            format!("{}: {}, in the state {cut}{ellipsis}", placed.place(unfit.offset), unfit.detail)
        });
    }

    /// The state after an effect; `None` if an expression is of no use, which is noted.
    fn after(&self, state: &State, effect: &Effect, variables: &[Datum<'_>]) -> Option<State> {
        let mut after = state.clone();
        let mut is_known = true;
        for (at, placed) in &effect.then {
            match placed.index(variables, &self.domains[*at], &self.schema.attributes()[*at].name) {
                Ok(index) => after[*at] = index,
                Err(unfit) => {
                    self.note(placed, &unfit, state);
                    is_known = false;
                }
            }
        }
        is_known.then_some(after)
    }

    /// Adds where an action leads from `state`.
    fn add_outcomes(
        &self,
        action: ActionIdx,
        state: &State,
        variables: &[Datum<'_>],
        outcomes: &mut Vec<(ActionIdx, Outcome<State>)>,
    ) {
        let Some(rule) = self.applying(action, variables, |placed, unfit| self.note(placed, &unfit, state)) else {
            return;
        };
        let cost = match &rule.cost {
            None => None,
            Some(placed) => match placed.cost(variables) {
                Ok(cost) => Some(cost),
                Err(unfit) => return self.note(placed, &unfit, state),
            },
        };
        if let [effect] = rule.effects.as_slice() {
            let after = self.after(state, effect, variables);
            outcomes.extend(after.map(|to| (action, Outcome { to, probability: 1.0, cost })));
            return;
        }
        let mut found: Vec<Outcome<State>> = Vec::with_capacity(rule.effects.len());
        for effect in &rule.effects {
            let Some(to) = self.after(state, effect, variables) else { return };
            match found.iter_mut().find(|known| known.to == to) {
                Some(known) => known.probability += effect.probability,
                None => found.push(Outcome { to, probability: effect.probability, cost }),
            }
        }
        if let [only] = found.as_mut_slice() {
            only.probability = 1.0;
        }
        outcomes.extend(found.into_iter().map(|outcome| (action, outcome)));
    }
}

impl Implicit for Rules {
    type State = State;

    fn domains(&self) -> Vec<Vec<Value>> {
        self.domains.iter().map(Domain::values).collect()
    }

    fn row(&self, state: &State) -> impl Iterator<Item = u32> {
        state.iter().copied()
    }

    fn state_of(&self, row: &[Option<u32>]) -> Option<State> {
        let state: State = row.iter().copied().collect::<Option<_>>()?;
        (!self.is_unsafe(&state)).then_some(state)
    }

    fn start_states(&self) -> Vec<State> {
        self.start.clone()
    }

    /// A state that cannot be told to be safe is not.
    fn is_unsafe(&self, state: &State) -> bool {
        self.deadly.as_ref().is_some_and(|deadly| {
            deadly.flag(&self.variables(state)).unwrap_or_else(|unfit| {
                self.note(deadly, &unfit, state);
                true
            })
        })
    }

    fn successors(&self, state: &State) -> impl Iterator<Item = (ActionIdx, Outcome<State>)> {
        let variables = self.variables(state);
        let mut outcomes = Vec::with_capacity(self.actions.len());
        for (action, _) in (0..).zip(&self.actions) {
            self.add_outcomes(action, state, &variables, &mut outcomes);
        }
        outcomes.into_iter()
    }

    fn operators(&self) -> impl Iterator<Item = Operator> {
        self.all_operators()
    }

    fn is_told(&self, attribute: usize) -> bool {
        self.told()[attribute]
    }

    fn work(&self) -> u64 {
        /// Nodes that are evaluated in ten nanoseconds.
        const NODES: u64 = 2;
        self.work / NODES + self.actions.len() as u64
    }

    fn state_bytes(&self) -> usize {
        /// What an allocation takes besides what it is asked for.
        const ALLOCATION_BYTES: usize = 16;
        self.domains.len() * size_of::<u32>() + ALLOCATION_BYTES
    }
}
