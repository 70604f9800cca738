//! What a client registers as a model.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

use super::action::read_actions;
use super::{Action, ActionDocument, Cave, Limits, TableDocument, WumpusDocument, table};
use crate::attribute::{AttributeDocument, Schema};
use crate::document::{Faults, Place};

/// What a client registers as a model: checked, with defaults filled in, not yet compiled.
#[derive(Clone, Debug)]
pub enum Definition {
    /// States and transitions are listed.
    Table(table::Table),
    /// States and transitions follow from the rules of the wumpus world.
    Wumpus(Cave),
}

impl Definition {
    /// Reads a model.
    ///
    /// # Errors
    ///
    /// All faults of the document.
    pub fn read(document: &serde_json::Value, limits: Limits) -> Result<Self, Faults> {
        let mut faults = Faults::default();
        let definition = read_definition(&Place::root(document), limits, &mut faults);
        faults.check(definition)
    }

    /// The definition as a document in canonical form: defaults filled in, actions of transitions by name. Reading it
    /// gives the same definition.
    #[must_use]
    pub fn document(&self) -> DefinitionDocument {
        match self {
            Self::Table(table) => DefinitionDocument {
                attributes: Some(table.schema().attributes().iter().map(AttributeDocument::from).collect()),
                actions: Some(table.actions().iter().map(ActionDocument::from).collect()),
                dynamics: DynamicsDocument::Table(table.document()),
            },
            Self::Wumpus(cave) => DefinitionDocument {
                attributes: None,
                actions: Some(cave.actions().iter().map(ActionDocument::from).collect()),
                dynamics: DynamicsDocument::Wumpus(cave.document()),
            },
        }
    }

    /// The attributes that states of the model will have.
    #[must_use]
    pub fn schema(&self) -> Schema {
        match self {
            Self::Table(table) => table.schema().clone(),
            Self::Wumpus(cave) => cave.schema(),
        }
    }

    /// The actions of the body.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        match self {
            Self::Table(table) => table.actions(),
            Self::Wumpus(cave) => cave.actions(),
        }
    }
}

fn read_definition(place: &Place<'_, '_>, limits: Limits, faults: &mut Faults) -> Option<Definition> {
    let object = place.object(&["attributes", "actions", "dynamics"], faults)?;
    let dynamics = object.required("dynamics", faults)?;
    match dynamics.value.get("kind").and_then(serde_json::Value::as_str) {
        Some("table") => {
            let attributes = object.required("attributes", faults);
            let attributes = attributes.and_then(|place| Schema::read(&place, faults));
            let actions = object.required("actions", faults);
            let actions = actions.and_then(|place| read_actions(&place, table::DEFAULT_ACTION_COST, faults));
            table::read(&dynamics, attributes, actions, limits, faults).map(Definition::Table)
        }
        Some("wumpus") => {
            if let Some(place) = object.optional("attributes") {
                faults.note(&place, "the attributes of a wumpus world are implied; leave this out");
            }
            let actions = object.optional("actions").map(|place| {
                let actions = read_actions(&place, Cave::DEFAULT_ACTION_COST, faults);
                actions.map(|actions| (place, actions))
            });
            let actions = match actions {
                None => Some(None),
                Some(None) => None,
                Some(Some((place, actions))) => Cave::check_actions(&place, &actions, faults).then_some(Some(actions)),
            };
            let world = Cave::read(&dynamics, faults);
            world.zip(actions).map(|(cave, actions)| Definition::Wumpus(cave.with_actions(actions)))
        }
        _ => {
            let object = dynamics.open_object(faults)?;
            object.required("kind", faults)?.mismatch("one of \"table\", \"wumpus\"", faults)
        }
    }
}

impl DefinitionDocument {
    /// The document as JSON text. Of [`Definition::document`]: the canonical text, equal for equal content.
    ///
    /// # Panics
    ///
    /// Never: a document has no keys but strings.
    #[must_use]
    pub fn text(&self) -> String {
        serde_json::to_string(self).expect("a document has no keys but strings")
    }
}

/// SHA-256 of a model's canonical text, in hexadecimal: equal for equal content, however that was written.
#[must_use]
pub fn hash_of(canonical: &str) -> String {
    let digest = Sha256::digest(canonical.as_bytes());
    digest.iter().fold(String::with_capacity(64), |mut hash, byte| {
        for nibble in [byte >> 4, byte & 15] {
            hash.extend(char::from_digit(nibble.into(), 16));
        }
        hash
    })
}

/// A model, as it is written in JSON.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = ModelDefinition)]
pub struct DefinitionDocument {
    /// The attributes of a state, in order: 1 to 256. Required with `table` dynamics; implied by `wumpus` dynamics
    /// and then left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attributes: Option<Vec<AttributeDocument>>,
    /// The actions of this body. Required with `table` dynamics; left out with `wumpus` dynamics: all six.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actions: Option<Vec<ActionDocument>>,
    /// Which states there are, and how actions lead from one to another.
    pub dynamics: DynamicsDocument,
}

/// Which states there are, and how actions lead from one to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "kind", rename_all = "lowercase")]
#[schema(as = Dynamics)]
pub enum DynamicsDocument {
    /// States and transitions are listed.
    #[schema(title = "TableDynamics")]
    Table(TableDocument),
    /// They follow from the rules of the wumpus world.
    #[schema(title = "WumpusDynamics")]
    Wumpus(WumpusDocument),
}
