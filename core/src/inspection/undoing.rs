//! How many actions it takes until everything that is compared is as it was before an action.

use std::borrow::Cow;

use super::report::{Steps, UndoReport, Unknown};
use super::{Classes, Extent, OneWay, Parts, Query, Reached};
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::Demonstration;
use crate::model::{ActionIdx, Model, Rows};

/// How many ways are looked at in all: a second or two.
const MAX_WORK: u64 = 1 << 26;

/// How many states are looked at for one way.
const MAX_SEEN: usize = 1 << 16;

/// Of a model that is searched lazily, the ways from every so many of the states that were explored are undone, the first ones: those that were
/// explored around them are known well.
const EXPLORED_FOR_EACH: usize = 8;

/// What was found of the ways that were looked at.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tally {
    pub(super) greatest: Option<u64>,
    pub(super) n_never: u64,
    n_unknown: u64,
    n_examined: u64,
}

/// What was found.
#[derive(Debug)]
pub(super) struct Undoing {
    extent: Extent,
    by_action: Vec<Tally>,
    all: Tally,
    /// How many ways there are; of those that were explored.
    n_ways: u64,
    /// By number of actions, how many ways are undone by so many.
    n_undone: Vec<u64>,
}

/// What one way takes to be undone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Back {
    Steps(u32),
    /// Nothing that the body can do undoes it.
    Never,
    /// It was not found.
    Unknown,
}

impl Undoing {
    /// Undoes the ways from as many states as there is time for; which ones come first, nothing but their number says. `parts` are those of
    /// the states, if all are known.
    pub(super) fn of(
        model: &Model,
        reached: &Reached<'_>,
        parts: Option<&Parts>,
        query: &Query,
        meter: &mut Meter<'_>,
    ) -> Result<Self, Interrupted> {
        let weighed = query.weights.as_slice().iter().enumerate().filter(|(_, weight)| **weight > 0.0);
        let classes = Classes::of(reached, weighed.map(|(position, _)| position).collect(), meter)?;
        let of_classes = match parts {
            Some(_) if classes.len() < reached.n_states() => Some(parts_of_classes(reached, &classes, meter)?),
            _ => None,
        };
        let parts: Option<Cow<'_, [u32]>> = match &of_classes {
            Some(of_classes) => Some(classes.of.iter().map(|class| of_classes.of[*class as usize]).collect()),
            None => parts.map(|parts| Cow::Borrowed(&*parts.of)),
        };
        let n_from = match reached.extent {
            Extent::Whole => reached.n_states(),
            Extent::Part => reached.ways.n_rows() / EXPLORED_FOR_EACH,
        };
        let mut found = Self {
            extent: reached.extent,
            by_action: vec![Tally::default(); model.actions().len()],
            all: Tally::default(),
            n_ways: reached.ways.n_items() as u64,
            n_undone: Vec::new(),
        };
        let seen = vec![0; reached.n_states()];
        let (classes, parts) = (&*classes.of, parts.as_deref());
        let one_way = OneWay::of(model, query, meter)?;
        let mut search = Search { reached, classes, parts, one_way, seen, n_searches: 0, queue: Vec::new() };
        let mut work = 0;
        for from in evenly(n_from) {
            for way in reached.ways.of(from as usize) {
                match search.back(way.to, from, &mut work, meter) {
                    Ok(back) => found.count(way.action, back),
                    // What was found so far is of use.
                    Err(Interrupted::OutOfTime) => return Ok(found),
                    Err(cancelled) => return Err(cancelled),
                }
            }
            if work >= MAX_WORK {
                break;
            }
        }
        Ok(found)
    }

    fn count(&mut self, action: ActionIdx, back: Back) {
        for tally in [&mut self.by_action[usize::from(action)], &mut self.all] {
            tally.n_examined += 1;
            match back {
                Back::Steps(steps) => tally.greatest = tally.greatest.max(Some(steps.into())),
                Back::Never => tally.n_never += 1,
                Back::Unknown => tally.n_unknown += 1,
            }
        }
        if let Back::Steps(steps) = back {
            let steps = steps as usize;
            if self.n_undone.len() <= steps {
                self.n_undone.resize(steps + 1, 0);
            }
            self.n_undone[steps] += 1;
        }
    }

    pub(super) fn of_action(&self, action: ActionIdx) -> Tally {
        self.by_action[usize::from(action)]
    }

    /// One observation more than the most actions that undo one, so that what they were for is seen as well.
    pub(super) fn lookahead(&self) -> Option<u64> {
        self.all.greatest.map(|greatest| (greatest + 1).min(Demonstration::MAX_OBSERVATIONS as u64))
    }

    /// Why there is no lookahead, if there is none.
    pub(super) fn unknown(&self) -> Option<Unknown> {
        let detail = if self.n_ways == 0 {
            "the body can do nothing where it is, so that no lookahead makes a difference"
        } else if self.all.n_unknown > 0 {
            "whatever the body does takes longer to be undone than was looked for, if it can be undone at all: no lookahead can be told"
        } else {
            "nothing that the body does can be undone, so that a step of a stream that is committed too early is never made good: give \
             streams the longest lookahead that their use allows"
        };
        self.all.greatest.is_none().then(|| Unknown { pointer: "/lookahead".to_owned(), detail: detail.to_owned() })
    }

    pub(super) fn report(&self) -> UndoReport {
        let n_found: u64 = self.n_undone.iter().sum();
        // The least number of actions that undo this part of those that can be undone.
        let share = |percent: u64| {
            let mut n_more = (n_found * percent).div_ceil(100);
            let within = self.n_undone.iter().position(|n| {
                n_more = n_more.saturating_sub(*n);
                n_more == 0
            });
            within.unwrap_or(0) as u64
        };
        let steps = self.all.greatest.map(|greatest| Steps { median: share(50), p99: share(99), greatest });
        UndoReport {
            exact: self.extent == Extent::Whole && self.all.n_examined == self.n_ways && self.all.n_unknown == 0,
            transitions: self.n_ways,
            examined: self.all.n_examined,
            never: self.all.n_never,
            not_found: self.all.n_unknown,
            steps,
        }
    }
}

