//! Figure 4: the way of a demonstrator, and that of an imitator that cannot shoot.

use super::{Followed, Laboratory, Scene};
use etude_core::model::Cell;

/// Two ways through the same cave.
#[derive(Clone, Debug, PartialEq)]
pub struct Paths {
    /// Where the demonstrator was seen, observation by observation.
    pub demonstrator: Vec<Cell>,
    /// Where the imitator goes, from its start on.
    pub imitator: Vec<Cell>,
    /// What it does.
    pub actions: Vec<String>,
    /// What its mapping costs.
    pub cost: f64,
    /// What it earns.
    pub reward: f64,
}

/// Maps the demonstration of figure 4 with default weights.
///
/// # Errors
///
/// If the laboratory failed.
pub fn figure_4<L: Laboratory>(laboratory: &mut L) -> Result<Paths, L::Error> {
    let scene = Scene::figure_4();
    let Followed { actions, cost } = laboratory.map(&scene, None)?;
    let imitator = (0..=actions.len()).map(|n| scene.execute(&actions[..n]).state.cell).collect();
    let reward = scene.execute(&actions).reward;
    Ok(Paths { demonstrator: scene.observed_cells(), imitator, actions, cost, reward })
}
