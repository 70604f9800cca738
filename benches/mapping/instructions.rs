//! Instructions per solution, counted by callgrind: they do not depend on what else the machine does, so that regressions show.

use std::process::Command;

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::Settings;

use crate::worlds::{self, World};

/// The argument by which this program runs itself to solve a world's problem so many times.
pub(crate) const ALONE: &str = "--alone";

const FIGURE_4: &str = "figure-4";
const CAVE: &str = "cave";

pub(crate) fn measure() {
    println!("\ninstructions per solution, by callgrind");
    for world in [FIGURE_4, CAVE] {
        // What comes before the solutions is the same in both runs.
        match (count(world, 10), count(world, 110)) {
            (Some(few), Some(many)) => println!("{world:<26} {:>11}", (many - few) / 100),
            _ => println!("{world:<26} skipped: `valgrind --tool=callgrind` cannot be run here"),
        }
    }
}

/// Instructions of a process that solves a world's problem `n` times.
fn count(world: &str, n: u64) -> Option<u64> {
    let directory = tempfile::tempdir().ok()?;
    let out = directory.path().join("counts");
    let program = std::env::current_exe().ok()?;
    let run = Command::new("valgrind")
        .args(["--tool=callgrind", &format!("--callgrind-out-file={}", out.display())])
        .arg(program)
        .args([ALONE, world, &n.to_string()])
        .output()
        .ok()?;
    if !run.status.success() {
        return None;
    }
    let counts = std::fs::read_to_string(out).ok()?;
    counts.lines().find_map(|line| line.strip_prefix("summary: ")?.trim().parse().ok())
}

/// `world`: an example with what it starts in, `cave` or `cave-` and a seed, `cave40` or `table`.
pub(crate) fn solve_alone(world: &str, n: u64) {
    let world: World = match world {
        FIGURE_4 => worlds::example("figure-4"),
        "taxi" => {
            let mut world = worlds::example("taxi");
            world.model["dynamics"]["start"] = serde_json::json!(0);
            world
        }
        "cave40" => worlds::cave(40, 8, 100, 1),
        "table" => crate::table::table(100_000, 50, 1),
        _ => match world.strip_prefix("cave-") {
            Some(seed) => worlds::cave(20, 5, 50, seed.parse().expect("a seed")),
            None => worlds::cave(20, 5, 50, 1),
        },
    };
    let mapper = crate::prepare(&world);
    let problem = crate::problem(&mapper, &world);
    for _ in 0..n {
        std::hint::black_box(
            mapper.map(&problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts"),
        );
    }
}
