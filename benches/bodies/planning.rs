//! Planning tasks that are searched lazily, beside Fast Downward.
//!
//! A demonstration of the states along a plan is followed by the body that it is of, and by one that lacks an action, guided and without a
//! heuristic. Fast Downward searches for a plan of the same body: what is asked of it is another question, but of the same states and operators. Its program is that of the package
//! `up-fast-downward` on `PyPI` (61 MB); without it, only etude is measured:
//!
//! ```sh
//! pip install --no-deps --target fd up-fast-downward==1.0.0
//! ETUDE_FAST_DOWNWARD=$PWD/fd/up_fast_downward/downward/builds/release/bin/downward cargo bench -p etude-core --features rules --bench bodies -- planning
//! ```

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::HeuristicName;
use etude_core::model::{Definition, Edits, Implicit, ImportFile, ImportFormat, Limits, Planning, import};
use serde_json::{Value, json};

use crate::{Known, map, mapper, ms, problem, spread, timed};

const N_ROUNDS: usize = 5;

/// How Fast Downward searches: for a plan of least cost, and for any plan. A minute at most.
const SEARCHES: [(&str, &str); 2] = [
    ("astar(lmcut())", "astar(lmcut(),max_time=60)"),
    ("lazy_greedy(ff())", "lazy_greedy([ff()],preferred=[ff()],max_time=60)"),
];

pub(crate) fn measure() {
    println!("\nplanning tasks: ms of {N_ROUNDS} rounds, expansions");
    let planner = std::env::var("ETUDE_FAST_DOWNWARD").ok();
    if planner.is_none() {
        println!("NOT MEASURED: Fast Downward; set ETUDE_FAST_DOWNWARD to its program");
    }
    for (name, lacks) in [
        ("blocksworld-8", None),
        // Of the tower that is to be built, every operator is needed: there is no plan without one.
        ("blocksworld-8", Some("stack b a")),
        ("logistics-6", None),
        ("logistics-6", Some("fly plane1 airport2 airport3")),
    ] {
        compare(name, lacks, planner.as_deref());
    }
}

fn example(file: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/planning").join(file);
    std::fs::read_to_string(path).expect("the examples are there")
}

fn definition(task: &str, without: &[&str]) -> Definition {
    let edits = Edits { without: without.iter().map(ToString::to_string).collect(), ..Edits::default() };
    let file = ImportFile { name: String::new(), content: Box::new(task.as_bytes()) };
    import(ImportFormat::Sas, vec![file], &edits, Limits::NONE, &mut Uninterrupted).expect("the examples are tasks")
}

/// The task without one of its operators.
fn without(task: &str, lacks: &str) -> String {
    let (head, rest) = task.split_once("begin_operator\n").expect("a task has operators");
    let (head, count) = head.trim_end().rsplit_once('\n').expect("a count stands before them");
    let count: usize = count.parse().expect("a count");
    let left = format!("begin_operator\n{rest}").replace(&operator(rest, lacks), "");
    format!("{head}\n{}\n{left}", count - 1)
}

fn operator(operators: &str, name: &str) -> String {
    let begin = operators.find(&format!("begin_operator\n{name}\n")).expect("there is such an operator");
    let end = operators[begin..].find("end_operator\n").expect("it ends");
    format!("{}end_operator\n", &operators[begin..begin + end])
}

struct Planned {
    plan: Vec<String>,
    n_expanded: String,
    search_ms: f64,
}

