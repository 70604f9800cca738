//! How the next steps are found: the seam between a mapping and the two ways of looking ahead.

use std::num::NonZeroU32;
use std::sync::Arc;

use super::decided::{Decided, Halt, Rest, RootNode, Work};
use super::layers::Layers;
use super::windows::Windows;
use crate::attribute::{Value, Weights};
use crate::interrupt::{Cancelled, Interrupt};
use crate::mapping::{Budget, Conditions, Mapper};
use crate::model::Model;

/// The observations from the root's on, and what is known of the ways through them.
#[derive(Debug)]
pub(super) enum Ahead {
    /// Every state's cheapest way.
    Layers(Box<Layers>),
    /// Nothing but the observations: ways are searched for when one is needed.
    Windows(Box<Windows>),
}

/// Most nodes, states times layers, of windows for which the ways to all states are kept. To find all of these anew, as a decision may ask
/// for, takes about as long as to search such a window; and it tells which steps are proven, and commits those early. With more nodes it
/// depends on how soon steps are proven: figure 4 with layers takes 3.9 times as long at a lookahead of 4, 3.1 times at 8, and 0.15 times at
/// 16, where hardly anything is left to be decided; a cave of 1,008 states takes 10.7 times as long at 4.
const MAX_KEPT: u64 = 1 << 9;

/// Whether all ways are kept, and not searched for.
pub(super) fn keeps_layers(model: &Model, lookahead: Option<NonZeroU32>) -> bool {
    let Some(lookahead) = lookahead else { return true };
    let n_layers = 1 + u64::from(lookahead.get());
    !model.is_lazy() && n_layers.saturating_mul(model.graph().n_states() as u64) <= MAX_KEPT
}

impl Ahead {
    /// Nothing was observed yet.
    pub(super) fn new(mapper: &Arc<Mapper>, weights: Weights, conditions: &Conditions, keeps_layers: bool) -> Self {
        if keeps_layers {
            Self::Layers(Box::new(Layers::new(mapper, weights, conditions)))
        } else {
            Self::Windows(Box::new(Windows::new(Arc::clone(mapper), weights, conditions)))
        }
    }

    /// The same, from `root` on. The observations from its own on are still to come.
    pub(super) fn at(mut self, root: RootNode, work: Work) -> Self {
        match &mut self {
            Self::Layers(layers) => layers.go_to(&root, work),
            Self::Windows(windows) => windows.go_to(root, work),
        }
        self
    }

    /// Takes an observation.
    pub(super) fn observe(
        &mut self,
        observation: &[Option<Value>],
        observation_weight: f64,
        budget: Budget,
        interrupt: &mut dyn Interrupt,
    ) -> Result<(), Halt> {
        match self {
            Self::Layers(layers) => layers.observe(observation, observation_weight, budget, interrupt),
            Self::Windows(windows) => {
                windows.observe(observation, observation_weight);
                Ok(())
            }
        }
    }

    /// The next step, if it is known that all cheapest ways share it, however the demonstration goes on. The root moves there.
    pub(super) fn shared(&mut self) -> Option<Decided> {
        match self {
            Self::Layers(layers) => layers.shared(),
            Self::Windows(windows) => windows.sole_start(),
        }
    }

    /// The first steps of the cheapest way to the newest observation, up to and including the first that advances. The root moves there.
    /// There must be an observation after the root's.
    pub(super) fn decide(&mut self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Vec<Decided>, Halt> {
        match self {
            Self::Layers(layers) => layers.decide(budget, interrupt),
            Self::Windows(windows) => windows.decide(budget, interrupt),
        }
    }

    /// The cheapest way from the root to the end, if the demonstration ends now. `None` if nothing was observed.
    pub(super) fn rest(&self, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Option<Rest>, Cancelled> {
        match self {
            Self::Layers(layers) => Ok(layers.rest()),
            Self::Windows(windows) => windows.rest(budget, interrupt),
        }
    }

    /// How many nodes are kept that ways lead over.
    pub(super) fn n_nodes(&self) -> usize {
        match self {
            Self::Layers(layers) => layers.n_nodes(),
            Self::Windows(_) => 0,
        }
    }

    /// The cost of the way to the root; 0 if it is not needed.
    pub(super) fn root_cost(&self) -> f64 {
        match self {
            Self::Layers(layers) => layers.root_cost,
            Self::Windows(_) => 0.0,
        }
    }

    /// How much was looked at.
    pub(super) fn work(&self) -> Work {
        match self {
            Self::Layers(layers) => layers.work,
            Self::Windows(windows) => windows.work,
        }
    }

    /// How much was looked at that would not be again, if the observations from the root's on were given again.
    pub(super) fn work_before(&self) -> Work {
        match self {
            Self::Layers(layers) => layers.work_before(),
            Self::Windows(windows) => windows.work,
        }
    }

    /// Approximate size in memory, in bytes. Looks at no layer.
    pub(super) fn size_bytes(&self) -> usize {
        match self {
            Self::Layers(layers) => layers.size_bytes(),
            Self::Windows(windows) => windows.size_bytes(),
        }
    }
}
