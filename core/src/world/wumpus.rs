//! The simulator of the wumpus world.

use crate::model::{Act, Cave, CaveState};

/// What the world pays for each event. A reward is the sum over an execution.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rewards {
    /// For an action other than `shoot`, whether it has an effect or not.
    pub action: f64,
    /// For `shoot`, instead of that.
    pub shot: f64,
    /// For death, in addition to the action that led to it.
    pub death: f64,
    /// For each piece of gold that is carried out, in addition to the `climb` that does it.
    pub gold: f64,
}

impl Rewards {
    /// Those of the paper's experiments.
    pub const PAPER: Self = Self { action: -1.0, shot: -10.0, death: -1000.0, gold: 1000.0 };
}

impl Default for Rewards {
    fn default() -> Self {
        Self::PAPER
    }
}

/// What became of an agent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Execution {
    /// What it earned.
    pub reward: f64,
    /// How many actions it executed.
    pub n_executed: usize,
    /// How many pieces of gold it carried out.
    pub n_gold: u32,
    /// Whether it died.
    pub is_dead: bool,
    /// The state at the end.
    pub state: CaveState,
}

/// A wumpus world that gives rewards.
#[derive(Clone, Debug)]
pub struct WumpusWorld {
    cave: Cave,
    rewards: Rewards,
}

impl WumpusWorld {
    /// The world of `cave`, with its pits, wumpi and gold. The body of `cave` is ignored: every action can be executed.
    #[must_use]
    pub fn new(cave: Cave, rewards: Rewards) -> Self {
        Self { cave, rewards }
    }

    /// The cave.
    #[must_use]
    pub fn cave(&self) -> &Cave {
        &self.cave
    }

    /// Executes `acts` from the start, until the agent is dead or outside.
    #[must_use]
    pub fn execute(&self, acts: impl IntoIterator<Item = Act>) -> Execution {
        let Self { cave, rewards } = self;
        let mut execution =
            Execution { reward: 0.0, n_executed: 0, n_gold: 0, is_dead: false, state: cave.first_state() };
        for act in acts {
            execution.state = cave.after(execution.state, act);
            execution.n_executed += 1;
            execution.reward += if act == Act::Shoot { rewards.shot } else { rewards.action };
            if cave.is_deadly(&execution.state) {
                execution.is_dead = true;
                execution.reward += rewards.death;
                break;
            }
            if execution.state.outside {
                execution.n_gold = cave.first_state().lying.count_ones() - execution.state.lying.count_ones();
                execution.reward += rewards.gold * f64::from(execution.n_gold);
                break;
            }
        }
        execution
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::model::{Definition, Limits};

    fn world(wumpi: &[[u16; 2]], gold: &[[u16; 2]]) -> WumpusWorld {
        let model = json!({"dynamics": {"kind": "wumpus", "width": 4, "height": 2, "wumpi": wumpi, "gold": gold}});
        let definition = Definition::read(&model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        WumpusWorld::new(definition.dynamics::<Cave>().unwrap().clone(), Rewards::PAPER)
    }

    fn acts(letters: &str) -> impl Iterator<Item = Act> + '_ {
        letters.chars().map(|letter| match letter {
            'F' => Act::Forward,
            'L' => Act::TurnLeft,
            'R' => Act::TurnRight,
            'S' => Act::Shoot,
            'G' => Act::Grab,
            _ => Act::Climb,
        })
    }

    #[test]
    fn gold_pays_once_it_is_carried_out() {
        let world = world(&[], &[[1, 0], [1, 0]]);
        let execution = world.execute(acts("FGGGLLFC"));
        assert_eq!((execution.reward, execution.n_gold, execution.is_dead), (1992.0, 2, false));
        assert_eq!(world.execute(acts("FGLLF")).reward, -5.0, "not while it is still inside");
        assert_eq!(world.execute(acts("FGC")).reward, -3.0, "not from elsewhere than the start");
        let execution = world.execute(acts("CFG"));
        assert_eq!((execution.reward, execution.n_executed), (-1.0, 1), "outside, it is over");
    }

    #[test]
    fn a_live_wumpus_kills_and_a_dead_one_does_not() {
        let world = world(&[[2, 0]], &[]);
        let execution = world.execute(acts("FFLF"));
        assert_eq!((execution.reward, execution.n_executed, execution.is_dead), (-1002.0, 2, true));
        let execution = world.execute(acts("SFFLF"));
        assert_eq!((execution.reward, execution.is_dead, execution.state.cell), (-14.0, false, (2, 1)));
    }

    #[test]
    fn an_action_without_effect_costs_its_step() {
        let world = world(&[], &[]);
        assert_eq!(world.execute(acts("GRFSS")).reward, -23.0, "no gold, a wall, an arrow, and no arrow");
    }
}
