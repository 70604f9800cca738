//! Files are short, or say in their first lines why they are not.

use std::fs;
use std::path::Path;

use crate::sources::files;

/// Most lines of a file without a reason.
const MAX_LINES: usize = 400;

/// What a reason begins with, in the docs of the file: "This file is longer than 400 lines because ..".
const REASON: &str = "longer than 400 lines";

/// Files that are still to be split, or to say why not.
const TO_DO: &[&str] = &[];

#[test]
fn long_files_say_why_they_are_long() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let all = ["core/src", "core/tests", "src", "tests", "benches"].map(|directory| files(&root.join(directory)));
    let is_unexplained = |file: &&std::path::PathBuf| {
        let text = fs::read_to_string(file).unwrap();
        let docs: Vec<&str> = text.lines().take_while(|line| line.starts_with("//!")).collect();
        // The sentence may be broken between two lines.
        text.lines().count() > MAX_LINES && !docs.join(" ").replace(" //!", "").contains(REASON)
    };
    let unexplained = all.iter().flatten().filter(is_unexplained);
    let names: Vec<_> = unexplained.map(|file| file.strip_prefix(root).unwrap().to_string_lossy()).collect();
    assert_eq!(names, TO_DO, "split it, or write: //! This file is {REASON} because ..");
}
