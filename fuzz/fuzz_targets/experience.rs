//! Models of experience, and what they are told, as JSON: one a line.
//!
//! ```sh
//! cargo +nightly install cargo-fuzz
//! cargo +nightly fuzz run experience -- -max_total_time=300 -rss_limit_mb=512 -malloc_limit_mb=64
//! ```

#![no_main]

#[path = "../../core/tests/fuzzed/inputs.rs"]
#[expect(dead_code, reason = "other targets use the rest")]
mod inputs;

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let _ = inputs::read_experience(bytes);
});
