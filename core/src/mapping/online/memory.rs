//! The memory of a mapping while its demonstration is still running, and the lookahead that it limits.

use std::num::NonZeroU32;

use super::layer::{self, Layer, Node};
use super::{OnlineMapping, Stopped};
use crate::mapping::Move;
use crate::mapping::open_list::CheapestFirst;
use crate::model::{Model, StateIdx};

/// The longest lookahead whose window takes about `max_bytes` with `model` if all of its nodes are alive, as when nothing tells the ways
/// apart: that has one layer more, and 8 bytes a node. With 1 GB it has at most 134 million nodes. 0 if not even the shortest one fits.
pub(crate) fn longest_lookahead(model: &Model, max_bytes: usize) -> u32 {
    let n_layers = max_bytes / size_of::<Node>() / (model.states().len() as usize).max(1);
    u32::try_from(n_layers.saturating_sub(1)).unwrap_or(u32::MAX)
}

impl OnlineMapping {
    /// Approximate size in memory, in bytes, without the model. Looks at no layer.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        let moves = self.moves.capacity() * size_of::<Move>();
        size_of::<Self>() + self.window.size_bytes() + self.sweep.size_bytes() + moves
    }

    /// Checks that there is memory for so many bytes more.
    pub(super) fn check_memory(&self, n_bytes: usize) -> Result<(), Stopped> {
        if self.max_bytes == usize::MAX || self.size_bytes().saturating_add(n_bytes) <= self.max_bytes {
            Ok(())
        } else {
            Err(Stopped::Memory)
        }
    }

    /// How much memory the next layer takes, in bytes.
    pub(super) fn next_layer_bytes(&self) -> usize {
        let observed = self.n_terms * size_of::<f64>() + self.weights.as_slice().len() * OBSERVED_BYTES;
        self.window.layer_bytes(self.model.graph().n_states()) + observed
    }

    /// About how much memory a mapping of so many observations takes at most, in bytes, also while it takes one: if all ways to all states
    /// are alive, as when nothing tells them apart.
    #[must_use]
    pub fn most_bytes(model: &Model, lookahead: Option<NonZeroU32>, n_observations: usize) -> usize {
        /// How many entries of the open list there are for each state, about.
        const OPEN: usize = 4;
        let n_states = model.graph().n_states();
        let n_terms = n_terms(model, |_| true);
        let reach = lookahead.map_or(usize::MAX, |lookahead| lookahead.get() as usize);
        let n_layers = n_observations.min(reach.saturating_add(1));
        let each = n_states * size_of::<Node>() + size_of::<Layer>() + model.schema().len() * OBSERVED_BYTES;
        let once = n_states
            * (size_of::<f64>() + size_of::<StateIdx>() + OPEN * size_of::<CheapestFirst>() + 3 * layer::NODE_BYTES)
            + n_terms * size_of::<f64>();
        let moves = n_observations.saturating_mul(MOVES_PER_OBSERVATION * size_of::<Move>());
        n_layers.saturating_mul(each).saturating_add(once).saturating_add(moves + BASE_BYTES)
    }
}

/// How many terms of distances an observation has, for each value of the attributes at these positions.
pub(super) fn n_terms(model: &Model, weighs: impl Fn(usize) -> bool) -> usize {
    let weighing = (0..model.schema().len()).filter(|position| weighs(*position));
    weighing.map(|position| model.states().domain(position).len()).sum()
}

/// What an observed attribute takes, besides its terms.
const OBSERVED_BYTES: usize = 64;

/// What there is however small the model.
const BASE_BYTES: usize = 1 << 12;

/// About how many steps an observation has at most, with the room for more: bodies that need more are rare.
const MOVES_PER_OBSERVATION: usize = 8;
