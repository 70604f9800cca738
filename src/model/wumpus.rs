//! Dynamics of the wumpus world (Gudla & Huber's environment, after Russell & Norvig).
//!
//! A cave is a grid; x grows east, y north, both from 0. Pits and live wumpi kill. An arrow flies from the agent's cell
//! to the wall and kills the first live wumpus in line. Gold is taken piece by piece, and the cave is left by climbing
//! out of the start cell.
//!
//! [`Cave`] holds the rules ([`Cave::after`]), free of any body; [`Cave::compile`] explores what a body can reach by them
//! ([`Explored`]), or leaves that to searches if it is too much.

use std::ops::Range;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::explored::Explored;
use super::{Action, Graph, Limits, Model, Space, Start, StateIdx, States};
use crate::attribute::{Attribute, Cycle, Kind, Labels, Schema, Value};
use crate::document::{Faults, Object, Path, Place, Quoted};
use crate::interrupt::{Cancelled, Interrupt, Meter};

/// A direction in the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
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
                let flight = std::iter::successors(Some(state.cell), |cell| self.ahead(*cell, state.heading));
                let hit = flight.skip(1).find_map(|cell| first_in(&self.wumpi, cell, state.alive));
                next.alive &= !hit.unwrap_or(0);
            }
            Act::Grab => next.lying &= !first_in(&self.gold, state.cell, state.lying).unwrap_or(0),
            Act::Climb => next.outside = state.cell == self.start.0,
            Act::Shoot => {}
        }
        next
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
            attribute("outside", &Kind::Category, 4.0),
        ];
        attributes.extend((1..=self.wumpi.len()).map(|k| attribute(&format!("wumpus_{k}"), &Kind::Category, 0.0)));
        attributes.extend((1..=self.gold.len()).map(|k| attribute(&format!("gold_{k}"), &Kind::Category, 0.0)));
        Schema::new(attributes)
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
    pub(super) fn compile(&self, limits: Limits, interrupt: &mut dyn Interrupt) -> Result<Model, Cancelled> {
        /// How many successors are made between two looks at the interrupt. One may take the flight of an arrow past every
        /// wumpus: tens of microseconds.
        const POLL_EVERY: u64 = 256;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let mut explored = Explored::new(self, self.first_state());
        let mut from = 0;
        while from < explored.n_found() {
            if explored.n_found() > limits.max_states {
                return Ok(self.unexplored());
            }
            meter.spend_or_cancel(explored.n_acts())?;
            #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
            explored.explore(from as StateIdx);
            from += 1;
        }
        let (states, graph) = explored.into_parts();
        Ok(self.model(states, graph, None))
    }

    /// The model of which nothing but the start is known.
    fn unexplored(&self) -> Model {
        let states = States::new(self.domains(), self.row(&self.first_state()).collect());
        self.model(states, Graph::new(1, std::iter::empty()), Some(self.clone()))
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
        }
    }

    /// Reads the start of a request: every attribute of a state but `gold`, which follows from the pieces. Whether the body could come
    /// to it is not asked.
    pub(super) fn read_state(&self, schema: &Schema, place: &Place<'_, '_>, faults: &mut Faults) -> Option<CaveState> {
        let n_before = faults.count();
        let wanted = schema.read_observation(place, faults)?;
        if faults.count() != n_before {
            return None;
        }
        let attributes = schema.attributes().iter().zip(&wanted).enumerate();
        let missing = attributes.filter(|(at, (_, value))| *at != position::GOLD && value.is_none());
        if let Some((_, (attribute, _))) = missing.into_iter().next() {
            let detail = format!(
                "the states of this world are found as it is searched, so all attributes of one are needed; {} is missing",
                Quoted(&attribute.name)
            );
            faults.note(place, detail);
            return None;
        }
        let state = self.state_of(&wanted);
        if state.is_none() {
            faults.note(place, "no state of the model has these values");
        }
        state
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

    /// Reads the world, with a body of all six actions.
    pub(super) fn read(
        place: &Place<'_, '_>,
        meter: &mut Meter<'_>,
        faults: &mut Faults,
    ) -> Result<Option<Self>, Cancelled> {
        let fields = ["kind", "width", "height", "pits", "wumpi", "gold", "start", "arrows"];
        let Some(object) = place.object(&fields, faults) else { return Ok(None) };
        let side = |name: &str, faults: &mut Faults| {
            let side = object.required(name, faults)?.integer(1, Self::MAX_SIDE.into(), faults)?;
            u16::try_from(side).ok()
        };
        let width = side("width", faults);
        let height = side("height", faults);
        // Where a side is missing, any cell may be right.
        let grid = (width.unwrap_or(Self::MAX_SIDE), height.unwrap_or(Self::MAX_SIDE));
        let max_pits = usize::from(Self::MAX_SIDE) * usize::from(Self::MAX_SIDE);
        let pits = read_cells(&object, "pits", grid, max_pits, meter, faults)?;
        let wumpi = read_cells(&object, "wumpi", grid, Self::MAX_THINGS, meter, faults)?;
        let gold = read_cells(&object, "gold", grid, Self::MAX_THINGS, meter, faults)?;
        let start = match object.optional("start") {
            Some(place) => read_pose(&place, grid, faults),
            None => Some(((0, 0), Heading::East)),
        };
        let arrows = match object.optional("arrows") {
            Some(place) => place.integer(0, Self::MAX_ARROWS.into(), faults).and_then(|n| u8::try_from(n).ok()),
            None => Some(1),
        };
        let cave = || {
            let (width, height, pits) = (width?, height?, pits?);
            let mut is_pit = vec![false; usize::from(width) * usize::from(height)];
            for (x, y) in &pits {
                is_pit[cell_index((*x, *y), width)] = true;
            }
            Some(Self {
                width,
                height,
                pits,
                is_pit,
                wumpi: wumpi?,
                gold: gold?,
                start: start?,
                arrows: arrows?,
                actions: Act::ALL
                    .map(|act| Action { name: act.name().into(), cost: Self::DEFAULT_ACTION_COST })
                    .to_vec(),
            })
        };
        let cave = cave();
        if let Some((cell, _)) = start {
            note_deadly(&object, cell, meter, faults)?;
        }
        Ok(cave)
    }

    /// Notes actions that the agent of a wumpus world does not have.
    pub(super) fn check_actions(place: &Place<'_, '_>, faults: &mut Faults) {
        let items = place.value.as_array().map(Vec::as_slice).unwrap_or_default();
        for (n, item) in items.iter().enumerate() {
            let name = item.get("name").and_then(serde_json::Value::as_str);
            if let Some(name) = name.filter(|name| Act::named(name).is_none()) {
                let known = Act::ALL.map(Act::name).join(", ");
                let detail = format!("unknown action {}; a wumpus world has {known}", Quoted(name));
                faults.note_at(&Path::Member(&Path::Item(&place.path, n), "name"), detail);
            }
        }
    }

    /// The world with a body of these actions; `None` leaves it all six.
    pub(super) fn with_actions(self, actions: Option<Vec<Action>>) -> Self {
        match actions {
            Some(actions) => Self { actions, ..self },
            None => self,
        }
    }

    pub(super) fn document(&self) -> WumpusDocument {
        let cells = |cells: &[Cell]| cells.iter().map(|(x, y)| CellDocument(*x, *y)).collect();
        let ((x, y), heading) = self.start;
        WumpusDocument {
            width: self.width,
            height: self.height,
            pits: cells(&self.pits),
            wumpi: cells(&self.wumpi),
            gold: cells(&self.gold),
            start: PoseDocument { x, y, heading },
            arrows: self.arrows,
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
    let bits = things.iter().zip(0..).map(|(thing, bit)| (thing, 1u64 << bit));
    bits.filter(|(thing, bit)| **thing == cell && present & bit != 0).map(|(_, bit)| bit).next()
}

fn read_cells(
    object: &Object<'_, '_>,
    name: &str,
    size: (u16, u16),
    most: usize,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Vec<Cell>>, Cancelled> {
    let Some(place) = object.optional(name) else { return Ok(Some(Vec::new())) };
    let Some(items) = place.array(faults) else { return Ok(None) };
    if items.len() > most {
        return Ok(place.mismatch(&format!("at most {most} cells"), faults));
    }
    let mut cells = Vec::with_capacity(items.len());
    for (n, item) in items.iter().enumerate() {
        meter.spend_or_cancel(1)?;
        let place = place.item(n, item);
        let Some(parts) = place.array(faults) else { continue };
        let [x, y] = parts else {
            faults.note(&place, format!("expected [x, y], found an array of {}", parts.len()));
            continue;
        };
        let x = read_coordinate(&place.item(0, x), size.0, faults);
        let y = read_coordinate(&place.item(1, y), size.1, faults);
        cells.extend(x.zip(y));
    }
    Ok((cells.len() == items.len()).then_some(cells))
}

/// Notes that a pit or a wumpus is where the agent starts: at `start`, unless that is left out.
fn note_deadly(
    object: &Object<'_, '_>,
    (x, y): Cell,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<(), Cancelled> {
    for (name, thing) in [("pits", "pit"), ("wumpi", "wumpus")] {
        let Some(list) = object.optional(name) else { continue };
        for (n, item) in list.value.as_array().into_iter().flatten().enumerate() {
            meter.spend_or_cancel(1)?;
            let cell = item.as_array().map(Vec::as_slice).unwrap_or_default();
            if !cell.iter().map(serde_json::Value::as_u64).eq([Some(x.into()), Some(y.into())]) {
                continue;
            }
            match object.optional("start") {
                Some(start) => faults.note(&start, format!("this cell holds a {thing}")),
                None => faults.note(&list.item(n, item), "the agent starts here, as `start` is left out"),
            }
            break;
        }
    }
    Ok(())
}

fn read_coordinate(place: &Place<'_, '_>, side: u16, faults: &mut Faults) -> Option<u16> {
    let coordinate = place.integer(0, u64::from(side) - 1, faults)?;
    u16::try_from(coordinate).ok()
}

fn read_pose(place: &Place<'_, '_>, size: (u16, u16), faults: &mut Faults) -> Option<(Cell, Heading)> {
    let object = place.object(&["x", "y", "heading"], faults)?;
    let x = object.required("x", faults).and_then(|place| read_coordinate(&place, size.0, faults));
    let y = object.required("y", faults).and_then(|place| read_coordinate(&place, size.1, faults));
    let heading = match object.optional("heading") {
        Some(place) => {
            let heading = Heading::ALL.into_iter().find(|heading| place.value.as_str() == Some(heading.name()));
            heading.or_else(|| place.mismatch(&Heading::ALL.map(Heading::name).join(", "), faults))
        }
        None => Some(Heading::East),
    };
    Some(((x?, y?), heading?))
}

/// A cave of the wumpus world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct WumpusDocument {
    /// Cells from west to east: 1 to 1000.
    #[schema(minimum = 1, maximum = 1000, example = 7)]
    pub width: u16,
    /// Cells from south to north: 1 to 1000.
    #[schema(minimum = 1, maximum = 1000, example = 4)]
    pub height: u16,
    /// Cells that kill.
    #[serde(default)]
    pub pits: Vec<CellDocument>,
    /// Cells that kill while their wumpus lives: at most 64. They are `wumpus_1`, `wumpus_2`, .. in this order.
    #[serde(default)]
    #[schema(max_items = 64)]
    pub wumpi: Vec<CellDocument>,
    /// Cells with a piece of gold: at most 64. They are `gold_1`, `gold_2`, .. in this order.
    #[serde(default)]
    #[schema(max_items = 64)]
    pub gold: Vec<CellDocument>,
    /// Where the agent starts, and may climb out; (0, 0) facing east if left out.
    #[serde(default)]
    pub start: PoseDocument,
    /// How many arrows it starts with: 0 to 100; 1 if left out.
    #[serde(default = "one_arrow")]
    #[schema(maximum = 100, example = 1)]
    pub arrows: u8,
}

fn one_arrow() -> u8 {
    1
}

/// A cell, `[x, y]`; x grows east, y north, both from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Cell, example = json!([3, 0]))]
pub struct CellDocument(pub u16, pub u16);

/// A cell and a direction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Pose, example = json!({"x": 0, "y": 0, "heading": "east"}))]
pub struct PoseDocument {
    /// Counted from the west.
    pub x: u16,
    /// Counted from the south.
    pub y: u16,
    /// East if left out.
    pub heading: Heading,
}

impl Default for PoseDocument {
    fn default() -> Self {
        Self { x: 0, y: 0, heading: Heading::East }
    }
}
