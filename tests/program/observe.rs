//! Demonstrators with attributes of their own, on the command line.

use std::process::Output;

use crate::commands::etude;

const MODEL: &str = "examples/lift/model.json";

/// What mapping the lift's demonstration in `text`, read from a file called `name`, gives with these flags.
fn mapped(name: &str, text: &str, flags: &[&str]) -> Output {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(name);
    std::fs::write(&path, text).unwrap();
    let mut arguments = vec!["map", "--model", MODEL, "--demonstration", path.to_str().unwrap(), "--json"];
    arguments.extend(flags);
    etude(&arguments).output().unwrap()
}

fn cost(output: &Output) -> f64 {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let policy: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    policy["cost"]["total"].as_f64().unwrap()
}

const CSV: &str = "height_m,passenger,time\n0,out,0\n9.0,out,1\n9,in,2\n3,in,3\n";
const LINES: &str = "{\"height_m\": 0, \"passenger\": \"out\"}\n{\"height_m\": 9, \"passenger\": \"out\"}\n\
                     {\"height_m\": 9.0, \"passenger\": \"in\"}\n{\"height_m\": 3, \"passenger\": \"in\"}\n";

#[test]
fn a_file_in_another_vocabulary_is_observed_as_flags_say() {
    let own = "[{\"floor\": 0, \"rider\": \"waiting\"}, {\"floor\": 3, \"rider\": \"waiting\"}, \
               {\"floor\": 3, \"rider\": \"inside\"}, {\"floor\": 1, \"rider\": \"inside\"}]";
    let expected = cost(&mapped("own.json", own, &[]));
    let flags = ["--observe", "floor=height_m / 3", "--observe", "rider=passenger == 'in' ? 'inside' : 'waiting'"];
    for (name, text) in [("seen.csv", CSV), ("seen.jsonl", LINES)] {
        assert_eq!(cost(&mapped(name, text, &flags)), expected, "{name}");
    }
}

#[test]
fn a_stream_observes_as_a_whole_file_does() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("seen.csv");
    std::fs::write(&path, CSV).unwrap();
    let flags = ["--observe", "floor=height_m / 3", "--observe", "rider=passenger == 'in' ? 'inside' : 'waiting'"];
    let mut arguments =
        vec!["stream", "--model", MODEL, "--demonstration", path.to_str().unwrap(), "--json", "--lookahead", "none"];
    arguments.extend(flags);
    let output = etude(&arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let done: serde_json::Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    assert_eq!(done["cost"]["total"].as_f64(), Some(cost(&mapped("seen.csv", CSV, &flags))), "{done}");
}

#[test]
fn what_cannot_be_observed_is_told_with_the_flag_or_the_row_and_the_column() {
    let told = |flags: &[&str]| {
        let output = mapped("seen.csv", CSV, flags);
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let message = told(&["--observe", "floor=height_m / (3"]);
    assert!(message.contains("--observe floor=height_m / (3") && message.contains("column 14"), "{message}");
    let message = told(&["--observe", "floor=height / 3"]);
    assert!(message.contains("no state of the demonstration has \"height\""), "{message}");
    let message = told(&["--observe", "floor=1 / int(height_m)"]);
    assert!(message.contains("row 2 of") && message.contains("column 3: a division by zero"), "{message}");
    let message = told(&["--observe", "floor=height_m", "--column", "floor=height_m*2"]);
    assert!(message.contains("--column floor=height_m*2"), "{message}");
}
