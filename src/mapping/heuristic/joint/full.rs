//! Tables of all classes of a group.
//!
//! A class costs what it takes in the projection on the group, exactly ([`backward`]), with the least price of each way between two
//! classes. A group's price is no less than those of its attributes together, so its table tells no less than theirs.

use rustc_hash::FxHashMap;

use super::Basis;
use crate::interrupt::{Meter, Signal};
use crate::mapping::backward::{self, Distances, Graph, NoLinks, PriceIdx};
use crate::mapping::heuristic::projected::Table;
use crate::mapping::heuristic::projection::{ClassIdx, Group};
use crate::mapping::heuristic::shares::{Parts, Way, Ways};

/// The table of a group.
#[derive(Debug)]
pub(in crate::mapping::heuristic) struct Whole<'p> {
    group: &'p Group,
    costs: Table<f64>,
}

impl<'p> Whole<'p> {
    /// What is left of room for `n_entries` after that of `group`; `None` if there is too little.
    pub(super) fn room_after(n_entries: usize, group: &Group, basis: &Basis<'_>) -> Option<usize> {
        n_entries.checked_sub(Table::<f64>::n_entries_for(group.n_classes(), basis.least_terms.len()))
    }

    /// Makes the table. `None` if the group has more prices than can be numbered, or more ways out of a class.
    pub(super) fn solve(
        group: &'p Group,
        basis: &Basis<'_>,
        parts: &Parts<'_>,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Self>, Signal> {
        let Some(graph) = graph(group, parts) else { return Ok(None) };
        let (n_classes, last) = (group.n_classes(), basis.least_terms.len() - 1);
        let mut costs = Table::filled_with(0.0, n_classes, last + 1);
        let mut buffers = backward::Buffers::default();
        let (mut here, mut next) = (vec![0.0; n_classes], vec![0.0; n_classes]);
        let mut distances = distances(group, basis, last);
        for i in (0..last).rev() {
            for ((next, distance), here) in next.iter_mut().zip(&distances).zip(&here) {
                *next = distance + here;
            }
            distances = self::distances(group, basis, i);
            let rests: Vec<f64> = distances.iter().map(|distance| distance - basis.least_terms[i]).collect();
            let of_here = Distances { rests: &rests, least: basis.least_distances[i] };
            graph.step_back(&next, of_here, &mut here, &mut NoLinks, &mut buffers, meter)?;
            for (class, cost) in here.iter().enumerate() {
                *costs.at_mut(class, i) = *cost;
            }
        }
        Ok(Some(Self { group, costs }))
    }

    /// The cost-to-go of the class of a state with these domain indices.
    #[inline]
    pub(super) fn cost_to_go(&self, observation: usize, values: &[u32]) -> f64 {
        self.costs.at(self.group.class_of(values), observation)
    }

    pub(super) fn group(&self) -> &'p Group {
        self.group
    }
}

/// The ways between the classes of a group.
fn graph(group: &Group, parts: &Parts<'_>) -> Option<Graph> {
    let ways = Ways::into_classes(group, parts);
    let mut prices = Vec::new();
    let mut numbers: FxHashMap<[u64; 2], PriceIdx> = FxHashMap::default();
    let mut numbered: Vec<(ClassIdx, ClassIdx, PriceIdx)> = Vec::with_capacity(ways.len());
    for (to, into) in (0..).zip(ways.iter()) {
        for Way { class: from, price } in into {
            let next = PriceIdx::try_from(prices.len()).ok()?;
            let number = *numbers.entry([price.share, price.part].map(f64::to_bits)).or_insert(next);
            if number == next {
                prices.push(*price);
            }
            numbered.push((*from, to, number));
        }
    }
    Graph::new(group.n_classes(), numbered.iter().copied(), prices)
}

/// What the classes of a group cost at an observation.
fn distances(group: &Group, basis: &Basis<'_>, i: usize) -> Vec<f64> {
    group.digits().zip(basis.columns).fold(vec![0.0], |distances, ((_, n_values), column)| {
        let term = |value: usize| column.map_or(0.0, |column| basis.table.at(column + value, i).distance);
        (0..n_values).map(term).flat_map(|term| distances.iter().map(move |distance| distance + term)).collect()
    })
}
