//! Expansions: which nodes of a layer are, and what follows from them.
//!
//! A few nodes are chosen, and then followed together: either takes fewer instructions by itself.

use std::ops::Range;

use super::super::layered::note;
use super::bands::BandIdx;
use super::layer::{Entry, EntryIdx, Layer, Link, Stage};
use super::passed::{PassedIdx, PassedWay};
use super::{BEAM_WIDTHS, End, NO_ACTION, Search};
use crate::interrupt::{Cancelled, Signal};
use crate::mapping::heuristic::projected::Estimate;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{MoveKind, StoppedBy};
use crate::model::Space;

const WIDEST_BEAM: usize = BEAM_WIDTHS[BEAM_WIDTHS.len() - 1];

/// A node that is expanded.
#[derive(Debug)]
pub(super) struct Chosen {
    /// What the way to it costs, with its distance.
    g: f64,
    state: PassedIdx,
    /// Where the ways out of the state are.
    ways: Range<u32>,
    may_skip: bool,
    may_linger: bool,
}

impl Chosen {
    /// The node of a state, where the way to it ends with a move of this kind.
    #[inline]
    fn of(kind: MoveKind, g: f64, state: PassedIdx, ways: Range<u32>) -> Self {
        let may = |next| Recurrence::default().may_follow(kind, next);
        Self { g, state, ways, may_skip: may(MoveKind::Skip), may_linger: may(MoveKind::Extra) }
    }

    /// How many successors it has.
    #[inline]
    fn n_generated(&self) -> usize {
        usize::from(self.may_skip) + (1 + usize::from(self.may_linger)) * self.ways.len()
    }
}

