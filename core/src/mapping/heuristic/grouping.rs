//! Which attributes are projected together.
//!
//! Attributes belong together if the one says what the other can do: the position changes as the heading allows, a piece of
//! gold is taken where it lies. So of each change of an attribute (from a value to another by an action) it is counted with
//! how many values of every other attribute it occurs; if these are far fewer than they would be if the two were independent,
//! the other *restricts* it, unless that is so of few of the attribute's changes. Groups are merged greedily, those first that restrict each other most, as far as a limit on
//! the number of classes allows.

use std::cmp::{Ordering, Reverse};

use rustc_hash::{FxHashMap, FxHashSet};

use crate::interrupt::{Interrupt, Interrupted, Meter};
use crate::model::{ActionIdx, Model, StateIdx};

/// A partition of attributes: their positions, ascending in each group.
pub(super) type Partition = Vec<Vec<usize>>;

/// How many classes a group may have, by level.
const MOST_CLASSES: [usize; 4] = [1 << 12, 1 << 16, 1 << 20, 1 << 24];

/// Most states whose transitions are looked at, and most looks at an attribute of one.
const MAX_STATES: usize = 1 << 17;
const MAX_LOOKS: usize = 1 << 21;

/// The partitions of the attributes of `model` that vary, from the finest to the coarsest, without that into single attributes.
/// Deterministic.
///
/// # Errors
///
/// What `interrupt` said, if that was not to continue.
pub(super) fn choose(model: &Model, interrupt: &mut dyn Interrupt) -> Result<Vec<Partition>, Interrupted> {
    let varying: Vec<usize> = (0..model.schema().len()).filter(|at| model.states().domain(*at).len() > 1).collect();
    let restrictions = Restrictions::new(model, interrupt)?;
    let sizes: Vec<usize> = (0..model.schema().len()).map(|at| model.states().domain(at).len()).collect();
    let alone: Partition = varying.iter().map(|at| vec![*at]).collect();
    let mut levels = vec![alone.clone()];
    for most in MOST_CLASSES {
        let mut partition = alone.clone();
        merge(&mut partition, &restrictions, &sizes, most);
        if levels.last() != Some(&partition) {
            levels.push(partition);
        }
    }
    levels.remove(0);
    Ok(levels)
}

/// About how much memory that takes, in bytes: what is seen of the changes of some states.
pub(super) fn bytes_for(model: &Model) -> usize {
    /// A change, where it was seen and its place in a hash table.
    const SIGHTING_BYTES: usize = 160;
    /// How many attributes a transition changes, about.
    const N_CHANGES: usize = 2;
    let n_states = model.graph().n_states();
    let n_sampled = n_states.min(MAX_STATES).min(MAX_LOOKS / model.schema().len().max(1));
    let n_each = model.graph().n_transitions().div_ceil(n_states.max(1));
    n_sampled * n_each * N_CHANGES * SIGHTING_BYTES
}

/// Merges the groups that restrict each other most as long as they have at most `most` classes; those with fewer classes
/// among equals, then the earlier ones.
fn merge(partition: &mut Partition, restrictions: &Restrictions, sizes: &[usize], most: usize) {
    let n_classes = |group: &[usize]| group.iter().fold(1usize, |product, at| product.saturating_mul(sizes[*at]));
    loop {
        let groups = &*partition;
        let pairs = (0..groups.len()).flat_map(|second| (0..second).map(move |first| (first, second)));
        let candidates = pairs.filter_map(|(first, second)| {
            let product = n_classes(&groups[first]).saturating_mul(n_classes(&groups[second]));
            let score = restrictions.between(&groups[first], &groups[second]);
            (product <= most && score > Score::default()).then_some((score, Reverse((product, first, second))))
        });
        let best = candidates.max_by(|a, b| a.partial_cmp(b).unwrap_or(Ordering::Equal));
        let Some((_, Reverse((_, first, second)))) = best else { break };
        let merged = partition.remove(second);
        partition[first].extend(merged);
        partition[first].sort_unstable();
    }
}

/// How much attributes restrict each other's changes.
struct Restrictions {
    n_attributes: usize,
    /// What part of all transitions change the one attribute but cannot for what the other is. Shape
    /// `[n_attributes, n_attributes]`.
    scores: Vec<f64>,
    /// Whether each attribute weighs something, if a request does not say otherwise.
    weighs: Vec<bool>,
}

/// How much two groups restrict each other; those that do so in attributes that weigh something come first.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd)]
struct Score {
    /// As to changes of attributes that weigh something.
    weighing: f64,
    /// As to changes of the others.
    others: f64,
}

