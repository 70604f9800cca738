//! No two files use each other.
//!
//! A module and the modules inside it count as one place, as they share private items: between those, there is no circle. What a module
//! only hands on (`pub use`) is used where it is defined.

use std::collections::{BTreeMap, BTreeSet};

use crate::sources::{Module, modules, references, uses};

/// Circles of the core that are still to be opened.
const CORE: &[&str] = &[];

/// Circles of the service that are still to be opened.
const SERVICE: &[&str] = &[];

#[test]
fn files_of_the_core_use_one_another_one_way_only() {
    assert_eq!(circles("core/src"), CORE);
}

#[test]
fn files_of_the_service_use_one_another_one_way_only() {
    assert_eq!(circles("src"), SERVICE);
}

/// Pairs of files that use each other.
fn circles(root: &str) -> Vec<String> {
    let modules = modules(root);
    let used: BTreeMap<&Module, BTreeSet<Module>> = modules
        .iter()
        .map(|(module, code)| {
            let references = references(module, code, &modules);
            let defined = references.into_iter().map(|(used, name)| definer(used, &name, &modules));
            let apart = defined.filter(|used| !module.starts_with(used) && !used.starts_with(module));
            (module, apart.collect())
        })
        .collect();
    assert!(used.values().map(BTreeSet::len).sum::<usize>() > 20, "references of {root} are found");
    let pairs = used.iter().flat_map(|(one, others)| others.iter().map(move |other| (*one, other)));
    let circles = pairs.filter(|(one, other)| one < other && used[other].contains(*one));
    circles.map(|(one, other)| format!("{}, {}", one.join("/"), other.join("/"))).collect()
}

/// The module that defines what `module` calls `name`, which it may only hand on.
fn definer(module: Module, name: &str, modules: &BTreeMap<Module, String>) -> Module {
    let handed_on =
        uses(&modules[&module]).filter(|path| path.len() > 1 && path.last().is_some_and(|last| last == name));
    let inside = handed_on.map(|path| [&module[..], &path[..path.len() - 1]].concat());
    let found = inside.into_iter().find(|inside| modules.contains_key(inside));
    found.map_or(module, |inside| definer(inside, name, modules))
}
