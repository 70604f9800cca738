//! Actions: what a body can do, and what it pays for it.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::document::{Faults, Place, Range};

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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Action)]
pub struct ActionDocument {
    /// Unique within the model; 1 to 64 characters.
    #[schema(value_type = String, example = "forward")]
    pub name: Arc<str>,
    /// What the body pays for it: 0 to 1e150. Left out: 1 in a table, 0.3 in a wumpus world.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.0, example = 0.3)]
    pub cost: Option<f64>,
}

impl From<&Action> for ActionDocument {
    fn from(action: &Action) -> Self {
        Self { name: action.name.clone(), cost: Some(action.cost) }
    }
}

/// Reads the actions of a body. The list may be shorter than the document's if that has faults.
pub(super) fn read_actions(place: &Place<'_, '_>, default_cost: f64, faults: &mut Faults) -> Option<Vec<Action>> {
    let items = place.array(faults)?;
    if items.len() > Action::MAX_ACTIONS {
        faults.note(place, format!("expected at most {} actions, found {}", Action::MAX_ACTIONS, items.len()));
        return None;
    }
    let mut actions: Vec<Action> = Vec::with_capacity(items.len());
    for (n, item) in items.iter().enumerate() {
        let place = place.item(n, item);
        let Some(action) = read_action(&place, default_cost, faults) else { continue };
        if actions.iter().any(|other| other.name == action.name) {
            faults.note(&place, format!("another action is called {:?} already", action.name));
        }
        actions.push(action);
    }
    Some(actions)
}

fn read_action(place: &Place<'_, '_>, default_cost: f64, faults: &mut Faults) -> Option<Action> {
    let object = place.object(&["name", "cost"], faults)?;
    let cost = match object.optional("cost") {
        Some(place) => place.number(Range::Cost, faults),
        None => Some(default_cost),
    };
    let place = object.required("name", faults)?;
    let name = place.string(faults)?;
    if !(1..=Action::MAX_NAME_CHARS).contains(&name.chars().count()) {
        return place.mismatch(&format!("a name of 1 to {} characters", Action::MAX_NAME_CHARS), faults);
    }
    Some(Action { name: name.into(), cost: cost? })
}
