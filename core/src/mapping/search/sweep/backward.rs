//! What it costs to go on, exactly, from all states: one observation after the other, from the last backwards.
//!
//! This is the [recurrence](crate::mapping::MoveKind) backwards, for all states at once.
//!
//! Skips and matches are done in one pass over the states. Extra actions lead to states at the same observation, so passes are repeated
//! until few states change, and Dijkstra's algorithm does the rest. Only a cheaper way replaces another, so chains of extra actions end even
//! where actions cost nothing.

use std::collections::BinaryHeap;
use std::hint::select_unpredictable;

use crate::interrupt::{Meter, Signal};
use crate::mapping::MoveKind;
use crate::mapping::open_list::CheapestFirst;
use crate::model::{ActionIdx, Model, Rows, StateIdx};

/// The transitions of a model, to go back over.
#[derive(Debug)]
pub(super) struct Ways {
    /// By the state that they leave.
    out: Rows<SweepWay>,
    /// The same ways, by the state to which they lead; of each, where it comes from.
    into: Rows<SweepWay>,
    /// By action.
    costs: Vec<f64>,
}

/// A way between two states, as one of them sees it.
#[derive(Clone, Copy, Debug)]
struct SweepWay {
    /// The other state.
    state: StateIdx,
    action: ActionIdx,
    /// Its number among the ways out of the state that it leaves.
    number: u16,
}

/// The cheapest way to go on from a state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GoOn {
    Skip,
    /// By the way of this number.
    Match(usize),
    Extra(usize),
}

/// A [`GoOn`], in two bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct GoOnLink(u16);

impl GoOnLink {
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

/// Most ways out of a state, so that their numbers have room in a [`GoOnLink`].
const MAX_WAYS_OUT: usize = (u16::MAX >> 1) as usize;

/// Stands for "no way" among their numbers.
const NO_WAY: u16 = u16::MAX;

/// Takes note of the cheapest way to go on from each state, or does not.
pub(super) trait NoteLinks {
    fn set(&mut self, state: usize, link: GoOnLink);
}

impl NoteLinks for [GoOnLink] {
    #[inline]
    fn set(&mut self, state: usize, link: GoOnLink) {
        self[state] = link;
    }
}

/// For whom costs are enough.
pub(super) struct NoLinks;

impl NoteLinks for NoLinks {
    #[inline]
    fn set(&mut self, _: usize, _: GoOnLink) {}
}

/// What a step back works with, kept for the next one.
#[derive(Debug, Default)]
pub(super) struct Workspace {
    /// By state, what it costs to come there by an extra action and to go on.
    arrivals: Vec<f64>,
    /// The states that the last pass has changed.
    changed: Vec<StateIdx>,
    open: BinaryHeap<CheapestFirst>,
}

impl Ways {
    /// The ways of `model`. `None` if more leave one state than can be numbered.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn new(model: &Model, meter: &mut Meter<'_>) -> Result<Option<Self>, Signal> {
        let graph = model.graph();
        let ways = graph.iter().map(|(from, to)| (from, SweepWay { state: to.to, action: to.action, number: 0 }));
        let mut out = Rows::try_of_entries(graph.n_states(), ways, || meter.go_on(1))?;
        for state in 0..graph.n_states() {
            let ways = out.of_mut(state);
            if ways.len() > MAX_WAYS_OUT {
                return Ok(None);
            }
            ways.iter_mut().zip(0..).for_each(|(way, number)| way.number = number);
        }
        let rows = out.iter().zip(0..);
        let reversed =
            rows.flat_map(|(ways, from)| ways.iter().map(move |way| (way.state, SweepWay { state: from, ..*way })));
        let into = Rows::try_of_entries(graph.n_states(), reversed, || meter.go_on(1))?;
        Ok(Some(Self { out, into, costs: model.actions().iter().map(|action| action.cost).collect() }))
    }

    /// How much memory the ways of so many states take, in bytes.
    pub(super) fn bytes_for(n_states: usize, n_ways: usize) -> usize {
        2 * (n_states * size_of::<u32>() + n_ways * size_of::<SweepWay>())
    }

