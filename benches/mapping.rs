//! The mapping against `pathfinding`'s A* on the same problems, in one run.
//!
//! Every solver is given the problem ready: models are compiled, and for the peer distances are tabulated per observation
//! and state, which is more than it would have in use. Rounds are interleaved, so that a machine that slows down slows
//! all of them down. Times are per solution: the median, and in brackets the least and the most.

#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

mod worlds;

use std::cell::Cell;
use std::time::{Duration, Instant};

use etude::attribute::Schema;
use etude::document::{Faults, Place};
use etude::interrupt::Uninterrupted;
use etude::mapping::{HeuristicName, Mapper, Request, Settings};
use etude::model::{Definition, Limits, Model};
use pathfinding::prelude::astar;
use serde_json::json;
use worlds::World;

const N_ROUNDS: usize = 7;

fn main() {
    let only = std::env::var("ONLY").unwrap_or_default();
    for world in [
        worlds::example("figure-4"),
        worlds::cave(20, 5, 50, 1),
        worlds::example("taxi"),
        worlds::cave(40, 8, 100, 1),
        worlds::table(100_000, 50, 1),
    ] {
        if world.name.contains(&only) {
            measure(&world);
        }
    }
}

fn measure(world: &World) {
    let definition =
        Definition::read(&world.model, Limits { max_states: 20_000_000, ..Limits::DEFAULT }, &mut Uninterrupted)
            .expect("worlds are models");
    let started = Instant::now();
    let model = Model::compile(&definition, Limits { max_states: 20_000_000, ..Limits::DEFAULT }, &mut Uninterrupted)
        .expect("worlds are small enough");
    let mapper = &Mapper::new(model, &mut Uninterrupted).expect("nothing interrupts");
    let compiled = started.elapsed();
    let graph = mapper.model().graph();
    let start = {
        let request = json!({"model": "m", "demonstration": world.demonstration});
        let mut faults = Faults::default();
        let object = Place::root(&request).object(&Request::FIELDS, &mut faults).expect("a request is an object");
        Request::read(mapper.model(), &object, &mut faults).expect("worlds have their demonstrations").problem.start()
    };
    let peer = Peer::new(mapper, world, start);
    println!(
        "\n{}: {} states, {} transitions (compiled in {}), {} observations",
        world.name,
        graph.n_states(),
        graph.n_transitions(),
        shown(compiled),
        peer.n_observations(),
    );

    let etude = |heuristic| {
        let request = json!({"model": "m", "demonstration": world.demonstration});
        let mut faults = Faults::default();
        let object = Place::root(&request).object(&Request::FIELDS, &mut faults).expect("a request is an object");
        let request = Request::read(mapper.model(), &object, &mut faults).expect("worlds have their demonstrations");
        let settings = Settings { heuristic, ..Settings::default() };
        move || {
            let mapping = mapper.map(&request.problem, settings, &mut Uninterrupted).expect("nothing interrupts");
            Solved { cost: mapping.cost.total, n_expanded: mapping.n_expanded }
        }
    };
    let mut solvers: Vec<(&str, Solver<'_>)> = vec![
        ("etude, default", Box::new(etude(HeuristicName::Default))),
        ("etude, none", Box::new(etude(HeuristicName::None))),
        ("pathfinding astar, paper", Box::new(|| peer.solve(|node| peer.paper(*node)))),
        ("pathfinding astar, none", Box::new(|| peer.solve(|_| 0))),
    ];
    let mut times = vec![Vec::with_capacity(N_ROUNDS); solvers.len()];
    for _ in 0..N_ROUNDS {
        for ((_, solve), times) in solvers.iter().zip(&mut times) {
            let started = Instant::now();
            std::hint::black_box(solve());
            times.push(started.elapsed());
        }
    }

    println!("{:<26} {:>8} {:>11} {:>32} {:>8}", "", "cost", "expansions", "time", "ratio");
    let mut first = None;
    for ((name, solve), mut times) in solvers.drain(..).zip(times) {
        times.sort_unstable();
        let (least, median, most) = (times[0], times[N_ROUNDS / 2], times[N_ROUNDS - 1]);
        let ratio = median.as_secs_f64() / first.get_or_insert(median).as_secs_f64();
        let time = format!("{} [{} .. {}]", shown(median), shown(least), shown(most));
        let Solved { cost, n_expanded } = solve();
        println!("{name:<26} {cost:>8.1} {n_expanded:>11} {time:>32} {ratio:>8.1}");
    }
}

fn shown(time: Duration) -> String {
    let ms = time.as_secs_f64() * 1000.0;
    if ms < 10.0 { format!("{ms:.2} ms") } else { format!("{ms:.0} ms") }
}

