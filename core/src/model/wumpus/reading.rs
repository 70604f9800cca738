//! Caves as they are written in JSON.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{Act, Cave, Cell, Heading, attributes, cell_index};
use crate::document::{Faults, Object, Path, Place, Quoted};
use crate::interrupt::{Interrupted, Meter};
use crate::model::action::ReadActions;
use crate::model::dynamics::{Description, Dynamics};
use crate::model::{Action, Limits};

/// Reads a model of a cave, whose attributes follow from what is in it. A body that names no actions has all six.
pub(in crate::model) fn read(
    description: &mut Description<'_, '_>,
    _: Limits,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Arc<dyn Dynamics>>, Interrupted> {
    let (model, dynamics) = (description.model, description.dynamics);
    if let Some(place) = model.optional("attributes") {
        faults.note(&place, "the attributes of a wumpus world are implied; leave this out");
    }
    let actions = match model.optional("actions") {
        None => Some(all_actions()),
        Some(place) => {
            let actions = ReadActions::read(&place, Cave::DEFAULT_ACTION_COST, faults);
            check_actions(&place, faults);
            actions.and_then(ReadActions::complete)
        }
    };
    let cave = Cave::read(&dynamics, actions, meter, faults)?;
    Ok(cave.map(|cave| Arc::new(cave) as Arc<dyn Dynamics>))
}

fn all_actions() -> Vec<Action> {
    Act::ALL.map(|act| Action { name: act.name().into(), cost: Cave::DEFAULT_ACTION_COST }).to_vec()
}

/// Notes actions that the agent of a wumpus world does not have.
fn check_actions(place: &Place<'_, '_>, faults: &mut Faults) {
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

impl Cave {
    /// Reads the world. `actions` are `None` where they had faults of their own.
    fn read(
        place: &Place<'_, '_>,
        actions: Option<Vec<Action>>,
        meter: &mut Meter<'_>,
        faults: &mut Faults,
    ) -> Result<Option<Self>, Interrupted> {
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
            let (width, height, pits, wumpi, gold) = (width?, height?, pits?, wumpi?, gold?);
            let mut is_pit = vec![false; usize::from(width) * usize::from(height)];
            for (x, y) in &pits {
                is_pit[cell_index((*x, *y), width)] = true;
            }
            let actions = actions?;
            let schema = attributes::schema(wumpi.len(), gold.len());
            Some(Self {
                width,
                height,
                pits,
                is_pit,
                wumpi,
                gold,
                start: start?,
                arrows: arrows?,
                acts: actions.iter().map(|action| Act::named(&action.name)).collect::<Option<_>>()?,
                actions,
                schema,
            })
        };
        let cave = cave();
        if let Some((cell, _)) = start {
            note_deadly(&object, cell, meter, faults)?;
        }
        Ok(cave)
    }

    fn document(&self) -> WumpusDocument {
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

fn read_cells(
    object: &Object<'_, '_>,
    name: &str,
    size: (u16, u16),
    most: usize,
    meter: &mut Meter<'_>,
    faults: &mut Faults,
) -> Result<Option<Vec<Cell>>, Interrupted> {
    let Some(place) = object.optional(name) else { return Ok(Some(Vec::new())) };
    let Some(items) = place.array(faults) else { return Ok(None) };
    if items.len() > most {
        return Ok(place.mismatch(&format!("at most {most} cells"), faults));
    }
    let mut cells = Vec::with_capacity(items.len());
    for (n, item) in items.iter().enumerate() {
        meter.spend_or_stop(1)?;
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
) -> Result<(), Interrupted> {
    for (name, thing) in [("pits", "pit"), ("wumpi", "wumpus")] {
        let Some(list) = object.optional(name) else { continue };
        for (n, item) in list.value.as_array().into_iter().flatten().enumerate() {
            meter.spend_or_stop(1)?;
            let cell = item.as_array().map(Vec::as_slice).unwrap_or_default();
            let place = list.item(n, item);
            let coordinates = cell.iter().enumerate().map(|(k, coordinate)| place.item(k, coordinate).whole());
            if !coordinates.eq([Some(x.into()), Some(y.into())]) {
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = WumpusDynamics))]
pub struct WumpusDocument {
    /// Cells from west to east: 1 to 1000.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 1000, example = 7))]
    pub width: u16,
    /// Cells from south to north: 1 to 1000.
    #[cfg_attr(feature = "openapi", schema(minimum = 1, maximum = 1000, example = 4))]
    pub height: u16,
    /// Cells that kill.
    #[serde(default)]
    pub pits: Vec<CellDocument>,
    /// Cells that kill while their wumpus lives: at most 64. They are `wumpus_1`, `wumpus_2`, .. in this order.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(max_items = 64))]
    pub wumpi: Vec<CellDocument>,
    /// Cells with a piece of gold: at most 64. They are `gold_1`, `gold_2`, .. in this order.
    #[serde(default)]
    #[cfg_attr(feature = "openapi", schema(max_items = 64))]
    pub gold: Vec<CellDocument>,
    /// Where the agent starts, and may climb out; (0, 0) facing east if left out.
    #[serde(default)]
    pub start: PoseDocument,
    /// How many arrows it starts with: 0 to 100; 1 if left out.
    #[serde(default = "one_arrow")]
    #[cfg_attr(feature = "openapi", schema(maximum = 100, example = 1))]
    pub arrows: u8,
}

/// The dynamics as they are written in canonical form.
#[derive(Serialize)]
pub(super) struct WrittenCave {
    kind: &'static str,
    #[serde(flatten)]
    cave: WumpusDocument,
}

impl WrittenCave {
    pub(super) fn of(cave: &Cave) -> Self {
        Self { kind: "wumpus", cave: cave.document() }
    }
}

fn one_arrow() -> u8 {
    1
}

/// A cell, `[x, y]`; x grows east, y north, both from 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellDocument(pub u16, pub u16);

// Derived, each of its items would have its description and its example.
#[cfg(feature = "openapi")]
impl utoipa::PartialSchema for CellDocument {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::Schema> {
        use utoipa::openapi::schema::{ArrayBuilder, ObjectBuilder, Type};
        ArrayBuilder::new()
            .description(Some("A cell, `[x, y]`; x grows east, y north, both from 0."))
            .items(ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).maximum(Some(999)))
            .min_items(Some(2))
            .max_items(Some(2))
            .examples([serde_json::json!([3, 0])])
            .into()
    }
}

#[cfg(feature = "openapi")]
impl utoipa::ToSchema for CellDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "Cell".into()
    }
}

/// A cell and a direction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Pose, example = json!({"x": 0, "y": 0, "heading": "east"})))]
pub struct PoseDocument {
    /// Counted from the west.
    pub x: u16,
    /// Counted from the south.
    pub y: u16,
    /// East if left out.
    #[cfg_attr(feature = "openapi", schema(required = false))]
    pub heading: Heading,
}

impl Default for PoseDocument {
    fn default() -> Self {
        Self { x: 0, y: 0, heading: Heading::East }
    }
}
