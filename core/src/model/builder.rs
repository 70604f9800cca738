//! Models that a program makes, state by state.

use std::collections::{HashMap, HashSet};

use super::table::{Edges, Table, Uneven};
use super::{Action, ActionIdx, Definition, Limits, Model, Outcome, Start, StateIdx, States};
use crate::attribute::{BuildError, MAX_COST, Scalar, Schema, Value, check_cost, check_count, check_name};
use crate::interrupt::{Meter, Uninterrupted};

/// A model that is being made. States and actions are numbered in the order in which they are added.
///
/// ```
/// use etude_core::attribute::{Attribute, Schema};
/// use etude_core::model::ModelBuilder;
///
/// let schema = Schema::new([Attribute::number("x"), Attribute::category("door")])?;
/// let mut builder = ModelBuilder::new(schema);
/// let (open, forward) = (builder.action("open", 0.5)?, builder.action("forward", 1.0)?);
/// let shut = builder.state([0.into(), "shut".into()])?;
/// let opened = builder.state([0.into(), "open".into()])?;
/// let through = builder.state([1.into(), "open".into()])?;
/// builder.transition(shut, open, opened)?;
/// builder.transition(opened, forward, through)?;
/// builder.start_at([shut])?;
/// let model = builder.build()?;
/// assert_eq!((model.states().len(), model.n_transitions()), (3, 2));
/// # Ok::<(), etude_core::attribute::BuildError>(())
/// ```
#[derive(Clone, Debug)]
pub struct ModelBuilder {
    schema: Schema,
    actions: Vec<Action>,
    /// Distinct values by attribute, and where each stands.
    domains: Vec<Vec<Value>>,
    positions: Vec<HashMap<Value, u32>>,
    /// Shape `[n_states, n_attributes]`, row by row.
    rows: Vec<u32>,
    edges: Edges,
    /// States and actions that have a transition.
    taken: HashSet<(StateIdx, ActionIdx)>,
    start: Vec<StateIdx>,
    unsafe_states: HashSet<StateIdx>,
}

impl ModelBuilder {
    /// A model without states or actions.
    #[must_use]
    pub fn new(schema: Schema) -> Self {
        let n_attributes = schema.len();
        Self {
            schema,
            actions: Vec::new(),
            domains: vec![Vec::new(); n_attributes],
            positions: vec![HashMap::new(); n_attributes],
            rows: Vec::new(),
            edges: Edges::default(),
            taken: HashSet::new(),
            start: Vec::new(),
            unsafe_states: HashSet::new(),
        }
    }

    /// The attributes of the states.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// Adds an action, which costs `cost` (0 to 1e150; dimensionless, weighed against distances).
    ///
    /// # Errors
    ///
    /// [`BuildError::Name`], [`BuildError::Twice`], [`BuildError::Number`], or [`BuildError::Count`] beyond
    /// [`Action::MAX_ACTIONS`].
    pub fn action(&mut self, name: &str, cost: f64) -> Result<ActionIdx, BuildError> {
        check_name(name, Action::MAX_NAME_CHARS)?;
        check_cost(|| format!("cost of action {name:?}"), cost, MAX_COST)?;
        if self.actions.iter().any(|action| &*action.name == name) {
            return Err(BuildError::Twice(name.to_owned()));
        }
        check_count("actions", 0, Action::MAX_ACTIONS, self.actions.len() + 1)?;
        self.actions.push(Action { name: name.into(), cost });
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_ACTIONS")]
        let index = (self.actions.len() - 1) as ActionIdx;
        Ok(index)
    }

    /// Adds a state with these values, one for each attribute, in order.
    ///
    /// # Errors
    ///
    /// [`BuildError::Count`] if they are not as many, [`BuildError::Value`] if one is none of its attribute's.
    pub fn state(&mut self, values: impl IntoIterator<Item = Scalar>) -> Result<StateIdx, BuildError> {
        let values = self.schema.values(values)?;
        check_count("states", 0, StateIdx::MAX as usize - 1, self.n_states() as usize + 1)?;
        for (position, value) in values.into_iter().enumerate() {
            let domain = &mut self.domains[position];
            let index = *self.positions[position].entry(value).or_insert_with_key(|value| {
                domain.push(value.clone());
                #[expect(clippy::cast_possible_truncation, reason = "at most as many as states")]
                let index = (domain.len() - 1) as u32;
                index
            });
            self.rows.push(index);
        }
        Ok(self.n_states() - 1)
    }

