//! The order of the layers, as `lib.rs` of both packages tells it, held against what the code refers to.

use std::collections::BTreeMap;

use crate::sources::{Module, modules, references};

/// Modules of the core. Those of a layer may use those before it.
const CORE: [&[&str]; 7] = [
    &["interrupt", "document"],
    &["attribute"],
    &["expression"],
    &["model"],
    &["mapping"],
    &["inspection", "learning"],
    &["world"],
];

/// Modules of the service.
const SERVICE: [&[&str]; 10] = [
    &["client", "clock", "compressed", "memory", "telemetry", "picture"],
    &["experiment"],
    &["store"],
    &["service"],
    &["stream"],
    &["http"],
    &["config"],
    &["server"],
    &["cli"],
    &["main"],
];

#[test]
fn modules_of_the_core_use_only_those_before_them() {
    assert_eq!(out_of_order("core/src", &CORE), Vec::<String>::new());
}

#[test]
fn modules_of_the_service_use_only_those_before_them() {
    assert_eq!(out_of_order("src", &SERVICE), Vec::<String>::new());
}

#[test]
fn transports_know_the_store_by_what_the_service_hands_out_alone() {
    let modules = modules("src");
    let mut users = Vec::new();
    for (module, code) in &modules {
        if !matches!(module.first().map(String::as_str), Some("http" | "stream")) {
            continue;
        }
        let uses_store = |(used, name): &(Module, String)| used.first().unwrap_or(name) == "store";
        if references(module, code, &modules).iter().any(uses_store) {
            users.push(module.join("/"));
        }
    }
    assert_eq!(users, Vec::<String>::new());
}

/// References that lead to a later layer, or to one that is not listed.
fn out_of_order(root: &str, layers: &[&[&str]]) -> Vec<String> {
    let levels: BTreeMap<&str, usize> =
        layers.iter().enumerate().flat_map(|(level, names)| names.iter().map(move |name| (*name, level))).collect();
    let modules = modules(root);
    let mut wrong = Vec::new();
    for (module, code) in modules.iter().filter(|(module, _)| !module.is_empty()) {
        for (used, name) in references(module, code, &modules) {
            let (own, used) = (&module[0], used.first().unwrap_or(&name));
            let is_before = match (levels.get(&**used), levels.get(&**own)) {
                (Some(used), Some(own)) => used < own,
                _ => false,
            };
            if used != own && !is_before {
                wrong.push(format!("{}: {own} uses {used}", module.join("/")));
            }
        }
    }
    wrong
}
