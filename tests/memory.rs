//! What searches take of the memory, measured: the most that is resident while one runs, in a process of its own.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::too_many_lines,
    clippy::cast_possible_truncation,
    reason = "tests may panic, and the process that measures prints what it measured"
)]

#[path = "../core/tests/suite/oracle/mod.rs"]
mod oracle;
#[path = "../core/tests/suite/problems.rs"]
mod problems;

use std::fs;
use std::process::Command;
use std::sync::Arc;

use etude_core::document::{Faults, Place};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Budget, HeuristicName, Mapper, Request, StoppedBy};
use etude_core::model::Limits;
use problems::{mapper, mapper_within};
use serde_json::{Value, json};

/// As in the program.
#[cfg(all(target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

/// Which case a process is to measure, and its budget.
const CASE: &str = "ETUDE_TEST_MEMORY_CASE";

/// A belt of places with a dial of ten at each, and a demonstration that turns it in a way that the body cannot.
fn belt(n_places: usize, n_observations: usize) -> (Value, Value) {
    let states: Value = (0..n_places * 10).map(|state| json!([state / 10, state % 10])).collect();
    let transitions = (0..n_places * 10).flat_map(|state| {
        let (place, dial) = (state / 10, state % 10);
        let on = (place + 1 < n_places).then(|| json!([state, "on", state + 10]));
        let back = (place > 0).then(|| json!([state, "back", state - 10]));
        on.into_iter().chain(back).chain([json!([state, "turn", place * 10 + (dial + 3) % 10])])
    });
    let model = json!({
        "attributes": [{"name": "place", "kind": "number"}, {"name": "dial", "kind": "cyclic", "period": 10}],
        "actions": [{"name": "on", "cost": 0.3}, {"name": "back", "cost": 0.3}, {"name": "turn", "cost": 0.3}],
        "dynamics": {"kind": "table", "start": 0, "states": states, "transitions": transitions.collect::<Value>()},
    });
    let seen = (0..n_observations).map(|i| json!({"place": i % n_places, "dial": i * 2 % 10}));
    (model, seen.collect())
}

/// A cave whose demonstrator walks along the walls, through a wumpus and past the gold, again and again.
fn cave(side: usize, n_gold: usize, n_observations: usize) -> (Value, Value) {
    let gold: Vec<_> = (0..n_gold).map(|k| json!([(k * 7 + 2) % side, (k * 5 + 3) % side])).collect();
    let model = json!({"dynamics": {
        "kind": "wumpus", "width": side, "height": side, "gold": gold, "wumpi": [[side - 2, 0]], "pits": [[side / 2, 1]],
    }});
    let seen = (0..n_observations).map(|i| {
        let (along, wall) = (i % side, i / side % 4);
        let (x, y) = [(along, 0), (side - 1, along), (side - 1 - along, side - 1), (0, side - 1 - along)][wall];
        let heading = ["east", "north", "west", "south"][wall];
        json!({"x": x, "y": y, "heading": heading, "gold": i / 9 % (n_gold + 1)})
    });
    (model, seen.collect())
}

/// What is measured.
struct Case {
    mapper: Mapper,
    request: Value,
    heuristic: HeuristicName,
    max_expansions: u64,
}

/// What a case is called, how it is prepared, and what it is stopped by within each of its budgets, in MB.
type Named = (&'static str, fn() -> Case, &'static [(usize, Option<StoppedBy>)]);

fn case((model, demonstration): (Value, Value)) -> Case {
    case_of(mapper(&model), &demonstration)
}

fn case_of(mapper: Mapper, demonstration: &Value) -> Case {
    let request = json!({"model": "m", "demonstration": demonstration});
    let heuristic = HeuristicName::Default;
    Case { mapper, request, heuristic, max_expansions: u64::MAX }
}

const MEMORY: Option<StoppedBy> = Some(StoppedBy::Memory);

