//! The memory that layers take, and the lookahead that it limits.

use std::num::NonZeroU32;

use super::layer::Nodes;
use super::sweep::STATE_BYTES;
use super::ways_in::most_bytes as ways_in_bytes;
use super::{Layer, Layers};
use crate::mapping::online::committed::Shortage;
use crate::mapping::online::decided::Halt;
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::{Budget, StoppedBy};
use crate::model::{Model, StateIdx};

/// The longest lookahead whose window takes about `max_bytes` with `model` if all of its nodes are alive, as when nothing tells the ways
/// apart: that has one layer more, and 8 bytes a node. With 1 GB it has at most 134 million nodes. 0 if not even the shortest one fits.
pub(crate) fn longest_lookahead(model: &Model, max_bytes: usize) -> u32 {
    let n_layers = max_bytes / Nodes::MOST_BYTES_EACH / (model.states().len() as usize).max(1);
    u32::try_from(n_layers.saturating_sub(1)).unwrap_or(u32::MAX)
}

impl Layers {
    /// Approximate size in memory, in bytes. Looks at no layer.
    pub(in crate::mapping::online) fn size_bytes(&self) -> usize {
        size_of::<Self>() + self.tree.size_bytes() + self.sweep.size_bytes()
    }

    /// Checks that there is memory for so many bytes more.
    pub(super) fn check_memory(&self, n_bytes: usize, budget: Budget) -> Result<(), Halt> {
        if budget.max_bytes == usize::MAX || self.size_bytes().saturating_add(n_bytes) <= budget.max_bytes {
            Ok(())
        } else {
            Err(Halt::OutOf(StoppedBy::Memory))
        }
    }

    /// How much memory the next layer takes, in bytes; before the first, with all that is made once.
    pub(super) fn next_layer_bytes(&self) -> usize {
        let observed = self.n_terms * size_of::<f64>() + self.weights.as_slice().len() * OBSERVED_BYTES;
        let n_states = self.model().graph().n_states();
        let once = if self.sweep.is_ready() { 0 } else { ways_in_bytes(self.model()) + n_states * STATE_BYTES };
        self.tree.layer_bytes(n_states, &self.sweep.ways_in) + observed + once
    }

    /// What does not fit, if the mapping takes so many bytes and may take so many.
    pub(in crate::mapping::online) fn shortage(&self, taken_bytes: usize, max_bytes: usize) -> Shortage {
        Shortage {
            n_states: self.model().states().len(),
            n_observations: self.tree.n_layers_of_observations(),
            taken_bytes,
            layer_bytes: self.next_layer_bytes(),
            max_bytes,
        }
    }
}

/// About how much memory layers take at most, in bytes, also while one is made: if all ways to all states are alike, as when nothing tells
/// them apart.
pub(in crate::mapping::online) fn most_bytes(
    model: &Model,
    lookahead: Option<NonZeroU32>,
    n_observations: usize,
) -> usize {
    /// How many entries of the open list there are for each state, about.
    const OPEN: usize = 4;
    let n_states = model.graph().n_states();
    let n_terms = n_terms(model, |_| true);
    let reach = lookahead.map_or(usize::MAX, |lookahead| lookahead.get() as usize);
    let n_layers = n_observations.min(reach.saturating_add(1));
    let each = n_states * Nodes::MOST_BYTES_EACH + size_of::<Layer>() + model.schema().len() * OBSERVED_BYTES;
    let once = n_states
        * (STATE_BYTES + 2 * size_of::<StateIdx>() + OPEN * size_of::<CheapestFirst>() + 3 * Nodes::MOST_BYTES_EACH)
        + n_terms * size_of::<f64>()
        + ways_in_bytes(model);
    n_layers.saturating_mul(each).saturating_add(once)
}

/// How many terms of distances an observation has, for each value of the attributes at these positions.
pub(super) fn n_terms(model: &Model, weighs: impl Fn(usize) -> bool) -> usize {
    let weighing = (0..model.schema().len()).filter(|position| weighs(*position));
    weighing.map(|position| model.states().domain(position).len()).sum()
}

/// What an observed attribute takes, besides its terms.
const OBSERVED_BYTES: usize = 64;
