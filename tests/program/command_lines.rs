//! Command lines that are wrong, or unusual: each is taken, or answered with what to type.

use std::collections::BTreeSet;
use std::path::Path;

use crate::commands::{etude, run, text};
use crate::harness::process::Process;

/// What `etude` says of a command line that it refuses, in an empty directory.
fn told(directory: &Path, line: &str) -> String {
    let arguments: Vec<&str> = line.split(' ').collect();
    let failed = etude(&arguments).current_dir(directory).output().unwrap();
    let told = text(&failed.stderr).to_owned();
    assert!(!failed.status.success() && failed.stdout.is_empty(), "{line}: {told}");
    told
}

#[test]
fn each_wrong_command_line_is_answered_with_what_to_type() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for name in ["model.json", "demonstration.json"] {
        std::fs::copy(format!("{}/examples/figure-4/{name}", env!("CARGO_MANIFEST_DIR")), here.join(name)).unwrap();
    }
    let map = "map --model model.json --demonstration demonstration.json";
    for (line, expected) in [
        ("serve --database missing/etude.db --listen 127.0.0.1:0", "make it with `mkdir -p missing`"),
        ("serve --database . --listen 127.0.0.1:0", "it is a directory: name a file in it, such as "),
        ("serve --database :memory:", "such as /tmp/etude.db"),
        ("serve --database sqlite://etude.db", "expected a file, not a URL: etude.db"),
        ("serve --listen 8080", "expected a host and a port, such as 127.0.0.1:8080"),
        ("serve --listen http://127.0.0.1:8080", "expected a host and a port, such as 127.0.0.1:8080"),
        ("serve --listen nowhere.invalid:80", "there is no host \"nowhere.invalid\""),
        ("serve --learn-every 7", "expected a time with its unit, such as 500ms, 10s or 1m"),
        ("serve --max-states 1e6", "expected a whole number of at least 0"),
        ("serve --max-states -1", "invalid value '-1' for '--max-states <N>'"),
        ("serve --max-body-bytes lots", "expected a number of bytes, such as 800000000, 512M or 2G"),
        ("--log etude=loud openapi", "invalid value 'etude=loud' for '--log <FILTER>': expected off, error, warn"),
        (
            "map --model demonstration.json --demonstration demonstration.json",
            "the model demonstration.json has faults",
        ),
        ("map --model model.json --demonstration model.json", "model.json: this is a model, and no demonstration"),
        (&format!("{map} --start east"), "expected a state's index, or attribute values such as"),
        (&format!("{map} --start 9999"), "--start 9999: there is no state 9999"),
        (&format!("{map} --deadline-ms 1s"), "expected a whole number of at least 0"),
        (&format!("{map} --deadline-ms 99999999999"), "--deadline-ms 99999999999: expected a whole number from 0 to"),
        (&format!("{map} --max-expansions -1"), "invalid value '-1' for '--max-expansions <N>'"),
        (&format!("{map} --column x"), "expected ATTRIBUTE=COLUMN, such as x=lon"),
        ("stream --model figure-4", "say where that is by --server"),
        ("stream --model model.json --lookahead -1", "expected a number from 1 to 100000, or none"),
        ("stream --model m --server https://127.0.0.1", "https is not spoken here"),
        ("stream --model m --server 8080", "such as http://127.0.0.1:8080"),
        (
            "stream --model m --server 127.0.0.1:1",
            "no service answers at http://127.0.0.1:1/v1/models/m: nothing listens",
        ),
        ("stream --model m --server nowhere.invalid", "there is no such host, or it cannot be reached"),
        ("learner replay gold", "there is no database etude.db: name the one of the service by --database"),
        ("learner export gold --server 127.0.0.1:1", "no service answers at http://127.0.0.1:1/v1/learners/gold"),
        ("learner import demonstration.json", "demonstration.json: is no exported learner"),
        ("experiment figure-4 --out model.json", "cannot write model.json: File exists"),
        ("experiment figure-7 --runs 0", "invalid value '0' for '--runs <N>': expected at least 1"),
        ("healthcheck --listen localhost:1", "no service answers at http://127.0.0.1:1/readyz: nothing listens there"),
    ] {
        let told = told(here, line);
        assert!(told.contains(expected), "{line}: {told}");
        for words in ["os error", "entity not found", "invalid digit", "relative URL", "error sending request"] {
            assert!(!told.contains(words), "{line}: {told}");
        }
    }
}

#[test]
fn a_value_that_is_wrong_in_the_environment_is_told_with_its_variable() {
    let output = |arguments: &[&str]| etude(arguments).env("ETUDE_MAX_STATES", "many").output().unwrap();
    let failed = output(&["serve"]);
    let told = text(&failed.stderr);
    assert!(told.contains("this is the value of the environment variable ETUDE_MAX_STATES"), "{told}");
    let typed = output(&["serve", "--max-states", "more"]);
    assert!(!text(&typed.stderr).contains("environment"), "{}", text(&typed.stderr));
}

#[test]
fn variables_that_are_empty_are_as_if_they_were_not_set() {
    let help = run(&["serve", "--help"]);
    let words = text(&help.stdout).split(|c: char| !c.is_ascii_uppercase() && c != '_');
    let variables: BTreeSet<&str> = words.filter(|word| word.starts_with("ETUDE_")).collect();
    assert!(variables.len() > 20 && variables.contains("ETUDE_MAX_STATES") && variables.contains("ETUDE_LOG"));
    let empty: Vec<(&str, &Path)> = variables.into_iter().map(|variable| (variable, Path::new(""))).collect();
    let directory = tempfile::tempdir().unwrap();
    // That it listens is logged: nothing is, where `ETUDE_LOG` is taken as a filter that lets nothing through.
    let service = Process::start_under(&empty, &["--listen", "localhost:0"], &directory.path().join("etude.db"));
    let healthy = etude(&["healthcheck", "--listen", &service.address]).env("ETUDE_LISTEN", "").output().unwrap();
    assert!(healthy.status.success(), "{}", text(&healthy.stderr));
    let (code, log) = service.signal("-TERM");
    assert_eq!(code, Some(0), "{log}");
    let demo = etude(&["demo"]).envs(empty).output().unwrap();
    assert!(demo.status.success(), "{}", text(&demo.stderr));
}

#[test]
fn a_server_needs_no_scheme() {
    let directory = tempfile::tempdir().unwrap();
    let service = Process::start(&directory.path().join("etude.db"));
    for server in [service.address.clone(), format!("http://{}/", service.address)] {
        let unknown = run(&["learner", "export", "gold", "--server", &server]);
        let told = text(&unknown.stderr);
        assert!(told.contains("answered 404: ") && !told.contains('{'), "{told}");
    }
}
