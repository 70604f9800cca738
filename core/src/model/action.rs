//! Actions: what a body can do, and what it pays for it.

use std::borrow::Cow;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::attribute::MAX_COST;
use crate::document::{Faults, Path, Place, Quoted, Range, list_known, normal};

/// Index of an action in its model.
pub type ActionIdx = u16;

/// Something that a body can do.
#[derive(Clone, Debug, PartialEq)]
pub struct Action {
    /// Unique within the model.
    pub name: Arc<str>,
    /// What the body pays for it. Finite, at least 0; dimensionless, weighed against distances.
    pub cost: f64,
}

impl Action {
    /// Most actions of a model.
    pub const MAX_ACTIONS: usize = 4096;
    /// Longest name, in characters.
    pub const MAX_NAME_CHARS: usize = 64;
}

/// An action, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "openapi", schema(as = Action))]
pub struct ActionDocument {
    /// Unique within the model; 1 to 64 characters.
    #[cfg_attr(feature = "openapi", schema(value_type = String, example = "forward"))]
    pub name: Arc<str>,
    /// What the body pays for it: 0 to 1e150. Left out: 1, in a wumpus world 0.3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(minimum = 0.0, example = 0.3))]
    pub cost: Option<f64>,
}

impl From<&Action> for ActionDocument {
    fn from(action: &Action) -> Self {
        Self { name: action.name.clone(), cost: Some(action.cost) }
    }
}

/// The actions of a document, as far as they could be read.
#[derive(Debug)]
pub(super) struct ReadActions<'v> {
    /// `None` for each that is faulty, so that transitions can still be checked against the others.
    actions: Vec<Option<Action>>,
    /// The index of each name that could be read, faulty actions' too. Hashed with a seed, as clients choose the names.
    positions: HashMap<Cow<'v, str>, ActionIdx>,
    /// Whether every action's name could be read.
    is_named: bool,
}

impl<'v> ReadActions<'v> {
    /// Reads the actions of a body.
    pub(super) fn read(place: &Place<'v, '_>, default_cost: f64, faults: &mut Faults) -> Option<Self> {
        let items = place.array(faults)?;
        if items.len() > Action::MAX_ACTIONS {
            faults.note(place, format!("expected at most {} actions, found {}", Action::MAX_ACTIONS, items.len()));
            return None;
        }
        let mut read = Self { actions: Vec::with_capacity(items.len()), positions: HashMap::new(), is_named: true };
        for (item, index) in items.iter().zip(0..) {
            let place = place.item(index.into(), item);
            read.actions.push(read_action(&place, default_cost, faults));
            match item.get("name").and_then(serde_json::Value::as_str) {
                None => read.is_named = false,
                Some(name) => match read.positions.entry(normal(name)) {
                    Entry::Vacant(entry) => drop(entry.insert(index)),
                    Entry::Occupied(_) => {
                        let detail = format!("another action is called {} already", Quoted(name));
                        faults.note_at(&Path::Member(&place.path, "name"), detail);
                    }
                },
            }
        }
        Some(read)
    }

    /// Reads a reference to an action: its name or index. `None` also where it may refer to an action that could not be
    /// read.
    pub(super) fn read_reference(&self, place: &Place<'_, '_>, faults: &mut Faults) -> Option<ActionIdx> {
        let Some(name) = place.value.as_str() else {
            let index = place.index(self.actions.len(), "action", faults)?;
            return ActionIdx::try_from(index).ok();
        };
        let position = self.positions.get(normal(name).as_ref()).copied();
        if position.is_none() && self.is_named {
            let names = self.actions.iter().flatten().map(|action| &action.name);
            return place.mismatch(&format!("one of the actions {}", list_known(names)), faults);
        }
        position
    }

    /// What the action at `index` costs; 0 if it is faulty.
    pub(super) fn cost(&self, index: ActionIdx) -> f64 {
        self.actions.get(usize::from(index)).and_then(Option::as_ref).map_or(0.0, |action| action.cost)
    }

    /// The actions, if none is faulty.
    pub(super) fn complete(self) -> Option<Vec<Action>> {
        self.actions.into_iter().collect()
    }
}

fn read_action(place: &Place<'_, '_>, default_cost: f64, faults: &mut Faults) -> Option<Action> {
    let object = place.object(&["name", "cost"], faults)?;
    let cost = match object.optional("cost") {
        Some(place) => place.number(Range::UpTo(MAX_COST), faults),
        None => Some(default_cost),
    };
    let place = object.required("name", faults)?;
    let name = normal(place.string(faults)?);
    if !(1..=Action::MAX_NAME_CHARS).contains(&name.chars().count()) {
        return place.mismatch(&format!("a name of 1 to {} characters", Action::MAX_NAME_CHARS), faults);
    }
    Some(Action { name: name.into(), cost: cost? })
}
