//! How near to its deadline a search that is cut short answers, and how near its bound is to its cost.

use std::time::{Duration, Instant};

use etude::interrupt::Signal;
use etude::mapping::Settings;

use crate::{Spread, prepare, problem, shown, table};

const N_ROUNDS: usize = 5;

pub(crate) fn measure() {
    let world = table::table(100_000, 2_000, 1);
    println!("\nsearches cut short: {}, 2,000 observations", world.name);
    println!("{:>12} {:>36} {:>10} {:>10} {:>12}", "deadline", "answered after", "of it", "cost", "lower bound");
    let mapper = prepare(&world);
    let problem = problem(&mapper, &world);
    for deadline_ms in [20, 50, 100, 500, 2_000] {
        let deadline = Duration::from_millis(deadline_ms);
        let solve = || {
            let started = Instant::now();
            let mut interrupt = || if started.elapsed() < deadline { Signal::Continue } else { Signal::Finish };
            let mapping = mapper.map(&problem, Settings::default(), &mut interrupt).expect("nothing cancels");
            (mapping, started.elapsed())
        };
        let (mapping, _) = solve();
        let mut times: Vec<Duration> = (0..N_ROUNDS).map(|_| solve().1).collect();
        let spread = Spread::of(&mut times);
        println!(
            "{:>12} {spread:>36} {:>10.3} {:>10.1} {:>12.1}",
            shown(deadline),
            spread.median.as_secs_f64() / deadline.as_secs_f64(),
            mapping.cost.total,
            mapping.lower_bound.unwrap_or(0.0),
        );
    }
}
