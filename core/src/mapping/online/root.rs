//! What is committed, so that a mapping can go on after a restart.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use super::OnlineMapping;
use crate::attribute::Weights;
use crate::mapping::policy::StepWriter;
use crate::mapping::{Conditions, Mapper, Move};
use crate::model::StateIdx;

/// Where a mapping in the making has come to: the last committed node, and of what was committed before it as much as the rest needs.
/// As it is stored, floats must keep their bits.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Root {
    /// The observation and the state of the last committed step, as its move numbers it; `None` if nothing is committed.
    node: Option<(u32, StateIdx)>,
    /// The cost of the way there, summed as those of all ways are.
    cost: f64,
    /// The sums of the committed steps.
    writer: StepWriter,
    /// Whether some step was forced.
    was_forced: bool,
    /// How many layers were swept for it.
    n_swept: u64,
}

/// A committed step, as far as a mapping must know it to go on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CommittedMove {
    /// The step.
    pub step: Move,
    /// What its action costs; 0 without one.
    pub action_cost: f64,
}

impl Root {
    /// The first observation that is to be given again: that of the last committed step, or 0.
    #[must_use]
    pub fn first_observation(&self) -> u32 {
        self.node.map_or(0, |(observation, _)| observation)
    }

    /// How many steps are committed.
    #[must_use]
    pub fn n_steps(&self) -> usize {
        self.writer.n_steps() as usize
    }
}

impl OnlineMapping {
    /// What is committed so far.
    #[must_use]
    pub fn root(&self) -> Root {
        Root {
            node: self.moves.last().map(|step| (step.observation, step.state)),
            cost: self.root_cost,
            writer: self.writer,
            was_forced: self.was_forced,
            // Those after it will be swept again.
            n_swept: self.n_swept - self.n_layers_kept(),
        }
    }

    /// The committed steps from the one with the number `first` on, counted from 0.
    pub fn moves_from(&self, first: usize) -> impl Iterator<Item = CommittedMove> {
        let moves = self.moves.iter().zip(&self.action_costs).skip(first);
        moves.map(|(step, action_cost)| CommittedMove { step: *step, action_cost: *action_cost })
    }

    /// Goes on from `root` with what was given to [`Self::new`] and the steps that are committed at this root: those that
    /// [`Self::moves_from`] 0 gave with it, and no later ones. The observations from [`Root::first_observation`] on, the one of the last
    /// committed step included, are then to be given again by [`Self::observe`], with their weights; they commit nothing that the root has
    /// already. Steps whose time is up after the root are to be [decided](Self::decide) again where they were, between the same
    /// observations.
    ///
    /// From there on the mapping gives what the unbroken one gave and would have given, to the bit: the same steps with the same costs, the
    /// same proven marks, and the same [mapping](Self::end). Nothing that is committed is searched again, so it takes what the observations
    /// after the root take.
    ///
    /// `None` if `root` and `moves` do not belong together, or to the mapper's model.
    ///
    /// # Panics
    ///
    /// As [`Self::new`].
    #[must_use]
    pub fn resume(
        mapper: &Mapper,
        weights: Weights,
        conditions: Conditions,
        lookahead: Option<NonZeroU32>,
        root: &Root,
        moves: impl IntoIterator<Item = CommittedMove>,
    ) -> Option<Self> {
        let model = mapper.model();
        let (moves, action_costs): (Vec<_>, Vec<_>) = moves.into_iter().map(|own| (own.step, own.action_cost)).unzip();
        let are_known = moves.iter().all(|step| {
            let has_action = step.action.is_none_or(|action| usize::from(action) < model.actions().len());
            has_action && step.state < model.states().len()
        });
        let last = moves.last().map(|step| (step.observation, step.state));
        if !are_known || moves.len() != root.n_steps() || last != root.node {
            return None;
        }
        let mut online = Self::new(mapper, weights, conditions, lookahead);
        if let Some((observation, state)) = root.node {
            online.window.n_before = observation + 1;
            online.window.root = state;
        }
        Some(Self {
            n_observed: root.first_observation(),
            n_swept: root.n_swept,
            root_cost: root.cost,
            writer: root.writer,
            moves,
            action_costs,
            was_forced: root.was_forced,
            ..online
        })
    }

    /// Whether the root's layer is still to be made.
    pub(super) fn is_resumed(&self) -> bool {
        self.window.layers.is_empty() && self.window.n_before > 0
    }

    /// How many layers there are of observations.
    fn n_layers_kept(&self) -> u64 {
        let is_before_starts = self.window.n_before == 0;
        self.window.layers.len().saturating_sub(usize::from(is_before_starts)) as u64
    }
}
