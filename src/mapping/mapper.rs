//! A model prepared for mapping.

use std::sync::{Arc, Mutex, PoisonError};

use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::completion::{Allowance, Extras, complete};
use super::cost::{Cost, ROUNDING, SLACK, cost_of};
use super::heuristic::paper::Paper;
use super::heuristic::projected::{MAX_ENTRIES, Projected};
use super::heuristic::projection::Projections;
use super::heuristic::{Blind, Grouping, GroupingPatience, Heuristic, HeuristicName};
use super::search::best_first::{self, Buffers};
use super::search::{Found, Move, astar};
use super::{OnlineMapping, Problem};
use crate::interrupt::{Cancelled, Interrupt, Signal, Uninterrupted};
use crate::model::{Explored, Model, Space, StateIdx, States, Whole};

/// What a search may spend. Its time is bounded by its caller's [`Interrupt`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Most nodes expanded.
    pub max_expansions: u64,
    /// Most nodes kept in memory, about 64 bytes each. If the model is searched lazily, the states that are found count too, by
    /// their size.
    pub max_nodes: usize,
}

impl Budget {
    /// Any number of expansions, within 16 million nodes: about 1 GB. The tables of the default heuristic come on top: up to
    /// 256 MB, and as much again where attributes are projected together.
    pub const DEFAULT: Self = Self { max_expansions: u64::MAX, max_nodes: 16_000_000 };
}

impl Budget {
    /// How much memory a node takes, in bytes.
    const NODE_BYTES: usize = 64;

    /// How much memory its nodes take, in bytes.
    fn max_bytes(self) -> usize {
        self.max_nodes.saturating_mul(Self::NODE_BYTES)
    }

    /// Whether there is no more memory: for `n_nodes`, and what was found in `space`.
    #[inline]
    pub(super) fn is_full(self, n_nodes: usize, space: &impl Space) -> bool {
        n_nodes + space.found_bytes() / Self::NODE_BYTES >= self.max_nodes
    }
}

impl Default for Budget {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// How a mapping is searched for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Settings {
    /// What guides the search.
    pub heuristic: HeuristicName,
    /// What it may spend.
    pub budget: Budget,
    /// The cost of a mapping that is known already: nothing that costs more is looked at. If it is below the optimum, the mapping
    /// is bounded by it. Has no effect with the paper's heuristic.
    pub upper_bound: Option<f64>,
    /// When the default heuristic projects attributes together.
    pub grouping: Grouping,
}

/// What was proven of a mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// No mapping costs less.
    Optimal,
    /// No mapping costs less than `lower_bound`: a budget ran out, or the heuristic proves nothing.
    Bounded,
    /// Nothing: a finite lookahead decided.
    Local,
}

impl Status {
    /// The status, as in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Optimal => "optimal",
            Self::Bounded => "bounded",
            Self::Local => "local",
        }
    }
}

/// The best sequence of imitator states and actions that was found for a demonstration, with its alignment.
#[derive(Clone, Debug, PartialEq)]
pub struct Mapping {
    /// The steps, from [`Start`](super::MoveKind::Start) to the last observation.
    pub moves: Vec<Move>,
    /// What they cost.
    pub cost: Cost,
    /// What was proven.
    pub status: Status,
    /// No mapping costs less. Equal to `cost.total` if optimal; `None` if local.
    pub lower_bound: Option<f64>,
    /// Nodes expanded.
    pub n_expanded: u64,
    /// Successors looked at.
    pub n_generated: u64,
    /// The states of the moves, in the order in which they are first passed, if the model is searched lazily; else they are those
    /// of the model.
    pub states: Option<States>,
}

/// A model, and what is computed once per model to search it.
#[derive(Debug)]
pub struct Mapper {
    model: Arc<Model>,
    projections: Projections,
    /// Of searches that have ended, for those that come: at most as many as ran at the same time.
    buffers: Mutex<Vec<Buffers>>,
    patience: Patience,
}

