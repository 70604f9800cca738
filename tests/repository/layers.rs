//! The order of the layers, as `lib.rs` of both packages tells it, held against what the code refers to.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Modules of the core. Those of a layer may use those before it.
const CORE: [&[&str]; 6] =
    [&["interrupt", "document"], &["attribute"], &["model"], &["mapping"], &["learning"], &["world"]];

/// Modules of the service.
const SERVICE: [&[&str]; 9] = [
    &["memory", "telemetry", "experiment"],
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

/// References that lead to a later layer, or to one that is not listed.
fn out_of_order(root: &str, layers: &[&[&str]]) -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join(root);
    let levels: BTreeMap<&str, usize> =
        layers.iter().enumerate().flat_map(|(level, names)| names.iter().map(move |name| (*name, level))).collect();
    let mut wrong = Vec::new();
    let mut n_references = 0;
    for file in sources(&root) {
        let module = module_of(&root, &file);
        if module == "lib" {
            continue;
        }
        let text = fs::read_to_string(&file).unwrap();
        // Tests may look further.
        let code = text.split("#[cfg(test)]").next().unwrap_or_default();
        for line in code.lines().filter(|line| !line.trim_start().starts_with("//")) {
            for reference in line.split("crate::").skip(1) {
                let used: String = reference.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                n_references += 1;
                let is_before = match (levels.get(&*used), levels.get(&*module)) {
                    (Some(used), Some(own)) => used < own,
                    _ => false,
                };
                if used != module && !is_before {
                    wrong.push(format!("{}: {module} uses {used}", file.display()));
                }
            }
        }
    }
    assert!(n_references > 10, "{} is read", root.display());
    wrong
}

/// Source files, but for files of tests.
fn sources(directory: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") && !path.ends_with("tests.rs") {
            found.push(path);
        }
    }
    found
}

/// The module of the crate that a file belongs to.
fn module_of(root: &Path, file: &Path) -> String {
    let first = file.strip_prefix(root).unwrap().components().next().unwrap();
    first.as_os_str().to_string_lossy().trim_end_matches(".rs").to_owned()
}
