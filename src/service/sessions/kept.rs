//! What is kept of a session besides its observations: the steps that it has committed, and what it goes on from after them.
//!
//! Steps follow from observations, so they are written when it costs little: with observations that come later, once there are enough of
//! them. What was decided by time follows from nothing, and is written before anybody is told. Whoever takes up the session searches
//! only what is after the last step that was written.

use serde::{Deserialize, Serialize};

use super::SessionError;
use crate::service::ServiceError;
use crate::store::{NewSteps, StoredSteps};
use etude_core::mapping::{CommittedMove, CommittedStep, OnlineMapping, PassedStates, Root, Step, Watch};
use etude_core::model::Model;

/// So many steps are written together where they cost less to be found again than to be written.
const MANY: usize = 256;

/// And so many where they are searched in the pool.
const FEW: usize = 8;

/// A committed step, as it was told, in short. Floats keep their bits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShortStep {
    step: CommittedMove,
    told: Told,
}

/// What was told of a committed step, besides what its move says.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Told {
    distance: f64,
    cost: f64,
    is_proven: bool,
    after: u32,
}

impl From<&CommittedStep> for Told {
    fn from(CommittedStep { step, is_proven, after }: &CommittedStep) -> Self {
        Self { distance: step.distance, cost: step.cost, is_proven: *is_proven, after: *after }
    }
}

impl ShortStep {
    /// Passes the step's state.
    pub fn pass(&self, passed: &mut PassedStates<'_>) {
        passed.pass(&self.step);
    }

    /// This step, which is number `number` and was [passed](Self::pass), as it was told. Of its distance, the terms by attribute are not kept.
    #[must_use]
    pub fn written(&self, number: u32, passed: &PassedStates<'_>) -> CommittedStep {
        let state = passed.values(&self.step);
        let Self { step: CommittedMove { step, action_cost, .. }, told } = self;
        let Told { distance, cost, is_proven, after } = *told;
        let step = Step {
            step: number,
            observation: step.observation,
            kind: step.kind,
            action: step.action.map(|action| passed.model().action_name(action)),
            state,
            state_index: step.state,
            action_cost: *action_cost,
            distance,
            distance_by_attribute: [].into_iter().collect(),
            cost,
        };
        CommittedStep { step, is_proven, after }
    }
}

/// Steps that are not written yet.
#[derive(Debug, Default)]
pub(super) struct Unwritten {
    /// How many were written before them.
    n_written: usize,
    steps: Vec<Told>,
}

/// What a session goes on from.
#[derive(Serialize, Deserialize)]
struct KeptRoot {
    root: Root,
    watch: Watch,
    /// How many observations it has watched.
    n_watched: u32,
}

/// A session as it was written.
pub(super) struct Kept {
    pub(super) steps: Vec<ShortStep>,
    pub(super) root: Root,
    pub(super) watch: Watch,
    pub(super) n_watched: u32,
}

impl Unwritten {
    /// None, after so many that were written.
    pub(super) fn after(n_written: usize) -> Self {
        Self { n_written, steps: Vec::new() }
    }

    /// Adds steps that were committed.
    pub(super) fn extend(&mut self, steps: &[CommittedStep]) {
        self.steps.extend(steps.iter().map(Told::from));
    }

    /// Whether they are to be written with the next observations, in a session that is mapped where observations arrive, or is not.
    pub(super) fn are_enough(&self, is_inline: bool) -> bool {
        self.steps.len() >= if is_inline { MANY } else { FEW }
    }

    /// Takes them to be written, together with what the mapping goes on from now, after `n_observations`.
    pub(super) fn take(
        &mut self,
        online: &OnlineMapping,
        watch: &Watch,
        n_observations: u32,
    ) -> Result<NewSteps, SessionError> {
        let first = self.n_written;
        let told = self.steps.drain(..);
        let steps: Vec<_> = online.moves_from(first).zip(told).map(|(step, told)| ShortStep { step, told }).collect();
        self.n_written += steps.len();
        let root = KeptRoot { root: online.root(), watch: watch.clone(), n_watched: n_observations };
        let unwritable = |error| SessionError::from(ServiceError::unreadable("steps", "steps", "new", error));
        Ok(NewSteps {
            first: u32::try_from(first).unwrap_or(u32::MAX),
            steps: postcard::to_allocvec(&steps).map_err(unwritable)?,
            root: postcard::to_allocvec(&root).map_err(unwritable)?,
        })
    }
}

impl Kept {
    /// Most bytes that steps take that are stored in `n_stored`.
    pub(super) fn most_bytes(n_stored: u64) -> usize {
        /// One takes at least as many: its three numbers.
        const LEAST_BYTES: u64 = 3 * size_of::<f64>() as u64;
        usize::try_from(n_stored / LEAST_BYTES).unwrap_or(usize::MAX).saturating_mul(size_of::<ShortStep>())
    }

    /// How many bytes its steps take.
    pub(super) fn n_bytes(&self) -> usize {
        self.steps.capacity() * size_of::<ShortStep>()
    }

    /// Reads what was written of the session `id`.
    pub(super) fn read(stored: &StoredSteps, id: &str) -> Result<Self, SessionError> {
        let unreadable = |column| move |error| SessionError::from(ServiceError::unreadable("steps", column, id, error));
        let KeptRoot { root, watch, n_watched } = postcard::from_bytes(&stored.root).map_err(unreadable("root"))?;
        let mut steps = Vec::with_capacity(root.n_steps());
        for row in &stored.steps {
            let read: Vec<ShortStep> = postcard::from_bytes(row).map_err(unreadable("steps"))?;
            steps.extend(read);
        }
        Ok(Self { steps, root, watch, n_watched })
    }

    /// How many observations they have met.
    pub(super) fn n_met(&self) -> u32 {
        self.steps.last().map_or(0, |last| last.step.step.observation + 1)
    }

    /// Whether they are of `model`, as far as that is told: whether it lists its states.
    pub(super) fn fit(&self, model: &Model) -> bool {
        self.steps.first().is_none_or(|first| first.step.row.is_some() == model.is_lazy())
    }

    /// The steps, as the mapping goes on from them.
    pub(super) fn moves(&self) -> impl Iterator<Item = CommittedMove> {
        self.steps.iter().map(|step| step.step.clone())
    }
}
