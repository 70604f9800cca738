//! Dynamics of the wumpus world (Gudla & Huber's environment, after Russell & Norvig).
//!
//! A cave is a grid; x grows east, y north, both from 0. Pits and live wumpi kill. An arrow flies from the agent's cell
//! to the wall and kills the first live wumpus in line. Gold is taken piece by piece, and the cave is left by climbing
//! out of the start cell.
//!
//! [`Cave`] holds the rules ([`Cave::after`]), and the actions of a body; as [`Implicit`](super::Implicit) dynamics it gives the states that
//! this body reaches.

mod attributes;
mod dynamics;
mod operators;
mod reading;

use serde::{Deserialize, Serialize};

pub(super) use reading::read;
pub use reading::{CellDocument, PoseDocument, WumpusDocument};

use super::Action;
use crate::attribute::Schema;

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
    /// Cells from west to east.
    width: u16,
    /// Cells from south to north.
    height: u16,
    /// Cells with a pit.
    pits: Vec<Cell>,
    /// Whether there is a pit, by [`cell_index`]. Shape `[height, width]`.
    is_pit: Vec<bool>,
    /// Cells with a wumpus, in the order of their attributes.
    wumpi: Vec<Cell>,
    /// Cells with a piece of gold, in the order of their attributes.
    gold: Vec<Cell>,
    /// Where the agent starts.
    start: (Cell, Heading),
    /// How many arrows it starts with.
    arrows: u8,
    /// The body.
    actions: Vec<Action>,
    /// What each of its actions does. Shape `[n_actions]`.
    acts: Vec<Act>,
    /// See [`Self::schema`].
    schema: Schema,
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

    /// The attributes of a state of this cave.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.schema
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
