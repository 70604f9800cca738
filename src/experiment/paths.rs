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
    /// The imitator's actions.
    pub actions: Vec<String>,
    /// Total cost of the mapping.
    pub cost: f64,
    /// Reward of the imitator.
    pub reward: f64,
    /// Shots and grabs of both.
    pub marks: Vec<Mark>,
}

/// A shot or a grab.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark {
    /// The cell in which it was done.
    pub cell: Cell,
    /// Which of the two it was.
    pub deed: Deed,
    /// Whether the imitator did it; else the demonstrator did.
    pub by_imitator: bool,
}

/// What is marked on a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deed {
    /// A piece of gold was grabbed.
    Grab,
    /// A wumpus was shot.
    Shot {
        /// The cell of the wumpus.
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
