//! The mapping against its peers on the same problems, in one run: `cargo bench --bench mapping [-- part ..]`, where a part is `peers`,
//! `caves`, `large`, `growth`, `deadline`, `limit` or `instructions`; all if none is named.
//!
//! Every solver is given the problem ready: models are compiled, and terms of distances are tabulated by observation and value,
//! for the peers too. Rounds are interleaved, so that a machine that slows down slows all of them down; in each, a solver
//! solves as often as takes a hundredth of a second. Times are per solution: the median of the rounds, and in brackets
//! the least and the most. What takes seconds is solved once. All solvers must come to the same cost, but for the paper's heuristic,
//! which may cost more.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]
#![expect(clippy::cast_precision_loss, reason = "counts and costs here are far below 2^52")]

mod deadline;
mod grid;
mod growth;
mod instructions;
mod large;
mod limit;
mod logistics;
mod peers;
mod table;
#[path = "../worlds/mod.rs"]
mod worlds;

use std::time::{Duration, Instant};

use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{HeuristicName, Mapper, Problem, Request, Settings};
use etude_core::model::{Definition, Limits, Model};
use peers::{Peer, Solved};
use serde_json::json;
use worlds::World;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    if let [flag, world, n] = arguments.as_slice()
        && flag == instructions::ALONE
    {
        instructions::solve_alone(world, n.parse().expect("a number of solutions"));
        return;
    }
    let is_wanted = |part: &str| arguments.is_empty() || arguments.iter().any(|argument| argument == part);
    if is_wanted("peers") {
        for world in [
            worlds::example("figure-4"),
            worlds::example("taxi"),
            worlds::cave(20, 5, 50, 1),
            worlds::cave(40, 8, 100, 1),
            table::table(100_000, 50, 1),
        ] {
            compare(&world, true);
        }
    }
    if is_wanted("caves") {
        compare_caves();
    }
    if is_wanted("large") {
        large::measure();
    }
    if is_wanted("growth") {
        growth::measure();
    }
    if is_wanted("deadline") {
        deadline::measure();
    }
    if is_wanted("limit") {
        limit::measure();
    }
    if is_wanted("instructions") {
        instructions::measure();
    }
}

/// A prepared model.
fn prepare(world: &World) -> Mapper {
    let definition = Definition::read(&world.model, Limits::NONE, &mut Uninterrupted).expect("worlds are models");
    let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).expect("worlds are small enough");
    Mapper::new(model, &mut Uninterrupted).expect("nothing interrupts")
}

/// The problem of a world.
fn problem<'m>(mapper: &'m Mapper, world: &World) -> Problem<'m> {
    let request = json!({"model": "m", "demonstration": world.demonstration});
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).expect("a request is an object");
    let request = Request::read(mapper.model(), &object, &mut faults);
    request.expect("worlds have their demonstrations").problem
}

type Solver<'a> = Box<dyn Fn() -> Solved + 'a>;

/// The peers on ten caves, drawn from seeds, and the worst of these.
fn compare_caves() {
    let compared: Vec<Ratios> = (1..=10).map(|seed| compare(&worlds::cave(20, 5, 50, seed), false)).collect();
    let least = |of: fn(&Ratios) -> f64| compared.iter().map(of).fold(f64::INFINITY, f64::min);
    println!("\nThe worst of ten caves, as multiples of etude's time:");
    println!("pathfinding A*, paper's    {:.1}", least(|ratios| ratios.paper));
    println!("the fastest of the others  {:.1}", least(|ratios| ratios.fastest));
}

/// Times of peers, as multiples of etude's.
struct Ratios {
    /// Of `pathfinding` with the paper's heuristic.
    paper: f64,
    /// Of the fastest that has its estimates from elsewhere.
    fastest: f64,
}

