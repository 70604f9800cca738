//! What was experienced, counted.

use std::collections::{HashMap, HashSet};
use std::io::BufRead;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::values::DistinctStates;
use super::{Batch, Experience};
use crate::attribute::{Schema, Value};
use crate::document::{Faults, Path, Place};
use crate::interrupt::{Interrupt, Interrupted, Meter};
use crate::model::table::{Edges, Table};
use crate::model::{Action, ActionIdx, Limits, Outcome, ReadError, Start, StateIdx};

/// What was experienced with a model, counted: which outcomes its actions had, how often, and at what cost.
///
/// ```
/// use etude_core::interrupt::Uninterrupted;
/// use etude_core::model::{Definition, Limits, Model, Tally};
/// use etude_core::document::{Faults, Place};
/// use serde_json::json;
///
/// let definition = json!({
///     "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on"}], "dynamics": {"kind": "experience"},
/// });
/// let definition = Definition::read(&definition, Limits::DEFAULT, &mut Uninterrupted)?;
/// let mut tally = Tally::new(&definition).expect("it is a model of experience");
/// let batch = json!({"batch": "monday", "transitions": [
///     {"state": {"x": 0}, "action": "on", "next": {"x": 1}, "count": 3},
///     {"state": {"x": 0}, "action": "on", "next": {"x": 0}, "cost": 2.5},
/// ]});
/// let mut faults = Faults::default();
/// let batch = tally.read_batch(&Place::root(&batch), &mut faults, &mut Uninterrupted)?.expect("it has no faults");
/// tally.add(&batch);
/// let table = tally.definition(&mut Uninterrupted)?.expect("there are states");
/// let model = Model::compile(&table, Limits::DEFAULT, &mut Uninterrupted)?;
/// assert_eq!(model.graph().probabilities(0), [0.25, 0.75]);
/// # Ok::<(), etude_core::model::CompileError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Tally {
    pub(super) experience: Arc<Experience>,
    /// By first appearance.
    pub(super) states: DistinctStates,
    /// Outcomes of states and actions, by first appearance.
    pub(super) outcomes: Vec<SeenOutcome>,
    /// Where an outcome stands. Hashed with a seed, as clients choose what follows what.
    known: HashMap<(StateIdx, ActionIdx, StateIdx), u32>,
    pairs: HashMap<(StateIdx, ActionIdx), Pair>,
    pub(super) n_unsafe: usize,
    /// Of the pairs that were seen often enough: their outcomes, and how many of them have several.
    n_transitions: usize,
    n_stochastic: usize,
}

/// An outcome that was seen.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub(super) struct SeenOutcome {
    pub(super) from: StateIdx,
    pub(super) action: ActionIdx,
    pub(super) to: StateIdx,
    /// How often, at least once.
    pub(super) count: u64,
    /// How often its cost was told.
    pub(super) n_costs: u64,
    /// What it cost first, and in all when it was told.
    pub(super) cost: f64,
    pub(super) cost_sum: f64,
    /// Whether it cost the same each time.
    pub(super) is_same: bool,
}

/// A state and an action that were seen.
#[derive(Clone, Copy, Debug, Default)]
struct Pair {
    /// How often, with whatever outcome.
    count: u64,
    n_outcomes: usize,
}

/// How much there is of what was experienced.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExperienceCounts {
    /// States: those that were seen, and those to start in that were not.
    pub n_states: usize,
    /// Outcomes of states and actions that were seen often enough.
    pub n_transitions: usize,
    /// Of how many of these states and actions there are several outcomes.
    pub n_stochastic: usize,
    /// States that were seen and must never be entered.
    pub n_unsafe: usize,
}

impl Tally {
    /// Nothing experienced yet.
    pub(in crate::model) fn of(experience: Arc<Experience>) -> Self {
        Self {
            states: DistinctStates::new(experience.schema.len()),
            experience,
            outcomes: Vec::new(),
            known: HashMap::new(),
            pairs: HashMap::new(),
            n_unsafe: 0,
            n_transitions: 0,
            n_stochastic: 0,
        }
    }

    /// Reads a batch: `{"batch": .., "transitions": [{"state", "action", "next", "count", "cost"}]}`. `None`: at least one fault was noted.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    pub fn read_batch(
        &self,
        place: &Place<'_, '_>,
        faults: &mut Faults,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Batch>, Interrupted> {
        Batch::read(&self.experience, place, &mut Meter::new(interrupt, POLL_EVERY), faults)
    }

