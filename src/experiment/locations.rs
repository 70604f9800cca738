//! Figure 8: weights that were learned in one world, used in four others.

use std::collections::BTreeMap;

use super::{CurvePlan, Laboratory, Scene, curve};

/// The rewards at one location of the gold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocationRow {
    /// `L1` to `L4`.
    pub location: &'static str,
    /// With the model's default weights.
    pub uniform: f64,
    /// With learned weights.
    pub learned: f64,
}

/// The rewards at all locations.
#[derive(Clone, Debug, PartialEq)]
pub struct Locations {
    /// By location.
    pub rows: Vec<LocationRow>,
    /// The learned mean weights, by attribute.
    pub means: BTreeMap<String, f64>,
}

const NAMES: [&str; 4] = ["L1", "L2", "L3", "L4"];

/// Learns once in the world of figure 6, as the first run of figure 7 does, and then follows the demonstration of figure 8
/// wherever the gold lies. `on_trial` is called after each trial.
///
/// # Errors
///
/// If the laboratory failed.
pub fn figure_8<L: Laboratory>(
    laboratory: &mut L,
    plan: &CurvePlan,
    on_trial: impl FnMut(),
) -> Result<Locations, L::Error> {
    let learner = laboratory.start_learner(&plan.learner)?;
    curve::run(laboratory, &learner, &Scene::figure_6(), plan.n_trials, on_trial)?;
    let mut rows = Vec::with_capacity(NAMES.len());
    for (location, scene) in NAMES.into_iter().zip(Scene::figure_8()) {
        let mut earned = |learner| Ok(scene.execute(&laboratory.map(&scene, learner)?.actions).reward);
        rows.push(LocationRow { location, uniform: earned(None)?, learned: earned(Some(&learner))? });
    }
    Ok(Locations { rows, means: laboratory.means(&learner)? })
}