    /// Writes to `here` what it costs to go on from each state at an observation with these `distances`, if being at it at the next one
    /// and going on from there costs `next`. `O(|V| + |E|)`, and `O(|E| log |V|)` where many extra actions follow each other.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn step_back<L: NoteLinks + ?Sized>(
        &self,
        next: &[f64],
        distances: &[f64],
        here: &mut [f64],
        links: &mut L,
        workspace: &mut Workspace,
        meter: &mut Meter<'_>,
    ) -> Result<(), Signal> {
        for (state, ((here, skipped), ways)) in here.iter_mut().zip(next).zip(self.out.iter()).enumerate() {
            meter.go_on(1 + ways.len() as u64)?;
            let (cost, link) = self.cheapest(*skipped, ways, next, GoOnLink::matched);
            *here = cost;
            links.set(state, link.unwrap_or(GoOnLink::SKIP));
        }
        self.linger(distances, here, links, workspace, meter)
    }

    /// Makes cheaper what extra actions make cheaper.
    fn linger<L: NoteLinks + ?Sized>(
        &self,
        distances: &[f64],
        here: &mut [f64],
        links: &mut L,
        workspace: &mut Workspace,
        meter: &mut Meter<'_>,
    ) -> Result<(), Signal> {
        /// They are gone over again if more than one in this many has changed,
        const MANY: usize = 8;
        /// but no more often than this.
        const MAX_PASSES: usize = 8;
        let Workspace { arrivals, changed, open } = workspace;
        arrivals.clear();
        arrivals.extend(here.iter().zip(distances).map(|(here, distance)| MoveKind::Extra.go_on(*distance, *here)));
        for _ in 0..MAX_PASSES {
            changed.clear();
            for (state, (here, ways)) in (0..).zip(here.iter_mut().zip(self.out.iter())) {
                meter.go_on(1 + ways.len() as u64)?;
                if let (cost, Some(link)) = self.cheapest(*here, ways, arrivals, GoOnLink::extra) {
                    *here = cost;
                    arrivals[state as usize] = MoveKind::Extra.go_on(distances[state as usize], cost);
                    links.set(state as usize, link);
                    changed.push(state);
                }
            }
            if changed.len() <= here.len() / MANY {
                break;
            }
        }
        open.clear();
        open.extend(changed.iter().map(|state| CheapestFirst { cost: here[*state as usize], id: *state }));
        while let Some(CheapestFirst { cost, id }) = open.pop() {
            if cost > here[id as usize] {
                continue;
            }
            let ways = self.into.of(id as usize);
            meter.go_on(1 + ways.len() as u64)?;
            let arrival = MoveKind::Extra.go_on(distances[id as usize], cost);
            for way in ways {
                let cost = self.costs[usize::from(way.action)] + arrival;
                let known = &mut here[way.state as usize];
                if cost < *known {
                    *known = cost;
                    links.set(way.state as usize, GoOnLink::extra(way.number));
                    open.push(CheapestFirst { cost, id: way.state });
                }
            }
        }
        Ok(())
    }

    /// The least of `cost` and of what the `ways` out of a state cost, the first among equals; with the way's link, if it is one.
    #[inline]
    fn cheapest(
        &self,
        cost: f64,
        ways: &[SweepWay],
        arrivals: &[f64],
        link_by: impl Fn(u16) -> GoOnLink,
    ) -> (f64, Option<GoOnLink>) {
        // Costs are not negative, so their bits are in the same order. Which way is cheaper cannot be foreseen, so there should be no
        // branch.
        let (mut least, mut number) = (cost.to_bits(), NO_WAY);
        for way in ways {
            let cost = (self.costs[usize::from(way.action)] + arrivals[way.state as usize]).to_bits();
            let is_less = cost < least;
            number = select_unpredictable(is_less, way.number, number);
            least = select_unpredictable(is_less, cost, least);
        }
        (f64::from_bits(least), (number != NO_WAY).then(|| link_by(number)))
    }
}
