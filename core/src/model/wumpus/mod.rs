//! Dynamics of the wumpus world (Gudla & Huber's environment, after Russell & Norvig).
//!
//! A cave is a grid; x grows east, y north, both from 0. Pits and live wumpi kill. An arrow flies from the agent's cell
//! to the wall and kills the first live wumpus in line. Gold is taken piece by piece, and the cave is left by climbing
//! out of the start cell.
//!
//! [`Cave`] holds the rules ([`Cave::after`]), free of any body; [`Cave::compile`] explores what a body can reach by them
//! ([`Explored`]), or leaves that to searches if it is too much.

mod reading;

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};

pub use reading::{CellDocument, PoseDocument, WumpusDocument};

use super::explored::Explored;
use super::{Action, Graph, Limits, Model, Space, Start, StateIdx, States, Transition};
use crate::attribute::{Attribute, Cycle, Kind, Labels, Schema, Value};
use crate::interrupt::{Interrupt, Interrupted, Meter};

/// A direction in the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Heading {
    /// Towards larger x.
    East,
    /// Towards larger y.
    North,
    /// Towards smaller x.
    West,
    /// Towards smaller y.
    South,
}

impl Heading {
    /// Every heading, in the order of its labels: each is a left turn from the one before.
    pub const ALL: [Self; 4] = [Self::East, Self::North, Self::West, Self::South];

    /// The name of the heading, as in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::East => "east",
            Self::North => "north",
            Self::West => "west",
            Self::South => "south",
        }
    }

    fn turned(self, quarters: usize) -> Self {
        Self::ALL[(self as usize + quarters) % Self::ALL.len()]
    }
}

/// Where the attributes of a state stand; wumpi and pieces of gold come after these.
pub(super) mod position {
    pub(in crate::model) const X: usize = 0;
    pub(in crate::model) const Y: usize = 1;
    pub(in crate::model) const HEADING: usize = 2;
    pub(in crate::model) const GOLD: usize = 3;
    pub(in crate::model) const ARROWS: usize = 4;
    pub(in crate::model) const OUTSIDE: usize = 5;
}

/// A cell of the grid: `(x, y)`.
pub type Cell = (u16, u16);

/// What the agent of a wumpus world can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Act {
    /// One cell ahead.
    Forward,
    /// A quarter turn counterclockwise.
    TurnLeft,
    /// A quarter turn clockwise.
    TurnRight,
    /// An arrow, to the wall.
    Shoot,
    /// One piece of gold in this cell.
    Grab,
    /// Out of the cave, in the start cell.
    Climb,
}

impl Act {
    /// Every act, in the order of a body that names none.
    pub const ALL: [Self; 6] = [Self::Forward, Self::TurnLeft, Self::TurnRight, Self::Shoot, Self::Grab, Self::Climb];

    /// The name of the act, as in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::TurnLeft => "turn_left",
            Self::TurnRight => "turn_right",
            Self::Shoot => "shoot",
            Self::Grab => "grab",
            Self::Climb => "climb",
        }
    }

    /// The act called `name`.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|act| act.name() == name)
    }
}

/// Everything that can change in a cave.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct CaveState {
    /// Where the agent is.
    pub cell: Cell,
    /// Where it faces.
    pub heading: Heading,
    /// How many arrows it has left.
    pub arrows: u8,
    /// Whether it has left the cave.
    pub outside: bool,
    /// Bit `k` is set while wumpus `k + 1` lives.
    pub alive: u64,
    /// Bit `k` is set while gold piece `k + 1` lies where it was.
    pub lying: u64,
}

/// A wumpus world, and a body in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Cave {
    width: u16,
    height: u16,
    pits: Vec<Cell>,
    /// Whether there is a pit, by [`cell_index`]. Shape `[height, width]`.
    is_pit: Vec<bool>,
    wumpi: Vec<Cell>,
    gold: Vec<Cell>,
    start: (Cell, Heading),
    arrows: u8,
    actions: Vec<Action>,
}

impl Cave {
    /// Cost of an action that names none.
    pub const DEFAULT_ACTION_COST: f64 = 0.3;
    /// Longest side of the grid.
    pub const MAX_SIDE: u16 = 1000;
    /// Most wumpi, and most pieces of gold: one bit of a word each.
    pub const MAX_THINGS: usize = 64;
    /// Most arrows.
    pub const MAX_ARROWS: u8 = 100;

