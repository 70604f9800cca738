//! Bounds from a group of attributes that are projected together.
//!
//! The [projections on single attributes](super::projection) do not see that some attributes change at few places only: gold is taken
//! wherever one stands, for the cost of an action. Where extra actions pay the distance, a search is seldom misled by that for long: if so, the
//! cheapest mapping that it has found costs far more than what it has shown that all cost. Where they pay little of it, it looks at all ways
//! that cost a few actions more than the bound. So, if it takes long, attributes are projected together of which some [change at few values of others](group). States with the same values of these are a *class*. A transition costs a class
//! what the group's attributes pay of it in their own projections, so the bounds of the others may still be added; and as the classes are
//! followed exactly, they cost at least the sum of what the group's attributes cost alone.
//!
//! To solve this for all classes takes longer than what it saves. It is [searched](solving) instead, from the end back, as far as the
//! search of the model asks: in turn, each search is guided by the other way's costs (Switchback: Larsen, Burns, Ruml & Holte 2010). The
//! estimates of the backward search are what single attributes cost [from the start on](forward). The search of the model goes on from where
//! it is; the estimate of a node is raised when its turn comes.
//!
//! Attributes that weigh nothing can matter as well: which piece of gold is still there tells how often it can be taken. They are found
//! where they are missed, on the cheapest way through the classes: if an attribute changes there from a value that it no longer has, it is
//! added to the group (counterexamples refine abstractions so: Clarke, Grumberg, Jha, Lu & Veith 2000; in planning, Seipp & Helmert 2018).

mod forward;
mod group;
mod open;
mod solving;

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use rustc_hash::{FxHashMap, FxHashSet};

use super::projected::Projected;
use super::projection::{ChangeSets, Projections, ValueIdx};
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::Problem;
use crate::model::{ActionIdx, Model, OwnCost, Rows, StateIdx};
pub(in crate::mapping) use solving::{Abstracted, KnownCosts};

/// The number of a class.
type ClassIdx = u32;

/// A listed model, projected on a group of its attributes. Depends on neither demonstrations nor weights.
#[derive(Debug)]
struct Abstraction {
    /// The group, ascending.
    positions: Vec<usize>,
    /// By state.
    classes: Vec<ClassIdx>,
    /// The values of each class. Shape `[n_classes, positions.len()]`.
    values: Vec<ValueIdx>,
    /// Distinct ways to change the class, by the class to which they lead.
    ways: Rows<AbstractWay>,
    /// The states of one of the transitions of each way.
    states: Vec<(StateIdx, StateIdx)>,
    /// The kinds of ways.
    kinds: Vec<WayKind>,
    /// Distinct sets of [projections](Projections::attributes) that some of these change.
    change_sets: Vec<Vec<u16>>,
}

/// A way from one class to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct AbstractWay {
    from: ClassIdx,
    /// The number of its kind.
    kind: u32,
}

/// All that tells what a way costs the group.
#[derive(Clone, Copy, Debug)]
struct WayKind {
    change_set: u32,
    action: ActionIdx,
    own_cost: OwnCost,
}

impl WayKind {
    /// What tells it from other kinds.
    fn key(&self) -> (u32, ActionIdx, Option<u64>) {
        (self.change_set, self.action, self.own_cost.get().map(f64::to_bits))
    }
}

/// A transition that changes the class, from one that is known.
#[derive(Clone, Copy, Debug)]
struct ClassChange {
    way: AbstractWay,
    states: (StateIdx, StateIdx),
}

