//! SAS+ tasks, against a reader that takes the file for what the format's documentation says.

use std::collections::{BTreeMap, BTreeSet};

use super::{check_optimal, edits, imported, model, told};
use crate::problems::{close, example, example_bytes, mapper_within, solve};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Edits, ImportFormat, Limits, Model, Planning};
use serde_json::{Value, json};

/// Nothing may be known beforehand.
const LAZY: Limits = Limits { max_states: 0, ..Limits::DEFAULT };

/// A task as its file says it. A fact is a variable and a value.
struct Task {
    values: Vec<Vec<String>>,
    start: Vec<usize>,
    operators: Vec<Operator>,
}

struct Operator {
    name: String,
    cost: usize,
    prevail: Vec<(usize, usize)>,
    effects: Vec<Effect>,
}

/// Conditions, variable, value before, value after.
type Effect = (Vec<(usize, usize)>, usize, Option<usize>, usize);

fn numbers(line: &str) -> Vec<i64> {
    line.split(' ').map(|part| part.parse().unwrap()).collect()
}

fn index(number: i64) -> usize {
    usize::try_from(number).unwrap()
}

fn read(text: &str) -> Task {
    let mut lines = text.lines().filter(|line| !line.starts_with("begin_") && !line.starts_with("end_"));
    let number = |lines: &mut dyn Iterator<Item = &str>| index(numbers(lines.next().unwrap())[0]);
    assert_eq!(number(&mut lines), 3);
    let has_costs = number(&mut lines) == 1;
    let n_variables = number(&mut lines);
    let mut values = Vec::new();
    for _ in 0..n_variables {
        lines.nth(1);
        let n_values = number(&mut lines);
        values.push((0..n_values).map(|_| lines.next().unwrap().to_owned()).collect());
    }
    for _ in 0..number(&mut lines) {
        for _ in 0..number(&mut lines) {
            lines.next();
        }
    }
    let start = (0..n_variables).map(|_| number(&mut lines)).collect();
    for _ in 0..number(&mut lines) {
        lines.next();
    }
    let mut operators = Vec::new();
    for _ in 0..number(&mut lines) {
        let name = lines.next().unwrap().to_owned();
        let pairs = |numbers: &[i64]| numbers.chunks(2).map(|pair| (index(pair[0]), index(pair[1]))).collect();
        let n_prevail = number(&mut lines);
        let prevail = (0..n_prevail).flat_map(|_| numbers(lines.next().unwrap())).collect::<Vec<_>>();
        let mut effects = Vec::new();
        for _ in 0..number(&mut lines) {
            let effect = numbers(lines.next().unwrap());
            let (conditions, rest) = effect[1..].split_at(2 * index(effect[0]));
            effects.push((pairs(conditions), index(rest[0]), usize::try_from(rest[1]).ok(), index(rest[2])));
        }
        let cost = number(&mut lines);
        operators.push(Operator { name, cost: if has_costs { cost } else { 1 }, prevail: pairs(&prevail), effects });
    }
    Task { values, start, operators }
}

impl Task {
    fn of(path: &str) -> Self {
        read(std::str::from_utf8(&example_bytes(path)).unwrap())
    }

    fn after(state: &[usize], operator: &Operator) -> Option<Vec<usize>> {
        let holds = |(variable, value): &(usize, usize)| state[*variable] == *value;
        let applies = operator.prevail.iter().all(holds)
            && operator
                .effects
                .iter()
                .all(|(_, variable, before, _)| before.is_none_or(|before| state[*variable] == before));
        let mut after = state.to_vec();
        for (conditions, variable, _, value) in &operator.effects {
            if conditions.iter().all(holds) {
                after[*variable] = *value;
            }
        }
        applies.then_some(after)
    }

    /// All transitions between states that are reached from the start, by a body that lacks what `lacks` says.
    fn transitions(&self, lacks: impl Fn(&str) -> bool) -> BTreeSet<(Vec<usize>, String, usize, Vec<usize>)> {
        let (mut reached, mut open) = (BTreeSet::from([self.start.clone()]), vec![self.start.clone()]);
        let mut transitions = BTreeSet::new();
        while let Some(state) = open.pop() {
            for operator in self.operators.iter().filter(|operator| !lacks(&operator.name)) {
                let Some(after) = Self::after(&state, operator) else { continue };
                if after == state {
                    continue;
                }
                transitions.insert((state.clone(), operator.name.clone(), operator.cost, after.clone()));
                if reached.insert(after.clone()) {
                    open.push(after);
                }
            }
        }
        transitions
    }

