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
    /// What either did on the way.
    pub marks: Vec<Mark>,
}

/// Something that was done on the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark {
    /// Where.
    pub cell: Cell,
    /// What.
    pub deed: Deed,
    /// By whom: the imitator, or the demonstrator.
    pub by_imitator: bool,
}

/// What may be done on the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deed {
    /// A piece of gold was grabbed.
    Grab,
    /// A wumpus was shot.
    Shot {
        /// Where it was.
        hit: Cell,
    },
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
    let imitated = |n: usize| scene.execute(&actions[..n]).state;
    let grabs = (0..actions.len()).filter(|n| imitated(*n).lying != imitated(n + 1).lying);
    let grabs = grabs.map(|n| Mark { cell: imitated(n).cell, deed: Deed::Grab, by_imitator: true });
    let shots = scene.shot().map(|(cell, hit)| Mark { cell, deed: Deed::Shot { hit }, by_imitator: false });
    let grabbed = scene.grabbed_at().map(|cell| Mark { cell, deed: Deed::Grab, by_imitator: false });
    let marks = shots.into_iter().chain(grabbed).chain(grabs).collect();
    Ok(Paths { demonstrator: scene.observed_cells(), imitator, actions, cost, reward, marks })
}