/// A change of an attribute by an action.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Change {
    attribute: usize,
    from: u32,
    to: u32,
    action: ActionIdx,
}

/// Where a change was seen.
#[derive(Default)]
struct Sightings {
    n: u32,
    /// The first [`MAX_SIGHTINGS`].
    states: Vec<StateIdx>,
}

/// How many sightings of a change are compared: with fewer than the least nothing can be said.
const MAX_SIGHTINGS: usize = 64;
const MIN_SIGHTINGS: usize = 8;

/// A part of an attribute's changes that may well be restricted by chance, of the few that were seen only a few times.
const CHANCE: f64 = 0.01;

/// A change is restricted if it goes with at most this part of the values that are expected: that is hardly ever chance.
const FEW: f64 = 0.6;

impl Restrictions {
    fn new(model: &Model, interrupt: &mut dyn Interrupt) -> Result<Self, Interrupted> {
        /// How many values are looked at between two looks at the interrupt: about a millisecond.
        const POLL_EVERY: u64 = 1 << 14;
        let n_attributes = model.schema().len();
        let states = sample(model.graph().n_states(), MAX_STATES.min(MAX_LOOKS / n_attributes.max(1)));
        let mut meter = Meter::new(interrupt, POLL_EVERY);
        let mut sightings: FxHashMap<Change, Sightings> = FxHashMap::default();
        let mut n_transitions = 0u32;
        for state in &states {
            let row = model.states().row(*state);
            for transition in model.graph().successors(*state) {
                meter.spend_or_stop(n_attributes as u64)?;
                n_transitions += 1;
                let row_after = model.states().row(transition.to);
                for attribute in (0..n_attributes).filter(|at| row[*at] != row_after[*at]) {
                    let (from, to) = (row[attribute], row_after[attribute]);
                    let seen = sightings.entry(Change { attribute, from, to, action: transition.action }).or_default();
                    seen.n += 1;
                    if seen.states.len() < MAX_SIGHTINGS {
                        seen.states.push(*state);
                    }
                }
            }
        }
        // Sums of floats depend on their order, and that of a hash map must not reach the results.
        let mut sightings: Vec<(Change, Sightings)> = sightings.into_iter().collect();
        sightings.retain(|(_, seen)| seen.states.len() >= MIN_SIGHTINGS);
        sightings.sort_unstable_by_key(|(change, _)| *change);
        let mut scores = vec![0.0; n_attributes * n_attributes];
        let mut n_changes = vec![0u32; n_attributes];
        for (change, seen) in &sightings {
            n_changes[change.attribute] += seen.n;
        }
        for other in 0..n_attributes {
            let mut expected = Expected::new(states.iter().map(|state| model.states().row(*state)[other]));
            for (change, seen) in sightings.iter().filter(|(change, _)| change.attribute != other) {
                meter.spend_or_stop(seen.states.len() as u64)?;
                let values: FxHashSet<u32> =
                    seen.states.iter().map(|state| model.states().row(*state)[other]).collect();
                #[expect(clippy::cast_precision_loss, reason = "at most `MAX_SIGHTINGS`")]
                let part = values.len() as f64 / expected.n_distinct(seen.states.len());
                if part <= FEW {
                    scores[change.attribute * n_attributes + other] +=
                        f64::from(seen.n) * (1.0 - part) / f64::from(n_transitions);
                }
            }
        }
        for (scores, n_changes) in scores.chunks_exact_mut(n_attributes).zip(n_changes) {
            let chance = f64::from(n_changes) * CHANCE / f64::from(n_transitions);
            scores.iter_mut().filter(|score| **score < chance).for_each(|score| *score = 0.0);
        }
        let weighs = model.schema().attributes().iter().map(|attribute| attribute.weight > 0.0);
        Ok(Self { n_attributes, scores, weighs: weighs.collect() })
    }

    /// How much the attributes of two groups restrict each other. Nothing if none of them weighs anything: such a group has
    /// nothing to tell.
    fn between(&self, group: &[usize], other: &[usize]) -> Score {
        let mut sum = Score::default();
        if !group.iter().chain(other).any(|at| self.weighs[*at]) {
            return sum;
        }
        for (a, b) in group.iter().flat_map(|a| other.iter().flat_map(|b| [(*a, *b), (*b, *a)])) {
            let score = self.scores[a * self.n_attributes + b];
            *if self.weighs[a] { &mut sum.weighing } else { &mut sum.others } += score;
        }
        sum
    }
}