    fn value_of(&self, variable: usize, text: &str) -> usize {
        let written = |value: &String| match value.split_once(' ') {
            Some(("Atom", atom)) => atom.to_owned(),
            Some(("NegatedAtom", atom)) => format!("not {atom}"),
            _ => value.trim_matches(['<', '>']).to_owned(),
        };
        self.values[variable].iter().position(|value| written(value) == text).unwrap()
    }
}

/// The transitions of a table, in the words of the file.
fn transitions(task: &Task, model: &Value) -> BTreeSet<(Vec<usize>, String, usize, Vec<usize>)> {
    let states = model["dynamics"]["states"].as_array().unwrap().iter().map(|state| {
        let values = state.as_array().unwrap().iter().enumerate();
        values.map(|(variable, value)| task.value_of(variable, value.as_str().unwrap())).collect()
    });
    let states: Vec<Vec<usize>> = states.collect();
    let actions = model["actions"].as_array().unwrap().iter();
    let costs: BTreeMap<&str, usize> = actions
        .map(|action| (action["name"].as_str().unwrap(), index(action["cost"].as_f64().unwrap() as i64)))
        .collect();
    let transitions = model["dynamics"]["transitions"].as_array().unwrap().iter().map(|way| {
        let [from, to] = [0, 2].map(|end| states[way[end].as_u64().unwrap() as usize].clone());
        let action = way[1].as_str().unwrap();
        (from, action.to_owned(), costs[action], to)
    });
    transitions.collect()
}

const TASKS: [(&str, &[&str], usize); 4] = [
    ("planning/blocksworld-4", &[], 125),
    ("planning/blocksworld-4", &["stack c *"], 68),
    ("planning/logistics-2", &[], 392),
    ("planning/logistics-2", &["fly * airport2 *"], 160),
];

#[test]
fn a_small_task_is_the_table_of_what_its_operators_lead_to() {
    for (path, without, n_states) in TASKS {
        let task = Task::of(&format!("{path}.sas"));
        let model = model(ImportFormat::Sas, &format!("{path}.sas"), &edits(without, &[]));
        let parts: Vec<&str> = without.iter().flat_map(|without| without.split('*')).collect();
        let lacks = |name: &str| parts.len() > 1 && name.starts_with(parts[0]) && name.contains(parts[1]);
        assert_eq!(transitions(&task, &model), task.transitions(lacks), "{path} without {without:?}");
        assert_eq!(model["dynamics"]["states"].as_array().unwrap().len(), n_states);
        assert_eq!(model["dynamics"]["start"], 0);
    }
}

#[test]
fn a_mapping_on_a_task_costs_what_the_independent_solver_finds() {
    for (path, without, _) in TASKS {
        let model = model(ImportFormat::Sas, &format!("{path}.sas"), &edits(without, &[]));
        check_optimal(&model, &json!({"model": "m", "demonstration": example(&format!("{path}.json"))}));
    }
}

/// The task as a model, by this reader alone; attributes are called as in `like`.
fn planning(task: &Task, like: &Value) -> Value {
    let names: Vec<&str> =
        like["attributes"].as_array().unwrap().iter().map(|own| own["name"].as_str().unwrap()).collect();
    let written = |value: &String| value.replace("NegatedAtom ", "not ").replace("Atom ", "");
    let value = |variable: usize, value: usize| written(&task.values[variable][value]);
    let by_name = |facts: &[(usize, usize)]| -> Value {
        facts
            .iter()
            .map(|(variable, fact)| (names[*variable].to_owned(), Value::from(value(*variable, *fact))))
            .collect()
    };
    let operators = task.operators.iter().map(|operator| {
        let needs = operator.effects.iter().filter_map(|(_, variable, before, _)| Some((*variable, (*before)?)));
        let needs: Vec<_> = operator.prevail.iter().copied().chain(needs).collect();
        let effects: Vec<_> = operator.effects.iter().map(|(_, variable, _, after)| (*variable, *after)).collect();
        json!({"action": operator.name, "when": by_name(&needs), "then": by_name(&effects)})
    });
    let start: Vec<_> = task.start.iter().copied().enumerate().collect();
    json!({
        "attributes": like["attributes"],
        "actions": task.operators.iter().map(|operator| json!({"name": operator.name, "cost": operator.cost})).collect::<Value>(),
        "dynamics": {
            "kind": "planning",
            "values": task.values.iter().map(|values| values.iter().map(written).collect::<Value>()).collect::<Value>(),
            "start": by_name(&start),
            "operators": operators.collect::<Value>(),
        },
    })
}