const CASES: &[Named] = &[
    // Too few expansions for a look at all nodes, which would take less.
    (
        "best first",
        || Case { max_expansions: 10_000_000, ..case(belt(700, 3000)) },
        &[(8, MEMORY), (20, MEMORY), (48, MEMORY)],
    ),
    ("sweep", || case(belt(100, 2000)), &[(8, None), (32, None)]),
    ("layered", || case(belt(60, 100)), &[(1, None), (8, None)]),
    (
        "without heuristic",
        || Case { heuristic: HeuristicName::None, ..case(belt(400, 1000)) },
        &[(8, MEMORY), (48, MEMORY), (64, MEMORY)],
    ),
    (
        "lazily",
        || {
            let (model, demonstration) = cave(60, 20, 400);
            case_of(mapper_within(Limits { max_states: 0, ..Limits::DEFAULT }, &model), &demonstration)
        },
        &[(8, MEMORY), (48, MEMORY)],
    ),
    (
        "lookahead",
        || {
            let mut case = Case { max_expansions: 10_000_000, ..case(belt(700, 3000)) };
            case.request["lookahead"] = 1000.into();
            case
        },
        &[(20, MEMORY), (24, MEMORY)],
    ),
];

/// A number of kB that this process has in memory, by its name.
fn resident(name: &str) -> usize {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix(name)).unwrap();
    line.trim_start_matches(':').trim().trim_end_matches(" kB").parse().unwrap()
}

/// Solves a case within a budget, and gives what it was stopped by, and what it took of the memory at most, in bytes.
fn measure(case: Case, max_bytes: usize) -> (Option<StoppedBy>, usize) {
    let Case { mapper, request, heuristic, max_expansions } = case;
    let mapper = Arc::new(mapper);
    let mut faults = Faults::default();
    let object = Place::root(&request).object(Request::FIELDS, &mut faults).unwrap();
    let mut request = Request::read(mapper.model(), &object, &mut faults).unwrap();
    request.settings.heuristic = heuristic;
    request.settings.budget = Budget { max_expansions, max_bytes };
    // From here on, the peak is counted anew.
    fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = resident("VmRSS");
    let mapping = request.solve(&mapper, &mut Uninterrupted).unwrap();
    (mapping.stopped_by, (resident("VmHWM") - before) << 10)
}

/// Measures in this process, if it was started for that.
#[test]
fn measured_here() {
    let Ok(wanted) = std::env::var(CASE) else { return };
    let (name, max_bytes) = wanted.split_once(':').unwrap();
    let (_, prepare, _) = CASES.iter().find(|(known, _, _)| *known == name).unwrap();
    let (stopped_by, n_bytes) = measure(prepare(), max_bytes.parse().unwrap());
    println!("measured {n_bytes} {}", stopped_by.map_or("nothing", StoppedBy::name));
}

#[test]
fn a_search_takes_no_more_memory_than_its_budget() {
    if fs::write("/proc/self/clear_refs", "5").is_err() {
        println!("SKIPPED: this system does not tell how much memory a process takes at most");
        return;
    }
    for (name, _, budgets) in CASES {
        for (n_mb, expected) in *budgets {
            let max_bytes = n_mb << 20;
            // What is given back counts no more.
            let output = Command::new(std::env::current_exe().unwrap())
                .args(["measured_here", "--exact", "--nocapture"])
                .env(CASE, format!("{name}:{max_bytes}"))
                .env("_RJEM_MALLOC_CONF", "dirty_decay_ms:0,muzzy_decay_ms:0")
                .output()
                .unwrap();
            let output = String::from_utf8(output.stdout).unwrap();
            let measured =
                output.lines().find_map(|line| line.split_once("measured ")).unwrap_or_else(|| panic!("{output}")).1;
            let (n_bytes, stopped_by) = measured.split_once(' ').unwrap();
            let n_bytes: usize = n_bytes.parse().unwrap();
            println!("{name}: {} of {} kB, stopped by {stopped_by}", n_bytes >> 10, max_bytes >> 10);
            assert_eq!(stopped_by, expected.map_or("nothing", StoppedBy::name), "{name}, {n_mb} MB");
            // Stacks and pages of the allocator.
            assert!(n_bytes < max_bytes / 5 * 6 + (2 << 20), "{name}: {n_bytes} of {max_bytes}");
            assert!(*expected != MEMORY || n_bytes > max_bytes / 2, "{name}: only {n_bytes} of {max_bytes}");
        }
    }
}