    /// Reads a batch called `id` from lines of JSON (NDJSON), a transition each: `{"state", "action", "next", "count", "cost"}`. `None`: at least one
    /// fault was noted, with its line.
    ///
    /// # Errors
    ///
    /// [`ReadError`] if `lines` could not be read, or `interrupt` said so.
    pub fn read_lines(
        &self,
        id: &str,
        lines: impl BufRead,
        faults: &mut Faults,
        interrupt: &mut dyn Interrupt,
    ) -> Result<Option<Batch>, ReadError> {
        Batch::read_lines(&self.experience, id, lines, &mut Meter::new(interrupt, POLL_EVERY), faults)
    }

    /// Notes that there would be more states or transitions than `limits` allow, if that is so once `batch` is added.
    pub fn check(&self, batch: &Batch, limits: Limits, faults: &mut Faults) {
        let place = Path::Member(&Path::Root, "transitions");
        let mut note = |n: usize, most: usize, what: &str| {
            if n > most {
                faults.note_at(&place, format!("with these, the model has {n} {what}, and at most {most} are allowed"));
            }
        };
        // Most batches are far from that, and all of one may be known.
        if (self.states.len() + batch.states.len()) as usize <= limits.max_states
            && self.outcomes.len() + batch.len() <= limits.max_transitions
        {
            return;
        }
        let numbers = self.numbers_of(batch);
        let n_new = numbers.iter().filter(|number| number.is_none()).count();
        note(self.states.len() as usize + n_new, limits.max_states, "states");
        let new: HashSet<(StateIdx, ActionIdx, StateIdx)> = batch
            .transitions
            .iter()
            .map(|seen| (seen.from, seen.action, seen.to))
            .filter(|(from, action, to)| {
                let known = numbers[*from as usize].zip(numbers[*to as usize]);
                !known.is_some_and(|(from, to)| self.known.contains_key(&(from, *action, to)))
            })
            .collect();
        note(self.outcomes.len() + new.len(), limits.max_transitions, "transitions");
    }

    /// The number of each state of `batch` here, if it has one.
    fn numbers_of(&self, batch: &Batch) -> Vec<Option<StateIdx>> {
        let states = 0..batch.states.len();
        states.map(|state| self.states.find(batch.states.values(state))).collect()
    }

    /// The attributes of its states.
    #[must_use]
    pub fn schema(&self) -> &Schema {
        &self.experience.schema
    }

    /// What the body can do.
    #[must_use]
    pub fn actions(&self) -> &[Action] {
        &self.experience.actions
    }

    /// Counts a batch that was read for this.
    ///
    /// # Panics
    ///
    /// If it was read for a model with other attributes or actions.
    pub fn add(&mut self, batch: &Batch) {
        let numbers: Vec<StateIdx> = (0..batch.states.len())
            .map(|state| {
                let n_before = self.states.len();
                let number = self.states.number_of(batch.states.values(state).cloned());
                let unsafe_states = &self.experience.unsafe_states;
                if self.states.len() > n_before && !unsafe_states.is_empty() {
                    let values: Vec<_> = batch.states.values(state).cloned().collect();
                    self.n_unsafe += usize::from(unsafe_states.contains(&values));
                }
                number
            })
            .collect();
        for seen in &batch.transitions {
            let (from, to) = (numbers[seen.from as usize], numbers[seen.to as usize]);
            self.count((from, seen.action, to), seen.count, seen.own_cost.get());
        }
    }

    fn count(&mut self, (from, action, to): (StateIdx, ActionIdx, StateIdx), count: u64, cost: Option<f64>) {
        #[expect(clippy::cast_possible_truncation, reason = "limits keep transitions below 2^32")]
        let new = self.outcomes.len() as u32;
        let at = *self.known.entry((from, action, to)).or_insert(new) as usize;
        let is_new = at == self.outcomes.len();
        if is_new {
            self.outcomes.push(SeenOutcome {
                from,
                action,
                to,
                count: 0,
                n_costs: 0,
                cost: 0.0,
                cost_sum: 0.0,
                is_same: true,
            });
        }
        let outcome = &mut self.outcomes[at];
        outcome.count = outcome.count.saturating_add(count);
        if let Some(cost) = cost {
            if outcome.n_costs == 0 {
                outcome.cost = cost;
            }
            outcome.n_costs = outcome.n_costs.saturating_add(count);
            outcome.cost_sum += float(count) * cost;
            outcome.is_same &= outcome.cost.to_bits() == cost.to_bits();
        }
        self.count_pair((from, action), count, is_new);
    }

    /// Notes the outcome at `at` among the states and actions, to which it is new; says whether it is.
    pub(super) fn note_outcome(&mut self, at: usize) -> bool {
        let SeenOutcome { from, action, to, count, .. } = self.outcomes[at];
        #[expect(clippy::cast_possible_truncation, reason = "limits keep transitions below 2^32")]
        let is_new = self.known.insert((from, action, to), at as u32).is_none();
        self.count_pair((from, action), count, is_new);
        is_new
    }