#[test]
fn a_task_that_is_searched_lazily_gives_the_same_optimum_with_a_heuristic_and_without() {
    for (path, without, _) in TASKS {
        let table = model(ImportFormat::Sas, &format!("{path}.sas"), &edits(without, &[]));
        let model = planning(&Task::of(&format!("{path}.sas")), &table);
        let mapper = mapper_within(LAZY, &model);
        assert!(mapper.model().is_lazy());
        let kept: Vec<&Value> = table["actions"].as_array().unwrap().iter().map(|action| &action["name"]).collect();
        let all = model["actions"].as_array().unwrap().iter().map(|action| &action["name"]);
        let without: Vec<_> = all.filter(|name| !kept.contains(name)).collect();
        let mut request = json!({"model": "m", "demonstration": example(&format!("{path}.json"))});
        let optimum = check_optimal(&table, &request);
        request["without"] = json!(without);
        let [default, none] = ["default", "none"].map(|heuristic| {
            request["heuristic"] = heuristic.into();
            solve(&mapper, &request)
        });
        assert!(close(default.cost.total, optimum) && close(none.cost.total, optimum), "{path} {without:?}");
        assert!(default.search.expanded < none.search.expanded, "{path}: projections guide the search");
    }
}

#[test]
fn a_large_task_stays_a_task_and_is_searched_lazily() {
    let content = example_bytes("planning/logistics-6.sas");
    let definition = imported(ImportFormat::Sas, &content, &edits(&["fly plane2 *"], &["drive *=3"])).unwrap();
    assert!(definition.dynamics::<Planning>().is_some());
    let text: Value = serde_json::from_str(&definition.text()).unwrap();
    let task = Task::of("planning/logistics-6.sas");
    let mut expected = planning(&task, &text);
    let lacks = |name: &Value| name.as_str().unwrap().starts_with("fly plane2 ");
    for (list, name) in [("/actions", "name"), ("/dynamics/operators", "action")] {
        expected.pointer_mut(list).unwrap().as_array_mut().unwrap().retain(|item| !lacks(&item[name]));
    }
    for action in expected["actions"].as_array_mut().unwrap() {
        let cost =
            if action["name"].as_str().unwrap().starts_with("drive ") { 3.0 } else { action["cost"].as_f64().unwrap() };
        action["cost"] = cost.into();
    }
    assert_eq!(text, expected);
    let model = Model::compile(&definition, LAZY, &mut Uninterrupted).unwrap();
    assert!(model.is_lazy());
}

#[cfg(feature = "rules")]
#[test]
fn unsafe_states_of_a_task_that_is_searched_lazily_are_never_entered() {
    let avoiding =
        |texts: &[&str]| Edits { unsafe_if: texts.iter().map(ToString::to_string).collect(), ..Edits::default() };
    let text = "b == 'holding(b)' && c != 'ontable(c)' || c == 'on(c, b)' && a == 'ontable(a)'";
    let table = model(ImportFormat::Sas, "planning/blocksworld-4.sas", &avoiding(&[text]));
    let request = json!({"model": "m", "demonstration": example("planning/blocksworld-4.json")});
    let optimum = check_optimal(&table, &request);
    let free = model(ImportFormat::Sas, "planning/blocksworld-4.sas", &Edits::default());
    assert!(check_optimal(&free, &request) < optimum);
    let mut task = planning(&Task::of("planning/blocksworld-4.sas"), &free);
    task["dynamics"]["unsafe"] = text.into();
    for limits in [LAZY, Limits::DEFAULT] {
        let mapped = solve(&mapper_within(limits, &task), &request).cost.total;
        assert!(close(mapped, optimum), "{mapped} and {optimum}");
    }

    let import =
        |texts: &[&str]| imported(ImportFormat::Sas, &example_bytes("planning/blocksworld-8.sas"), &avoiding(texts));
    let definition = import(&["b == 'on(b, a)'", "h == 'holding(h)' && b == 'ontable(b)'"]).unwrap();
    let large: Value = serde_json::from_str(&definition.text()).unwrap();
    assert_eq!(large["dynamics"]["unsafe"], "(b == 'on(b, a)') || (h == 'holding(h)' && b == 'ontable(b)')");
    let request = json!({"model": "m", "demonstration": example("planning/blocksworld-8.json"), "end_weight": 10});
    let policy = solve(&mapper_within(LAZY, &large), &request);
    for step in &policy.steps {
        let state = serde_json::to_value(&step.state).unwrap();
        assert!(state["b"] != "on(b, a)" && (state["h"] != "holding(h)" || state["b"] != "ontable(b)"), "{state}");
    }
    for (text, expected) in [
        ("b == 'ontable(b)'", "unsafe \"b == 'ontable(b)'\": the state where the body starts is unsafe"),
        ("z == 3", "unsafe \"z == 3\": column 1: unknown name \"z\""),
        ("b", "unsafe \"b\": expected bool, found string"),
    ] {
        let told = import(&[text]).unwrap_err().to_string();
        assert!(told.starts_with(expected), "{told}");
    }
}

