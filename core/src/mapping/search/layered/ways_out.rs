//! The ways out of the states of a model, in one array.

use crate::mapping::conditions::Body;
use crate::model::{ActionIdx, Model, StateIdx};

/// The ways out of all states that a body has.
#[derive(Debug, Default)]
pub(super) struct WaysOut {
    pub(super) ways: Vec<WayOut>,
    /// By state, where its ways end.
    pub(super) ends: Vec<usize>,
    body: Body,
}

/// A way out of a state.
#[derive(Clone, Copy, Debug)]
pub(super) struct WayOut {
    pub(super) cost: f64,
    pub(super) from: StateIdx,
    pub(super) to: StateIdx,
    pub(super) action: ActionIdx,
}

impl WaysOut {
    /// Gathers the ways of `body` in `model`, which is the same every time.
    pub(super) fn prepare(&mut self, model: &Model, body: &Body) {
        if !self.ends.is_empty() && self.body == *body {
            return;
        }
        self.ways.clear();
        self.ends.clear();
        self.body.clone_from(body);
        let space = model.whole();
        for state in 0..model.states().len() {
            let ways = body.ways(&space, state);
            self.ways.extend(ways.map(|(way, cost)| WayOut { cost, from: state, to: way.to, action: way.action }));
            self.ends.push(self.ways.len());
        }
    }

    /// The ways out of a state, and the number of the first.
    #[inline]
    pub(super) fn ways(&self, state: StateIdx) -> (usize, &[WayOut]) {
        let begin = (state as usize).checked_sub(1).map_or(0, |before| self.ends[before]);
        (begin, &self.ways[begin..self.ends[state as usize]])
    }
}
