//! Following a demonstration while it is running, with a lookahead, beside mapping it as a whole: `cargo bench --bench lookahead [-- world ..]`.
//!
//! Of each world a stream of 10,000 observations is followed, with each lookahead, and the first of them are mapped as a whole; rounds of
//! all of these are interleaved, so that a machine that slows down slows all of them down. Times are microseconds of the processor an
//! observation, so that they do not tell what else the machine does: the median of nineteen observations around the one named, in all rounds;
//! and of all observations the median, the 99th percentile and the most. The whole's time is that of the median round, divided by its
//! observations.

#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]
#![expect(clippy::cast_precision_loss, reason = "counts and times here are far below 2^52")]

#[path = "mapping/grid.rs"]
mod grid;
mod worlds;

use std::hint::black_box;
use std::num::NonZeroU32;
use std::sync::Arc;

use etude_core::attribute::Value;
use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Demonstration, Mapper, OnlineMapping, Problem, Settings};
use etude_core::model::{Definition, Limits, Model};
use rustix::time::{ClockId, clock_gettime};
use worlds::World;

const N_OBSERVATIONS: usize = 10_010;

/// As many are mapped as a whole.
const N_WHOLE: usize = 1000;

const N_ROUNDS: usize = 3;

const LOOKAHEADS: [u32; 3] = [4, 8, 16];

/// The observations that are looked at closely, and how many on either side with them.
const MARKS: [usize; 3] = [10, 100, 10_000];
const HALF: usize = 9;

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    println!(
        "{:<24} {:>9} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "microseconds", "lookahead", "at 10", "at 100", "10,000", "median", "p99", "most", "whole", "median/w"
    );
    let is_wanted = |name: &str| wanted.is_empty() || wanted.iter().any(|part| part == name);
    if is_wanted("figure-4") {
        measure(&endless(worlds::example("figure-4")));
    }
    if is_wanted("cave") {
        measure(&worlds::wandered(20, 5, N_OBSERVATIONS, 1));
    }
    if is_wanted("grid") {
        measure(&grid::grid(316, N_OBSERVATIONS, 1));
    }
    if is_wanted("lazy") {
        measure(&worlds::wandered(20, 20, N_OBSERVATIONS, 1));
    }
}

/// The demonstration there and back, again and again, so that it never jumps.
fn endless(world: World) -> World {
    let there = world.demonstration.as_array().cloned().unwrap_or_default();
    let back = there.iter().rev().cloned();
    let period: Vec<_> = there.iter().cloned().chain(back).collect();
    World { demonstration: period.iter().cycle().take(N_OBSERVATIONS).cloned().collect(), ..world }
}

fn measure(world: &World) {
    let definition = Definition::read(&world.model, Limits::DEFAULT, &mut Uninterrupted).expect("it has no faults");
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).expect("there is room for it");
    let mapper = Arc::new(Mapper::new(model, &mut Uninterrupted).expect("nothing interrupts"));
    let schema = mapper.model().schema();
    let states = world.demonstration.as_array().expect("a demonstration is an array");
    let read = |state| schema.read_observation(&Place::root(state), &mut Faults::default()).expect("it has no faults");
    let observations: Vec<Vec<Option<Value>>> = states.iter().map(read).collect();
    let mut followed: Vec<Vec<Vec<f64>>> = vec![Vec::new(); LOOKAHEADS.len()];
    let mut whole = Vec::new();
    for _ in 0..N_ROUNDS {
        whole.push(map(&mapper, &observations[..N_WHOLE]));
        for (lookahead, rounds) in LOOKAHEADS.into_iter().zip(&mut followed) {
            rounds.push(follow(&mapper, &observations, lookahead));
        }
    }
    let n_states = mapper.model().states().len();
    let size = if mapper.model().is_lazy() { "lazy".to_owned() } else { format!("{n_states} states") };
    println!("{}, {size}", world.name);
    let whole = quantile(whole, 0.5);
    for (lookahead, rounds) in LOOKAHEADS.into_iter().zip(followed) {
        let around = |mark: usize| rounds.iter().flat_map(|times| &times[mark - HALF..=mark + HALF]).copied().collect();
        let [at_10, at_100, at_10_000] = MARKS.map(|mark| quantile(around(mark), 0.5));
        let all: Vec<f64> = rounds.concat();
        let [median, p99, most] = [0.5, 0.99, 1.0].map(|part| quantile(all.clone(), part));
        println!(
            "{:<24} {lookahead:>9} {at_10:>8.1} {at_100:>8.1} {at_10_000:>8.1} {median:>8.1} {p99:>8.1} {most:>8.0} {whole:>8.1} {:>8.2}",
            "",
            median / whole
        );
    }
}

/// Microseconds of each observation.
fn follow(mapper: &Arc<Mapper>, observations: &[Vec<Option<Value>>], lookahead: u32) -> Vec<f64> {
    let weights = mapper.model().schema().weights();
    let mut online = OnlineMapping::new(mapper, weights, Conditions::default(), NonZeroU32::new(lookahead));
    let timed = observations.iter().map(|observation| {
        let started = processor_us();
        black_box(online.observe(observation, None, &mut Uninterrupted).expect("nothing interrupts"));
        processor_us() - started
    });
    timed.collect()
}

/// Microseconds an observation of the mapping of the whole, the problem included.
fn map(mapper: &Mapper, observations: &[Vec<Option<Value>>]) -> f64 {
    let started = processor_us();
    let demonstration = Demonstration::of(observations.iter().cloned()).expect("there are observations");
    let weights = mapper.model().schema().weights();
    let problem = Problem::new(mapper.model(), demonstration, weights, Conditions::default());
    black_box(mapper.map(&problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts"));
    (processor_us() - started) / observations.len() as f64
}

/// Microseconds that this thread has had a processor.
fn processor_us() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e6 + time.tv_nsec as f64 / 1e3
}

/// The least of `values` that so large a part of them do not exceed.
fn quantile(mut values: Vec<f64>, part: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index")]
    let at = ((values.len() - 1) as f64 * part).round() as usize;
    values[at]
}
