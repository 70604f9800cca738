//! The search of large problems, which gets larger tables, and at last a sweep, the longer it takes.

use super::{Budget, Buffers, Choices, Mapper, Mapping, Settings, conclude, least_start, within};
use crate::interrupt::{Cancelled, Interrupt, Meter};
use crate::mapping::cost::SLACK;
use crate::mapping::heuristic::abstraction::{AbstractionRoom, KnownCosts};
use crate::mapping::heuristic::projected::{Projected, TableRoom};
use crate::mapping::heuristic::{Guide, Heuristic, Raising};
use crate::mapping::search::sweep::{KnownLayer, Swept, sweep};
use crate::mapping::search::{Found, banded, best_first};
use crate::mapping::{Problem, StoppedBy};
use crate::model::{Space, StateIdx};

impl Mapper {
    /// Searches, in bands or best first, in up to four stages: with the small tables of projections only, then with all of them; where single attributes
    /// tell little, with estimates that an [abstraction](crate::mapping::heuristic::abstraction) raises; and once a good part of all nodes was
    /// expanded, [`sweep`] goes over all nodes instead, which takes a fraction of the time for each.
    pub(super) fn best_first<S: Space>(
        &self,
        space: &mut S,
        choices: Choices,
        problem: &Problem<'_>,
        settings: Settings,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let budget = settings.budget;
        let n_nodes =
            space.n_states().map_or(u64::MAX, |n| (n as u64).saturating_mul(problem.demonstration.len() as u64));
        let may_be_swept = space.n_states().is_some();
        let n_observations = problem.demonstration.len();
        // Where there are not even expansions enough to look at every observation, much depends on good estimates.
        let is_small_budget = budget.max_expansions < n_observations as u64;
        let patience = self.patience;
        let few_entries = patience.few_entries.max(n_observations * patience.few_entries_per_observation);
        let room = TableRoom::within(choices.max_bytes);
        let mut before: Option<(Projected<'_>, Found)> = None;
        for room in [if is_small_budget { room } else { room.at_first(few_entries) }, room] {
            let solved = self.solve(problem, room, interrupt)?;
            // No time for estimates, so none for a search with them.
            let Some(projected) = solved else { break };
            // The tables of the first attempt are of no more use.
            let found_before = before.take().map(|(_, found)| found);
            let n_before = found_before.as_ref().map_or(0, |found| found.n_expanded);
            let budget = budget.beside(projected.size_bytes());
            let max_expansions = budget.max_expansions - n_before;
            // What would be done instead, should it take that long.
            let n_untabled = if room.few < room.most { projected.n_left_out() } else { 0 };
            let before_sweep = patience.min_expansions_before_sweep.max(n_nodes / patience.nodes_per_expansion);
            let until_sweep = |max_expansions: u64| {
                let may_sweep = may_be_swept && before_sweep.saturating_add(n_nodes) <= max_expansions;
                if may_sweep { before_sweep } else { u64::MAX }
            };
            let enough = match n_untabled {
                0 => until_sweep(max_expansions),
                n_untabled => n_untabled / patience.entries_per_expansion,
            };
            let capped = Budget { max_expansions: max_expansions.min(enough), ..budget };
            let (n_tries, least_excess) = patience.abstractions(problem);
            let max_classes = self.max_classes();
            let mut abstract_in = |max_bytes: usize, costs: &mut KnownCosts, meter: &mut Meter<'_>| {
                let room = AbstractionRoom { n_tries, max_classes, max_bytes };
                self.abstractions.solve(&self.projections, problem, &projected, room, costs, meter)
            };
            let after = patience.before_abstraction(n_nodes);
            let may_raise = n_untabled == 0 && choices.may_turn && self.may_abstract();
            let raising = may_raise.then_some(Raising { after, least_excess, abstract_in: &mut abstract_in });
            let guide = Guide { projected: &projected, raising };
            let mut found = self.in_bands(space, problem, guide, capped, most_f, interrupt)?;
            let is_enough = !found.is_complete && enough < max_expansions && found.n_expanded >= enough;
            let is_out_of_memory = choices.may_turn && found.stopped_by == Some(StoppedBy::Memory);
            if let Some(before) = found_before {
                found = joined(before, found);
            }
            if (is_enough || is_out_of_memory) && n_untabled > 0 {
                before = Some((projected, found));
                continue;
            }
            // A sweep takes less memory for a node.
            let may_sweep_instead = may_be_swept && n_nodes <= budget.max_expansions.saturating_sub(found.n_expanded);
            if is_enough || (is_out_of_memory && may_sweep_instead) {
                match sweep(problem, budget, interrupt)? {
                    Swept::Done(swept) => found = joined(Found { paths: Vec::new(), ..found }, swept),
                    Swept::CutShort { known, n_expanded, n_generated } => {
                        found.least_f = found.least_f.max(bound_of(problem, &projected, &known));
                        found.n_expanded += n_expanded;
                        found.n_generated += n_generated;
                        found.stopped_by = Some(StoppedBy::Deadline);
                    }
                    Swept::TooLarge if is_out_of_memory => {}
                    Swept::TooLarge => {
                        let max_expansions = budget.max_expansions - found.n_expanded;
                        let rest = Budget { max_expansions, ..budget };
                        let more = self.search(space, problem, Guide::from(&projected), rest, most_f, interrupt)?;
                        found = joined(found, more);
                    }
                }
            }
            return conclude(problem, space, &projected, within(most_f, found, problem), interrupt);
        }
        if let Some((projected, found)) = before {
            let found = Found { stopped_by: Some(StoppedBy::Deadline), ..found };
            return conclude(problem, space, &projected, found, interrupt);
        }
        let blind = Projected::blind(problem);
        let budget = Budget { max_expansions: 0, ..budget };
        let found = self.search(space, problem, Guide::from(&blind), budget, most_f, interrupt)?;
        let found = Found { stopped_by: Some(StoppedBy::Deadline), ..found };
        conclude(problem, space, &blind, found, interrupt)
    }