impl Abstraction {
    /// Projects `model` on the attributes at `positions`; `None` if they have more than `max_classes`.
    fn new(
        model: &Model,
        projections: &Projections,
        positions: Vec<usize>,
        max_classes: usize,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Self>, Interrupted> {
        let (states, graph) = (model.states(), model.graph());
        let sizes = positions.iter().map(|position| states.domain(*position).len() as u64);
        if sizes.clone().try_fold(1_u64, u64::checked_mul).is_none() {
            return Ok(None);
        }
        let mut numbers: FxHashMap<u64, ClassIdx> = FxHashMap::default();
        let (mut classes, mut values) = (Vec::with_capacity(states.len() as usize), Vec::new());
        let mut n_classes = 0;
        for state in 0..states.len() {
            meter.spend_or_stop(positions.len() as u64)?;
            let row = states.row(state);
            let digits = positions.iter().zip(sizes.clone());
            let key = digits.fold(0, |key, (position, size)| key * size + u64::from(row[*position]));
            let class = *numbers.entry(key).or_insert(n_classes);
            if class == n_classes {
                if n_classes as usize == max_classes {
                    return Ok(None);
                }
                n_classes += 1;
                values.extend(positions.iter().map(|position| row[*position]));
            }
            classes.push(class);
        }
        let mut change_sets = ChangeSets::default();
        let mut kinds = Vec::new();
        let mut numbers: FxHashMap<_, u32> = FxHashMap::default();
        // Most transitions differ from others in other attributes only.
        let (mut known, mut entries) = (FxHashSet::default(), Vec::new());
        for from in 0..states.len() {
            let own_costs = graph.own_costs(from);
            for (n, transition) in graph.successors(from).iter().enumerate() {
                meter.spend_or_stop(1)?;
                let [class, class_after] = [from, transition.to].map(|state| classes[state as usize]);
                if class == class_after {
                    continue;
                }
                let (row, row_after) = (states.row(from), states.row(transition.to));
                let numbered = (0..).zip(&projections.attributes);
                let changed = numbered.filter(|(_, own)| row[own.position] != row_after[own.position]);
                let kind = WayKind {
                    change_set: change_sets.number_of(changed.map(|(number, _)| number)),
                    action: transition.action,
                    own_cost: own_costs.get(n).copied().unwrap_or(OwnCost::NONE),
                };
                #[expect(clippy::cast_possible_truncation, reason = "no more than there are transitions")]
                let next = kinds.len() as u32;
                let number = *numbers.entry(kind.key()).or_insert(next);
                if number == next {
                    kinds.push(kind);
                }
                let way = AbstractWay { from: class, kind: number };
                if known.insert((class_after, way)) {
                    entries.push((class_after, ClassChange { way, states: (from, transition.to) }));
                }
            }
        }
        let n_classes = n_classes as usize;
        drop(known);
        let mut changes = Rows::try_of_entries(n_classes, entries.iter().copied(), || meter.spend_or_stop(1))?;
        for class in 0..n_classes {
            let into = changes.of_mut(class);
            meter.spend_or_stop(1 + into.len() as u64)?;
            into.sort_unstable_by_key(|change| change.way);
        }
        let states = changes.items().iter().map(|change| change.states).collect();
        let (ways, change_sets) = (changes.map(|change| change.way), change_sets.sets);
        Ok(Some(Self { positions, classes, values, ways, states, kinds, change_sets }))
    }

    fn n_classes(&self) -> usize {
        self.ways.n_rows()
    }

    fn size_bytes(&self) -> usize {
        size_of_val(self.classes.as_slice())
            + size_of_val(self.values.as_slice())
            + size_of_val(self.states.as_slice())
            + self.ways.size_bytes()
    }
}

/// A group, and its abstraction, if it does not have too many classes.
type Kept = (Vec<usize>, Option<Arc<Abstraction>>);

/// What an abstraction may take.
#[derive(Clone, Copy, Debug)]
pub(in crate::mapping) struct AbstractionRoom {
    pub(in crate::mapping) n_tries: usize,
    pub(in crate::mapping) max_classes: usize,
    pub(in crate::mapping) max_bytes: usize,
}

/// The abstractions of a model that searches asked for.
#[derive(Debug, Default)]
pub(in crate::mapping) struct Abstractions {
    /// See [`group::coupled`].
    coupled: OnceLock<Vec<(usize, usize)>>,
    /// The latest last.
    kept: Mutex<Vec<Kept>>,
}

impl Abstractions {
    /// Most that are kept. Few problems of a model differ in which attributes matter.
    const MAX_KEPT: usize = 4;

    /// An abstraction for `problem`, of a listed model; `None` if no attributes that matter are coupled, or the group of those has more than
    /// `max_classes` or would take more than `max_bytes`. Up to `n_tries` are made, each with a larger group, and all but the last one of
    /// these searched as far as to tell what mappings cost at least, and which attributes the group misses.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(in crate::mapping) fn solve<'p>(
        &self,
        projections: &Projections,
        problem: &'p Problem<'p>,
        projected: &'p Projected<'p>,
        AbstractionRoom { n_tries, max_classes, max_bytes }: AbstractionRoom,
        costs: &mut KnownCosts,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Abstracted<'p>>, Interrupted> {
        let coupled = if let Some(coupled) = self.coupled.get() {
            coupled
        } else {
            let found = group::coupled(problem.model, meter)?;
            self.coupled.get_or_init(|| found)
        };
        let mut positions = group::of_problem(problem, coupled);
        let mut solved: Option<Abstracted<'p>> = None;
        for n_left in (0..n_tries).rev() {
            if positions.len() < 2 {
                break;
            }
            let Some(abstraction) = self.get(problem.model, projections, &positions, max_classes, meter)? else {
                break;
            };
            if Abstracted::bytes_for(abstraction.n_classes(), problem) > max_bytes {
                break;
            }
            let costs = solved.take().map_or_else(|| std::mem::take(costs), Abstracted::into_costs);
            let abstracted = Abstracted::new(abstraction, projections, problem, projected, costs, meter)?;
            let abstracted = solved.insert(abstracted);
            let missed = if n_left > 0 { abstracted.solve_from_start(meter)? } else { Vec::new() };
            if missed.is_empty() {
                break;
            }
            positions.extend(missed);
            positions.sort_unstable();
        }
        Ok(solved)
    }

    /// The abstraction with the group at `positions`, made unless it is kept.
    fn get(
        &self,
        model: &Model,
        projections: &Projections,
        positions: &[usize],
        max_classes: usize,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Arc<Abstraction>>, Interrupted> {
        let kept = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = kept().iter().find(|(group, _)| group == positions) {
            return Ok(known.clone());
        }
        // Two searches that come at the same time may both do the work, with the same result.
        let made = Abstraction::new(model, projections, positions.to_vec(), max_classes, meter)?.map(Arc::new);
        let mut kept = kept();
        if kept.len() == Self::MAX_KEPT {
            kept.remove(0);
        }
        kept.push((positions.to_vec(), made.clone()));
        Ok(made)
    }

    /// Those of a model that has these pairs of coupled attributes, whatever its transitions are.
    #[cfg(test)]
    pub(in crate::mapping) fn coupling(coupled: Vec<(usize, usize)>) -> Self {
        Self { coupled: OnceLock::from(coupled), ..Self::default() }
    }

    /// Approximate size in memory, in bytes.
    pub(in crate::mapping) fn size_bytes(&self) -> usize {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.iter().filter_map(|(_, abstraction)| abstraction.as_ref()).map(|own| own.size_bytes()).sum()
    }

    /// Forgets them. They are made again when searches ask for them.
    pub(in crate::mapping) fn release(&self) {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner).clear();
    }
}

#[cfg(test)]
mod tests;
