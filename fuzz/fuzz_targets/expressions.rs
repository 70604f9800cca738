//! Expressions of CEL, one a line, in a model of rules and in what is observed of a demonstrator.
//!
//! ```sh
//! cargo +nightly install cargo-fuzz
//! cargo +nightly fuzz run expressions -- -max_total_time=300 -rss_limit_mb=512 -malloc_limit_mb=64 -dict=fuzz/cel.dict
//! ```

#![no_main]

#[path = "../../core/tests/fuzzed/inputs.rs"]
#[expect(dead_code, reason = "other targets use the rest")]
mod inputs;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = inputs::read_expressions(bytes);
});
