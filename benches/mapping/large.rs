//! Searches that take longer, of models that people have: a planner's facts, a grid of cells, and tables without any structure.

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::Settings;

use crate::grid::grid;
use crate::logistics::logistics;
use crate::{Spread, prepare, problem, table, time_often};

const N_ROUNDS: usize = 5;

pub(crate) fn measure() {
    println!("\n{:<34} {:>12} {:>36} {:>11} {:>10}", "", "observations", "time", "expansions", "cost");
    let worlds = [
        logistics(3, 2, 60, 1),
        logistics(4, 3, 60, 1),
        logistics(4, 4, 200, 1),
        table::table(100, 50, 1),
        table::table(1_000, 50, 1),
        table::table(5_000, 50, 1),
        table::table(5_000, 2_000, 1),
        grid(100, 2_000, 1),
        grid(316, 2_000, 1),
    ];
    for world in worlds {
        let mapper = prepare(&world);
        let problem = problem(&mapper, &world);
        let solve = || mapper.map(&problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts");
        let mapping = solve();
        let mut times: Vec<_> = (0..N_ROUNDS).map(|_| time_often(solve)).collect();
        let (name, n_observations) = (&world.name, problem.demonstration().len());
        let (spread, n_expanded, cost) = (Spread::of(&mut times), mapping.n_expanded, mapping.cost.total);
        println!("{name:<34} {n_observations:>12} {spread:>36} {n_expanded:>11} {cost:>10.1}");
    }
}
