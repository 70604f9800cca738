//! What the fuzz targets begin with, and what they have found: each input is read or refused, and none takes much more memory than it has bytes.

#![expect(clippy::unwrap_used, clippy::print_stdout, reason = "tests may panic, and say how much was read")]

mod inputs;

use std::path::Path;

use inputs::{read_experience, read_expressions, read_import, read_rules};
use peak_alloc::PeakAlloc;

/// Counts what is allocated: by the only test here, as all threads are counted together.
#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// What reading takes whatever is read: a file's buffers, and the stack of the thread on which expressions are parsed is none of it.
const FIXED_BYTES: usize = 4 << 20;
/// How many bytes may be taken for each byte of an input.
const BYTES_FOR_EACH: usize = 64;

/// Every input of a target, by name.
fn corpus(target: &str) -> Vec<(String, Vec<u8>)> {
    // Of the repository, whichever of its packages is tested.
    let mut roots = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let folder = roots.find_map(|root| Some(root.join("fuzz/corpus").join(target)).filter(|path| path.exists()));
    let entries = std::fs::read_dir(folder.unwrap()).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    let mut inputs: Vec<_> = paths.map(|path| (path.display().to_string(), std::fs::read(path).unwrap())).collect();
    inputs.sort();
    assert!(!inputs.is_empty(), "{target}");
    inputs
}

/// Reads every input of a target, within a small multiple of its bytes.
fn replay(target: &str, mut read: impl FnMut(&[u8])) {
    let mut most = 0;
    for (name, bytes) in corpus(target) {
        let before = MEMORY.current_usage();
        MEMORY.reset_peak_usage();
        read(&bytes);
        let taken = MEMORY.peak_usage() - before;
        assert!(taken <= FIXED_BYTES + BYTES_FOR_EACH * bytes.len(), "{name}: {taken} bytes for {}", bytes.len());
        most = most.max(taken);
    }
    println!("{target}: at most {most} bytes");
}

#[test]
fn every_input_of_the_corpora_is_read_or_refused_within_a_small_multiple_of_its_bytes() {
    let mut n_imported = std::collections::BTreeMap::new();
    replay("import", |bytes| {
        if let Some(format) = read_import(bytes) {
            *n_imported.entry(format.name()).or_insert(0) += 1;
        }
    });
    assert!(n_imported.len() >= 4, "{n_imported:?}");
    let mut n_rules = 0;
    replay("rules", |bytes| n_rules += usize::from(read_rules(bytes)));
    let mut n_batches = 0;
    replay("experience", |bytes| n_batches += read_experience(bytes).unwrap_or_default());
    assert!(n_batches >= 4, "{n_batches}");
    let mut n_expressions = [0; 2];
    replay("expressions", |bytes| {
        let (model, perception) = read_expressions(bytes);
        n_expressions[0] += usize::from(model);
        n_expressions[1] += usize::from(perception);
    });
    assert!(n_rules >= 4 && n_expressions.iter().all(|n| *n >= 3), "{n_rules} and {n_expressions:?}");
}
