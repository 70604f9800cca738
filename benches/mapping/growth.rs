//! How time and memory grow with the demonstration and with the model.

use std::io::{self, BufReader, Read};
use std::time::{Duration, Instant};

use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Settings};
use etude_core::model::{Definition, Format, Limits, Model, Origin};
use serde_json::{Value, json};

use crate::{Spread, shown, time_often};

const N_ROUNDS: usize = 5;
/// A belt of places in a row, each of so many states: those that a body can be in there.
const STATES_PER_PLACE: u64 = 10;

pub(crate) fn measure() {
    println!("\ntime against observations: a belt of 1,000 states");
    let mapper = prepare(1_000);
    let mut points = Vec::new();
    for n_observations in [10, 100, 1_000, 10_000, 100_000] {
        let problem = problem(&mapper, n_observations);
        let time = time(&mapper, &problem, n_observations);
        points.push((n_observations, time));
    }
    println!("time grows as observations^{:.2}", exponent(&points));

    println!("\ntime against states: belts, 50 observations");
    let mut points = Vec::new();
    for n_states in [100, 1_000, 10_000, 100_000, 1_000_000, 10_000_000] {
        let started = Instant::now();
        let mapper = prepare(n_states);
        let prepared = started.elapsed();
        let problem = problem(&mapper, 50);
        let time = time(&mapper, &problem, n_states);
        let n_transitions = mapper.model().graph().n_transitions();
        println!(
            "{:<12} {n_transitions} transitions, read and prepared in {}, {:.1} bytes a state with its transitions",
            "",
            shown(prepared),
            mapper.size_bytes() as f64 / n_states as f64,
        );
        points.push((n_states, time));
    }
    println!("time grows as states^{:.2}", exponent(&points));
}

fn time(mapper: &Mapper, problem: &Problem<'_>, n: u64) -> Duration {
    let solve = || mapper.map(problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts");
    let mapping = solve();
    let mut times: Vec<Duration> = (0..N_ROUNDS).map(|_| time_often(solve)).collect();
    let spread = Spread::of(&mut times);
    println!("{n:>12} {spread:>36} {:>11} expansions, cost {:.1}", mapping.n_expanded, mapping.cost.total);
    spread.median
}

/// The slope of the line that fits the logarithms best.
fn exponent(points: &[(u64, Duration)]) -> f64 {
    let logarithms: Vec<(f64, f64)> =
        points.iter().map(|(n, time)| ((*n as f64).ln(), time.as_secs_f64().ln())).collect();
    let n = logarithms.len() as f64;
    let mean = |part: fn(&(f64, f64)) -> f64| logarithms.iter().map(part).sum::<f64>() / n;
    let (x, y) = (mean(|point| point.0), mean(|point| point.1));
    let covariance: f64 = logarithms.iter().map(|point| (point.0 - x) * (point.1 - y)).sum();
    let variance: f64 = logarithms.iter().map(|point| (point.0 - x) * (point.0 - x)).sum();
    covariance / variance
}

/// A belt: the body goes along it, and at each place turns a dial of ten, by one or by three at a time; the demonstrator
/// turned it by two.
fn prepare(n_states: u64) -> Mapper {
    let text = BufReader::new(Belt { n_places: n_states / STATES_PER_PLACE, next: 0, text: io::Cursor::default() });
    let definition =
        Definition::parse_from(text, Format::Ndjson, Limits::NONE, &mut Uninterrupted).expect("a belt is a model");
    let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).expect("a belt is a model");
    drop(definition);
    Mapper::new(model, &mut Uninterrupted).expect("nothing interrupts")
}

fn problem(mapper: &Mapper, n_observations: u64) -> Problem<'_> {
    let n_places = mapper.model().graph().n_states() as u64 / STATES_PER_PLACE;
    // There and back again.
    let place = |i: u64| {
        let at = i % (2 * n_places - 1).max(1);
        at.min((2 * n_places).saturating_sub(2 + at))
    };
    let demonstration: Value = (0..n_observations).map(|i| json!({"place": place(i), "dial": i * 2 % 10})).collect();
    let model = mapper.model();
    let mut faults = Faults::default();
    let read = Demonstration::read(model.schema(), &Place::root(&demonstration), &mut faults);
    let demonstration = faults.check(read).expect("the demonstration is of the belt");
    Problem::new(model, demonstration, model.schema().weights(), Conditions::starting_at(Origin::State(0)))
}

/// Writes the belt as it is read.
struct Belt {
    n_places: u64,
    /// The next line to write, the first being the head.
    next: u64,
    text: io::Cursor<Vec<u8>>,
}

impl Belt {
    fn write_next(&mut self) -> Option<Value> {
        let n = self.next;
        self.next += 1;
        let state = |place: u64, dial: u64| place * STATES_PER_PLACE + dial % STATES_PER_PLACE;
        if n == 0 {
            return Some(json!({
                "attributes": [{"name": "place", "kind": "number"}, {"name": "dial", "kind": "cyclic", "period": 10}],
                "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}, {"name": "turn", "cost": 0.3}, {"name": "spin", "cost": 0.5}],
                "dynamics": {"kind": "table", "start": 0},
            }));
        }
        let dials = 0..STATES_PER_PLACE;
        if n <= self.n_places {
            let place = n - 1;
            return Some(json!({"states": dials.map(|dial| json!([place, dial])).collect::<Vec<_>>()}));
        }
        let place = n.checked_sub(self.n_places + 1).filter(|place| *place < self.n_places)?;
        let transitions = dials.flat_map(|dial| {
            let from = state(place, dial);
            let on = (place + 1 < self.n_places).then(|| json!([from, 0, state(place + 1, dial)]));
            let back = (place > 0).then(|| json!([from, 1, state(place - 1, dial)]));
            let turns = [json!([from, 2, state(place, dial + 1)]), json!([from, 3, state(place, dial + 3)])];
            on.into_iter().chain(back).chain(turns)
        });
        Some(json!({"transitions": transitions.collect::<Vec<_>>()}))
    }
}

impl Read for Belt {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            let n_read = self.text.read(buffer)?;
            if n_read > 0 {
                return Ok(n_read);
            }
            let Some(line) = self.write_next() else { return Ok(0) };
            self.text = io::Cursor::new(format!("{line}\n").into_bytes());
        }
    }
}
