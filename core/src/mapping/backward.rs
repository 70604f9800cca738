//! What it costs to go on, exactly, from all vertices of a graph: one observation after the other, from the last backwards.
//!
//! With `N(v)`, what it costs to be at `v` at the next observation and to go on from there,
//!
//! ```text
//! H(v) = min( N(v),                                             skip
//!             share(w) + N(v') by a way w to v',                match
//!             share(w) + part(w) * least + rest(v') + H(v') )   extra
//! ```
//!
//! where the distance at the observation is `rest`, of which the graph tells the vertices apart, and `least`, of which a way pays its
//! part. The vertices are the states of a model, each way paying all ([`super::search::sweep`]), or the classes of a group of
//! attributes, whose ways pay the group's share ([`super::heuristic`]'s tables of several attributes).
//!
//! The first two are looked up for one vertex after the other. Extra actions lead to others at the same observation, so these are gone
//! over again and again until few of them change, and the rest is done by Dijkstra's algorithm. A way replaces one that was found only
//! if it is cheaper, so ways to go on end at the next observation, even where actions cost nothing.

use std::collections::BinaryHeap;
use std::hint::select_unpredictable;

use super::open_list::CheapestFirst;
use crate::interrupt::{Meter, Signal};
use crate::model::Rows;

/// A graph to go back over.
#[derive(Debug)]
pub(super) struct Graph {
    /// By the vertex that they leave.
    out: Rows<Way>,
    /// The same ways, by the vertex to which they lead; of each, where it comes from.
    into: Rows<Way>,
    prices: Vec<Price>,
}

/// A way between two vertices, as one of them sees it.
#[derive(Clone, Copy, Debug)]
struct Way {
    /// The other vertex.
    vertex: u32,
    price: u16,
    /// Its number among the ways out of the vertex that it leaves.
    number: u16,
}

/// What a way costs besides the distance of the vertex to which it leads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Price {
    /// The action's cost, or a share of it.
    pub(super) share: f64,
    /// Which part of the least distance an extra action pays: from 0 to 1.
    pub(super) part: f64,
}

impl Price {
    /// Of an extra action.
    #[inline]
    pub(super) fn of_extra(self, least_distance: f64) -> f64 {
        self.share + self.part * least_distance
    }
}

/// The number of a [`Price`].
pub(super) type PriceIdx = u16;

/// The cheapest way to go on from a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GoOn {
    Skip,
    /// By the way of this number.
    Match(usize),
    Extra(usize),
}

/// A [`GoOn`], in two bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Link(u16);

impl Link {
    pub(super) const SKIP: Self = Self(u16::MAX);

    #[inline]
    fn matched(way: u16) -> Self {
        Self(way << 1)
    }

    #[inline]
    fn extra(way: u16) -> Self {
        Self(way << 1 | 1)
    }

    pub(super) fn go_on(self) -> GoOn {
        let way = usize::from(self.0 >> 1);
        match self {
            Self::SKIP => GoOn::Skip,
            Self(link) if link & 1 == 0 => GoOn::Match(way),
            Self(_) => GoOn::Extra(way),
        }
    }
}

/// Most ways out of a vertex, so that their numbers have room in a [`Link`].
const MAX_WAYS_OUT: usize = (u16::MAX >> 1) as usize;

/// Stands for "no way" among their numbers.
const NO_WAY: u16 = u16::MAX;

/// Takes note of the cheapest way to go on from each vertex, or does not.
pub(super) trait Links {
    fn set(&mut self, vertex: usize, link: Link);
}

impl Links for [Link] {
    #[inline]
    fn set(&mut self, vertex: usize, link: Link) {
        self[vertex] = link;
    }
}

/// For whom costs are enough.
pub(super) struct NoLinks;

impl Links for NoLinks {
    #[inline]
    fn set(&mut self, _: usize, _: Link) {}
}

/// What an extra action pays for arriving at the vertices.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arriving<'d> {
    /// By vertex: the distance without the least. At least 0, without which it might pay to go round in a circle.
    pub(super) rests: &'d [f64],
    /// Of this, a way pays its part.
    pub(super) least_distance: f64,
}

/// Buffers of a step back.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    /// By price, what a way costs: first as a match, then as an extra action.
    prices: Vec<f64>,
    /// By vertex, what it costs to come there by an extra action and to go on.
    arrivals: Vec<f64>,
    /// The vertices that the last pass has changed.
    changed: Vec<u32>,
    open: BinaryHeap<CheapestFirst>,
}

