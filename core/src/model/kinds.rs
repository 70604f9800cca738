//! Which kinds of dynamics there are. A new kind is an entry in each of the two lists here, and a folder.

use serde::{Deserialize, Serialize};

use super::dynamics::Read;
use super::experience::{self, ExperienceDocument};
use super::planning::{self, PlanningDocument};
#[cfg(feature = "rules")]
use super::rules::{self, RulesDocument};
use super::table::{self, TableDocument};
use super::wumpus::{self, WumpusDocument};

/// Each kind's name in JSON, and what reads it.
const KINDS: &[(&str, Read)] = &[
    ("table", table::read),
    ("planning", planning::read),
    ("wumpus", wumpus::read),
    ("experience", experience::read),
    #[cfg(feature = "rules")]
    ("rules", rules::read),
];

/// What reads the dynamics of the kind called `name`.
pub(super) fn reader(name: &str) -> Option<Read> {
    KINDS.iter().find(|(known, _)| *known == name).map(|(_, read)| *read)
}

/// The names of all kinds, as they are listed in a fault.
pub(super) fn names() -> String {
    let names: Vec<String> = KINDS.iter().map(|(name, _)| format!("{name:?}")).collect();
    names.join(", ")
}

/// Which states there are, and how actions lead from one to another.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "lowercase")]
#[cfg_attr(feature = "openapi", schema(as = Dynamics))]
pub enum DynamicsDocument {
    /// States and transitions are listed.
    #[cfg_attr(feature = "openapi", schema(title = "TableDynamics"))]
    Table(TableDocument),
    /// Actions need some values and change some.
    #[cfg_attr(feature = "openapi", schema(title = "PlanningDynamics"))]
    Planning(PlanningDocument),
    /// They follow from the rules of the wumpus world.
    #[cfg_attr(feature = "openapi", schema(title = "WumpusDynamics"))]
    Wumpus(WumpusDocument),
    /// They follow from rules that the model tells.
    #[cfg(feature = "rules")]
    #[cfg_attr(feature = "openapi", schema(title = "RulesDynamics"))]
    Rules(RulesDocument),
    /// They are what was experienced.
    #[cfg_attr(feature = "openapi", schema(title = "ExperienceDynamics"))]
    Experience(ExperienceDocument),
}
