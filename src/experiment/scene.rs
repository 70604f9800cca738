//! The worlds of the paper's figures.

use serde_json::Value;

use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Act, Cave, Cell, Definition, Limits};
use etude_core::world::{Execution, Rewards, WumpusWorld};

/// A world, the imitator's model of it, and a demonstration.
#[derive(Clone, Debug)]
pub struct Scene {
    name: &'static str,
    model: Value,
    demonstration: Value,
    world: WumpusWorld,
}

const FIGURE_4: &str = include_str!("../../examples/figure-4/model.json");
const FIGURE_4_SEEN: &str = include_str!("../../examples/figure-4/demonstration.json");
const FIGURE_6: &str = include_str!("../../examples/figure-6/model.json");
const FIGURE_6_SEEN: &str = include_str!("../../examples/figure-6/demonstration.json");
const FIGURE_8: [(&str, &str); 4] = [
    ("figure-8-l1", include_str!("../../examples/figure-8/model-l1.json")),
    ("figure-8-l2", include_str!("../../examples/figure-8/model-l2.json")),
    ("figure-8-l3", include_str!("../../examples/figure-8/model-l3.json")),
    ("figure-8-l4", include_str!("../../examples/figure-8/model-l4.json")),
];
const FIGURE_8_SEEN: &str = include_str!("../../examples/figure-8/demonstration.json");

impl Scene {
    /// The world of figure 4: the imitator cannot shoot the wumpus that the demonstrator shot.
    #[must_use]
    pub fn figure_4() -> Self {
        Self::new("figure-4", FIGURE_4, FIGURE_4_SEEN)
    }

    /// The world of figures 6 and 7: the gold that the demonstrator fetched is gone; there is another piece.
    #[must_use]
    pub fn figure_6() -> Self {
        Self::new("figure-6", FIGURE_6, FIGURE_6_SEEN)
    }

    /// The worlds of figure 8: the gold lies at one of four other locations, L1 to L4.
    #[must_use]
    pub fn figure_8() -> [Self; 4] {
        FIGURE_8.map(|(name, model)| Self::new(name, model, FIGURE_8_SEEN))
    }

    fn new(name: &'static str, model: &str, demonstration: &str) -> Self {
        let parse = |text| serde_json::from_str::<Value>(text).expect("examples are JSON");
        let model = parse(model);
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted);
        let cave = definition.ok().and_then(|definition| definition.dynamics::<Cave>().cloned());
        let cave = cave.expect("the examples of figures are caves");
        Self { name, model, demonstration: parse(demonstration), world: WumpusWorld::new(cave, Rewards::PAPER) }
    }

    /// The name of its model.
    #[must_use]
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The imitator's model: JSON.
    #[must_use]
    pub fn model(&self) -> &Value {
        &self.model
    }

    /// The demonstration: JSON.
    #[must_use]
    pub fn demonstration(&self) -> &Value {
        &self.demonstration
    }

    /// The cave of its world.
    #[must_use]
    pub fn cave(&self) -> &Cave {
        self.world.cave()
    }

    /// Where the demonstrator was seen, observation by observation.
    #[must_use]
    pub fn observed_cells(&self) -> Vec<Cell> {
        let seen = self.demonstration.as_array().map(Vec::as_slice).unwrap_or_default();
        seen.iter().filter_map(cell_of).collect()
    }

    /// The first observation after which something changed: of it and the next one, `is_change` holds.
    fn first_change(&self, is_change: impl Fn(&Value, &Value) -> bool) -> Option<&Value> {
        let seen = self.demonstration.as_array()?;
        seen.windows(2).find(|pair| is_change(&pair[0], &pair[1])).map(|pair| &pair[0])
    }

    /// Where the demonstrator was seen to grab gold for the first time.
    #[must_use]
    pub fn grabbed_at(&self) -> Option<Cell> {
        let gold = |seen: &Value| seen["gold"].as_u64();
        cell_of(self.first_change(|before, after| gold(before) < gold(after))?)
    }

    /// Where the demonstrator was seen to shoot a wumpus for the first time, and where that was.
    #[must_use]
    pub fn shot(&self) -> Option<(Cell, Cell)> {
        let is_alive = |seen: &Value, n: usize| seen[format!("wumpus_{}", n + 1)].as_bool();
        let wumpi = self.cave().wumpi();
        let (hit, seen) = wumpi.iter().enumerate().find_map(|(n, cell)| {
            let seen = self.first_change(|before, after| is_alive(before, n) > is_alive(after, n))?;
            Some((*cell, seen))
        })?;
        Some((cell_of(seen)?, hit))
    }

    /// Executes actions of these names in the world. Names that are no action of a cave are ignored.
    #[must_use]
    pub fn execute(&self, actions: &[String]) -> Execution {
        self.world.execute(actions.iter().filter_map(|name| Act::named(name)))
    }
}

/// The cell of an observation.
fn cell_of(seen: &Value) -> Option<Cell> {
    let coordinate = |name: &str| u16::try_from(seen[name].as_u64()?).ok();
    coordinate("x").zip(coordinate("y"))
}
