//! Dynamics that a program brings along: listed or searched lazily, they come to the same.

use std::sync::Arc;

use etude_core::attribute::{Attribute, Schema, Value};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Settings, Status};
use etude_core::model::{Action, ActionIdx, Implicit, Limits, Model, Operator, Outcome};

const N: u32 = 12;

/// A dial that goes round in steps of one, past a number that it must not stand on by a step of two; it starts on any of several.
#[derive(Debug)]
struct Dial {
    forbidden: u32,
    starts: Vec<u32>,
}

impl Dial {
    const STEPS: [(ActionIdx, u32); 2] = [(0, 1), (1, 2)];
}

impl Implicit for Dial {
    type State = u32;

    fn domains(&self) -> Vec<Vec<Value>> {
        vec![(0..N).map(|n| Value::Number(n.into())).collect()]
    }

    fn row(&self, state: &u32) -> impl Iterator<Item = u32> {
        std::iter::once(*state)
    }

    fn state_of(&self, row: &[Option<u32>]) -> Option<u32> {
        row[0].filter(|state| *state != self.forbidden)
    }

    fn start_states(&self) -> Vec<u32> {
        self.starts.clone()
    }

    fn is_unsafe(&self, state: &u32) -> bool {
        *state == self.forbidden
    }

    fn successors(&self, state: &u32) -> impl Iterator<Item = (ActionIdx, Outcome<u32>)> {
        Self::STEPS.into_iter().map(move |(action, step)| (action, Outcome::certain((state + step) % N)))
    }

    fn operators(&self) -> impl Iterator<Item = Operator> {
        let every = Self::STEPS.into_iter().flat_map(|step| (0..N).map(move |from| (step, from)));
        let operator = |((action, step), from)| Operator {
            action,
            cost: None,
            kept: Vec::new(),
            changed: vec![(0, from, (from + step) % N)],
        };
        every.map(operator)
    }
}

fn mapper(max_states: usize) -> Mapper {
    let schema = Schema::new([Attribute::number("n")]).unwrap();
    let actions = [("step", 0.3), ("leap", 0.5)].map(|(name, cost)| Action { name: name.into(), cost });
    let dial = Dial { forbidden: 7, starts: vec![2, 5, 9] };
    let limits = Limits { max_states, ..Limits::DEFAULT };
    let model = Model::explore(schema, actions.to_vec(), Arc::new(dial), limits, &mut Uninterrupted).unwrap();
    Mapper::new(model, &mut Uninterrupted).unwrap()
}

/// Cost, actions and values of the cheapest mapping of a dial that is seen at `seen`.
fn solved(mapper: &Mapper, seen: &[u32]) -> (f64, Vec<Option<ActionIdx>>, bool) {
    let schema = mapper.model().schema();
    let demonstration = Demonstration::new(schema, seen.iter().map(|n| [Some(i64::from(*n).into())])).unwrap();
    let problem = Problem::new(mapper.model(), demonstration, schema.weights(), Conditions::default());
    let mapping = mapper.map(&problem, Settings::default(), &mut Uninterrupted).unwrap();
    let actions = mapping.moves.iter().map(|step| step.action).collect();
    (mapping.cost.total, actions, mapping.status == Status::Optimal)
}

#[test]
fn a_model_is_the_same_whether_its_states_are_listed_or_found_by_the_search() {
    let (listed, lazy) = (mapper(100), mapper(0));
    assert!(!listed.model().is_lazy() && lazy.model().is_lazy());
    assert_eq!((listed.model().states().len(), lazy.model().states().len()), (N - 1, 3));
    // Where it starts is part of what is found.
    for seen in [[2, 3, 4, 5, 6], [5, 6, 7, 8, 9], [9, 10, 11, 0, 2]] {
        let expected = solved(&listed, &seen);
        assert!(expected.2);
        assert_eq!(solved(&lazy, &seen), expected, "{seen:?}");
    }
}

#[test]
fn outcomes_of_a_state_are_certain_and_lead_into_no_unsafe_state() {
    let mapper = mapper(100);
    let model = mapper.model();
    for state in 0..model.states().len() {
        for (_, outcome) in model.outcomes(state) {
            assert!(outcome.is_certain() && outcome.cost.is_none() && outcome.to != state);
            assert_ne!(model.states().values(outcome.to).next(), Some(&Value::Number(7.0)));
        }
    }
}