    /// The actions of the body.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        &self.actions
    }

    /// Width and height of the grid.
    #[must_use]
    pub fn size(&self) -> (u16, u16) {
        (self.width, self.height)
    }

    /// Where the pits are.
    #[must_use]
    pub fn pits(&self) -> &[Cell] {
        &self.pits
    }

    /// Where the wumpi are.
    #[must_use]
    pub fn wumpi(&self) -> &[Cell] {
        &self.wumpi
    }

    /// Where the gold lies at first.
    #[must_use]
    pub fn gold(&self) -> &[Cell] {
        &self.gold
    }

    /// How everything is at first.
    #[must_use]
    pub fn first_state(&self) -> CaveState {
        let (cell, heading) = self.start;
        let (alive, lying) = (all_set(self.wumpi.len()), all_set(self.gold.len()));
        CaveState { cell, heading, arrows: self.arrows, outside: false, alive, lying }
    }

    /// How everything is after `act` in `state`. Equal to `state` if the act has no effect; deadly if
    /// [`Self::is_deadly`] says so.
    #[must_use]
    pub fn after(&self, state: CaveState, act: Act) -> CaveState {
        let mut next = state;
        if state.outside {
            return next;
        }
        match act {
            Act::Forward => next.cell = self.ahead(state.cell, state.heading).unwrap_or(state.cell),
            Act::TurnLeft => next.heading = state.heading.turned(1),
            Act::TurnRight => next.heading = state.heading.turned(3),
            Act::Shoot if state.arrows > 0 => {
                next.arrows -= 1;
                next.alive &= !self.hit_from(&state).unwrap_or(0);
            }
            Act::Grab => next.lying &= !first_in(&self.gold, state.cell, state.lying).unwrap_or(0),
            Act::Climb => next.outside = state.cell == self.start.0,
            Act::Shoot => {}
        }
        next
    }

    /// The bit of the wumpus that an arrow hits: the nearest of those alive in line, the first of those in one cell.
    fn hit_from(&self, state: &CaveState) -> Option<u64> {
        let (x, y) = state.cell;
        let ahead = |(to_x, to_y): Cell| {
            let distance = match state.heading {
                Heading::East if to_y == y => to_x.checked_sub(x),
                Heading::North if to_x == x => to_y.checked_sub(y),
                Heading::West if to_y == y => x.checked_sub(to_x),
                Heading::South if to_x == x => y.checked_sub(to_y),
                _ => None,
            };
            distance.filter(|distance| *distance > 0)
        };
        let alive = self.wumpi.iter().zip(bits()).filter(|(_, bit)| state.alive & bit != 0);
        let in_line = alive.filter_map(|(wumpus, bit)| Some((ahead(*wumpus)?, bit)));
        in_line.min_by_key(|(distance, _)| *distance).map(|(_, bit)| bit)
    }

    /// Whether the agent is dead in `state`: in a pit, or with a live wumpus.
    #[must_use]
    pub fn is_deadly(&self, state: &CaveState) -> bool {
        self.is_pit(state.cell) || first_in(&self.wumpi, state.cell, state.alive).is_some()
    }

    pub(super) fn is_pit(&self, cell: Cell) -> bool {
        self.is_pit[cell_index(cell, self.width)]
    }

    /// The cell next to this one, if that is in the grid.
    pub(super) fn ahead(&self, (x, y): Cell, heading: Heading) -> Option<Cell> {
        let (x, y) = match heading {
            Heading::East => (x.checked_add(1)?, y),
            Heading::North => (x, y.checked_add(1)?),
            Heading::West => (x.checked_sub(1)?, y),
            Heading::South => (x, y.checked_sub(1)?),
        };
        (x < self.width && y < self.height).then_some((x, y))
    }

    /// The attributes of a state of this cave.
    #[must_use]
    pub fn schema(&self) -> Schema {
        let number = Kind::Number { scale: 1.0 };
        let labels = Labels::of(Heading::ALL.map(Heading::name));
        let heading = Kind::Cyclic { scale: 1.0, cycle: Cycle::Labels(labels) };
        let attribute =
            |name: &str, kind: &Kind, weight: f64| Attribute { name: name.to_owned(), kind: kind.clone(), weight };
        let mut attributes = vec![
            attribute("x", &number, 1.0),
            attribute("y", &number, 1.0),
            attribute("heading", &heading, 1.0),
            attribute("gold", &number, 1.0),
            attribute("arrows", &number, 1.0),
            attribute("outside", &Kind::Category, 5.0),
        ];
        attributes.extend((1..=self.wumpi.len()).map(|k| attribute(&format!("wumpus_{k}"), &Kind::Category, 0.0)));
        attributes.extend((1..=self.gold.len()).map(|k| attribute(&format!("gold_{k}"), &Kind::Category, 0.0)));
        Schema::of(attributes)
    }

    /// Values by attribute; [`Self::row`] gives indices into these. A boolean's index is its value.
    pub(super) fn domains(&self) -> Vec<Vec<Value>> {
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

    /// The state as indices into [`Self::domains`].
    pub(crate) fn row(&self, state: &CaveState) -> impl Iterator<Item = u32> {
        #[expect(clippy::cast_possible_truncation, reason = "at most MAX_THINGS")]
        let n_gold = self.gold.len() as u32;
        let (x, y) = state.cell;
        let taken = n_gold - state.lying.count_ones();
        let counts = [x.into(), y.into(), state.heading as u32, taken, state.arrows.into(), state.outside.into()];
        let bits = |word: u64, n: usize| (0..n).map(move |k| u32::from(word >> k & 1 == 1));
        counts.into_iter().chain(bits(state.alive, self.wumpi.len())).chain(bits(state.lying, self.gold.len()))
    }

    /// Explores, breadth first, every state that the body reaches from the start. States are numbered as they are found. If that are
    /// more than `limits` allow, they are left to searches.
    pub(super) fn compile(&self, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, Interrupted> {
        /// How many successors, cells or transitions are looked at between two looks at the interrupt: well below a millisecond.
        const POLL_EVERY: u64 = 1 << 10;
        /// What a transition takes in the end, beside what is found.
        const TRANSITION_BYTES: usize = 2 * size_of::<Transition>();
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let n_attributes = self.first_row().len();
        let max_states = limits.max_states.min(limits.max_values / n_attributes);
        if self.least_states(&mut meter)? > max_states as u64 {
            return Ok(self.unexplored());
        }
        let mut explored = Explored::new(self, self.first_state());
        let mut from = 0;
        while from < explored.n_found() {
            let n_bytes = explored.found_bytes() + explored.n_ways() * TRANSITION_BYTES;
            if explored.n_found() > max_states || n_bytes > limits.max_bytes {
                return Ok(self.unexplored());
            }
            meter.spend_or_stop(explored.n_acts())?;
            #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
            explored.explore(from as StateIdx);
            from += 1;
        }
        let (states, graph) = explored.into_parts(&mut meter)?;
        Ok(self.model(states, graph, None))
    }

    /// See [`Definition::compiling_bytes`](super::Definition::compiling_bytes).
    pub(super) fn compiling_bytes(&self, limits: Limits) -> u64 {
        /// Exploring keeps the states themselves, their numbers, and the ways out of each, beside what is compiled.
        const EXPLORED_BYTES: u64 = (4 * size_of::<(CaveState, StateIdx)>()) as u64;
        let n_bits = u32::try_from(self.wumpi.len() + self.gold.len()).unwrap_or(u32::MAX);
        // Facing four ways, inside and outside.
        let n_poses = self.is_pit.len() as u64 * 4 * 2 * (u64::from(self.arrows) + 1);
        let n_states = 1_u64.checked_shl(n_bits).unwrap_or(u64::MAX).saturating_mul(n_poses);
        let n_states = n_states.min(limits.max_states as u64);
        let n_transitions = n_states.saturating_mul(self.actions.len() as u64);
        let compiled = Model::compiled_bytes(n_states, n_transitions, self.schema().len() as u64);
        compiled.saturating_add(n_states.saturating_mul(EXPLORED_BYTES)).min(limits.max_bytes as u64)
    }

    /// How many states the body reaches at least: those with all wumpi alive. A body that goes ahead and turns comes to every pose in the
    /// cells that are connected, with or without each piece of gold there; of several in one cell, the first is taken first. It may have
    /// shot any of its arrows before, which opens cells and closes none.
    fn least_states(&self, meter: &mut Meter<'_>) -> Result<u64, Interrupted> {
        let has = |act: Act| self.actions.iter().any(|action| Act::named(&action.name) == Some(act));
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
            |cell: Cell| is_closed[cell_index(cell, self.width)] && !self.is_pit(cell) && !self.wumpi.contains(&cell);
        let heaps =
            self.gold.iter().enumerate().filter(|(k, cell)| !self.gold[..*k].contains(cell) && is_reached(**cell));
        for (_, cell) in heaps.filter(|_| has(Act::Grab)) {
            let n_pieces = self.gold.iter().filter(|other| *other == cell).count() as u64;
            n_states = n_states.saturating_mul(1 + n_pieces);
        }
        Ok(n_states)
    }

    /// The row of the first state.
    fn first_row(&self) -> Vec<u32> {
        self.row(&self.first_state()).collect()
    }

    /// The model of which nothing but the start is known.
    fn unexplored(&self) -> Model {
        let states = States::new(self.domains(), self.first_row());
        self.model(states, Graph::of_one_state(), Some(self.clone()))
    }

    fn model(&self, states: States, graph: Graph, unexplored: Option<Self>) -> Model {
        Model {
            schema: self.schema(),
            actions: self.actions.clone(),
            n_transitions: graph.n_transitions(),
            states: Arc::new(states),
            graph,
            start: Start::State(0),
            is_unsafe: Vec::new(),
            n_unsafe: 0,
            unexplored,
            state_bytes: OnceLock::new(),
        }
    }

    /// The state with these values, if there may be one; the one of [`position::GOLD`] may be missing.
    fn state_of(&self, wanted: &[Option<Value>]) -> Option<CaveState> {
        let domains = self.domains();
        let index = |at: usize| domains[at].iter().position(|value| Some(value) == wanted[at].as_ref());
        let word = |positions: Range<usize>| {
            let bits = positions.zip(0..).map(|(at, bit)| Some((index(at)? as u64) << bit));
            bits.sum::<Option<u64>>()
        };
        let state = CaveState {
            cell: (index(position::X)?.try_into().ok()?, index(position::Y)?.try_into().ok()?),
            heading: Heading::ALL[index(position::HEADING)?],
            arrows: index(position::ARROWS)?.try_into().ok()?,
            outside: index(position::OUTSIDE)? == 1,
            alive: word(self.wumpus_positions())?,
            lying: word(self.gold_positions())?,
        };
        let n_taken = self.gold.len() - state.lying.count_ones() as usize;
        let n_killed = self.wumpi.len() - state.alive.count_ones() as usize;
        let is_consistent = (wanted[position::GOLD].is_none() || index(position::GOLD) == Some(n_taken))
            && n_killed <= usize::from(self.arrows - state.arrows)
            && (!state.outside || state.cell == self.start.0)
            && !self.is_deadly(&state);
        is_consistent.then_some(state)
    }

    /// Positions of the attributes `wumpus_1`, `wumpus_2`, ..
    pub(super) fn wumpus_positions(&self) -> Range<usize> {
        let first = position::OUTSIDE + 1;
        first..first + self.wumpi.len()
    }

    /// Positions of the attributes `gold_1`, `gold_2`, ..
    pub(super) fn gold_positions(&self) -> Range<usize> {
        let first = self.wumpus_positions().end;
        first..first + self.gold.len()
    }

    /// The world with a body of these actions; `None` leaves it all six.
    pub(super) fn with_actions(self, actions: Option<Vec<Action>>) -> Self {
        match actions {
            Some(actions) => Self { actions, ..self },
            None => self,
        }
    }
}

/// Where a cell stands in a list of all, row by row.
fn cell_index((x, y): Cell, width: u16) -> usize {
    usize::from(y) * usize::from(width) + usize::from(x)
}

fn all_set(n_bits: usize) -> u64 {
    (0..n_bits).fold(0, |word, bit| word | 1 << bit)
}

/// The bit of the first of `things` that is at `cell` and whose bit in `present` is set.
fn first_in(things: &[Cell], cell: Cell, present: u64) -> Option<u64> {
    let mut things = things.iter().zip(bits());
    things.find(|(thing, bit)| **thing == cell && present & bit != 0).map(|(_, bit)| bit)
}

/// The bits of things, in their order.
fn bits() -> impl Iterator<Item = u64> {
    (0..u64::BITS).map(|bit| 1 << bit)
}

#[cfg(test)]
mod tests;
