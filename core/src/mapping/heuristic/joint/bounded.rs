//! Tables of groups of several attributes, of those classes only that matter.
//!
//! A group of several attributes tells more than its attributes alone, but has many more classes, of which nearly all are far off
//! any mapping worth finding. Once a mapping is known, of cost U, they need no entry. Let `F_k(i, v)` be the least that
//! the projection on the attribute `k` costs from the start to the value `v` at observation `i`, with its distance there, and
//! `opt_k` what it costs in all. A mapping through `(i, s)` costs at least
//!
//! ```text
//! sum of F_k(i, s_k) over the attributes k of the group  +  H(i, class of s)  +  sum of opt_k over the other attributes
//! ```
//!
//! where H is the group's own exact cost-to-go: the cost of an action is shared so that a group's part is no less than those of
//! its attributes together, and every way of the mapping pays in full in each projection. If that is U or more, no mapping
//! through the node costs less than U, and the node need not be kept: its estimate is infinite.
//!
//! The tables are made backwards, layer by layer, from the classes of the last observation; whatever comes to U is dropped at
//! once. That loses nothing: along a cheapest projected completion of a class that is kept, `F + H` does not grow (a step raises
//! F by what it costs at most, and lowers H by just that), so all of the completion is kept too, and the entries that
//! remain are exact (Zhou & Hansen 2004, on pattern databases made for one instance, of what is below an upper bound).
//! Between nodes of finite estimates the sum is consistent, as that of whole tables is; from a node of infinite estimate no move
//! is looked at.

use std::collections::BinaryHeap;

use super::{Basis, Unsolved};
use crate::interrupt::Meter;
use crate::mapping::heuristic::projection::{ClassIdx, Classes, Group};
use crate::mapping::open_list::CheapestFirst;

/// The table of a group: hash tables with linear probing, one per observation.
#[derive(Debug)]
pub(in crate::mapping::heuristic) struct Bounded {
    classes: Classes,
    layers: Vec<Layer>,
    slots: Vec<Slot>,
}

/// Where the entries of an observation are.
#[derive(Clone, Copy, Debug, Default)]
struct Layer {
    first: usize,
    /// There are `2^bits` slots.
    bits: u32,
}

#[derive(Clone, Copy, Debug)]
struct Slot {
    class: ClassIdx,
    cost_to_go: f64,
}

/// Stands for "no class".
const NO_CLASS: ClassIdx = ClassIdx::MAX;

/// A class of the layer in the making.
#[derive(Clone, Copy, Debug)]
struct Entry {
    class: ClassIdx,
    distance: f64,
    cost_to_go: f64,
}

/// Marks classes that have no entry in the layer.
const NO_PLACE: u32 = u32::MAX;

impl Bounded {
    /// What an entry takes at most, with the room in hash tables.
    pub(super) const ENTRY_BYTES: usize = 4 * size_of::<Slot>();

    /// What making the table takes besides, in bytes; but for the entries of two layers.
    pub(super) fn bytes_to_make(basis: &Basis<'_>) -> usize {
        basis.group.n_classes() * size_of::<u32>() + basis.least_terms.len() * size_of::<Layer>()
    }