impl Graph {
    /// `ways` gives each way as where it leaves, where it leads and the number of its price. `None` if more leave one vertex than can be
    /// numbered.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn new(
        n_vertices: usize,
        ways: impl Iterator<Item = (u32, u32, PriceIdx)> + Clone,
        prices: Vec<Price>,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Self>, Signal> {
        let ways = ways.map(|(from, to, price)| (from, Way { vertex: to, price, number: 0 }));
        let mut out = Rows::try_of_entries(n_vertices, ways, || meter.go_on(1))?;
        for vertex in 0..n_vertices {
            let ways = out.of_mut(vertex);
            if ways.len() > MAX_WAYS_OUT {
                return Ok(None);
            }
            ways.iter_mut().zip(0..).for_each(|(way, number)| way.number = number);
        }
        let rows = out.iter().zip(0..);
        let reversed =
            rows.flat_map(|(ways, from)| ways.iter().map(move |way| (way.vertex, Way { vertex: from, ..*way })));
        let into = Rows::try_of_entries(n_vertices, reversed, || meter.go_on(1))?;
        Ok(Some(Self { out, into, prices }))
    }

    /// How much memory one takes, in bytes.
    pub(super) fn bytes_for(n_vertices: usize, n_ways: usize) -> usize {
        2 * (n_vertices * size_of::<u32>() + n_ways * size_of::<Way>())
    }

    /// Writes to `here` what it costs to go on from each vertex at an observation, if being there at the next one and going on from there
    /// costs `next`. `O(|V| + |E|)`, and `O(|E| log |V|)` where many extra actions follow
    /// each other.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn step_back<L: Links + ?Sized>(
        &self,
        next: &[f64],
        arriving: Arriving<'_>,
        here: &mut [f64],
        links: &mut L,
        buffers: &mut Buffers,
        meter: &mut Meter<'_>,
    ) -> Result<(), Signal> {
        debug_assert!(arriving.rests.iter().all(|rest| *rest >= 0.0), "no circle pays");
        buffers.prices.clear();
        buffers.prices.extend(self.prices.iter().map(|price| price.share));
        for (vertex, ((here, skipped), ways)) in here.iter_mut().zip(next).zip(self.out.iter()).enumerate() {
            meter.go_on(1 + ways.len() as u64)?;
            let (cost, link) = cheapest(*skipped, ways, &buffers.prices, next, Link::matched);
            *here = cost;
            links.set(vertex, link.unwrap_or(Link::SKIP));
        }
        buffers.prices.clear();
        buffers.prices.extend(self.prices.iter().map(|price| price.of_extra(arriving.least_distance)));
        self.linger(arriving.rests, here, links, buffers, meter)
    }

    /// Makes cheaper what extra actions make cheaper, at the prices in `buffers`.
    fn linger<L: Links + ?Sized>(
        &self,
        rests: &[f64],
        here: &mut [f64],
        links: &mut L,
        buffers: &mut Buffers,
        meter: &mut Meter<'_>,
    ) -> Result<(), Signal> {
        /// They are gone over again if more than one in this many has changed,
        const MANY: usize = 8;
        /// but no more often than this.
        const MAX_PASSES: usize = 8;
        let Buffers { prices, arrivals, changed, open } = buffers;
        arrivals.clear();
        arrivals.extend(here.iter().zip(rests).map(|(here, rest)| here + rest));
        for _ in 0..MAX_PASSES {
            changed.clear();
            for (vertex, (here, ways)) in (0..).zip(here.iter_mut().zip(self.out.iter())) {
                meter.go_on(1 + ways.len() as u64)?;
                if let (cost, Some(link)) = cheapest(*here, ways, prices, arrivals, Link::extra) {
                    *here = cost;
                    arrivals[vertex as usize] = cost + rests[vertex as usize];
                    links.set(vertex as usize, link);
                    changed.push(vertex);
                }
            }
            if changed.len() <= here.len() / MANY {
                break;
            }
        }
        open.clear();
        open.extend(changed.iter().map(|vertex| CheapestFirst { cost: here[*vertex as usize], id: *vertex }));
        while let Some(CheapestFirst { cost, id }) = open.pop() {
            if cost > here[id as usize] {
                continue;
            }
            let ways = self.into.of(id as usize);
            meter.go_on(1 + ways.len() as u64)?;
            let arrival = cost + rests[id as usize];
            for way in ways {
                let cost = prices[usize::from(way.price)] + arrival;
                let known = &mut here[way.vertex as usize];
                if cost < *known {
                    *known = cost;
                    links.set(way.vertex as usize, Link::extra(way.number));
                    open.push(CheapestFirst { cost, id: way.vertex });
                }
            }
        }
        Ok(())
    }
}

/// The least of `cost` and of what the `ways` out of a vertex cost, the first among equals; with the way's link, if it is one.
#[inline]
fn cheapest(
    cost: f64,
    ways: &[Way],
    prices: &[f64],
    arrivals: &[f64],
    link_by: impl Fn(u16) -> Link,
) -> (f64, Option<Link>) {
    // Costs are not negative, so their bits are in the same order. Which way is cheaper cannot be foreseen, so there should be no branch.
    let (mut least, mut number) = (cost.to_bits(), NO_WAY);
    for way in ways {
        let cost = (prices[usize::from(way.price)] + arrivals[way.vertex as usize]).to_bits();
        let is_less = cost < least;
        number = select_unpredictable(is_less, way.number, number);
        least = select_unpredictable(is_less, cost, least);
    }
    (f64::from_bits(least), (number != NO_WAY).then(|| link_by(number)))
}
