//! A table in the making: what all files that list states and transitions are read into.

use super::deadly::unsafe_states;
use super::words::{as_whole, check_names, domain};
use super::{Edits, ImportError, Spot};
use crate::attribute::{Attribute, MAX_COST, Schema};
use crate::document::{Quoted, normal};
use crate::interrupt::Meter;
use crate::model::reading::{Distinct, Raw};
use crate::model::table::{Edges, Table, Uneven};
use crate::model::{Action, ActionIdx, Definition, Limits, Outcome, Start, StateIdx, States};

/// By how much the probabilities of an action's outcomes may miss 1 in a file, where they are often rounded. They are divided by their sum.
const TOLERANCE: f64 = 1e-5;

/// What an action costs of which a file says nothing.
const DEFAULT_COST: f64 = 1.0;

/// Where an action may lead, as a file says it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Way {
    pub(super) to: u64,
    pub(super) probability: f64,
    /// What the body pays for it, if the file says so.
    pub(super) cost: Option<f64>,
}

/// An attribute in the making.
#[derive(Clone, Debug)]
pub(super) enum DraftAttribute {
    /// By its name; its kind follows from its values: numbers, or what is equal or not.
    Named(String),
    /// In full.
    Whole(Attribute),
}

/// A table in the making. States, actions and attributes have the names and numbers of the file.
pub(super) struct Draft {
    limits: Limits,
    attributes: Vec<DraftAttribute>,
    /// By attribute.
    values: Vec<Distinct>,
    /// Shape `[n_states, n_attributes]`, row by row.
    rows: Vec<u32>,
    actions: Vec<DraftAction>,
    edges: Edges,
    /// How many states there are, as far as the file has said.
    n_states: Option<u64>,
    /// The greatest state that something leads to, and where that is said.
    farthest: Option<(u64, Spot)>,
    /// States that nothing leaves, in any order, some of them several times.
    terminal: Vec<StateIdx>,
    pub(super) start: Vec<StateIdx>,
    /// In hand.
    ways: Vec<Way>,
}

struct DraftAction {
    name: String,
    /// The cost that most of its transitions have, if most have the same (Boyer & Moore 1981), else one of theirs; and by how many votes it leads.
    most: Option<(f64, u64)>,
    /// The first of its costs that is none, and where.
    refused: Option<(Spot, String)>,
}

impl Draft {
    pub(super) fn new(limits: Limits) -> Self {
        Self {
            limits: Limits {
                max_states: limits.max_states.min(StateIdx::MAX as usize - 1),
                max_transitions: limits.max_transitions.min(u32::MAX as usize - 1),
                ..limits
            },
            attributes: Vec::new(),
            values: Vec::new(),
            rows: Vec::new(),
            actions: Vec::new(),
            edges: Edges::default(),
            n_states: None,
            farthest: None,
            terminal: Vec::new(),
            start: Vec::new(),
            ways: Vec::new(),
        }
    }

    /// Says how many states there are.
    pub(super) fn expect_states(&mut self, n_states: u64, spot: Spot) -> Result<(), ImportError> {
        if n_states == 0 {
            return Err(ImportError::at(spot, "there are no states"));
        }
        if n_states > self.limits.max_states as u64 {
            let detail = format!("{n_states} states, of which there may be {}", self.limits.max_states);
            return Err(ImportError::at(spot, detail));
        }
        self.n_states = Some(n_states);
        Ok(())
    }

    pub(super) fn set_attributes(&mut self, attributes: Vec<DraftAttribute>) {
        self.values.resize_with(attributes.len(), Distinct::default);
        self.attributes = attributes;
    }

    pub(super) fn n_attributes(&self) -> usize {
        self.values.len()
    }

    /// How many states have their values.
    pub(super) fn n_rows(&self) -> u64 {
        self.rows.len().checked_div(self.values.len()).unwrap_or_default() as u64
    }