/// `layered`: Dijkstra's algorithm on all layers as well, which takes long.
fn compare(world: &World, layered: bool) -> Ratios {
    const N_ROUNDS: usize = 7;
    const PAPER: &str = "pathfinding A*, paper's";
    let started = Instant::now();
    let mapper = &prepare(world);
    let prepared = started.elapsed();
    let problem = &problem(mapper, world);
    let peer = &Peer::new(mapper.model(), problem);
    let graph = mapper.model().graph();
    println!(
        "\n{}: {} states, {} transitions (read and prepared in {}), {} observations",
        world.name,
        graph.n_states(),
        graph.n_transitions(),
        shown(prepared),
        problem.demonstration().len(),
    );

    let etude = |heuristic| {
        let settings = Settings { heuristic, ..Settings::default() };
        move || {
            let mapping = mapper.map(problem, settings, &mut Uninterrupted).expect("nothing interrupts");
            Solved { cost: mapping.cost.total, n_expanded: mapping.n_expanded, n_steps: Some(mapping.moves.len()) }
        }
    };
    let bound = mapper.lower_bounds(problem);
    let mut solvers: Vec<(&str, Solver<'_>)> = vec![
        ("etude", Box::new(etude(HeuristicName::Default))),
        ("etude, no heuristic", Box::new(etude(HeuristicName::None))),
        (PAPER, Box::new(|| peer.pathfinding(|node| peer.paper(node)))),
        ("pathfinding A*, ours", Box::new(|| peer.pathfinding(|(i, state)| peers::micro_floor(bound(i, state))))),
        ("pathfinding A*, none", Box::new(|| peer.pathfinding(|_| 0))),
        ("petgraph A*, none", Box::new(|| peer.petgraph(|_| 0))),
    ];
    if layered {
        solvers.push(("layered Dijkstra", Box::new(|| peer.layered())));
    }
    let (solved, once): (Vec<Solved>, Vec<Duration>) = solvers.iter().map(|(_, solve)| timed(solve)).unzip();
    let mut times = vec![Vec::with_capacity(N_ROUNDS); solvers.len()];
    for _ in 0..N_ROUNDS {
        for (((_, solve), once), times) in solvers.iter().zip(&once).zip(&mut times) {
            times.push(if *once > Duration::from_secs(2) { *once } else { time_often(solve) });
        }
    }

    println!("{:<26} {:>8} {:>11} {:>36} {:>8}", "", "cost", "expansions", "time", "ratio");
    let first = Spread::of(&mut times[0]).median;
    let mut ratios = Ratios { paper: f64::INFINITY, fastest: f64::INFINITY };
    for (((name, _), mut times), Solved { cost, n_expanded, n_steps }) in solvers.iter().zip(times).zip(&solved) {
        let spread = Spread::of(&mut times);
        let ratio = spread.median.as_secs_f64() / first.as_secs_f64();
        println!("{name:<26} {cost:>8.1} {n_expanded:>11} {spread:>36} {ratio:>8.1}");
        let is_exact = !name.contains("paper");
        assert!(!is_exact || (cost - solved[0].cost).abs() < 1e-3, "{name} found {cost}");
        if let Some(n_steps) = n_steps {
            println!("{:<26} {n_steps} steps, {:.1} expansions a step", "", *n_expanded as f64 / *n_steps as f64);
        }
        if *name == PAPER {
            ratios.paper = ratio;
        }
        if !name.starts_with("etude") && !name.contains("ours") {
            ratios.fastest = ratios.fastest.min(ratio);
        }
    }
    println!("the fastest peer with estimates of its own takes {:.1} times as long", ratios.fastest);
    ratios
}

fn timed<T>(solve: impl Fn() -> T) -> (T, Duration) {
    let started = Instant::now();
    let solved = std::hint::black_box(solve());
    (solved, started.elapsed())
}

/// The time of a solution, of as many as take a hundredth of a second.
fn time_often<T>(solve: impl Fn() -> T) -> Duration {
    let started = Instant::now();
    let mut n_solved = 0;
    while n_solved == 0 || started.elapsed() < Duration::from_millis(10) {
        std::hint::black_box(solve());
        n_solved += 1;
    }
    started.elapsed() / n_solved
}

/// The median of times, with the least and the most.
struct Spread {
    least: Duration,
    median: Duration,
    most: Duration,
}

impl Spread {
    fn of(times: &mut [Duration]) -> Self {
        times.sort_unstable();
        Self { least: times[0], median: times[times.len() / 2], most: times[times.len() - 1] }
    }
}

impl std::fmt::Display for Spread {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { least, median, most } = self;
        formatter.pad(&format!("{} [{} .. {}]", shown(*median), shown(*least), shown(*most)))
    }
}

fn shown(time: Duration) -> String {
    let ms = time.as_secs_f64() * 1000.0;
    match ms {
        ..1.0 => format!("{ms:.3} ms"),
        ..10.0 => format!("{ms:.2} ms"),
        ..1000.0 => format!("{ms:.0} ms"),
        _ => format!("{:.1} s", ms / 1000.0),
    }
}
