//! The attributes of the states of a cave.

use std::ops::Range;

use super::{Cave, Heading};
use crate::attribute::{Attribute, Cycle, Kind, Labels, Schema};

/// Where the attributes of a state stand; wumpi and pieces of gold come after these.
pub(super) mod position {
    pub(in crate::model::wumpus) const X: usize = 0;
    pub(in crate::model::wumpus) const Y: usize = 1;
    pub(in crate::model::wumpus) const HEADING: usize = 2;
    pub(in crate::model::wumpus) const GOLD: usize = 3;
    pub(in crate::model::wumpus) const ARROWS: usize = 4;
    pub(in crate::model::wumpus) const OUTSIDE: usize = 5;
}

/// The attributes of a state of a cave with so many wumpi and pieces of gold.
pub(super) fn schema(n_wumpi: usize, n_gold: usize) -> Schema {
    let number = Kind::Number { scale: 1.0 };
    let labels = Labels::of(Heading::ALL.map(Heading::name));
    let heading = Kind::Cyclic { scale: 1.0, cycle: Cycle::Labels(labels) };
    let attribute = |name: &str, kind: &Kind, weight: f64| Attribute {
        name: name.to_owned(),
        kind: kind.clone(),
        weight,
        is_hidden: false,
    };
    let mut attributes = vec![
        attribute("x", &number, 1.0),
        attribute("y", &number, 1.0),
        attribute("heading", &heading, 1.0),
        attribute("gold", &number, 1.0),
        attribute("arrows", &number, 1.0),
        attribute("outside", &Kind::Category, 5.0),
    ];
    attributes.extend((1..=n_wumpi).map(|k| attribute(&format!("wumpus_{k}"), &Kind::Category, 0.0)));
    attributes.extend((1..=n_gold).map(|k| attribute(&format!("gold_{k}"), &Kind::Category, 0.0)));
    Schema::of(attributes)
}

impl Cave {
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
}
