//! How near to its deadline a search that is cut short answers, and how near its bound is to its cost.

use std::time::{Duration, Instant};

use etude_core::interrupt::{Signal, time_until_finish};
use etude_core::mapping::Settings;

use crate::worlds::World;
use crate::{Spread, prepare, problem, shown, table, worlds};

const N_ROUNDS: usize = 5;

pub(crate) fn measure() {
    // One that takes a few milliseconds, and one that takes a minute.
    compare(&worlds::cave(40, 8, 100, 1), &[500, 1_000, 2_000, 3_000, 4_000]);
    compare(&table::table(100_000, 2_000, 1), &[20_000, 50_000, 100_000, 500_000, 2_000_000]);
}

fn compare(world: &World, deadlines_us: &[u64]) {
    let mapper = prepare(world);
    let problem = problem(&mapper, world);
    println!("\nsearches cut short: {}, {} observations", world.name, problem.demonstration().len());
    println!("{:>12} {:>36} {:>10} {:>10} {:>12}", "deadline", "answered after", "of it", "cost", "lower bound");
    for deadline_us in deadlines_us {
        let deadline = Duration::from_micros(*deadline_us);
        let solve = || {
            let started = Instant::now();
            let finish = time_until_finish(deadline);
            let mut interrupt = || if started.elapsed() < finish { Signal::Continue } else { Signal::Finish };
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
