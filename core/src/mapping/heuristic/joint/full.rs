//! Tables of all classes of a group.
//!
//! A class costs what it takes in the projection on the group, exactly ([`backward`]), with the least price of each way between two
//! classes. A group's price is no less than those of its attributes together, so its table tells no less than theirs.
//!
//! Nothing is said of classes to which the start does not lead: where no action changes an attribute, the least term that
//! extra actions pay is that of its value at the start, and those of other values are taken to be no less.

use rustc_hash::FxHashMap;

use super::{Basis, Unsolved};
use crate::interrupt::Meter;
use crate::mapping::backward::{self, Arriving, Graph, NoLinks, PriceIdx};
use crate::mapping::heuristic::projected::Table;
use crate::mapping::heuristic::projection::{ClassIdx, Classes, Group};
use crate::mapping::heuristic::shares::{Parts, Way, Ways};

/// The table of a group.
#[derive(Debug)]
pub(in crate::mapping::heuristic) struct Full {
    classes: Classes,
    costs: Table<f64>,
}

impl Full {
    pub(super) const ENTRY_BYTES: usize = size_of::<f64>();

    /// How many entries the table would have.
    pub(super) fn n_entries(basis: &Basis<'_>) -> usize {
        Table::<f64>::n_entries_for(basis.group.n_classes(), basis.least_terms.len())
    }

    /// What making the table takes besides, in bytes: the ways between classes, in three forms, and what these cost.
    pub(super) fn bytes_to_make(basis: &Basis<'_>) -> usize {
        const CLASS_BYTES: usize = 8 * size_of::<f64>();
        let (n_classes, n_edges) = (basis.group.n_classes(), basis.group.n_edges());
        let way_bytes = size_of::<Way>() + size_of::<(ClassIdx, ClassIdx, PriceIdx)>();
        Graph::bytes_for(n_classes, n_edges) + n_edges * way_bytes + n_classes * CLASS_BYTES
    }

    /// Makes the table.
    pub(super) fn solve(basis: &Basis<'_>, meter: &mut Meter<'_>) -> Result<Self, Unsolved> {
        let group = basis.group;
        let graph = graph(group, &basis.parts, meter)?.ok_or(Unsolved::Impossible)?;
        let (n_classes, last) = (group.n_classes(), basis.least_terms.len() - 1);
        let mut costs = Table::filled_with(0.0, n_classes, last + 1);
        let mut buffers = backward::Buffers::default();
        let (mut here, mut next) = (vec![0.0; n_classes], vec![0.0; n_classes]);
        let mut distances = distances(basis, last);
        for i in (0..last).rev() {
            for ((next, distance), here) in next.iter_mut().zip(&distances).zip(&here) {
                *next = distance + here;
            }
            distances = self::distances(basis, i);
            let rest = |distance: &f64| (distance - basis.least_terms[i]).max(0.0);
            let rests: Vec<f64> = distances.iter().map(rest).collect();
            let arriving = Arriving { rests: &rests, least_distance: basis.least_distances[i] };
            let stepped = graph.step_back(&next, arriving, &mut here, &mut NoLinks, &mut buffers, meter);
            stepped.map_err(Unsolved::Interrupted)?;
            for (class, cost) in here.iter().enumerate() {
                *costs.at_mut(class, i) = *cost;
            }
        }
        Ok(Self { classes: group.classes().clone(), costs })
    }

    /// The cost-to-go of the class of a state with these domain indices.
    #[inline]
    pub(super) fn cost_to_go(&self, observation: usize, values: &[u32]) -> f64 {
        self.costs.at(self.classes.of(values), observation)
    }

    pub(super) fn classes(&self) -> &Classes {
        &self.classes
    }

    /// Size in memory, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        self.costs.size_bytes()
    }
}

/// The ways between the classes of a group. `None` if it has more prices than can be numbered, or more ways out of a class.
fn graph(group: &Group, parts: &Parts<'_>, meter: &mut Meter<'_>) -> Result<Option<Graph>, Unsolved> {
    let ways = Ways::into_classes(group, parts);
    let mut prices = Vec::new();
    let mut numbers: FxHashMap<[u64; 2], PriceIdx> = FxHashMap::default();
    let mut numbered: Vec<(ClassIdx, ClassIdx, PriceIdx)> = Vec::with_capacity(ways.len());
    for (to, into) in (0..).zip(ways.iter()) {
        for Way { class: from, price } in into {
            let Ok(next) = PriceIdx::try_from(prices.len()) else { return Ok(None) };
            let number = *numbers.entry([price.share, price.part].map(f64::to_bits)).or_insert(next);
            if number == next {
                prices.push(*price);
            }
            numbered.push((*from, to, number));
        }
    }
    drop(ways);
    Graph::new(group.n_classes(), numbered.iter().copied(), prices, meter).map_err(Unsolved::Interrupted)
}

/// What the classes of a group cost at an observation.
fn distances(basis: &Basis<'_>, i: usize) -> Vec<f64> {
    basis.group.digits().zip(&basis.columns).fold(vec![0.0], |distances, ((_, n_values), column)| {
        let term = |value: usize| column.map_or(0.0, |column| basis.table.at(column + value, i).distance);
        (0..n_values).map(term).flat_map(|term| distances.iter().map(move |distance| distance + term)).collect()
    })
}
