//! Readers of imported files. The first byte says which format the others are of.
//!
//! ```sh
//! cargo +nightly install cargo-fuzz
//! cargo +nightly fuzz run import -- -max_total_time=300 -rss_limit_mb=512
//! ```

#![no_main]

use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Edits, ImportFile, ImportFormat, Limits, import};
use libfuzzer_sys::fuzz_target;

/// As little as a service might allow.
const LIMITS: Limits = Limits { max_states: 1000, max_transitions: 10_000, max_values: 1 << 20, max_bytes: 1 << 22 };

fuzz_target!(|bytes: &[u8]| {
    let Some((first, content)) = bytes.split_first() else { return };
    let format = ImportFormat::ALL[usize::from(*first) % ImportFormat::ALL.len()];
    let mut edits = Edits::default();
    // So that files with several rewards get further.
    if first & 0x80 != 0 {
        edits.costs.push(("*".to_owned(), 1.0));
    }
    let file = ImportFile { name: String::new(), content: Box::new(content) };
    let _ = import(format, vec![file], &edits, LIMITS, &mut Uninterrupted);
});
