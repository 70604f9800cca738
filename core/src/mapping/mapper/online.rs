//! What a lookahead asks of a mapper: the search of a window, and what is done when the budget of all of them runs out.

use super::{Choices, Mapper, Mapping, Settings, Status, conclude, renumber, way_bytes};
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::cost::action_costs;
use crate::mapping::heuristic::projected::{Projected, TableRoom, most_bytes, most_bytes_of_all};
use crate::mapping::online::Halt;
use crate::mapping::search::Found;
use crate::mapping::{Budget, Move, MoveKind, Problem, StoppedBy};
use crate::model::{Space, States};

/// The first moves of the cheapest way through a window.
#[derive(Debug)]
pub(in crate::mapping) struct FirstMoves {
    pub(in crate::mapping) moves: Vec<Move>,
    /// What the action of each of them costs; 0 without one.
    pub(in crate::mapping) action_costs: Vec<f64>,
    /// The states of the moves, if the model is searched lazily.
    pub(in crate::mapping) states: Option<States>,
    pub(in crate::mapping) n_expanded: u64,
    pub(in crate::mapping) n_generated: u64,
}

impl From<Mapping> for FirstMoves {
    fn from(mapping: Mapping) -> Self {
        let Mapping { moves, action_costs, states, n_expanded, n_generated, .. } = mapping;
        Self { moves, action_costs, states, n_expanded, n_generated }
    }
}

impl Mapper {
    /// What the search of a window may always take, in bytes, beside the window itself; nearly all do with it.
    pub const WINDOW_BYTES: usize = 4 << 20;

    /// The cheapest mapping of a window. Of those that cost the same, which is found does not depend on the budget, unless that runs out:
    /// whoever follows the same demonstration again, with more memory or less, comes to the same.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(in crate::mapping) fn map_window(
        &self,
        problem: &Problem<'_>,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let Some((choices, budget)) = self.room_for_window(problem, budget) else {
            return self.complete(problem, Vec::new(), None, StoppedBy::Memory, interrupt);
        };
        self.map_by(choices, problem, Settings { budget, ..Settings::default() }, interrupt)
    }

    /// The first moves of the mapping that [`Self::map_window`] finds, of which there are as many as `n_first` says, and no more than is needed for these.
    ///
    /// # Errors
    ///
    /// What ran out, if not all was searched that had to be.
    pub(in crate::mapping) fn first_moves(
        &self,
        problem: &Problem<'_>,
        n_first: impl Fn(&[Move]) -> usize,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<FirstMoves, Halt> {
        let Some((choices, budget)) = self.room_for_window(problem, budget) else {
            return Err(Halt::OutOf(StoppedBy::Memory));
        };
        let settings = Settings { budget: budget.beside(way_bytes(problem)), ..Settings::default() };
        if !self.model.is_lazy() {
            let space = self.model.whole();
            let found = self.layered(choices, problem, settings, f64::INFINITY, interrupt, |found, _, _| Ok(found))?;
            if let Some(Found { mut paths, is_complete, stopped_by, n_expanded, n_generated, .. }) = found {
                let Some(mut moves) = paths.pop().filter(|_| is_complete) else {
                    return Err(Halt::OutOf(stopped_by.unwrap_or(StoppedBy::Memory)));
                };
                moves.truncate(n_first(&moves));
                let action_costs = action_costs(problem, &space, &moves);
                return Ok(FirstMoves { moves, action_costs, states: None, n_expanded, n_generated });
            }
        }
        let mapping = self.map_by(choices, problem, Settings { budget, ..Settings::default() }, interrupt)?;
        if mapping.status != Status::Optimal {
            return Err(Halt::OutOf(mapping.stopped_by.unwrap_or(StoppedBy::Memory)));
        }
        let mut first = FirstMoves::from(mapping);
        first.moves.truncate(n_first(&first.moves));
        Ok(first)
    }

    /// How a window is searched, and what that may take; `None` if there is no room for its tables.
    fn room_for_window(&self, problem: &Problem<'_>, budget: Budget) -> Option<(Choices, Budget)> {
        /// As if there was so much for each observation.
        const CHOICE_BYTES: usize = 1 << 18;
        let max_bytes = budget.max_bytes.clamp(Self::WINDOW_BYTES, Budget::DEFAULT.max_bytes);
        let as_if = Self::WINDOW_BYTES.max(problem.demonstration.len().saturating_mul(CHOICE_BYTES));
        let choices = Choices { max_bytes: as_if.min(Budget::DEFAULT.max_bytes), may_turn: false };
        // Of two attempts to make tables, there is room for one.
        let is_room = |table_bytes: usize| table_bytes / 2 <= max_bytes;
        let table_bytes = || most_bytes(&self.projections, problem, TableRoom::within(choices.max_bytes)).0;
        let is_room =
            is_room(most_bytes_of_all(&self.projections, problem.demonstration.len())) || is_room(table_bytes());
        is_room.then_some((choices, Budget { max_bytes, ..budget }))
    }

    /// A mapping of `problem` that begins with `moves`, if there are any, and goes on greedily, as `stopped_by` ran out. Their states are
    /// numbered in `states`, if the model is searched lazily. Nothing is proven of it.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(in crate::mapping) fn complete(
        &self,
        problem: &Problem<'_>,
        mut moves: Vec<Move>,
        states: Option<&States>,
        stopped_by: StoppedBy,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let mut rows = problem.starts.rows().to_vec();
        if moves.is_empty() {
            let (kind, state) = (MoveKind::Start, problem.closest_start());
            moves.push(Move { kind, action: None, observation: 0, state });
        } else if let Some(states) = states {
            rows = (0..states.len()).map(|state| states.row(state).to_vec()).collect();
        }
        let Some(mut explored) = self.model.explore_from(&rows) else {
            return complete_in(&mut self.model.whole(), problem, moves, stopped_by, interrupt);
        };
        for step in &moves {
            explored.explore(step.state);
        }
        let mut mapping = complete_in(&mut explored, problem, moves, stopped_by, interrupt)?;
        mapping.states = Some(explored.keep(&renumber(&mut mapping.moves)));
        Ok(mapping)
    }
}

/// A mapping that begins with `moves` and goes on greedily.
fn complete_in<S: Space>(
    space: &mut S,
    problem: &Problem<'_>,
    moves: Vec<Move>,
    stopped_by: StoppedBy,
    interrupt: &mut dyn Interrupt,
) -> Result<Mapping, Cancelled> {
    let found = Found {
        paths: vec![moves],
        is_complete: false,
        stopped_by: Some(stopped_by),
        least_f: 0.0,
        n_expanded: 0,
        n_generated: 0,
    };
    let mapping = conclude(problem, space, &Projected::blind(problem), found, interrupt)?;
    Ok(Mapping { status: Status::Local, lower_bound: None, stopped_by: Some(stopped_by), ..mapping })
}
