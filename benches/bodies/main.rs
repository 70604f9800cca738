//! Bodies that are told by rules and by planning tasks: `cargo bench -p etude-core --features rules --bench bodies [-- part ..]`, where a part is `rules` or `planning`; both if
//! none is named. Rounds of what is compared are interleaved, so that a machine that slows down slows all of it down. Times are medians, and in
//! brackets the least and the most.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

#[expect(clippy::unwrap_used, reason = "it is the tests' own")]
#[path = "../../core/tests/suite/rules/cave.rs"]
mod cave;
mod planning;
mod rules;
#[path = "../worlds/mod.rs"]
mod worlds;

use std::time::{Duration, Instant};

use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{HeuristicName, Mapper, Mapping, Problem, Request, Settings};
use etude_core::model::{Definition, Limits, Model};
use serde_json::{Value, json};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    let is_wanted = |part: &str| arguments.is_empty() || arguments.iter().any(|argument| argument == part);
    if is_wanted("rules") {
        rules::measure();
    }
    if is_wanted("planning") {
        planning::measure();
    }
}

/// What is found beforehand: every state, or none.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Known {
    All,
    Nothing,
}

fn mapper(definition: &Definition, known: Known) -> Mapper {
    let limits = if known == Known::All { Limits::NONE } else { Limits { max_states: 0, ..Limits::NONE } };
    let model = Model::compile(definition, limits, &mut Uninterrupted).expect("worlds are without faults");
    assert_eq!(model.is_lazy(), known == Known::Nothing);
    Mapper::new(model, &mut Uninterrupted).expect("nothing interrupts")
}

fn problem<'m>(mapper: &'m Mapper, demonstration: &Value) -> Problem<'m> {
    let request = json!({"model": "m", "demonstration": demonstration});
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).expect("a request is an object");
    Request::read(mapper.model(), &object, &mut faults).expect("worlds have their demonstrations").problem
}

fn map(mapper: &Mapper, problem: &Problem<'_>, heuristic: HeuristicName) -> Mapping {
    let settings = Settings { heuristic, ..Settings::default() };
    mapper.map(problem, settings, &mut Uninterrupted).expect("nothing interrupts")
}

fn timed<T>(run: impl FnOnce() -> T) -> (T, Duration) {
    let started = Instant::now();
    let done = std::hint::black_box(run());
    (done, started.elapsed())
}

/// The median of figures, with the least and the most.
fn spread(mut figures: Vec<f64>) -> String {
    figures.sort_by(f64::total_cmp);
    let shown = |figure: f64| match figure {
        ..10.0 => format!("{figure:.2}"),
        ..100.0 => format!("{figure:.1}"),
        _ => format!("{figure:.0}"),
    };
    let [least, median, most] = [0, figures.len() / 2, figures.len() - 1].map(|n| shown(figures[n]));
    format!("{median} [{least} .. {most}]")
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1000.0
}