/// The parts of the graph of classes: a way leads from class to class if one leads from a state of the one to a state of the other. Where
/// no way leads back between classes, none does between their states.
fn parts_of_classes(reached: &Reached<'_>, classes: &Classes, meter: &mut Meter<'_>) -> Result<Parts, Interrupted> {
    let of = &classes.of;
    let edges = of.iter().zip(reached.ways.iter());
    let edges = edges.flat_map(|(from, ways)| ways.iter().map(move |way| (*from, of[way.to as usize])));
    let rows = Rows::try_of_entries(classes.len(), edges, || meter.spend_or_stop(1))?;
    Parts::of_graph(classes.len(), |class| rows.of(class as usize), |to| *to, meter)
}

/// The numbers below `n`, each once, so that the first ones of them are spread evenly: a few neighbours at a time, whose surroundings are the same.
#[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
fn evenly(n: usize) -> impl Iterator<Item = u32> {
    const NEIGHBOURS: usize = 64;
    /// The golden section: of all numbers, its multiples leave the most even gaps.
    const GOLDEN: f64 = 0.618_033_988_749_894_9;
    let n_groups = n.div_ceil(NEIGHBOURS);
    #[expect(clippy::cast_precision_loss, clippy::cast_sign_loss, reason = "about")]
    let about = ((n_groups as f64 * GOLDEN) as usize).max(1);
    let step = (about..=about + n_groups).find(|step| greatest_divisor(*step, n_groups) == 1).unwrap_or(1);
    let groups = (0..n_groups).scan(0, move |at, _| {
        let next = (*at + step) % n_groups;
        Some(std::mem::replace(at, next))
    });
    groups.flat_map(move |group| group * NEIGHBOURS..n.min((group + 1) * NEIGHBOURS)).map(|state| state as u32)
}

fn greatest_divisor(one: usize, other: usize) -> usize {
    if other == 0 { one } else { greatest_divisor(other, one % other) }
}

/// Searches, one after the other.
struct Search<'r> {
    reached: &'r Reached<'r>,
    /// By state, the class of those that look like it.
    classes: &'r [u32],
    /// By state, its class's part in the graph of classes, if that is known whole.
    parts: Option<&'r [u32]>,
    one_way: OneWay,
    /// By state, the last search that has seen it.
    seen: Vec<u32>,
    n_searches: u32,
    queue: Vec<u32>,
}

impl Search<'_> {
    /// How many actions it takes from the state `from` to one that looks like `to`: breadth first.
    fn back(&mut self, from: u32, to: u32, work: &mut u64, meter: &mut Meter<'_>) -> Result<Back, Interrupted> {
        let class_of = |state: u32| self.classes[state as usize];
        let wanted = class_of(to);
        if class_of(from) == wanted {
            return Ok(Back::Steps(0));
        }
        let part_of = |state: u32| self.parts.map(|parts| parts[state as usize]);
        let part = part_of(to);
        // A way back stays within the part.
        if part_of(from) != part || self.one_way.bars(self.reached.row(from), self.reached.row(to)) {
            return Ok(Back::Never);
        }
        self.n_searches += 1;
        self.queue.clear();
        self.queue.push(from);
        self.seen[from as usize] = self.n_searches;
        let (mut n_steps, mut n_done, mut is_cut) = (0, 0, false);
        while n_done < self.queue.len() {
            n_steps += 1;
            let level = n_done..self.queue.len();
            n_done = level.end;
            for at in level {
                let state = self.queue[at] as usize;
                if state >= self.reached.ways.n_rows() {
                    is_cut = true;
                    continue;
                }
                let ways = self.reached.ways.of(state);
                *work += 1 + ways.len() as u64;
                meter.spend_or_stop(1 + ways.len() as u64)?;
                for way in ways {
                    if class_of(way.to) == wanted {
                        return Ok(Back::Steps(n_steps));
                    }
                    let seen = &mut self.seen[way.to as usize];
                    if *seen != self.n_searches && part_of(way.to) == part {
                        *seen = self.n_searches;
                        self.queue.push(way.to);
                    }
                }
                if self.queue.len() > MAX_SEEN {
                    return Ok(Back::Unknown);
                }
            }
        }
        Ok(if is_cut { Back::Unknown } else { Back::Never })
    }
}