    /// Makes the table, with at most `n_left` entries, of which it takes its own.
    pub(super) fn solve(basis: &Basis<'_>, n_left: &mut usize, meter: &mut Meter<'_>) -> Result<Self, Unsolved> {
        let Basis { group, parts, .. } = basis;
        let n_observations = basis.least_terms.len();
        let classes = group.classes().clone();
        let mut table = Self { classes, layers: vec![Layer::default(); n_observations], slots: Vec::new() };
        let mut here =
            Making { group, basis, observation: 0, places: vec![NO_PLACE; group.n_classes()], entries: Vec::new() };
        let mut open = BinaryHeap::new();
        here.observation = n_observations - 1;
        here.enumerate(*n_left, meter)?;
        table.finish_layer(n_observations - 1, &here.entries, n_left)?;
        for i in (0..n_observations - 1).rev() {
            let next = here.restart(i);
            for entry in &next {
                let cost = entry.distance + entry.cost_to_go;
                let edges = group.edges_into(entry.class as usize);
                meter.go_on(1 + edges.len() as u64).map_err(Unsolved::Interrupted)?;
                here.offer(entry.class, cost);
                for edge in edges {
                    here.offer(edge.from, parts.of(edge, 0.0) + cost);
                }
            }
            for number in 0..here.entries.len() {
                open.extend(here.as_open(number));
            }
            while let Some(CheapestFirst { cost, id }) = open.pop() {
                let entry = here.entries[id as usize];
                if cost > entry.cost_to_go {
                    continue;
                }
                let edges = group.edges_into(entry.class as usize);
                meter.go_on(1 + edges.len() as u64).map_err(Unsolved::Interrupted)?;
                let cost = entry.distance - basis.least_terms[i] + cost;
                for edge in edges {
                    let offered = here.offer(edge.from, parts.of(edge, basis.least_distances[i]) + cost);
                    open.extend(offered.and_then(|number| here.as_open(number)));
                }
                if here.entries.len() > *n_left {
                    return Err(Unsolved::TooLarge);
                }
            }
            table.finish_layer(i, &here.entries, n_left)?;
        }
        Ok(table)
    }

    /// The cost-to-go of the class of a state with these domain indices; infinite if no mapping through it is worth
    /// finding.
    #[inline]
    pub(super) fn cost_to_go(&self, observation: usize, values: &[u32]) -> f64 {
        #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
        let class = self.classes.of(values) as ClassIdx;
        let layer = self.layers[observation];
        let mut place = layer.place_of(class);
        loop {
            let slot = &self.slots[layer.first + place];
            if slot.class == class {
                return slot.cost_to_go;
            }
            if slot.class == NO_CLASS {
                return f64::INFINITY;
            }
            place = (place + 1) & layer.mask();
        }
    }

    pub(super) fn classes(&self) -> &Classes {
        &self.classes
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.layers.len() * size_of::<Layer>() + self.slots.capacity() * size_of::<Slot>()
    }

    fn finish_layer(&mut self, i: usize, entries: &[Entry], n_left: &mut usize) -> Result<(), Unsolved> {
        *n_left = n_left.checked_sub(entries.len()).ok_or(Unsolved::TooLarge)?;
        let bits = (entries.len() * 2).next_power_of_two().trailing_zeros().max(1);
        let layer = Layer { first: self.slots.len(), bits };
        self.layers[i] = layer;
        self.slots.resize(layer.first + (1 << bits), Slot { class: NO_CLASS, cost_to_go: f64::INFINITY });
        for Entry { class, cost_to_go, .. } in entries {
            let mut place = layer.place_of(*class);
            while self.slots[layer.first + place].class != NO_CLASS {
                place = (place + 1) & layer.mask();
            }
            self.slots[layer.first + place] = Slot { class: *class, cost_to_go: *cost_to_go };
        }
        Ok(())
    }
}

impl Layer {
    fn mask(self) -> usize {
        (1 << self.bits) - 1
    }

    /// Where the search for a class begins.
    #[inline]
    fn place_of(self, class: ClassIdx) -> usize {
        /// 2^32 divided by the golden ratio (Knuth 1973, multiplicative hashing).
        const MULTIPLIER: u32 = 0x9e37_79b9;
        (class.wrapping_mul(MULTIPLIER) >> (ClassIdx::BITS - self.bits)) as usize
    }
}

/// The layer in the making.
struct Making<'b> {
    group: &'b Group,
    basis: &'b Basis<'b>,
    /// The observation.
    observation: usize,
    /// By class, where it is in `entries`, or [`NO_PLACE`].
    places: Vec<u32>,
    entries: Vec<Entry>,
}

