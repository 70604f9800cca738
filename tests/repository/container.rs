//! The container is built from all that the program includes, without building one.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap()
}

/// What the first stage of the Dockerfile copies, relative to the root.
fn copied() -> Vec<PathBuf> {
    let dockerfile = read("docker/Dockerfile");
    let first_stage = dockerfile.split("\nFROM ").nth(1).unwrap();
    let copies = first_stage.lines().filter_map(|line| line.strip_prefix("COPY "));
    copies
        .flat_map(|copy| {
            let paths: Vec<&str> = copy.split_whitespace().collect();
            let (target, sources) = paths.split_last().unwrap();
            // Elsewhere, what is included would not be found.
            assert!(sources == [*target] || *target == "./", "{copy}");
            sources.iter().map(PathBuf::from).collect::<Vec<_>>()
        })
        .collect()
}

/// Whether the builder is sent this path: the last line that is about it decides.
fn is_sent(path: &Path) -> bool {
    let mut is_sent = true;
    for line in read(".dockerignore").lines().filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (admits, pattern) = match line.strip_prefix('!') {
            Some(pattern) => (true, pattern),
            None => (false, line),
        };
        if pattern == "*" || path.starts_with(pattern) {
            is_sent = admits;
        }
    }
    is_sent
}

/// Every file under `directory`.
fn files(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

/// `path` without `..`.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for component in path.components() {
        match component {
            Component::ParentDir => assert!(plain.pop(), "{}", path.display()),
            component => plain.push(component),
        }
    }
    plain
}

/// What the sources of the program include, relative to the root.
fn included() -> BTreeSet<PathBuf> {
    let mut included = BTreeSet::new();
    let sources = ["src", "core/src"].map(|directory| files(&root().join(directory)));
    for source in sources.into_iter().flatten() {
        let text = fs::read_to_string(&source).unwrap();
        for (position, _) in text.match_indices("include_") {
            let call =
                text[position..].split_once('!').filter(|(name, _)| matches!(*name, "include_str" | "include_bytes"));
            let Some((_, argument)) = call else { continue };
            let path = argument.split('"').nth(1).unwrap();
            let path = plain(&source.parent().unwrap().join(path));
            assert!(path.is_file(), "{} includes {}", source.display(), path.display());
            included.insert(path.strip_prefix(root()).unwrap().to_owned());
        }
    }
    included
}

#[test]
fn the_builder_is_sent_and_copies_whatever_the_program_includes() {
    let (copied, included) = (copied(), included());
    assert!(included.contains(Path::new("migrations/0001_schema.sql")), "{included:?}");
    let is_copied = |path: &Path| copied.iter().any(|copy| path.starts_with(copy));
    let missing: Vec<_> = included.iter().filter(|path| !is_copied(path) || !is_sent(path)).collect();
    assert!(missing.is_empty(), "{missing:?}");
    for copy in &copied {
        assert!(root().join(copy).exists(), "{}", copy.display());
        assert!(is_sent(copy), "{}", copy.display());
    }
    for path in [".cargo/config.toml", "src/lib.rs", "core/src/lib.rs", "core/Cargo.toml", "Cargo.toml", "Cargo.lock"]
        .map(Path::new)
    {
        assert!(is_copied(path) && is_sent(path), "{}", path.display());
    }
}
