//! Figure 7: how rewards grow while weights are learned.

use std::collections::BTreeMap;

use super::{Laboratory, LearnerId, Scene};
use etude_core::learning::{AlgorithmDocument, LearnerDocument, PerAttributeDocument};

/// Settings of the experiment.
#[derive(Clone, Debug, PartialEq)]
pub struct CurvePlan {
    /// The learner of the first run. Each further run has the next seed; after the largest, seeds go on from 0.
    pub learner: LearnerDocument,
    /// How many runs there are.
    pub n_runs: usize,
    /// How many trials a run has.
    pub n_trials: usize,
}

impl CurvePlan {
    /// The hyperparameters that are documented in the README.
    #[must_use]
    pub fn documented() -> Self {
        let attributes = ["x", "y", "heading", "gold", "arrows"].map(Into::into).to_vec();
        Self {
            learner: LearnerDocument {
                attributes,
                algorithm: Some(AlgorithmDocument::Srv {
                    alpha: Some(0.5),
                    beta: Some(0.1),
                    gamma: Some(0.97),
                    sd_min: Some(0.0),
                }),
                mean: Some(PerAttributeDocument::All(1.0)),
                sd: Some(PerAttributeDocument::All(3.0)),
                expected_reward: None,
                reward_scale: Some(1000.0),
                seed: Some(1),
                lease_s: None,
            },
            n_runs: 5,
            n_trials: 200,
        }
    }
}

/// One run: a learner from its first trial to its last.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// The seed of its learner.
    pub seed: u64,
    /// Reward of each trial.
    pub rewards: Vec<f64>,
    /// Mean weights after the last trial, by attribute.
    pub means: BTreeMap<String, f64>,
}

/// The rewards of several runs.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// The runs, all of the same length.
    pub runs: Vec<Run>,
}

/// A point of the curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// The trial, counted from 1.
    pub trial: usize,
    /// The mean over all runs of the running averages that end with this trial.
    pub mean: f64,
    /// The standard deviation of these running averages between the runs; 0 for a single run.
    pub sd: f64,
}

impl Run {
    /// The average of the rewards of `trial`, counted from 1, and of the trials before it: [`Curve::WINDOW`] of them, or as
    /// many as there are.
    #[must_use]
    pub fn running_average(&self, trial: usize) -> f64 {
        let window = &self.rewards[trial.saturating_sub(Curve::WINDOW)..trial];
        mean(window.iter().copied())
    }
}

impl Curve {
    /// How many trials are averaged.
    pub const WINDOW: usize = 10;

    /// The curve, trial by trial.
    pub fn points(&self) -> impl Iterator<Item = Point> {
        let n_trials = self.runs.iter().map(|run| run.rewards.len()).min().unwrap_or(0);
        (1..=n_trials).map(|trial| {
            let averages = || self.runs.iter().map(move |run| run.running_average(trial));
            let mean_of_runs = mean(averages());
            let squares: f64 = averages().map(|average| (average - mean_of_runs).powi(2)).sum();
            #[expect(clippy::cast_precision_loss, reason = "there are few runs")]
            let n_others = self.runs.len().saturating_sub(1).max(1) as f64;
            Point { trial, mean: mean_of_runs, sd: (squares / n_others).sqrt() }
        })
    }
}

fn mean(numbers: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = numbers.fold((0.0, 0.0), |(sum, count), number| (sum + number, count + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}

/// Trials in the world of figure 6, learning after each. `on_trial` is called after each.
///
/// # Errors
///
/// If the laboratory failed.
pub fn figure_7<L: Laboratory>(
    laboratory: &mut L,
    plan: &CurvePlan,
    mut on_trial: impl FnMut(),
) -> Result<Curve, L::Error> {
    let scene = Scene::figure_6();
    let first_seed = plan.learner.seed.unwrap_or(0);
    let mut runs = Vec::with_capacity(plan.n_runs);
    for seed in std::iter::successors(Some(first_seed), |seed| Some(seed.wrapping_add(1))).take(plan.n_runs) {
        let definition = LearnerDocument { seed: Some(seed), ..plan.learner.clone() };
        let learner = laboratory.start_learner(&definition)?;
        let rewards = run(laboratory, &learner, &scene, plan.n_trials, &mut on_trial)?;
        runs.push(Run { seed, rewards, means: laboratory.means(&learner)? });
    }
    Ok(Curve { runs })
}

/// The rewards of `n_trials` trials of a learner in the world of `scene`, learning after each.
pub(super) fn run<L: Laboratory>(
    laboratory: &mut L,
    learner: &LearnerId,
    scene: &Scene,
    n_trials: usize,
    mut on_trial: impl FnMut(),
) -> Result<Vec<f64>, L::Error> {
    let mut rewards = Vec::with_capacity(n_trials);
    for _ in 0..n_trials {
        let attempt = laboratory.draw(learner, scene)?;
        let reward = scene.execute(&attempt.actions).reward;
        laboratory.learn(learner, &attempt, reward)?;
        rewards.push(reward);
        on_trial();
    }
    Ok(rewards)
}
