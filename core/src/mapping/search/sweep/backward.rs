//! What it costs to go on, exactly, from all states: one observation after the other, from the last backwards.
//!
//! This is the [recurrence](crate::mapping::recurrence) backwards, for all states at once.
//!
//! Skips and matches are done in one pass over the states. Extra actions lead to states at the same observation, so passes are repeated
//! until few states change, and Dijkstra's algorithm does the rest. Only a cheaper way replaces another, so chains of extra actions end even
//! where actions cost nothing.

use std::collections::BinaryHeap;
use std::hint::select_unpredictable;

use crate::interrupt::{Meter, Signal};
use crate::mapping::open_list::CheapestFirst;
use crate::mapping::recurrence::Recurrence;
use crate::mapping::{MoveKind, Problem};
use crate::model::{ActionIdx, Graph, Rows, StateIdx};

/// The transitions of a model, to go back over.
#[derive(Debug)]
pub(super) struct Ways {
    /// By the state that they leave.
    out: Rows<SweepWay>,
    /// The same ways, by the state to which they lead; of each, where it comes from.
    into: Rows<SweepWay>,
    /// By action; infinite for those that the body lacks.
    costs: Vec<f64>,
    /// What each way of `out` costs, in the same order; empty if that is what its action costs.
    out_costs: Vec<f64>,
    /// Likewise, of `into`.
    into_costs: Vec<f64>,
    recurrence: Recurrence,
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
    /// The ways of the body of `problem`. `None` if more leave one state than can be numbered.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn new(problem: &Problem<'_>, meter: &mut Meter<'_>) -> Result<Option<Self>, Signal> {
        let (graph, body) = (problem.model.graph(), &problem.body);
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
        let (mut out_costs, mut into_costs) = (Vec::new(), Vec::new());
        if graph.has_own_costs() {
            #[expect(clippy::cast_possible_truncation, reason = "states are counted in u32")]
            let own_costs = |from: usize| graph.own_costs(from as StateIdx);
            let costs = out.iter().enumerate().flat_map(|(from, ways)| {
                ways.iter().zip(own_costs(from)).map(|(way, own)| body.cost(way.action, Some(own)))
            });
            out_costs = costs.collect();
            let own_of = |way: &SweepWay| own_costs(way.state as usize).get(usize::from(way.number));
            into_costs = into.iter().flatten().map(|way| body.cost(way.action, own_of(way))).collect();
        }
        #[expect(clippy::cast_possible_truncation, reason = "actions are counted in u16")]
        let costs = (0..problem.model.actions().len()).map(|action| body.cost(action as ActionIdx, None)).collect();
        Ok(Some(Self { out, into, costs, out_costs, into_costs, recurrence: problem.recurrence() }))
    }

    /// What the ways out of a state cost, if not what their actions cost.
    #[inline]
    fn own_costs<'w>(costs: &'w [f64], rows: &Rows<SweepWay>, state: usize) -> &'w [f64] {
        if costs.is_empty() { &[] } else { &costs[rows.range(state)] }
    }

    /// How much memory the ways of `graph` take, in bytes.
    pub(super) fn bytes_for(graph: &Graph) -> usize {
        let cost_bytes = if graph.has_own_costs() { size_of::<f64>() } else { 0 };
        2 * (graph.n_states() * size_of::<u32>() + graph.n_transitions() * (size_of::<SweepWay>() + cost_bytes))
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
            let own = Self::own_costs(&self.out_costs, &self.out, state);
            let (cost, link) = self.cheapest(*skipped, ways, own, next, GoOnLink::matched);
            *here = cost;
            links.set(state, link.unwrap_or(GoOnLink::SKIP));
        }
        self.linger(distances, here, links, workspace, meter)
    }

    /// Makes cheaper what extra actions make cheaper.
    ///
    /// # Errors
    ///
    /// What the interrupt of `meter` said, if that was not to continue.
    pub(super) fn linger<L: NoteLinks + ?Sized>(
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
        let arrive = |distance: f64, here: f64| self.recurrence.go_on(MoveKind::Extra, distance, here);
        arrivals.extend(here.iter().zip(distances).map(|(here, distance)| arrive(*distance, *here)));
        for _ in 0..MAX_PASSES {
            changed.clear();
            for (state, (here, ways)) in (0..).zip(here.iter_mut().zip(self.out.iter())) {
                meter.go_on(1 + ways.len() as u64)?;
                let own = Self::own_costs(&self.out_costs, &self.out, state as usize);
                if let (cost, Some(link)) = self.cheapest(*here, ways, own, arrivals, GoOnLink::extra) {
                    *here = cost;
                    arrivals[state as usize] = arrive(distances[state as usize], cost);
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
            let own = Self::own_costs(&self.into_costs, &self.into, id as usize);
            let arrival = arrive(distances[id as usize], cost);
            for (n, way) in ways.iter().enumerate() {
                let cost = own.get(n).copied().unwrap_or_else(|| self.costs[usize::from(way.action)]) + arrival;
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

    /// The least of `cost` and of what the `ways` out of a state cost, the first among equals; with the way's link, if it is one. `own` is
    /// what each of them costs, if that is not what its action costs.
    #[inline]
    fn cheapest(
        &self,
        cost: f64,
        ways: &[SweepWay],
        own: &[f64],
        arrivals: &[f64],
        link_by: impl Fn(u16) -> GoOnLink,
    ) -> (f64, Option<GoOnLink>) {
        // Costs are not negative, so their bits are in the same order. Which way is cheaper cannot be foreseen, so there should be no
        // branch.
        let (mut least, mut number) = (cost.to_bits(), NO_WAY);
        for (n, way) in ways.iter().enumerate() {
            let cost = own.get(n).copied().unwrap_or_else(|| self.costs[usize::from(way.action)]);
            let cost = (cost + arrivals[way.state as usize]).to_bits();
            let is_less = cost < least;
            number = select_unpredictable(is_less, way.number, number);
            least = select_unpredictable(is_less, cost, least);
        }
        (f64::from_bits(least), (number != NO_WAY).then(|| link_by(number)))
    }
}