/// How many distinct values of an attribute are to be expected if it does not matter.
struct Expected {
    /// How often each value occurs.
    counts: Vec<u32>,
    n: u32,
    /// By how many times one looks.
    n_distinct: [Option<f64>; MAX_SIGHTINGS + 1],
}

impl Expected {
    fn new(values: impl Iterator<Item = u32>) -> Self {
        let mut counts: FxHashMap<u32, u32> = FxHashMap::default();
        let mut n = 0;
        for value in values {
            *counts.entry(value).or_default() += 1;
            n += 1;
        }
        let mut counts: Vec<u32> = counts.into_values().collect();
        counts.sort_unstable();
        Self { counts, n, n_distinct: [None; MAX_SIGHTINGS + 1] }
    }

    fn n_distinct(&mut self, n_looks: usize) -> f64 {
        let Self { counts, n, n_distinct } = self;
        *n_distinct[n_looks].get_or_insert_with(|| {
            #[expect(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "at most `MAX_SIGHTINGS`")]
            let n_looks = n_looks as i32;
            let is_seen = |count: &u32| 1.0 - (1.0 - f64::from(*count) / f64::from(*n)).powi(n_looks);
            counts.iter().fold(0.0, |sum, count| sum + is_seen(count))
        })
    }
}

/// About `most` of `n_states` states, or all, each once. They are scattered and come in no order, as that of a model's states
/// has a structure of its own.
fn sample(n_states: usize, most: usize) -> Vec<StateIdx> {
    #[expect(clippy::cast_possible_truncation, reason = "states are counted in u32")]
    let n_states = n_states as StateIdx;
    let mut states: Vec<StateIdx> = if n_states as usize <= most {
        (0..n_states).collect()
    } else {
        #[expect(clippy::cast_possible_truncation, reason = "less than `n_states`")]
        (0..most as u64).map(|n| (scatter(n) % u64::from(n_states)) as StateIdx).collect()
    };
    states.sort_unstable();
    states.dedup();
    states.sort_unstable_by_key(|state| scatter(u64::from(*state)));
    states
}

