//! Where a search begins: in the most promising start, and in the others once a mapping is known that they would have to beat.

use super::{Arrival, End, NO_ACTION, NO_NODE, OUT_OF_TIME, Reached, Search};
use crate::interrupt::{Cancelled, Signal};
use crate::mapping::MoveKind;
use crate::mapping::heuristic::Heuristic as _;
use crate::model::{Space, StateIdx};

impl<S: Space, const ALIKE: bool> Search<'_, '_, S, ALIKE> {
    /// Takes the most promising start, whatever it costs: it is what is left to complete if there is no budget at all. Gives the others,
    /// with their `f`.
    pub(super) fn start(&mut self) -> Vec<(f64, StateIdx)> {
        let starts = self.problem.starts.states();
        let mut others = Vec::new();
        let mut first = starts[0];
        if starts.len() > 1 {
            let f = |state: &StateIdx| {
                let row = self.space.row(*state);
                let distance = self.problem.distances.distance(0, row);
                let f = self.recurrence.arrive(MoveKind::Start, 0.0, distance) + self.projected.cost_to_go(0, row);
                (f, *state)
            };
            others.extend(starts.iter().map(f));
            // The first among equals.
            let best = (0..others.len()).min_by(|n, other| others[*n].0.total_cmp(&others[*other].0)).unwrap_or(0);
            (_, first) = others.remove(best);
            self.left_out_f = others.iter().map(|(f, _)| *f).fold(f64::INFINITY, f64::min);
        }
        let limit = std::mem::replace(&mut self.limit, f64::INFINITY);
        let taken = self.take_start(first);
        self.limit = self.limit.min(limit);
        self.first = taken.map_or(self.incumbent.unwrap_or(NO_NODE), |first| first.id);
        self.least_f = self.nodes.get::<ALIKE>(self.first).f.min(self.left_out_f);
        others
    }

    /// Takes these starts, as far as they are of interest.
    pub(super) fn start_in(&mut self, starts: &[(f64, StateIdx)]) -> Result<End, Cancelled> {
        for (n, (f, state)) in starts.iter().enumerate() {
            match self.meter.spend(1) {
                Signal::Continue if *f < self.limit => drop(self.take_start(*state)),
                Signal::Continue => {}
                Signal::Finish => {
                    self.left_out_f = starts[n..].iter().map(|(f, _)| *f).fold(f64::INFINITY, f64::min);
                    return Ok(OUT_OF_TIME);
                }
                Signal::Cancel => return Err(Cancelled),
            }
        }
        self.left_out_f = f64::INFINITY;
        Ok(End::Done)
    }

    fn take_start(&mut self, state: StateIdx) -> Option<Reached> {
        let state = self.seen.number_of(state, self.space, self.projected);
        let kind = MoveKind::Start;
        let start = Arrival { kind, observation: 0, state, cost: 0.0, parent: NO_NODE, action: NO_ACTION };
        let mut block = self.nodes.find(state, 0);
        self.take(&mut block, start)
    }
}
