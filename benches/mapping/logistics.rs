//! A planner's model: what is so of packages and trucks, each fact an attribute of two values.

use std::collections::HashMap;

use serde_json::{Value, json};

use crate::worlds::{SplitMix, World};

const N_TRUCKS: usize = 2;

/// Where trucks are; and packages, at places or, numbered after these, in trucks.
type State = (Vec<usize>, Vec<usize>);

#[derive(Clone, Copy, PartialEq, Eq)]
enum Action {
    Drive { truck: usize, to: usize },
    Load { package: usize, truck: usize },
    Unload { package: usize, truck: usize },
}

/// Two trucks that bring packages from place to place, and may drive from any to any. All facts are booleans: `truck 0 at 2`,
/// `package 1 in truck 0`. The demonstrator brings one package after the other to a place at random; the second truck of the imitator
/// cannot drive to the last place.
pub(crate) fn logistics(n_places: usize, n_packages: usize, n_observations: usize, seed: u64) -> World {
    let drives = (0..N_TRUCKS).flat_map(|truck| (0..n_places).map(move |to| Action::Drive { truck, to }));
    let moves = (0..n_packages).flat_map(|package| {
        (0..N_TRUCKS).flat_map(move |truck| [Action::Load { package, truck }, Action::Unload { package, truck }])
    });
    let missing = Action::Drive { truck: N_TRUCKS - 1, to: n_places - 1 };
    let actions: Vec<Action> = drives.chain(moves).filter(|action| *action != missing).collect();

    let start: State = (vec![0; N_TRUCKS], (0..n_packages).map(|package| package % n_places).collect());
    let mut numbers = HashMap::from([(start.clone(), 0)]);
    let mut states = vec![start.clone()];
    let mut transitions = Vec::new();
    let mut from = 0;
    while let Some(state) = states.get(from).cloned() {
        for (action, next) in
            actions.iter().enumerate().filter_map(|(n, action)| Some((n, after(&state, *action, n_places)?)))
        {
            let to = *numbers.entry(next.clone()).or_insert_with(|| {
                states.push(next);
                states.len() - 1
            });
            transitions.push(json!([from, action, to]));
        }
        from += 1;
    }

    let names = (0..N_TRUCKS).flat_map(|truck| (0..n_places).map(move |place| format!("truck {truck} at {place}")));
    let package_names = (0..n_packages).flat_map(|package| {
        let at = (0..n_places).map(move |place| format!("package {package} at {place}"));
        at.chain((0..N_TRUCKS).map(move |truck| format!("package {package} in truck {truck}")))
    });
    let names: Vec<String> = names.chain(package_names).collect();
    let facts = |(trucks, packages): &State| -> Value {
        let of_trucks = trucks.iter().flat_map(|at| (0..n_places).map(move |place| *at == place));
        let of_packages = packages.iter().flat_map(|at| (0..n_places + N_TRUCKS).map(move |place| *at == place));
        of_trucks.chain(of_packages).collect()
    };
    let demonstration = demonstrate(start, n_places, n_observations, seed).iter().map(facts).collect();
    World {
        name: format!("logistics, {} facts", names.len()),
        model: json!({
            "attributes": names.iter().map(|name| json!({"name": name, "kind": "category"})).collect::<Value>(),
            "actions": actions.iter().map(|action| json!({"name": name(*action), "cost": 0.3})).collect::<Value>(),
            "dynamics": {
                "kind": "table", "states": states.iter().map(facts).collect::<Value>(), "transitions": transitions, "start": 0,
            },
        }),
        demonstration,
    }
}

fn name(action: Action) -> String {
    match action {
        Action::Drive { truck, to } => format!("drive truck {truck} to {to}"),
        Action::Load { package, truck } => format!("load package {package} into truck {truck}"),
        Action::Unload { package, truck } => format!("unload package {package} from truck {truck}"),
    }
}

/// What an action makes of a state; `None` if it is not possible or changes nothing.
fn after((trucks, packages): &State, action: Action, n_places: usize) -> Option<State> {
    let (mut trucks, mut packages) = (trucks.clone(), packages.clone());
    match action {
        Action::Drive { truck, to } if trucks[truck] != to => trucks[truck] = to,
        Action::Load { package, truck } if packages[package] == trucks[truck] => packages[package] = n_places + truck,
        Action::Unload { package, truck } if packages[package] == n_places + truck => packages[package] = trucks[truck],
        _ => return None,
    }
    Some((trucks, packages))
}

/// Brings packages to places at random, with trucks at random.
fn demonstrate(start: State, n_places: usize, n_observations: usize, seed: u64) -> Vec<State> {
    let mut random = SplitMix(seed);
    let mut below = |bound: usize| usize::try_from(random.below(i64::try_from(bound).unwrap_or(1))).unwrap_or(0);
    let mut seen = vec![start.clone()];
    let mut state = start;
    while seen.len() < n_observations {
        let (package, truck) = (below(state.1.len()), below(N_TRUCKS));
        let from = state.1[package];
        let way = [
            Action::Drive { truck, to: from },
            Action::Load { package, truck },
            Action::Drive { truck, to: below(n_places) },
            Action::Unload { package, truck },
        ];
        for action in way {
            if let Some(next) = after(&state, action, n_places) {
                state = next;
                seen.push(state.clone());
            }
        }
    }
    seen.truncate(n_observations);
    seen
}
