//! A cave as a source of states: which there are, and how they follow from one another.

use std::io;
use std::ops::Range;
use std::sync::Arc;

use super::attributes::position;
use super::reading::WrittenCave;
use super::{Act, Cave, CaveState, Heading, cell_index};
use crate::attribute::{Schema, Value};
use crate::interrupt::{Interrupt, Interrupted, Meter};
use crate::model::dynamics::{Dynamics, write_definition};
use crate::model::{ActionIdx, CompileError, Implicit, Limits, Model, Operator, Outcome, StateIdx};

impl Dynamics for Cave {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn compiling_bytes(&self, limits: Limits) -> u64 {
        /// Exploring keeps the states themselves, their numbers, and the transitions from each, beside what is compiled.
        const EXPLORED_BYTES: u64 = (4 * size_of::<(CaveState, StateIdx)>()) as u64;
        let n_bits = u32::try_from(self.wumpi.len() + self.gold.len()).unwrap_or(u32::MAX);
        // Facing four ways, inside and outside.
        let n_poses = self.is_pit.len() as u64 * 4 * 2 * (u64::from(self.arrows) + 1);
        let n_states = 1_u64.checked_shl(n_bits).unwrap_or(u64::MAX).saturating_mul(n_poses);
        let n_states = n_states.min(limits.max_states as u64);
        let n_transitions = n_states.saturating_mul(self.actions.len() as u64);
        let compiled = Model::compiled_bytes(n_states, n_transitions, self.schema.len() as u64);
        compiled.saturating_add(n_states.saturating_mul(EXPLORED_BYTES)).min(limits.max_bytes as u64)
    }

    fn compile(self: Arc<Self>, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, CompileError> {
        Ok(Model::explore(self.schema.clone(), self.actions.clone(), self, limits, interrupt)?)
    }

    fn write(&self, writer: &mut dyn io::Write) -> io::Result<()> {
        write_definition(writer, None, &self.actions, &WrittenCave::of(self))
    }
}

impl Implicit for Cave {
    type State = CaveState;

    /// A boolean's index is its value, and that of a number as well.
    fn domains(&self) -> Vec<Vec<Value>> {
        let count = |n: u16| (0..n).map(|n| Value::Number(f64::from(n))).collect::<Vec<_>>();
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_THINGS")]
        let n_gold = self.gold.len() as u16;
        let mut domains = vec![
            count(self.width),
            count(self.height),
            (0..4).map(Value::Label).collect(),
            count(n_gold + 1),
            count(u16::from(self.arrows) + 1),
        ];
        let booleans = vec![Value::Boolean(false), Value::Boolean(true)];
        domains.extend(std::iter::repeat_n(booleans, 1 + self.wumpi.len() + self.gold.len()));
        domains
    }

    fn row(&self, state: &CaveState) -> impl Iterator<Item = u32> {
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_THINGS")]
        let n_gold = self.gold.len() as u32;
        let (x, y) = state.cell;
        let taken = n_gold - state.lying.count_ones();
        let counts = [x.into(), y.into(), state.heading as u32, taken, state.arrows.into(), state.outside.into()];
        let bits = |word: u64, n: usize| (0..n).map(move |k| u32::from(word >> k & 1 == 1));
        counts.into_iter().chain(bits(state.alive, self.wumpi.len())).chain(bits(state.lying, self.gold.len()))
    }

    fn state_of(&self, row: &[Option<u32>]) -> Option<CaveState> {
        let word = |positions: Range<usize>| {
            let bits = positions.zip(0..).map(|(at, bit)| Some(u64::from(row[at]?) << bit));
            bits.sum::<Option<u64>>()
        };
        let state = CaveState {
            cell: (row[position::X]?.try_into().ok()?, row[position::Y]?.try_into().ok()?),
            heading: Heading::ALL[row[position::HEADING]? as usize],
            arrows: row[position::ARROWS]?.try_into().ok()?,
            outside: row[position::OUTSIDE]? == 1,
            alive: word(self.wumpus_positions())?,
            lying: word(self.gold_positions())?,
        };
        let n_taken = self.gold.len() - state.lying.count_ones() as usize;
        let n_killed = self.wumpi.len() - state.alive.count_ones() as usize;
        let is_consistent = row[position::GOLD].is_none_or(|gold| gold as usize == n_taken)
            && n_killed <= usize::from(self.arrows - state.arrows)
            && (!state.outside || state.cell == self.start.0)
            && !self.is_deadly(&state);
        is_consistent.then_some(state)
    }

    /// How much gold the agent has follows from the pieces that are left.
    fn is_derived(&self, attribute: usize) -> bool {
        attribute == position::GOLD
    }

    fn start_states(&self) -> Vec<CaveState> {
        vec![self.first_state()]
    }

    #[inline]
    fn is_unsafe(&self, state: &CaveState) -> bool {
        self.is_deadly(state)
    }

    #[inline]
    fn successors(&self, state: &CaveState) -> impl Iterator<Item = (ActionIdx, Outcome<CaveState>)> {
        let after = |act: &Act| Outcome::certain(self.after(*state, *act));
        (0..).zip(self.acts.iter().map(after))
    }

    fn operators(&self) -> impl Iterator<Item = Operator> {
        self.all_operators()
    }

    /// Those with all wumpi alive. A body that goes ahead and turns comes to every pose in the
    /// cells that are connected, with or without each piece of gold there; of several in one cell, the first is taken first. It may have
    /// shot any of its arrows before, which opens cells and closes none.
    fn least_states(&self, meter: &mut Meter<'_>) -> Result<u64, Interrupted> {
        let has = |act: Act| self.acts.contains(&act);
        if !has(Act::Forward) || !(has(Act::TurnLeft) || has(Act::TurnRight)) {
            return Ok(1);
        }
        let (start, _) = self.start;
        let mut is_closed = self.is_pit.clone();
        for wumpus in &self.wumpi {
            is_closed[cell_index(*wumpus, self.width)] = true;
        }
        is_closed[cell_index(start, self.width)] = true;
        let mut reached = vec![start];
        let mut next = 0;
        while let Some(cell) = reached.get(next).copied() {
            meter.spend_or_stop(1)?;
            next += 1;
            for to in Heading::ALL.into_iter().filter_map(|heading| self.ahead(cell, heading)) {
                if !std::mem::replace(&mut is_closed[cell_index(to, self.width)], true) {
                    reached.push(to);
                }
            }
        }
        let n_arrows = if has(Act::Shoot) { u64::from(self.arrows) } else { 0 };
        let mut n_states = 4 * reached.len() as u64 * (1 + n_arrows);
        let is_reached =
            |cell| is_closed[cell_index(cell, self.width)] && !self.is_pit(cell) && !self.wumpi.contains(&cell);
        let heaps =
            self.gold.iter().enumerate().filter(|(k, cell)| !self.gold[..*k].contains(cell) && is_reached(**cell));
        for (_, cell) in heaps.filter(|_| has(Act::Grab)) {
            let n_pieces = self.gold.iter().filter(|other| *other == cell).count() as u64;
            n_states = n_states.saturating_mul(1 + n_pieces);
        }
        Ok(n_states)
    }
}