    /// Adds the transition by which `action` leads from one state to another, at the action's cost.
    ///
    /// # Errors
    ///
    /// [`BuildError::Unknown`] if there is no such state or action, [`BuildError::Ambiguous`] if the action leads somewhere already.
    pub fn transition(&mut self, from: StateIdx, action: ActionIdx, to: StateIdx) -> Result<(), BuildError> {
        self.outcome(from, action, Outcome::certain(to))
    }

    /// Adds an outcome of `action` in the state `from`: a transition with a cost of its own, or one of several, each with its probability. Outcomes
    /// that lead to the same state add up.
    ///
    /// ```
    /// use etude_core::attribute::{Attribute, Schema};
    /// use etude_core::model::{ModelBuilder, Outcome};
    ///
    /// let mut body = ModelBuilder::new(Schema::new([Attribute::number("x")])?);
    /// let (walk, jump) = (body.action("walk", 1.0)?, body.action("jump", 1.5)?);
    /// let (here, there) = (body.state([0.into()])?, body.state([1.into()])?);
    /// body.outcome(there, walk, Outcome::certain(here).at_cost(0.2))?;
    /// body.outcome(here, jump, Outcome::certain(there).with_probability(0.9))?;
    /// body.outcome(here, jump, Outcome::certain(here).with_probability(0.1).at_cost(3.0))?;
    /// let model = body.build()?;
    /// assert_eq!((model.n_transitions(), model.n_stochastic()), (3, 1));
    /// assert_eq!(model.outcomes(there).next(), Some((walk, Outcome::certain(here).at_cost(0.2))));
    /// # Ok::<(), etude_core::attribute::BuildError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// As [`Self::transition`], where `outcome` is certain; [`BuildError::Number`] if its probability is not above 0 and at most 1, or its cost
    /// is not from 0 to 1e150.
    pub fn outcome(&mut self, from: StateIdx, action: ActionIdx, outcome: Outcome<StateIdx>) -> Result<(), BuildError> {
        self.check_state(from)?;
        self.check_state(outcome.to)?;
        let Some(known) = self.actions.get(usize::from(action)) else {
            return Err(BuildError::Unknown { what: "action", index: action.into() });
        };
        let what = |what: &str| format!("{what} of action {:?} in state {from}", known.name);
        let is_probability = outcome.probability > 0.0 && outcome.probability <= 1.0;
        if !is_probability {
            let expected = "a number above 0 and at most 1";
            return Err(BuildError::Number { what: what("probability"), expected, found: outcome.probability });
        }
        if let Some(cost) = outcome.cost {
            check_cost(|| what("cost"), cost, MAX_COST)?;
        }
        if !self.taken.insert((from, action)) && outcome.is_certain() {
            return Err(BuildError::Ambiguous { state: from, action: known.name.to_string() });
        }
        self.edges.push(from, action, outcome);
        Ok(())
    }

    /// Where the imitator may start: in any one of these states. In any state that may be entered, if this is never said.
    ///
    /// # Errors
    ///
    /// [`BuildError::Unknown`] if there is no such state.
    pub fn start_at(&mut self, states: impl IntoIterator<Item = StateIdx>) -> Result<(), BuildError> {
        for state in states {
            self.check_state(state)?;
            self.start.push(state);
        }
        Ok(())
    }

    /// Notes that `state` must never be entered.
    ///
    /// # Errors
    ///
    /// [`BuildError::Unknown`] if there is no such state.
    pub fn forbid(&mut self, state: StateIdx) -> Result<(), BuildError> {
        self.check_state(state)?;
        self.unsafe_states.insert(state);
        Ok(())
    }

    /// The model as it would be registered.
    ///
    /// # Errors
    ///
    /// [`BuildError::Count`] if there is no state that may be entered, [`BuildError::UnsafeStart`], [`BuildError::Probabilities`].
    ///
    /// # Panics
    ///
    /// Never: nothing interrupts it.
    pub fn definition(mut self) -> Result<Definition, BuildError> {
        let n_states = self.n_states() as usize;
        check_count("states that may be entered", 1, n_states.max(1), n_states - self.unsafe_states.len())?;
        if let Some(state) = self.start.iter().find(|state| self.unsafe_states.contains(state)) {
            return Err(BuildError::UnsafeStart(*state));
        }
        let start = match self.start.as_slice() {
            [] => Start::Any,
            [state] => Start::State(*state),
            _ => Start::Candidates(self.start),
        };
        let mut uninterrupted = Uninterrupted;
        let mut meter = Meter::new(&mut uninterrupted, u64::MAX);
        let uneven = self.edges.settle(&self.actions, &mut meter).expect("nothing interrupts it");
        if let Some(uneven) = uneven.first() {
            let (Uneven::Twice { number, .. } | Uneven::Sum { number, .. }) = *uneven;
            let (state, action) = self.edges.pair(number);
            let action = self.actions[usize::from(action)].name.to_string();
            return Err(match uneven {
                Uneven::Twice { .. } => BuildError::Ambiguous { state, action },
                Uneven::Sum { sum, .. } => BuildError::Probabilities { state, action, sum: *sum },
            });
        }
        let mut unsafe_states: Vec<StateIdx> = self.unsafe_states.into_iter().collect();
        unsafe_states.sort_unstable();
        let states = States::new(self.domains, self.rows);
        Ok(Definition::of(Table::new(self.schema, self.actions, states, self.edges, start, unsafe_states)))
    }