impl Mapper {
    /// Prepares `model`. Takes time and memory proportional to its states and transitions times attributes.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so. It is not asked to finish.
    pub fn new(model: Model, interrupt: &mut dyn Interrupt) -> Result<Self, Cancelled> {
        let projections = Projections::new(&model, interrupt)?;
        Ok(Self { model: Arc::new(model), projections, buffers: Mutex::default(), patience: Patience::DEFAULT })
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> &Model {
        &self.model
    }

    pub(super) fn shared_model(&self) -> Arc<Model> {
        Arc::clone(&self.model)
    }

    /// Approximate size in memory, in bytes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.model.size_bytes() + self.projections.size_bytes()
    }

    /// A lower bound of the cost from each node, an observation and a state, of `problem` to the end: what guides the
    /// search by default. Consistent, for nodes that the start leads to; 0 at the last observation. For other searches, and to
    /// look at.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model; the function, if the observation is not of the problem, or the state has no number in the
    /// model, as all but the start of one that is searched lazily.
    pub fn lower_bounds<'p>(&'p self, problem: &'p Problem<'p>) -> impl Fn(u32, StateIdx) -> f64 + 'p {
        self.check(problem);
        let projected =
            Projected::solve(&self.projections, problem, Grouping::WhenItPays, MAX_ENTRIES, &mut Uninterrupted)
                .ok()
                .flatten();
        let projected = projected.expect("nothing interrupts");
        move |observation, state| projected.cost_to_go(observation as usize, self.model.states().row(state))
    }

    /// The cheapest mapping of `problem`, which must be of this mapper's model; the best one found if the budget runs out or
    /// `interrupt` says to finish. Deterministic but for where `interrupt` cuts it off.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    ///
    /// # Panics
    ///
    /// If `problem` is of another model.
    pub fn map(
        &self,
        problem: &Problem<'_>,
        settings: Settings,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        self.check(problem);
        let Some(cave) = self.model.unexplored() else {
            return self.map_in(&mut Whole::of(&self.model), problem, settings, interrupt);
        };
        let mut explored = Explored::new(cave, problem.cave_start.unwrap_or_else(|| cave.first_state()));
        let mut mapping = self.map_in(&mut explored, problem, settings, interrupt)?;
        mapping.states = Some(explored.keep(&renumber(&mut mapping.moves)));
        Ok(mapping)
    }

    fn map_in<S: Space>(
        &self,
        space: &mut S,
        problem: &Problem<'_>,
        settings: Settings,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let Settings { budget, upper_bound, .. } = settings;
        // Sums in another order may be a little larger; a little room costs nothing.
        let most_f = upper_bound.map_or(f64::INFINITY, |bound| bound * (1.0 + SLACK));
        match settings.heuristic {
            HeuristicName::Default => self.best_first(space, problem, settings, most_f, interrupt),
            HeuristicName::None => {
                let found = astar::search(problem, space, &Blind, budget, most_f, interrupt)?;
                conclude(problem, space, &Blind, within(most_f, found, problem), interrupt)
            }
            HeuristicName::Paper => {
                let found = astar::search(problem, space, &Paper::new(problem), budget, f64::INFINITY, interrupt)?;
                // The paper's estimate proves nothing; the projections bound the optimum all the same.
                let first = problem.distances.distance(0, space.row(problem.start));
                match Projected::solve(&self.projections, problem, settings.grouping, MAX_ENTRIES, interrupt)? {
                    Some(projected) => {
                        let least_f = first + projected.cost_to_go(0, space.row(problem.start));
                        conclude(problem, space, &projected, Found { least_f, ..found }, interrupt)
                    }
                    None => conclude(problem, space, &Blind, Found { least_f: first, ..found }, interrupt),
                }
            }
        }
    }

    fn check(&self, problem: &Problem<'_>) {
        assert!(std::ptr::eq(problem.model, &raw const *self.model), "the problem must be of this mapper's model");
    }

    /// Searches best first, with more help the longer it takes: at first with tables of projections only where they are small,
    /// then with all of them; and where it has still looked at a good part of all nodes, what is left is to look at all of them,
    /// layer by layer, which takes a fraction of the time for each.
    fn best_first<S: Space>(
        &self,
        space: &mut S,
        problem: &Problem<'_>,
        settings: Settings,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let Settings { budget, grouping, .. } = settings;
        let n_nodes =
            space.n_states().map_or(u64::MAX, |n| (n as u64).saturating_mul(problem.demonstration.len() as u64));
        let may_be_swept = space.n_states().is_some_and(|n_states| n_states <= MAX_SWEPT_STATES);
        let n_observations = problem.demonstration.len();
        // Where there are not even expansions enough to look at every observation, much depends on good estimates.
        let is_small_budget = budget.max_expansions < n_observations as u64;
        let patience = self.patience;
        let few_entries = patience.few_entries.max(n_observations * patience.few_entries_per_observation);
        let few_entries = few_entries.min(MAX_ENTRIES);
        let mut before: Option<(Projected<'_>, Found)> = None;
        for max_entries in [if is_small_budget { MAX_ENTRIES } else { few_entries }, MAX_ENTRIES] {
            let solved = Projected::solve(&self.projections, problem, grouping, max_entries, interrupt)?;
            // No time for estimates, so none for a search with them.
            let Some(mut projected) = solved else { break };
            projected.set_patience(patience.grouping);
            let n_before = before.as_ref().map_or(0, |(_, found)| found.n_expanded);
            let max_expansions = budget.max_expansions - n_before;
            // What would be done instead, should it take that long.
            let n_untabled = if max_entries < MAX_ENTRIES { projected.n_left_out() } else { 0 };
            let before_sweep = patience.min_expansions_before_sweep.max(n_nodes / patience.nodes_per_expansion);
            let may_sweep = may_be_swept && before_sweep.saturating_add(n_nodes) <= max_expansions;
            let enough = match n_untabled {
                0 if may_sweep => before_sweep,
                0 => u64::MAX,
                n_untabled => n_untabled / patience.entries_per_expansion,
            };
            let capped = Budget { max_expansions: max_expansions.min(enough), ..budget };
            let mut found = self.search(space, problem, &mut projected, capped, most_f, interrupt)?;
            let is_enough = !found.is_complete && enough < max_expansions && found.n_expanded >= enough;
            if let Some((_, before)) = before.take() {
                found = joined(before, found);
            }
            if is_enough && n_untabled > 0 {
                before = Some((projected, found));
                continue;
            }
            if is_enough {
                let swept = self.sweep(problem, budget, interrupt)?;
                found.n_expanded += swept.n_expanded;
                found.n_generated += swept.n_generated;
                match swept.outcome {
                    Outcome::Mapped(mapping) => {
                        let Found { n_expanded, n_generated, .. } = found;
                        return Ok(Mapping { n_expanded, n_generated, ..mapping });
                    }
                    Outcome::CutShort => {}
                    Outcome::TooLarge => {
                        let max_expansions = budget.max_expansions - found.n_expanded;
                        let rest = Budget { max_expansions, ..budget };
                        let more = self.search(space, problem, &mut projected, rest, most_f, interrupt)?;
                        found = joined(found, more);
                    }
                }
            }
            return conclude(problem, space, &projected, within(most_f, found, problem), interrupt);
        }
        if let Some((projected, found)) = before {
            return conclude(problem, space, &projected, found, interrupt);
        }
        let mut blind = Projected::blind(problem);
        let budget = Budget { max_expansions: 0, ..budget };
        let found = self.search(space, problem, &mut blind, budget, most_f, interrupt)?;
        conclude(problem, space, &blind, found, interrupt)
    }

    fn search<S: Space>(
        &self,
        space: &mut S,
        problem: &Problem<'_>,
        projected: &mut Projected<'_>,
        budget: Budget,
        most_f: f64,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Found, Cancelled> {
        let kept = self.buffers.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut buffers = kept.unwrap_or_default();
        let found = best_first::search(problem, space, projected, budget, most_f, &mut buffers, interrupt)?;
        if buffers.are_small() {
            self.buffers.lock().unwrap_or_else(PoisonError::into_inner).push(buffers);
        }
        Ok(found)
    }

    /// A mapping of `problem` that begins with `moves` and goes on greedily; of whole states, as for a lookahead. Nothing is
    /// proven of it.
    ///
    /// # Errors
    ///
    /// [`Cancelled`] if `interrupt` said so.
    pub(super) fn complete(
        &self,
        problem: &Problem<'_>,
        moves: Vec<Move>,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Mapping, Cancelled> {
        let found = Found { paths: vec![moves], is_complete: false, least_f: 0.0, n_expanded: 0, n_generated: 0 };
        let mapping = conclude(problem, &mut Whole::of(&self.model), &Blind, found, interrupt)?;
        Ok(Mapping { status: Status::Local, lower_bound: None, ..mapping })
    }

    /// The cheapest mapping, from the cheapest ways to all states at each observation after the other.
    fn sweep(&self, problem: &Problem<'_>, budget: Budget, interrupt: &mut dyn Interrupt) -> Result<Swept, Cancelled> {
        let mut online = OnlineMapping::new(self, problem.weights.clone(), Some(problem.start), None);
        let mut is_cut_short = None;
        for observation in problem.demonstration.iter() {
            is_cut_short = match interrupt.poll() {
                Signal::Continue if online.size_bytes() > budget.max_bytes() => Some(Outcome::TooLarge),
                Signal::Continue => None,
                Signal::Finish => Some(Outcome::CutShort),
                Signal::Cancel => return Err(Cancelled),
            };
            if is_cut_short.is_some() {
                break;
            }
            online.observe(observation, interrupt)?;
        }
        let (n_expanded, n_generated) = (online.n_expanded(), online.n_generated());
        let end = || online.end().map_or(Outcome::CutShort, |(_, mapping)| Outcome::Mapped(mapping));
        Ok(Swept { outcome: is_cut_short.unwrap_or_else(end), n_expanded, n_generated })
    }
}

/// What a sweep gave, and what it took.
#[derive(Debug)]
struct Swept {
    outcome: Outcome,
    n_expanded: u64,
    n_generated: u64,
}

/// How a sweep ended.
#[derive(Debug, PartialEq)]
enum Outcome {
    /// With the cheapest mapping.
    Mapped(Mapping),
    /// The interrupt said to finish.
    CutShort,
    /// The ways would have taken more memory than the budget allows.
    TooLarge,
}

/// What two searches for the same mappings found together, of which the later one is `found`.
fn joined(before: Found, found: Found) -> Found {
    let mut paths = found.paths;
    paths.extend(before.paths);
    Found {
        paths,
        least_f: found.least_f.max(before.least_f),
        n_expanded: before.n_expanded + found.n_expanded,
        n_generated: before.n_generated + found.n_generated,
        is_complete: found.is_complete,
    }
}

/// When a search that takes long gets more help.
#[derive(Clone, Copy, Debug)]
struct Patience {
    /// Most entries of the tables of a search's first attempt,
    few_entries: usize,
    /// or so many per observation, if that is more.
    few_entries_per_observation: usize,
    /// How many entries of a table take as long as an expansion.
    entries_per_expansion: u64,
    /// After how many expansions all nodes are looked at instead,
    min_expansions_before_sweep: u64,
    /// or after one for so many nodes, if that is more.
    nodes_per_expansion: u64,
    /// When attributes are projected together.
    grouping: GroupingPatience,
}

impl Patience {
    const DEFAULT: Self = Self {
        // They take half a millisecond.
        few_entries: 1 << 16,
        // Two microseconds, which is no more than the search is bound to take.
        few_entries_per_observation: 1 << 8,
        entries_per_expansion: 16,
        // Nodes of fewer expansions are in the caches, where an expansion takes less time.
        min_expansions_before_sweep: 1 << 16,
        // So many are swept in about the time of an expansion, where there are many.
        nodes_per_expansion: 16,
        grouping: GroupingPatience::DEFAULT,
    };
}

/// Most states of a model whose layers are swept: a layer takes tens of milliseconds then, between two looks at the interrupt.
const MAX_SWEPT_STATES: usize = 1 << 20;

/// Numbers the states of `moves` anew, in the order in which they are first passed. Gives their former numbers, by the new ones.
fn renumber(moves: &mut [Move]) -> Vec<StateIdx> {
    let mut former = Vec::new();
    let mut numbers: FxHashMap<StateIdx, StateIdx> = FxHashMap::default();
    for step in moves {
        #[expect(clippy::cast_possible_truncation, reason = "no more than there were")]
        let next = former.len() as StateIdx;
        let number = *numbers.entry(step.state).or_insert(next);
        if number == next {
            former.push(step.state);
        }
        step.state = number;
    }
    former
}

/// What was found by a search among the mappings that cost at most `most_f`. If it came to its end without one, there is none, so
/// that is a lower bound.
fn within(most_f: f64, found: Found, problem: &Problem<'_>) -> Found {
    let is_whole = |path: &Vec<Move>| path.last().is_some_and(|end| end.observation as usize == problem.last());
    if found.is_complete && !found.paths.iter().any(is_whole) {
        Found { is_complete: false, least_f: most_f, ..found }
    } else {
        found
    }
}

/// Completes what was found, guided by `heuristic`, and says what is proven if no mapping costs less than its `least_f`.
fn conclude<S: Space, H: Heuristic>(
    problem: &Problem<'_>,
    space: &mut S,
    heuristic: &H,
    found: Found,
    interrupt: &mut dyn Interrupt,
) -> Result<Mapping, Cancelled> {
    let Found { paths, is_complete, least_f: lower_bound, n_expanded, n_generated } = found;
    let mut allowance = Allowance::new(interrupt);
    let ways: &[Extras] = if is_complete { &[Extras::Avoided] } else { &[Extras::Allowed, Extras::Avoided] };
    let mut costed = Vec::new();
    for path in paths {
        for extras in ways {
            let moves = complete(problem, space, heuristic, *extras, path.clone(), &mut allowance)?;
            costed.push((cost_of(problem, space, &moves), moves));
        }
    }
    let best = costed.into_iter().min_by(|(cost, _), (other, _)| cost.total.total_cmp(&other.total));
    let (cost, moves) = best.expect("a search gives at least one path");
    let is_optimal = cost.total * (1.0 - ROUNDING) <= lower_bound;
    Ok(Mapping {
        moves,
        cost,
        status: if is_optimal { Status::Optimal } else { Status::Bounded },
        lower_bound: Some(if is_optimal { cost.total } else { lower_bound }),
        n_expanded,
        n_generated,
        states: None,
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::{Value, json};

    use super::*;
    use crate::document::{Faults, Place};
    use crate::mapping::Request;
    use crate::model::{Definition, Limits};

    /// A belt of places with a dial of ten at each, and a demonstration that turns it in a way that the body cannot.
    fn belt(n_places: usize, n_observations: usize) -> (Mapper, Value) {
        let states: Value = (0..n_places * 10).map(|state| json!([state / 10, state % 10])).collect();
        let transitions = (0..n_places * 10).flat_map(|state| {
            let (place, dial) = (state / 10, state % 10);
            let on = (place + 1 < n_places).then(|| json!([state, "on", state + 10]));
            let back = (place > 0).then(|| json!([state, "back", state - 10]));
            on.into_iter().chain(back).chain([json!([state, "turn", place * 10 + (dial + 3) % 10])])
        });
        let model = json!({
            "attributes": [{"name": "place", "kind": "number"}, {"name": "dial", "kind": "cyclic", "period": 10}],
            "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}, {"name": "turn", "cost": 0.3}],
            "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions.collect::<Value>()},
        });
        let seen = (0..n_observations).map(|i| json!({"place": i % n_places, "dial": i * 2 % 10}));
        (prepared(&model), json!({"model": "belt", "demonstration": seen.collect::<Value>()}))
    }

    fn prepared(model: &Value) -> Mapper {
        let definition = Definition::read(model, Limits::NONE, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).unwrap();
        Mapper::new(model, &mut Uninterrupted).unwrap()
    }

    fn read<'m>(mapper: &'m Mapper, request: &Value) -> Request<'m> {
        let mut faults = Faults::default();
        let object = Place::root(request).object(&Request::FIELDS, &mut faults).unwrap();
        Request::read(mapper.model(), &object, &mut faults).unwrap()
    }

    /// A body in a world of small numbers, and a demonstration. States look alike now and then, and actions may cost nothing.
    fn wander() -> impl Strategy<Value = (Value, Value)> {
        let states = prop::collection::vec((0..6_u32, 0..4_u32, 0..3_u32), 5..60);
        let transitions = prop::collection::vec((0..60_usize, 0..3_usize, 0..60_usize), 10..200);
        let seen = (0..8_u32, prop::option::weighted(0.7, 0..4_u32), prop::option::weighted(0.7, 0..3_u32));
        let costs = prop_oneof![Just([0.0, 0.5, 2.0]), Just([0.3, 0.7, 1.1])];
        (states, transitions, prop::collection::vec(seen, 3..16), costs).prop_map(
            |(states, mut transitions, seen, costs)| {
                for (from, _, to) in &mut transitions {
                    (*from, *to) = (*from % states.len(), *to % states.len());
                }
                transitions.sort_unstable();
                transitions.dedup_by_key(|(from, action, _)| (*from, *action));
                let model = json!({
                    "attributes": [
                        {"name": "x", "kind": "number"},
                        {"name": "y", "kind": "number", "weight": 2.5},
                        {"name": "c", "kind": "category", "weight": 1.3},
                    ],
                    "actions": (0..3).map(|n| json!({"name": format!("a{n}"), "cost": costs[n]})).collect::<Value>(),
                    "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
                });
                (model, json!({"model": "wander", "demonstration": seen}))
            },
        )
    }

    /// A body that goes where it looks, in a hall with walls, and a demonstration. Attributes of it are worth projecting together.
    fn hall() -> impl Strategy<Value = (Value, Value)> {
        let seen = (0..4_u32, 0..9_u32, prop::option::of(0..4_u32));
        let walls = prop::collection::vec(prop::bool::weighted(0.1), 4 * 9 * 4);
        (walls, prop::collection::vec(seen, 3..16)).prop_map(|(walls, seen)| {
            let state = |x: i32, y: i32, heading: i32| usize::try_from((x * 9 + y) * 4 + heading).unwrap();
            let places = (0..4).flat_map(|x| (0..9).flat_map(move |y| (0..4).map(move |heading| (x, y, heading))));
            let transitions = places.clone().flat_map(|(x, y, heading)| {
                let (ahead_x, ahead_y) = [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)][state(0, 0, heading)];
                let here = state(x, y, heading);
                let is_free = (0..4).contains(&ahead_x) && (0..9).contains(&ahead_y) && !walls[here];
                let ahead = is_free.then(|| json!([here, "forward", state(ahead_x, ahead_y, heading)]));
                ahead.into_iter().chain([json!([here, "left", state(x, y, (heading + 1) % 4)])])
            });
            let model = json!({
                "attributes": [
                    {"name": "x", "kind": "number"},
                    {"name": "y", "kind": "number"},
                    {"name": "heading", "kind": "cyclic", "period": 4},
                ],
                "actions": [{"name": "forward", "cost": 0.3}, {"name": "left", "cost": 0.3}],
                "dynamics": {
                    "kind": "table",
                    "states": places.collect::<Vec<_>>(),
                    "transitions": transitions.collect::<Value>(),
                    "start": 0,
                },
            });
            (model, json!({"model": "hall", "demonstration": seen}))
        })
    }

    /// Whatever takes long is done as soon as may be.
    const IMPATIENT: Patience = Patience {
        few_entries: 0,
        few_entries_per_observation: 8,
        entries_per_expansion: 16,
        min_expansions_before_sweep: 40,
        nodes_per_expansion: u64::MAX,
        grouping: GroupingPatience { min_expansions: 8, expansions_per_transition: 0, expansions_per_entry: 0 },
    };

    proptest! {
        #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn whatever_helps_a_long_search_leads_to_the_optimum_and_to_true_bounds(
            (model, request) in prop_oneof![wander(), hall()],
            helps in prop_oneof![
                Just(IMPATIENT),
                Just(Patience { min_expansions_before_sweep: u64::MAX, ..IMPATIENT }),
                Just(Patience { grouping: GroupingPatience::DEFAULT, ..IMPATIENT }),
            ],
            few in 0..300_u64,
            looseness in prop_oneof![Just(None), Just(Some(1.0)), Just(Some(1.3))],
        ) {
            let mapper = Mapper { patience: helps, ..prepared(&model) };
            let request = read(&mapper, &request);
            let without = Settings { heuristic: HeuristicName::None, ..Settings::default() };
            let optimum = mapper.map(&request.problem, without, &mut Uninterrupted).unwrap().cost.total;
            let close = |cost: f64| (cost - optimum).abs() <= 1e-9 * optimum;
            let settings = Settings { upper_bound: looseness.map(|factor| optimum * factor), ..Settings::default() };
            let map = |budget, interrupt: &mut dyn Interrupt| {
                mapper.map(&request.problem, Settings { budget, ..settings }, interrupt).unwrap()
            };
            let is_true = |mapping: &Mapping| {
                let lower_bound = mapping.lower_bound.unwrap();
                lower_bound <= optimum * (1.0 + 1e-9)
                    && optimum * (1.0 - 1e-9) <= mapping.cost.total
                    && (mapping.status == Status::Bounded || close(mapping.cost.total))
            };

            let mapping = map(Budget::DEFAULT, &mut Uninterrupted);
            prop_assert!(mapping.status == Status::Optimal && close(mapping.cost.total), "{mapping:?}, not {optimum}");
            let mapping = map(Budget { max_expansions: few, ..Budget::DEFAULT }, &mut Uninterrupted);
            prop_assert!(is_true(&mapping) && mapping.n_expanded <= few, "{mapping:?}, of {optimum} and {few}");
            let max_nodes = usize::try_from(few).unwrap();
            let mapping = map(Budget { max_nodes, ..Budget::DEFAULT }, &mut Uninterrupted);
            prop_assert!(is_true(&mapping), "{mapping:?}, of {optimum} in {max_nodes} nodes");
            let mut n_left = few / 8;
            let mapping = map(Budget::DEFAULT, &mut || {
                n_left = n_left.saturating_sub(1);
                if n_left > 0 { Signal::Continue } else { Signal::Finish }
            });
            prop_assert!(is_true(&mapping), "{mapping:?}, of {optimum}");
        }
    }

    #[test]
    fn tables_left_out_at_first_and_sweeps_come_to_the_same_cost_as_a_search_without_heuristic() {
        // The places' table is too large for a first attempt, which is not enough.
        let (mapper, request) = belt(3_000, 30);
        let request = read(&mapper, &request);
        let few = Projected::solve(
            &mapper.projections,
            &request.problem,
            Grouping::WhenItPays,
            Patience::DEFAULT.few_entries,
            &mut Uninterrupted,
        );
        assert!(few.unwrap().unwrap().n_left_out() >= 90_000);
        let map = |heuristic| {
            let settings = Settings { heuristic, ..Settings::default() };
            mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap()
        };
        let (by_default, without) = (map(HeuristicName::Default), map(HeuristicName::None));
        assert_eq!((by_default.cost.total, by_default.status), (without.cost.total, Status::Optimal));

        // Cut short between the two attempts, it keeps what the first one found.
        let optimum = without.cost.total;
        for n_polls in 1..60 {
            let mut n_left = n_polls;
            let mut interrupt = || {
                n_left -= i32::from(n_left > 0);
                if n_left > 0 { Signal::Continue } else { Signal::Finish }
            };
            let mapping = mapper.map(&request.problem, Settings::default(), &mut interrupt).unwrap();
            let lower_bound = mapping.lower_bound.unwrap();
            assert!(lower_bound <= optimum + 1e-9 && optimum <= mapping.cost.total + 1e-9, "after {n_polls} polls");
        }
        for max_expansions in [0, 10, 1_000, 6_000, 10_000] {
            let settings = Settings { budget: Budget { max_expansions, ..Budget::DEFAULT }, ..Settings::default() };
            let mapping = mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap();
            assert!(mapping.n_expanded <= max_expansions && mapping.lower_bound.unwrap() <= optimum + 1e-9);
        }

        let (mapper, request) = belt(6, 40);
        let request = read(&mapper, &request);
        let sweep = |interrupt: &mut dyn Interrupt| mapper.sweep(&request.problem, Budget::DEFAULT, interrupt);
        let swept = sweep(&mut Uninterrupted).unwrap();
        assert_eq!(swept.n_expanded, 60 * 40);
        let Outcome::Mapped(swept) = swept.outcome else { panic!("{swept:?}") };
        let settings = Settings { heuristic: HeuristicName::None, ..Settings::default() };
        let without = mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap();
        assert_eq!((swept.cost.total, swept.status), (without.cost.total, Status::Optimal));
        assert_eq!(swept.lower_bound, Some(swept.cost.total));
        assert_eq!(sweep(&mut || Signal::Finish).unwrap().outcome, Outcome::CutShort);
        assert_eq!(sweep(&mut || Signal::Cancel).unwrap_err(), Cancelled);
    }

    #[test]
    fn an_upper_bound_below_the_optimum_proves_that_there_is_no_such_mapping() {
        let (mapper, request) = belt(6, 40);
        let request = read(&mapper, &request);
        let optimum = mapper.map(&request.problem, Settings::default(), &mut Uninterrupted).unwrap().cost.total;
        for factor in [0.0, 0.5, 0.99, 0.999_999] {
            let upper_bound = Some(optimum * factor);
            let settings = Settings { upper_bound, ..Settings::default() };
            let mapping = mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap();
            assert_eq!(mapping.status, Status::Bounded, "{factor}");
            assert!(mapping.lower_bound.unwrap() <= optimum && optimum <= mapping.cost.total, "{factor}: {mapping:?}");
            assert!(mapping.lower_bound.unwrap() >= optimum * factor);
        }
    }

    #[test]
    fn a_search_goes_on_where_there_is_no_room_for_a_sweep_and_none_is_begun_that_would_take_too_many_expansions() {
        let (mapper, request) = belt(3_000, 30);
        let patience = Patience {
            few_entries: MAX_ENTRIES,
            min_expansions_before_sweep: 100,
            nodes_per_expansion: u64::MAX,
            ..Patience::DEFAULT
        };
        let mapper = Mapper { patience, ..mapper };
        let request = read(&mapper, &request);
        let map = |budget| {
            let settings = Settings { budget, ..Settings::default() };
            mapper.map(&request.problem, settings, &mut Uninterrupted).unwrap()
        };
        let swept = map(Budget::DEFAULT);
        assert_eq!((swept.status, swept.n_expanded), (Status::Optimal, 100 + 30_000 * 30));
        // The newest layer alone has 30,000 nodes.
        let searched = map(Budget { max_nodes: 20_000, ..Budget::DEFAULT });
        assert_eq!((searched.status, searched.cost.total), (Status::Optimal, swept.cost.total));
        assert!(searched.n_expanded < swept.n_expanded / 4, "a few layers, and a search: {}", searched.n_expanded);

        let n_all = swept.n_expanded;
        assert_eq!(map(Budget { max_expansions: n_all, ..Budget::DEFAULT }).n_expanded, n_all);
        let searched = map(Budget { max_expansions: n_all - 1, ..Budget::DEFAULT });
        assert!(searched.status == Status::Optimal && searched.n_expanded < 30_000, "{}", searched.n_expanded);
    }
}
