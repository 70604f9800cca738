//! The sources of a package, and what they refer to.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// A path of modules from the root of its package, without `crate`.
pub(crate) type Module = Vec<String>;

/// The modules below `root` that are files of their own, with their code: without tests and comments.
pub(crate) fn modules(root: &str) -> BTreeMap<Module, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join(root);
    let code = |file: &PathBuf| code(&fs::read_to_string(file).unwrap());
    let modules: BTreeMap<Module, String> = files(&root)
        .iter()
        .map(|file| (module(&root, file), code(file)))
        .filter(|(module, _)| !is_test(module))
        .collect();
    assert!(modules.len() > 10, "{} is read", root.display());
    modules
}

/// All files of Rust below a directory, in order.
pub(crate) fn files(directory: &Path) -> Vec<PathBuf> {
    let mut paths: Vec<PathBuf> = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let inside = |path: PathBuf| match path.extension() {
        _ if path.is_dir() => files(&path),
        Some(extension) if extension == "rs" => vec![path],
        _ => Vec::new(),
    };
    paths.into_iter().flat_map(inside).collect()
}

fn is_test(module: &Module) -> bool {
    module.last().is_some_and(|last| last == "tests")
}

fn module(root: &Path, file: &Path) -> Module {
    let relative = file.strip_prefix(root).unwrap().with_extension("");
    let mut module: Module = relative.iter().map(|part| part.to_string_lossy().into_owned()).collect();
    module.pop_if(|last| matches!(last.as_str(), "mod" | "lib"));
    module
}

/// A file without its tests, which may look further, and without comments.
fn code(text: &str) -> String {
    let mut lines = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    let mut code = String::new();
    while let Some(line) = lines.next() {
        if line != "#[cfg(test)]" {
            code += line;
            code.push('\n');
        } else if lines.next().is_some_and(|line| line.ends_with('{')) {
            lines.find(|line| *line == "}");
        }
    }
    code
}

/// What `module`, whose code this is, refers to: paths whose first parts are modules, with what is named in the last of them.
pub(crate) fn references(module: &Module, code: &str, modules: &BTreeMap<Module, String>) -> Vec<(Module, String)> {
    let names: Vec<Vec<String>> = uses(code).chain(inline(code)).collect();
    names.iter().filter_map(|path| resolve(module, path, modules)).collect()
}

/// What is re-exported by `use` from where: the name, and the path that is written.
pub(crate) fn uses(code: &str) -> impl Iterator<Item = Vec<String>> + '_ {
    let statements = code.split(';').filter_map(|statement| {
        let line = statement.rfind("\nuse ").map(|at| at + 5);
        let public = statement.rfind("\npub").and_then(|at| Some(at + statement[at..].find(" use ")? + 5));
        let at = line.max(public).or_else(|| statement.strip_prefix("use ").map(|_| 4))?;
        Some(&statement[at..])
    });
    statements.flat_map(|tree| expand(&tree.split_whitespace().collect::<String>()))
}

/// The paths of a tree such as `a::{b, c::{d, e}}`.
fn expand(tree: &str) -> Vec<Vec<String>> {
    let Some((prefix, rest)) = tree.split_once('{') else {
        return vec![tree.split("::").map(|part| part.split("as").next().unwrap_or(part).to_owned()).collect()];
    };
    let inside = rest.strip_suffix('}').unwrap_or(rest);
    let prefix: Vec<String> = prefix.split("::").filter(|part| !part.is_empty()).map(str::to_owned).collect();
    let (mut depth, mut start, mut paths) = (0, 0, Vec::new());
    for (at, c) in inside.char_indices().chain([(inside.len(), ',')]) {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                // Nothing stands behind a last comma.
                if start < at {
                    paths.extend(expand(&inside[start..at]));
                }
                start = at + 1;
            }
            _ => {}
        }
    }
    paths.into_iter().map(|path| [prefix.clone(), path].concat()).collect()
}

/// Paths from the root of the package or from the module around, wherever they stand.
fn inline(code: &str) -> impl Iterator<Item = Vec<String>> + '_ {
    let is_path = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    let words = code.split(move |c| !is_path(c));
    words
        .filter(|word| word.starts_with("crate::") || word.starts_with("super::"))
        .map(|word| word.split("::").map(str::to_owned).collect())
}

/// The module that a path leads to, and what is named in it.
fn resolve(module: &Module, path: &[String], modules: &BTreeMap<Module, String>) -> Option<(Module, String)> {
    let mut at = module.clone();
    let mut parts = path.iter().peekable();
    let first = parts.peek()?.as_str();
    if first == "crate" {
        at.clear();
        parts.next();
    } else if first != "super" && first != "self" {
        // A module inside this one, or another package.
        at.push(first.to_owned());
        if !modules.contains_key(&at) {
            return None;
        }
        at.pop();
    }
    while let Some(part) = parts.next_if(|part| matches!(part.as_str(), "super" | "self")) {
        if part == "super" {
            at.pop()?;
        }
    }
    while let Some(part) = parts.peek() {
        at.push((*part).clone());
        if !modules.contains_key(&at) {
            at.pop();
            break;
        }
        parts.next();
    }
    Some((at, parts.next().cloned().unwrap_or_default()))
}