/// A plan for `task`; `None` if none is found in a minute.
fn plan(planner: &str, task: &str, search: &str) -> Option<Planned> {
    let folder = std::env::temp_dir().join(format!("etude-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let mut child = Command::new(planner)
        .args(["--internal-plan-file", "plan", "--search", search])
        .current_dir(&folder)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("Fast Downward runs");
    child.stdin.take().expect("a pipe").write_all(task.as_bytes()).expect("it reads its task");
    let output = String::from_utf8_lossy(&child.wait_with_output().expect("it ends").stdout).into_owned();
    let after = |before: &str| -> Option<String> {
        let line = output.lines().find_map(|line| line.split_once(before))?;
        line.1.split([' ', 's']).next().map(str::to_owned)
    };
    let plan = std::fs::read_to_string(folder.join("plan"));
    let _ = std::fs::remove_dir_all(&folder);
    let plan = plan.ok()?;
    let steps = plan.lines().filter_map(|line| line.strip_prefix('(')?.strip_suffix(')')).map(str::to_owned);
    Some(Planned {
        plan: steps.collect(),
        n_expanded: after("Expanded ")?,
        search_ms: after("Search time: ")?.parse::<f64>().ok()? * 1000.0,
    })
}

/// The states along a plan, as a demonstration.
fn along(definition: &Definition, plan: &[String]) -> Value {
    let planning: &Planning = definition.dynamics().expect("a large task stays one");
    let (domains, names) = (planning.domains(), planning.schema().attributes());
    let written = |state: &_| -> Value {
        let values = planning.row(state).zip(&domains).zip(names);
        values
            .map(|((value, domain), own)| (own.name.clone(), json!(own.write_value(&domain[value as usize]))))
            .collect::<serde_json::Map<_, _>>()
            .into()
    };
    let mut state = planning.start_states().remove(0);
    let mut seen = vec![written(&state)];
    for step in plan {
        let taken =
            planning.successors(&state).find(|(action, _)| *planning.actions()[usize::from(*action)].name == **step);
        state = taken.expect("a plan can be followed").1.to;
        seen.push(written(&state));
    }
    seen.into()
}

fn compare(name: &str, lacks: Option<&str>, planner: Option<&str>) {
    let task = example(&format!("{name}.sas"));
    let body_task = lacks.map_or_else(|| task.clone(), |lacks| without(&task, lacks));
    let body = mapper(&definition(&task, lacks.as_slice()), Known::Nothing);
    let told = lacks.map_or_else(|| "the whole body".to_owned(), |lacks| format!("without `{lacks}`"));
    let committed: Value = serde_json::from_str(&example(&format!("{name}.json"))).expect("the examples are JSON");
    let mut demonstrations = vec![("the demonstration beside it", committed)];
    if let Some(planned) = planner.and_then(|planner| plan(planner, &task, SEARCHES[1].1)) {
        demonstrations
            .push(("the states along a plan of Fast Downward", along(&definition(&task, &[]), &planned.plan)));
    }
    for (what, demonstration) in &demonstrations {
        let problem = problem(&body, demonstration);
        println!("\n{name}, {told}: {what}, {} observations", problem.demonstration().len());
        let mut times = [Vec::new(), Vec::new()];
        let mut searched: Vec<Vec<f64>> = vec![Vec::new(); SEARCHES.len()];
        let mut found = [String::new(), String::new()];
        let mut expanded =
            vec!["no plan: the goal is beyond this body, or a minute was over".to_owned(); SEARCHES.len()];
        let (mut costs, mut is_proven) = ([0.0; 2], [true; 2]);
        for _ in 0..N_ROUNDS {
            for (n, heuristic) in [HeuristicName::Default, HeuristicName::None].into_iter().enumerate() {
                // What took long is not repeated.
                if times[n].first().is_some_and(|first| *first > 5000.0) {
                    continue;
                }
                let (mapping, time) = timed(|| map(&body, &problem, heuristic));
                times[n].push(ms(time));
                costs[n] = mapping.cost.total;
                let stopped = mapping.stopped_by.map_or(String::new(), |by| format!(", stopped by {by:?}"));
                found[n] = format!("{} expansions, cost {:.1}{stopped}", mapping.n_expanded, mapping.cost.total);
                is_proven[n] = mapping.stopped_by.is_none();
            }
            for (n, (_, search)) in SEARCHES.iter().enumerate() {
                if searched[n].first().is_some_and(|first| *first > 5000.0) {
                    continue;
                }
                if let Some(planned) = planner.and_then(|planner| plan(planner, &body_task, search)) {
                    expanded[n] = format!("{} expansions, {} steps", planned.n_expanded, planned.plan.len());
                    searched[n].push(planned.search_ms);
                }
            }
        }
        assert!(is_proven.contains(&false) || (costs[0] - costs[1]).abs() < 1e-6, "{costs:?}");
        for (n, name) in ["etude", "etude, no heuristic"].into_iter().enumerate() {
            println!("{name:<32} {:>28} ms   {}", spread(times[n].clone()), found[n]);
        }
        for (n, (name, _)) in SEARCHES.iter().enumerate().filter(|_| planner.is_some()) {
            let times = if searched[n].is_empty() { "-".to_owned() } else { spread(searched[n].clone()) };
            println!("Fast Downward, {name:<17} {times:>28} ms   {}", expanded[n]);
        }
    }
}