    /// Searches in bands, where that may be done, and best first if that takes long, or too much memory.
    fn in_bands<S: Space>(
        &self,
        space: &mut S,
        problem: &Problem<'_>,
        guide: Guide<'_, '_>,
        budget: Budget,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Found, Cancelled> {
        if !banded::is_for(problem, guide.projected) {
            return self.search(space, problem, guide, budget, most_f, interrupt);
        }
        let few = Budget { max_expansions: budget.max_expansions.min(self.patience.max_banded_expansions), ..budget };
        let found = self.buffers.lend(budget.max_bytes, |Buffers { banded, .. }| {
            banded::search(problem, space, guide.projected, few, most_f, banded, interrupt)
        })?;
        let is_left = few.max_expansions < budget.max_expansions;
        let goes_on = match found.stopped_by {
            Some(StoppedBy::MaxExpansions) => is_left,
            // Best first takes none for nodes that it does not come to.
            Some(StoppedBy::Memory) => true,
            Some(StoppedBy::Deadline) | None => false,
        };
        if !goes_on {
            return Ok(found);
        }
        let rest = Budget { max_expansions: budget.max_expansions - found.n_expanded, ..budget };
        Ok(joined(found, self.search(space, problem, guide, rest, most_f, interrupt)?))
    }

    /// Whether estimates can be raised by an [abstraction](crate::mapping::heuristic::abstraction): all states are listed.
    pub(super) fn may_abstract(&self) -> bool {
        !self.model.is_lazy()
    }

    /// Most classes of a group of attributes: if they were more, one might as well look at the states.
    pub(super) fn max_classes(&self) -> usize {
        const MOST: usize = 1 << 16;
        (self.model.graph().n_states() / self.patience.states_per_class).min(MOST)
    }

    /// Searches best first, with buffers of searches before.
    pub(super) fn search<S: Space>(
        &self,
        space: &mut S,
        problem: &Problem<'_>,
        guide: Guide<'_, '_>,
        budget: Budget,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Found, Cancelled> {
        let is_alike = problem.recurrence().pays_alike();
        let search = if is_alike { best_first::search::<S, true> } else { best_first::search::<S, false> };
        self.buffers.lend(budget.max_bytes, |Buffers { searching, .. }| {
            search(problem, space, guide, budget, most_f, searching, interrupt)
        })
    }
}

/// A lower bound of the cost of all mappings, from the exact costs-to-go of a layer: as the estimate is consistent, a path to a node costs
/// at least what the estimate falls by along it. 0 if the model has too many states to compute it quickly.
fn bound_of(problem: &Problem<'_>, projected: &Projected<'_>, layer: &KnownLayer) -> f64 {
    /// That takes some ten milliseconds.
    const MAX_STATES: StateIdx = 1 << 17;
    let states = problem.model.states();
    if layer.observation == 0 {
        let costs = problem.starts.states().iter().map(|state| layer.costs[*state as usize]);
        return costs.fold(f64::INFINITY, f64::min) * (1.0 - SLACK);
    }
    if states.len() > MAX_STATES {
        return 0.0;
    }
    let estimate = |i: usize, row: &[u32]| problem.distances.distance(i, row) + projected.cost_to_go(i, row);
    let states = (0..states.len()).map(|state| states.row(state)).zip(&layer.costs);
    let reachable = states.filter(|(row, _)| projected.speaks_of(row));
    let rises = reachable.map(|(row, cost)| cost - estimate(layer.observation, row));
    let least_rise = rises.fold(f64::INFINITY, f64::min);
    (least_start(problem, projected) + least_rise) * (1.0 - SLACK)
}

/// Merges the results of two searches of one problem; `found` is that of the later one.
fn joined(before: Found, found: Found) -> Found {
    let mut paths = found.paths;
    paths.extend(before.paths);
    Found {
        paths,
        least_f: found.least_f.max(before.least_f),
        n_expanded: before.n_expanded + found.n_expanded,
        n_generated: before.n_generated + found.n_generated,
        is_complete: found.is_complete,
        stopped_by: found.stopped_by,
    }
}

/// Thresholds at which a search that takes long gets larger tables or a sweep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    /// Most nodes, observations times states, of a problem that is searched layer by layer.
    pub(super) max_layered_nodes: usize,
    /// Most expansions of a search in bands, before one that is best first begins.
    max_banded_expansions: u64,
    /// Most entries of the tables of a search's first attempt, unless `few_entries_per_observation` allows more.
    few_entries: usize,
    /// The same limit for each observation.
    few_entries_per_observation: usize,
    /// How many entries of a table take as long as an expansion.
    entries_per_expansion: u64,
    /// Estimates are raised by a group of attributes after so many expansions,
    min_expansions_before_abstraction: u64,
    /// or one in this many of all nodes, if that is more;
    nodes_per_expansion_before_abstraction: u64,
    /// unless there are fewer states than this for each class of the group,
    states_per_class: usize,
    /// or the cheapest mapping that is known costs fewer times what all cost at least;
    least_excess: f64,
    /// whatever it costs, where extra actions pay a smaller part of the distance than this, and then
    refine_below_extra_weight: f64,
    /// up to so many groups are tried, each with what the one before it misses.
    max_groups: usize,
    /// Expansions after which a sweep replaces the search, unless `nodes_per_expansion` allows more.
    min_expansions_before_sweep: u64,
    /// The search may expand one in this many of all nodes before a sweep replaces it.
    nodes_per_expansion: u64,
}

impl Patience {
    /// After how many expansions of a search of so many nodes estimates are raised.
    fn before_abstraction(self, n_nodes: u64) -> u64 {
        self.min_expansions_before_abstraction.max(n_nodes / self.nodes_per_expansion_before_abstraction)
    }

