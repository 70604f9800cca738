//! What is committed, so that a mapping can go on after a restart.

use std::num::NonZeroU32;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::OnlineMapping;
use super::committed::{Committed, CommittedMove};
use super::decided::{RootNode, Work};
use crate::attribute::{ByAttribute, Scalar, Weights};
use crate::mapping::policy::StepWriter;
use crate::mapping::{Conditions, Mapper};
use crate::model::{Model, OriginRow, StateIdx, States};

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
    /// How much was looked at for it.
    work: Work,
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

/// The states that committed steps pass, as they were told.
#[derive(Debug)]
pub struct PassedStates<'m> {
    model: &'m Model,
    /// If the model is searched lazily, in the order in which they are first passed.
    found: States,
}

impl<'m> PassedStates<'m> {
    /// Before the first step of a mapping in `model`.
    #[must_use]
    pub fn new(model: &'m Model) -> Self {
        Self { model, found: model.states().keep(&[]) }
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> &'m Model {
        self.model
    }

    /// Passes the state of the next step. The steps must be passed in their order, from the first on.
    pub fn pass(&mut self, step: &CommittedMove) {
        if let Some(OriginRow(row)) = &step.row {
            self.found.push(row.iter().copied());
        }
    }

    /// The values of the state of a step that was passed.
    ///
    /// # Panics
    ///
    /// If it was not, or is of another model.
    #[must_use]
    pub fn values(&self, step: &CommittedMove) -> ByAttribute<Scalar> {
        let states = if self.model.is_lazy() { &self.found } else { self.model.states() };
        self.model.describe_one_of(states, step.step.state)
    }
}

impl OnlineMapping {
    /// What is committed so far.
    #[must_use]
    pub fn root(&self) -> Root {
        Root {
            node: self.committed.moves.last().map(|step| (step.observation, step.state)),
            cost: self.ahead.root_cost(),
            writer: self.committed.writer,
            was_forced: self.was_forced,
            work: self.ahead.work_before(),
        }
    }

    /// The committed steps from the one with the number `first` on, counted from 0.
    pub fn moves_from(&self, first: usize) -> impl Iterator<Item = CommittedMove> {
        (first..self.n_steps()).map(|number| self.committed.move_at(number))
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
        mapper: &Arc<Mapper>,
        weights: Weights,
        conditions: Conditions,
        lookahead: Option<NonZeroU32>,
        root: &Root,
        moves: impl IntoIterator<Item = CommittedMove>,
    ) -> Option<Self> {
        Self::new(mapper, weights, conditions, lookahead).resumed(root, moves)
    }

    /// [`Self::resume`] for a mapping that was made as the one that is gone on with, and has observed nothing.
    #[must_use]
    pub fn resumed(self, root: &Root, moves: impl IntoIterator<Item = CommittedMove>) -> Option<Self> {
        let committed = Committed::of(&self.model, moves)?;
        let last = committed.moves.last().map(|step| (step.observation, step.state));
        if committed.moves.len() != root.n_steps() || last != root.node {
            return None;
        }
        let node = last.map(|(observation, state)| RootNode {
            observation,
            state,
            row: committed.last_row(),
            cost: root.cost,
        });
        Some(Self {
            n_observed: root.first_observation(),
            committed: Committed { writer: root.writer, ..committed },
            was_forced: root.was_forced,
            ahead: match node {
                Some(node) => self.ahead.at(node, root.work),
                None => self.ahead,
            },
            ..self
        })
    }
}
