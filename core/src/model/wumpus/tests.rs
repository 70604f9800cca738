use std::sync::Arc;

use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::interrupt::{Interrupt, Meter, Signal, Uninterrupted};
use crate::model::dynamics::Dynamics;
use crate::model::{Definition, Implicit, Limits, Model, Operator};

fn cave(document: &Value) -> Cave {
    let definition = Definition::read(document, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    definition.dynamics::<Cave>().unwrap().clone()
}

fn compiled_while(cave: &Cave, limits: Limits, interrupt: &mut dyn Interrupt) -> Model {
    Arc::new(cave.clone()).compile(limits, interrupt).unwrap()
}

fn compiled(cave: &Cave, limits: Limits) -> Model {
    compiled_while(cave, limits, &mut Uninterrupted)
}

/// Caves with things in any cells but the start's, and bodies.
fn document() -> impl Strategy<Value = Value> {
    let cells = |most| prop::collection::vec((0..4_u16, 0..3_u16), 0..=most);
    let body = prop::sample::subsequence(Act::ALL.to_vec(), 1..=6);
    (cells(3), cells(3), cells(4), body, (0..4_u16, 0..3_u16), 0..3_u8).prop_map(
        |(pits, wumpi, gold, body, (x, y), arrows)| {
            let away = |cells: Vec<Cell>| cells.into_iter().filter(|cell| *cell != (x, y)).collect::<Vec<_>>();
            json!({
                "actions": body.iter().map(|act| json!({"name": act.name()})).collect::<Value>(),
                "dynamics": {
                    "kind": "wumpus", "width": 4, "height": 3, "pits": away(pits), "wumpi": away(wumpi), "gold": gold,
                    "start": {"x": x, "y": y, "heading": "west"}, "arrows": arrows,
                },
            })
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_body_reaches_as_many_states_as_is_certain_and_no_others_if_it_neither_shoots_nor_climbs(document in document()) {
        let cave = cave(&document);
        let least = cave.least_states(&mut Meter::new(&mut Uninterrupted, 1)).unwrap();
        let n_states = u64::from(compiled(&cave, Limits::NONE).states().len());
        let has = |name: &str| cave.actions.iter().any(|action| &*action.name == name);
        prop_assert!((1..=n_states).contains(&least), "{least} of {n_states}");
        let moves_freely = has("forward") && (has("turn_left") || has("turn_right"));
        if moves_freely && !has("climb") && !(has("shoot") && cave.arrows > 0) {
            prop_assert_eq!(least, n_states);
        }
    }

    #[test]
    fn a_row_leads_back_to_its_state(document in document()) {
        let cave = cave(&document);
        let mut found = cave.start_states();
        let mut next = 0;
        while let Some(state) = found.get(next).copied() {
            next += 1;
            let mut row: Vec<Option<u32>> = cave.row(&state).map(Some).collect();
            prop_assert_eq!(cave.state_of(&row), Some(state));
            (0..row.len()).filter(|at| Implicit::is_derived(&cave, *at)).for_each(|at| row[at] = None);
            prop_assert_eq!(cave.state_of(&row), Some(state));
            for (_, outcome) in cave.successors(&state) {
                if !cave.is_unsafe(&outcome.to) && !found.contains(&outcome.to) {
                    found.push(outcome.to);
                }
            }
            if next == 100 {
                break;
            }
        }
    }

    #[test]
    fn an_arrow_hits_what_it_comes_to_first(
        wumpi in prop::collection::vec((0..5_u16, 0..5_u16), 0..20),
        cell in (0..5_u16, 0..5_u16),
        heading in prop::sample::select(Heading::ALL.to_vec()),
        alive in any::<u64>(),
    ) {
        let document = json!({"dynamics": {"kind": "wumpus", "width": 5, "height": 5}});
        let cave = Cave { wumpi, ..cave(&document) };
        let state = CaveState { cell, heading, arrows: 1, outside: false, alive: alive & all_set(cave.wumpi.len()), lying: 0 };
        let flight = std::iter::successors(cave.ahead(cell, heading), |cell| cave.ahead(*cell, heading));
        let hit = flight.into_iter().find_map(|cell| first_in(&cave.wumpi, cell, state.alive)).unwrap_or(0);
        let after = CaveState { arrows: 0, alive: state.alive & !hit, ..state };
        prop_assert_eq!(cave.after(state, Act::Shoot), after);
    }
}

#[test]
fn a_cave_that_is_certainly_too_large_is_not_explored() {
    let spread =
        |n: usize| (1..=64_usize).map(|k| json!([k * 7919 % 1000, (k * 104_729 + n) % 1000])).collect::<Value>();
    let document = json!({"dynamics": {
        "kind": "wumpus", "width": 1000, "height": 1000, "wumpi": spread(1), "gold": spread(2), "arrows": 100,
    }});
    let cave = cave(&document);
    let mut n_polls = 0;
    let mut count = || {
        n_polls += 1;
        Signal::Continue
    };
    assert!(compiled_while(&cave, Limits::DEFAULT, &mut count).is_lazy());
    // A look at each cell, where a million states would be as many looks for each action.
    assert!(n_polls <= 1_000_000 / 1000, "{n_polls}");
}

#[test]
fn a_cave_that_would_take_more_values_or_memory_than_it_may_is_searched_lazily() {
    let document =
        json!({"dynamics": {"kind": "wumpus", "width": 9, "height": 9, "wumpi": [[3, 3]], "gold": [[5, 5]]}});
    let cave = cave(&document);
    let known = compiled(&cave, Limits::DEFAULT);
    let (n_states, n_values) = (known.states().len() as usize, known.states().len() as usize * known.schema().len());
    let is_lazy = |limits| compiled(&cave, limits).is_lazy();
    assert!(!known.is_lazy() && !is_lazy(Limits { max_states: n_states, ..Limits::NONE }));
    assert!(is_lazy(Limits { max_states: n_states - 1, ..Limits::NONE }));
    assert!(!is_lazy(Limits { max_values: n_values, ..Limits::NONE }));
    assert!(is_lazy(Limits { max_values: n_values - 1, ..Limits::NONE }));
    // What exploring takes, with its index, is more than what is left in the end.
    assert!(!is_lazy(Limits { max_bytes: 8 * known.size_bytes(), ..Limits::NONE }));
    assert!(is_lazy(Limits { max_bytes: known.size_bytes(), ..Limits::NONE }));
}

#[test]
fn every_transition_has_an_operator() {
    let document = json!({"dynamics": {
        "kind": "wumpus", "width": 4, "height": 3, "pits": [[3, 2]], "wumpi": [[2, 0], [2, 0], [0, 2]],
        "gold": [[1, 0], [1, 0], [2, 0]], "start": {"x": 1, "y": 1, "heading": "north"}, "arrows": 3,
    }});
    let cave = cave(&document);
    let model = compiled(&cave, Limits::DEFAULT);
    let operators: Vec<Operator> = cave.operators().collect();
    let mut is_used = vec![false; operators.len()];
    for (from, transition) in model.graph().iter() {
        let (row, row_after) = (model.states().row(from), model.states().row(transition.to));
        let differences = (0..row.len()).filter(|at| row[*at] != row_after[*at]);
        let changed: Vec<_> = differences.map(|at| (at, row[at], row_after[at])).collect();
        let found = operators.iter().position(|operator| {
            let is_kept = |(at, value): &(usize, u32)| row[*at] == *value && row_after[*at] == *value;
            operator.action == transition.action && operator.changed == changed && operator.kept.iter().all(is_kept)
        });
        let found = found.unwrap_or_else(|| panic!("{} changes {changed:?}", model.action(transition.action).name));
        is_used[found] = true;
    }
    let idle = operators.iter().zip(is_used).filter(|(_, is_used)| !is_used).count();
    assert!(idle < operators.len() / 4, "{idle} of {} allow what never happens", operators.len());
}