    /// The model, ready to be searched.
    ///
    /// # Errors
    ///
    /// As [`Self::definition`].
    ///
    /// # Panics
    ///
    /// Never: nothing interrupts it.
    pub fn build(self) -> Result<Model, BuildError> {
        let definition = self.definition()?;
        Ok(Model::compile(&definition, Limits::NONE, &mut Uninterrupted).expect("nothing interrupts it"))
    }

    fn n_states(&self) -> StateIdx {
        #[expect(clippy::cast_possible_truncation, reason = "checked when they are added")]
        let n_states = (self.rows.len() / self.schema.len()) as StateIdx;
        n_states
    }

    fn check_state(&self, state: StateIdx) -> Result<(), BuildError> {
        if state < self.n_states() { Ok(()) } else { Err(BuildError::Unknown { what: "state", index: state }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::attribute::Attribute;

    fn builder() -> ModelBuilder {
        ModelBuilder::new(Schema::new([Attribute::number("x")]).unwrap())
    }

    #[test]
    fn what_is_built_is_what_is_read_from_json() {
        let mut builder = builder();
        let (on, back) = (builder.action("on", 1.0).unwrap(), builder.action("back", 2.0).unwrap());
        let states: Vec<_> = [0, 1, 1, 2].map(|x| builder.state([x.into()]).unwrap()).into();
        builder.transition(states[0], on, states[1]).unwrap();
        builder.transition(states[2], back, states[0]).unwrap();
        builder.start_at([states[0], states[2]]).unwrap();
        builder.forbid(states[3]).unwrap();
        let document = serde_json::json!({
            "attributes": [{"name": "x", "kind": "number"}],
            "actions": [{"name": "on", "cost": 1}, {"name": "back", "cost": 2}],
            "dynamics": {
                "kind": "table", "states": [[0], [1], [1], [2]], "transitions": [[0, "on", 1], [2, "back", 0]],
                "start": [0, 2], "unsafe": [3],
            },
        });
        let read = Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        assert_eq!(builder.definition().unwrap().text(), read.text());
    }

    #[test]
    fn what_is_no_model_is_told() {
        let mut builder = builder();
        assert!(matches!(builder.clone().build(), Err(BuildError::Count { found: 0, .. })));
        let on = builder.action("on", 1.0).unwrap();
        assert_eq!(builder.action("on", 1.0), Err(BuildError::Twice("on".to_owned())));
        assert!(matches!(builder.action("off", -1.0), Err(BuildError::Number { .. })));
        let [first, second] = [0, 1].map(|x| builder.state([x.into()]).unwrap());
        assert!(matches!(builder.state([0.into(), 0.into()]), Err(BuildError::Count { found: 2, .. })));
        assert!(matches!(builder.state(["a".into()]), Err(BuildError::Value { .. })));
        builder.transition(first, on, second).unwrap();
        assert!(matches!(builder.transition(first, on, first), Err(BuildError::Ambiguous { state: 0, .. })));
        assert_eq!(builder.transition(first, 7, first), Err(BuildError::Unknown { what: "action", index: 7 }));
        let half = Outcome::certain(first).with_probability(0.5);
        assert!(matches!(builder.outcome(first, on, Outcome::certain(first)), Err(BuildError::Ambiguous { .. })));
        assert!(matches!(builder.outcome(second, on, half.with_probability(0.0)), Err(BuildError::Number { .. })));
        assert!(matches!(builder.outcome(second, on, half.at_cost(-1.0)), Err(BuildError::Number { .. })));
        let mut uneven = builder.clone();
        uneven.outcome(second, on, half).unwrap();
        assert!(matches!(uneven.build(), Err(BuildError::Probabilities { state: 1, sum: 0.5, .. })));
        assert_eq!(builder.forbid(2), Err(BuildError::Unknown { what: "state", index: 2 }));
        builder.start_at([second]).unwrap();
        builder.forbid(second).unwrap();
        assert_eq!(builder.build().unwrap_err(), BuildError::UnsafeStart(1));
    }
}