    /// Counts a state and an action, with an outcome that may be new.
    fn count_pair(&mut self, pair: (StateIdx, ActionIdx), count: u64, is_new: bool) {
        let pair = self.pairs.entry(pair).or_default();
        let before = pair.present(self.experience.min_count);
        pair.count = pair.count.saturating_add(count);
        pair.n_outcomes += usize::from(is_new);
        let after = pair.present(self.experience.min_count);
        self.n_transitions += after - before;
        self.n_stochastic += usize::from(after > 1) - usize::from(before > 1);
    }

    /// How much there is.
    #[must_use]
    pub fn counts(&self) -> ExperienceCounts {
        ExperienceCounts {
            n_states: self.states.len() as usize + self.unseen_start().count(),
            n_transitions: self.n_transitions,
            n_stochastic: self.n_stochastic,
            n_unsafe: self.n_unsafe,
        }
    }

    /// Start states that were not seen.
    fn unseen_start(&self) -> impl Iterator<Item = &Vec<Value>> {
        self.experience.start.iter().filter(|values| self.states.find(values.iter()).is_none())
    }

    /// What was experienced, as a table; `None` if there is no state to start in.
    ///
    /// # Errors
    ///
    /// What `interrupt` said, if that was not to continue.
    ///
    /// # Panics
    ///
    /// Never: frequencies sum to 1.
    pub(in crate::model) fn table(&self, interrupt: &mut dyn Interrupt) -> Result<Option<Table>, Interrupted> {
        let Experience { schema, actions, min_count, start, unsafe_states, .. } = &*self.experience;
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let mut edges = Edges::default();
        for seen in &self.outcomes {
            meter.spend_or_stop(1)?;
            let pair = self.pairs[&(seen.from, seen.action)];
            if pair.count < *min_count {
                continue;
            }
            let probability = if pair.n_outcomes == 1 { 1.0 } else { ratio(seen.count, pair.count) };
            let cost = seen.mean_cost(actions[usize::from(seen.action)].cost);
            edges.push(seen.from, seen.action, Outcome { to: seen.to, probability, cost });
        }
        let uneven = edges.settle(actions, &mut meter)?;
        assert_eq!(uneven, [], "frequencies sum to 1");
        let mut states = self.states.clone();
        let start: Vec<StateIdx> = start.iter().map(|values| states.number_of(values.iter().cloned())).collect();
        let is_unsafe = |state: &StateIdx| {
            !unsafe_states.is_empty() && unsafe_states.contains(&states.values(*state).cloned().collect::<Vec<_>>())
        };
        let unsafe_states: Vec<StateIdx> = (0..states.len()).filter(is_unsafe).collect();
        if unsafe_states.len() == states.len() as usize {
            return Ok(None);
        }
        let start = match start.as_slice() {
            [] => Start::Any,
            [one] => Start::State(*one),
            _ => Start::Candidates(start),
        };
        Ok(Some(Table::new(schema.clone(), actions.clone(), states.into_states(), edges, start, unsafe_states)))
    }

    /// How many outcomes of states and actions were seen, whether often enough or not.
    #[must_use]
    pub fn n_outcomes(&self) -> usize {
        self.outcomes.len()
    }

    /// About how much memory it takes, in bytes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.states.size_bytes() + self.outcomes.len() * OUTCOME_BYTES
    }

    /// About how much more it takes at most once `batch` is added, in bytes.
    #[must_use]
    pub fn growth_bytes(batch: &Batch) -> usize {
        batch.states.size_bytes() + batch.len() * OUTCOME_BYTES
    }
}

/// How many outcomes are looked at between two looks at the interrupt: less than a millisecond.
const POLL_EVERY: u64 = 4096;

/// What an outcome takes, with its place, its pair, and room to grow.
const OUTCOME_BYTES: usize = 2 * (size_of::<SeenOutcome>() + size_of::<[u32; 4]>() + size_of::<([u32; 2], Pair)>());

impl Pair {
    /// How many outcomes the model has of it.
    fn present(&self, min_count: u64) -> usize {
        if self.count < min_count { 0 } else { self.n_outcomes }
    }
}

impl SeenOutcome {
    /// What it costs, if it was told at least once what it did. Where it was not told, it was what the action costs.
    fn mean_cost(&self, action_cost: f64) -> Option<f64> {
        let n_untold = self.count - self.n_costs;
        match self.n_costs {
            0 => None,
            // Sums are rounded; what costs the same each time costs that.
            _ if self.is_same && n_untold == 0 => Some(self.cost),
            _ => Some((self.cost_sum + float(n_untold) * action_cost) / float(self.count)),
        }
    }
}

fn ratio(part: u64, whole: u64) -> f64 {
    float(part) / float(whole)
}

#[expect(clippy::cast_precision_loss, reason = "what is beyond 2^53 is rounded")]
fn float(count: u64) -> f64 {
    count as f64
}
