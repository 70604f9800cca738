//! What a lookahead asks of a mapper: the search of a window, and what is done when the budget of all of them runs out.

use super::{Choices, Mapper, Mapping, Settings, Status, conclude, renumber};
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::heuristic::projected::{Projected, TableRoom, most_bytes};
use crate::mapping::search::Found;
use crate::mapping::{Budget, Move, MoveKind, Problem, StoppedBy};
use crate::model::{Space, States};

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
        /// As if there was so much for each observation.
        const CHOICE_BYTES: usize = 1 << 18;
        let max_bytes = budget.max_bytes.clamp(Self::WINDOW_BYTES, Budget::DEFAULT.max_bytes);
        let as_if = Self::WINDOW_BYTES.max(problem.demonstration.len().saturating_mul(CHOICE_BYTES));
        let choices = Choices { max_bytes: as_if.min(Budget::DEFAULT.max_bytes), may_turn: false };
        // Of two attempts to make tables, there is room for one.
        let (table_bytes, _) = most_bytes(&self.projections, problem, TableRoom::within(choices.max_bytes));
        if table_bytes / 2 > max_bytes {
            return self.complete(problem, Vec::new(), None, StoppedBy::Memory, interrupt);
        }
        let budget = Budget { max_bytes, ..budget };
        self.map_by(choices, problem, Settings { budget, ..Settings::default() }, interrupt)
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
