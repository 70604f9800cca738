//! How far a search is from what the memory allows: from the time that it takes to read as many cache lines, at random places of as
//! much memory as its nodes take.
//!
//! A search that does nothing but look would still look at a place of its index and at costs for each action, which makes two
//! successors, and at an entry of its open list, a node, its estimate and its transitions for each expansion. If all of these
//! reads overlapped, they would take what independent reads take; if each waited for the one before, what dependent reads take.

use std::hint::black_box;
use std::time::Duration;

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::Settings;

use crate::worlds::{self, SplitMix, World};
use crate::{Spread, prepare, problem, shown, table, time_often};

const N_ROUNDS: usize = 7;

/// What a search keeps of a node, with its place in the index, in bytes.
const NODE_BYTES: u64 = 64;

pub(crate) fn measure() {
    println!("\nreads of as many cache lines as a search looks at");
    println!(
        "{:<26} {:>9} {:>9} {:>24} {:>14} {:>14}",
        "", "lines", "kept", "search", "of independent", "of dependent"
    );
    for world in [
        worlds::example("figure-4"),
        worlds::cave(20, 5, 50, 1),
        worlds::cave(40, 8, 100, 1),
        table::table(100_000, 50, 1),
    ] {
        compare(&world);
    }
}

fn compare(world: &World) {
    let mapper = prepare(world);
    let problem = problem(&mapper, world);
    let solve = || mapper.map(&problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts");
    let mapping = solve();
    let n_lines = mapping.n_generated + 4 * mapping.n_expanded;
    let memory = Memory::of(mapping.n_expanded * NODE_BYTES);
    let mut times = [const { Vec::new() }; 3];
    for _ in 0..N_ROUNDS {
        times[0].push(time_often(solve));
        times[1].push(time_often(|| memory.read_independently(n_lines)));
        times[2].push(time_often(|| memory.read_dependently(n_lines)));
    }
    let [search, independent, dependent] = times.map(|mut times| Spread::of(&mut times));
    let ratio = |limit: Duration| search.median.as_secs_f64() / limit.as_secs_f64();
    println!(
        "{:<26} {n_lines:>9} {:>6} kB {:>24} {:>14.2} {:>14.2}",
        world.name,
        memory.lines.len() * 64 / 1000,
        shown(search.median),
        ratio(independent.median),
        ratio(dependent.median),
    );
}

/// Cache lines, each of which names another: following them comes to all.
struct Memory {
    lines: Vec<[u64; 8]>,
}

impl Memory {
    fn of(n_bytes: u64) -> Self {
        let n_lines = (n_bytes / 64).max(2);
        let mut next: Vec<u64> = (0..n_lines).collect();
        let mut random = SplitMix(1);
        // A single cycle through all (Sattolo 1986).
        for last in (1..n_lines).rev() {
            next.swap(index(last), index(below(&mut random, last)));
        }
        Self { lines: next.into_iter().map(|next| [next; 8]).collect() }
    }

    fn read_independently(&self, n_lines: u64) -> u64 {
        let n = self.lines.len() as u64;
        let mut sum = 0;
        for k in 0..n_lines {
            // The upper bits of a product, of which the lower ones are spread evenly: a random place without waiting for the last.
            let place = (u128::from(k.wrapping_mul(0x9e37_79b9_7f4a_7c15)) * u128::from(n)) >> 64;
            sum ^= self.lines[usize::try_from(place).unwrap_or(0)][0];
        }
        black_box(sum)
    }

    fn read_dependently(&self, n_lines: u64) -> u64 {
        let mut at = 0;
        for _ in 0..n_lines {
            at = self.lines[index(at)][0];
        }
        black_box(at)
    }
}

fn below(random: &mut SplitMix, bound: u64) -> u64 {
    u64::try_from(random.below(i64::try_from(bound).unwrap_or(1))).unwrap_or(0)
}

fn index(n: u64) -> usize {
    usize::try_from(n).unwrap_or(0)
}