    /// Adds the values of the next state, as many as there are attributes.
    pub(super) fn push_row<'r>(
        &mut self,
        row: impl IntoIterator<Item = Raw<&'r str>>,
        spot: Spot,
    ) -> Result<(), ImportError> {
        if self.n_rows() >= self.limits.max_states as u64 {
            return Err(ImportError::at(spot, format!("over {} states, the limit", self.limits.max_states)));
        }
        for (value, distinct) in row.into_iter().zip(&mut self.values) {
            let number = match value {
                Raw::Float(bits) => distinct.number_of(as_whole(f64::from_bits(bits))),
                Raw::Text(text) => distinct.number_of(Raw::Text(normal(text).as_ref())),
                other => distinct.number_of(other),
            };
            self.rows.push(number);
        }
        debug_assert_eq!(self.rows.len() % self.values.len(), 0, "whole rows");
        Ok(())
    }

    /// Adds an action. Names may stand twice.
    pub(super) fn push_action(&mut self, name: String, spot: Spot) -> Result<ActionIdx, ImportError> {
        let index = self.actions.len();
        if index >= Action::MAX_ACTIONS {
            let detail = format!("over {} actions, which is the most that a model has", Action::MAX_ACTIONS);
            return Err(ImportError::at(spot, detail));
        }
        self.actions.push(DraftAction { name, most: None, refused: None });
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_ACTIONS")]
        let index = index as ActionIdx;
        Ok(index)
    }

    pub(super) fn n_actions(&self) -> usize {
        self.actions.len()
    }

    /// Gives the action at `index` its name.
    pub(super) fn name_action(&mut self, index: usize, name: String) {
        self.actions[index].name = name;
    }

    /// Notes that a cost of an action is none; it matters if the body has the action and pays that.
    pub(super) fn refuse(&mut self, action: ActionIdx, spot: Spot, detail: impl FnOnce() -> String) {
        let action = &mut self.actions[usize::from(action)];
        if action.refused.is_none() {
            action.refused = Some((spot, detail()));
        }
    }

    /// Adds an outcome of a state and an action; [`Self::end_pair`] says that it was the last.
    pub(super) fn push_way(&mut self, way: Way, spot: Spot) -> Result<(), ImportError> {
        let is_probability = (0.0..=1.0 + TOLERANCE).contains(&way.probability);
        if !is_probability {
            return Err(ImportError::at(spot, format!("{} is no probability, from 0 to 1", way.probability)));
        }
        if self.farthest.is_none_or(|(farthest, _)| farthest < way.to) {
            if let Some(n_states) = self.n_states {
                check_state(way.to, n_states, spot)?;
            }
            self.farthest = Some((way.to, spot));
        }
        if way.probability > 0.0 {
            self.ways.push(way);
        }
        Ok(())
    }

    /// Ends the outcomes of a state and an action: there must be some, and their probabilities sum to 1.
    pub(super) fn end_pair(&mut self, from: u64, action: ActionIdx, spot: Spot) -> Result<(), ImportError> {
        let sum = self.ways.iter().fold(0.0, |sum, way| sum + way.probability);
        if (sum - 1.0).abs() > TOLERANCE {
            let name = Quoted(&self.actions[usize::from(action)].name);
            let detail = format!("the probabilities of state {from} and action {name} sum to {sum}, not to 1");
            return Err(ImportError::at(spot, detail));
        }
        let from = StateIdx::try_from(from).ok().filter(|from| (*from as usize) < self.limits.max_states);
        let from =
            from.ok_or_else(|| ImportError::at(spot, format!("over {} states, the limit", self.limits.max_states)))?;
        let is_certain = self.ways.len() == 1;
        let mut ways = std::mem::take(&mut self.ways);
        for way in ways.drain(..) {
            let probability = if is_certain { 1.0 } else { way.probability / sum };
            let to = StateIdx::try_from(way.to).unwrap_or(StateIdx::MAX);
            // What has no effect is never paid.
            let cost = way.cost.filter(|_| !(is_certain && from == to));
            if let Some(cost) = cost {
                let (most, lead) = self.actions[usize::from(action)].most.get_or_insert((cost, 0));
                match *lead {
                    0 => (*most, *lead) = (cost, 1),
                    _ if *most == cost => *lead += 1,
                    _ => *lead -= 1,
                }
            }
            self.edges.push(from, action, Outcome { to, probability, cost });
        }
        self.ways = ways;
        if self.edges.len() > self.limits.max_transitions {
            return Err(ImportError::at(spot, format!("over {} transitions, the limit", self.limits.max_transitions)));
        }
        Ok(())
    }

    /// Notes that nothing leaves `state`: an episode ends there.
    pub(super) fn end_at(&mut self, state: u64) {
        // What is no state is told at the end.
        let Ok(state) = StateIdx::try_from(state) else { return };
        if self.terminal.last() != Some(&state) {
            self.terminal.push(state);
        }
    }

    /// Where there are no values of states: the state's number is its only attribute.
    pub(super) fn number_states(&mut self, n_states: u64) -> Result<(), ImportError> {
        self.set_attributes(vec![DraftAttribute::Whole(Attribute::category("state"))]);
        (0..n_states).try_for_each(|state| self.push_row([Raw::Whole(state)], Spot::Whole))
    }

    /// The definition, with the `edits`.
    pub(super) fn finish(mut self, edits: &Edits, meter: &mut Meter<'_>) -> Result<Definition, ImportError> {
        let n_states = self.n_rows();
        if n_states == 0 {
            return Err(ImportError::at(Spot::Whole, "there are no states"));
        }
        if let Some(expected) = self.n_states.filter(|expected| *expected != n_states) {
            return Err(ImportError::at(Spot::Whole, format!("expected {expected} states, found {n_states}")));
        }
        if let Some((farthest, spot)) = self.farthest {
            check_state(farthest, n_states, spot)?;
        }
        let schema = self.schema(edits)?;
        let actions = self.actions(edits)?;

        let mut is_terminal = vec![false; usize::try_from(n_states).unwrap_or_default()];
        for state in std::mem::take(&mut self.terminal) {
            is_terminal[state as usize] = true;
        }
        let numbers: Vec<Option<ActionIdx>> = numbered(&actions);
        self.edges.keep(|from, action| numbers[usize::from(action)].filter(|_| !is_terminal[from as usize]));
        let fixed: Vec<bool> = actions.iter().flatten().map(|(_, is_fixed)| *is_fixed).collect();
        let actions: Vec<Action> = actions.into_iter().flatten().map(|(action, _)| action).collect();
        self.edges
            .leave_out_costs(|action, cost| fixed[usize::from(action)] || actions[usize::from(action)].cost == cost);
        if let Some(uneven) = self.edges.settle(&actions, meter)?.first() {
            let (Uneven::Twice { number, .. } | Uneven::Sum { number, .. }) = *uneven;
            let (state, action) = self.edges.pair(number);
            let name = Quoted(&actions[usize::from(action)].name);
            return Err(ImportError::at(Spot::Whole, format!("state {state} has the action {name} twice")));
        }

        let values = std::mem::take(&mut self.values).into_iter().zip(schema.attributes());
        let domains = values.map(|(distinct, attribute)| domain(distinct, attribute)).collect::<Result<Vec<_>, _>>()?;
        let states = States::new(domains, self.rows);
        self.start.sort_unstable();
        self.start.dedup();
        let start = match self.start.as_slice() {
            [] => Start::Any,
            [state] => Start::State(*state),
            all if all.len() as u64 == n_states => Start::Any,
            _ => Start::Candidates(self.start),
        };
        let unsafe_states = unsafe_states(edits, &schema, &states, &start, meter)?;
        Ok(Definition::of(Table::new(schema, actions, states, self.edges, start, unsafe_states)))
    }

    fn schema(&self, edits: &Edits) -> Result<Schema, ImportError> {
        let names: Vec<&str> = self.attributes.iter().map(DraftAttribute::name).collect();
        let actions: Vec<&str> = self.actions.iter().map(|action| &*action.name).collect();
        edits.check(&actions, &names)?;
        if !(1..=Schema::MAX_ATTRIBUTES).contains(&names.len()) {
            let detail = format!("{} attributes, of which there may be 1 to {}", names.len(), Schema::MAX_ATTRIBUTES);
            return Err(ImportError::at(Spot::Whole, detail));
        }
        check_names("attribute", names.iter().map(|name| edits.renamed(name)), Attribute::MAX_NAME_CHARS)?;
        let attributes = self.attributes.iter().zip(&self.values).map(|(attribute, values)| {
            let name = normal(edits.renamed(attribute.name())).into_owned();
            match attribute {
                DraftAttribute::Whole(attribute) => Attribute { name, ..attribute.clone() },
                DraftAttribute::Named(_) if values.values().iter().all(|value| value.number().is_some()) => {
                    Attribute::number(name)
                }
                DraftAttribute::Named(_) => Attribute::category(name),
            }
        });
        Ok(Schema::of(attributes.collect()))
    }

    /// The actions of the body, in the order of the file, and whether their costs are given; `None` for those that it lacks.
    fn actions(&self, edits: &Edits) -> Result<Vec<Option<(Action, bool)>>, ImportError> {
        let kept = self.actions.iter().filter(|action| !edits.lacks(&action.name));
        check_names("action", kept.map(|action| edits.renamed(&action.name)), Action::MAX_NAME_CHARS)?;
        let read = self.actions.iter().map(|DraftAction { name, most, refused }| {
            if edits.lacks(name) {
                return Ok(None);
            }
            let fixed = edits.cost(name);
            if let (None, Some((spot, detail))) = (fixed, refused) {
                let say = format!("say by `cost` what the action costs, {}", Quoted(&format!("{name}=1")));
                return Err(ImportError::at(*spot, format!("{detail}; {say}, or what all cost, \"*=1\"")));
            }
            let cost = fixed.or(most.map(|(cost, _)| cost)).unwrap_or(DEFAULT_COST);
            Ok(Some((Action { name: normal(edits.renamed(name)).into(), cost }, fixed.is_some())))
        });
        read.collect()
    }
}

impl DraftAttribute {
    fn name(&self) -> &str {
        match self {
            Self::Named(name) => name,
            Self::Whole(attribute) => &attribute.name,
        }
    }
}

/// Reads a cost: finite, at least 0.
pub(super) fn cost_of(written: f64) -> Option<f64> {
    (0.0..=MAX_COST).contains(&written).then_some(written + 0.0)
}

/// Checks that there is such a state.
pub(super) fn check_state(state: u64, n_states: u64, spot: Spot) -> Result<(), ImportError> {
    if state < n_states {
        return Ok(());
    }
    Err(ImportError::at(spot, format!("there is no state {state}: there are {n_states}, counted from 0")))
}

/// The new number of each of `items` that is there.
fn numbered<T>(items: &[Option<T>]) -> Vec<Option<ActionIdx>> {
    let mut next = 0;
    let number = |item: &Option<T>| {
        item.is_some().then(|| {
            next += 1;
            next - 1
        })
    };
    items.iter().map(number).collect()
}
