//! A laboratory in this process: no service, no database.

use std::collections::BTreeMap;

use super::{Attempt, Followed, Laboratory, LearnerId, Scene};
use etude_core::attribute::Weights;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::{Cancelled, Interrupted, Uninterrupted};
use etude_core::learning::{Distribution, Learner, LearnerDocument, MissingAttributes};
use etude_core::mapping::{Conditions, Demonstration, Mapper, Mapping, Problem, Settings};
use etude_core::model::{CompileError, Definition, Limits, Model};

/// Why a laboratory in this process failed.
#[derive(Debug, thiserror::Error)]
pub enum LocalError {
    /// A definition, model or demonstration has faults.
    #[error(transparent)]
    Faults(#[from] Faults),
    /// A model could not be compiled.
    #[error(transparent)]
    Compile(#[from] CompileError),
    /// The model lacks attributes of the learner.
    #[error(transparent)]
    MissingAttributes(#[from] MissingAttributes),
    /// There is no such learner or trial.
    #[error("there is no learner or trial {0:?}")]
    Unknown(String),
    /// Never: nothing interrupts it.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// Never: nothing interrupts it.
    #[error(transparent)]
    Interrupted(#[from] Interrupted),
}

/// Learners and models in memory.
#[derive(Debug, Default)]
pub struct Local {
    mappers: BTreeMap<&'static str, Mapper>,
    learners: Vec<Taught>,
}

#[derive(Debug)]
struct Taught {
    learner: Learner,
    distribution: Distribution,
    /// The weights of each trial, by number from 1.
    drawn: Vec<Vec<f64>>,
}

impl Local {
    /// An empty laboratory.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    fn mapper(&mut self, scene: &Scene) -> Result<&Mapper, LocalError> {
        if !self.mappers.contains_key(scene.name()) {
            let definition = Definition::read(scene.model(), Limits::DEFAULT, &mut Uninterrupted)?;
            let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted)?;
            self.mappers.insert(scene.name(), Mapper::new(model, &mut Uninterrupted)?);
        }
        self.mappers.get(scene.name()).ok_or_else(|| LocalError::Unknown(scene.name().to_owned()))
    }

    fn taught(&mut self, id: &LearnerId) -> Result<&mut Taught, LocalError> {
        let taught = id.0.parse().ok().and_then(|index: usize| self.learners.get_mut(index));
        taught.ok_or_else(|| LocalError::Unknown(id.0.clone()))
    }
}

impl Laboratory for Local {
    type Error = LocalError;

    fn start_learner(&mut self, definition: &LearnerDocument) -> Result<LearnerId, LocalError> {
        let document = serde_json::to_value(definition).unwrap_or_default();
        let learner = Learner::read(&document)?;
        let distribution = learner.initial().clone();
        self.learners.push(Taught { learner, distribution, drawn: Vec::new() });
        Ok(LearnerId((self.learners.len() - 1).to_string()))
    }

    fn draw(&mut self, learner: &LearnerId, scene: &Scene) -> Result<Attempt, LocalError> {
        let taught = self.taught(learner)?;
        let number = taught.drawn.len() + 1;
        let drawn = taught.learner.draw(&taught.distribution, number as u64);
        taught.drawn.push(drawn.clone());
        let learner = taught.learner.clone();
        let mapper = self.mapper(scene)?;
        let weights = learner.weights_for(mapper.model().schema(), &drawn)?;
        let Followed { actions, .. } = follow(mapper, scene, weights)?;
        Ok(Attempt { id: number.to_string(), actions })
    }

    fn learn(&mut self, learner: &LearnerId, attempt: &Attempt, reward: f64) -> Result<(), LocalError> {
        let Taught { learner, distribution, drawn } = self.taught(learner)?;
        let number: usize = attempt.id.parse().unwrap_or(0);
        let weights = number.checked_sub(1).and_then(|index| drawn.get(index));
        let weights = weights.ok_or_else(|| LocalError::Unknown(attempt.id.clone()))?;
        learner.learn(distribution, weights, reward);
        Ok(())
    }

    fn means(&mut self, learner: &LearnerId) -> Result<BTreeMap<String, f64>, LocalError> {
        let Taught { learner, distribution, .. } = self.taught(learner)?;
        let names = learner.attributes().iter().map(ToString::to_string);
        Ok(names.zip(distribution.mean.iter().copied()).collect())
    }

    fn map(&mut self, scene: &Scene, learner: Option<&LearnerId>) -> Result<Followed, LocalError> {
        let taught = match learner {
            Some(id) => {
                let Taught { learner, distribution, .. } = self.taught(id)?;
                Some((learner.clone(), distribution.mean.clone()))
            }
            None => None,
        };
        let mapper = self.mapper(scene)?;
        let schema = mapper.model().schema();
        let weights = match taught {
            Some((learner, means)) => learner.weights_for(schema, &means)?,
            None => schema.weights(),
        };
        follow(mapper, scene, weights)
    }
}

fn follow(mapper: &Mapper, scene: &Scene, weights: Weights) -> Result<Followed, LocalError> {
    let model = mapper.model();
    let mut faults = Faults::default();
    let demonstration = Demonstration::read(model.schema(), &Place::root(scene.demonstration()), &mut faults);
    let problem = Problem::new(model, faults.check(demonstration)?, weights, Conditions::default());
    let Mapping { moves, cost, .. } = mapper.map(&problem, Settings::default(), &mut Uninterrupted)?;
    let actions = moves.iter().filter_map(|step| step.action).map(|action| model.action(action).name.to_string());
    Ok(Followed { actions: actions.collect(), cost: cost.total })
}