impl Making<'_> {
    /// Goes on to the layer of observation `i`, and gives the entries of the one before.
    fn restart(&mut self, i: usize) -> Vec<Entry> {
        let entries = std::mem::take(&mut self.entries);
        for entry in &entries {
            self.places[entry.class as usize] = NO_PLACE;
        }
        self.observation = i;
        entries
    }

    /// Takes all classes of the last observation, from where nothing is still to be paid: one of each state, or of all values if
    /// there are fewer of those.
    fn enumerate(&mut self, n_left: usize, meter: &mut Meter<'_>) -> Result<(), Unsolved> {
        let states = self.basis.states;
        if states.len() as usize > self.group.n_classes() {
            return self.enumerate_values(n_left);
        }
        for state in 0..states.len() {
            meter.go_on(1).map_err(Unsolved::Interrupted)?;
            #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
            self.offer(self.group.class_of(states.row(state)) as ClassIdx, 0.0);
            if self.entries.len() > n_left {
                return Err(Unsolved::TooLarge);
            }
        }
        Ok(())
    }

    fn enumerate_values(&mut self, n_left: usize) -> Result<(), Unsolved> {
        let mut partial = vec![(0usize, 0.0, 0.0)];
        let mut stride = 1;
        for ((_, n_values), column) in self.group.digits().zip(&self.basis.columns) {
            let mut extended = Vec::new();
            for (class, distance, forward) in partial {
                for value in 0..n_values {
                    let (more_distance, more_forward) = self.at(*column, value);
                    let forward: f64 = forward + more_forward;
                    if forward < self.basis.limit {
                        extended.push((class + value * stride, distance + more_distance, forward));
                    }
                }
                if extended.len() > n_left {
                    return Err(Unsolved::TooLarge);
                }
            }
            partial = extended;
            stride *= n_values;
        }
        for (class, distance, _) in partial {
            #[expect(clippy::cast_possible_truncation, reason = "classes are counted in u32")]
            let (class, place) = (class as ClassIdx, self.entries.len() as u32);
            self.places[class as usize] = place;
            self.entries.push(Entry { class, distance, cost_to_go: 0.0 });
        }
        Ok(())
    }

    /// The distance of an attribute's value, and the least cost from the start to it.
    #[inline]
    fn at(&self, column: Option<usize>, value: usize) -> (f64, f64) {
        column.map_or((0.0, 0.0), |column| {
            let (class, i) = (column + value, self.observation);
            (self.basis.table.at(class, i).distance, self.basis.forward.at(class, i))
        })
    }

    /// Takes a way to complete the mapping from `class`. Gives its place if that is cheaper than any before, and worth
    /// keeping.
    #[inline]
    fn offer(&mut self, class: ClassIdx, cost: f64) -> Option<usize> {
        let place = self.places[class as usize];
        if let Some(entry) = self.entries.get_mut(place as usize) {
            let is_cheaper = cost < entry.cost_to_go;
            if is_cheaper {
                entry.cost_to_go = cost;
            }
            return is_cheaper.then_some(place as usize);
        }
        let (mut distance, mut total) = (0.0, cost);
        let mut rest = class as usize;
        for ((_, n_values), column) in self.group.digits().zip(&self.basis.columns) {
            let (more_distance, forward) = self.at(*column, rest % n_values);
            distance += more_distance;
            total += forward;
            rest /= n_values;
        }
        if total >= self.basis.limit {
            return None;
        }
        let place = self.entries.len();
        #[expect(clippy::cast_possible_truncation, reason = "at most as many as classes, counted in u32")]
        {
            self.places[class as usize] = place as u32;
        }
        self.entries.push(Entry { class, distance, cost_to_go: cost });
        Some(place)
    }

    fn as_open(&self, number: usize) -> Option<CheapestFirst> {
        #[expect(clippy::cast_possible_truncation, reason = "at most as many as classes, counted in u32")]
        self.entries.get(number).map(|entry| CheapestFirst { cost: entry.cost_to_go, id: number as u32 })
    }
}