impl<S: Space> Search<'_, S> {
    /// Expands the most promising fresh nodes of a layer, about `width`, and of those to which they lead by actions that do not advance.
    pub(super) fn expand_best(&mut self, observation: usize, width: usize) -> Result<End, Cancelled> {
        let limit = self.limit_of_beam(observation, width);
        let mut n_left = width + width / 2;
        loop {
            match self.look()? {
                Ok(n_allowed) => self.choose_fresh(observation, limit, n_left.min(n_allowed)),
                Err(stopped_by) => return Ok(End::CutShort(stopped_by)),
            }
            if self.chosen.is_empty() {
                return Ok(End::Done);
            }
            n_left -= self.chosen.len();
            self.go_on(observation);
        }
    }

    /// What mappings must cost less than for no more than `width` of the fresh nodes of a layer to be expanded, equals aside.
    fn limit_of_beam(&self, observation: usize, width: usize) -> f64 {
        let layer = &self.layers[observation];
        let estimates = self.passed.estimates(observation);
        let mut least = [f64::INFINITY; WIDEST_BEAM];
        let least = &mut least[..width];
        for &state in &layer.fresh[..layer.n_fresh] {
            let Estimate { distance, cost_to_go } = estimates.of(state);
            note(least, layer.nodes[state as usize].cost + distance + cost_to_go);
        }
        self.limit.min(least[width - 1].next_up())
    }

    /// Chooses up to `most` fresh nodes of a layer, which may be on a mapping of less than `limit`. The others stay fresh.
    fn choose_fresh(&mut self, observation: usize, limit: f64, most: usize) {
        let Self { space, projected, passed, layers, chosen, .. } = self;
        let Layer { nodes, fresh, n_fresh, entries, .. } = &mut layers[observation];
        chosen.clear();
        let mut n_kept = 0;
        for at in 0..std::mem::take(n_fresh) {
            let state = fresh[at];
            let node = &mut nodes[state as usize];
            let Estimate { distance, cost_to_go } = passed.estimate(state, observation);
            let g = node.cost + distance;
            if chosen.len() < most && g + cost_to_go < limit {
                node.link.move_to(Stage::Closed);
                entries.push(Entry { g, state, before: 0 });
                chosen.push(Chosen::of(node.link.kind(), g, state, passed.explore(state, *space, projected)));
            } else {
                fresh[n_kept] = state;
                n_kept += 1;
            }
        }
        *n_fresh = n_kept;
    }

    /// Expands the nodes of a layer in a band, and those to which they lead by actions that do not advance.
    pub(super) fn expand(&mut self, observation: usize, band: BandIdx) -> Result<End, Cancelled> {
        loop {
            let layer = &mut self.layers[observation];
            if layer.n_fresh > 0 {
                layer.sort_in(self.passed.estimates(observation), self.bands, band, self.limit);
            }
            let mut entry_idx = layer.take(band);
            if entry_idx == 0 {
                return Ok(End::Done);
            }
            while entry_idx != 0 {
                match self.look()? {
                    Ok(n_allowed) => entry_idx = self.choose(observation, band, entry_idx, n_allowed),
                    Err(stopped_by) => return Ok(End::CutShort(stopped_by)),
                }
                self.go_on(observation);
            }
        }
    }

    /// How many nodes may be expanded until it is asked again, or what has run out.
    fn look(&mut self) -> Result<Result<usize, StoppedBy>, Cancelled> {
        let n_metered = self.n_expanded + self.n_generated;
        let signal = self.meter.spend(n_metered - self.n_metered);
        self.n_metered = n_metered;
        let n_layers = self.last + 1;
        let n_bytes = self.passed.size_bytes() + self.passed.len() * n_layers * Layer::PLACE_BYTES;
        let n_left = self.budget.max_expansions - self.n_expanded;
        Ok(match signal {
            Signal::Cancel => return Err(Cancelled),
            Signal::Finish => Err(StoppedBy::Deadline),
            Signal::Continue if n_left == 0 => Err(StoppedBy::MaxExpansions),
            Signal::Continue if self.budget.is_full(n_bytes, self.space) => Err(StoppedBy::Memory),
            Signal::Continue => {
                Ok(usize::try_from(n_left).map_or(self.look_every, |n_left| n_left.min(self.look_every)))
            }
        })
    }

    /// Chooses up to `most` nodes of a layer from a band, from an entry on, and looks where the ways out of their states are. Gives the
    /// entry from which to go on.
    fn choose(&mut self, observation: usize, band: BandIdx, mut entry_idx: EntryIdx, most: usize) -> EntryIdx {
        let Self { space, projected, passed, layers, chosen, .. } = self;
        let Layer { nodes, entries, .. } = &mut layers[observation];
        let may_be_above = band == self.bands.of(self.limit, 0);
        chosen.clear();
        while entry_idx != 0 && chosen.len() < most {
            let Entry { g, state, before } = entries[entry_idx as usize - 1];
            entry_idx = before;
            let node = &mut nodes[state as usize];
            // It may have been chosen from a lower band.
            if !node.link.is_at(Stage::Waiting) {
                continue;
            }
            node.link.move_to(Stage::Closed);
            if may_be_above && g + passed.estimate(state, observation).cost_to_go >= self.limit {
                continue;
            }
            chosen.push(Chosen::of(node.link.kind(), g, state, passed.explore(state, *space, projected)));
        }
        entry_idx
    }

    /// Follows the ways out of the chosen nodes of a layer.
    #[inline(never)]
    fn go_on(&mut self, observation: usize) {
        let Self { passed, layers, chosen, .. } = self;
        let Ok([here, next]) = layers.get_disjoint_mut([observation, observation + 1]) else { return };
        let n_generated = chosen.iter().map(Chosen::n_generated).sum();
        self.n_expanded += chosen.len() as u64;
        self.n_generated += n_generated as u64;
        let n_states = passed.len();
        let mut reaching_next = next.reaching(n_states, n_generated);
        let mut reaching_here = here.reaching(n_states, n_generated);
        for &Chosen { g, state, ref ways, may_skip, may_linger } in chosen.iter() {
            // What may not be is infinitely expensive: there is no branch.
            let [before_skip, before_extra] = [may_skip, may_linger].map(|may| if may { g } else { f64::INFINITY });
            reaching_next.reach(state, before_skip, Link::new(state, NO_ACTION, MoveKind::Skip));
            for &PassedWay { cost, to, action } in passed.ways(ways) {
                reaching_next.reach(to, g + cost, Link::new(state, action, MoveKind::Match));
                reaching_here.reach(to, before_extra + cost, Link::new(state, action, MoveKind::Extra));
            }
        }
        let [n_here, n_next] = [reaching_here, reaching_next].map(|reaching| reaching.n_fresh);
        (here.n_fresh, next.n_fresh) = (n_here, n_next);
    }
}