    /// How many groups are tried for a problem, and how many times what all mappings cost at least the cheapest that is known must cost for
    /// that.
    fn abstractions(self, problem: &Problem<'_>) -> (usize, f64) {
        let is_refined = problem.conditions.extra_weight < self.refine_below_extra_weight;
        if is_refined { (self.max_groups, 0.0) } else { (1, self.least_excess) }
    }

    pub(super) const DEFAULT: Self = Self {
        // To make room for as many takes ten microseconds.
        max_layered_nodes: 1 << 16,
        // They take seven milliseconds. Few searches take more, and to raise estimates takes some.
        max_banded_expansions: 1 << 17,
        // They take half a millisecond.
        few_entries: 1 << 16,
        // Two microseconds, which is no more than the search is bound to take.
        few_entries_per_observation: 1 << 8,
        entries_per_expansion: 16,
        // They take a fifth of a millisecond, and the abstraction more.
        min_expansions_before_abstraction: 1 << 11,
        // A table has as many entries as a quarter of the nodes at most, and to make room for one takes a nanosecond.
        nodes_per_expansion_before_abstraction: 1 << 10,
        states_per_class: 4,
        // Where it costs less, the searches of most caves end before they would gain by it.
        least_excess: 2.0,
        // Where they pay more, to search a larger group takes longer than what it saves.
        refine_below_extra_weight: 0.25,
        max_groups: 4,
        // Nodes of fewer expansions are in the caches, where an expansion takes less time.
        min_expansions_before_sweep: 1 << 16,
        // So many are swept in about the time of an expansion, where there are many.
        nodes_per_expansion: 16,
    };
}

#[cfg(test)]
mod tests;