type Solver<'a> = Box<dyn Fn() -> Solved + 'a>;

struct Solved {
    cost: f64,
    n_expanded: u64,
}

/// Costs as the peer adds them, in millionths: integers are totally ordered, and exact here.
type MicroCost = u64;

/// A node: observation and state.
type Node = (u32, u32);

/// The same problem for a general A*.
struct Peer<'m> {
    mapper: &'m Mapper,
    start: u32,
    /// Terms of the distance by the state's value. Shape `[n_observations][n_attributes][domain size]`.
    terms: Vec<Vec<Vec<MicroCost>>>,
    action_costs: Vec<MicroCost>,
    n_expanded: Cell<u64>,
}

impl<'m> Peer<'m> {
    fn new(mapper: &'m Mapper, world: &World, start: u32) -> Self {
        let model = mapper.model();
        let observations = world.demonstration.as_array().expect("a demonstration is an array");
        let terms = observations.iter().map(|observation| terms(model, &observe(model.schema(), observation)));
        let action_costs = model.actions().iter().map(|action| micro(action.cost)).collect();
        Self { mapper, start, terms: terms.collect(), action_costs, n_expanded: Cell::new(0) }
    }

    fn n_observations(&self) -> usize {
        self.terms.len()
    }

    fn distance(&self, (i, state): Node) -> MicroCost {
        self.terms_of(i as usize, state).sum()
    }

    /// The terms of a distance, by attribute.
    fn terms_of(&self, i: usize, state: u32) -> impl Iterator<Item = MicroCost> {
        let values = self.mapper.model().states().row(state);
        self.terms[i].iter().zip(values).map(|(terms, value)| terms[*value as usize])
    }

    fn solve(&self, heuristic: impl Fn(&Node) -> MicroCost) -> Solved {
        self.n_expanded.set(0);
        let last = u32::try_from(self.n_observations() - 1).expect("demonstrations are short");
        let graph = self.mapper.model().graph();
        let successors = |&(i, state): &Node| {
            self.n_expanded.set(self.n_expanded.get() + 1);
            let skip = (i < last).then_some((i + 1, state)).map(|node| (node, self.distance(node)));
            let moves = graph.successors(state).iter().flat_map(move |transition| {
                let cost = self.action_costs[usize::from(transition.action)];
                let extra = Some((i, transition.to));
                let matched = (i < last).then_some((i + 1, transition.to));
                [matched, extra].into_iter().flatten().map(move |node| (node, cost + self.distance(node)))
            });
            skip.into_iter().chain(moves).collect::<Vec<_>>()
        };
        let start = (0, self.start);
        let (_, cost) = astar(&start, successors, heuristic, |&(i, _)| i == last).expect("there is always a mapping");
        #[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
        let cost = (self.distance(start) + cost) as f64 / 1e6;
        Solved { cost, n_expanded: self.n_expanded.get() }
    }

    /// The paper's estimate.
    fn paper(&self, (i, state): Node) -> MicroCost {
        let last = self.n_observations() - 1;
        let ahead = i as usize + 1..=last;
        let Some(j) = ahead.min_by_key(|j| self.terms_of(*j, state).sum::<MicroCost>()) else { return 0 };
        let least = self.action_costs.iter().copied().min().unwrap_or(0);
        let mut terms: Vec<MicroCost> = self.terms_of(j, state).filter(|term| *term > 0).collect();
        terms.sort_unstable_by(|a, b| b.cmp(a));
        let mut remaining: MicroCost = terms.iter().sum();
        let mut estimate = 0;
        for term in terms {
            remaining -= term;
            estimate += remaining + least;
        }
        estimate + (last - j) as MicroCost * least
    }
}

fn observe(schema: &Schema, observation: &serde_json::Value) -> Vec<Option<etude::attribute::Value>> {
    schema
        .read_observation(&Place::root(observation), &mut Faults::default())
        .expect("worlds have their demonstrations")
}

/// Shape `[n_attributes][domain size]`.
fn terms(model: &Model, observed: &[Option<etude::attribute::Value>]) -> Vec<Vec<MicroCost>> {
    let attributes = model.schema().attributes().iter().zip(observed).enumerate();
    let terms = attributes.map(|(position, (attribute, observed))| {
        let term = |own| observed.as_ref().map_or(0, |observed| micro(attribute.term(attribute.weight, observed, own)));
        model.states().domain(position).iter().map(term).collect()
    });
    terms.collect()
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "costs here are small and positive")]
fn micro(cost: f64) -> MicroCost {
    (cost * 1e6).round() as MicroCost
}