/// The finalizer of splitmix64 (Steele, Lea & Flood 2014), a bijection whose values look random.
fn scatter(n: u64) -> u64 {
    let mut z = n.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::model::{Definition, Limits};

    /// The attributes that are grouped, by name, level by level.
    fn groups(model: &Value) -> Vec<Vec<String>> {
        let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let name = |at: &usize| model.schema().attributes()[*at].name.clone();
        let join = |group: &Vec<usize>| group.iter().map(name).collect::<Vec<_>>().join(" ");
        let levels = choose(&model, &mut Uninterrupted).unwrap();
        for (level, most) in levels.iter().zip(MOST_CLASSES.iter().skip(MOST_CLASSES.len() - levels.len())) {
            let n_classes =
                |group: &[usize]| group.iter().map(|at| model.states().domain(*at).len()).product::<usize>();
            assert!(level.iter().all(|group| n_classes(group) <= *most), "{level:?}");
            let mut all = level.concat();
            all.sort_unstable();
            let varying = (0..model.schema().len()).filter(|at| model.states().domain(*at).len() > 1);
            assert!(varying.eq(all), "each attribute that varies is in one group: {level:?}");
        }
        levels.iter().map(|level| level.iter().map(join).collect()).collect()
    }

    #[test]
    fn on_a_cave_position_and_heading_belong_together_and_then_what_lies_there() {
        let acts = ["forward", "turn_left", "turn_right", "grab"];
        let gold = [[1, 2], [9, 3], [4, 8], [13, 13], [2, 12]];
        let model = json!({
            "actions": acts.map(|act| json!({"name": act})),
            "dynamics": {"kind": "wumpus", "width": 16, "height": 16, "pits": [[3, 3]], "wumpi": [], "gold": gold,
                "start": {"x": 0, "y": 0, "heading": "east"}, "arrows": 0},
        });
        let levels = groups(&model);
        let together = |level: &Vec<String>, names: &[&str]| {
            level.iter().any(|group| names.iter().all(|name| group.split(' ').any(|own| own == *name)))
        };
        assert!(levels.iter().all(|level| together(level, &["x", "y", "heading"])), "{levels:?}");
        // Of 1024 classes as they are; then with how much gold there is, which makes them 6 times as many, and with as many
        // pieces as fit, each of which doubles them.
        let of_gold = |level: &Vec<String>| {
            let group = level.iter().find(|group| group.contains("heading"))?;
            Some(group.split(' ').filter(|name| name.starts_with("gold")).count())
        };
        assert_eq!(levels.iter().map(of_gold).collect::<Vec<_>>(), [Some(0), Some(1 + 3), Some(1 + 5)]);
    }

    /// A machine of two dials that turn independently, of 12 and 9 steps, perhaps with a lamp that never goes on or off.
    fn dials(lamp: bool) -> Value {
        let n_lamps = if lamp { 2 } else { 1 };
        let index = |a: usize, b: usize, c: usize| (a * 9 + b) * n_lamps + c;
        let mut states = Vec::new();
        let mut transitions = Vec::new();
        for (a, b, c) in (0..12).flat_map(|a| (0..9).flat_map(move |b| (0..n_lamps).map(move |c| (a, b, c)))) {
            states.push(json!([a, b, c]));
            transitions.push(json!([index(a, b, c), 0, index((a + 1) % 12, b, c)]));
            transitions.push(json!([index(a, b, c), 1, index(a, (b + 1) % 9, c)]));
        }
        json!({
            "attributes": (["a", "b", "lamp"]).map(|name| json!({"name": name, "kind": "number"})),
            "actions": [{"name": "turn_a"}, {"name": "turn_b"}],
            "dynamics": {"kind": "table", "states": states, "transitions": transitions},
        })
    }

    #[test]
    fn independent_attributes_stay_apart() {
        assert!(groups(&dials(false)).is_empty());
        assert!(groups(&dials(true)).is_empty());
    }

    #[test]
    fn what_restricts_few_changes_by_chance_is_not_grouped() {
        // Places along a path, numbered by `a` and then `b`, with other marks at random, and steps of up to fifty.
        let mut n = 0;
        let mut random = |below: u64| {
            n += 1;
            scatter(n) % below
        };
        let mut states: Vec<[u64; 4]> = (0..20_000).map(|_| [random(20), random(100), random(8), random(4)]).collect();
        states.sort_unstable();
        let transitions: Vec<_> = (0..20_000_u64)
            .flat_map(|from| [0, 1, 2].map(|action| json!([from, action, (from + random(101) + 19_950) % 20_000])))
            .collect();
        let model = json!({
            "attributes": (["a", "b", "c", "d"]).map(|name| json!({"name": name, "kind": "number"})),
            "actions": (["0", "1", "2"]).map(|name| json!({"name": name})),
            "dynamics": {"kind": "table", "states": states, "transitions": transitions},
        });
        assert_eq!(groups(&model), [["a b", "c", "d"]]);
    }

    #[test]
    fn an_attribute_that_enables_another_is_grouped_with_it() {
        // `a` moves only while `gate` is open; `b` does not care.
        let index = |a: usize, gate: usize, b: usize| (a * 2 + gate) * 9 + b;
        let mut states = Vec::new();
        let mut transitions = Vec::new();
        for (a, gate, b) in (0..12).flat_map(|a| (0..2).flat_map(move |gate| (0..9).map(move |b| (a, gate, b)))) {
            states.push(json!([a, gate, b]));
            transitions.push(json!([index(a, gate, b), 1, index(a, 1 - gate, b)]));
            transitions.push(json!([index(a, gate, b), 2, index(a, gate, (b + 1) % 9)]));
            if gate == 1 {
                transitions.push(json!([index(a, gate, b), 0, index((a + 1) % 12, gate, b)]));
            }
        }
        let model = json!({
            "attributes": [{"name": "a", "kind": "number"}, {"name": "gate", "kind": "number", "weight": 0}, {"name": "b", "kind": "number"}],
            "actions": [{"name": "on"}, {"name": "switch"}, {"name": "turn"}],
            "dynamics": {"kind": "table", "states": states, "transitions": transitions},
        });
        assert_eq!(groups(&model), [["a gate", "b"]]);
    }

    #[test]
    fn groups_grow_to_the_limit_and_no_further() {
        let sizes = [10, 10, 10, 10];
        let restrictions = Restrictions { n_attributes: 4, scores: vec![0.5; 16], weighs: vec![true; 4] };
        let merged = |most| {
            let mut partition: Partition = (0..4).map(|at| vec![at]).collect();
            merge(&mut partition, &restrictions, &sizes, most);
            partition
        };
        assert_eq!(merged(99), [vec![0], vec![1], vec![2], vec![3]]);
        assert_eq!(merged(100), [vec![0, 1], vec![2, 3]]);
        assert_eq!(merged(999), [vec![0, 1], vec![2, 3]]);
        assert_eq!(merged(9_999), [vec![0, 1, 2], vec![3]]);
        assert_eq!(merged(10_000), [vec![0, 1, 2, 3]]);
    }
}
