//! Committed steps, as they are given and as they are kept, and why there are none.

use std::sync::Arc;

use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};

use super::decided::{Decided, Halt};
use crate::attribute::Scalar;
use crate::interrupt::Cancelled;
use crate::mapping::policy::{Step, StepWriter};
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{Move, StoppedBy};
use crate::model::{Model, OriginRow, StateIdx, States};

/// A step that will not be revised.
#[derive(Clone, Debug, PartialEq)]
pub struct CommittedStep {
    /// The step.
    pub step: Step,
    /// Whether it is part of a cheapest mapping of the whole demonstration, whatever is still to come, among those that
    /// begin with the steps committed before it.
    pub is_proven: bool,
    /// How many observations had come when it was committed.
    pub after: u32,
}

impl CommittedStep {
    /// About how many bytes of memory a step of `model` takes.
    pub fn bytes_of(model: &Model) -> usize {
        const ATTRIBUTE_BYTES: usize = size_of::<(Arc<str>, Scalar)>() + size_of::<(Arc<str>, f64)>();
        size_of::<Self>() + model.schema().len() * ATTRIBUTE_BYTES
    }
}

/// A committed step, as far as a mapping must know it to go on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CommittedMove {
    /// The step.
    pub step: Move,
    /// What its action costs; 0 without one.
    pub action_cost: f64,
    /// If the model is searched lazily and no earlier step passes the step's state: what that is. States have no numbers there but those
    /// of the steps, in the order in which they are first passed.
    pub row: Option<OriginRow>,
}

/// Why an observation was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stopped {
    /// The caller lost interest.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// It would take more memory than the mapping may: see [`OnlineMapping::shortage`](super::OnlineMapping::shortage).
    #[error("what may still turn out to be the cheapest mapping takes more memory than there is for it")]
    Memory,
}

impl From<Halt> for Stopped {
    fn from(halt: Halt) -> Self {
        match halt {
            Halt::OutOf(StoppedBy::Memory) => Self::Memory,
            Halt::Cancelled | Halt::OutOf(StoppedBy::Deadline | StoppedBy::MaxExpansions) => Self::Cancelled(Cancelled),
        }
    }
}

/// The ways to all states, with those through another observation, do not fit into the memory that a mapping may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the cheapest ways to all {n_states} states, through {n_observations} observations since the last proven step, take {taken_bytes} bytes; \
     another observation takes {layer_bytes}, and there are {max_bytes} in all now: with a lookahead, such as 8, an observation takes no \
     more than a search of its window"
)]
pub struct Shortage {
    /// How many states the model has.
    pub n_states: u32,
    /// How many observations are kept, from that of the last committed step on.
    pub n_observations: usize,
    /// What the mapping takes with them, in bytes.
    pub taken_bytes: usize,
    /// What the next observation takes, in bytes; the first with all that is made once.
    pub layer_bytes: usize,
    /// What the mapping may take, in bytes.
    pub max_bytes: usize,
}

/// The committed steps.
#[derive(Debug, Default)]
pub(super) struct Committed {
    pub(super) moves: Vec<Move>,
    /// What the action of each of these costs.
    pub(super) action_costs: Vec<f64>,
    pub(super) writer: StepWriter,
    /// The states of the moves, if the model is searched lazily.
    pub(super) passed: Option<Passed>,
}

/// The states that the moves pass, in the order in which they are first passed.
#[derive(Debug)]
pub(super) struct Passed {
    pub(super) states: States,
    numbers: FxHashMap<Vec<u32>, StateIdx>,
    /// By state, the number of the step that first passes it.
    firsts: Vec<usize>,
}

impl Passed {
    /// The number of the state with this row, which the step with the number `step` passes.
    fn number_of(&mut self, row: &[u32], step: usize) -> StateIdx {
        if let Some(number) = self.numbers.get(row) {
            return *number;
        }
        let number = self.states.len();
        self.states.push(row.iter().copied());
        self.numbers.insert(row.to_vec(), number);
        self.firsts.push(step);
        number
    }
}

impl Committed {
    /// No steps, in `model`.
    pub(super) fn new(model: &Model) -> Self {
        let none = || Passed { states: model.states().keep(&[]), numbers: FxHashMap::default(), firsts: Vec::new() };
        Self { passed: model.is_lazy().then(none), ..Self::default() }
    }

    /// Takes up steps that were committed before. `None` if they are not of `model`.
    pub(super) fn of(model: &Model, moves: impl IntoIterator<Item = CommittedMove>) -> Option<Self> {
        let mut committed = Self::new(model);
        for (number, CommittedMove { step, action_cost, row }) in moves.into_iter().enumerate() {
            let has_action = step.action.is_none_or(|action| usize::from(action) < model.actions().len());
            let has_state = match (&mut committed.passed, row) {
                (None, None) => step.state < model.states().len(),
                (Some(passed), Some(OriginRow(row))) if model.has_row(&row) => {
                    passed.number_of(&row, number) == step.state
                }
                (Some(passed), None) => step.state < passed.states.len(),
                _ => false,
            };
            if !has_action || !has_state {
                return None;
            }
            committed.moves.push(step);
            committed.action_costs.push(action_cost);
        }
        Some(committed)
    }

    /// Commits a step.
    pub(super) fn add(&mut self, model: &Model, recurrence: Recurrence, decided: &Decided) -> Step {
        let Decided { step, action_cost, terms, row } = decided;
        let state = match (&mut self.passed, row) {
            (Some(passed), Some(OriginRow(row))) => passed.number_of(row, self.moves.len()),
            _ => step.state,
        };
        let step = Move { state, ..*step };
        let states = self.passed.as_ref().map_or_else(|| model.states(), |passed| &passed.states);
        let paid = terms.iter().map(|(position, term)| (*position, recurrence.paid(step.kind, *term)));
        let written = self.writer.write(model, states, &step, *action_cost, paid);
        self.moves.push(step);
        self.action_costs.push(*action_cost);
        written
    }

    /// The step with this number.
    pub(super) fn move_at(&self, number: usize) -> CommittedMove {
        let (step, action_cost) = (self.moves[number], self.action_costs[number]);
        let passed = self.passed.as_ref().filter(|passed| passed.firsts[step.state as usize] == number);
        let row = passed.map(|passed| OriginRow(passed.states.row(step.state).to_vec()));
        CommittedMove { step, action_cost, row }
    }

    /// The last state's row, if the model is searched lazily.
    pub(super) fn last_row(&self) -> Option<OriginRow> {
        let (passed, last) = (self.passed.as_ref()?, self.moves.last()?);
        Some(OriginRow(passed.states.row(last.state).to_vec()))
    }

    /// Approximate size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let passed = self.passed.as_ref().filter(|passed| !passed.states.is_empty()).map_or(0, |passed| {
            let row_bytes = size_of_val(passed.states.row(0));
            // The index is at most half empty just after it has grown.
            passed.firsts.len() * (2 * row_bytes + 2 * size_of::<(Vec<u32>, StateIdx)>() + size_of::<usize>())
        });
        self.moves.capacity() * (size_of::<Move>() + size_of::<f64>()) + passed
    }
}