#[test]
fn variables_are_called_after_what_they_are_about() {
    let content = example_bytes("planning/blocksworld-4.sas");
    let definition = imported(ImportFormat::Sas, &content, &Edits::default()).unwrap();
    let names: BTreeSet<&str> = definition.schema().attributes().iter().map(|own| own.name.as_str()).collect();
    let expected = ["a", "b", "c", "d", "clear(a)", "clear(b)", "clear(c)", "clear(d)", "handempty()"];
    assert_eq!(names, BTreeSet::from(expected));
}

/// A switch that turns a lamp on, if it is plugged in; and another way to do so.
const LAMP: &str = "begin_version\n3\nend_version\nbegin_metric\n1\nend_metric\n2\n\
    begin_variable\nvar0\n-1\n2\nAtom plugged()\n<none of those>\nend_variable\n\
    begin_variable\nvar1\n-1\n2\nAtom lit(lamp)\nNegatedAtom lit(lamp)\nend_variable\n0\n\
    begin_state\n1\n1\nend_state\nbegin_goal\n1\n1 0\nend_goal\n3\n\
    begin_operator\npress\n0\n2\n1 0 0 1 -1 0\n1 0 1 1 -1 1\n4\nend_operator\n\
    begin_operator\nplug\n0\n1\n0 0 1 0\n0\nend_operator\n\
    begin_operator\nplug\n0\n1\n0 0 0 1\n7\nend_operator\n0\n";

#[test]
fn conditional_effects_costs_and_names_that_stand_twice_are_kept() {
    let definition = imported(ImportFormat::Sas, LAMP.as_bytes(), &Edits::default()).unwrap();
    let model: Value = serde_json::from_str(&definition.text()).unwrap();
    assert_eq!(
        model["dynamics"]["states"],
        json!([
            ["none of those", "not lit(lamp)"],
            ["plugged()", "not lit(lamp)"],
            ["plugged()", "lit(lamp)"],
            ["none of those", "lit(lamp)"],
        ])
    );
    assert_eq!(
        model["actions"],
        json!([
            {"name": "press", "cost": 4.0}, {"name": "plug", "cost": 0.0}, {"name": "plug (2)", "cost": 7.0},
        ])
    );
    assert_eq!(
        model["dynamics"]["transitions"],
        json!([
            [0, "plug", 1],
            [1, "press", 2],
            [1, "plug (2)", 0],
            [2, "plug (2)", 3],
            [3, "press", 0],
            [3, "plug", 2],
        ])
    );
}

#[test]
fn what_is_wrong_with_a_task_is_told_with_its_line() {
    let cases = [
        ("begin_version\n3", "begin_version\n4", "line 2: version 4; version 3 is read here"),
        ("begin_metric\n1", "begin_metric\n2", "line 5: expected 0 or 1, found 2"),
        ("end_metric\n2", "end_metric\n300", "line 7: 300 variables: a model has 1 to 256 attributes"),
        ("end_metric\n2", "end_metric\n3", "line 22: expected `begin_variable`, found \"0\""),
        ("var0\n-1", "var0\n0", "line 10: \"var0\" is derived by axioms, which are not read"),
        ("var0\n-1\n2", "var0\n-1\n3", "line 15: expected `end_variable`, found \"begin_variable\""),
        ("<none of those>", "Atom plugged()", "line 13: \"var0\" has a value twice"),
        ("begin_state\n1", "begin_state\n2", "line 24: variable 0 has no value 2: it has 2, counted from 0"),
        ("begin_state\n1", "begin_state\nx", "line 24: expected a value of the first state, found \"x\""),
        ("\n1 0\nend_goal", "\n2 0\nend_goal", "line 29: there is no variable 2: there are 2"),
        ("1 0 0 1 -1 0", "9 0 0 1 -1 0", "line 36: an effect with 9 conditions does not have so many numbers"),
        (
            "0 0 1 0\n0",
            "0 0 1\n0",
            "line 44: expected an effect: conditions, variable, value before and after: 4 numbers, found 3",
        ),
        ("end_operator\n0\n", "end_operator\n2\nbegin_rule\n", "line 54: 2 axioms, which are not read"),
        ("end_operator\n0\n", "end_operator\n", "line 54: the file ends, but how many axioms there are should follow"),
        ("end_operator\n0\n", "end_operator\n0\nmore\n", "line 55: the file goes on after its end"),
    ];
    for (right, wrong, expected) in cases {
        assert!(LAMP.contains(right), "{right}");
        assert_eq!(told(ImportFormat::Sas, &LAMP.replacen(right, wrong, 1)), expected, "{wrong}");
    }
    for n_bytes in 0..LAMP.len() - 1 {
        imported(ImportFormat::Sas, &LAMP.as_bytes()[..n_bytes], &Edits::default()).unwrap_err();
    }
}
